"""Driving through an environment's own action: small environments that mean by their action what suites mean by it."""

from __future__ import annotations

import math
import types
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest

import iris_session
from anchors.pose import (
    PoseTuple,
    Quat,
    compose,
    inverse,
    quat_angle,
    quat_conj,
    quat_from_rotvec,
    quat_mul,
    quat_rotate,
    quat_to_rotvec,
)
from iris_session import ConfigError, ControlConfig
from iris_session.control.arm_model import ArmModel, read_site_pose
from iris_session.demo.scenes import scene_path
from iris_session.physics import find_robots, load_model
from iris_session.physics.tip import Tip
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import GripperActuator, RobotSpec
from iris_session.session.action_entries import measure_way
from iris_session.session.actions import ActionDrive
from iris_session.session.attachment import Attachment
from iris_session.session.user_loop import UserLoop
from tests.session.loops import Rig, take_over
from tests.session.test_session import QUIET

Space = types.SimpleNamespace
CONFIG = ControlConfig(output="targets")
FRAMES = 10  # ticks in a step of an environment
PERIOD = 0.02
JOINT_STEP = CONFIG.joint_velocity * PERIOD
GRIPPER_STEP = CONFIG.gripper_speed * PERIOD

MOCAP = """<mujoco><option timestep="0.002"><flag contact="disable"/></option><worldbody>
<body name="mocap" mocap="true" pos="0 0 .5"/>
<body name="x" pos="0 0 .5"><joint name="x" type="slide" axis="1 0 0" damping="2"/><geom size=".02"/>
<body name="y"><joint name="y" type="slide" axis="0 1 0" damping="2"/><geom size=".02"/>
<body name="hand"><joint name="z" type="slide" axis="0 0 1" damping="2"/><geom size=".03" mass="1"/>
<site name="tip" pos="0 0 -.1"/>
<body name="left" pos="0 .02 -.1"><joint name="l" type="slide" axis="0 1 0" range="-.02 .03" damping="5"/>
<geom size=".01"/></body>
<body name="right" pos="0 -.02 -.1"><joint name="r" type="slide" axis="0 -1 0" range="-.02 .03" damping="5"/>
<geom size=".01"/></body></body></body></body></worldbody>
<equality><weld body1="mocap" body2="hand" solref=".05 1" solimp=".5 .5 .001"/></equality>
<actuator><position joint="l" name="l" kp="100" ctrlrange="-1 1"/><position joint="r" name="r" kp="100"
ctrlrange="-1 1"/></actuator></mujoco>"""


class World:
    """An environment of the demo scene whose arms are heavy and whose servos are soft, so that they stop short."""

    size = 16

    def __init__(self) -> None:
        model = load_model(scene_path("handover"))
        model.body_gravcomp[:] = 0.0
        model.actuator_gainprm[:, 0] *= 0.3
        model.actuator_biasprm[:, 1] *= 0.3
        self._begin(model, find_robots(model).robots)
        mujoco.mj_resetDataKeyframe(model, self.data, 0)
        self.home = self.data.ctrl.copy()
        self.advance(20)

    def _begin(self, model: mujoco.MjModel, robots: tuple[RobotSpec, ...]) -> None:
        self.model, self.data, self.robots = model, mujoco.MjData(model), robots
        self.tip = Tip(model, robots[0])

    def step(self, action: Any) -> tuple[Any, ...]:
        self.data.ctrl[:] = action
        self.advance()
        return None, 0.0, False, False, {"success": False}

    def advance(self, steps: int = 1) -> None:
        mujoco.mj_step(self.model, self.data, nstep=FRAMES * steps)

    def policy(self, t: float) -> np.ndarray:
        wave = np.zeros(16)
        wave[[0, 1, 5]] = 0.15
        return self.home + wave * math.sin(3.0 * t)

    def measure_opening(self) -> float:
        """Distance of the fingers [m]."""
        a, b = (self.data.body(name).xpos for name in ("left/finger_left", "left/finger_right"))
        return float(np.linalg.norm(a - b))


class ShortArm(World):
    """As SO-101: five joints, which do not turn the tip freely."""

    def __init__(self) -> None:
        super().__init__()
        robot = self.robots[0]
        link = self.model.body(int(self.model.jnt_bodyid[self.model.joint(robot.joints[4]).id])).name
        robot = msgspec.structs.replace(
            robot, joints=robot.joints[:5], actuators=robot.actuators[:5], site="", tip_body=link
        )
        robot = msgspec.structs.replace(robot, T_body_tip=Pose((0.05, 0.0, 0.1), (1.0, 0.0, 0.0, 0.0)))
        self.robots, self.tip = (robot,), Tip(self.model, robot)


