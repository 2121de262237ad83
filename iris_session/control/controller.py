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

from anchors.pose import PoseTuple, compose, inverse
from iris_session.control import clutch
from iris_session.control.arm_model import ArmModel, Floats, moving_base, site_pose
from iris_session.control.config import OUTPUT_CTRL, ControlConfig
from iris_session.control.errors import ControlError
from iris_session.control.grasp import Grasps
from iris_session.control.gripper import Grippers
from iris_session.control.hold import ActuatorLaws
from iris_session.control.ik import IkSolver
from iris_session.control.interpolate import JointInterpolator
from iris_session.control.leader import leader_goal, ramping
from iris_session.control.proximity import Proximity
from iris_session.control.state import ControllerState, RobotState, decode_state, encode_state
from iris_session.protocol.common import Applied, Pose
from iris_session.protocol.names import CommandKind
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import Command, ControlStatus, Decision, WorldView

_MAX_STALLS = 5  # solves without progress after which a target counts as out of reach


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
        self._laws = ActuatorLaws(model, self._robots, self._config)
        self._solvers = [IkSolver(arm, self._config) for arm in self._arms] if self._writes_ctrl else []
        self._joints = JointInterpolator(*self._speed_limits(model), self._dt)
        self._rest = np.zeros(len(self._qpos))
        self._grippers = Grippers(model, self._robots, self._config, self._dt)
        self._grasps = Grasps(model, objects, self._config)
        self._proximity = Proximity(model, self._robots, self._config)
        self._solve_ticks = max(1, math.ceil(1.0 / (self._config.solve_rate_hz * self._dt) - 1e-9))
        self._slow_interval = max(1.0 / self._config.sample_rate_min_hz, self._solve_ticks * self._dt)
        self._refine_ticks = math.ceil(self._slow_interval / self._dt - 1e-9)
        self._proximity_ticks = max(1, round(self._config.proximity_period_s / self._dt))
        self._states = [RobotState() for _ in self._robots]
        self._status = [ControlStatus(robot.name) for robot in self._robots]
        self._now_ns = 0
        self._tick = 0
        self._cursor = 0

    # --- the contract -------------------------------------------------------------------------------------------------

    def reset(self, data: mujoco.MjData) -> None:
        """Everything is forgotten; targets are where the robots stand now (kinematics of `data` must be current)."""
        self._joints.place(data.qpos[self._qpos])
        self._rest[:] = self._joints.q
        self._grippers.reset(data)
        self._grasps.reset(data)
        self._tick = self._cursor = self._now_ns = 0
        self._states = [RobotState() for _ in self._robots]
        for i, arm in enumerate(self._arms):
            self._states[i].T_world_root = _body_pose(data, arm.root_body)
            self._states[i].commanded = self._solved_tip(i) if self._writes_ctrl else site_pose(data, arm.site_id)

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

    def tick(self, data: mujoco.MjData) -> None:
        """One physics tick: writes `data.ctrl` of the robots and `data.xfrc_applied` of grasped objects."""
        if self._writes_ctrl:
            self._solve_due(data)
            if self._proximity.active and self._tick % self._proximity_ticks == 0:
                self._slow_near_contact(data)
            self._joints.advance()
            self._laws.write(data, self._joints.q, self._joints.v)
            self._grippers.tick(data)
        else:
            self._move_targets()
        self._grasps.tick(data)
        self._tick += 1

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
                self._rest.tobytes(),
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
        if len(state.robots) != len(self._robots) or len(state.rest) != self._rest.nbytes:
            raise ControlError(
                f"snapshot is of {len(state.robots)} robots with {len(state.rest) // 8} joints; "
                f"this controller has {len(self._robots)} with {len(self._rest)}"
            )
        self._now_ns, self._tick, self._cursor = state.now_ns, state.tick, state.cursor
        self._states = state.robots
        self._rest[:] = np.frombuffer(state.rest)
        self._joints.set_state(state.joints, state.moving)
        self._grippers.set_state(state.grippers)
        self._grasps.commanded = dict(state.grasp_poses)
        self._grasps.written = state.grasp_written

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
            r.commanded = self._solved_tip(i)
        self._set_cap(i)

    def _drive(self, i: int, command: Command) -> None:
        r = self._states[i]
        scale = clutch.clip_scale(command.scale, self._config.min_scale, self._config.max_scale)
        new = any(source.new for source in command.sources)
        if r.latch is None or r.latch.kind != command.kind:
            self._engage(i, command, scale)
            return
        if not clutch.same_sources(r.latch, command, scale):
            r.latch = clutch.latch(command, scale, r.latch.target, r.latch)
            new = True
        self._grippers.command(i, command.gripper)
        if not (new or r.fresh):
            return
        r.fresh = False
        if command.kind == CommandKind.JOINTS:
            self._follow_joints(i, r.latch, command)
        else:
            clutch.follow(r.latch, command.sources, self._box(i))
            r.want_solve = True
        r.stalls = 0
        r.pending = _newest(command)

    def _engage(self, i: int, command: Command, scale: float) -> None:
        """Latches the clutch against the commanded target; nothing moves in this step."""
        r = self._states[i]
        if self._writes_ctrl:
            r.commanded = self._solved_tip(i)
        r.latch = clutch.latch(command, scale, r.commanded)
        r.fresh, r.want_solve, r.ramping, r.stalls = True, False, False, 0
        r.pending = _newest(command)

    def _follow_joints(self, i: int, state: clutch.Latch, command: Command) -> None:
        r, columns, laws = self._states[i], self._columns[i], self._laws
        goal = leader_goal(state, command.sources, self._joints.goal[columns], self._config)
        goal = np.minimum(np.maximum(goal, laws.lower[columns]), laws.upper[columns])
        r.ramping = ramping(r.ramping, float(np.abs(goal - self._joints.q[columns]).max()), self._config)
        self._set_cap(i)
        self._joints.aim(columns, goal, self._interval(r))
        r.last_solve = self._tick
        state.target = self._solved_tip(i)
        if self._writes_ctrl:
            r.commanded = state.target

    # --- once a tick --------------------------------------------------------------------------------------------------

    def _solve_due(self, data: mujoco.MjData) -> None:
        """Integrates twists; solves for at most `max_solves_per_tick` robots, taking turns."""
        n, solved, config = len(self._states), 0, self._config
        for i in self._moving_bases:
            self._states[i].T_world_root = _body_pose(data, self._arms[i].root_body)
        start = self._cursor
        for k in range(n):
            i = (start + k) % n
            r = self._states[i]
            if r.latch is not None and not r.fresh and r.latch.kind == CommandKind.TWIST:
                self._integrate(i, r, r.latch)
            if r.want_solve:
                # New targets first of all; refinement of an old one waits for the slowest device's next sample.
                wait = self._solve_ticks if r.pending is not None else self._refine_ticks
                if solved < config.max_solves_per_tick and self._tick - r.last_solve >= wait:
                    self._solve(i)
                    solved += 1
                    self._cursor = (i + 1) % n
                    self._apply(r)
            elif r.pending is not None:
                self._apply(r)

    def _integrate(self, i: int, r: RobotState, state: clutch.Latch) -> None:
        config = self._config
        if clutch.integrate(state, self._dt, config.tip_speed, config.tip_angular_speed, self._box(i)):
            tip = self._solved_tip(i) if self._writes_ctrl else r.commanded
            state.target = clutch.toward(tip, state.target, config.twist_lead_m, config.twist_lead_rad)
            r.want_solve, r.stalls = True, 0

    def _solve(self, i: int) -> None:
        """One step of inverse kinematics from the last solution toward the target."""
        r, columns, joints, config, laws = self._states[i], self._columns[i], self._joints, self._config, self._laws
        if r.latch is None:
            return
        interval = self._interval(r)
        q, commanded, speed = joints.goal[columns], joints.q[columns], joints.velocity[columns]
        T_world_now = self._solved_tip(i)
        r.commanded = clutch.toward(
            T_world_now, r.latch.target, config.tip_speed * interval, config.tip_angular_speed * interval
        )
        lead = speed * config.lead_s
        lower = np.maximum(laws.lower[columns], commanded - lead) - q
        upper = np.minimum(laws.upper[columns], commanded + lead) - q
        step = speed * interval
        # A joint that stands outside its range may stay, and may come back at its own speed.
        box_lower = np.minimum(np.maximum(lower, -step), 0.0)
        box_upper = np.maximum(np.minimum(upper, step), 0.0)
        result = self._solvers[i].step(
            q, self._rest[columns], compose(inverse(r.T_world_root), r.commanded), box_lower, box_upper
        )
        joints.aim(columns, result.q, interval)
        r.last_solve = self._tick
        self._judge(i, r, r.latch, result.q - q, box_lower, box_upper, result.singular)

    def _judge(
        self, i: int, r: RobotState, state: clutch.Latch, dq: Floats, lower: Floats, upper: Floats, singular: bool
    ) -> None:
        """Decides whether solving goes on without new samples, and what is reported as limiting."""
        config, columns, laws = self._config, self._columns[i], self._laws
        distance, angle = clutch.separation(self._solved_tip(i), state.target)
        error = max(distance / config.position_tolerance, angle / config.rotation_tolerance)
        r.stalls = r.stalls + 1 if error > 0.99 * r.error else 0
        r.error = error
        r.want_solve = error > 1.0 and r.stalls < _MAX_STALLS
        limits = []
        goal = self._joints.goal[columns]
        at_range = (goal <= laws.lower[columns] + 1e-6) | (goal >= laws.upper[columns] - 1e-6)
        limits += [name for name, at in zip(self._robots[i].joints, at_range.tolist(), strict=True) if at]
        if error > 1.0 and bool(((dq <= lower + 1e-9) | (dq >= upper - 1e-9))[~at_range].any()):
            limits.append("speed")
        if r.stalls >= _MAX_STALLS and error > 1.0:
            limits.append("reach")
        if singular:
            limits.append("singular")
        r.solver_limits = tuple(limits)

    def _slow_near_contact(self, data: mujoco.MjData) -> None:
        """Bounds the speed of robots that close in on each other, until the next check."""
        joints = self._joints
        factors = [1.0] * len(self._states)
        speed = joints.velocity
        wanted = np.minimum(np.maximum((joints.goal - joints.q) / joints.remaining, -speed), speed)
        if joints.moving:
            factors = self._proximity.factors(data, [wanted[columns] for columns in self._columns])
        for i, (r, factor) in enumerate(zip(self._states, factors, strict=True)):
            if factor < 1.0 or r.proximity < 1.0:
                self._set_cap(i)
            r.proximity = factor
            if factor < 1.0:
                columns = self._columns[i]
                joints.cap[columns] = np.minimum(joints.cap[columns], np.abs(wanted[columns]) * factor)

    def _move_targets(self) -> None:
        """Output `targets`: end-effector targets move at bounded speed; the environment's controller does the rest."""
        config, dt = self._config, self._dt
        for i, r in enumerate(self._states):
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

    def _interval(self, r: RobotState) -> float:
        """Time since the last solution [s], within what devices send: the time to arrive at the next one."""
        return min(max(self._tick - r.last_solve, self._solve_ticks) * self._dt, self._slow_interval)

    def _solved_tip(self, i: int) -> PoseTuple:
        """`T_world_tip` of the joint goal: where the robot will stand when nothing else is asked of it."""
        return compose(self._states[i].T_world_root, self._arms[i].fk(self._joints.goal[self._columns[i]]))

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
        return r.solver_limits + extra

    def _speed_limits(self, model: mujoco.MjModel) -> tuple[Floats, Floats]:
        """Velocity and acceleration limits of all joints, shape (n,). Raises `ControlError` for unknown joint names."""
        config = self._config
        names = [name for robot in self._robots for name in robot.joints]
        for name in (*config.velocity_limits, *config.acceleration_limits):
            if name not in names:
                raise ControlError(f"limit of joint {name!r}: no robot has it. Available joints: {', '.join(names)}")
        slide = [
            int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE) for arm in self._arms for j in arm.joint_ids
        ]
        velocity = [
            config.velocity_limits.get(name, config.slide_velocity if s else config.joint_velocity)
            for name, s in zip(names, slide, strict=True)
        ]
        acceleration = [
            config.acceleration_limits.get(name, config.slide_acceleration if s else config.joint_acceleration)
            for name, s in zip(names, slide, strict=True)
        ]
        return np.array(velocity), np.array(acceleration)


def _newest(command: Command) -> Applied:
    """The newest sample of a command, not applied yet (`step_ns` 0)."""
    s = max(command.sources, key=lambda source: source.receive_ns)
    return Applied(command.robot, s.participant, s.device, s.seq, s.capture_ns, s.receive_ns, 0)


def _body_pose(data: mujoco.MjData, body: int) -> PoseTuple:
    x, y, z = data.xpos[body].tolist()
    w, i, j, k = data.xquat[body].tolist()
    return ((x, y, z), (w, i, j, k))
