"""`World`: ticks equal `mj_step` bit for bit, and saving has no effect, in this process and in another one."""

from __future__ import annotations

import math
import re

import msgspec
import mujoco
import numpy as np
import pytest

from iris_session.physics import (
    ModelUnsupportedError,
    SimulationDivergedError,
    SnapshotError,
    SpecError,
    UnknownNameError,
    World,
    decode_model,
    find_objects,
    find_robots,
)
from iris_session.physics.tip import Tip
from iris_session.physics.world import STATE, RobotSignals
from iris_session.protocol.common import Pose
from iris_session.protocol.server_messages import BodyInfo
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from tests.models import MENAGERIE
from tests.physics.models import arm, clutter, model, scene

NAMES = {"EULER": "Euler", "RK4": "RK4"}
INTEGRATORS = [n.removeprefix("mjINT_") for n in dir(mujoco.mjtIntegrator) if n.startswith("mjINT_")]
CASES = [
    *((NAMES.get(name, name.lower()), "", "") for name in INTEGRATORS),
    ("implicitfast", 'cone="elliptic" impratio="10" noslip_iterations="3"', ""),
    ("Euler", 'solver="PGS"', ""),
    ("Euler", 'solver="CG" jacobian="sparse"', '<flag warmstart="disable" energy="enable"/>'),
]
SLEEPS = hasattr(mujoco.mjtEnableBit, "mjENBL_SLEEP")


def state_of(m: mujoco.MjModel, d: mujoco.MjData) -> bytes:
    array = np.empty(mujoco.mj_stateSize(m, STATE))
    mujoco.mj_getState(m, d, array, STATE)
    return array.tobytes()


def drive(data: mujoco.MjData, k: int) -> None:
    """Set the k-th inputs: actuators, and everything else that may be written between ticks."""
    data.ctrl[:] = np.sin(0.05 * k + np.arange(len(data.ctrl)))
    data.xfrc_applied[-2, :3] = (0.3 * np.cos(0.1 * k), 0.0, 0.2)
    data.qfrc_applied[0] = 0.1 * np.sin(0.2 * k)
    data.userdata[:1] = k


@pytest.mark.parametrize(("integrator", "option", "flag"), CASES)
def test_ticks_equal_mj_steps_bit_for_bit(integrator: str, option: str, flag: str) -> None:
    m = clutter(integrator, option, flag)
    plain, world = mujoco.MjData(m), World(m, (), ())
    contacts = 0
    for k in range(200):
        drive(plain, k)
        drive(world.data, k)
        mujoco.mj_step(m, plain)
        world.tick()
        contacts = max(contacts, int(plain.ncon))
        assert world.save_state() == state_of(m, plain), f"tick {k}"
    assert contacts > 8


@pytest.mark.parametrize("name", ["aloha", "panda", "handover"])
def test_real_models_tick_like_mj_step_and_restore(name: str, request: pytest.FixtureRequest) -> None:
    m = request.getfixturevalue(name)
    robots, objects = find_robots(m).robots, find_objects(m)
    world, plain = World(m, robots, objects), mujoco.MjData(m)
    mujoco.mj_resetDataKeyframe(m, plain, 0)
    assert world.save_state() == state_of(m, plain)
    start = world.data.ctrl.copy()
    for k in range(300):
        ctrl = start + 0.2 * np.sin(0.02 * k)
        plain.ctrl[:] = ctrl
        world.ctrl[:] = ctrl
        mujoco.mj_step(m, plain)
        world.tick()
        if k == 150:
            saved = world.snapshot()
    assert world.save_state() == state_of(m, plain)
    other = World(m, robots, objects)
    other.restore(saved)
    for k in range(151, 300):
        other.ctrl[:] = start + 0.2 * np.sin(0.02 * k)
        other.tick()
    assert other.snapshot() == world.snapshot()


