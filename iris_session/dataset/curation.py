"""Edits of curations: what people decide about the episodes of a recording, in the file beside it.

The recording is never opened for writing. A curation without a decision is no file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from iris_session.dataset.episodes import LABELS, Curation, DatasetError, EpisodeCuration, find_curation
from iris_session.system.files import Replacement

#: An episode may end within a period of the state after the last one that is known [s].
_TOLERANCE_S: Final = 0.05
_TRIM: Final = re.compile(r"(\d+)=(\d+\.?\d*|\.\d+):(\d+\.?\d*|\.\d+)")
_NAMED: Final = re.compile(r"(\d+)=(.+)", re.DOTALL)
MAX_TASK: Final = 512


class Edits(msgspec.Struct, frozen=True):
    """Decisions to add to a curation, by numbers of episodes.

    `reset` is done first; it removes all decisions about an episode, `reset_all` those about all. `trim`: first and
    last moment that is kept [s since its beginning]. `label`: empty for that of the recording. `task`: texts;
    `task_of_all`: for the others.
    """

    drop: tuple[int, ...] = ()
    keep: tuple[int, ...] = ()
    trim: dict[int, tuple[float, float]] = {}
    label: dict[int, str] = {}
    task: dict[int, str] = {}
    task_of_all: str = ""
    reset: tuple[int, ...] = ()
    reset_all: bool = False

    def __bool__(self) -> bool:
        return self != Edits()


def parse_edits(
    *,
    drop: Sequence[str] = (),
    keep: Sequence[str] = (),
    trim: Sequence[str] = (),
    label: Sequence[str] = (),
    task: Sequence[str] = (),
    reset: Sequence[str] = (),
) -> Edits:
    """Parse edits as the command line has them: `4,5`, `3=1.2:8.5`, `5=success`, `TEXT` or `5=TEXT`; `all` of a reset.

    Raises:
        DatasetError: One is none of these.
    """
    labels, tasks, texts = {}, {}, []
    for text in _split(label):
        if (found := _NAMED.fullmatch(text)) is None:
            raise DatasetError(f"--label {text!r:.80}: give NUMBER=LABEL, for example 5=success")
        labels[int(found[1])] = found[2]
    for text in task:
        if len(text) > MAX_TASK or not text.strip():
            raise DatasetError(f"--task {text!r:.60}: give a text of 1 to {MAX_TASK} characters")
        found = _NAMED.fullmatch(text)
        if found is None:
            texts.append(text)
        else:
            tasks[int(found[1])] = found[2]
    if len(texts) > 1:
        raise DatasetError("--task is given twice: give one text for all episodes, or NUMBER=TEXT for each")
    trims = {}
    for text in _split(trim):
        if (found := _TRIM.fullmatch(text)) is None:
            raise DatasetError(f"--trim {text!r:.80}: give NUMBER=FROM:TO in seconds since its beginning: 3=1.2:8.5")
        trims[int(found[1])] = float(found[2]), float(found[3])
    resets = [text for text in _split(reset) if text != "all"]
    numbers = [_parse_numbers(name, given) for name, given in (("drop", drop), ("keep", keep), ("reset", resets))]
    if twice := set(numbers[0]) & set(numbers[1]):
        raise DatasetError(f"episode {min(twice)} is given to --drop and --keep: give it to one of them")
    all_of_it = len(resets) < len(_split(reset))
    return Edits(numbers[0], numbers[1], trims, labels, tasks, "".join(texts), numbers[2], all_of_it)


def _split(given: Sequence[str]) -> list[str]:
    return [part for text in given for part in text.replace(" ", "").split(",")]


def _parse_numbers(name: str, given: Sequence[str]) -> tuple[int, ...]:
    for text in _split(given):
        if not (text.isascii() and text.isdigit()):
            raise DatasetError(f"--{name} {text!r:.40}: give numbers of episodes, for example 4 or 4,5")
    return tuple(map(int, _split(given)))


def edit_curation(curation: Curation, lengths_s: Mapping[int, float], edits: Edits) -> Curation:
    """Return a curation with edits.

    Args:
        curation: As it is.
        lengths_s: Length of each episode that can be edited, by its number [s].
        edits: What changes.

    Raises:
        DatasetError: There is no such episode or label, or a trim is outside of its episode.
    """
    named = (*edits.drop, *edits.keep, *edits.trim, *edits.label, *edits.task, *edits.reset)
    if unknown := sorted(set(named) - set(lengths_s)):
        there_are = ", ".join(map(str, lengths_s)) or "none"
        raise DatasetError(f"there is no episode {unknown[0]} in the recording: there are {there_are}")
    found = {} if edits.reset_all else {n: one for n, one in curation.episodes.items() if n not in edits.reset}

    def change(number: int, **changes: Any) -> None:
        found[number] = msgspec.structs.replace(found.get(number, EpisodeCuration()), **changes)

    for number in lengths_s if edits.task_of_all else ():
        change(number, task=edits.task_of_all)
    for number, text in edits.task.items():
        change(number, task=text)
    for number, label in edits.label.items():
        if label not in ("", *LABELS):
            raise DatasetError(f"episode {number} cannot have the label {label!r:.40}: give one of {', '.join(LABELS)}")
        change(number, label=label)
    for number, (begin_s, end_s) in edits.trim.items():
        if not begin_s < end_s <= lengths_s[number] + _TOLERANCE_S:
            raise DatasetError(
                f"episode {number} cannot be trimmed to {begin_s:g}:{end_s:g}: give two ascending times from 0 to "
                f"{lengths_s[number]:.2f} s"
            )
        change(number, trim=(begin_s, end_s))
    for number in (*edits.drop, *edits.keep):
        change(number, drop=number in edits.drop)
    kept = {number: found[number] for number in sorted(found) if found[number] != EpisodeCuration()}
    return Curation(curation.recording, kept)


def write_curation(recording: str | Path, curation: Curation) -> None:
    """Write the curation of a recording beside it, as a whole; remove the file of an empty one.

    Args:
        recording: First file of the recording, which is not touched.
        curation: Its decisions.

    Raises:
        DatasetError: The folder cannot be written to.
    """
    path = find_curation(recording)
    try:
        if not curation.episodes:
            path.unlink(missing_ok=True)
            return
        with Replacement(path, durable=True, permissions=None) as replacement:
            replacement.file.write(msgspec.json.format(msgspec.json.encode(curation), indent=1) + b"\n")
    except OSError as error:
        raise DatasetError(f"{path} cannot be written: {error.strerror or error}") from error
