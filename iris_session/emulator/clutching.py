"""The clutch as a person works it: when the robot holds although it is closed, open it and close it again."""

from __future__ import annotations

from typing import Final

from iris_session.client import Client
from iris_session.emulator.behaviours import HandInput
from iris_session.protocol.names import CommandKind, HoldReason

RECLUTCH_AFTER_S: Final = 0.25  # clutch closed but the robot holds: open it ...
RECLUTCH_SAMPLES: Final = 3  # ... for this many samples

#: Reasons of a hold that end by clutching again.
CLUTCH_AGAIN: Final = frozenset(
    {HoldReason.REARM, HoldReason.REJECTED, HoldReason.STALE, HoldReason.GAP, HoldReason.SCENE_CHANGED,
     HoldReason.NO_SAMPLE, HoldReason.DISCONNECTED, HoldReason.ESTOP, HoldReason.UNTRACKED, HoldReason.NOT_WORN,
     HoldReason.UNALIGNED}
)  # fmt: skip


class Clutch:
    """The clutch of one hand on one robot. `reclutches` counts how often it had to be worked again."""

    def __init__(self) -> None:
        self.reclutches = 0
        self._open = RECLUTCH_SAMPLES  # samples for which it stays open
        self._holding_since = 0
        self._lease_version: int | None = None

    def open(self) -> None:
        """Opens it for a moment."""
        self._open = RECLUTCH_SAMPLES

    def sample(self, hand: HandInput, client: Client, estop: bool, now_ns: int) -> bool:
        """Whether it is closed in the sample that is made now [local ns]."""
        lease_version = client.lease_version(hand.robot)
        if lease_version != self._lease_version:  # a new lease arms only after it has seen the clutch open
            self._lease_version = lease_version
            self.open()
        if self._open > 0:
            self._open -= 1
            return False
        feedback = client.feedback.get(hand.robot)
        holds = feedback is not None and feedback.state == CommandKind.HOLD and feedback.hold_reason in CLUTCH_AGAIN
        if not (hand.clutch and holds) or estop:
            self._holding_since = 0
        elif not self._holding_since:
            self._holding_since = now_ns
        elif now_ns - self._holding_since > RECLUTCH_AFTER_S * 1e9:
            self._holding_since = 0
            self.open()
            self.reclutches += 1
        return hand.clutch
