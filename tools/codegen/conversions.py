"""World poses in the frames of engines: the reference for clients, which convert (the server never does).

The world is right-handed, X forward, Y left, Z up. Unity is left-handed, X right, Y up, Z forward. WebXR and three.js
are right-handed, X right, Y up, -Z forward.
"""

from __future__ import annotations

from collections.abc import Sequence

PoseRow = tuple[float, float, float, float, float, float, float]


def to_unity(pose: Sequence[float]) -> PoseRow:
    """Convert `x y z qw qx qy qz` in the world to `x y z qx qy qz qw` in Unity."""
    x, y, z, qw, qx, qy, qz = pose
    return (-y, z, x, qy, -qz, -qx, qw)


def to_three(pose: Sequence[float]) -> PoseRow:
    """Convert `x y z qw qx qy qz` in the world to `x y z qx qy qz qw` in WebXR and three.js."""
    x, y, z, qw, qx, qy, qz = pose
    return (-y, z, -x, -qy, qz, -qx, qw)


def from_unity(pose: Sequence[float]) -> PoseRow:
    """Convert a pose of `to_unity` back."""
    x, y, z, qx, qy, qz, qw = pose
    return (z, -x, y, qw, -qz, qx, -qy)


def from_three(pose: Sequence[float]) -> PoseRow:
    """Convert a pose of `to_three` back."""
    x, y, z, qx, qy, qz, qw = pose
    return (-z, -x, y, qw, -qz, -qx, qy)
