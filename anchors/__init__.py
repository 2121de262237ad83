"""Anchors: detection, controller anchors, alignment, constellations, drift, camera extrinsics, printable sheets.

Pure geometry (numpy, scipy, OpenCV), usable without the server; imports nothing of iris_session.
"""
