"""Arrow columns for `rerun.send_columns`, built without a Python object per value where rows are many."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import rerun as rr
from numpy.typing import NDArray


class ArrowColumn:
    """One component column: `values` is an Arrow list array with one list per row."""

    def __init__(self, name: str, values: Any) -> None:
        self._descriptor = rr.ComponentDescriptor(name)
        self._values = values

    def component_descriptor(self) -> Any:
        """The name that the component has in the file."""
        return self._descriptor

    def as_arrow_array(self) -> Any:
        """The rows."""
        return self._values


def scalar_column(name: str, values: Any, kind: Any) -> ArrowColumn:
    """One value of Arrow type `kind` per row."""
    array = pa.array(values, kind)
    return ArrowColumn(name, pa.ListArray.from_arrays(pa.array(np.arange(len(array) + 1, dtype=np.int32)), array))


def bytes_column(name: str, values: Iterable[bytes]) -> ArrowColumn:
    """One byte string per row, exactly."""
    return scalar_column(name, list(values), pa.binary())


def list_column(name: str, values: Sequence[Sequence[int]], kind: Any) -> ArrowColumn:
    """A list of integers per row."""
    flat = [item for row in values for item in row]
    offsets = np.zeros(len(values) + 1, np.int32)
    np.cumsum([len(row) for row in values], out=offsets[1:])
    return ArrowColumn(name, pa.ListArray.from_arrays(pa.array(offsets), pa.array(flat, kind)))


def matrix_column(name: str, values: NDArray[np.float64]) -> ArrowColumn:
    """A list of float64 per row of `values` (rows, items), exactly."""
    rows, items = values.shape
    offsets = np.arange(rows + 1, dtype=np.int32) * items
    return ArrowColumn(name, pa.ListArray.from_arrays(pa.array(offsets), pa.array(values.ravel())))


def sequence_index(timeline: str, values: Any) -> Any:
    """An integer index."""
    return rr.TimeColumn(timeline, sequence=np.asarray(values, np.int64))


def duration_index(timeline: str, values: Any) -> Any:
    """An index of durations from integer nanoseconds, exactly."""
    return rr.TimeColumn(timeline, duration=np.asarray(values, np.int64).view("timedelta64[ns]"))
