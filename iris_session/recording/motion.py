"""Motion in the picture of a recording: poses of bodies and devices, each at an entity of its own.

Rerun's dataframes have one row per entity and time, and a chunk of few rows is mostly its schema. So rows are collected
and written together, a chunk per entity.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from iris_session.recording.timelines import to_time_columns


class MotionRows:
    """Poses in the world that are not written yet."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._rec = recording
        self._indices: dict[str, int] = {}
        self._parts: list[tuple[NDArray[np.intp], NDArray[np.int64], NDArray[np.float64]]] = []

    def add(
        self,
        entities: Sequence[str],
        which: NDArray[np.intp],
        times: NDArray[np.int64],
        poses: NDArray[np.float64],
    ) -> None:
        """Collect rows.

        Args:
            entities: Entities that the rows are of, each once.
            which: Index of the entity of each row, shape (n,).
            times: See `to_time_columns`, one column per row.
            poses: `x y z qw qx qy qz` ([m], unit quaternion), world frame, shape (n, 7).
        """
        if not len(which):
            return
        indices = np.array([self._indices.setdefault(entity, len(self._indices)) for entity in entities], np.intp)
        self._parts.append((indices[which], times, poses))

    def write(self) -> int:
        """Write what was collected. Return the number of chunks."""
        if not self._parts:
            return 0
        which = np.concatenate([part[0] for part in self._parts])
        order = np.argsort(which, kind="stable")
        times = np.concatenate([part[1] for part in self._parts], axis=1)[:, order]
        poses = np.concatenate([part[2] for part in self._parts])[order].astype(np.float32)
        ends = np.cumsum(np.bincount(which, minlength=len(self._indices))).tolist()
        for entity, begin, end in zip(self._indices, [0, *ends], ends, strict=False):
            if begin < end:
                rows = poses[begin:end]
                columns = rr.Transform3D.columns(translation=rows[:, :3], quaternion=rows[:, [4, 5, 6, 3]])
                times_of = to_time_columns(times[:, begin:end])
                rr.send_columns(entity, times_of, [*columns], recording=self._rec, strict=True)
        n = len(self._indices)
        self._indices.clear()
        self._parts.clear()
        return n
