"""State machine of task phases, the common base of all scripted tasks."""

from __future__ import annotations

from collections.abc import Callable

from anchors.pose import PoseTuple
from iris_session.emulator.behaviours.base import HandInput, OperatorView
from iris_session.emulator.behaviours.hand import ClutchedHand
from iris_session.emulator.behaviours.objects import ARM, ArmKind, raise_pose
from iris_session.emulator.behaviours.perception import Perception

#: Time to wait for a robot or object that is not in the scene [s].
SEARCH_S = 10.0


class PhasedTask:
    """`done` and not `failed`: it succeeded. A subclass fills `self._steps`: phase -> method called once per update.

    `first_phase`: the phase after `wait`. `max_attempts`: attempts, each of which begins with the phase `back_off`,
    before the task fails.
    """

    first_phase = "look"
    max_attempts = 8

    def __init__(self, robot: str, device: str, eyes: Perception, arm: ArmKind = ARM) -> None:
        self.phase = "wait"
        self.done = False
        self.failed = ""
        self.attempts = 1
        self.fault = ""  # of the attempt before this one
        self.robot, self.arm = robot, arm
        self.hand = ClutchedHand(device, robot, arm.speed)
        self.perception = eyes
        self._entering, self._entering_now = True, False
        self._entered_s = 0.0
        self._search_since_ns: int | None = None
        self._home: PoseTuple | None = None
        self._steps: dict[str, Callable[[], None]] = {"wait": self._wait, "return": self._return}

    def update(self, view: OperatorView) -> tuple[HandInput, ...]:
        """Process one frame and return one hand input; see `Behaviour.update`."""
        self.perception.observe(view)
        if not self.perception.is_complete:
            self._search(view)
        if self.done:
            return (self.hand.release_robot(view),)
        can_act = self.hand.update(view, self.perception.get_tip(self.robot) if self.perception.is_complete else None)
        if can_act:
            self._entering_now, self._entering = self._entering, False
            self._steps[self.phase]()
        return (self.hand.make_input(),)

    def _search(self, view: OperatorView) -> None:
        """Fail after `SEARCH_S` while required bodies have not been in the scene."""
        if self._search_since_ns is None:
            self._search_since_ns = view.session_time_ns
        if view.session_time_ns - self._search_since_ns > SEARCH_S * 1e9:
            self._fail(f"missing in the scene: {', '.join(self.perception.missing)}")

    def _wait(self) -> None:
        self._home = self.perception.get_tip(self.robot)
        self._enter(self.first_phase)

    def _reach(
        self,
        goal: Callable[[], PoseTuple],
        then: str,
        within: tuple[float, float],
        limit_s: float,
        fault: str = "",
        *,
        speed: float | None = None,
        trigger: float | None = None,
    ) -> None:
        """Move the tip to a goal, and continue.

        Args:
            goal: Computes the tip pose at the beginning of the phase.
            then: Phase after it has arrived.
            within: How near the tip must be ([m], [rad]).
            limit_s: Time after which another attempt begins with `fault`; without one, the task continues with `then`.
            fault: Reason of another attempt.
            speed: Peak speed [m/s], by default that of free movements.
            trigger: Where to move the trigger meanwhile, which then must be there, too.
        """
        if self._entering_now:
            self.hand.trigger_goal = self.hand.trigger_goal if trigger is None else trigger
            self.hand.move_to(goal(), speed)
        if self.hand.has_arrived(*within) and (trigger is None or self.hand.is_trigger_done()):
            self._enter(then)
        elif self._has_lasted(limit_s) and fault:
            self._retry(fault)
        elif self._has_lasted(limit_s):
            self._enter(then)

    def _rise(self, height: float, then: str, speed: float | None = None, trigger: float | None = None) -> None:
        """Move the tip straight up, without a look at where it gets, and continue."""
        if self._entering_now:
            self.hand.trigger_goal = self.hand.trigger_goal if trigger is None else trigger
            self.hand.move_to(raise_pose(self.perception.get_tip(self.robot), height), speed, correct=False)
        if self.hand.has_moved() and (trigger is None or (self.hand.is_trigger_done() and self._has_lasted(1.5))):
            self._enter(then)

    def _compute_table_height(self) -> float:
        """Return the height of the table [m], world frame."""
        return self.perception.get_base(self.robot)[0][2] - self.arm.above_table

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
        self.fault = reason
        self._enter("back_off")

    def _fail(self, reason: str) -> None:
        self.phase, self.failed, self.done = "failed", reason, True

    def _finish(self) -> None:
        self.phase, self.done = "done", True
