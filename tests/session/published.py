"""A scene as a builder composes it, without files: two boxes, an arm of two joints, a cloth of four vertices."""

from __future__ import annotations

import math

import numpy as np

from iris_session.protocol.common import Pose
from iris_session.protocol.scene import Body, SceneSpec
from iris_session.scene.result import ArticulatedBody, Articulation, ComposedScene, DeformableSource, Joint
from iris_session.streams.deformable_topology import DeformableTopology

UNIT = (1.0, 0.0, 0.0, 0.0)
MOVING = ("red", "blue", "arm/base", "arm/upper", "arm/fore")
CLOTH = np.array([(0, 0, 1), (0, 1, 1), (1, 0, 1), (1, 1, 1)], np.float32)


def arm() -> Articulation:
    """Return an arm: a revolute upper arm of 1 m along x with a prismatic fore arm at its end."""
    return Articulation(
        "arm",
        Pose((0.0, 0.0, 0.8), UNIT),
        (
            ArticulatedBody("arm/base"),
            ArticulatedBody("arm/upper", 0, joint=0),
            ArticulatedBody("arm/fore", 1, Pose((1.0, 0.0, 0.0), UNIT), axis=(1.0, 0.0, 0.0), sliding=True, joint=1),
        ),
        (Joint("turn", "revolute", -math.pi, math.pi, 0.0), Joint("slide", "prismatic", 0.0, 0.5, 0.0)),
        {"follower": "turn"},
    )


def composed() -> ComposedScene:
    poses = tuple(Pose((float(i), 0.0, 0.5), UNIT) for i in range(len(MOVING)))
    bodies = tuple(
        Body(i + 1, name, 0, pose, pose, moving=True) for i, (name, pose) in enumerate(zip(MOVING, poses, strict=True))
    )
    ground = Body(0, "world", -1, Pose((0.0, 0.0, 0.0), UNIT), Pose((0.0, 0.0, 0.0), UNIT), moving=False)
    topology = DeformableTopology(4, faces=[(0, 1, 3), (0, 3, 2)])
    return ComposedScene(
        SceneSpec(bodies=(ground, *bodies)),
        "0" * 64,
        (),
        0,
        0,
        MOVING,
        poses,
        {"arm": arm()},
        {"cloth": DeformableSource("cloth", "cloth", topology, CLOTH)},
    )
