"""A commented camera file, to be edited. `camera_file` reads it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

_INTRINSICS: Final = """\
# Of the depth picture; the colour is of the same pixels. A file of `iris-session anchors calibrate-camera --help`, or
# as here.
intrinsics = {width = 640, height = 480, fx = 585.0, fy = 585.0, cx = 319.5, cy = 239.5, distortion = []}
"""
_POSE: Final = """\
# Where the camera is: measured by printed sheets with `iris-session cloud calibrate`, which writes this file.
calibration = "calibration.toml"
# Or by hand. Optical frame: x right, y down, z forward; here 1 m above the origin, looking along +x.
# pose = {position_m = [0.0, 0.0, 1.0], quaternion_wxyz = [0.5, -0.5, 0.5, -0.5]}
"""
_RECORDING: Final = """\
# depth = ""               # {kind} of the depth pictures; empty: the only one
# color = ""               # {kind} of the colour pictures
# loop = true              # begin anew at the end
# intrinsics = "intrinsics.toml"       # of the depth pictures; by default those of the recording
"""
_DEVICE: Final = """\
# path = ""                # serial number; empty: the only one
# width = 640              # of the depth pictures; intrinsics and depth scale are those of the device
# height = 480
# hz = 30.0                # frames per second
"""
#: Keys of a camera by its source.
SOURCES: Final[Mapping[str, str]] = {
    "folder": """\
source = "folder"
path = "pictures"          # NAME.depth.png, NAME.color.jpg or .png, and NAME.pose.txt (4 x 4) where it is known
# hz = 30.0                # frames per second
# loop = true              # begin anew at the end
"""
    + _INTRINSICS
    + _POSE,
    "mujoco": """\
source = "mujoco"          # rendered, to try things without a camera
model = "scene.xml"        # MJCF or MJB file
camera = "front"           # camera of the model: field of view and pose are its own
# width = 640
# height = 480
# hz = 30.0
""",
    "rerun": """\
source = "rerun"
path = "recording.rrd"
"""
    + _RECORDING.format(kind="entity")
    + _POSE,
    "mcap": """\
source = "mcap"
path = "recording.mcap"
"""
    + _RECORDING.format(kind="topic")
    + _POSE,
    "realsense": 'source = "realsense"\n' + _DEVICE + _POSE,
    "orbbec": 'source = "orbbec"\n' + _DEVICE + _POSE,
}
_HEAD: Final = """\
# Depth cameras whose points become one cloud. Paths are relative to this file. What is commented out has this value.
#   iris-session cloud inspect camera.toml              rate, points, faults, without a session
#   iris-session serve scene.xml --camera camera.toml   the cloud in a session

stream = "room"            # name of the media stream
title = "Room"             # shown to people
# audience = "remote"      # "all": people in the room are shown it, too, who see the room itself
# hz = 30.0                # clouds per second at most
# points = 50_000          # points of a cloud at most; cells grow until it is met
# voxel_m = 0.01           # least edge of a cell
# What lies outside of this box is left out [m], world frame.
low = [-2.0, -2.0, -0.1]
high = [2.0, 2.0, 3.0]
# remove_robots = false    # leave out points on the session's robots, which are drawn anyway
# picture_hz = 10.0        # pictures per second, in streams named STREAM-CAMERA; 0: none

# One [[cameras]] for each camera: frames that are captured within 50 ms of each other become one cloud.
[[cameras]]
name = "front"
"""
_TAIL: Final = """\
# body = ""                # body of the scene that carries the camera; its pose is then in the frame of that body
# depth_scale_m = 0.001    # length of one unit of depth [m]; by default as the source says
# nearest_m = 0.3          # points that are nearer to the camera are left out
# farthest_m = 3.5
# error_mm = 10.0          # what calibration and depth are good for, 95 %; by default from the calibration
"""


def make_example(source: str) -> str:
    """Return a commented camera file.

    Args:
        source: One of `SOURCES`.

    Raises:
        KeyError: There is no such source.
    """
    return _HEAD + SOURCES[source] + _TAIL
