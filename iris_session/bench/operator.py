"""Scripted operator of benchmarks that step a session core in simulated time, without processes."""

from __future__ import annotations

from typing import Final, NamedTuple

from iris_session.protocol.client_messages import Acquire, Sample
from iris_session.protocol.common import IDENTITY, Pose, Target
from iris_session.protocol.entries import AlignmentProposal, Entry, EntryMessage, Join
from iris_session.protocol.names import Role

#: Steps in which it joins, is aligned and acquires the robot; no sample is accepted before the next one.
OPENING_STEPS: Final = 3
_COVARIANCE: Final = tuple(1e-8 if i % 7 == 0 else 0.0 for i in range(36))


class ScriptedOperator(NamedTuple):
    """The one operator of a session, who drives a robot with a device."""

    device: str
    robot: str

    def make_entry(self, message: EntryMessage, now_ns: int) -> Entry:
        """Return a message as the session receives it."""
        return Entry(1, 1, now_ns, message)

    def make_opening(self, step: int, now_ns: int) -> list[Entry]:
        """Return what it sends in one of the first steps, nothing after them."""
        messages: tuple[EntryMessage, ...] = (
            Join("key", Role.OPERATOR, "ann", devices=(self.device,)),
            AlignmentProposal(IDENTITY, 0, _COVARIANCE, (0.0, 0.0, 0.0), 1e-3),
            Acquire(1, (self.robot,)),
        )
        return [self.make_entry(message, now_ns) for message in messages[step : step + 1]]

    def make_sample(self, pose: Pose, capture_ns: int, clutch: bool) -> Sample:
        """Return the sample of a time [ns], at most one for each millisecond."""
        seq, targets = capture_ns // 1_000_000, (Target(self.robot, 1),)
        return Sample(self.device, "pose", seq, capture_ns, 1, 0, 1, targets, clutch=clutch, pose=pose)