class ByRobot(World):
    """As gym-aloha: joints and an opening from 0 to 1, robot by robot."""

    def step(self, action: Any) -> tuple[Any, ...]:
        ctrl = np.array(action, float)
        ctrl[[7, 15]] *= 0.04
        return super().step(ctrl)

    def policy(self, t: float) -> np.ndarray:
        action = super().policy(t)
        action[[7, 15]] /= 0.04
        return action


ByRobot.__module__ = "gym_aloha.env"


class Normalised(World):
    """`ctrl` from -1 to 1."""

    def __init__(self) -> None:
        super().__init__()
        self.action_space = Space(low=np.full(16, -1.0), high=np.ones(16))
        self.middle = self.model.actuator_ctrlrange.mean(axis=1)
        self.half = 0.5 * np.ptp(self.model.actuator_ctrlrange, axis=1)

    def step(self, action: Any) -> tuple[Any, ...]:
        return super().step(self.middle + self.half * np.asarray(action))

    def policy(self, t: float) -> np.ndarray:
        return (super().policy(t) - self.middle) / self.half


class Ways(World):
    """As many entries as actuators, and none is what it commands: ways of the joints, from what is commanded.

    After nineteen steps of a constant action `ctrl` is the action, in the next one: a chance match.
    """

    def __init__(self) -> None:
        super().__init__()
        self.data.ctrl[:] = 0.0

    def step(self, action: Any) -> tuple[Any, ...]:
        return super().step(self.data.ctrl + 0.05 * np.asarray(action))

    def policy(self, t: float) -> np.ndarray:
        return np.full(16, 0.02)


class WaysAndOpening(Ways):
    """Ways of the joints, and what the grippers are to be."""

    def step(self, action: Any) -> tuple[Any, ...]:
        ctrl = self.data.ctrl + 0.05 * np.asarray(action)
        ctrl[[7, 15]] = np.asarray(action)[[7, 15]]
        return World.step(self, ctrl)

    def policy(self, t: float) -> np.ndarray:
        action = np.zeros(16)
        action[[7, 15]] = 0.03
        return action


class AboutHome(Normalised):
    """Half a radian about a home position, as usual in reinforcement learning."""

    def step(self, action: Any) -> tuple[Any, ...]:
        return World.step(self, self.home + 0.5 * np.asarray(action))

    def policy(self, t: float) -> np.ndarray:
        return np.full(16, 0.1)


class Swapped(World):
    """Lists the other arm first; while both stand alike, equal values fit any order."""

    def step(self, action: Any) -> tuple[Any, ...]:
        return super().step(np.roll(np.asarray(action), 8))

    def policy(self, t: float) -> np.ndarray:
        return self.home


class Blocked(World):
    """A robot that something stops, as far as the lock is closed."""

    is_blocked = False

    def advance(self, steps: int = 1) -> None:
        before = self.data.qpos.copy()
        super().advance(steps)
        if self.is_blocked:
            self.data.qpos[:], self.data.qvel[:] = before, 0.0
            mujoco.mj_forward(self.model, self.data)

    def measure_push(self, action: Any) -> np.ndarray:
        """Way from the tip to where `action` commands it [m]."""
        data = mujoco.MjData(self.model)
        data.qpos[:] = self.data.qpos
        for name, entry in zip(self.robots[0].joints, action, strict=False):
            data.joint(name).qpos[0] = entry
        mujoco.mj_kinematics(self.model, data)
        return np.subtract(self.tip.read_pose(data)[0], self.tip.read_pose(self.data)[0])

    def policy(self, t: float) -> np.ndarray:
        return self.home


