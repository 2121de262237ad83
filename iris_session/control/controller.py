"""Commands to `ctrl`: one object that composes clutch, inverse kinematics, interpolation, grippers, grasps and limits.

`begin` reads the decision of a step (no physics, may be followed by no tick); `tick` moves everything by one physics
tick and writes `data.ctrl` of its own robots and wrenches of grasped objects, nothing else. Time is counted in ticks.
No clock, no randomness; the whole memory is in `snapshot()`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from anchors.pose import PoseTuple
from iris_session.control import clutch
from iris_session.control.actuators import ActuatorLaws, Grippers
from iris_session.control.arm_model import ArmModel, Floats, find_arm, has_moving_base, read_joint_ranges
from iris_session.control.clutch import compute_leader_goal, is_ramping
from iris_session.control.config import OUTPUT_CTRL, ControlConfig, ControlError
from iris_session.control.grasp import Grasps
from iris_session.control.hold import HoldLaw
from iris_session.control.ik import InverseKinematics
from iris_session.control.interpolate import JointInterpolator, read_speed_limits
from iris_session.control.proximity import Motion, ProximityLimiter, SpeedFactors
from iris_session.control.sag import SAG, SagCompensation
from iris_session.control.state import ControllerState, RobotControlState, decode_state, encode_state
from iris_session.physics.tip import Tip
from iris_session.protocol.common import Applied, Pose
from iris_session.protocol.names import CommandKind
from iris_session.protocol.specs import HAND, ObjectSpec, RobotSpec
from iris_session.protocol.steps import Command, ControlStatus, Decision, WorldView

#: Share of the bounds of an end-effector target that is no push when a hold begins; a lead that is as good as none.
_DEAD_BAND: Final = 0.05
_TINY: Final = 1e-6


class RobotOutput(NamedTuple):
    """Actuators whose `ctrl` one robot's control writes, joints first, then the gripper; none without `ctrl` output.

    `rates`: how fast each `ctrl` may change [1/s]; infinite for torques.
    """

    actuators: NDArray[np.intp]
    rates: Floats


def check_robot(model: mujoco.MjModel, robot: RobotSpec, config: ControlConfig) -> None:
    """Raise `ControlError` for a robot that cannot be driven as described. Compiles nothing."""
    find_arm(model, robot)
    if config.output == OUTPUT_CTRL:
        ActuatorLaws(model, [robot], config)


class Controller:
    """Controller of all robots: turns one `Command` per robot and step into `ctrl` for every tick."""

    def __init__(
        self,
        model: mujoco.MjModel,
        robots: Sequence[RobotSpec],
        objects: Sequence[ObjectSpec] = (),
        config: ControlConfig | None = None,
    ) -> None:
        """Raise `ControlError` for robots, actuators or objects that cannot be driven, `ImportError` for the solver of
        a recording that is not installed.
        """
        self._model = model
        self._config = config or ControlConfig()
        self._robots = tuple(robots)
        self._dt = float(model.opt.timestep)
        self._index = {robot.name: i for i, robot in enumerate(self._robots)}
        self._arms = [ArmModel(model, robot) for robot in self._robots]
        self._moving_bases = [i for i, arm in enumerate(self._arms) if has_moving_base(model, arm.root_body)]
        bounds = np.cumsum([0, *(len(robot.joints) for robot in self._robots)])
        self._columns = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds)]
        self._qpos = np.array([model.jnt_qposadr[j] for arm in self._arms for j in arm.joint_ids], dtype=np.intp)
        self._writes_ctrl = self._config.output == OUTPUT_CTRL
        # Without ctrl output the environment drives the actuators: any kind will do.
        driven = self._robots if self._writes_ctrl else ()
        self._laws = ActuatorLaws(model, driven, self._config)
        self._bounds = (self._laws.lower, self._laws.upper) if driven else read_joint_ranges(model, self._arms)
        speeds = read_speed_limits(model, self._robots, self._arms, self._config)
        self._joints = JointInterpolator(*speeds, self._dt, one_way=self._config.proximity_stopped)
        dof = np.array([model.jnt_dofadr[j] for arm in self._arms for j in arm.joint_ids], dtype=np.intp)
        self._hold: HoldLaw | None = None
        if self._writes_ctrl:
            self._hold = HoldLaw(self._joints, self._laws.servos, self._qpos, dof, self._config)
        self._sag: SagCompensation | None = None
        if self._hold is not None and self._config.compensate_sag:
            self._sag = SagCompensation(self._joints, self._hold, self._columns)
        self._ik = InverseKinematics(self._robots, self._arms, self._columns, self._joints, self._bounds, self._config)
        commanded = self._robots if self._writes_ctrl or self._config.target_grippers else ()
        self._grippers = Grippers(model, commanded, self._config, self._dt)
        self._grasps = Grasps(model, objects, self._config)
        self._proximity = ProximityLimiter(model, self._robots, self._config)
        self._check_ticks = max(1, round(self._config.proximity_period_s / self._dt))
        self._solves = self._ik.solves_per_tick(self._check_ticks)
        self._states = [RobotControlState() for _ in self._robots]
        self._status = [ControlStatus(robot.name) for robot in self._robots]
        self._latched, self._driven = np.zeros((2, len(self._qpos)), dtype=bool)
        self._now_ns = 0
        self._tick = 0
        self._cursor = 0
        self._estop = False
        self._ready = False

    # --- the contract -------------------------------------------------------------------------------------------------

    def reset(self, data: mujoco.MjData) -> None:
        """Clear all state; targets are where the robots stand now (kinematics of `data` must be current)."""
        self._joints.place(self._measure_joints(data))
        if self._hold is not None:
            self._hold.reset()
        if self._sag is not None:
            self._sag.reset()
        self._ik.rest[:] = self._joints.q
        self._grippers.reset(data)
        self._grasps.reset(data)
        self._tick = self._cursor = self._now_ns = 0
        self._estop = False
        self._ready = True
        before, self._states = self._states, [RobotControlState() for _ in self._robots]
        for i, arm in enumerate(self._arms):
            r = self._states[i]
            r.T_world_root = _require_finite(_read_body_pose(data, arm.root_body)) or before[i].T_world_root
            tip = None if self._writes_ctrl else _require_finite(arm.tip.read_pose(data))
            r.commanded = tip or self._ik.compute_tip(i, r)
        self._mark_driven()

    def follow_robots(self, data: mujoco.MjData, robots: Sequence[int]) -> None:
        """Let robots without a command that the owner drives stand, for control, where they are measured."""
        if not robots:
            return
        columns = np.concatenate([np.arange(self._columns[i].start, self._columns[i].stop) for i in robots])
        self._joints.place_part(columns, self._measure_joints(data)[columns])
        if self._hold is not None:
            self._hold.forget(columns)
        for i in robots:
            r = self._states[i]
            r.lagging = False
            if not self._writes_ctrl:
                r.commanded = _require_finite(self._arms[i].tip.read_pose(data)) or r.commanded
                self._grippers.place(i, data.ctrl)

    def place_robot(self, i: int, data: mujoco.MjData, ctrl: Floats) -> None:
        """Take a robot over from the owner, whose `ctrl` is given, shape (nu,): it stands where that commands it, and
        the first tick leaves `ctrl` of position actuators as it is.

        Where `ctrl` leads the measured joints by more than `tracking_error`, the robot stands that far ahead of them.
        What carries gravity is not counted.
        """
        columns, measured = self._columns[i], self._measure_joints(data)
        q, droop = measured, np.zeros_like(measured)
        if self._hold is not None:
            self._hold.forget(columns)
            if self._sag is not None:
                _, _, droop = self._hold.measure(data)
            lead = self._config.tracking_error
            low, high = measured + np.minimum(droop, 0.0) - lead, measured + np.maximum(droop, 0.0) + lead
            q = np.clip(self._laws.find_commanded(ctrl, measured), low, high)
        self._grippers.place(i, ctrl)
        self._joints.place_part(columns, q[columns])
        if self._sag is not None:
            self._sag.begin_support(columns, measured, droop)
            self._sag.forget(i)
        self._ik.rest[columns] = q[columns]
        r = self._states[i] = RobotControlState(T_world_root=self._states[i].T_world_root)
        tip = None if self._writes_ctrl else _require_finite(self._arms[i].tip.read_pose(data))
        r.commanded = tip or self._ik.compute_tip(i, r)

    def list_outputs(self) -> list[RobotOutput]:
        """Return what this controller writes, by robot."""
        if not self._writes_ctrl:
            return [RobotOutput(np.zeros(0, np.intp), np.zeros(0)) for _ in self._robots]
        rates = self._laws.compute_ctrl_rates(self._joints.velocity, self._joints.acceleration)
        outputs = []
        for i, columns in enumerate(self._columns):
            gripper, gripper_rates = self._grippers.find_output(i, self._dt)
            actuators = np.array([*self._laws.actuators[columns], *gripper], dtype=np.intp)
            outputs.append(RobotOutput(actuators, np.array([*rates[columns], *gripper_rates])))
        return outputs

    def list_held_objects(self) -> list[str]:
        """Return the objects whose `xfrc_applied` was written by the newest tick."""
        return list(self._grasps.written)

    @property
    def holds_objects(self) -> bool:
        """True while a hand holds an object, until a tick has written its last wrench."""
        return bool(self._grasps.commanded or self._grasps.written)

    def begin(self, now_ns: int, n_ticks: int, decision: Decision, view: WorldView) -> None:
        """Read the commands of one step at session time `now_ns`. A robot without a command holds.

        Raises `ControlError` for an unknown robot or object. `n_ticks` ticks follow (or none).
        """
        del n_ticks, view  # what is measured is read from `data`, tick by tick
        self._now_ns = now_ns
        if self._hold is not None:
            self._hold.begin()
        commanded = 0
        for command in decision.commands:
            i = self._index.get(command.robot)
            if i is None:
                raise ControlError(f"robot {command.robot!r} is not known. Available robots: {', '.join(self._index)}")
            commanded |= 1 << i
            if command.kind == CommandKind.HOLD or not command.sources:
                self._hold_robot(i)
            else:
                self._drive_robot(i, command)
        for i in range(len(self._robots)):
            if not commanded >> i & 1:
                self._hold_robot(i)
        if decision.estop and not self._estop:
            for i, r in enumerate(self._states):
                if r.latch is None:  # held already, but maybe pressed against something since
                    self._enter_hold(i)
        self._estop = decision.estop
        self._mark_driven()
        self._grasps.set_goals(decision.objects)

    def tick(self, data: mujoco.MjData, crowded: bool = False) -> None:
        """Run one physics tick: write `data.ctrl` of the robots and `data.xfrc_applied` of grasped objects.

        `crowded`: its step had much else to do, so it solves less; it must follow from the journal. Raises
        `ControlError` when neither `reset` nor `restore` was called: the place of the robots is not known then.
        """
        if not self._ready:
            raise ControlError("control does not know where the robots stand: call reset(data) or restore(bytes) first")
        if self._writes_ctrl:
            checks = self._tick % self._check_ticks == 0
            self._solve_due(data, checks, crowded)
            if self._sag is not None:
                self._compensate_sag(data, self._sag)  # before the checks, which forget what was strained
            if checks:
                self._check_tracking(data)
                if self._proximity.active:
                    self._slow_near_contact(data)
            self._joints.advance()
            self._follow_measured(data)
            self._grippers.tick(data)
        else:
            self._move_targets(data)
            self._grippers.advance()
        self._grasps.tick(data)
        self._tick += 1

    def write_rest(self, data: mujoco.MjData) -> None:
        """Write the last `ctrl`, when no tick follows: robots at rest where they are commanded, or where they stand if
        they push against something; no wrench on objects.
        """
        if self._hold is not None:
            still = np.zeros_like(self._joints.q)
            q = self._hold.find_rest(data, self._laws.read_activations(data))
            self._laws.write(data, q, still, still)  # a speed of at most zero: velocity actuators stop
        self._grasps.commanded = {}
        self._grasps.tick(data)

    def get_status(self) -> tuple[ControlStatus, ...]:
        """Return the active limits per robot, and the newest sample behind the `ctrl` in use."""
        for i, r in enumerate(self._states):
            limits = self._list_limits(i, r)
            old = self._status[i]
            if old.applied is not r.applied or old.limits != limits:
                self._status[i] = ControlStatus(old.robot, limits, r.applied)
        return tuple(self._status)

    def get_targets(self) -> dict[str, Pose]:
        """Return the end-effector target in force per robot, `T_world_tip`, for environments with controllers of their
        own.
        """
        targets = {}
        for i, (robot, r) in enumerate(zip(self._robots, self._states, strict=True)):
            stands = self._writes_ctrl and r.latch is None
            targets[robot.name] = Pose(*(self._ik.compute_tip(i, r) if stands else r.commanded))
        return targets

    def get_goals(self) -> dict[str, Pose]:
        """Return where the driven robots are moved to, `T_world_tip`; robots that hold are not in it."""
        states = zip(self._robots, self._states, strict=True)
        return {robot.name: Pose(*r.latch.target) for robot, r in states if r.latch is not None}

    def list_held(self) -> list[str]:
        """Return the robots that hold: without a command, or with an open clutch."""
        return [robot.name for robot, r in zip(self._robots, self._states, strict=True) if r.latch is None]

    def get_grippers(self) -> dict[str, float]:
        """Return how far each gripper is commanded to close, 0 (open) to 1 (closed), of the robots that have one."""
        shares = ((robot.name, self._grippers.read_share(i)) for i, robot in enumerate(self._robots))
        return {name: share for name, share in shares if share is not None}

    def snapshot(self) -> bytes:
        """Return the whole memory. `restore` of it in a controller made alike continues bit for bit."""
        return encode_state(
            ControllerState(
                self._now_ns,
                self._tick,
                self._cursor,
                self._states,
                self._ik.rest.tobytes(),
                self._joints.save_state(),
                self._joints.moving,
                self._grippers.save_state(),
                list(self._grasps.commanded.items()),
                self._grasps.written,
                [
                    *([] if self._hold is None else self._hold.save_state()),
                    *([] if self._sag is None else self._sag.save_state()),
                ],
                0 if self._hold is None else self._hold.stale,
                0.0 if self._hold is None else self._hold.seen_time,
                self._estop,
            )
        )

    def restore(self, data: bytes) -> None:
        """Restore a `snapshot`. Raises `ControlError` for a snapshot of other robots."""
        state = decode_state(data)
        if len(state.robots) != len(self._robots) or len(state.rest) != self._ik.rest.nbytes:
            raise ControlError(
                f"snapshot is of {len(state.robots)} robots with {len(state.rest) // 8} joints; "
                f"this controller has {len(self._robots)} with {len(self._ik.rest)}"
            )
        self._now_ns, self._tick, self._cursor = state.now_ns, state.tick, state.cursor
        self._states = state.robots
        self._ik.rest[:] = np.frombuffer(state.rest)
        self._joints.restore_state(state.joints, state.moving)
        self._grippers.restore_state(state.grippers)
        self._grasps.commanded = dict(state.grasp_poses)
        self._grasps.written = state.grasp_written
        if self._hold is not None:
            n = len(self._hold.save_state())
            self._hold.restore_state(state.hold[:n], state.stale, state.seen_time)
            if self._sag is not None:
                self._sag.restore_state(state.hold[n:])
        self._estop = state.estop
        self._mark_driven()
        self._ready = True

    # --- once a step --------------------------------------------------------------------------------------------------

    def _hold_robot(self, i: int) -> None:
        """Enter the hold: the next tick decides from the measured joints where they stop; the gripper stays as it is.

        Until then they stop from where they are commanded, which is what the next holder is latched against when the
        robot changes hands within this step.
        """
        r = self._states[i]
        if r.latch is None:
            return
        r.latch = r.pending = None
        r.fresh = r.want_solve = r.ramping = False
        r.proximity, r.solver_limits = 1.0, ()
        if self._joints.one_way:
            self._joints.near[self._columns[i]] = np.inf  # it brakes as hard as it can
        self._grippers.stop(i)
        if self._writes_ctrl:
            self._joints.stop(self._columns[i])
            r.commanded = self._ik.compute_tip(i, r)
        self._enter_hold(i)
        self._set_cap(i)

    def _mark_driven(self) -> None:
        """Note which joints are of robots whose clutch is closed, and which of them may move."""
        for r, columns in zip(self._states, self._columns, strict=True):
            self._latched[columns] = r.latch is not None
            self._driven[columns] = r.latch is not None and not r.fresh

    def _enter_hold(self, i: int) -> None:
        if self._hold is None:
            self._states[i].settle, self._states[i].learning = -1, False
        else:
            self._hold.enter(self._columns[i])

    def _drive_robot(self, i: int, command: Command) -> None:
        r = self._states[i]
        scale = clutch.clip_scale(command.scale, self._config.min_scale, self._config.max_scale)
        new = any(source.new for source in command.sources)
        if r.latch is None or not clutch.is_continued_by(r.latch, command):
            self._hold_robot(i)  # the next holder does not inherit the motion of the previous one
            self._engage_robot(i, command, scale)
            return
        if not clutch.has_same_sources(r.latch, command, scale):
            r.latch = clutch.latch_sources(command, scale, r.latch.target, r.latch)
            new = True
        self._grippers.set_goal(i, command.gripper)
        # The latching sample itself moved nothing: what it asks for, unless it is relative to itself, follows now.
        late = r.fresh and any(source.absolute or source.pose_world is None for source in command.sources)
        r.fresh = False
        if not (new or late):
            return
        if command.kind == CommandKind.JOINTS:
            self._follow_joints(i, r.latch, command)
        else:
            clutch.follow_poses(r.latch, command.sources, self._get_workspace(i))
            r.want_solve = True
        r.pending = _find_newest(command)

    def _engage_robot(self, i: int, command: Command, scale: float) -> None:
        """Latch the clutch against the commanded target; nothing moves in this step."""
        r = self._states[i]
        if self._hold is not None:
            if self._hold.is_settling(self._columns[i]):
                self._joints.stop(self._columns[i])
            self._hold.leave(self._columns[i])
            if self._sag is not None:
                self._sag.engage(self._columns[i])
            r.commanded = self._ik.compute_tip(i, r)
        r.settle, r.learning = 0, False
        r.latch = clutch.latch_sources(command, scale, r.commanded)
        r.fresh, r.want_solve, r.ramping, r.stalls = True, False, False, 0
        r.pending = _find_newest(command)

    def _follow_joints(self, i: int, state: clutch.Latch, command: Command) -> None:
        r, columns, (lower, upper) = self._states[i], self._columns[i], self._bounds
        goal = compute_leader_goal(state, command.sources, self._joints.get_goal(columns), self._config)
        goal = np.minimum(np.maximum(goal, lower[columns]), upper[columns])
        goal, state.clamped = self._ik.clip_to_workspace(i, r, state.base, goal, self._get_workspace(i))
        r.ramping = is_ramping(r.ramping, float(np.abs(goal - self._joints.get_position(columns)).max()), self._config)
        self._set_cap(i)
        self._joints.set_goal(columns, goal, self._ik.get_interval(r, self._tick))
        r.last_solve = self._tick
        state.target = self._ik.compute_tip(i, r)
        if self._writes_ctrl:
            r.commanded = state.target

    # --- once a tick --------------------------------------------------------------------------------------------------

    def _solve_due(self, data: mujoco.MjData, checks: bool, crowded: bool) -> None:
        """Integrate twists; solve for a bounded number of robots, in turn.

        A tick that `checks` distances too, or whose step was `crowded`, solves less: ticks with all the work at once
        would be the late ones.
        """
        n, start = len(self._states), self._cursor
        usual, besides_checks = self._solves
        busy = crowded or (checks and self._proximity.active and self._joints.moving)
        left = besides_checks if busy else usual
        self._follow_bases(data)
        for i in (*range(start, n), *range(start)):
            r = self._states[i]
            if r.latch is None:
                continue
            if r.latch.kind == CommandKind.TWIST and not r.fresh:
                self._integrate_twist(i, r, r.latch)
            if left and self._ik.is_due(r, self._tick):
                self._ik.solve(i, r, r.latch, self._tick)
                left -= 1
                self._cursor = (i + 1) % n
                self._mark_applied(r)
            elif r.pending is not None and not r.want_solve:
                self._mark_applied(r)

    def _follow_measured(self, data: mujoco.MjData) -> None:
        """Bound the commanded joints by the measured ones, and write `ctrl`."""
        assert self._hold is not None
        joints = self._joints
        self._hold.apply(data, self._laws.read_activations(data))
        self._laws.write(data, joints.q, joints.v, joints.velocity, self._hold.act_range)

    def _compensate_sag(self, data: mujoco.MjData, sag: SagCompensation) -> None:
        """Move the goals by what the servos sag by; note what is left."""
        assert self._hold is not None
        x, v, droop = self._hold.measure(data)
        sag.update(x, v, droop, self._latched, self._driven)
        if self._tick % self._check_ticks:
            return
        for i, r in enumerate(self._states):
            if r.latch is None:
                sag.forget(i)
            elif sag.is_near(i):
                sag.note(i, 0.0, 0.0, 0.0)
            elif sag.is_standing(i, v):
                sag.note(i, *self._measure_sag(i, r, data), self._check_ticks * self._dt)

    def _measure_sag(self, i: int, r: RobotControlState, data: mujoco.MjData) -> tuple[float, float]:
        """Return how far a robot stands from its aim [m, rad]: its tip; of a hand the joint that is farthest."""
        assert self._sag is not None
        if self._robots[i].kind == HAND:
            return 0.0, float(np.abs(self._sag.error[self._columns[i]]).max())
        tip = _require_finite(self._arms[i].tip.read_pose(data))
        return (0.0, 0.0) if tip is None else clutch.measure_separation(tip, self._ik.compute_tip(i, r))

    def _follow_bases(self, data: mujoco.MjData) -> None:
        """Update the bases. A robot whose base is not finite (physics that diverged) holds at its last finite place."""
        for i in self._moving_bases:
            T = _require_finite(_read_body_pose(data, self._arms[i].root_body))
            if T is None:
                self._hold_robot(i)
                self._mark_driven()
            else:
                self._states[i].T_world_root = T

    def _measure_joints(self, data: mujoco.MjData) -> Floats:
        """Return joint positions of all robots, shape (n,); those that are not finite are where they were commanded."""
        q = data.qpos[self._qpos]
        return np.where(np.isfinite(q), q, self._joints.q)

    def _integrate_twist(self, i: int, r: RobotControlState, state: clutch.Latch) -> None:
        config = self._config
        if clutch.integrate_twists(state, self._dt, config.tip_speed, config.tip_angular_speed, self._get_workspace(i)):
            tip = self._ik.compute_tip(i, r) if self._writes_ctrl else r.commanded
            state.target = clutch.step_toward(tip, state.target, config.twist_lead_m, config.twist_lead_rad)
            r.want_solve = True

    def _check_tracking(self, data: mujoco.MjData) -> None:
        """Flag robots whose joints are far from where they are commanded: blocked, overloaded, or far too slow."""
        assert self._hold is not None
        far = np.abs(data.qpos[self._qpos] - self._joints.get_position(slice(None))) > self._config.tracking_error
        far |= self._hold.take_strained()
        some = bool(far.any())
        for r, columns in zip(self._states, self._columns, strict=True):
            r.lagging = some and bool(far[columns].any())

    def _slow_near_contact(self, data: mujoco.MjData) -> None:
        """Bound the speed of robots that approach each other, until the next check: new samples do not lift it.

        A robot that holds is not bounded: it brakes as hard as it can already.
        """
        joints = self._joints
        factors, near = SpeedFactors([np.ones(1)] * len(self._states), frozenset())
        speed = joints.velocity
        wanted = np.minimum(np.maximum((joints.goal - joints.q) / joints.remaining, -speed), speed)
        if joints.moving:
            motions, stops = None, None
            if self._config.proximity_stopped:
                change = joints.acceleration * (self._check_ticks * self._dt)
                reached = np.clip(wanted, joints.v - change, joints.v + change)
                motions = [Motion(joints.v[c], reached[c]) for c in self._columns]
                stops = self._find_stops(data, reached)
            speeds = [wanted[columns] for columns in self._columns]
            factors, near = self._proximity.compute_speed_factors(data, speeds, motions, stops)
        for i, (r, factor) in enumerate(zip(self._states, factors, strict=True)):
            columns = self._columns[i]
            r.proximity = 1.0 if r.latch is None else float(factor.min())
            # Near another robot no joint that moves gets faster than it wants to be now, or turns round, until the next
            # check, whatever the next sample wants.
            if joints.one_way:
                joints.near[columns] = wanted[columns] * factor if i in near and r.latch else np.inf
            else:
                joints.near[columns] = speed[columns] if r.proximity == 1.0 else np.abs(wanted[columns]) * factor

    def _find_stops(self, data: mujoco.MjData, v: Floats) -> Floats:
        """Return `qpos`, shape (nq,), where joints come to a stop that brake from the next check on, with the speeds
        `v` by then, shape (n,); what is not driven and does not brake is where it is measured."""
        joints, stops = self._joints, np.array(data.qpos)
        until_then = np.where(joints.v * v > 0.0, np.maximum(np.abs(v), np.abs(joints.v)), np.abs(v))
        travel = np.sign(v) * (until_then * (self._check_ticks * self._dt) + joints.find_stop_distance(v))
        moves = self._latched | (joints.v != 0.0)
        stops[self._qpos[moves]] = (joints.get_position(slice(None)) + travel)[moves]
        return stops

    def _move_targets(self, data: mujoco.MjData) -> None:
        """Output `targets`: move end-effector targets at bounded speed; the environment's controller does the rest.

        The joints are moved by it alone, so they are where they are measured; only leaders give them goals.
        """
        config, dt, joints = self._config, self._dt, self._joints
        self._follow_bases(data)
        joints.q[:] = self._measure_joints(data)
        for i, (r, columns) in enumerate(zip(self._states, self._columns, strict=True)):
            if r.latch is None or r.latch.kind != CommandKind.JOINTS:
                joints.goal[columns] = joints.q[columns]
            elif r.ramping:
                r.ramping = is_ramping(True, float(np.abs(joints.goal[columns] - joints.q[columns]).max()), config)
            if r.latch is not None:
                if not r.fresh and r.latch.kind == CommandKind.TWIST:
                    self._integrate_twist(i, r, r.latch)
                if not r.fresh:
                    r.commanded = clutch.step_toward(
                        r.commanded, r.latch.target, config.tip_speed * dt, config.tip_angular_speed * dt
                    )
                self._mark_applied(r)
            self._bound_target(i, r, data)

    def _bound_target(self, i: int, r: RobotControlState, data: mujoco.MjData) -> None:
        """Bound the lead of the end-effector target on the measured tip; a hold that begins takes away its push.

        The law of `hold.HoldLaw` for a servo of which only the bound is known.
        """
        config = self._config
        tip = _require_finite(self._arms[i].tip.read_pose(data))
        if tip is None:
            return
        speed, angular_speed = _measure_speed(self._arms[i].tip, data)
        m, rad = config.target_lag_s * speed, config.target_lag_s * angular_speed
        apart = clutch.measure_separation(tip, r.commanded)
        at_rest = (_DEAD_BAND * config.target_lead_m, _DEAD_BAND * config.target_lead_rad)
        if r.settle < 0:
            blocked = any(
                a > dead + carry + lag for a, dead, carry, lag in zip(apart, at_rest, r.carry, (m, rad), strict=True)
            )
            r.settle = max(1, round(config.hold_release_s / self._dt)) if blocked else 0
            r.learning = blocked
        if r.settle:
            r.settle -= 1
            m, rad = max(m + r.carry[0], _TINY), max(rad + r.carry[1], _TINY)
        else:
            if r.latch is None:
                limits = (config.target_lead_m, config.target_lead_rad)
                (a, b), (c, d) = apart, limits if r.learning else r.carry
                r.carry = (min(a, c), min(b, d))
            m, rad = m + config.target_lead_m, rad + config.target_lead_rad
        r.lagging = apart[0] > m or apart[1] > rad
        r.commanded = clutch.step_toward(tip, r.commanded, m, rad)

    # --- helpers ------------------------------------------------------------------------------------------------------

    def _mark_applied(self, r: RobotControlState) -> None:
        if r.pending is not None:
            p = r.pending
            r.applied = Applied(p.robot, p.participant, p.device, p.seq, p.capture_ns, p.receive_ns, self._now_ns)
            r.pending = None

    def _get_workspace(self, i: int) -> clutch.Box | None:
        return self._config.workspaces.get(self._robots[i].name, self._config.workspace)

    def _set_cap(self, i: int) -> None:
        columns, joints = self._columns[i], self._joints
        cap = joints.velocity[columns]
        joints.cap[columns] = np.minimum(cap, self._config.leader_ramp_speed) if self._states[i].ramping else cap

    def _list_limits(self, i: int, r: RobotControlState) -> tuple[str, ...]:
        extra: tuple[str, ...] = ("workspace",) if r.latch is not None and r.latch.clamped else ()
        if r.proximity < 1.0:
            extra += ("proximity",)
        if r.ramping:
            extra += ("leader_apart",)
        if r.lagging:
            extra += ("tracking",)
        if self._sag is not None and self._sag.said[i]:
            extra += (SAG,)
        return r.solver_limits + extra


def _find_newest(command: Command) -> Applied:
    """Return the newest sample of a command, not applied yet (`step_ns` 0)."""
    s = max(command.sources, key=lambda source: source.receive_ns)
    return Applied(command.robot, s.participant, s.device, s.seq, s.capture_ns, s.receive_ns, 0)


def _read_body_pose(data: mujoco.MjData, body: int) -> PoseTuple:
    x, y, z = data.xpos[body].tolist()
    w, i, j, k = data.xquat[body].tolist()
    return ((x, y, z), (w, i, j, k))


def _measure_speed(tip: Tip, data: mujoco.MjData) -> tuple[float, float]:
    """Return linear [m/s] and angular [rad/s] speed of an end effector; zero if they are not finite."""
    velocity = tip.read_velocity(data)
    angular, linear = float(np.linalg.norm(velocity[:3])), float(np.linalg.norm(velocity[3:]))
    return (linear, angular) if math.isfinite(linear + angular) else (0.0, 0.0)


def _require_finite(T: PoseTuple) -> PoseTuple | None:
    return T if all(map(math.isfinite, (*T[0], *T[1]))) else None
