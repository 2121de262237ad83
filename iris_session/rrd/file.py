"""Rerun files: list their messages without decoding them, read chunks, and find bytes that were changed.

An RRD file is a 12-byte header and messages of a 16-byte head (kind, length; little-endian uint64) and a body. What
cannot be decoded is found by `salvage.py`.
"""

from __future__ import annotations

import os
import struct
import sys
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

from iris_session.journal.errors import NotARecordingError

if sys.platform != "win32":  # where nothing is recorded, and recordings are read
    import fcntl

MAGIC: Final = b"RRF2"
FILE_HEAD: Final = 12
FILE_TAIL: Final = 32  # after the end message of a file with a footer
FOOT: Final = b"FOOT"
_HEAD: Final = struct.Struct("<QQ")
KIND_END: Final = 0
KIND_STORE_INFO: Final = 1
KIND_ARROW: Final = 2
KIND_LAST: Final = 3
#: The last message of a closed file. Its body may be an index, the footer, which is followed by a tail.
END_MESSAGE: Final = _HEAD.pack(KIND_END, 0)
_ARROW_HEAD: Final = struct.pack("<Q", KIND_ARROW)
#: Kinds of stores.
RECORDING: Final = 1
BLUEPRINT: Final = 2
#: Upper bound of the bytes at the beginning of a message in which the id of its store stands.
ID_BYTES: Final = 160
#: Number of messages that are written twice when a file is closed: the last mark, and the end of the journal.
CLOSING: Final = 2
_CHANGED: Final = "bytes {} to {} are not as they were written"
#: Bytes searched at a time for messages after a damaged one.
WINDOW_BYTES: Final = 1 << 20


class RrdMessage(NamedTuple):
    """One message: `offset` of its head in the file, `length` of its body [bytes]."""

    offset: int
    kind: int
    length: int


class Scan(NamedTuple):
    """Messages of a file. `holes`: unreadable spans between messages. `good_bytes`: end of the last readable message.

    `cut`: the file ends in the middle of a message, as after a kill or a full disk. Bytes after the end message do not
    belong to the file, except the tail after an index. `indexed`: the file ends with Rerun's index: it was made by one
    of Rerun's tools, from one file or several, or it is a recorder's, with the index of `index.py`.
    """

    messages: list[RrdMessage]
    holes: list[tuple[int, int]]
    good_bytes: int
    size: int
    cut: bool
    indexed: bool


class Mark(NamedTuple):
    """Checksum of a span of the file, noted by the recorder: CRC-32 of the bytes from `begin` up to `end`."""

    begin: int
    end: int
    crc: int


def scan_file(path: str | Path) -> Scan:
    """List the messages of a file without decoding them. Raises `NotARecordingError`."""
    wait_for_index(path)
    size = os.path.getsize(path)
    found: list[RrdMessage] = []
    holes: list[tuple[int, int]] = []
    with open(path, "rb") as file:
        if file.read(FILE_HEAD)[: len(MAGIC)] != MAGIC:
            raise NotARecordingError(f"{path} is not a Rerun file (it does not begin with {MAGIC.decode()})")
        at = FILE_HEAD
        while at < size:
            message = message_at(file, at, size)
            if message is None and (grown := os.fstat(file.fileno()).st_size) > size:
                size = grown  # the index was added meanwhile, or the recorder still writes
                continue
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


def find_end(data: bytes) -> tuple[int, int]:
    """Return the offset of the end message in the bytes of a file, and the number of messages before it.

    Raises `ValueError` if there is none.
    """
    at, n = FILE_HEAD, 0
    while at + _HEAD.size <= len(data):
        kind, length = _HEAD.unpack_from(data, at)
        if kind == KIND_END:
            return at, n
        at += _HEAD.size + length
        n += 1
    raise ValueError("a Rerun file without an end")


def message_at(file: BinaryIO, at: int, size: int) -> RrdMessage | None:
    """Return the message that begins at an offset of a file of `size` bytes; `None` if there is none, or not whole."""
    file.seek(at)
    head = file.read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    kind, length = _HEAD.unpack(head)
    return RrdMessage(at, kind, length) if kind <= KIND_LAST and at + _HEAD.size + length <= size else None


def _next_message(file: BinaryIO, begin: int, size: int) -> int | None:
    """Return the offset of the next message after a damaged head: an Arrow message followed by another or the end."""
    overlap = len(_ARROW_HEAD) - 1
    for window in range(begin, size, WINDOW_BYTES):
        file.seek(window)
        data = file.read(WINDOW_BYTES + overlap)
        at = data.find(_ARROW_HEAD)
        while at >= 0:
            message = message_at(file, window + at, size)
            if message is not None:
                end = message.offset + _HEAD.size + message.length
                if end == size or message_at(file, end, size) is not None:
                    return message.offset
            at = data.find(_ARROW_HEAD, at + 1)
    return None