@pytest.mark.parametrize(("integrator", "option", "flag"), CASES)
def test_restore_has_no_effect_on_later_ticks(integrator: str, option: str, flag: str) -> None:
    """A world saved and restored every 37 ticks, and one restored elsewhere, stay equal to an untouched one."""
    m = clutter(integrator, option, flag)
    objects = find_objects(m)
    world, saved_often, other = (World(m, (), objects) for _ in range(3))
    shared = b""
    for k in range(260):
        for w in (world, saved_often, other) if k >= 200 else (world, saved_often):
            drive(w.data, k)
            if k in (50, 230):
                w.data.mocap_pos[0] = (0.1 * k / 50, 0.0, 0.05)
                w.data.eq_active[0] = k == 50
                mujoco.mj_step1(m, w.data)
            w.tick()
        if k % 37 == 0:
            snapshot = saved_often.snapshot()
            saved_often.restore(snapshot)
            assert saved_often.snapshot() == snapshot
        if k == 199:
            shared = world.snapshot()
            other.tick()
            other.restore(shared)
        assert saved_often.snapshot() == world.snapshot()
        assert saved_often.view().object_contacts() == world.view().object_contacts()
    assert other.snapshot() == world.snapshot()
    poses = np.zeros((2, len(world.bodies), 7))
    world.read_poses(poses[0])
    other.read_poses(poses[1])
    assert poses[0].tobytes() == poses[1].tobytes()
    assert other.view().object_contacts() == world.view().object_contacts() != ()


@pytest.mark.skipif(not hasattr(mujoco.MjModel, "nhistory"), reason="this MuJoCo has no delays")
def test_delayed_actuators_and_sensors_are_saved() -> None:
    """Delay buffers are state too."""
    m = model("""<mujoco><worldbody><body><joint name="a" axis="0 1 0" damping=".1"/>
      <geom type="capsule" fromto="0 0 0 .4 0 0" size=".03"/></body></worldbody>
      <actuator><position joint="a" kp="50" delay=".02" nsample="12"/></actuator>
      <sensor><jointpos joint="a" delay=".01" nsample="8"/></sensor></mujoco>""")
    world, restored, plain = World(m, (), ()), World(m, (), ()), mujoco.MjData(m)
    for k in range(120):
        for d in (world.data, restored.data, plain):
            d.ctrl[0] = np.sin(0.1 * k)
        mujoco.mj_step(m, plain)
        world.tick()
        restored.tick()
        if k == 60:
            restored = World(m, (), ())
            restored.restore(world.snapshot())
        assert world.save_state() == restored.save_state() == state_of(m, plain)
    assert world.data.sensordata.tobytes() == restored.data.sensordata.tobytes()


def test_reset_uses_home_then_the_first_keyframe_then_the_default(aloha: mujoco.MjModel) -> None:
    xml = """<mujoco><worldbody><body><joint/><geom size=".1"/></body></worldbody>{}</mujoco>"""
    keys = '<keyframe><key name="up" qpos="1"/><key name="home" qpos="2" time="3"/></keyframe>'
    world = World(model(xml.format(keys)), (), ())
    assert world.data.qpos[0] == 2.0
    assert world.view().sim_time == 3.0
    for _ in range(3):
        world.tick()
    assert world.view().tick == 3
    first = World(model(xml.format(keys)), (), ()).snapshot()
    world.reset()
    assert world.snapshot() == first
    assert world.view().tick == 0
    assert World(model(xml.format("")), (), ()).data.qpos[0] == 0.0
    assert (World(aloha, (), ()).data.qpos == aloha.key_qpos[0]).all()


def test_bodies_of_a_scene_with_flexes_mocap_and_unnamed_bodies() -> None:
    m = model("""<mujoco><option timestep="0.005"/><worldbody>
      <body><geom size=".1"/><body name="body_1" pos="1 0 0"><joint/><geom size=".1"/></body></body>
      <body name="ball" pos="0 0 2"><freejoint/><geom size=".1"/></body>
      <body name="hand" mocap="true"><geom size=".1"/></body>
      <flexcomp name="cloth" type="grid" count="4 4 1" spacing=".1 .1 .1" pos="0 0 4" dim="2" mass=".3" radius=".01">
        <edge equality="true"/><pin id="0"/></flexcomp>
      <flexcomp name="brick" type="grid" count="3 3 3" spacing=".1 .1 .1" pos="2 0 4" dim="3" mass="1" rigid="true"/>
      </worldbody></mujoco>""")
    objects = find_objects(m)
    assert [o.name for o in objects] == ["ball"]
    world = World(m, (), objects)
    assert m.nbody > 16
    assert world.bodies[:4] == (
        BodyInfo(1, "body_1~2", moving=False),
        BodyInfo(2, "body_1", moving=True),
        BodyInfo(3, "ball", moving=True, object=True),
        BodyInfo(4, "hand", moving=True),
    )
    assert {b.name for b in world.bodies[4:]} <= {"brick"}
    assert world.tick_period_ns == 5_000_000
    for _ in range(5):
        world.tick()
    assert len(world.bodies) < m.nbody - 15
    out = np.full((len(world.bodies), 7), np.nan)
    world.read_poses(out)
    assert out[2, 2] < 2.0
    assert np.allclose(np.linalg.norm(out[:, 3:], axis=1), 1.0)


