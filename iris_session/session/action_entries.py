"""Entries of robots in the action of an environment: what they mean, and what to write there for a target.

The entries of an arm are one of

- `TipEntries`: the way of a frame of the end effector, from where it is or from where it was commanded; or its pose;
- `JointEntries`: joint positions, or the way to them. Inverse kinematics is solved here, on the arm alone.

Which entries a robot has: `actions`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final, NamedTuple, Protocol

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from anchors.pose import (
    IDENTITY_POSE,
    PoseTuple,
    Quat,
    compose,
    distance,
    inverse,
    quat_conj,
    quat_from_rotvec,
    quat_mul,
    quat_normalize,
    quat_rotate,
    quat_to_rotvec,
)
from iris_session.control.arm_model import ArmModel, Floats
from iris_session.control.clutch import step_toward
from iris_session.control.config import ControlConfig
from iris_session.control.interpolate import read_speed_limits
from iris_session.control.solvers import NumpySolver
from iris_session.physics.tip import Tip
from iris_session.protocol.common import Pose
from iris_session.protocol.specs import RobotSpec
from iris_session.session.simulation import Simulation

#: What is missing to a target at rest is added to what is commanded with this time constant [s], less while the target
#: moves at such a speed [m/s],
SETTLE_S: Final = 0.4
REST_SPEED: Final = 0.03
#: where it is not more than that [m, rad], up to this lead,
NEAR: Final = (0.05, 0.3)
MAX_LEAD: Final = (0.05, 0.3)
#: of which so much is added while the end effector stands still, as against an obstacle.
MAX_PUSH: Final = (0.01, 0.06)
#: The end effector has moved when it is so far from where it was [m, rad], and is at a target that is so near.
MOVED: Final = (0.003, 0.02)
ARRIVED: Final = (0.001, 0.01)
#: Time constant with which a hold gives up what was added against an obstacle [s].
RELEASE_S: Final = 0.3
#: `ctrl` is what an action means when it is no farther from that, as a share of the value or of one: rounding to
#: 32 bits, with a margin. An entry that commands less than `TELLING` says nothing.
ROUNDING: Final = 1e-5
TELLING: Final = 0.01
#: Share of a stroke that a gripper which only opens and closes may be off.
GRIPPER_DEAD_BAND: Final = 0.15
#: Passes of inverse kinematics per step.
IK_PASSES: Final = 6


class ArmEntries(Protocol):
    """The entries of one arm in the action. They move a frame of the arm, which need not be its end effector."""

    #: About how many axes they turn the frame: 3, 1 (the z axis of the world) or 0.
    turns: int

    def read_pose(self) -> PoseTuple:
        """Return where the frame is, in the world."""
        ...

    def read_commanded(self, before: Floats | None) -> PoseTuple:
        """Return where the frame is commanded to, by the newest action `before`, if that is known."""
        ...

    def write(self, action: Floats, before: Floats | None, T_world_frame: PoseTuple, period: float) -> None:
        """Write what moves the frame to `T_world_frame` within a step of `period` [s], or on the way to it."""
        ...

    def return_to(self, action: Floats, before: Floats, period: float) -> bool:
        """Bound the owner's entries by what the newest action commands; return whether they were reached."""
        ...


class GripperEntry(NamedTuple):
    """The entry of one gripper: `at` its place. Values of `open` and `closed`.

    `read_share`: how far the gripper is closed now; for entries that say a way from there. `toggles`: only the sign of
    the way counts. `paces`: the value may not jump.
    """

    at: int
    open: float
    closed: float
    read_share: Callable[[], float] | None = None
    toggles: bool = False
    paces: bool = False

    def write(self, action: Floats, before: Floats | None, share: float | None, stroke: float) -> None:
        """Write what closes the gripper to `share`; `stroke`: most of it in this step. `None`: as it was."""
        if share is None:
            if before is not None:
                action[self.at] = before[self.at]
            return
        way = self.closed - self.open
        if self.read_share is not None:
            missing = share - self.read_share()
            if self.toggles:
                rests = abs(missing) < GRIPPER_DEAD_BAND and 0.0 < share < 1.0
                missing = 0.0 if rests else math.copysign(1.0, missing if 0.0 < share < 1.0 else share - 0.5)
            action[self.at] = 0.5 * (self.open + self.closed) + way * min(max(missing, -1.0), 1.0) * 0.5
            return
        action[self.at] = self.open + way * share
        if before is not None:
            self.return_to(action, before, stroke)

    def return_to(self, action: Floats, before: Floats, stroke: float) -> bool:
        """Bound the entry by what the newest action has; return whether it is as it was."""
        if not self.paces:
            return True
        theirs, most = float(action[self.at]), abs(self.closed - self.open) * stroke
        action[self.at] = min(max(theirs, before[self.at] - most), before[self.at] + most)
        return bool(action[self.at] == theirs)


