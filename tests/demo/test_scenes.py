"""The scenes that come with the package: names, physics of the grasp, generated scenes, and those with robots of
MuJoCo Menagerie: ALOHA stations and Panda arms."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest

from iris_session.demo.scenes import n_arms_scene, scene_path
from iris_session.demo.scenes.aloha import aloha_scene
from iris_session.demo.scenes.generators import arm_names
from iris_session.demo.scenes.panda import compute_panda_radius, panda_scene
from iris_session.physics import find_objects, find_robots


def _handover() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(scene_path("handover")))


def _settled(model: mujoco.MjModel, steps: int = 500) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return data


def test_unknown_scene_lists_the_available_ones() -> None:
    with pytest.raises(FileNotFoundError, match=r"arm, .*handover, soft\..*panda, aloha, .*downloaded on first use"):
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


# --- real robots ------------------------------------------------------------------------------------------------------


def _is_held_by_friction_only(model: mujoco.MjModel) -> bool:
    """No weld, connect, adhesion or mocap body: equalities couple the two fingers of a gripper only."""
    fingers = all(int(kind) == int(mujoco.mjtEq.mjEQ_JOINT) for kind in model.eq_type)
    no_adhesion = int(mujoco.mjtTrn.mjTRN_BODY) not in {int(kind) for kind in model.actuator_trntype}
    return fingers and no_adhesion and model.nmocap == 0


@pytest.fixture
def aloha() -> mujoco.MjModel:
    return aloha_scene().compile()


@pytest.mark.parametrize("n", [2, 8])
def test_panda_arms_stand_around_a_table_and_hold_still(n: int) -> None:
    model = panda_scene(n).compile()
    robots = find_robots(model).robots
    assert len(robots) == n
    assert [o.name for o in find_objects(model)] == [f"object{k + 1}" for k in range(n // 2)]
    assert _is_held_by_friction_only(model)
    data = _settled(model)
    for robot in robots:
        base, tip = data.body(robot.base_body), data.site(robot.site)
        assert len(robot.joints) == 7
        assert robot.gripper_actuator == f"{robot.name}/actuator8"
        assert np.hypot(*base.xpos[:2]) == pytest.approx(compute_panda_radius(n))
        inward = base.xmat.reshape(3, 3).T @ (tip.xpos - base.xpos)
        np.testing.assert_allclose(inward, (0.5, 0.0, 0.35), atol=5e-3)  # gravity is compensated
        assert tip.xmat.reshape(3, 3)[2, 2] == pytest.approx(-1.0, abs=1e-3)
    assert {_rests_on_table_only(model, data, o.name) for o in find_objects(model)} == {True}


def _rests_on_table_only(model: Any, data: Any, name: str) -> bool:
    """Return whether the object touches nothing but the table."""
    body = model.body(name).id
    partners = {int(model.geom_bodyid[g]) for c in data.contact for g in c.geom if body in model.geom_bodyid[c.geom]}
    return partners <= {0, body}
