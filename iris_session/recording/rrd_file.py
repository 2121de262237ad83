"""Damaged Rerun files: finds what can be read in a file that was cut short or changed, without altering it.

An RRD file is a 12-byte header and messages of a 16-byte head (kind, length; little-endian uint64) and a body. Rerun's
reader stops at the first body it cannot decode; this module makes a temporary copy of the messages that it can.
"""

from __future__ import annotations

import os
import struct
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

from iris_session.recording.errors import NotARecordingError

MAGIC: Final = b"RRF2"
FILE_HEAD: Final = 12
FILE_TAIL: Final = 32  # after the end message of a file with a footer
_HEAD: Final = struct.Struct("<QQ")
KIND_END: Final = 0
KIND_STORE_INFO: Final = 1
KIND_ARROW: Final = 2
#: Messages that are tried together; a group that fails is halved until the bad ones are alone.
GROUP: Final = 256


class Message(NamedTuple):
    """`offset` of its head in the file, `length` of its body [bytes]."""

    offset: int
    kind: int
    length: int


class Scan(NamedTuple):
    """`good_bytes`: the file is whole up to here."""

    messages: list[Message]
    good_bytes: int
    size: int


def scan(path: str | Path) -> Scan:
    """Walks over the messages of a file without decoding them. Raises `NotARecordingError`."""
    size = os.path.getsize(path)
    found: list[Message] = []
    with open(path, "rb") as file:
        if file.read(FILE_HEAD)[: len(MAGIC)] != MAGIC:
            raise NotARecordingError(f"{path} is not a Rerun file (it does not begin with {MAGIC.decode()})")
        at = FILE_HEAD
        while at + _HEAD.size <= size:
            file.seek(at)
            kind, length = _HEAD.unpack(file.read(_HEAD.size))
            if kind > KIND_ARROW + 1 or at + _HEAD.size + length > size:
                break
            found.append(Message(at, kind, length))
            at += _HEAD.size + length
            if kind == KIND_END:
                break
    has_footer = bool(found) and found[-1].kind == KIND_END and size - at == FILE_TAIL
    return Scan(found, size if has_footer else at, size)


def chunks(path: str | Path, entity: str) -> Iterator[Any]:
    """Chunks of one entity in the order of writing. Raises `RuntimeError` where the file is damaged."""
    try:
        iterator = iter(_open(path).filter(content=entity))
    except BaseException as error:
        raise _plain(error) from error
    while True:
        try:
            chunk = next(iterator)
        except StopIteration:
            return
        except BaseException as error:
            raise _plain(error) from error
        yield chunk


def is_readable(path: str | Path) -> bool:
    """True when Rerun decodes every message of the file."""
    try:
        for _ in _open(path):
            pass
    except BaseException as error:
        _plain(error)
        return False
    return True


def salvage(path: str | Path, copy: str | Path) -> list[str]:
    """Writes the readable messages of `path` to `copy`. Returns what was left out, a line each.

    Raises `NotARecordingError` when nothing is readable.
    """
    found = scan(path)
    damage = []
    if found.good_bytes < found.size:
        damage.append(f"cut or changed at byte {found.good_bytes} of {found.size}: nothing after it is readable")
    messages = [m for m in found.messages if m.kind != KIND_END]
    infos = [m for m in messages if m.kind == KIND_STORE_INFO]
    if not infos:
        raise NotARecordingError(f"{path} holds no recording that can be read")
    with open(path, "rb") as file, tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / "trial.rrd"
        bad: list[Message] = []
        others = [m for m in messages if m.kind != KIND_STORE_INFO]
        for i in range(0, len(others), GROUP):
            bad += _bad_ones(file, infos, others[i : i + GROUP], trial)
        damage += [f"message of {m.length} bytes at byte {m.offset} is damaged and left out" for m in bad]
        refused = {m.offset for m in bad}
        _write(file, [m for m in messages if m.offset not in refused], Path(copy))
    return damage


def _open(path: str | Path) -> Any:
    """Rerun's stream of the chunks of the recording in `path`."""
    from rerun.chunk import RrdReader

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a file without a footer is normal here: the session was killed
        return RrdReader(str(path)).stream()


def _bad_ones(file: Any, infos: Sequence[Message], group: Sequence[Message], trial: Path) -> list[Message]:
    _write(file, [*infos, *group], trial)
    if is_readable(trial):
        return []
    if len(group) == 1:
        return list(group)
    half = len(group) // 2
    return _bad_ones(file, infos, group[:half], trial) + _bad_ones(file, infos, group[half:], trial)


def _write(file: Any, messages: Sequence[Message], path: Path) -> None:
    file.seek(0)
    with open(path, "wb") as out:
        out.write(file.read(FILE_HEAD))
        for message in messages:
            file.seek(message.offset)
            out.write(file.read(_HEAD.size + message.length))


def _plain(error: BaseException) -> RuntimeError:
    """Rerun's errors and its panics (which are no `Exception`) as `RuntimeError`; everything else goes on."""
    if isinstance(error, Exception) or type(error).__name__ == "PanicException":
        return RuntimeError(" ".join(str(error).split()))
    raise error