class CtrlReading(NamedTuple):
    """Meaning that entries of a robot are taken for: `ctrl[at] = action[at] * scale + offset`, within `low` and `high`.

    Joints come first, then grippers: shape (n,). `qpos`: addresses of the joints, `slope` and `shift` of the `ctrl`
    that holds each where it is, shape (n_joints,).
    """

    at: NDArray[np.intp]
    qpos: NDArray[np.intp]
    slope: Floats
    shift: Floats
    scale: Floats
    offset: Floats
    low: Floats
    high: Floats

    def compare(self, action: Floats, ctrl: Floats, qpos_before: Floats, ctrl_before: Floats) -> bool | None:
        """Return whether `ctrl` after a step is what `action` was taken for; `None` if it is, but proves nothing.

        Other meanings are ways from where the joints were, or from their command before: what an action says counts
        only where it differs from these, is not about zero, and within the range.
        """
        way = action[self.at] * self.scale
        meant, value = way + self.offset, ctrl[self.at]
        bounded = np.clip(meant, self.low, self.high)
        off = np.minimum(np.abs(value - meant), np.abs(value - bounded))
        if not (off <= ROUNDING * np.maximum(1.0, np.maximum(np.abs(meant), np.abs(self.offset)))).all():
            return False
        n = len(self.qpos)
        is_telling = ((np.abs(way) > TELLING) & (meant > self.low) & (meant < self.high))[:n]
        for other in (qpos_before[self.qpos] * self.slope + self.shift, ctrl_before[self.at][:n]):
            is_telling &= np.abs(self.offset[:n] - other) > TELLING
        return True if is_telling.any() else None


class RobotEntries(NamedTuple):
    """Entries of one robot in the action. `reading`: a guess, which steps of the environment have to prove."""

    arm: ArmEntries
    grippers: tuple[GripperEntry, ...] = ()
    reading: CtrlReading | None = None