class Osc(World):
    """As robosuite: the way of a frame beside the tip, in the frame of a base that is turned."""

    size = 7
    kind, input_type = "OSC_POSE", "delta"

    def __init__(self) -> None:
        super().__init__()
        spec = mujoco.MjSpec.from_file(str(scene_path("handover")))
        spec.body("left/base").add_site(name="base_center", quat=[0.5, 0.5, -0.5, 0.5])
        spec.body("left/hand").add_site(name="frame", pos=[0.05, 0.02, 0.1], quat=[0.8, 0.6, 0.0, 0.0])
        model = spec.compile()
        model.body_gravcomp[:] = 0.0
        self._begin(model, find_robots(model).robots[:1])
        mujoco.mj_resetDataKeyframe(model, self.data, 0)
        self.advance(20)
        self.joints = [int(model.joint(name).id) for name in self.robots[0].joints]
        self.current = -1.0  # of the gripper
        self.sim, self.control_timestep = Space(model=model, data=self.data), PERIOD
        controller = Space(
            name=self.kind,
            joint_index=self.joints,
            ref_name="frame",
            naming_prefix="base",
            part_name="",
            use_ori=True,
            input_type=self.input_type,
            input_ref_frame="base",
            input_max=np.ones(6),
            input_min=-np.ones(6),
            output_max=np.array([0.05, 0.05, 0.05, 0.5, 0.5, 0.5]),
            output_min=-np.array([0.05, 0.05, 0.05, 0.5, 0.5, 0.5]),
        )
        composite = Space(
            arms=["right"],
            part_controllers={"right": controller},
            _action_split_indexes={"right": (0, 6), "right_gripper": (6, 7)},
        )
        self.robots_of_suite = [Space(composite_controller=composite, action_dim=7)]

    def step(self, action: Any) -> tuple[Any, ...]:
        entries = np.clip(action, -1.0, 1.0)
        base, (p, q) = self.read_site("base_center")[1], self.read_site("frame")
        way = np.array(quat_rotate(base, tuple((0.05 * entries[:3]).tolist())))
        turn = quat_from_rotvec(quat_rotate(base, tuple((0.5 * entries[3:6]).tolist())))
        self.move_gripper(entries[6])
        return self.pull(p + way, quat_mul(turn, q))

    def read_site(self, name: str) -> PoseTuple:
        return read_site_pose(self.data, self.model.site(name).id)

    def move_gripper(self, entry: float) -> None:
        self.current = float(np.clip(self.current + 0.2 * np.sign(entry), -1.0, 1.0))
        self.data.ctrl[7] = 0.02 - 0.02 * self.current

    def pull(self, p: Any, q: Quat) -> tuple[Any, ...]:
        """Step towards a goal, half of the way in a tick, for soft servos."""
        J, frame = np.zeros((6, self.model.nv)), self.model.site("frame").id
        for _ in range(FRAMES):
            e = measure_way(self.read_site("frame"), (tuple(p), q))
            mujoco.mj_jacSite(self.model, self.data, J[:3], J[3:], frame)
            A = J[:, :7]
            self.data.ctrl[:7] = self.data.qpos[:7] + 0.5 * A.T @ np.linalg.solve(A @ A.T + 1e-4 * np.eye(6), e)
            mujoco.mj_step(self.model, self.data)
        return None, 0.0, False, {}

    def policy(self, t: float) -> np.ndarray:
        return np.array([0.3 * math.sin(3.0 * t), 0.0, 0.3 * math.cos(3.0 * t), 0.0, 0.0, 0.0, -1.0])


class OscAbsolute(Osc):
    """A pose in the frame of the base instead."""

    input_type = "absolute"

    def __init__(self) -> None:
        super().__init__()
        p, q = compose(inverse(self.read_site("base_center")), self.read_site("frame"))
        self.fixed = np.array([*p, *quat_to_rotvec(q), -1.0])

    def step(self, action: Any) -> tuple[Any, ...]:
        x, y, z, *turn = np.asarray(action)[:6].tolist()
        goal = ((x, y, z), quat_from_rotvec((turn[0], turn[1], turn[2])))
        return self.pull(*compose(self.read_site("base_center"), goal))

    def policy(self, t: float) -> np.ndarray:
        return self.fixed


class Suite:
    """An environment has a `robots` of its own, which are not those of a session."""

    def __init__(self, world: Osc) -> None:
        self.robots, self.sim, self.control_timestep = world.robots_of_suite, world.sim, PERIOD


class MetaWorld(World):
    """The way of a mocap body, which the hand hangs on softly, and the effort of the gripper."""

    size, unit = 4, 0.01
    mocap_low, mocap_high, action_scale = -np.ones(3), np.ones(3), 0.01

    def __init__(self) -> None:
        partner = GripperActuator("r", -1.0, 1.0)
        robot = RobotSpec(
            "arm", ("x", "y", "z"), (), "tip", "x", "l", 1.0, -1.0, ("left", "right"), gripper_partners=(partner,)
        )
        self._begin(mujoco.MjModel.from_xml_string(MOCAP), (robot,))
        self.advance(20)

    def set_xyz_action(self, action: np.ndarray) -> None:
        self.data.mocap_pos[0] += self.unit * action

    def step(self, action: Any) -> tuple[Any, ...]:
        entries = np.clip(action, -1.0, 1.0)
        self.set_xyz_action(entries[:3])
        self.data.ctrl[:] = -entries[3]
        self.advance()
        return None, 0.0, False, False, {}

    def policy(self, t: float) -> np.ndarray:
        return np.array([0.3 * math.sin(3.0 * t), 0.0, 0.3 * math.cos(3.0 * t), -1.0])

    def measure_opening(self) -> float:
        return float(np.linalg.norm(self.data.body("left").xpos - self.data.body("right").xpos))


