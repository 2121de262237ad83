"""The scenes with real robots: ALOHA stations and Panda arms, built from models of MuJoCo Menagerie."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np
import pytest

from iris_session.demo.scenes.aloha import BOARD_SIZE, aloha_scene
from iris_session.demo.scenes.panda import compute_panda_radius, panda_scene
from iris_session.physics import find_objects, find_robots


def _settled(model: mujoco.MjModel, steps: int = 500) -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    for _ in range(steps):
        mujoco.mj_step(model, data)
    return data


def _is_held_by_friction_only(model: mujoco.MjModel) -> bool:
    """No weld, connect, adhesion or mocap body: equalities couple the two fingers of a gripper only."""
    fingers = all(int(kind) == int(mujoco.mjtEq.mjEQ_JOINT) for kind in model.eq_type)
    no_adhesion = int(mujoco.mjtTrn.mjTRN_BODY) not in {int(kind) for kind in model.actuator_trntype}
    return fingers and no_adhesion and model.nmocap == 0


@pytest.fixture
def aloha() -> mujoco.MjModel:
    return aloha_scene().compile()


def test_aloha_has_four_arms_with_grippers(aloha: mujoco.MjModel) -> None:
    robots = find_robots(aloha)
    assert [r.name for r in robots] == ["south/left", "south/right", "north/left", "north/right"]
    for robot in robots:
        assert robot.site == f"{robot.name}/tcp"
        assert len(robot.joints) == 6
        assert (robot.gripper_open, robot.gripper_closed) == (0.037, 0.002)
        assert robot.finger_bodies == (f"{robot.name}/left_finger_link", f"{robot.name}/right_finger_link")
    assert [o.name for o in find_objects(aloha)] == ["red_board", "blue_board"]
    assert _is_held_by_friction_only(aloha)


def test_aloha_rests_at_home(aloha: mujoco.MjModel) -> None:
    """Boards lie still on their own table; grippers lean towards the other station, one like the other."""
    data = _settled(aloha)
    home = mujoco.MjData(aloha)
    mujoco.mj_resetDataKeyframe(aloha, home, 0)
    mujoco.mj_kinematics(aloha, home)
    for name, sign in (("red_board", -1.0), ("blue_board", 1.0)):
        assert np.linalg.norm(data.body(name).xpos - home.body(name).xpos) < 1e-3
        assert data.body(name).xpos[1] * sign > 0.05
        assert data.body(name).xpos[2] == pytest.approx(BOARD_SIZE[2], abs=2e-3)
    tips = [data.site(f"{s}/tcp").xpos for s in ("south/left", "south/right", "north/left", "north/right")]
    np.testing.assert_allclose(tips[0] * (-1, 1, 1), tips[1], atol=1e-3)  # the stations are mirrored ...
    np.testing.assert_allclose(tips[1] * (-1, -1, 1), tips[3], atol=1e-3)  # ... and turned
    fingers = data.site("south/left/tcp").xmat.reshape(3, 3)[:, 2]
    assert math.degrees(math.acos(-fingers[2])) == pytest.approx(20.0, abs=4.0)  # its servos yield slightly
    assert fingers[1] > 0.0


@pytest.mark.parametrize("n", [2, 8])
def test_panda_arms_stand_around_a_table_and_hold_still(n: int) -> None:
    model = panda_scene(n).compile()
    robots = find_robots(model)
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
