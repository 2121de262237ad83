"""A model that carries poses of another simulation: its states return exactly the poses set, and can be restored."""

from __future__ import annotations

import numpy as np
import pytest

from iris_session.physics import ModelInvalidError, World
from iris_session.physics.kinematic_model import TICK_S, KinematicModel
from iris_session.protocol.common import Pose

NAMES = ("cup", "arm/link 1", "table top")
FIRST = tuple(Pose((float(i), 0.0, 0.5), (1.0, 0.0, 0.0, 0.0)) for i in range(3))


def read_poses(world: World) -> np.ndarray:
    poses = np.zeros((len(world.bodies), 7))
    world.read_poses(poses)
    return poses


def random_poses(seed: int) -> np.ndarray:
    poses = np.random.default_rng(seed).normal(size=(3, 7))
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return poses


def test_bodies_have_the_ids_and_first_poses_of_the_scene() -> None:
    world = World(KinematicModel(NAMES, FIRST).model, (), ())
    assert [(body.id, body.name, body.moving) for body in world.bodies] == [
        (i + 1, n, True) for i, n in enumerate(NAMES)
    ]
    assert read_poses(world) == pytest.approx(np.array([(*pose.p, *pose.q) for pose in FIRST]))
    assert world.model.nv == 0


def test_state_has_the_poses_and_time_that_were_set() -> None:
    kinematic = KinematicModel(NAMES, FIRST)
    world = World(kinematic.model, (), ())
    for seed, time_s in ((1, 12.3456), (2, 0.0)):
        world.restore_state(kinematic.encode_state(time_s, random_poses(seed)))
        assert np.allclose(read_poses(world), random_poses(seed), atol=1e-15)
        assert (world.view().tick, world.view().sim_time) == (round(time_s / TICK_S), time_s)


@pytest.mark.parametrize("names", [("cup", "cup"), ("world",)])
def test_invalid_names_are_rejected(names: tuple[str, ...]) -> None:
    with pytest.raises(ModelInvalidError, match="cannot be published"):
        KinematicModel(names, FIRST[: len(names)])