class Fetch(World):
    """The way of the hand from where it is; the gripper's entry is the way of its fingers."""

    size, unit, block_gripper, gripper_extra_height = 4, 0.05, False, (0.0,)
    policy, measure_opening = MetaWorld.policy, MetaWorld.measure_opening

    def __init__(self) -> None:
        MetaWorld.__init__(self)  # type: ignore[arg-type]

    def _set_action(self, action: np.ndarray) -> None:
        self.data.mocap_pos[0] = self.data.body("hand").xpos + self.unit * action[:3]
        self.data.ctrl[:] = np.clip(self.data.qpos[3:5] + action[3], -0.02, 0.03)

    def step(self, action: Any) -> tuple[Any, ...]:
        self._set_action(np.clip(action, -1.0, 1.0))
        self.advance()
        return None, 0.0, False, False, {}


class OgBench(Osc):
    """Way and yaw of the frame, from where it is; the way of the gripper."""

    size = 5

    def __init__(self) -> None:
        super().__init__()
        self._pinch_site_id = int(self.model.site("frame").id)
        self._gripper_opening_joint_id = int(self.model.jnt_qposadr[self.model.joint("left/finger_joint_left").id])
        self.action_high = np.array([0.05, 0.05, 0.05, 0.3, 1.0])
        self.upright = self.read_site("frame")[1]  # rolls and pitches stay

    def unnormalize_action(self, action: np.ndarray) -> np.ndarray:
        return action * self.action_high

    def step(self, action: Any) -> tuple[Any, ...]:
        entries = self.unnormalize_action(np.clip(action, -1.0, 1.0))
        p, q = self.read_site("frame")
        yaw = quat_to_rotvec(quat_mul(q, quat_conj(self.upright)))[2]
        return self.pull(p + entries[:3], quat_mul(quat_from_rotvec((0.0, 0.0, yaw + entries[3])), self.upright))

    def policy(self, t: float) -> np.ndarray:
        return np.array([0.3 * math.sin(3.0 * t), 0.0, 0.3 * math.cos(3.0 * t), 0.0, 0.0])


class JointWays(Osc):
    """As robosuite's JOINT_POSITION: ways of the joints."""

    size, kind = 8, "JOINT_POSITION"

    def __init__(self) -> None:
        super().__init__()
        composite = self.robots_of_suite[0].composite_controller
        composite._action_split_indexes = {"right": (0, 7), "right_gripper": (7, 8)}
        self.robots_of_suite[0].action_dim = 8
        controller = composite.part_controllers["right"]
        controller.input_max, controller.input_min = np.ones(7), -np.ones(7)
        controller.output_max, controller.output_min = np.full(7, 0.05), np.full(7, -0.05)

    def step(self, action: Any) -> tuple[Any, ...]:
        entries = np.clip(action, -1.0, 1.0)
        self.move_gripper(entries[7])
        self.data.ctrl[:7] = self.data.qpos[:7] + 0.05 * entries[:7]
        self.advance()
        return None, 0.0, False, {}

    def policy(self, t: float) -> np.ndarray:
        return np.array([0.3 * math.sin(3.0 * t), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, -1.0])


class Person:
    """Someone who drives the first robot of a world for a while, and the actions of all steps."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.drive = ActionDrive(Suite(world) if type(world).__name__ in OF_SUITE else world, CONFIG)
        self.robot = world.robots[0].name
        self.target: Pose | None = None
        self.share: float | None = None
        self.is_held = False
        self.mine: list[np.ndarray] = []
        self.theirs: list[np.ndarray] = []

    def apply(self, action: Any) -> Any:
        """The action with this person's part in it."""
        world = self.world
        driven = () if self.target is None else (self.robot,)
        targets = {} if self.target is None else {self.robot: self.target}
        shares = {} if self.share is None else {self.robot: self.share}
        held = driven if self.is_held else ()
        return self.drive.apply(action, (world.model, world.data, world.robots), driven, targets, shares, held)

    def step(self) -> Any:
        theirs = self.world.policy(float(self.world.data.time))
        mine = self.apply(theirs)
        self.theirs.append(theirs.copy())
        self.mine.append(np.array(mine))
        self.world.step(mine)
        return mine

    def aim_here(self) -> None:
        """Take over where the robot is."""
        self.target = Pose(*self.world.tip.read_pose(self.world.data))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD)):
            self.step()

    def lead(self, way: tuple[float, float, float] = (0.03, 0.02, 0.034), turn: float = 0.0) -> None:
        """Take over, move the target by `way` [m] within half a second, and turn it about the world's z axis."""
        p, q = self.world.tip.read_pose(self.world.data)
        for i in range(25):
            share = (i + 1) / 25
            x, y, z = (a + share * b for a, b in zip(p, way, strict=True))
            self.target = Pose((x, y, z), quat_mul(quat_from_rotvec((0.0, 0.0, share * turn)), q))
            self.step()

    def measure_miss(self) -> tuple[float, float]:
        """Distance of the tip from its target [m], and angle [rad]."""
        assert self.target is not None
        p, q = self.world.tip.read_pose(self.world.data)
        return math.dist(p, self.target.p), quat_angle(q, self.target.q)

    def largest_steps(self, first: int = 0) -> np.ndarray:
        return np.abs(np.diff(np.array(self.mine[first:]), axis=0)).max(axis=0)


