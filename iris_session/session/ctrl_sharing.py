"""`CtrlSharing`: whose `ctrl` counts in a user loop, per robot: the owner's or control's, and the way between the two.

The owner's counts until a participant that holds the robot engages. From then on control's counts, while the clutch is
open, too, until that participant no longer holds the robot. Both changes are continuous:

- Taken over: the first `ctrl` is the one in force. What it differs from control's fades within `FADE_S`, or slower
  where a limit of the robot asks for that. Position actuators do not differ, because control begins where `ctrl` is.
- Given back: `ctrl = owner + share * (hold - owner)`, both as they are in that tick. `share` goes from 1 to 0 within
  `RETURN_S`, or slower, so that the way between the two takes no joint faster than its limit. While the e-stop is
  latched nothing is given back.

Pure, as the core that it is part of: the owner's `ctrl` is in the plant of the journal's rows, `snapshot` has the rest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.control import Controller
from iris_session.protocol.names import CommandKind
from iris_session.protocol.steps import Decision

#: Shortest time in which control takes over [s of simulation].
FADE_S: Final = 0.1
#: Shortest time in which a robot is given back to its owner [s of simulation].
RETURN_S: Final = 0.5

Floats = NDArray[np.float64]


class RobotShare(msgspec.Struct, array_like=True):
    """One robot.

    `drivers`: participants that hold it and have engaged since they got it. `share`: weight of control's `ctrl`, 1
    while it is driven, 0 when it is the owner's. `start`: the `ctrl` in force when control took over, until the first
    tick. `offset`: of the first tick's, which fades by the factor `fade`. `written`: `ctrl` of the newest tick.
    """

    drivers: list[str] = []
    share: float = 0.0
    start: list[float] = []
    offset: list[float] = []
    fade: float = 0.0
    written: list[float] = []


_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(list[RobotShare])


class CtrlSharing:
    """Shares `ctrl` of the robots of one scene between its owner and `controller`. `dt`: timestep [s]."""

    def __init__(self, robots: Sequence[str], controller: Controller, dt: float) -> None:
        self._names = tuple(robots)
        self._controller = controller
        self._outputs = controller.list_outputs()
        self._dt = dt
        self._robots = [RobotShare() for _ in self._names]

    def reset(self) -> None:
        """Make every robot the owner's, at once: the owner has placed them anew."""
        self._robots = [RobotShare() for _ in self._names]

    @property
    def driven(self) -> tuple[str, ...]:
        """Robots that are not wholly the owner's."""
        return tuple(name for name, r in zip(self._names, self._robots, strict=True) if r.share > 0.0)

    @property
    def actuators(self) -> NDArray[np.intp]:
        """Actuators of the robots that are not wholly the owner's."""
        ids = [out.actuators for out, r in zip(self._outputs, self._robots, strict=True) if r.share > 0.0]
        return np.concatenate(ids) if ids else np.zeros(0, np.intp)

    def begin(self, decision: Decision, holders: Mapping[str, tuple[str, ...]], data: Any, owner: Floats) -> None:
        """Take over what is engaged in this step; call it before the controller's `begin`.

        Args:
            decision, holders: Of the step.
            data: The plant at its beginning.
            owner: The owner's `ctrl`, shape (nu,).
        """
        engaged = {
            command.robot: [source.participant for source in command.sources]
            for command in decision.commands
            if command.kind != CommandKind.HOLD and command.sources
        }
        for i, (name, r) in enumerate(zip(self._names, self._robots, strict=True)):
            if not r.share and name not in engaged:
                continue
            was_driven = bool(r.drivers)
            held = holders.get(name, ())
            r.drivers = [p for p in r.drivers if p in held]
            r.drivers += [p for p in engaged.get(name, ()) if p not in r.drivers]
            is_stopped = decision.estop and r.share < 1.0 and not was_driven
            # Anew until the first tick: the owner's `ctrl` has gone on since a step without ticks.
            if (r.drivers and (not was_driven or r.start)) or is_stopped:
                self._take_over(i, r, data, owner)
        self._controller.follow_robots(data, [i for i, r in enumerate(self._robots) if not r.share])

    def _take_over(self, i: int, r: RobotShare, data: Any, owner: Floats) -> None:
        actuators = self._outputs[i].actuators
        now = owner.copy()
        if r.share and r.written:
            now[actuators] = r.written
        now[~np.isfinite(now)] = 0.0
        self._controller.place_robot(i, data, now)
        r.share, r.start, r.offset, r.fade = 1.0, now[actuators].tolist(), [], 0.0

    def apply(self, ctrl: Floats, owner: Floats, n_ticks: int, *, estop: bool) -> None:
        """Replace control's `ctrl` of the newest of `n_ticks` ticks by what counts, in place, shape (nu,) each.

        Nothing that is not finite is written: then `ctrl` stays as it was in the tick before.
        """
        duration = n_ticks * self._dt
        for out, r in zip(self._outputs, self._robots, strict=True):
            mine, theirs = ctrl[out.actuators], owner[out.actuators]
            if not r.share:
                ctrl[out.actuators] = theirs
                continue
            if not out.actuators.size:  # output `targets`: there is no way back to walk
                r.share = 1.0 if r.drivers or estop else 0.0
                continue
            if not np.isfinite(mine).all():
                mine = np.array(r.written) if r.written else theirs
            if r.drivers or estop:
                value = self._fade_in(r, mine, out.rates, duration)
            else:
                value = self._give_back(r, mine, theirs, out.rates, duration)
            r.written = value.tolist() if r.share else []
            ctrl[out.actuators] = value

    def restore_owner_ctrl(self, ctrl: Floats, owner: Floats) -> None:
        """Put the owner's `ctrl` back where it counts alone, in place; what control drives stays as it is."""
        for out, r in zip(self._outputs, self._robots, strict=True):
            if not r.share:
                ctrl[out.actuators] = owner[out.actuators]

    def _fade_in(self, r: RobotShare, mine: Floats, rates: Floats, duration: float) -> Floats:
        r.share = 1.0
        if r.start:
            offset = np.array(r.start) - mine
            r.start = []
            r.offset, r.fade = (offset.tolist(), 1.0) if np.abs(offset).max() > 1e-12 else ([], 0.0)
        elif r.fade:
            seconds = max(FADE_S, float((np.abs(r.offset) / rates).max()))
            r.fade = max(0.0, r.fade - duration / seconds)
        return mine + r.fade * np.array(r.offset) if r.fade else mine

    def _give_back(self, r: RobotShare, mine: Floats, theirs: Floats, rates: Floats, duration: float) -> Floats:
        if r.fade:
            mine = mine + r.fade * np.array(r.offset)
        if not np.isfinite(theirs).all():
            return mine
        seconds = max(RETURN_S, float((np.abs(theirs - mine) / rates).max(initial=0.0)))
        r.share = max(0.0, r.share - duration / seconds)
        if r.share < 1e-9:
            r.share, r.fade, r.offset = 0.0, 0.0, []
            return theirs
        return theirs + r.share * (mine - theirs)

    def snapshot(self) -> bytes:
        """Return the whole memory."""
        return _encoder.encode(self._robots)

    def restore(self, data: bytes) -> None:
        """Restore a `snapshot` of a scene with the same robots. Raises `ValueError` for another one."""
        robots = _decoder.decode(data)
        if len(robots) != len(self._names):
            raise ValueError(f"snapshot of {len(robots)} robots, but this scene has {len(self._names)}")
        self._robots = robots
