"""`snapshot` and `restore` are invisible, bit for bit, wherever in a session they happen; control is deterministic."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchors.pose import quat_from_rotvec
from iris_session.control import ControlConfig, Controller
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import Command, Decision, ObjectCommand
from tests.control.rigs import Rig, aloha_robots, hold_command, pose_command
from tests.models import ALOHA

ONE_A_TICK = ControlConfig(max_solves_per_tick=1)  # so that whose turn it is matters
STATE = int(mujoco.mjtState.mjSTATE_INTEGRATION)


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    """Aloha with a free box to take."""
    spec = mujoco.MjSpec.from_file(str(ALOHA))
    for key in list(spec.keys):
        spec.delete(key)
    box = spec.worldbody.add_body(name="box", pos=[0.0, 0.0, 0.1])
    box.add_freejoint()
    box.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02, 0.02, 0.02], mass=0.1)
    return spec.compile()


HOME = (0.0, -0.96, 1.16, 0.0, -0.3, 0.0)


def make(model: mujoco.MjModel) -> Rig:
    return Rig(model, aloha_robots(), ONE_A_TICK, objects=[ObjectSpec("box", "box")], home=HOME)


def vector(rng: np.random.Generator, size: float, n: int) -> tuple[float, ...]:
    return tuple(rng.uniform(-size, size, n).tolist())


def random_command(rig: Rig, rng: np.random.Generator, robot: RobotSpec, act: int, engagement: int) -> Command:
    """One of the kinds of command, with random values."""
    p = vector(rng, 0.1, 3)
    q = quat_from_rotvec(vector(rng, 0.3, 3))
    new = bool(rng.random() < 0.2)
    gripper = float(rng.random()) if rng.random() < 0.5 else None
    one = {"engagement": engagement, "new": new}
    if act == 0:
        return hold_command(robot.name)
    if act == 1:
        return pose_command(robot.name, rig.source(p, q, **one), gripper=gripper, scale=float(rng.uniform(0.5, 2)))
    if act == 2:
        two = [rig.source(p, q, **one, weight=0.5, participant=name) for name in "ab"]
        return pose_command(robot.name, *two, gripper=gripper)
    if act == 3:
        source = rig.source(p, pose_world=None, twist_world=vector(rng, 0.4, 6), **one)
        return Command(robot.name, "twist", sources=(source,))
    if act == 4:
        joints = tuple(np.add(HOME, vector(rng, 0.4, 6)).tolist())
        source = rig.source(p, pose_world=None, q=joints, qd=vector(rng, 1.0, 6), **one)
        return Command(robot.name, "joints", sources=(source,))
    base = rig.target(rig.robots.index(robot))
    return pose_command(robot.name, rig.source(tuple(np.add(base[0], p).tolist()), q, absolute=True, **one))


def session(rig: Rig, seed: int, steps: int) -> list[tuple[Decision, int]]:
    """A random journal of decisions and tick counts. Acts last for a while, as people's do."""
    rng = np.random.default_rng(seed)
    journal, acts, grasping = [], [0, 0], False
    for step in range(steps):
        if step % 12 == 0:
            acts = [int(a) for a in rng.integers(0, 6, 2)]
            grasping = bool(rng.random() < 0.5)
        commands = [random_command(rig, rng, r, a, step // 24) for r, a in zip(rig.robots, acts, strict=True)]
        objects = (ObjectCommand("box", 1, Pose(vector(rng, 0.3, 3), (1.0, 0.0, 0.0, 0.0))),)
        journal.append((Decision(tuple(commands), objects if grasping else ()), int(rng.integers(0, 3))))
    return journal


def play(rig: Rig, journal: list[tuple[Decision, int]], restart_every: int = 0) -> list[bytes]:
    """What everybody can observe after every step: ctrl, wrenches, physics, status, targets."""
    seen = []
    for step, (decision, n_ticks) in enumerate(journal):
        if restart_every and step % restart_every == restart_every - 1:
            snapshot = rig.controller.snapshot()
            rig.controller = Controller(rig.model, rig.robots, [ObjectSpec("box", "box")], ONE_A_TICK)
            rig.controller.restore(snapshot)
            assert rig.controller.snapshot() == snapshot
        rig.step(decision, n_ticks)
        state = np.empty(mujoco.mj_stateSize(rig.model, STATE))
        mujoco.mj_getState(rig.model, rig.data, state, STATE)
        report = repr((rig.controller.get_status(), rig.controller.get_targets())).encode()
        seen.append(state.tobytes() + rig.data.ctrl.tobytes() + rig.data.xfrc_applied.tobytes() + report)
    return seen


@pytest.mark.long
@settings(max_examples=6, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(2, 40))
def test_restoring_into_a_fresh_controller_is_invisible(model: mujoco.MjModel, seed: int, every: int) -> None:
    journal = session(make(model), seed, 150)
    assert play(make(model), journal) == play(make(model), journal, restart_every=every)


def test_every_kind_of_command_was_in_such_a_session(model: mujoco.MjModel) -> None:
    journal = session(make(model), 7, 400)
    rig = make(model)
    play(rig, journal)
    kinds = {c.kind for d, _ in journal for c in d.commands}
    assert kinds == {"hold", "pose", "twist", "joints"}
    assert np.isfinite(rig.data.qpos).all()
    assert rig.controller.get_status()[0].applied is not None