OF_SUITE = ("Osc", "OscAbsolute", "JointWays")
#: Worlds whose action turns the tip about the vertical, and what is left of the turn [rad].
TURNING = {World: 0.01, ByRobot: 0.01, Normalised: 0.01, Osc: 0.01, OscAbsolute: 0.01, JointWays: 0.01, OgBench: 0.05}
WORLDS: tuple[Callable[[], World], ...] = (*TURNING, ShortArm, MetaWorld, Fetch)


@pytest.mark.parametrize("kind", WORLDS)
def test_the_tip_arrives_although_the_environment_is_soft(kind: Callable[[], World]) -> None:
    person = Person(kind())
    person.run(0.4)
    person.lead(turn=0.2 if kind in TURNING else 0.0)
    person.run(3.0)
    miss, angle = person.measure_miss()
    assert miss < 1e-3
    assert angle < TURNING.get(kind, math.inf)  # type: ignore[call-overload]


@pytest.mark.parametrize("kind", WORLDS)
def test_nothing_is_touched_while_the_owner_drives(kind: Callable[[], World]) -> None:
    person = Person(kind())
    for _ in range(5):
        theirs = person.world.policy(float(person.world.data.time))
        given = theirs.copy()
        assert person.apply(theirs) is theirs
        assert np.array_equal(theirs, given)
        person.world.step(theirs)
    assert person.drive.list_interventions(()) == ()


@pytest.mark.parametrize("kind", [World, ByRobot, Normalised])
def test_positions_never_jump(kind: Callable[[], World]) -> None:
    """Neither when a person takes over, nor when the policy has the robot again, which then is far away."""
    person = Person(kind())
    world = person.world
    person.run(0.5)
    person.lead((-0.05, 0.1, 0.15))
    person.share = 1.0
    person.run(0.5)
    assert person.drive.list_interventions(()) == (person.robot,)
    apart = np.abs(person.mine[-1] - person.theirs[-1])
    person.target = None
    person.run(1.5)
    limit = np.full(16, JOINT_STEP) / (world.half if isinstance(world, Normalised) else 1.0)
    limit[[7, 15]] = GRIPPER_STEP * {World: 0.04, ByRobot: 1.0, Normalised: 2.0}[kind]  # type: ignore[index]
    assert (apart[:8] > 3.0 * limit[:8]).any(), "the way back takes several steps"
    assert (person.largest_steps() <= limit + 1e-9).all()
    assert np.array_equal(person.mine[-1], person.theirs[-1])
    assert person.drive.list_interventions(()) == ()
    others = np.arange(8, 16)
    assert np.array_equal(np.array(person.mine)[:, others], np.array(person.theirs)[:, others])


@pytest.mark.parametrize("kind", [Osc, MetaWorld, Fetch, OgBench, JointWays])
def test_ways_stay_within_the_action_space(kind: Callable[[], World]) -> None:
    person = Person(kind())
    person.run(0.2)
    person.lead((0.3, 0.5, -0.2))  # faster than the environment moves
    person.run(0.3)
    entries = np.array(person.mine)
    assert np.abs(entries).max() <= 1.0 + 1e-9
    assert np.abs(entries[10:]).max() > 0.99
    person.target = None
    person.step()
    assert np.array_equal(person.mine[-1], person.theirs[-1])


def test_a_pose_moves_at_the_speed_of_the_tip() -> None:
    person = Person(OscAbsolute())
    person.run(0.2)
    person.lead((0.0, 0.1, 0.1))
    person.run(0.3)
    person.target = None
    person.run(0.5)
    assert person.largest_steps()[:3].max() <= CONFIG.tip_speed * PERIOD + 1e-9
    assert np.array_equal(person.mine[-1], person.theirs[-1])


@pytest.mark.parametrize("kind", [World, ByRobot, Normalised, Osc, MetaWorld, Fetch, JointWays])
def test_a_share_of_one_closes_the_gripper(kind: Callable[[], World]) -> None:
    person = Person(kind())
    person.run(0.2)
    person.lead((0.0, 0.0, 0.02))
    openings = []
    for person.share in (0.0, 1.0, 0.0):
        person.run(1.0)
        openings.append(person.world.measure_opening())
    assert openings[1] < openings[0] - 0.02
    assert openings[2] == pytest.approx(openings[0], abs=5e-3)


def test_a_gripper_stays_as_it_was_without_a_command() -> None:
    person = Person(ByRobot())
    person.world.home[7] = 0.5 * 0.04
    person.run(0.2)
    person.lead()
    person.run(0.2)
    assert person.mine[-1][7] == pytest.approx(0.5)


