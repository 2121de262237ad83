"""The scenes that come with the package: names, physics of the grasp, generated scenes."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest

from iris_session.demo.scenes import free_bodies_scene, n_arms_scene, scene_path
from iris_session.demo.scenes.generators import arm_names


def _handover() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(scene_path("handover")))


def _settled(model: mujoco.MjModel, steps: int = 500) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return data


def test_unknown_scene_lists_the_available_ones() -> None:
    with pytest.raises(FileNotFoundError, match=r"arm, .*handover, soft"):
        scene_path("kitchen")
    with pytest.raises(FileNotFoundError):
        scene_path("../physics")


def test_home_is_at_rest() -> None:
    model = _handover()
    data = _settled(model)
    home = model.key("home").qpos
    assert np.abs(data.qpos - home).max() < 2e-3
    assert np.abs(data.qvel).max() < 1e-3
    np.testing.assert_allclose(data.site("left/tcp").xpos, (-0.2, 0.0, 0.28), atol=1e-3)
    np.testing.assert_allclose(data.site("right/tcp").xpos, (0.2, 0.0, 0.28), atol=1e-3)
    # the grippers point down and close along the world's y
    assert data.site("left/tcp").xmat.reshape(3, 3)[2, 2] == pytest.approx(-1.0, abs=1e-4)
    assert abs(data.site("left/tcp").xmat.reshape(3, 3)[1, 1]) == pytest.approx(1.0, abs=1e-4)


def test_hammer_held_at_its_end_does_not_creep() -> None:
    """Held 19 cm from its centre of mass for 3 s: settles within 0.5 deg and then does not slip."""
    model = _handover()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    at = model.joint("hammer").qposadr[0]
    data.qpos[at : at + 3] = data.site("right/tcp").xpos - (0.085, 0.0, 0.0)
    for side in ("left", "right"):
        data.qpos[model.joint(f"right/finger_joint_{side}").qposadr[0]] = 0.0126
    data.actuator("right/gripper").ctrl[0] = 0.0
    gravity = model.opt.gravity.copy()
    model.opt.gravity[:] = 0.0
    mujoco.mj_step(model, data, 200)
    model.opt.gravity[:] = gravity

    def pitch_deg() -> float:
        return math.degrees(math.asin(data.body("hammer").xmat[6]))

    mujoco.mj_step(model, data, 500)
    early = pitch_deg()
    mujoco.mj_step(model, data, 1000)
    assert abs(early) < 0.5
    assert abs(pitch_deg() - early) < 0.02
    assert data.body("hammer").xpos[2] > 0.27


@pytest.mark.parametrize("n", [1, 8])
def test_arms_around_a_table(n: int) -> None:
    model = n_arms_scene(n).compile()
    data = _settled(model, 250)
    names = arm_names(n)
    assert len(names) == n
    assert model.nu == 8 * n
    assert np.abs(data.qpos - model.key("home").qpos).max() < 3e-3
    for name in names:
        tip, base = data.site(f"{name}/tcp").xpos, data.body(f"{name}/base").xpos
        assert np.linalg.norm(tip[:2]) < np.linalg.norm(base[:2])  # reaches towards the middle
        assert tip[2] == pytest.approx(0.28, abs=2e-3)
    touching = {int(model.geom_bodyid[g]) for c in data.contact for g in (c.geom1, c.geom2)}
    things = {model.body(f"object{i + 1}").id for i in range((n + 1) // 2)}
    assert touching <= things | {0}  # only objects on the table


def test_free_bodies_keep_their_speed_and_stay_inside() -> None:
    model = free_bodies_scene(60, seed=1).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for _ in range(30):
        mujoco.mj_step(model, data, 500)
        mujoco.mj_forward(model, data)
        before = data.xpos[1:].copy()
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        speed = np.linalg.norm(data.xpos[1:] - before, axis=1) / model.opt.timestep
        assert speed.min() > 0.099
        assert speed.max() < 0.501
        assert np.abs(data.xpos[1:, :2]).max() < 5.0
        assert data.xpos[1:, 2].min() > 0.0
        assert data.xpos[1:, 2].max() < 3.0
        assert data.ncon == 0
    spin = np.linalg.norm(data.qvel.reshape(-1, 6)[:, 3:], axis=1)
    np.testing.assert_allclose(spin, 0.5, atol=1e-6)
