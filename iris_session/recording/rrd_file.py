"""Damaged Rerun files: finds what can be read in a file that was cut short or changed, without altering it.

An RRD file is a 12-byte header and messages of a 16-byte head (kind, length; little-endian uint64) and a body. Rerun's
reader stops at the first body it cannot decode, or aborts; this module makes a temporary copy of those that it can.
"""

from __future__ import annotations

import os
import struct
import tempfile
import warnings
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

from iris_session.recording.errors import NotARecordingError
from iris_session.recording.probe import Prober

MAGIC: Final = b"RRF2"
FILE_HEAD: Final = 12
FILE_TAIL: Final = 32  # after the end message of a file with a footer
FOOT: Final = b"FOOT"
_HEAD: Final = struct.Struct("<QQ")
KIND_END: Final = 0
KIND_STORE_INFO: Final = 1
KIND_ARROW: Final = 2
KIND_LAST: Final = 3
#: The last message of a file that was closed. Rerun's own has a footer as its body, and more behind it.
END_MESSAGE: Final = _HEAD.pack(KIND_END, 0)
_ARROW_HEAD: Final = struct.pack("<Q", KIND_ARROW)
#: Messages that are tried together; a group that fails is halved until the bad ones are alone.
GROUP: Final = 256
#: What is searched at once for messages behind a damaged one.
WINDOW_BYTES: Final = 1 << 20


class RrdMessage(NamedTuple):
    """`offset` of its head in the file, `length` of its body [bytes]."""

    offset: int
    kind: int
    length: int


class Scan(NamedTuple):
    """`holes`: spans between readable messages that are none. `good_bytes`: after the last readable message.

    `cut`: the file ends in the middle of a message, as after a kill or a full disk. Behind the message that ends a file
    nothing belongs to it, but the tail that Rerun's own files have. `indexed`: it ends with Rerun's index, which a
    recorder does not write: one of Rerun's tools has made it, from one file or several.
    """

    messages: list[RrdMessage]
    holes: list[tuple[int, int]]
    good_bytes: int
    size: int
    cut: bool
    indexed: bool


class Mark(NamedTuple):
    """The recorder's note about a span of its file: CRC-32 of the bytes from `begin` up to `end`."""

    begin: int
    end: int
    crc: int


def scan_file(path: str | Path) -> Scan:
    """Walks over the messages of a file without decoding them. Raises `NotARecordingError`."""
    size = os.path.getsize(path)
    found: list[RrdMessage] = []
    holes: list[tuple[int, int]] = []
    with open(path, "rb") as file:
        if file.read(FILE_HEAD)[: len(MAGIC)] != MAGIC:
            raise NotARecordingError(f"{path} is not a Rerun file (it does not begin with {MAGIC.decode()})")
        at = FILE_HEAD
        while at < size:
            message = _message_at(file, at, size)
            if message is None:
                after = _next_message(file, at + 1, size)
                if after is None:
                    break
                holes.append((at, after))
                at = after
                continue
            found.append(message)
            at += _HEAD.size + message.length
            if message.kind == KIND_END:
                file.seek(at)
                at += FILE_TAIL if FOOT in file.read(FILE_TAIL) else 0
                break
    ended = bool(found) and found[-1].kind == KIND_END
    return Scan(found, holes, min(at, size), size, at < size and not ended, ended and found[-1].length > 0)


def end_of_messages(data: bytes) -> int:
    """Where, in the bytes of a whole file, the message lies that ends it. Raises `ValueError`: no such file."""
    at = FILE_HEAD
    while at + _HEAD.size <= len(data):
        kind, length = _HEAD.unpack_from(data, at)
        if kind == KIND_END:
            return at
        at += _HEAD.size + length
    raise ValueError("a Rerun file without an end")


def _message_at(file: BinaryIO, at: int, size: int) -> RrdMessage | None:
    file.seek(at)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    kind, length = _HEAD.unpack(head)
    return RrdMessage(at, kind, length) if kind <= KIND_LAST and at + _HEAD.size + length <= size else None


def _next_message(file: BinaryIO, begin: int, size: int) -> int | None:
    """Where messages go on behind a damaged head: an Arrow message that is followed by another one or by the end."""
    overlap = len(_ARROW_HEAD) - 1
    for window in range(begin, size, WINDOW_BYTES):
        file.seek(window)
        data = file.read(WINDOW_BYTES + overlap)
        at = data.find(_ARROW_HEAD)
        while at >= 0:
            message = _message_at(file, window + at, size)
            if message is not None:
                end = message.offset + _HEAD.size + message.length
                if end == size or _message_at(file, end, size) is not None:
                    return message.offset
            at = data.find(_ARROW_HEAD, at + 1)
    return None


