"""Damaged Rerun files: make a copy of the readable messages of a file that was cut short or changed.

Rerun's reader stops or aborts at the first body that it cannot decode. `rerun rrd filter` goes on after most of them;
where it aborts, the message at fault is left out and the rest is read without it.
"""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from iris_session.journal.errors import NotARecordingError
from iris_session.rrd.file import (
    KIND_END,
    KIND_STORE_INFO,
    RrdMessage,
    copy_messages,
    read_message,
    scan_file,
)
from iris_session.rrd.rerun_tool import filter_readable

#: Messages that Rerun may have decoded when it aborts, and not written: among those after them is the one at fault.
AHEAD: Final = 32
#: Number of messages that may make Rerun abort; what follows the last of them is given up.
MOST_ABORTS: Final = 16


def salvage(path: str | Path, copy: str | Path) -> list[str]:
    """Write the readable messages of `path` to `copy`. Return a line per omission.

    Raises:
        NotARecordingError: Nothing is readable.
        MissingExtraError: Rerun is not installed.
    """
    found = scan_file(path)
    damage = [f"bytes {begin} to {end} hold no message and are left out" for begin, end in found.holes]
    if found.good_bytes < found.size and not found.cut:
        damage.append(f"nothing after byte {found.good_bytes} of {found.size} is readable")
    messages = [m for m in found.messages if m.kind != KIND_END]
    kept, end = _find_readable(path, messages)
    if not any(m.kind == KIND_STORE_INFO for m in kept):
        raise NotARecordingError(f"{path} holds no recording that can be read")
    readable = set(kept)
    lost = [m for m in messages[:end] if m not in readable]
    damage += [f"message of {m.length} bytes at byte {m.offset} is damaged and left out" for m in lost]
    if end < len(messages):
        damage.append(f"too much is damaged: nothing after byte {messages[end].offset} is read")
    copy_messages(path, kept, copy)
    return damage if damage or found.cut else ["the footer is damaged: read without it"]


def _find_readable(path: str | Path, messages: Sequence[RrdMessage]) -> tuple[list[RrdMessage], int]:
    """Return the messages that Rerun decodes, and the number of those that were tried."""
    kept: list[RrdMessage] = []
    begin = 0
    for _ in range(MOST_ABORTS):
        infos = [m for m in kept if m.kind == KIND_STORE_INFO]
        readable, is_whole = _try_messages(path, [*infos, *messages[begin:]])
        kept += [m for m in messages[begin:] if m in readable]
        if is_whole:
            return kept, len(messages)
        if kept:
            begin = max(begin, messages.index(kept[-1]) + 1)
        for message in messages[begin : begin + AHEAD]:
            infos = [m for m in kept if m.kind == KIND_STORE_INFO]
            one, is_decoded = _try_messages(path, [*infos, message])
            begin += 1
            kept += [message] if message in one else []
            if not is_decoded:
                break
    return kept, begin


def _try_messages(path: str | Path, messages: Sequence[RrdMessage]) -> tuple[set[RrdMessage], bool]:
    """Return those messages that Rerun decodes, and whether it got to the end of them without aborting."""
    with tempfile.NamedTemporaryFile(suffix=".rrd") as output:
        is_whole = filter_readable(path, messages, output)
        try:
            written = scan_file(output.name).messages
        except NotARecordingError:
            written = []
        digests = set(_compute_digests(output.name, written))
        pairs = zip(messages, _compute_digests(path, messages), strict=True)
        return {message for message, digest in pairs if digest in digests}, is_whole


def _compute_digests(path: str | Path, messages: Sequence[RrdMessage]) -> list[bytes]:
    with open(path, "rb") as file:
        return [hashlib.blake2b(read_message(file, message)).digest() for message in messages]