def changed_spans(path: str | Path, marks: Sequence[Mark], *, closed: bool) -> list[str]:
    """Return a line per span of the file whose bytes differ from the recorder's checksum.

    `closed`: the recorder closed the file. The result is empty for a file that another tool has rewritten: in it most
    marks do not end between messages.
    """
    found = scan_file(path)
    if not is_of_recorder(found, marks):
        return []
    out = []
    left = 2 * found.size  # a recorder's marks do not overlap: those of a hostile file are not all computed
    with open(path, "rb") as file:
        for mark in marks:
            left -= max(0, mark.end - mark.begin)
            if left < 0 or not 0 <= mark.begin <= mark.end <= found.size or _crc(file, mark) != mark.crc:
                out.append(_CHANGED.format(mark.begin, mark.end))
        if closed:
            out += _changed_end(file, found, max(mark.end for mark in marks))
    return out


def is_of_recorder(found: Scan, marks: Sequence[Mark]) -> bool:
    """Return whether marks of a file are where a recorder has written them; else another tool has rewritten it."""
    ends = {m.offset for m in found.messages} | {found.size}
    placed = sum(mark.end in ends for mark in marks)
    # Half is enough with an index: of the two marks of a short recording, one may be what was changed. Without one,
    # no tool has written the file.
    return placed > 0 and not (found.indexed and 2 * placed < len(marks))


def _changed_end(file: BinaryIO, found: Scan, begin: int) -> list[str]:
    """Compare the two copies of the messages after the last mark, which a recorder writes when it closes the file.

    Earlier versions wrote `CLOSING` messages there, once.
    """
    is_ended = found.messages[-1].kind == KIND_END
    closing = [m for m in found.messages if m.offset >= begin and m.kind != KIND_END]
    if len(closing) <= CLOSING:
        return []
    end = closing[-1].offset + _HEAD.size + closing[-1].length
    file.seek(begin)
    copies = file.read(end - begin)
    first, second = copies[: closing[CLOSING].offset - begin], copies[closing[CLOSING].offset - begin :]
    # One call wrote both copies and the end message. Bytes of its size that are none were one; others are what a kill
    # has left of an index. A file that was cut lacks some of the second copy.
    is_same = first == second and (is_ended or found.size - end != len(END_MESSAGE))
    is_cut = not is_ended and len(second) < len(first) and first.startswith(second)
    return [] if is_same or is_cut else [_CHANGED.format(begin, end if is_ended else found.size)]


def _crc(file: BinaryIO, mark: Mark) -> int:
    """Compute the CRC-32 of the span of `mark` as it is now."""
    file.seek(mark.begin)
    crc, left = 0, mark.end - mark.begin
    while left and (data := file.read(min(left, 1 << 20))):
        crc, left = zlib.crc32(data, crc), left - len(data)
    return crc


def read_chunks(path: str | Path, entities: str | Sequence[str]) -> Iterator[Any]:
    """Yield the chunks of one entity or several in the order of the file. The file must be readable, see `is_readable`.

    `/clouds/**` stands for all entities below `/clouds`. An index (`index.py`) may be added meanwhile.

    Raises `NotARecordingError` if the file can no longer be read.
    """
    from rerun.chunk import RrdReader

    done: set[str] = set()
    while True:
        wait_for_index(path)
        size, taken = get_size(path), set(done)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # a file without a footer is normal: the recorder may have been killed
                stream = RrdReader(str(path)).stream().filter(content=entities)
            for chunk in stream:
                if chunk.id not in done:
                    taken.add(chunk.id)
                    yield chunk
        except (OSError, RuntimeError, ValueError) as error:
            if get_size(path) == size:
                said = " ".join(str(error).split())
                raise NotARecordingError(f"{path} can no longer be read: {said}") from error
            done = taken  # the index was added meanwhile: read on
        else:
            return


def wait_for_index(path: str | Path) -> None:
    """Wait while an index is being written: on a busy machine the file has a part of it for a while."""
    if sys.platform != "win32":
        with suppress(OSError), open(path, "rb") as file:
            fcntl.lockf(file, fcntl.LOCK_SH)  # apart from `flock`, which those that record hold


def get_size(path: str | Path) -> int:
    """Return the bytes of a file, -1 if it is gone."""
    try:
        return os.path.getsize(path)
    except OSError:
        return -1


def read_message_head(data: bytes) -> tuple[int, int]:
    """Return kind and length of the message that `data` begins with."""
    kind, length = _HEAD.unpack_from(data)
    return kind, length


def find_store_id(message: bytes, store: int) -> bytes:
    """Return the id of the `RECORDING` or `BLUEPRINT` that a message belongs to, empty if it belongs to none.

    Messages begin with it: kind in field 1, id in field 2, behind at most a row id.
    """
    head = message[:ID_BYTES]
    at = head.find(bytes((0x08, store, 0x12)))
    return head[at + 4 : at + 4 + head[at + 3]] if 0 <= at < len(head) - 3 else b""


def read_message(file: BinaryIO, message: RrdMessage) -> bytes:
    """Return head and body of a message of an open file."""
    file.seek(message.offset)
    return file.read(_HEAD.size + message.length)


def copy_messages(path: str | Path, messages: Sequence[RrdMessage], copy: str | Path) -> None:
    """Write messages of a file to `copy`."""
    with open(path, "rb") as file, open(copy, "wb") as out:
        out.write(file.read(FILE_HEAD))
        for message in messages:
            out.write(read_message(file, message))
