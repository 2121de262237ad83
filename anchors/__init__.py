"""Headsets on the same spot of the room: geometry, detection and estimation around physical references.

Geometry: `pose` (plain tuples, hot paths), `lie` (arrays), `noise` and `uncertainty` (what is known, what is stated).
Alignment of one headset: `alignment`, with `groups`, `robust`, `solve` behind it; `touch` and `controller` by a motion
controller. Over time: `drift` (alarms), `smooth` (corrections), `crosscheck` (between headsets). Several sheets:
`constellation`. Pictures: `sheet` and `sheet_print` (what is printed), `camera`, `detection` and `registration` (where
it is seen), `robot_world` and `camera_rig` (where cameras stand). Pure, usable without the server; imports nothing of
iris_session. Mathematics: docs/anchors.md.
"""
