"""Command -> `ctrl`: one object that composes clutch, inverse kinematics, interpolation, grippers, grasps and limits.

`begin` reads the decision of a step (no physics, may be followed by no tick); `tick` moves everything by one physics
tick and writes `data.ctrl` of its own robots and wrenches of grasped objects, nothing else. Time is counted in ticks.
No clock, no randomness; whatever is remembered is in `snapshot()`.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import mujoco
import numpy as np

from anchors.pose import PoseTuple
from iris_session.control import clutch
from iris_session.control.arm_model import ArmModel, Floats, joint_ranges, moving_base, site_pose
from iris_session.control.config import OUTPUT_CTRL, ControlConfig
from iris_session.control.errors import ControlError
from iris_session.control.grasp import Grasps
from iris_session.control.gripper import Grippers
from iris_session.control.hold import ActuatorLaws
from iris_session.control.interpolate import JointInterpolator, speed_limits
from iris_session.control.leader import leader_goal, ramping
from iris_session.control.proximity import Proximity
from iris_session.control.reach import Reach
from iris_session.control.state import ControllerState, RobotState, decode_state, encode_state
from iris_session.protocol.common import Applied, Pose
from iris_session.protocol.names import CommandKind
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import Command, ControlStatus, Decision, WorldView


class Controller:
    """Turns one `Command` per robot and step into `ctrl` for every tick."""

    def __init__(
        self,
        model: mujoco.MjModel,
        robots: Sequence[RobotSpec],
        objects: Sequence[ObjectSpec] = (),
        config: ControlConfig | None = None,
    ) -> None:
        """Raises `ControlError` for robots, actuators or objects that cannot be driven, `ImportError` without mink."""
        self._config = config or ControlConfig()
        self._robots = tuple(robots)
        self._dt = float(model.opt.timestep)
        self._index = {robot.name: i for i, robot in enumerate(self._robots)}
        self._arms = [ArmModel(model, robot) for robot in self._robots]
        self._moving_bases = [i for i, arm in enumerate(self._arms) if moving_base(model, arm.root_body)]
        bounds = np.cumsum([0, *(len(robot.joints) for robot in self._robots)])
        self._columns = [slice(int(a), int(b)) for a, b in itertools.pairwise(bounds)]
        self._qpos = np.array([model.jnt_qposadr[j] for arm in self._arms for j in arm.joint_ids], dtype=np.intp)
        self._writes_ctrl = self._config.output == OUTPUT_CTRL
        # Without ctrl output the environment drives the actuators: any kind will do.
        driven = self._robots if self._writes_ctrl else ()
        self._laws = ActuatorLaws(model, driven, self._config)
        self._bounds = (self._laws.lower, self._laws.upper) if driven else joint_ranges(model, self._arms)
        self._joints = JointInterpolator(*speed_limits(model, self._robots, self._arms, self._config), self._dt)
        self._reach = Reach(self._robots, self._arms, self._columns, self._joints, self._bounds, self._config)
        self._grippers = Grippers(model, driven, self._config, self._dt)
        self._grasps = Grasps(model, objects, self._config)
        self._proximity = Proximity(model, self._robots, self._config)
        self._check_ticks = max(1, round(self._config.proximity_period_s / self._dt))
        self._solves = self._reach.solves_per_tick(self._check_ticks)
        self._states = [RobotState() for _ in self._robots]
        self._status = [ControlStatus(robot.name) for robot in self._robots]
        self._now_ns = 0
        self._tick = 0
        self._cursor = 0
        self._ready = False

    # --- the contract -------------------------------------------------------------------------------------------------

    def reset(self, data: mujoco.MjData) -> None:
        """Everything is forgotten; targets are where the robots stand now (kinematics of `data` must be current)."""
        self._joints.place(self._measured(data))
        self._reach.rest[:] = self._joints.q
        self._grippers.reset(data)
        self._grasps.reset(data)
        self._tick = self._cursor = self._now_ns = 0
        self._ready = True
        before, self._states = self._states, [RobotState() for _ in self._robots]
        for i, arm in enumerate(self._arms):
            r = self._states[i]
            r.T_world_root = _finite(_body_pose(data, arm.root_body)) or before[i].T_world_root
            tip = None if self._writes_ctrl else _finite(site_pose(data, arm.site_id))
            r.commanded = tip or self._reach.tip(i, r)

    def begin(self, now_ns: int, n_ticks: int, decision: Decision, view: WorldView) -> None:
        """Reads the commands of one step at session time `now_ns`. A robot without a command holds.

        Raises `ControlError` for a robot or object that control was not given. `n_ticks` ticks follow (or none).
        """
        del n_ticks, view  # targets come from commanded motion alone, never from what was measured
        self._now_ns = now_ns
        commanded = 0
        for command in decision.commands:
            i = self._index.get(command.robot)
            if i is None:
                raise ControlError(f"robot {command.robot!r} is not known. Available robots: {', '.join(self._index)}")
            commanded |= 1 << i
            if command.kind == CommandKind.HOLD or not command.sources:
                self._hold(i)
            else:
                self._drive(i, command)
        for i in range(len(self._robots)):
            if not commanded >> i & 1:
                self._hold(i)
        self._grasps.command(decision.objects)

    def tick(self, data: mujoco.MjData, crowded: bool = False) -> None:
        """One physics tick: writes `data.ctrl` of the robots and `data.xfrc_applied` of grasped objects.

        `crowded`: its step had much else to do, so it solves less; it must follow from the journal.
        Raises `ControlError` when neither `reset` nor `restore` was called: where the robots stand is not known then.
        """
        if not self._ready:
            raise ControlError("control does not know where the robots stand: call reset(data) or restore(bytes) first")
        if self._writes_ctrl:
            checks = self._tick % self._check_ticks == 0
            self._solve_due(data, checks, crowded)
            if checks:
                self._check_tracking(data)
                if self._proximity.active:
                    self._slow_near_contact(data)
            self._joints.advance()
            self._laws.write(data, self._joints.q, self._joints.v, self._joints.velocity)
            self._grippers.tick(data)
        else:
            self._move_targets(data)
        self._grasps.tick(data)
        self._tick += 1

    def rest(self, data: mujoco.MjData) -> None:
        """The last `ctrl`, when no tick follows: robots at rest where they are commanded, no wrench on objects."""
        still = np.zeros_like(self._joints.q)
        self._laws.write(data, self._joints.q, still, still)  # a speed of at most zero: velocity actuators stop
        self._grasps.commanded = {}
        self._grasps.tick(data)

    def status(self) -> tuple[ControlStatus, ...]:
        """Per robot: what limits it now, and the newest sample behind the `ctrl` in use."""
        for i, r in enumerate(self._states):
            limits = self._limits(r)
            old = self._status[i]
            if old.applied is not r.applied or old.limits != limits:
                self._status[i] = ControlStatus(old.robot, limits, r.applied)
        return tuple(self._status)

    def targets(self) -> dict[str, Pose]:
        """End-effector target in force per robot, `T_world_tip`, for environments with controllers of their own."""
        return {robot.name: Pose(*r.commanded) for robot, r in zip(self._robots, self._states, strict=True)}

    def snapshot(self) -> bytes:
        """Everything remembered. `restore` of it in a controller made alike continues bit for bit."""
        return encode_state(
            ControllerState(
                self._now_ns,
                self._tick,
                self._cursor,
                self._states,
                self._reach.rest.tobytes(),
                self._joints.state(),
                self._joints.moving,
                self._grippers.state(),
                list(self._grasps.commanded.items()),
                self._grasps.written,
            )
        )

    def restore(self, data: bytes) -> None:
        """Inverse of `snapshot`. Raises `ControlError` for a snapshot of other robots."""
        state = decode_state(data)
        if len(state.robots) != len(self._robots) or len(state.rest) != self._reach.rest.nbytes:
            raise ControlError(
                f"snapshot is of {len(state.robots)} robots with {len(state.rest) // 8} joints; "
                f"this controller has {len(self._robots)} with {len(self._reach.rest)}"
            )
        self._now_ns, self._tick, self._cursor = state.now_ns, state.tick, state.cursor
        self._states = state.robots
        self._reach.rest[:] = np.frombuffer(state.rest)
        self._joints.set_state(state.joints, state.moving)
        self._grippers.set_state(state.grippers)
        self._grasps.commanded = dict(state.grasp_poses)
        self._grasps.written = state.grasp_written
        self._ready = True

    # --- once a step --------------------------------------------------------------------------------------------------

    def _hold(self, i: int) -> None:
        """Decelerates to the last commanded target; the gripper stays as it is."""
        r = self._states[i]
        if r.latch is None:
            return
        r.latch = r.pending = None
        r.fresh = r.want_solve = r.ramping = False
        r.proximity, r.solver_limits = 1.0, ()
        self._grippers.stop(i)
        if self._writes_ctrl:
            self._joints.stop(self._columns[i])
            r.commanded = self._reach.tip(i, r)
        self._set_cap(i)

    def _drive(self, i: int, command: Command) -> None:
        r = self._states[i]
        scale = clutch.clip_scale(command.scale, self._config.min_scale, self._config.max_scale)
        new = any(source.new for source in command.sources)
        if r.latch is None or not clutch.continues(r.latch, command):
            self._hold(i)  # whoever takes over does not inherit the motion of the one before
            self._engage(i, command, scale)
            return
        if not clutch.same_sources(r.latch, command, scale):
            r.latch = clutch.latch(command, scale, r.latch.target, r.latch)
            new = True
        self._grippers.command(i, command.gripper)
        # The latching sample itself moved nothing: what it asks for, unless it is relative to itself, follows now.
        late = r.fresh and any(source.absolute or source.pose_world is None for source in command.sources)
        r.fresh = False
        if not (new or late):
            return
        if command.kind == CommandKind.JOINTS:
            self._follow_joints(i, r.latch, command)
        else:
            clutch.follow(r.latch, command.sources, self._box(i))
            r.want_solve = True
        r.pending = _newest(command)

    def _engage(self, i: int, command: Command, scale: float) -> None:
        """Latches the clutch against the commanded target; nothing moves in this step."""
        r = self._states[i]
        if self._writes_ctrl:
            r.commanded = self._reach.tip(i, r)
        r.latch = clutch.latch(command, scale, r.commanded)
        r.fresh, r.want_solve, r.ramping, r.stalls = True, False, False, 0
        r.pending = _newest(command)

    def _follow_joints(self, i: int, state: clutch.Latch, command: Command) -> None:
        r, columns, (lower, upper) = self._states[i], self._columns[i], self._bounds
        goal = leader_goal(state, command.sources, self._joints.goal[columns], self._config)
        goal = np.minimum(np.maximum(goal, lower[columns]), upper[columns])
        goal, state.clamped = self._reach.within(i, r, state.base, goal, self._box(i))
        r.ramping = ramping(r.ramping, float(np.abs(goal - self._joints.q[columns]).max()), self._config)
        self._set_cap(i)
        self._joints.aim(columns, goal, self._reach.interval(r, self._tick))
        r.last_solve = self._tick
        state.target = self._reach.tip(i, r)
        if self._writes_ctrl:
            r.commanded = state.target

    # --- once a tick --------------------------------------------------------------------------------------------------

    def _solve_due(self, data: mujoco.MjData, checks: bool, crowded: bool) -> None:
        """Integrates twists; solves for a bounded number of robots, taking turns.

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
                self._integrate(i, r, r.latch)
            if left and self._reach.due(r, self._tick):
                self._reach.solve(i, r, r.latch, self._tick)
                left -= 1
                self._cursor = (i + 1) % n
                self._apply(r)
            elif r.pending is not None and not r.want_solve:
                self._apply(r)

    def _follow_bases(self, data: mujoco.MjData) -> None:
        """A robot whose base stands nowhere (physics that diverged) holds at the last place that it was seen at."""
        for i in self._moving_bases:
            T = _finite(_body_pose(data, self._arms[i].root_body))
            if T is None:
                self._hold(i)
            else:
                self._states[i].T_world_root = T

    def _measured(self, data: mujoco.MjData) -> Floats:
        """Joint positions of all robots, shape (n,); those that are no numbers are where they were commanded."""
        q = data.qpos[self._qpos]
        return np.where(np.isfinite(q), q, self._joints.q)

    def _integrate(self, i: int, r: RobotState, state: clutch.Latch) -> None:
        config = self._config
        if clutch.integrate(state, self._dt, config.tip_speed, config.tip_angular_speed, self._box(i)):
            tip = self._reach.tip(i, r) if self._writes_ctrl else r.commanded
            state.target = clutch.toward(tip, state.target, config.twist_lead_m, config.twist_lead_rad)
            r.want_solve = True

    def _check_tracking(self, data: mujoco.MjData) -> None:
        """Notices robots whose joints are not where they are commanded: blocked, overloaded, or far too slow."""
        far = np.abs(data.qpos[self._qpos] - self._joints.q) > self._config.tracking_error
        some = bool(far.any())
        for r, columns in zip(self._states, self._columns, strict=True):
            r.lagging = some and bool(far[columns].any())

    def _slow_near_contact(self, data: mujoco.MjData) -> None:
        """Bounds the speed of robots that close in on each other, until the next check: new samples do not lift it.

        Who holds is not bounded: it brakes as hard as it can already.
        """
        joints = self._joints
        factors = [1.0] * len(self._states)
        speed = joints.velocity
        wanted = np.minimum(np.maximum((joints.goal - joints.q) / joints.remaining, -speed), speed)
        if joints.moving:
            factors = self._proximity.factors(data, [wanted[columns] for columns in self._columns])
        for i, (r, factor) in enumerate(zip(self._states, factors, strict=True)):
            columns = self._columns[i]
            r.proximity = 1.0 if r.latch is None else factor
            joints.near[columns] = speed[columns] if r.proximity == 1.0 else np.abs(wanted[columns]) * factor

    def _move_targets(self, data: mujoco.MjData) -> None:
        """Output `targets`: end-effector targets move at bounded speed; the environment's controller does the rest.

        The joints are moved by it alone, so they are where they are measured; only leaders give them goals.
        """
        config, dt, joints = self._config, self._dt, self._joints
        self._follow_bases(data)
        joints.q[:] = self._measured(data)
        for i, (r, columns) in enumerate(zip(self._states, self._columns, strict=True)):
            if r.latch is None or r.latch.kind != CommandKind.JOINTS:
                joints.goal[columns] = joints.q[columns]
            elif r.ramping:
                r.ramping = ramping(True, float(np.abs(joints.goal[columns] - joints.q[columns]).max()), config)
            if r.latch is None:
                continue
            if not r.fresh and r.latch.kind == CommandKind.TWIST:
                self._integrate(i, r, r.latch)
            if not r.fresh:
                r.commanded = clutch.toward(
                    r.commanded, r.latch.target, config.tip_speed * dt, config.tip_angular_speed * dt
                )
            self._apply(r)

    # --- helpers ------------------------------------------------------------------------------------------------------

    def _apply(self, r: RobotState) -> None:
        if r.pending is not None:
            p = r.pending
            r.applied = Applied(p.robot, p.participant, p.device, p.seq, p.capture_ns, p.receive_ns, self._now_ns)
            r.pending = None

    def _box(self, i: int) -> clutch.Box | None:
        return self._config.workspaces.get(self._robots[i].name, self._config.workspace)

    def _set_cap(self, i: int) -> None:
        columns, joints = self._columns[i], self._joints
        cap = joints.velocity[columns]
        joints.cap[columns] = np.minimum(cap, self._config.leader_ramp_speed) if self._states[i].ramping else cap

    def _limits(self, r: RobotState) -> tuple[str, ...]:
        extra: tuple[str, ...] = ("workspace",) if r.latch is not None and r.latch.clamped else ()
        if r.proximity < 1.0:
            extra += ("proximity",)
        if r.ramping:
            extra += ("leader_apart",)
        if r.lagging:
            extra += ("tracking",)
        return r.solver_limits + extra


def _newest(command: Command) -> Applied:
    """The newest sample of a command, not applied yet (`step_ns` 0)."""
    s = max(command.sources, key=lambda source: source.receive_ns)
    return Applied(command.robot, s.participant, s.device, s.seq, s.capture_ns, s.receive_ns, 0)


def _body_pose(data: mujoco.MjData, body: int) -> PoseTuple:
    x, y, z = data.xpos[body].tolist()
    w, i, j, k = data.xquat[body].tolist()
    return ((x, y, z), (w, i, j, k))


def _finite(T: PoseTuple) -> PoseTuple | None:
    return T if all(map(math.isfinite, (*T[0], *T[1]))) else None
