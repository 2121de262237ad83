"""Bounds of control in one frozen struct, and its error. SI units, radians, rates in Hz; defaults for
table-top arms.
"""

from __future__ import annotations

import math
from typing import Final

import msgspec

from iris_session.protocol.common import Vec3
from iris_session.protocol.errors import IrisError

OUTPUT_CTRL: Final = "ctrl"
OUTPUT_TARGETS: Final = "targets"
SOLVER_AUTO: Final = "auto"
SOLVER_MINK: Final = "mink"
SOLVER_NUMPY: Final = "numpy"

_POSITIVE: Final = (
    "solve_rate_hz",
    "sample_rate_min_hz",
    "joint_velocity",
    "joint_acceleration",
    "slide_velocity",
    "slide_acceleration",
    "lead_s",
    "lead_bound_min_s",
    "lead_bound_max_s",
    "hold_release_s",
    "target_lead_m",
    "target_lead_rad",
    "target_lag_s",
    "tip_speed",
    "tip_angular_speed",
    "min_scale",
    "leader_apart",
    "leader_ramp_speed",
    "gripper_speed",
    "velocity_gain",
    "torque_frequency",
    "proximity_period_s",
    "tracking_error",
    "grasp_frequency",
    "grasp_max_force",
    "grasp_max_torque",
)


class ControlError(IrisError, ValueError):
    """A robot, object or configuration that control cannot drive as described. One line that says what would be
    right.
    """


