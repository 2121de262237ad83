"""From depth cameras to the points of a cloud: deprojection, crop, voxels, outliers. No sockets, no clocks.

`voxels` (the filter, and how it does without numba), `kernels` (its loops in numba), `camera_file` (settings), `frames`
(the interface of sources). Only `sources`, which reads cameras and recordings, has clocks and the packages that these
need. The encoding of the points is `iris_session.streams.cloud`.
"""

from __future__ import annotations

from typing import Final

#: Cells to each side of the origin along an axis: 21 bits an axis make a key of 63.
REACH: Final = 2**20
#: Columns of the sums: number of points, then the sums of their coordinates [cells], red, green, blue.
COLUMNS: Final = 7
