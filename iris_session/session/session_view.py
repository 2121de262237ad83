"""`SessionView`: participants of a session, their leases and recent events, from the authority's own decisions.

It needs no snapshot and no query of the pure core. `status` makes reports for users and clients from it.
"""

from __future__ import annotations

import logging
from collections import Counter, defaultdict, deque
from collections.abc import Mapping
from typing import Final

import msgspec

from iris_session.protocol.common import Applied
from iris_session.protocol.entries import HOST
from iris_session.protocol.server_messages import (
    AlignmentChanged,
    Event,
    Handover,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
    PauseChanged,
    Reply,
    SamplesRejected,
    Snapshot,
)
from iris_session.protocol.session_mirror import SessionMirror
from iris_session.protocol.status import AlignmentReport, ParticipantReport, Quantiles, compute_quantiles
from iris_session.protocol.steps import ControlStatus, Decision

_log = logging.getLogger(__name__)

#: Handovers listed by the status; the recording has them all.
MAX_HANDOVERS: Final = 1000
#: Events kept for display; the recording has them all.
RECENT_EVENTS: Final = 200
#: Samples per robot whose wait for a step is remembered: two to three seconds of one device.
RECEIVE_TO_STEP: Final = 200


class HandoverStatus(msgspec.Struct, frozen=True):
    """One handover: the robots or hands, session time of its end [s], and how long both held the object [s]."""

    object: str
    giver: str
    receiver: str
    at_s: float
    duration_s: float


