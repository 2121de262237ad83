"""Operators without a task: `Wander` makes small smooth motions for ever, `Idle` keeps still."""

from __future__ import annotations

import random

from anchors.pose import PoseTuple, quat_from_rotvec, quat_mul
from iris_session.emulator.behaviours.base import HandInput, OperatorView
from iris_session.emulator.behaviours.hand import ClutchedHand
from iris_session.emulator.behaviours.perception import TrackedPose
from iris_session.protocol.names import Device

#: How far the tip wanders from where it was at the start: per axis [m], and about each axis [rad].
ROAM = (0.08, 0.08, 0.05)
ROAM_TURN = 0.25


class Wander:
    """Moves the tip about its first pose: a new goal, a short rest, and at times a reclutch."""

    def __init__(self, robot: str, device: str = Device.CONTROLLER_RIGHT, seed: int = 0) -> None:
        self.phase = "wait"
        self.done = False
        self.failed = ""
        self.hand = ClutchedHand(device, robot)
        self._robot = robot
        self._random = random.Random(seed)
        self._tip: TrackedPose | None = None
        self._home: PoseTuple | None = None
        self._next_s = 0.0
        self._goals_left = 3

    def update(self, view: OperatorView) -> tuple[HandInput, ...]:
        """Return one hand input; see `Behaviour.update`."""
        seen, now_s = view.tip_pose(self._robot), view.session_time_ns * 1e-9
        if seen is not None and self._tip is None:
            self._tip = TrackedPose(seen, now_s)
        elif seen is not None and self._tip is not None:
            self._tip.update(seen, now_s)
        if self.hand.update(view, None if self._tip is None else self._tip.pose) and self._tip is not None:
            self._home = self._home or self._tip.pose
            if self.hand.now_s >= self._next_s:
                self._begin_next(self._home)
        return (self.hand.make_input(),)

    def _begin_next(self, home: PoseTuple) -> None:
        rng = self._random
        if self._goals_left == 0:
            self.phase = "clutch"
            pause_s = rng.uniform(0.4, 0.9)
            self.hand.open_clutch(pause_s)
            self._next_s, self._goals_left = self.hand.now_s + pause_s, rng.randint(2, 5)
            return
        self.phase = "move"
        self._goals_left -= 1
        x, y, z = (c + rng.uniform(-r, r) for c, r in zip(home[0], ROAM, strict=True))
        turn = quat_from_rotvec(tuple(rng.uniform(-ROAM_TURN, ROAM_TURN) for _ in range(3)))  # type: ignore[arg-type]
        self.hand.move_to(((x, y, z), quat_mul(turn, home[1])), rng.uniform(0.1, 0.3))
        self.hand.trigger_goal = rng.choice((0.0, 0.0, 0.5, 1.0))
        self._next_s = self.hand.now_s + rng.uniform(1.0, 2.0)


class Idle:
    """An operator who holds the device and does nothing."""

    def __init__(self, robot: str = "", device: str = Device.CONTROLLER_RIGHT) -> None:
        self.phase = "idle"
        self.done = False
        self.failed = ""
        self._robot, self._device = robot, device

    def update(self, view: OperatorView) -> tuple[HandInput, ...]:
        """Return the hand in its present pose, clutch open."""
        return (HandInput(self._device, self._robot, view.device_pose(self._device), False, 0.0),)