class TipEntries:
    """`ArmEntries` that move a frame of the end effector.

    Args:
        at: Places of x, y, z and, where they turn the frame, of a rotation vector or of the yaw alone.
        read_pose: Returns where the frame is, in the world.
        unit: Way [m or rad] of an entry of one, shape of `at`.
        limits: Least and greatest entries.
        read_axes: Returns `T_world_axes`, the frame in which entries are given; `None` for the world.
        read_goal: Returns the pose from which the ways count, if that is not where the frame is.
        absolute_speeds: Entries are a pose in the axes, not a way; how fast it may move [m/s, rad/s].
    """

    def __init__(
        self,
        at: Sequence[int],
        read_pose: Callable[[], PoseTuple],
        unit: Any = 1.0,
        limits: tuple[Any, Any] = (-math.inf, math.inf),
        *,
        read_axes: Callable[[], PoseTuple] | None = None,
        read_goal: Callable[[], PoseTuple] | None = None,
        absolute_speeds: tuple[float, float] | None = None,
    ) -> None:
        self.at = np.array(at, np.intp)
        self.turns = len(at) - 3
        self.read_pose = read_pose
        self._unit, self._low, self._high = (np.broadcast_to(v, len(at)) for v in (unit, *limits))
        self._read_axes, self._read_goal, self._speeds = read_axes, read_goal, absolute_speeds

    def read_commanded(self, before: Floats | None) -> PoseTuple:
        if self._speeds is not None and before is not None:
            return self._decode(before)
        return self.read_pose() if self._read_goal is None else self._read_goal()

    def write(self, action: Floats, before: Floats | None, T_world_frame: PoseTuple, period: float) -> None:
        now = self.read_commanded(before)
        if self._speeds is not None:
            T = step_toward(now, T_world_frame, self._speeds[0] * period + 1e-9, self._speeds[1] * period + 1e-9)
            action[self.at] = self._encode(T, before)
            return
        q_axes = (1.0, 0.0, 0.0, 0.0) if self._read_axes is None else self._read_axes()[1]
        way = measure_way(now, T_world_frame)
        way = np.concatenate([_turn(quat_conj(q_axes), way[:3]), _turn(quat_conj(q_axes), way[3:])])
        entries = (way[[0, 1, 2, 5]] if len(self.at) == 4 else way[: len(self.at)]) / self._unit
        excess = np.maximum(entries / self._high, entries / self._low)
        for part in (slice(0, 3), slice(3, None)):  # shorter, in the same direction
            entries[part] /= max(1.0, float(excess[part].max(initial=0.0)))
        action[self.at] = entries

    def return_to(self, action: Floats, before: Floats, period: float) -> bool:
        if self._speeds is None:
            return True
        theirs = self._decode(action)
        T = step_toward(self._decode(before), theirs, self._speeds[0] * period, self._speeds[1] * period)
        if T is not theirs:
            action[self.at] = self._encode(T, before)
        return T is theirs

    def _encode(self, T_world_frame: PoseTuple, before: Floats | None) -> Floats:
        p, q = T_world_frame if self._read_axes is None else compose(inverse(self._read_axes()), T_world_frame)
        turn = np.array(quat_to_rotvec(q))
        if self.turns and before is not None:  # half a turn has two rotation vectors
            other = turn * (1.0 - 2.0 * math.pi / max(float(np.linalg.norm(turn)), 1e-9))
            turn = min(turn, other, key=lambda one: float(np.linalg.norm(one - before[self.at[3:]])))
        return np.array([*p, *turn])[: len(self.at)]

    def _decode(self, action: Floats) -> PoseTuple:
        x, y, z, *turn = action[self.at].tolist()
        if not turn:
            return (self._to_world(((x, y, z), (1.0, 0.0, 0.0, 0.0)))[0], self.read_pose()[1])
        return self._to_world(((x, y, z), quat_from_rotvec((turn[0], turn[1], turn[2]))))

    def _to_world(self, T_axes_frame: PoseTuple) -> PoseTuple:
        return T_axes_frame if self._read_axes is None else compose(self._read_axes(), T_axes_frame)