class SessionView:
    """Roster, leases and handovers of a session, from the authority's decisions.

    Attributes:
        mirror: Participants and leases, as a client keeps them.
        handovers: The newest handovers, at most `MAX_HANDOVERS`.
        recent: The newest events, at most `RECENT_EVENTS`.
        paused_by: Name of who paused the session, empty while it runs.
        applied: By robot, the newest sample that moved it.
        connections: The newest connection number by participant id, until the participant has left.
        rejected: Rejected samples by (participant, device, reason), at most a second old.
    """

    def __init__(self) -> None:
        self.mirror = SessionMirror()
        self.mirror.apply_snapshot(Snapshot(0, 0, 1, 0, "", 0, 0.0, 0, participants=(), leases=()))
        self.handovers: deque[HandoverStatus] = deque(maxlen=MAX_HANDOVERS)
        self.recent: deque[Event] = deque(maxlen=RECENT_EVENTS)
        self.paused_by = ""
        self.applied: dict[str, Applied] = {}
        self.connections: dict[str, int] = {}
        self.rejected: dict[tuple[str, str, str], int] = {}
        # Session time since when a participant has its alignment, or lost it to a jump of its tracking frame.
        self._aligned_ns: dict[str, int] = {}
        self._void_ns: dict[str, int] = {}
        self._receive_to_step_ns: defaultdict[str, deque[int]] = defaultdict(lambda: deque(maxlen=RECEIVE_TO_STEP))
        self._hold_reasons: dict[str, str] = {}

    def apply_step(self, decision: Decision, status: tuple[ControlStatus, ...]) -> None:
        """Apply the decision and the control status of one step."""
        for admitted in decision.admitted:
            self.connections[admitted.participant_id] = admitted.connection
        for event in decision.events:
            self._note_alignment(event)
            self.mirror.apply_event(event)
            self.recent.append(event)
            body = event.body
            if isinstance(body, ParticipantJoined):
                again = " again" if body.resumed else ""
                _log.info("%r joined as %s%s", body.participant.name, body.participant.role, again)
            elif isinstance(body, ParticipantLeft):
                _log.info("participant %s left: %r", body.participant, body.reason)
            elif isinstance(body, PauseChanged):
                person = self.mirror.participants.get(body.participant)
                self.paused_by = (person.name if person else "the session") if body.paused else ""
            elif isinstance(body, SamplesRejected):
                self.rejected[body.participant, body.device, body.reason] = body.count
            elif isinstance(body, Handover):
                times_s = event.session_time * 1e-9, body.duration_ns * 1e-9
                self.handovers.append(HandoverStatus(body.object, body.giver, body.receiver, *times_s))
        for outgoing in decision.outgoing:
            message = outgoing.message
            if outgoing.connection == HOST and isinstance(message, Snapshot):
                self._apply_snapshot(message)
            elif isinstance(message, Reply) and message.denial is not None:
                _log.info("denied to connection %d: %r", outgoing.connection, message.denial.message)
        for command in decision.commands:
            if command.hold_reason != self._hold_reasons.get(command.robot, ""):
                self._hold_reasons[command.robot] = command.hold_reason
                if command.hold_reason:
                    _log.info("%s holds: %s", command.robot, command.hold_reason)
        for robot in status:
            if robot.applied is not None and robot.applied is not self.applied.get(robot.robot):
                self._note_applied(robot.robot, robot.applied)

    def _apply_snapshot(self, snapshot: Snapshot) -> None:
        """Start from the snapshot of a resumed session."""
        self.mirror.apply_snapshot(snapshot)
        for info in snapshot.participants:
            if info.alignment is not None:
                self._aligned_ns.setdefault(info.id, snapshot.session_time)

    def _note_applied(self, robot: str, applied: Applied) -> None:
        before = self.applied.get(robot)
        self.applied[robot] = applied
        if before is None or applied.step_ns != before.step_ns:
            self._receive_to_step_ns[robot].append(applied.step_ns - applied.receive_ns)

    def _note_alignment(self, event: Event) -> None:
        """Note since when alignments hold, which events do not say. Call before the mirror applies `event`."""
        body = event.body
        if isinstance(body, AlignmentChanged):
            known = self.mirror.participants.get(body.participant)
            if known is not None and known.alignment and known.alignment.version == body.alignment.version:
                return  # it has aged
            self._aligned_ns[body.participant] = event.session_time
            self._void_ns.pop(body.participant, None)
        elif isinstance(body, ParticipantJoined | ParticipantChanged):
            info = body.participant
            known = self.mirror.participants.get(info.id)
            if info.alignment is not None:
                self._aligned_ns.setdefault(info.id, event.session_time)
            elif known is not None and known.alignment is not None:
                self._aligned_ns.pop(info.id, None)
                self._void_ns[info.id] = event.session_time
        elif isinstance(body, ParticipantLeft) and not body.grace:
            self._aligned_ns.pop(body.participant, None)
            self._void_ns.pop(body.participant, None)
            self.connections.pop(body.participant, None)
            self.rejected = {key: n for key, n in self.rejected.items() if key[0] != body.participant}

    def names_by_id(self) -> dict[str, str]:
        """Return the name of each participant by id."""
        return {info.id: info.name for info in self.mirror.participants.values()}

    def make_participant_reports(
        self, now_ns: int, alignments: Mapping[str, AlignmentReport]
    ) -> tuple[ParticipantReport, ...]:
        """Return the authority's part of the participants in a `StatusReport`; `alignments` by participant id."""
        held: defaultdict[str, list[str]] = defaultdict(list)
        waits: defaultdict[str, list[str]] = defaultdict(list)
        for lease in self.mirror.leases.values():
            for holder in lease.sub_holders or (lease.holder,):
                held[holder].append(lease.target)
            for waiting in lease.queue:
                waits[waiting].append(lease.target)
        rejected: defaultdict[str, Counter[str]] = defaultdict(Counter)
        for (participant, _, reason), count in self.rejected.items():
            rejected[participant][reason] += count
        return tuple(
            ParticipantReport(
                info.id,
                info.name,
                info.role,
                info.connected,
                worn=info.worn,
                alignment="none" if info.alignment is None else info.alignment.kind,
                alignment_age_ns=now_ns - self._aligned_ns[info.id] if info.id in self._aligned_ns else -1,
                alignment_void_ns=now_ns - self._void_ns[info.id] if info.id in self._void_ns else -1,
                alignment_error_m=_state_error(info, alignments.get(info.id)),
                tracking_epoch=info.tracking_epoch,
                holds=tuple(held[info.id]),
                waits_for=tuple(waits[info.id]),
                rejected=dict(rejected[info.id]),
                alignment_report=alignments.get(info.id),
            )
            for info in self.mirror.participants.values()
        )

    def receive_to_step_quantiles(self, robot: str) -> Quantiles | None:
        """Return how long the newest samples of a robot waited for the step that applied them."""
        return compute_quantiles(self._receive_to_step_ns.get(robot, ()))

    def compute_input_to_ctrl_ms(self) -> dict[str, float]:
        """Return by robot the age [ms] of the newest applied sample when its step began."""
        return {name: (a.step_ns - a.capture_ns) * 1e-6 for name, a in self.applied.items()}


def _state_error(info: ParticipantInfo, report: AlignmentReport | None) -> float:
    """Return the stated p95 at the robot [m]: with its age, which events say in steps only."""
    if report is not None:
        return report.error_at_robot_m
    return 0.0 if info.alignment is None else info.alignment.error_at_robot_m
