"""From depth pictures to the points of a cloud: deprojection, crop, voxels, outliers. No sockets, no clocks.

`voxels` (the filter, and how it does without numba), `kernels` (its loops in numba). The encoding of the points is
`iris_session.streams.cloud`.
"""
