"""A bounded first-in first-out queue in a file: where the feed's batches wait when the recorder cannot take them."""

from __future__ import annotations

import os
import struct
from pathlib import Path
from typing import Final

_HEAD: Final = struct.Struct("<III")  # bytes of the record, rows in it, other items in it


class SpillFile:
    """Records of bytes in the order of `push`, at most `limit_bytes` on disk. It has no name in the
    folder: nothing stays behind, however the process ends. `rows`, `others`: journal rows and other items in the
    queue.

    `push` returns False when the disk or the limit refuses the record, which is then not in the queue.
    """

    def __init__(self, path: Path, limit_bytes: int) -> None:
        self._path = path
        self._limit = limit_bytes
        self._fd = -1
        self._read_at = 0
        self._write_at = 0
        self._wrap_at = -1  # where the records go on at the beginning of the file; -1: nowhere
        self.records = 0
        self.rows = 0
        self.others = 0
        self.fault = ""

    def __len__(self) -> int:
        return self.records

    @property
    def waiting_bytes(self) -> int:
        """What waits in it."""
        wrapped = self._wrap_at if self._wrap_at >= 0 else 0
        return self._write_at - self._read_at + wrapped

    def push(self, data: bytes, rows: int, others: int = 0) -> bool:
        """Appends one record that holds `rows` journal rows and `others` of other kinds."""
        record = _HEAD.pack(len(data), rows, others) + data
        at = self._place(len(record))
        if at < 0:
            self.fault = f"the spill file {self._path} holds its limit of {self._limit >> 20} MiB"
            return False
        try:
            if self._fd < 0:
                self._path.unlink(missing_ok=True)
                flags = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC  # never through a link of somebody else
                self._fd = os.open(self._path, flags, 0o600)
                self._path.unlink()  # nobody else reads it, and a killed session leaves nothing behind
            written = os.pwrite(self._fd, record, at)
        except OSError as error:
            self.fault = f"the spill file {self._path} cannot be written: {error.strerror}"
            return False
        if written != len(record):  # the disk is full: the next push writes over the partial record
            self.fault = f"the spill file {self._path} cannot be written: no space left"
            return False
        if at < self._write_at:
            self._wrap_at = self._write_at
        self._write_at = at + len(record)
        self.records += 1
        self.rows += rows
        self.others += others
        return True

    def pop(self) -> tuple[bytes, int] | None:
        """The oldest record as `(data, rows)`, None when empty. Raises `OSError` when the file cannot be read."""
        if not self.records:
            return None
        length, rows, others = _HEAD.unpack(self._read(_HEAD.size, self._read_at))
        data = self._read(length, self._read_at + _HEAD.size)
        self._read_at += _HEAD.size + length
        if self._read_at == self._wrap_at:
            self._read_at, self._wrap_at = 0, -1
        self.records -= 1
        self.rows -= rows
        self.others -= others
        if not self.records:
            self.close()
        return data, rows

    def _place(self, length: int) -> int:
        """Where a record of this length goes: behind the newest, or where records were read; -1 for nowhere."""
        if self._wrap_at >= 0 or self._write_at + length <= self._limit:
            end = self._read_at - 1 if self._wrap_at >= 0 else self._limit
            return self._write_at if self._write_at + length <= end else -1
        return 0 if length < self._read_at else -1

    def _read(self, n: int, at: int) -> bytes:
        data = os.pread(self._fd, n, at)
        if len(data) != n:
            raise OSError(f"the spill file holds {len(data)} of {n} bytes at {at}")
        return data

    def close(self) -> None:
        """Removes the file and what is in it."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1
        self._wrap_at = -1
        self._read_at = self._write_at = self.records = self.rows = self.others = 0
