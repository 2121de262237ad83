"""Points on robots are found by model and state; what a gripper holds stays, and so does the room."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from anchors.camera import CameraModel
from anchors.pose import PoseTuple
from iris_session.cloud.robot_points import RobotPoints, find_robot_bodies
from iris_session.physics import find_robots
from iris_session.protocol.scene import SceneSpec
from iris_session.protocol.server_messages import BodyInfo, RobotInfo
from iris_session.scene import MeshArrays
from tests.cloud.rays import cast_picture, look_at
from tests.cloud.robot_scene import load_robots

EYES = ((1.3, -1.2, 0.9), (-1.2, -1.3, 0.8), (0.1, 1.6, 0.7))
CAMERA = CameraModel(160, 120, 140.0, 140.0, 79.5, 59.5)


class Holding(NamedTuple):
    """A scene whose first robot holds its first object, as clients know it, and the points that cameras see of it."""

    spec: SceneSpec
    meshes: dict[int, MeshArrays]
    robots: tuple[RobotInfo, ...]
    streamed: tuple[BodyInfo, ...]
    body_pose: Callable[[str, int], PoseTuple | None]
    points: NDArray[np.float32]
    bodies: NDArray[np.int32]
    thing: int

    def find(self, *, known: bool = True) -> NDArray[np.bool_]:
        """Return the points on robots. `known`: whether the session knows the object."""
        streamed = [body if known else BodyInfo(body.id, body.name, body.moving) for body in self.streamed]
        found = RobotPoints(self.spec, self.meshes, self.robots, streamed)
        return found.find(self.points, self.body_pose, 7)


@lru_cache(maxsize=2)
def hold_object(scene: str, folder: Path) -> Holding:
    """Close the gripper of the first robot around the first object. Depth has a noise of 3 mm."""
    known = load_robots(scene, folder)
    model, data = known.model, known.data
    thing = next(body.id for body in known.streamed if body.object)
    free = next(j for j in range(model.njnt) if model.jnt_bodyid[j] == thing)
    start = model.jnt_qposadr[free]
    data.qpos[start : start + 3] = data.site(find_robots(model).robots[0].site).xpos
    for joint in range(model.njnt):
        if "finger" in model.joint(joint).name:
            data.qpos[model.jnt_qposadr[joint]] = 0.013  # half the width of the objects
    mujoco.mj_forward(model, data)
    pictures = [cast_picture(model, data, CAMERA, look_at(eye, (0.0, 0.0, 0.2)), 0.003) for eye in EYES]

    return Holding(
        known.spec,
        known.meshes,
        known.robots,
        known.streamed,
        lambda name, at_ns: known.read_pose(name) if at_ns == 7 else None,
        np.concatenate([one.points for one in pictures]).astype(np.float32),
        np.concatenate([model.geom_bodyid[one.geoms] for one in pictures]),
        thing,
    )


@pytest.mark.parametrize("scene", ["panda", "handover"])
def test_robots_are_gone_and_the_object_in_the_gripper_is_not(
    scene: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    holding = hold_object(scene, tmp_path_factory.getbasetemp() / scene)
    on_robot = holding.find()
    robots = {body.id for body in find_robot_bodies(holding.spec, holding.robots)}
    of_robot, of_thing = np.isin(holding.bodies, list(robots)), holding.bodies == holding.thing
    assert of_robot.sum() > 2_500
    assert of_thing.sum() > 100
    assert on_robot[of_robot].mean() >= 0.99
    assert on_robot[of_thing].mean() <= 0.05
    assert on_robot[~of_robot & ~of_thing].mean() <= 0.01


def test_of_an_object_that_the_session_does_not_know_what_touches_the_fingers_goes(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    holding = hold_object("handover", tmp_path_factory.getbasetemp() / "handover")
    of_thing = holding.bodies == holding.thing
    known, unknown = (holding.find(known=known)[of_thing].mean() for known in (True, False))
    assert known < 0.5 * unknown
    assert unknown <= 0.2


def test_bodies_without_a_pose_are_counted_and_keep_their_points(tmp_path_factory: pytest.TempPathFactory) -> None:
    holding = hold_object("handover", tmp_path_factory.getbasetemp() / "handover")
    found = RobotPoints(holding.spec, holding.meshes, holding.robots, holding.streamed)
    assert not found.find(holding.points, holding.body_pose, 8).any()
    assert found.n_unknown == found.n_bodies > 10
    assert found.find(holding.points, holding.body_pose, 7).any()
    assert found.n_unknown == 0
    # Bodies that are not streamed are where the specification has them.
    at_rest = RobotPoints(holding.spec, holding.meshes, holding.robots, ())
    assert at_rest.find(holding.points, lambda name, at_ns: None, 8).any()
    assert at_rest.n_unknown == 0
