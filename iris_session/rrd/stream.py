"""The file of a recorder: Rerun encodes what is logged, `RrdStream` appends the bytes, and marks their checksums.

Rerun's own file sink keeps some 4 KB in memory per chunk, for a footer with an index: 0.1-0.2 MiB/s of a session.
Here the encoded bytes are read from the stream at every write, without the data for a footer; so memory does not
grow, and an error of the disk is raised here. `rerun rrd optimize` makes a copy with such an index.

Columns are Arrow arrays for `rerun.send_columns`, built without a Python object per value where rows are many.
"""

from __future__ import annotations

import os
import time
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Final

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import rerun as rr
from numpy.typing import NDArray

from iris_session.rrd.file import END_MESSAGE, FILE_HEAD, MAGIC, Mark, find_end

#: The stream's own batcher never acts: the writer sends whole columns, and `write` collects them.
_BATCHER: Final = rr.ChunkBatcherConfig(flush_tick=3600.0, flush_num_bytes=1 << 30)


class RrdStream:
    """A new file. Data logged to `recording` is in it after `write`.

    All methods may raise `OSError` (the disk), `RuntimeError` and `ValueError` (Rerun).
    """

    def __init__(self, path: str, application: str, recording_id: str) -> None:
        self.recording = rr.RecordingStream(application, recording_id=recording_id, batcher_config=_BATCHER)
        self._encoded = self.recording.binary_stream()
        self._file: Any = open(path, "wb", buffering=0)  # noqa: SIM115 - closed by `close`
        self.size = 0  # bytes in the file
        self.messages = 0  # in the file
        self.write_s = 0.0  # time that the system took for the bytes of the last write
        self._marked = 0  # bytes of the file that marks cover
        self._crc = 0  # of the bytes after them

    def write(self, timeout_s: float) -> None:
        """Append the data logged since the last call, all or nothing, and hand it to the operating system."""
        self._append(self._read(timeout_s))

    def mark(self) -> Mark:
        """Return the CRC-32 of all bytes since the last mark, so that any later change of them is found."""
        mark = Mark(self._marked, self.size, self._crc)
        self._marked, self._crc = self.size, 0
        return mark

    def close(self, timeout_s: float) -> None:
        """Append the data logged since the last `write`, twice, and the message that marks the end of the file.

        The last mark must be in that data: no mark covers it, so its two copies are compared (`changed_spans`).
        """
        data = self._read(timeout_s)
        self._append(memoryview(b"".join((data, data, END_MESSAGE))))
        self._file.close()
        self.recording.disconnect()

    def _read(self, timeout_s: float) -> memoryview:
        """Return the messages of the data logged since the last call, with the head of the file if it is empty."""
        data = self._encoded.read(flush=True, flush_timeout_sec=timeout_s) or b""
        if not data:
            return memoryview(data)
        if data[: len(MAGIC)] != MAGIC:
            raise ValueError("this version of Rerun encodes its messages in another way")
        end, n_messages = find_end(data)
        self.messages += n_messages
        return memoryview(data)[FILE_HEAD if self.size else 0 : end]

    def _append(self, data: memoryview) -> None:
        rest, began = data, time.monotonic()
        try:
            while rest:
                rest = rest[self._file.write(rest) :]
        except OSError:
            with suppress(OSError):  # half a message would confuse readers
                os.ftruncate(self._file.fileno(), self.size)
            self._file.close()
            raise
        self.write_s = time.monotonic() - began
        self.size += len(data)
        self._crc = zlib.crc32(data, self._crc)


class ArrowColumn:
    """One component column: `values` is an Arrow list array with one list per row."""

    def __init__(self, name: str, values: Any) -> None:
        self._descriptor = rr.ComponentDescriptor(name)
        self._values = values

    def component_descriptor(self) -> Any:
        """Return the name of the component in the file."""
        return self._descriptor

    def as_arrow_array(self) -> Any:
        """Return the rows."""
        return self._values


def scalar_column(name: str, values: Any, kind: Any) -> ArrowColumn:
    """Return a column of one value of Arrow type `kind` per row; null where it is `None`."""
    array = pa.array(values, kind)
    is_null = array.is_null() if array.null_count else None
    ends = np.arange(1, len(array) + 1) if is_null is None else np.cumsum(np.asarray(array.is_valid()))
    offsets = pa.array(np.concatenate(([0], ends)).astype(np.int32))
    return ArrowColumn(name, pa.ListArray.from_arrays(offsets, array.drop_null(), mask=is_null))


def bytes_column(name: str, values: Iterable[bytes]) -> ArrowColumn:
    """Return a column of one byte string per row."""
    return scalar_column(name, list(values), pa.binary())


def table_columns(rows: Iterable[Sequence[Any]], types: Mapping[str, Any]) -> list[ArrowColumn]:
    """Return the columns of rows. `types`: names and Arrow types of their values, in order."""
    columns = zip(types.items(), zip(*rows, strict=True), strict=True)
    return [
        ArrowColumn(name, pa.array(values, kind)) if pa.types.is_list(kind) else scalar_column(name, values, kind)
        for (name, kind), values in columns
    ]


def list_column(name: str, values: Sequence[Sequence[Any]], kind: Any) -> ArrowColumn:
    """Return a column of a list of values of Arrow type `kind` per row."""
    return ArrowColumn(name, pa.array(values, pa.list_(kind)))


def matrix_column(name: str, values: NDArray[np.floating[Any]]) -> ArrowColumn:
    """Return a column of a list of numbers per row of `values` (rows, items)."""
    rows, items = values.shape
    offsets = np.arange(rows + 1, dtype=np.int32) * items
    return ArrowColumn(name, pa.ListArray.from_arrays(pa.array(offsets), pa.array(values.ravel())))


def sequence_index(timeline: str, values: Any) -> Any:
    """Return an integer index."""
    return rr.TimeColumn(timeline, sequence=np.asarray(values, np.int64))


def duration_index(timeline: str, values: Any) -> Any:
    """Return an index of durations from integer nanoseconds, exactly."""
    return rr.TimeColumn(timeline, duration=np.asarray(values, np.int64).view("timedelta64[ns]"))