def test_a_reset_forgets_the_way_back() -> None:
    person = Person(World())
    person.run(0.2)
    person.lead((0.0, 0.1, 0.1))
    mujoco.mj_resetDataKeyframe(person.world.model, person.world.data, 0)
    person.target = None
    person.step()
    assert np.array_equal(person.mine[-1], person.theirs[-1])


@pytest.mark.parametrize("make", [list, tuple, lambda a: a.astype(np.float32)])
def test_the_action_keeps_its_type(make: Callable[[Any], Any]) -> None:
    person = Person(World())
    person.run(0.1)
    person.aim_here()
    person.share, action = 1.0, make(person.world.home)
    mine = person.apply(action)
    assert type(mine) is type(action)
    assert np.asarray(mine).dtype == np.asarray(action).dtype
    assert not np.array_equal(mine, action)


# --- what an action means is proved -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Ways, WaysAndOpening, AboutHome])
@pytest.mark.parametrize("seconds", [0.0, 0.4, 1.0])
def test_nobody_drives_by_entries_that_mean_something_else(kind: Callable[[], World], seconds: float) -> None:
    person = Person(kind())
    person.run(seconds)
    assert person.drive.list_warnings() == ()
    person.lead()
    person.run(1.0)
    assert np.array_equal(person.mine, person.theirs)
    assert person.drive.list_interventions(("left",)) == ()
    (warning,) = person.drive.list_warnings()
    assert "'left'" in warning
    assert "\n" not in warning
    person.target = None
    person.step()
    assert person.drive.list_warnings() == ()


def test_a_driven_step_disproves_what_equal_values_had_proved() -> None:
    person = Person(Swapped())
    world = person.world
    other = [int(world.model.joint(name).qposadr[0]) for name in world.robots[1].joints]
    person.run(0.4)
    stood = world.data.qpos[other].copy()
    person.lead((0.0, 0.15, 0.1))
    assert person.drive.list_interventions(("left",)) == ()
    person.target = None
    person.run(1.0)
    person.lead((0.0, 0.15, 0.1))
    moved = np.abs(world.data.qpos[other] - stood).max()
    assert moved < 2.0 * CONFIG.joint_velocity * world.model.opt.timestep
    (warning,) = person.drive.list_warnings()
    assert "'left'" in warning


def test_a_person_does_not_leave_the_action_space() -> None:
    world = World()
    person = Person(world)
    world.action_space = Space(low=world.home - 0.05, high=world.home + 0.05)  # type: ignore[attr-defined]
    world.policy = lambda t: world.home  # type: ignore[method-assign]
    person.run(0.2)
    person.lead((0.0, 0.2, 0.2))
    ways = np.array(person.mine) - world.home
    assert np.abs(ways).max() == pytest.approx(0.05)


def test_an_action_of_whole_numbers_is_not_rounded() -> None:
    world = ByRobot()
    person = Person(world)
    world.policy = lambda t: np.zeros(16, int)  # type: ignore[method-assign]
    person.run(0.4)
    person.lead((0.0, 0.02, 0.02))
    ways = person.largest_steps()
    assert 0.0 < ways.max() <= 1.01 * max(JOINT_STEP, GRIPPER_STEP)


def test_a_robot_is_driven_once_the_action_says_something() -> None:
    """Zeros fit all meanings. The robot does not leap to a target that has gone ahead meanwhile."""
    world = World()
    home, world.home = world.home, np.zeros(16)
    world.policy = lambda t: world.home  # type: ignore[method-assign]
    person = Person(world)
    person.run(3.0)
    person.lead()
    person.run(0.5)
    assert np.array_equal(person.mine, person.theirs)
    world.home = home
    person.run(3.0)
    assert np.array_equal(person.mine, person.theirs)
    person.aim_here()
    person.run(0.1)
    assert person.drive.list_interventions(("left",)) == ("left",)
    assert person.drive.list_warnings() == ()


def test_a_proof_holds_for_the_next_episode_and_not_for_ever() -> None:
    world = World()
    person = Person(world)
    person.run(0.2)
    mujoco.mj_resetDataKeyframe(world.model, world.data, 0)
    mujoco.mj_forward(world.model, world.data)
    person.aim_here()
    person.step()
    assert person.drive.list_interventions(()) == ("left",)
    person.target = None
    person.run(2.0)
    world.step = lambda action: World.step(world, 0.5 * np.asarray(action))  # type: ignore[method-assign]
    person.run(1.0)
    person.aim_here()
    assert np.array_equal(person.step(), person.theirs[-1])


