"""Folders of data sets: whose set it is, files that appear whole and stay, and where an unfinished one goes on."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import shutil
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.dataset.cameras import PictureSpec
from iris_session.dataset.episodes import DatasetError, Plan
from iris_session.dataset.frames import Schema, Table
from iris_session.replay.pictures import Layer
from iris_session.system.files import sync_folder

Stats = dict[str, NDArray[np.float64]]

#: Files that are not in their places yet.
PARTIAL: Final = ".partial"
#: Recordings that an error names.
_NAMED: Final = 3


class PictureSink(ABC):
    """Pictures of one episode on their way into files of a folder, which `SetWriter.close_episode` finds there."""

    @abstractmethod
    def add(self, look: int, camera: str, image: Layer) -> None:
        """Add the picture of a look and camera of the next frame, or a layer of it, as of `CameraSet.draw`."""

    @abstractmethod
    def close(self) -> dict[tuple[int, str], Stats]:
        """Finish the files, and return statistics by look and camera where the format has any."""

    @abstractmethod
    def abort(self) -> None:
        """Close files that are not needed any more."""


class SetWriter(ABC):
    """A data set in a folder: begun, or continued after its last closed episode.

    Args:
        folder: Its folder; it is made if it does not exist.
        plan: The episodes.
        schema: Their frames.
        pictures: Their pictures.

    Attributes:
        partial: Folder for files that are not in their places yet.
        n_episodes, n_frames: Closed so far.
        next: Where the next begins: number in the plan, and look.

    Raises:
        DatasetError: The folder has something else, or a set of another request.
        OSError: It cannot be written to.
    """

    def __init__(self, folder: Path, plan: Plan, schema: Schema, pictures: PictureSpec) -> None:
        self.folder, self.plan, self.schema, self.pictures = folder, plan, schema, pictures
        self.partial = folder / PARTIAL
        self.n_episodes = self.n_frames = 0
        self.next = (0, 0)

    def prepare(self, name: str, request: Mapping[str, Any]) -> None:
        """Check the folder, and remove what a killed run has left.

        Args:
            name: File of the request in the folder.
            request: All that the set follows from, as plain values: that of a set that is there must be the same.
        """
        check_folder(self.folder, name, request, {one.id: str(one.path) for one in self.plan.recordings})
        shutil.rmtree(self.partial, ignore_errors=True)
        self.partial.mkdir(parents=True, exist_ok=True)

    def note_closed(self, index: int, look: int) -> None:
        """Note the last closed episode: its number in the plan, and look."""
        self.next = (index, look + 1) if look < self.pictures.looks else (index + 1, 0)

    @abstractmethod
    def close_episode(
        self, index: int, look: int, table: Table, pictures: Mapping[tuple[int, str], Stats], folder: Path
    ) -> None:
        """Write an episode, and name it: afterwards it is on the disk.

        Args:
            index: Its number in the plan.
            look: Its look.
            table: Its frames.
            pictures: Statistics of its pictures, by look and camera.
            folder: Where the files of its pictures are.
        """

    def describe(self, index: int, look: int, table: Table) -> dict[str, Any]:
        """Return what every format says of an episode: plain values by name."""
        episode = self.plan.episodes[index]
        return {
            "label": episode.label,
            "task": episode.task,
            "recording": self.plan.recordings[episode.recording].id,
            "episode": episode.number,
            "plan_index": index,
            "look": look,
            "notes": "; ".join(table.notes),
        }

    def finish(self) -> None:
        """Remove what only an unfinished set needs."""
        shutil.rmtree(self.partial, ignore_errors=True)

    def write_json(self, name: str, value: Any) -> None:
        """Write a file of the set."""
        path = self.partial / "file.json"
        path.write_text(json.dumps(value, indent=4, ensure_ascii=False) + "\n", encoding="utf-8")
        self.place(path, name)

    def place(self, path: Path, name: str) -> None:
        """Give a file its name in the set, in one step; content and name survive a power cut afterwards."""
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
        target = self.folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(path, target)
        sync_folder(target.parent)


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Make a folder and let no other export use it meanwhile (on file systems with locks).

    Raises:
        DatasetError: Another one does.
        OSError: It cannot be made.
    """
    if folder.exists() and not folder.is_dir():
        raise DatasetError(f"{folder} is no folder: give one that is empty or does not exist")
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY | os.O_CLOEXEC)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EAGAIN, errno.EACCES):
            os.close(descriptor)
            raise DatasetError(f"another export writes to {folder}: wait for its end, or give another folder") from None
    try:
        yield
    finally:
        os.close(descriptor)


def check_folder(folder: Path, name: str, request: Mapping[str, Any], files: Mapping[str, str]) -> None:
    """Check that a folder is empty, or has an unfinished or finished set of the same request.

    `files`: recordings of the request, by their ids.

    Raises:
        DatasetError: It has something else.
    """
    path = folder / name
    if not path.exists():
        # Folders without files are of a run that was killed at its beginning.
        if any(one.is_file() for one in folder.rglob("*") if PARTIAL not in one.parts):
            raise DatasetError(
                f"the folder {folder} is not empty, and has no data set of this format: give another one"
            )
        return
    try:
        found = json.loads(path.read_bytes())
        assert isinstance(found, dict)
    except (ValueError, AssertionError) as error:
        raise DatasetError(f"{path} is damaged: give another folder") from error
    if new := set(request.get("recordings", ())) - set(found.get("recordings", ())):
        names = ", ".join(sorted(files[one] for one in new)[:_NAMED])
        raise DatasetError(
            f"{folder} has a data set without {len(new)} of the recordings: {names}. Give those of the set, or another "
            "folder"
        )
    if difference := _find_difference(found, json.loads(json.dumps(request))):
        where, there, here = difference
        raise DatasetError(
            f"{folder} has a data set that differs in {where} ({there}, not {here}): give another folder, or remove it"
        )


def _find_difference(there: Any, here: Any, where: str = "") -> tuple[str, str, str] | None:
    """Return where two plain values differ first, and what stands there in each; None: nowhere."""
    if there == here:
        return None
    keys: Iterable[Any] = ()
    if isinstance(there, dict) and isinstance(here, dict):
        keys = dict.fromkeys((*here, *there))
        there, here = defaultdict(lambda: None, there), defaultdict(lambda: None, here)
    elif isinstance(there, list) and isinstance(here, list) and len(there) == len(here):
        keys = range(len(here))
    for key in keys:
        if difference := _find_difference(there[key], here[key], f"{where}.{key}".lstrip(".")):
            return difference
    return where, json.dumps(there, ensure_ascii=False)[:100], json.dumps(here, ensure_ascii=False)[:100]