class JointEntries:
    """`ArmEntries` that are joint positions, `entry = q * scale + offset`, or ways to them, `entry = way * scale`.

    Args:
        robot, simulation: Whose joints they are.
        config: Bounds of control.
        at: Places of the joints, in their order.
        law: Scale and offset, shape (n,) or one number each.
        limits: Joint positions, or entries that are ways, lower and upper.
        is_way: Entries are ways from the measured positions.
        arm: The robot's kinematic chain, where it was compiled before.
    """

    turns = 3

    def __init__(
        self,
        robot: RobotSpec,
        simulation: Simulation,
        config: ControlConfig,
        at: Sequence[int],
        law: tuple[Any, Any] = (1.0, 0.0),
        limits: tuple[Any, Any] = (-math.inf, math.inf),
        *,
        is_way: bool = False,
        arm: ArmModel | None = None,
    ) -> None:
        model, data = simulation
        self._data: Any = data
        self.at = np.array(at, np.intp)
        self._scale, self._offset = (np.broadcast_to(part, len(at)) for part in law)
        self._arm, self._tip = arm or ArmModel(model, robot), Tip(model, robot)
        self._qpos = np.array([model.jnt_qposadr[j] for j in self._arm.joint_ids], np.intp)
        ids = np.array(self._arm.joint_ids, np.intp)
        limited, ranges = model.jnt_limited[ids].astype(bool), model.jnt_range[ids]
        self._low = np.where(limited, ranges[:, 0], -np.inf)
        self._high = np.where(limited, ranges[:, 1], np.inf)
        if not is_way:
            self._low, self._high = np.maximum(self._low, limits[0]), np.minimum(self._high, limits[1])
        self._way_limits, self._is_way = [np.broadcast_to(limit, len(at)) for limit in limits], is_way
        own = {name: v for name, v in config.velocity_limits.items() if name in robot.joints}
        config = msgspec.structs.replace(config, velocity_limits=own, acceleration_limits={})
        self._speed = read_speed_limits(model, [robot], [self._arm], config)[0]
        self._solver = NumpySolver(self._arm, config)
        self._rest = self._q = self._measure()

    def read_pose(self) -> PoseTuple:
        return self._tip.read_pose(self._data)

    def read_commanded(self, before: Floats | None) -> PoseTuple:
        self._q = self._measure() if before is None or self._is_way else self._decode(before)
        self._rest = self._q.copy()
        return compose(self._read_root(), self._arm.forward_kinematics(self._q))

    def write(self, action: Floats, before: Floats | None, T_world_frame: PoseTuple, period: float) -> None:
        start = self._q if before is None or self._is_way else self._decode(before)
        most = self._speed * period
        # A joint outside its range may stay there, and may come back; it is never thrown back.
        low = np.minimum(np.maximum(self._low, start - most), start)
        high = np.maximum(np.minimum(self._high, start + most), start)
        if self._is_way:
            now, ends = self._measure(), np.sort(np.array(self._way_limits) / self._scale, axis=0)
            low, high = np.clip((low, high), now + ends[0], now + ends[1])
        T_root_target = compose(inverse(self._read_root()), T_world_frame)
        q = np.clip(start, low, high)
        for _ in range(IK_PASSES):
            q = self._solver.step(q, self._rest, T_root_target, low - q, high - q).q
        self._q = q
        action[self.at] = (q - now) * self._scale if self._is_way else q * self._scale + self._offset

    def return_to(self, action: Floats, before: Floats, period: float) -> bool:
        if self._is_way:
            return True
        most = np.abs(self._scale) * self._speed * period
        theirs = action[self.at]
        action[self.at] = np.clip(theirs, before[self.at] - most, before[self.at] + most)
        return bool(np.array_equal(action[self.at], theirs))

    def _decode(self, action: Floats) -> Floats:
        q: Floats = (action[self.at] - self._offset) / self._scale
        return q

    def _measure(self) -> Floats:
        q: Floats = self._data.qpos[self._qpos]
        return q

    def _read_root(self) -> PoseTuple:
        return read_body_pose(self._data, self._arm.root_body)


