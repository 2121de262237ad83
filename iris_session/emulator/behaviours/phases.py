"""State machine of task phases, the common base of all scripted tasks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from anchors.pose import PoseTuple
from iris_session.emulator.behaviours.arms import ARM, ArmKind
from iris_session.emulator.behaviours.base import HandInput, OperatorView
from iris_session.emulator.behaviours.hand import ClutchedHand

#: Time to wait for a robot or object that is not in the scene [s].
SEARCH_S = 10.0


class ScenePerception(Protocol):
    """The part of perception that the state machine uses."""

    missing: tuple[str, ...]

    @property
    def is_complete(self) -> bool: ...

    def observe(self, view: OperatorView) -> None: ...

    def get_tip(self, robot: str) -> PoseTuple: ...


class PhasedTask:
    """`done` and not `failed`: it succeeded. A subclass fills `self._steps`: phase -> method called once per update.

    `back_off`: the phase in which a new attempt begins. `max_attempts`: attempts before the task fails.
    """

    back_off = "back_off"
    max_attempts = 8

    def __init__(self, robot: str, device: str, eyes: ScenePerception, arm: ArmKind = ARM) -> None:
        self.phase = "wait"
        self.done = False
        self.failed = ""
        self.attempts = 1
        self.robot, self.arm = robot, arm
        self.hand = ClutchedHand(device, robot, arm.speed)
        self._perception = eyes
        self._entering, self._entering_now = True, False
        self._entered_s = 0.0
        self._search_since_ns: int | None = None
        self._home: PoseTuple | None = None
        self._steps: dict[str, Callable[[], None]] = {"return": self._return}

    def update(self, view: OperatorView) -> tuple[HandInput, ...]:
        """Process one frame and return one hand input; see `Behaviour.update`."""
        self._perception.observe(view)
        if not self._perception.is_complete:
            self._search(view)
        if self.done:
            return (self.hand.release_robot(view),)
        can_act = self.hand.update(view, self._perception.get_tip(self.robot) if self._perception.is_complete else None)
        if can_act:
            self._entering_now, self._entering = self._entering, False
            self._steps[self.phase]()
        return (self.hand.make_input(),)

    def _search(self, view: OperatorView) -> None:
        """Fail after `SEARCH_S` while required bodies have not been in the scene."""
        if self._search_since_ns is None:
            self._search_since_ns = view.session_time_ns
        if view.session_time_ns - self._search_since_ns > SEARCH_S * 1e9:
            self._fail(f"missing in the scene: {', '.join(self._perception.missing)}")

    def _return(self) -> None:
        """Move the hand back to its initial pose."""
        if self._entering_now and self._home is not None:
            self.hand.move_to(self._home)
        if self.hand.has_arrived(0.02, 0.1) or self._has_lasted(6.0):
            self._on_returned()

    def _on_returned(self) -> None:
        """Continue after the hand is back at its initial pose."""
        self._finish()

    def _enter(self, phase: str) -> None:
        self.phase, self._entering, self._entered_s = phase, True, self.hand.now_s

    def _has_lasted(self, seconds: float) -> bool:
        """Return True if this phase has lasted `seconds`."""
        return self.hand.now_s - self._entered_s >= seconds

    def _retry(self, reason: str) -> None:
        """Start another attempt, or fail with `reason` after the last one."""
        if self.attempts >= self.max_attempts:
            self._fail(f"{reason} (after {self.attempts} attempts)")
            return
        self.attempts += 1
        self._enter(self.back_off)

    def _fail(self, reason: str) -> None:
        self.phase, self.failed, self.done = "failed", reason, True

    def _finish(self) -> None:
        self.phase, self.done = "done", True
