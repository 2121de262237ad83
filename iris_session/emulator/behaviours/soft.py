"""What tasks with something that bends have in common: it is held as long as nothing else is seen."""

from __future__ import annotations

from abc import abstractmethod

from iris_session.emulator.behaviours.arms import ArmKind
from iris_session.emulator.behaviours.deformables import SoftEyes
from iris_session.emulator.behaviours.phases import Phases

#: The picture of a deformable may come so much later than that of the fingers which hold it [s].
PICTURE_LATE_S: float = 10.0
#: So long a picture must go on showing that it is not held [s].
SEEN_S: float = 0.6


class SoftPhases(Phases):
    """Phases of a task with what `eyes` watch."""

    def __init__(self, robot: str, device: str, eyes: SoftEyes, arm: ArmKind) -> None:
        self.eyes = eyes
        super().__init__(robot, device, eyes, arm)
        self._lost_s: float | None = None  # since when it seems to stay behind; session time
        self._phase_s = 0.0  # when the phase began; session time

    def _enter(self, phase: str) -> None:
        super()._enter(phase)
        self._phase_s = self.eyes.now_s

    def _seen_for(self, seconds: float) -> bool:
        """Whether the picture shows the first `seconds` of this phase, or is too late for that."""
        return self.eyes.captured_s > self._phase_s + seconds or self._waited(seconds + PICTURE_LATE_S)

    @abstractmethod
    def _holding(self) -> bool:
        """Whether it is seen to go with the fingers."""

    def _stays_behind(self, reason: str) -> bool:
        """Whether it is not seen to go with the fingers. Its picture may only be late: the hand stands still until it
        shows the same moment, then the phase begins again; or it is lost for `reason`, and another attempt begins."""
        now_s, lost_s = self.eyes.now_s, self._lost_s
        if self._holding():
            if lost_s is not None:
                self._lost_s = None
                self._enter(self.phase)
            return lost_s is not None
        if lost_s is None:
            self._lost_s = now_s
            self.hand.move_to(self.eyes.tip(self.robot), correct=False)
        elif self.eyes.captured_s > lost_s + SEEN_S or now_s > lost_s + PICTURE_LATE_S:
            self._lost_s = None
            self._retry(reason)
        return True
