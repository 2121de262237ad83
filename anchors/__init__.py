"""Geometry of anchors: rigid transforms (`pose`), and the alignment of a headset by anchors of known pose (`alignment`,
`robust`).

Pure, usable without the server; imports nothing of iris_session.
"""
