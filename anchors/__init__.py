"""Align headsets to physical references in a room: geometry, detection and estimation.

Geometry: `pose` (plain tuples, hot paths), `lie` (arrays), `uncertainty` (noise models, stated errors). Alignment of
one headset: `alignment`, with `viewpoints` and `solver` behind it; `touch` and `controller` with a motion controller,
`persistent` by an anchor of the device. Over time: `drift` (alarms), `cross_check` (between headsets). Several sheets:
`constellation`. Pictures: `sheet` and `sheet_print` (the printed sheet), `camera`, `detection` and `photometric` (its
pose in an image), `camera_calibration` with `robot_world` and `camera_rig` (poses of cameras by sheets),
`depth_calibration` with `icp` (by what depth cameras see). Pure, usable without the server; imports nothing of
iris_session. Mathematics: docs/anchors.md.
"""