class ControlConfig(msgspec.Struct, frozen=True):
    """Bounds of control. Raises `ValueError` for values that cannot work.

    `output`: `ctrl` solves inverse kinematics and writes `data.ctrl`; `targets` only moves the end-effector targets
    (`Controller.get_targets()`), for an environment with its own controller: it writes no `ctrl`.

    `solver`: of inverse kinematics. `mink` needs the extra of that name, and mujoco >= 3.10; `numpy` needs nothing;
    `auto` is `mink` where it can be imported, else `numpy`. Both take the robot to the same place.
    """

    output: str = OUTPUT_CTRL
    # --- inverse kinematics
    solver: str = SOLVER_AUTO
    solve_rate_hz: float = 100.0  # per robot, at most
    max_solves_per_tick: int = 3  # of robots in turn, where so many are needed: see `Reach.solves_per_tick`
    sample_rate_min_hz: float = 60.0  # slowest device; longer gaps between samples are not stretched into slow motion
    position_cost: float = 1.0  # [1/m]
    orientation_cost: float = 0.3  # [1/rad]: 1 mm counts as much as 3.3 mrad
    few_joints_orientation_cost: float | None = 0.01  # instead, of arms with under six: they cannot reach every pose
    posture_cost: float = 1e-2  # [1/rad]: also the damping near singularities
    posture_gain: float = 0.005  # share of the way to the rest posture per solve: an elbow 1 rad off moves at 0.4 rad/s
    lm_damping: float = 1e-2
    position_tolerance: float = 2e-5  # [m]: below both, a target counts as reached and solving stops
    rotation_tolerance: float = 1e-4  # [rad]
    singular_value: float = 0.02  # smallest singular value of the weighted Jacobian that is not reported
    # --- joint motion
    joint_velocity: float = 2.5  # [rad/s]
    joint_acceleration: float = 40.0  # [rad/s^2]
    slide_velocity: float = 0.5  # [m/s]
    slide_acceleration: float = 8.0  # [m/s^2]
    velocity_limits: dict[str, float] = {}  # by joint name, instead of the defaults above
    acceleration_limits: dict[str, float] = {}
    lead_s: float = 0.15  # an IK solution runs ahead of the commanded joints by at most this long at full speed
    # --- commanded against measured (see `hold`)
    lead_bound_min_s: float = 0.02  # a commanded joint may lead its measured position at rest, beyond gravity droop, by
    lead_bound_max_s: float = 0.06  # force limit / stiffness, within these times at its speed limit: 0.05 to 0.15 rad
    hold_release_s: float = 0.15  # a joint that is blocked when a hold begins yields for so long
    target_lead_m: float = 0.05  # output `targets`: the target may lead the measured tip by so much at rest,
    target_lead_rad: float = 0.25
    target_lag_s: float = 0.2  # and by so much time at the tip's measured speed
    target_grippers: bool = True  # output `targets`: grippers are commanded, too
    # --- end-effector target
    tip_speed: float = 1.5  # [m/s]
    tip_angular_speed: float = 5.0  # [rad/s]
    twist_lead_m: float = 0.05  # a twist target runs ahead of the solved tip by at most this
    twist_lead_rad: float = 0.25
    workspace: tuple[Vec3, Vec3] | None = None  # world box (lower, upper) of every tip target [m]
    workspaces: dict[str, tuple[Vec3, Vec3]] = {}  # by robot name, instead of `workspace`
    min_scale: float = 0.05
    max_scale: float = 5.0
    # --- leader robots
    leader_apart: float = 0.2  # [rad]: further apart than this, the follower is ramped
    leader_caught_up: float = 0.02  # [rad]: the ramp ends
    leader_ramp_speed: float = 0.5  # [rad/s]
    leader_lookahead_s: float = 0.014  # about one sample: `qd` predicts across the interpolation delay
    leader_lookahead_max: float = 0.05  # [rad]
    # --- actuators
    gripper_speed: float = 4.0  # full strokes per second
    velocity_gain: float = 20.0  # [1/s]: velocity actuators, correction of the joint error
    velocity_deadband: float = 1e-3  # [rad]: smaller errors are not corrected, so that hold commands exactly zero
    torque_frequency: float = 30.0  # [rad/s]: natural frequency of the critically damped `gravity_pd`
    # --- near contact between robots
    proximity_margin: float = 0.12  # [m]: below this distance the closing speed is bounded; 0 switches it off
    proximity_stop: float = 0.02  # [m]: at this distance it is zero
    proximity_gain: float = 4.0  # [1/s]: closing speed <= gain * (distance - stop)
    proximity_period_s: float = 0.01
    proximity_per_joint: bool = True  # only joints that close the distance are slowed; False: all of the robot alike
    proximity_stopped: bool = True  # distances also of where the robots would stop; False: only as they are
    compensate_sag: bool = True  # position servos carry gravity, payloads and friction: see `sag`
    tracking_error: float = 0.3  # [rad or m]: joints further than this from where they are commanded are reported
    # --- objects held by hands without a robot
    grasp_frequency: float = 25.0  # [rad/s]
    grasp_max_force: float = 40.0  # [N], gravity compensation not counted
    grasp_max_torque: float = 4.0  # [N m]

    def __post_init__(self) -> None:
        if self.output not in (OUTPUT_CTRL, OUTPUT_TARGETS):
            raise ValueError(f"output is {self.output!r}; it must be {OUTPUT_CTRL!r} or {OUTPUT_TARGETS!r}")
        if self.solver not in (SOLVER_AUTO, SOLVER_MINK, SOLVER_NUMPY):
            choices = f"{SOLVER_AUTO!r}, {SOLVER_MINK!r} or {SOLVER_NUMPY!r}"
            raise ValueError(f"solver is {self.solver!r}; it must be {choices}")
        for name in _POSITIVE:
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0.0):
                raise ValueError(f"{name} is {value}; it must be finite and positive")
        few = self.few_joints_orientation_cost
        if few is not None and not (math.isfinite(few) and few > 0.0):
            raise ValueError(f"few_joints_orientation_cost is {few}; it must be finite and positive, or None")
        if self.solve_rate_hz > 100.0:
            raise ValueError(f"solve_rate_hz is {self.solve_rate_hz}; it must be at most 100 Hz per robot")
        if not 1 <= self.max_solves_per_tick <= 3:
            raise ValueError(f"max_solves_per_tick is {self.max_solves_per_tick}; it must be 1 to 3")
        if self.lead_bound_max_s < self.lead_bound_min_s:
            raise ValueError(
                f"lead_bound_max_s is {self.lead_bound_max_s}; "
                f"it must be at least lead_bound_min_s {self.lead_bound_min_s}"
            )
        if self.max_scale < self.min_scale:
            raise ValueError(f"max_scale is {self.max_scale}; it must be at least min_scale {self.min_scale}")
        if self.proximity_margin > 0.0 and not 0.0 <= self.proximity_stop < self.proximity_margin:
            raise ValueError(f"proximity_stop is {self.proximity_stop}; it must be within [0, {self.proximity_margin})")
        for name, box in [("workspace", self.workspace), *self.workspaces.items()]:
            if box is not None and not all(low <= high for low, high in zip(*box, strict=True)):
                raise ValueError(f"workspace box {name!r} is {box}; its lower corner must lie below its upper one")
        for table in (self.velocity_limits, self.acceleration_limits):
            for joint, limit in table.items():
                if not (math.isfinite(limit) and limit > 0.0):
                    raise ValueError(f"limit of joint {joint!r} is {limit}; it must be finite and positive")
