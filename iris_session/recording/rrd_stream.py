"""Writes a Rerun file with our own hands: Rerun encodes the messages, this module appends them.

Rerun's own file sink keeps some 4 KB in memory per chunk, for a footer with an index: 0.1-0.2 MiB/s of a session. Here
the encoded bytes are taken out of the stream at every write, and what is only for a footer is left out; so memory does
not grow, and an error of the disk is an error of ours. `rerun rrd optimize` makes a copy with such an index.
"""

from __future__ import annotations

import os
import zlib
from contextlib import suppress
from typing import Any, Final

import rerun as rr

from iris_session.recording.rrd_file import END_MESSAGE, FILE_HEAD, MAGIC, Mark, end_of_messages

#: The stream's own batcher never acts: the writer sends whole columns, and `write` takes them.
_BATCHER: Final = rr.ChunkBatcherConfig(flush_tick=3600.0, flush_num_bytes=1 << 30)


class RrdStream:
    """One file, made new. What was logged to `recording` is in it after `write`.

    All of it may raise `OSError` (the disk), `RuntimeError` and `ValueError` (Rerun).
    """

    def __init__(self, path: str, application: str, recording_id: str) -> None:
        self.recording = rr.RecordingStream(application, recording_id=recording_id, batcher_config=_BATCHER)
        self._encoded = self.recording.binary_stream()
        self._file: Any = open(path, "wb", buffering=0)  # noqa: SIM115 - closed by `close`
        self.size = 0  # bytes in the file
        self._marked = 0  # bytes of the file that marks cover
        self._crc = 0  # of the bytes after them

    def write(self, timeout_s: float) -> None:
        """Appends what was logged since the last time, whole or not at all; then it is with the system."""
        data = self._encoded.read(flush=True, flush_timeout_sec=timeout_s)
        if not data:
            return
        if data[: len(MAGIC)] != MAGIC:
            raise ValueError("this version of Rerun encodes its messages in another way")
        self._append(memoryview(data)[FILE_HEAD if self.size else 0 : end_of_messages(data)])

    def mark(self) -> Mark:
        """CRC-32 of all bytes since the last mark, so that any later change of them is found."""
        mark = Mark(self._marked, self.size, self._crc)
        self._marked, self._crc = self.size, 0
        return mark

    def close(self) -> None:
        """Ends the file after the last `write`: with the message that says that nothing follows."""
        self._append(memoryview(END_MESSAGE))
        self._file.close()
        self.recording.disconnect()

    def _append(self, data: memoryview) -> None:
        rest = data
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            with suppress(OSError):  # half a message would only be in the way of readers
                os.ftruncate(self._file.fileno(), self.size)
            self._file.close()
            raise
        self.size += len(data)
        self._crc = zlib.crc32(data, self._crc)