def test_divergence_raises_until_reset() -> None:
    m = clutter()
    world = World(m, (), ())
    good = world.snapshot()
    world.data.qvel[3] = 1e14
    with pytest.raises(SimulationDivergedError, match=r"at tick 1 .*huge"):
        world.tick()
    with pytest.raises(SimulationDivergedError):
        world.tick()
    assert world.diverged
    world.reset()
    world.tick()
    world.ctrl[0] = np.nan
    with pytest.raises(SimulationDivergedError, match="ctrl is NaN"):
        world.tick()
    broken = world.snapshot()
    world.restore(good)
    world.tick()
    assert not world.diverged
    other = World(m, (), ())
    other.restore(broken)
    with pytest.raises(SimulationDivergedError, match="ctrl is NaN"):
        other.tick()
    assert world.view().tick == 1
    assert world.dropped_counts == {}


def test_foreign_snapshots_are_rejected(handover: mujoco.MjModel) -> None:
    world = World(clutter(), (), ())
    with pytest.raises(SnapshotError, match="no world snapshot"):
        world.restore(b"nonsense")
    with pytest.raises(SnapshotError, match=r"of scene [0-9a-f]{32}, "):
        world.restore(World(handover, (), ()).snapshot())
    with pytest.raises(SnapshotError, match="state of 8 bytes"):
        world.restore_state(bytes(8))
    state = np.frombuffer(world.save_state()).copy()
    state[0] = np.nan  # the time
    with pytest.raises(SimulationDivergedError, match="not finite"):
        world.restore_state(state.tobytes())
    with_robots = World(handover, find_robots(handover).robots, ())
    with pytest.raises(SnapshotError, match=r"0 robots, .* 2"):
        with_robots.restore(World(handover, (), ()).snapshot())


@pytest.mark.skipif(not SLEEPS, reason="this MuJoCo has no sleeping islands")
def test_sleeping_islands_are_rejected() -> None:
    m = clutter(flag='<flag sleep="enable"/>')
    with pytest.raises(ModelUnsupportedError, match="sleeping islands"):
        World(m, (), ())


def test_scene_hash_does_not_depend_on_the_folder(panda: mujoco.MjModel) -> None:
    first = World(panda, (), ())
    data = first.encode_model()
    assert bytes(panda.paths).strip(b"\0")
    assert bytes(panda.paths) not in data
    assert str(MENAGERIE).encode() not in data
    again = World(decode_model(data), (), ())
    assert again.scene_hash == first.scene_hash
    assert len(first.scene_hash) == 32
    assert World(clutter(), (), ()).scene_hash != first.scene_hash


def test_actuators_and_bodies_belong_to_one_robot(handover: mujoco.MjModel) -> None:
    left, right = find_robots(handover).robots
    (hammer, *_) = find_objects(handover)
    for change, named in (
        ({"joints": left.joints}, f"joint {left.joints[0]!r}"),
        ({"actuators": left.actuators}, f"actuator {left.actuators[0]!r}"),
        ({"gripper_actuator": left.gripper_actuator}, f"actuator {left.gripper_actuator!r}"),
        ({"name": "left"}, "name 'left'"),
    ):
        with pytest.raises(SpecError, match=re.escape(named)):
            World(handover, (left, msgspec.structs.replace(right, **change)), ())
    with pytest.raises(SpecError, match="belongs to object"):
        World(handover, (), (hammer, ObjectSpec("again", hammer.body)))
    with pytest.raises(UnknownNameError, match=r"'left': body 'left/fingr'.*: .*left"):
        World(handover, (msgspec.structs.replace(left, finger_bodies=("left/fingr",)),), ())


def test_shown_state_depends_only_on_its_bytes(handover: mujoco.MjModel) -> None:
    """The state of an open session does not depend on earlier states, and its bytes are kept."""
    robots, objects = find_robots(handover).robots, find_objects(handover)
    source = World(handover, robots, objects)
    states = []
    for k in range(40):
        source.ctrl[:] = handover.key_ctrl[0] + 0.1 * np.sin(0.1 * k)
        source.tick()
        states.append(source.save_state())
    forwards, single = World(handover, robots, objects), World(handover, robots, objects)
    for state in states:
        for _ in range(2):
            forwards.restore_state(state)
            assert forwards.save_state() == state
            forwards.ctrl[:] += 0.5
    forwards.restore_state(states[-1])
    single.restore_state(states[-1])
    assert single.snapshot() == forwards.snapshot()
    assert single.view().tick == 40
    assert single.view().object_contacts() == source.view().object_contacts()
    single.tick()
    source.tick()
    assert single.save_state() == source.save_state()


