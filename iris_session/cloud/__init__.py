"""Depth cameras as point clouds: deprojection, crop, voxels, outliers, and the process that publishes them.

`voxels` (the filter, and how it does without numba), `kernels` (its loops in numba), `camera_file` (settings), `frames`
(the interface of sources), `pipeline` (frames of several cameras to one cloud), `health` (faults), `reader` (a thread
for each source), `worker` (the loop that publishes). They take times and clocks as arguments; only `sources`, which
reads cameras and recordings, and `process`, which has the connection, bring clocks, sockets and the packages for these.
The encoding of the points is `iris_session.streams.cloud`.
"""

from __future__ import annotations

from typing import Final

#: Cells to each side of the origin along an axis: 21 bits an axis make a key of 63.
REACH: Final = 2**20
#: Columns of the sums: number of points, then the sums of their coordinates [cells], red, green, blue.
COLUMNS: Final = 7