def test_actions_beyond_the_range_of_ctrl() -> None:
    """Environments clip them; where nothing else is said, this proves nothing."""
    world = World()
    low, high = world.model.actuator_ctrlrange.T
    world.step = lambda action: World.step(world, np.clip(action, low, high))  # type: ignore[method-assign]
    beyond, home = high + 1.0, world.home
    person, world.home = Person(world), beyond
    world.policy = lambda t: world.home  # type: ignore[method-assign]
    person.run(0.4)
    person.aim_here()
    assert np.array_equal(person.step(), person.theirs[-1])
    person.target, world.home = None, np.where(np.arange(16) % 8 < 3, home, beyond)
    person.run(0.4)
    person.aim_here()
    person.step()
    assert person.drive.list_interventions(()) == ("left",)


# --- against an obstacle ----------------------------------------------------------------------------------------------


def test_a_push_is_bounded_and_a_hold_gives_it_up() -> None:
    world = Blocked()
    person = Person(world)
    person.run(3.0)
    person.aim_here()
    person.run(2.0)
    rest = world.measure_push(person.mine[-1])
    world.is_blocked = True
    (x, y, z), q = world.tip.read_pose(world.data)
    person.target = Pose((x, y, z + 0.04), q)
    person.run(3.0)
    push = world.measure_push(person.mine[-1]) - rest
    assert 0.03 < push[2] < 0.04 + 0.011
    person.target, person.is_held = Pose((x, y, z), q), True
    person.run(2.0)
    assert np.linalg.norm(world.measure_push(person.mine[-1]) - rest) < 1e-3
    world.is_blocked = False
    person.run(0.5)
    assert math.dist(world.tip.read_pose(world.data)[0], (x, y, z)) < 1e-3


@pytest.mark.parametrize("kind", [World, Osc, MetaWorld, Fetch, OgBench])
def test_a_robot_that_has_arrived_stays_in_a_hold(kind: Callable[[], World]) -> None:
    person = Person(kind())
    person.run(0.4)
    person.lead()
    person.run(3.0)
    person.is_held = True
    for _ in range(100):
        person.step()
        assert person.measure_miss()[0] < 1e-3


# --- resets -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [World, Osc, MetaWorld])
@pytest.mark.parametrize("is_reset", [True, False])
def test_a_robot_whose_place_is_not_known_is_the_owners(kind: Callable[[], World], *, is_reset: bool) -> None:
    """After a reset without `mj_forward`, and where physics diverged."""
    person = Person(kind())
    world = person.world
    person.run(0.1)
    person.lead()
    if is_reset:
        mujoco.mj_resetData(world.model, world.data)
    else:
        world.data.xpos[:] = math.nan
    theirs = world.policy(0.0)
    assert person.apply(theirs) is theirs
    assert person.drive.list_interventions(()) == ()