def changed_spans(path: str | Path, marks: Sequence[Mark]) -> list[str]:
    """The spans of the file whose bytes are not those that the recorder noted, a line each.

    None of a file that another tool has rewritten: there the marks end nowhere between messages.
    """
    found = scan_file(path)
    if found.indexed:
        return []
    ends = {m.offset for m in found.messages} | {found.size}
    if not any(mark.end in ends for mark in marks):
        return []
    out = []
    with open(path, "rb") as file:
        for mark in marks:
            if not 0 <= mark.begin <= mark.end <= found.size or _crc(file, mark) != mark.crc:
                out.append(f"bytes {mark.begin} to {mark.end} are not as they were written")
    return out


def _crc(file: BinaryIO, mark: Mark) -> int:
    """Of the bytes of `mark` as they are now."""
    file.seek(mark.begin)
    crc, left = 0, mark.end - mark.begin
    while left and (data := file.read(min(left, 1 << 20))):
        crc, left = zlib.crc32(data, crc), left - len(data)
    return crc


def read_chunks(path: str | Path, entity: str) -> Iterator[Any]:
    """Chunks of one entity in the order of the file. It must be readable, see `Prober`.

    Raises `NotARecordingError` when it is so no longer.
    """
    from rerun.chunk import RrdReader

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a file without a footer is normal here: the recorder may have been killed
            stream = RrdReader(str(path)).stream().filter(content=entity)
        yield from stream
    except (OSError, RuntimeError, ValueError) as error:
        said = " ".join(str(error).split())
        raise NotARecordingError(f"{path} can no longer be read: {said}") from error


def salvage(path: str | Path, copy: str | Path, prober: Prober) -> list[str]:
    """Writes the readable messages of `path` to `copy`. Returns what was left out, a line each.

    Raises `NotARecordingError` when nothing is readable.
    """
    found = scan_file(path)
    damage = [f"bytes {begin} to {end} hold no message and are left out" for begin, end in found.holes]
    if found.good_bytes < found.size and not found.cut:
        damage.append(f"nothing after byte {found.good_bytes} of {found.size} is readable")
    messages = [m for m in found.messages if m.kind != KIND_END]
    infos = [m for m in messages if m.kind == KIND_STORE_INFO]
    with open(path, "rb") as file, tempfile.TemporaryDirectory() as folder:
        trial = _Trial(file, infos, Path(folder) / "trial.rrd", prober)
        if not infos or not trial.passes([]):
            raise NotARecordingError(f"{path} holds no recording that can be read")
        bad: list[RrdMessage] = []
        others = [m for m in messages if m.kind != KIND_STORE_INFO]
        for i in range(0, len(others), GROUP):
            bad += trial.bad_ones(others[i : i + GROUP])
        damage += [f"message of {m.length} bytes at byte {m.offset} is damaged and left out" for m in bad]
        refused = {m.offset for m in bad}
        _write(file, [m for m in messages if m.offset not in refused], Path(copy))
    return damage if damage or found.cut else ["the footer is damaged: read without it"]


class _Trial:
    """Finds the messages of `file` that do not decode, by halving groups of them."""

    def __init__(self, file: BinaryIO, infos: Sequence[RrdMessage], path: Path, prober: Prober) -> None:
        self._file = file
        self._infos = infos
        self._path = path
        self._prober = prober

    def passes(self, group: Sequence[RrdMessage]) -> bool:
        _write(self._file, [*self._infos, *group], self._path)
        return self._prober.is_readable(self._path)

    def bad_ones(self, group: Sequence[RrdMessage]) -> list[RrdMessage]:
        if self.passes(group):
            return []
        if len(group) == 1:
            return list(group)
        half = len(group) // 2
        return self.bad_ones(group[:half]) + self.bad_ones(group[half:])


def _write(file: BinaryIO, messages: Sequence[RrdMessage], path: Path) -> None:
    file.seek(0)
    with open(path, "wb") as out:
        out.write(file.read(FILE_HEAD))
        for message in messages:
            file.seek(message.offset)
            out.write(file.read(_HEAD.size + message.length))