class RobotDrive:
    """One robot: from the target of its end effector to its entries in the action, and back to the owner's.

    Attributes:
        reading: What has to be proved of the entries, `None` where they are known.
        is_returning: No participant drives it any more, but its entries are not the owner's yet.
    """

    def __init__(self, entries: RobotEntries, tip: Tip, data: mujoco.MjData, config: ControlConfig) -> None:
        self._entries, self._tip, self._data = entries, tip, data
        self._stroke = config.gripper_speed
        self.reading = entries.reading
        self.forget()

    def forget(self) -> None:
        """Let the entries be the owner's at once, as after a reset."""
        #: Lead of what is commanded over where the frame is to go [m, rad], None while the owner drives; how much of
        #: it is not a push against something, and where the end effector was when that was found.
        self._lead: Floats | None = None
        self._carry: Floats = np.zeros(6)
        self._stood: PoseTuple = IDENTITY_POSE
        self._target: PoseTuple = IDENTITY_POSE
        self._misses = [True, True]  # the target, before a hold: in place, in turn
        self.is_returning = False

    def has_pose(self) -> bool:
        """Return whether the data says where the robot is: not after a reset until MuJoCo has computed it."""
        p, q = self._data.xpos[self._tip.body], self._data.xquat[self._tip.body]
        return bool(np.isfinite(p).all() and np.isfinite(q).all() and q.any())

    def is_near(self, target: Pose) -> bool:
        """Return whether the end effector is where a target would hardly move it."""
        return _is_within(measure_way(self._tip.read_pose(self._data), (target.p, target.q)), MAX_PUSH)

    def drive(
        self,
        action: Floats,
        before: Floats | None,
        target: Pose,
        share: float | None,
        period: float,
        *,
        is_held: bool = False,
    ) -> None:
        """Replace the robot's entries by those that follow `target`, `T_world_tip`, with the gripper at `share`.

        `is_held`: the clutch is open.
        """
        arm, T_tip, T_target = self._entries.arm, self._tip.read_pose(self._data), (target.p, target.q)
        T_frame, way = arm.read_pose(), measure_way(T_tip, T_target)
        if self._lead is None:  # what is commanded now goes on
            lead = _limit(measure_way(T_frame, arm.read_commanded(before)), MAX_LEAD)
            self._lead = self._carry = lead
            self._target, self._stood = T_target, T_tip
        self._lead = self._settle(self._lead, T_tip, T_target, way, period, is_held)
        self._target, self.is_returning = T_target, True
        if arm.turns == 3:
            T_goal = compose(compose(T_target, inverse(T_tip)), T_frame)
        else:
            T_goal = move(T_frame, way * (1.0, 1.0, 1.0, 0.0, 0.0, arm.turns))
        arm.write(action, before, move(T_goal, self._lead), period)
        for gripper in self._entries.grippers:
            gripper.write(action, before, share, self._stroke * period)

    def _settle(
        self, lead: Floats, T_tip: PoseTuple, T_target: PoseTuple, way: Floats, period: float, is_held: bool
    ) -> Floats:
        """Return the lead with what is missing of `way` added to it, and without a push that a hold gives up."""
        moved = measure_way(self._stood, T_tip)
        if not _is_within(moved, MOVED):
            self._stood = T_tip
            self._carry = self._carry + _limit(lead - self._carry, _measure_parts(moved))
        if is_held:
            lead = lead + (self._carry - lead) * np.repeat(self._misses, 3) * min(1.0, period / RELEASE_S)
        else:
            self._misses = [part > most for part, most in zip(_measure_parts(way), ARRIVED, strict=True)]
        speed = distance(T_target[0], self._target[0]) / period
        share_s = period / SETTLE_S / (1.0 + (speed / REST_SPEED) ** 2)
        near = [part < most for part, most in zip(_measure_parts(way), NEAR, strict=True)]
        lead = lead + way * np.repeat(near, 3) * share_s
        return _limit(self._carry + _limit(lead - self._carry, MAX_PUSH), MAX_LEAD)

    def give_back(self, action: Floats, before: Floats, period: float) -> None:
        """Let the entries become the owner's, no faster than the robot may move."""
        self._lead = None
        done = self._entries.arm.return_to(action, before, period)
        for gripper in self._entries.grippers:
            done = gripper.return_to(action, before, self._stroke * period) and done
        self.is_returning = not done


def measure_way(T_from: PoseTuple, T_to: PoseTuple) -> Floats:
    """Return the way between two poses, in their common frame: translation [m], rotation vector [rad], shape (6,)."""
    turn = quat_to_rotvec(quat_mul(T_to[1], quat_conj(T_from[1])))
    return np.array([*(b - a for a, b in zip(T_from[0], T_to[0], strict=True)), *turn])


def move(T: PoseTuple, way: Floats) -> PoseTuple:
    """Return a pose that was moved by a way: the inverse of `measure_way`."""
    x, y, z, *turn = way.tolist()
    (a, b, c), q = T
    return ((a + x, b + y, c + z), quat_normalize(quat_mul(quat_from_rotvec((turn[0], turn[1], turn[2])), q)))


def read_body_pose(data: mujoco.MjData, body: int) -> PoseTuple:
    """Return the pose of a body in the world."""
    (x, y, z), (w, i, j, k) = data.xpos[body].tolist(), data.xquat[body].tolist()
    return ((x, y, z), (w, i, j, k))


def _turn(q: Quat, vector: Floats) -> tuple[float, float, float]:
    x, y, z = vector.tolist()
    return quat_rotate(q, (x, y, z))


def _measure_parts(way: Floats) -> tuple[float, float]:
    """Return how far a way leads [m] and turns [rad]."""
    return float(np.linalg.norm(way[:3])), float(np.linalg.norm(way[3:]))


def _is_within(way: Floats, most: tuple[float, float]) -> bool:
    return all(part <= limit for part, limit in zip(_measure_parts(way), most, strict=True))


def _limit(way: Floats, most: tuple[float, float]) -> Floats:
    shares = [min(1.0, limit / max(part, 1e-12)) for limit, part in zip(most, _measure_parts(way), strict=True)]
    limited: Floats = way * np.repeat(shares, 3)
    return limited
