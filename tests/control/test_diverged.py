"""Plants whose numbers are no numbers: control holds, raises nothing, and commands finite values."""

from __future__ import annotations

import math

import mujoco
import numpy as np

from anchors.pose import PoseTuple
from iris_session.control import ControlConfig
from iris_session.control.grasp import Grasps
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import ObjectSpec
from iris_session.protocol.steps import Command, FixedView, ObjectCommand
from tests.control.rigs import PANDA_HOME, Rig, decision, hold_command, panda_spec, pose_command
from tests.models import PANDA


def on_a_rail(config: ControlConfig | None = None) -> Rig:
    arm = mujoco.MjSpec.from_file(str(PANDA))
    for key in list(arm.keys):
        arm.delete(key)
    arm.body("link0").add_joint(name="rail", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[1, 0, 0])
    return Rig(arm.compile(), [panda_spec()], config, home=PANDA_HOME)


def tick(rig: Rig, command: Command) -> None:
    """One step of control on the data as they are, without physics."""
    rig.steps += 1
    rig.controller.begin(rig.steps * 2_000_000, 1, decision([command]), FixedView())
    rig.controller.tick(rig.data)


def finite(T: PoseTuple) -> bool:
    return all(map(math.isfinite, (*T[0], *T[1])))


def test_a_base_that_stands_nowhere_is_held_where_it_was() -> None:
    for config in (None, ControlConfig(output="targets")):
        rig = on_a_rail(config)
        for k in range(20):
            rig.step(decision([pose_command("panda", rig.source((0.001 * k, 0.0, 0.0)))]))
        rig.data.joint("rail").qpos[:] = math.nan
        mujoco.mj_kinematics(rig.model, rig.data)
        before = rig.target()
        tick(rig, pose_command("panda", rig.source((0.3, 0.0, 0.0))))
        tick(rig, hold_command("panda"))
        assert finite(rig.target())
        assert np.linalg.norm(np.subtract(rig.target()[0], before[0])) < 0.02
        assert np.isfinite(rig.data.ctrl).all()


def test_a_reset_on_numbers_that_are_none_keeps_what_was_commanded() -> None:
    for config in (None, ControlConfig(output="targets")):
        rig = on_a_rail(config)
        before, ctrl = rig.target(), rig.data.ctrl.copy()
        rig.data.qpos[:] = math.nan
        mujoco.mj_kinematics(rig.model, rig.data)
        rig.controller.reset(rig.data)
        tick(rig, hold_command("panda"))
        assert np.allclose(rig.target()[0], before[0], atol=1e-9)
        assert config is not None or np.isfinite(rig.data.ctrl).all()
        assert config is None or (rig.data.ctrl == ctrl).all()


def test_an_object_that_is_nowhere_is_not_pushed() -> None:
    model = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body name='box'><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    data.qpos[0] = math.nan
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    grasps = Grasps(model, [ObjectSpec("box", "box")], ControlConfig())
    grasps.set_goals([ObjectCommand("box", 1, Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)))])
    grasps.tick(data)
    assert not data.xfrc_applied.any()