def test_arms_are_compiled_once_for_a_model(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    compiled: list[str] = []

    def compile_arm(model: mujoco.MjModel, robot: RobotSpec) -> ArmModel:
        compiled.append(robot.name)
        return ArmModel(model, robot)

    monkeypatch.setattr("iris_session.session.actions.ArmModel", compile_arm)
    world = World()
    world.model.actuator_biasprm[8, 1] = 0.0  # the second arm has no position servo
    person = Person(world)
    for i in range(4):
        person.run(0.1)
        if i == 2:
            world.data = mujoco.MjData(world.model)
        mujoco.mj_resetDataKeyframe(world.model, world.data, 0)
    assert compiled == ["left"]
    assert [record.getMessage() for record in caplog.records] == ["not moved by the action of World: right"]


def test_another_model_that_no_adapter_fits_does_not_end_the_loop(caplog: pytest.LogCaptureFixture) -> None:
    """A participant may have asked for the reset."""
    person = Person(World())
    person.run(0.1)
    person.lead()
    person.world, person.robot = MetaWorld(), "arm"
    person.world.size = 16
    person.aim_here()
    theirs = np.zeros(16)
    for _ in range(2):
        assert person.apply(theirs) is theirs
    assert len(person.drive.list_warnings()) == 1
    assert sum("no adapter fits" in record.getMessage() for record in caplog.records) == 1


def test_an_action_that_no_adapter_fits() -> None:
    person = Person(World())
    with pytest.raises(ConfigError, match=r"\(1, 16\)"):
        person.apply(np.zeros((1, 16)))
    person.drive = ActionDrive(Space(action_space="Discrete(5)"), CONFIG)
    with pytest.raises(ConfigError, match=r"Discrete\(5\).*session\.targets\(\)") as error:
        person.apply(np.zeros(5))
    assert "\n" not in str(error.value)


# --- in a session -----------------------------------------------------------------------------------------------------


@pytest.fixture
def rig() -> Iterator[Rig]:
    rig = Rig(control=CONFIG)
    yield rig
    rig.loop.close()


class Program:
    """An environment around the data of a loop, and its attachment."""

    result: tuple[Any, ...] = (None, 0.0, False, [1])

    def __init__(self, rig: Rig) -> None:
        self.rig, self.model, self.data = rig, rig.model, rig.data
        self.replaced: tuple[str, ...] = ()
        self.attach()

    def attach(self) -> None:
        self.attachment = Attachment(self.rig.loop, self, "step", lambda model, data: None, self.list_interventions)

    def list_interventions(self, driven: Sequence[str]) -> tuple[str, ...]:
        return tuple({*driven, *self.replaced})

    def step(self) -> Any:
        mujoco.mj_step(self.model, self.data)
        return self.result


@pytest.fixture
def program(rig: Rig) -> Iterator[Program]:
    program = Program(rig)
    yield program
    program.attachment.close()


@pytest.mark.parametrize("result", [(None, 0.0, False, False, {"a": 1}), (None, 0.0, False, {"a": 1})])
def test_info_says_who_was_driven(program: Program, result: tuple[Any, ...]) -> None:
    program.result = result
    assert program.step()[-1] == {"a": 1, "intervention": ()}
    program.attachment.close()  # rounds of the rig
    ann = take_over(program.rig)
    program.attach()
    *head, info = program.step()
    assert head == list(result[:-1])
    assert info == {"a": 1, "intervention": ("left",)}
    assert result[-1] == {"a": 1}, "the environment's own is not changed"
    ann.release()
    program.step()
    assert program.rig.loop.driven == ()
    program.replaced = ("left",)  # on its way back
    assert program.step()[-1]["intervention"] == ("left",)
    program.replaced = ()
    assert program.step()[-1]["intervention"] == ()


def test_results_without_info_stay_as_they_are(program: Program) -> None:
    assert program.step() is program.result


def test_grippers_follow_the_person_without_a_jump(rig: Rig) -> None:
    """Until then they are what the owner's `ctrl` commands, and nothing is written."""
    rig.data.ctrl[7] = 0.01
    rig.round()
    read = rig.stepper.core.controller.get_grippers
    assert read()["left"] == pytest.approx(0.75)
    ann = take_over(rig)
    seen = [read()["left"]]
    assert seen == pytest.approx([0.75])
    here = ann.tip()
    for closed in (0.0, 1.0):
        ann.gripper = closed
        for _ in range(40):
            ann.drive(lambda t: here, 0.014)
            assert rig.loop.driven == ("left",)
            seen.append(read()["left"])
        assert seen[-1] == closed
    assert np.abs(np.diff(seen)).max() <= CONFIG.gripper_speed * 0.014 + 1e-9
    assert rig.data.ctrl[7] == 0.01


@pytest.mark.usefixtures("simulation")
def test_a_session_without_participants_returns_the_action_itself() -> None:
    world = World()
    with iris_session.share(world, config=QUIET, drive="action") as session:
        action = world.policy(0.0)
        assert session.action(action) is action
        assert world.step(action)[-1] == {"success": False, "intervention": ()}
        assert session.grippers() == pytest.approx({"left": 0.0, "right": 0.0}, abs=1e-6)
        with pytest.raises(ConfigError, match="array of 3 numbers"):
            session.action(np.zeros(3))
    with iris_session.share(world, config=QUIET) as session, pytest.raises(ConfigError, match='drive="action"'):
        session.action(action)


def test_a_hold_is_known(rig: Rig) -> None:
    controller = rig.stepper.core.controller
    ann = take_over(rig)
    assert controller.list_held() == ["right"]
    here = ann.tip()
    ann.drive(lambda t: here, 0.02, clutch=False)
    assert rig.loop.driven == ("left",)
    assert controller.list_held() == ["left", "right"]


@pytest.mark.usefixtures("simulation")
def test_a_simulation_that_sync_shows_keeps_its_action(
    model: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """As MuJoCo Playground: a model, and states that JAX has."""
    action = np.zeros((4, 16))
    with iris_session.share(Space(mj_model=model), config=QUIET, drive="action") as session:
        assert session.action(action) is action
        sources = session.processes.reporter.warning_sources
        before = len(caplog.records), [text for source in sources for text in source()]
        monkeypatch.setattr(UserLoop, "driven", ("left",))
        for _ in range(2):
            assert session.action(action) is action
        assert len(caplog.records) == before[0] + 1
        assert len([text for source in sources for text in source()]) == len(before[1]) + 1
        monkeypatch.setattr(UserLoop, "driven", ())
        assert [text for source in sources for text in source()] == before[1]


@pytest.mark.usefixtures("simulation")
def test_a_person_who_engages_does_not_break_the_loop(monkeypatch: pytest.MonkeyPatch) -> None:
    """The meaning of this action is not proved yet, and the session says so."""
    world = World()
    with iris_session.share(world, config=QUIET, drive="action") as session:
        sources = session.processes.reporter.warning_sources
        monkeypatch.setattr(UserLoop, "driven", ("left",))
        action = world.policy(0.0)
        assert session.action(action) is action
        assert [text for source in sources for text in source() if "'left'" in text]
