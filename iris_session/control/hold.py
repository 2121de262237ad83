"""Bounds of commanded joints against measured ones: anti-windup while robots move, and the hold law.

Per joint, in rad (m for slides): `q` commanded, `x` measured, `v` measured speed, lead = q - x. The servo's force is
about `stiffness * lead - damping * v`, so a lead is a force. Two parts of it are no push: `droop`, the lead that
carries gravity where the arm stands (from `data`), and `lag * v`, the lead of free motion.

Anti-windup, in every mode: min(droop, 0) - B <= lead <= max(droop, 0) + B with B = static + lag * |v|. `static` is
where the actuator's force limit is reached (further it adds no force), within 20 to 60 ms at the joint's speed limit:
enough for the lead that accelerates a weak servo, and for a measurement that is one sample old. Measured in drags at up
to 2.5 rad/s: at most 0.82 of the bound on a Panda, with position, velocity and torque actuators; on ALOHA 0.72 at
0.15 m/s, while its weak wrist reached the bound at 0.4 m/s (151 of 700 ticks).

Hold, once whenever a robot enters it: the joint decelerates at its limit from where it is measured, at its measured
speed; its command is that motion plus `lag * speed` plus the offset that it had beyond (droop, friction), so a joint
that moves freely stops without a jump. A joint whose offset exceeds droop by more than a dead band is blocked: its
lead falls to its droop, at the joint's speed limit, and for `hold_release_s` the command follows whatever pushes the
joint back. Then the command stays until the next engagement.

No creep: at rest within the dead band nothing changes, bit for bit. A load that the model does not know (a grasped
object) makes the joint sag once; that lead is remembered as `load` and belongs to the droop of the next hold. It is
learned only by holds that let the joint go, so that pushing again and again does not raise it.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.control.arm_model import Floats
from iris_session.control.config import ControlConfig
from iris_session.control.interpolate import JointInterpolator

#: Share of the static bound that is no push yet: noise, small objects. It bounds the force that a hold leaves.
_DEAD_BAND = 0.05
#: A joint slower than this share of its speed limit is at rest when a hold begins.
_REST_SPEED = 0.02
#: Longest time without a new measurement within a step for which the bound widens [s]: user loops of 20 Hz and faster.
_STALE_S = 0.05


class Servos(NamedTuple):
    """Servos of all joints, shape (n,) each.

    `stiffness`: N m/rad (N/m) of the lead. `lag`: lead of steady motion per speed [s]. `reach`: lead at which the force
    limit is met. `slack`: lead that friction and dead bands can hold. `droops`: 1 where gravity needs a lead.
    `integrators`: columns whose actuator integrates: its force comes from the activation, not from the command.
    `supports`: position servos, whose command can carry a load by a lead (`sag`); `low`, `high`: their range of
    commands, as joint positions.
    """

    stiffness: Floats
    lag: Floats
    reach: Floats
    slack: Floats
    droops: Floats
    integrators: NDArray[np.intp]
    supports: NDArray[np.bool_]
    low: Floats
    high: Floats


class HoldLaw:
    """Bounds and holds the commanded joints of a `JointInterpolator`. All arrays shape (n,), part of the snapshot.

    `pending`: a hold has begun, the next tick measures. `held`: in hold. `left`: time until the command stays [s].
    `brake`: speed of the motion that stops [rad/s], `heading` its direction or that of the push, `offset` its lead
    beyond lag, `slack`: dead band, zero once the joint was found blocked. `load`: see above; `learning`: it may grow.
    `strained`: the bound was met since the last `take_strained`.
    """

    def __init__(
        self,
        joints: JointInterpolator,
        servos: Servos,
        qpos: NDArray[np.intp],
        dof: NDArray[np.intp],
        config: ControlConfig,
    ) -> None:
        self._joints, self.servos, self._qpos, self._dof = joints, servos, qpos, dof
        speed = joints.velocity
        self.static: Floats = np.minimum(
            np.maximum(servos.reach, config.lead_bound_min_s * speed), config.lead_bound_max_s * speed
        )
        self.dead: Floats = _DEAD_BAND * self.static + servos.slack
        #: Of the command: integrators are fed with the speed, and only their activation leads.
        self._feed: Floats = servos.lag.copy()
        self._feed[servos.integrators] = 0.0
        #: 1 where a load needs a lead of the command.
        self._carries: Floats = np.ones_like(speed)
        self._carries[servos.integrators] = 0.0
        self._rest_speed = _REST_SPEED * speed
        self._release_s = config.hold_release_s
        self._dt, self._dv, self._speed = joints.dt, joints.acceleration * joints.dt, speed
        n = len(joints.q)
        self.pending, self.held, self.left, self.brake, self.heading = (np.zeros(n) for _ in range(5))
        self.offset, self.slack, self.load, self.learning, self.strained = (np.zeros(n) for _ in range(5))
        self.stale = 0
        self.seen_time = -1.0
        #: Joint positions between which the activation of integrators must stay this tick, (2, n_integrators).
        self.act_range: Floats = np.zeros((2, len(servos.integrators)))

    # --- once a step --------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Forget everything: the joints were placed. Until a first engagement they come back to there when pushed."""
        self.forget(slice(None))
        self.begin()

    def forget(self, joints: slice | NDArray[np.intp]) -> None:
        """Forget what is known of some joints: they were placed."""
        for array in self._arrays():
            array[joints] = 0.0

    def begin(self) -> None:
        """Begin a step: its first tick has a new measurement."""
        self.stale, self.seen_time = 0, -1.0

    def enter(self, columns: slice) -> None:
        """Enter a hold: the next tick decides where the joints stop."""
        self.pending[columns] = self.held[columns] = 1.0
        self.left[columns] = 0.0

    def is_settling(self, columns: slice) -> bool:
        """Return true while the command of a hold still changes."""
        return bool(self.pending[columns].any() or self.left[columns].any())

    def leave(self, columns: slice) -> None:
        """Leave the hold: the robot is engaged."""
        self.pending[columns] = self.held[columns] = self.left[columns] = self.learning[columns] = 0.0

    def take_strained(self) -> NDArray[np.bool_]:
        """Return which joints met their bound since the last call."""
        strained = self.strained > 0.0
        self.strained[:] = 0.0
        return strained

    # --- once a tick --------------------------------------------------------------------------------------------------

    def apply(self, data: mujoco.MjData, act: Floats) -> None:
        """Bound the commanded joints by the measured ones of `data`, after they have advanced.

        `act`: activations of integrators as joint positions, shape (n_integrators,).
        """
        time = float(data.time)
        self.stale = self.stale + 1 if time == self.seen_time else 0
        self.seen_time = time
        joints = self._joints
        x = data.qpos[self._qpos]
        lead = joints.q - x
        settling = bool((self.pending + self.left).any())
        if (
            not settling
            and not act.size
            and bool((np.abs(lead) <= self.static).all())
            and not (self.learning.any() or self.load.any())
        ):
            return  # the usual case
        x = np.where(np.isfinite(x), x, joints.q)
        v = _require_finite(data.qvel[self._dof])
        load_lead = self._compute_load_lead(data)
        droop = load_lead * self.servos.droops
        window = self._speed * min(self.stale * self._dt, _STALE_S)
        if settling:
            self._begin_holds(x, v, droop, load_lead, act)
            self._settle(x, v, window)
            joints.moving = True
        bound = self.static + self.servos.lag * np.abs(v) + window
        self._bound(x + np.minimum(droop, 0.0) - bound, x + np.maximum(droop, 0.0) + bound)
        if act.size:
            self._bound_activations(x, bound, load_lead)
        self._update_loads(x, droop, load_lead, act)

    def find_rest(self, data: mujoco.MjData, act: Floats) -> Floats:
        """Return the commands with which the joints may be left for good: the present ones, unless they push."""
        x = data.qpos[self._qpos]
        x = np.where(np.isfinite(x), x, self._joints.q)
        load_lead = self._compute_load_lead(data)
        droop = load_lead * self.servos.droops
        _, excess = self._find_excess(x, np.zeros_like(x), droop, load_lead, act)
        return np.where(excess != 0.0, x + droop, self._joints.q)

    def measure(self, data: mujoco.MjData) -> tuple[Floats, Floats, Floats]:
        """Return measured positions, velocities and droops, finite, shape (n,) each."""
        x = data.qpos[self._qpos]
        x = np.where(np.isfinite(x), x, self._joints.q)
        return x, _require_finite(data.qvel[self._dof]), self._compute_load_lead(data) * self.servos.droops

    def find_band(self, droop: Floats) -> tuple[Floats, Floats]:
        """Return the leads between which a joint at rest does not push, by its droop and its load."""
        return self._band(droop, self.load * self._carries)

    def _compute_load_lead(self, data: mujoco.MjData) -> Floats:
        """Return the lead at which each servo carries gravity, Coriolis forces and springs of the model."""
        dof = self._dof
        force = data.qfrc_bias[dof] - data.qfrc_gravcomp[dof] - data.qfrc_spring[dof]
        return _require_finite(force) / self.servos.stiffness

    def _find_excess(
        self, x: Floats, speed: Floats, droop: Floats, load_lead: Floats, act: Floats
    ) -> tuple[Floats, Floats]:
        """Return the lead beyond the lag of `speed`, and by how much it exceeds what droop and load explain."""
        offset = self._joints.q - x - self._feed * speed
        excess = offset - _clip(offset, *self._band(droop, self.load * self._carries))
        columns = self.servos.integrators
        if columns.size:  # their force is in the activation
            lead = act - x[columns] - (self.servos.lag * speed)[columns]
            low, high = self._band(load_lead, self.load)
            pushed = lead - _clip(lead, low[columns], high[columns])
            excess[columns] = np.where(pushed != 0.0, pushed, excess[columns])
        return offset, excess

    def _band(self, droop: Floats, load: Floats) -> tuple[Floats, Floats]:
        """Return the leads between which a joint at rest does not push."""
        low = np.minimum(np.minimum(droop, droop + load), 0.0) - self.dead
        return low, np.maximum(np.maximum(droop, droop + load), 0.0) + self.dead

    def _begin_holds(self, x: Floats, v: Floats, droop: Floats, load_lead: Floats, act: Floats) -> None:
        """Decide where the joints stop whose hold begins in this tick."""
        new = self.pending > 0.0
        if not new.any():
            return
        joints = self._joints
        speed = _clip(v, -self._speed, self._speed)
        speed = np.where(np.abs(v) <= self._rest_speed, 0.0, speed)
        offset, excess = self._find_excess(x, speed, droop, load_lead, act)
        blocked = new & (excess != 0.0)
        heading = np.sign(np.where(blocked, excess, speed))
        load = np.where(self.load * heading > 0.0, self.load * self._carries, 0.0)
        offset = np.where(blocked, droop + load, offset)
        moving = new & ((speed != 0.0) | blocked)
        still = new & ~moving
        self.heading[new], self.brake[new], self.offset[new] = heading[new], speed[new], offset[new]
        self.slack[new] = np.where(blocked, 0.0, self.dead)[new]
        self.left[moving] = (np.abs(speed) / joints.acceleration + self._release_s)[moving]
        joints.goal[moving] = (x + offset + np.sign(speed) * joints.find_stop_distance(speed))[moving]
        joints.goal[still], joints.v[still] = joints.q[still], 0.0
        self.learning[new] = 0.0
        self.pending[:] = 0.0

    def _settle(self, x: Floats, v: Floats, window: Floats) -> None:
        """Advance the joints that stop by one tick; those that meet an obstacle, or are pushed back, give way."""
        busy = self.left > 0.0
        if not busy.any():
            return
        joints, feed = self._joints, self._feed
        self.brake[busy] = (np.sign(self.brake) * np.maximum(np.abs(self.brake) - self._dv, 0.0))[busy]
        q = joints.goal - np.sign(self.brake) * joints.find_stop_distance(self.brake) + feed * self.brake
        free = self.slack + window + feed * np.maximum(self.heading * v, 0.0)
        push = self.heading * (q - x - self.offset) - np.where(self.slack > 0.0, free, free - window)
        gives = busy & (push > 0.0)
        back = np.where(gives, self.heading * push, 0.0)
        wanted, step = q - back, self._speed * self._dt  # no command jumps, not even one that lets go
        q = _clip(wanted, joints.before - step, joints.before + step)
        joints.q[busy] = q[busy]
        joints.goal[busy] = (joints.goal - back)[busy]
        v = _clip(self.brake, joints.before_v - self._dv, joints.before_v + self._dv)
        joints.v[busy] = np.where(np.abs(self.brake) <= np.abs(joints.before_v), self.brake, v)[busy]
        met = gives & (self.slack > 0.0)
        self.left[busy] -= self._dt
        self.left[met] = self._release_s
        self.slack[met] = 0.0
        ended = busy & (self.left <= 0.0) & (q == wanted)
        self.left[busy & ~ended] = np.maximum(self.left, self._dt)[busy & ~ended]
        self.left[ended] = self.brake[ended] = 0.0
        joints.goal[ended], joints.v[ended] = joints.q[ended], 0.0
        self.learning[ended] = np.where(self.slack[ended] == 0.0, 1.0, 0.0)

    def _bound(self, low: Floats, high: Floats) -> None:
        """Keep the commanded joints within `low` and `high`. A held joint stays where it was pushed to."""
        joints = self._joints
        pulled = (joints.q < low) | (joints.q > high)
        if not pulled.any():
            return
        joints.q[pulled] = _clip(joints.q, low, high)[pulled]
        joints.v[pulled] = 0.0
        self.strained[pulled] = 1.0
        yielded = pulled & (self.held > 0.0) & (self.left == 0.0)
        joints.goal[yielded] = joints.q[yielded]
        joints.moving = True

    def _bound_activations(self, x: Floats, bound: Floats, load_lead: Floats) -> None:
        """Set `act_range`: about the measured joint while engaged, the command in hold, the droop when let go."""
        columns = self.servos.integrators
        low = x + np.minimum(load_lead, 0.0) - bound
        high = x + np.maximum(load_lead, 0.0) + bound
        band_low, band_high = self._band(load_lead, self.load)
        held = self.held > 0.0
        ahead = self._joints.q + self.servos.lag * self.brake
        low = np.where(held, np.maximum(low, ahead + band_low), low)
        high = np.where(held, np.minimum(high, ahead + band_high), high)
        gives = (self.left > 0.0) & (self.slack == 0.0)
        load = np.where(self.load * self.heading > 0.0, self.load, 0.0)
        self.act_range[0] = np.where(gives, x + load_lead + load, low)[columns]
        self.act_range[1] = np.where(gives, x + load_lead + load, np.maximum(low, high))[columns]

    def _update_loads(self, x: Floats, droop: Floats, load_lead: Floats, act: Floats) -> None:
        """Learn the leads that joints at rest need beyond their droop; forget those that they no longer need."""
        stays = (self.held > 0.0) & (self.left == 0.0)
        if not stays.any():
            return
        carried = self._joints.q - x - droop
        columns = self.servos.integrators
        if columns.size:
            carried[columns] = act - x[columns] - load_lead[columns]
        learned = _clip(carried, -self.static, self.static)
        kept = _clip(self.load, np.minimum(carried, 0.0), np.maximum(carried, 0.0))
        self.load[stays] = np.where(self.learning > 0.0, learned, kept)[stays]

    # --- snapshots ----------------------------------------------------------------------------------------------------

    def save_state(self) -> list[bytes]:
        """Return the arrays as raw bytes, for snapshots."""
        return [a.tobytes() for a in self._arrays()]

    def restore_state(self, arrays: list[bytes], stale: int, seen_time: float) -> None:
        """Restore the arrays of `save_state`, and the age of the measurement."""
        for array, raw in zip(self._arrays(), arrays, strict=True):
            array[:] = np.frombuffer(raw)
        self.stale, self.seen_time = stale, seen_time

    def _arrays(self) -> tuple[Floats, ...]:
        state = (self.pending, self.held, self.left, self.brake, self.heading)
        return (*state, self.offset, self.slack, self.load, self.learning, self.strained)


def _clip(a: Floats, low: Floats, high: Floats) -> Floats:
    return np.minimum(np.maximum(a, low), high)


def _require_finite(a: Floats) -> Floats:
    """Return `a` with zeros for values that are not finite: physics that diverged."""
    return np.where(np.isfinite(a), a, 0.0)