def test_a_shown_state_keeps_its_warm_start(monkeypatch: pytest.MonkeyPatch) -> None:
    """`mj_forward` of MuJoCo 3.3.0 replaces it, so that states that were shown before would count."""
    forward = mujoco.mj_forward

    def replace_warm_start(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        forward(model, data)
        data.qacc_warmstart[:] = data.qacc

    world = World(clutter(), (), ())
    for _ in range(40):
        world.tick()
    state = world.save_state()
    monkeypatch.setattr("mujoco.mj_forward", replace_warm_start)
    other = World(clutter(), (), ())
    other.restore_state(state)
    assert other.save_state() == state


def test_states_are_given_to_mujoco_as_arrays_that_it_may_write(monkeypatch: pytest.MonkeyPatch) -> None:
    """MuJoCo 3.3 refuses others."""
    world = World(clutter(), (), ())
    state, put = world.save_state(), mujoco.mj_setState

    def strict(m: mujoco.MjModel, d: mujoco.MjData, values: np.ndarray, kind: int) -> None:
        assert values.flags.writeable
        put(m, d, values, kind)

    monkeypatch.setattr(mujoco, "mj_setState", strict)
    data = world.make_initial_data(state)
    assert np.array_equal(data.qpos, world.data.qpos)
    world.restore_state(state)
    world.restore(world.snapshot())


def test_robot_signals_are_joints_openings_and_tips() -> None:
    """Openings of a position actuator with a gain, and of a motor, which has no position to open to."""
    gripper = '<general name="{0}" joint="{0}" gainprm="2" biastype="affine" biasprm="1 -400"/>'
    arms = "".join(
        f'<body name="{n}"><joint name="{n}/turn"/><geom size=".1"/><site name="{n}/tip" pos="0 0 .3"/>'
        f'<body><joint name="{n}/grip" type="slide"/><geom size=".1"/></body></body>'
        for n in ("a", "b")
    )
    motors = f'<actuator>{gripper.format("a/grip")}<motor name="b/grip" joint="b/grip"/></actuator>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{arms}</worldbody>{motors}</mujoco>")
    robots = [
        RobotSpec(n, (f"{n}/turn",), (), f"{n}/tip", n, f"{n}/grip", gripper_open=10.0, gripper_closed=0.0)
        for n in ("a", "b")
    ]
    signals = RobotSignals(model, robots)
    data = mujoco.MjData(model)
    data.qpos[:] = (0.5, 0.03, -0.5, 0.01)
    mujoco.mj_forward(model, data)
    values = np.frombuffer(signals.read(data))
    assert values[:2].tolist() == [0.5, -0.5]
    assert values[2] == pytest.approx((400 * 0.03 - 1) / 2 / 10), "ctrl at which it would rest here, as a share"
    assert np.isnan(values[3])
    assert values[4:].reshape(2, 3) == pytest.approx(data.site_xpos)
    assert signals.units == (("rad",), ("rad",))
    assert RobotSignals(model, []).read(data) == b""


def test_rotation_of_an_end_effector_is_normalised_once() -> None:
    m = scene(*arm(end=""))
    (robot,) = find_robots(m).robots
    turned = msgspec.structs.replace(robot, T_body_tip=Pose(robot.T_body_tip.p, (0.0, 2.0, 0.0, 0.0)))
    assert Tip(m, turned).T_body_tip.q == (0.0, 1.0, 0.0, 0.0)
    assert World(m, (turned,), ()).view().tip_pose(robot.name).q == (0.0, 1.0, 0.0, 0.0)
    here, straight = (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)
    for pose in (
        Pose(here, (0.0, 0.0, 0.0, 0.0)),
        Pose(here, (math.nan, 0.0, 0.0, 0.0)),
        Pose((math.nan, 0.0, 0.0), straight),
    ):
        with pytest.raises(SpecError, match=r"T_body_tip"):
            World(m, (msgspec.structs.replace(robot, T_body_tip=pose),), ())
