"""What a session shows about itself: roster, leases, alignment, lateness, latency, drops. Plain values for people.

`SessionLedger` follows the authority's own events, so it needs no snapshot and no question to the pure core.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import msgspec

from iris_session.protocol.common import Applied
from iris_session.protocol.entries import HOST
from iris_session.protocol.server_messages import (
    AlignmentChanged,
    Event,
    Handover,
    ParticipantChanged,
    ParticipantJoined,
    ParticipantLeft,
    SamplesRejected,
    Snapshot,
)
from iris_session.protocol.session_mirror import SessionMirror
from iris_session.protocol.status import AlignmentReport, ParticipantReport, Quantiles, compute_quantiles
from iris_session.protocol.steps import ControlStatus, Decision

if TYPE_CHECKING:
    from iris_session.physics import Pacer
    from iris_session.session.processes import SessionProcesses
    from iris_session.session.stepper import Stepper

#: Events kept for display; the recording has them all.
RECENT_EVENTS: Final = 200
#: Samples per robot whose wait for a step is remembered: two to three seconds of one device.
RECEIVE_TO_STEP: Final = 200


class ParticipantStatus(msgspec.Struct, frozen=True):
    """One row: `alignment_mm` is the stated p95 error at the robot, None without a measured alignment."""

    id: str
    name: str
    role: str
    connected: bool
    robots: tuple[str, ...]
    alignment: str
    alignment_mm: float | None


class HandoverStatus(msgspec.Struct, frozen=True):
    object: str
    giver: str
    receiver: str
    at_s: float
    duration_s: float


class SessionStatus(msgspec.Struct, frozen=True):
    """`lateness`: ticks, late, late_share, p50_ms, p99_ms. `input_to_ctrl_ms`: capture of the newest applied sample to
    the step that used it, per robot. `drops`: by reason. `scheduling`: `realtime` or `normal`."""

    session_time_s: float
    tick: int
    sim_time: float
    paused: bool
    estop: bool
    participants: tuple[ParticipantStatus, ...]
    handovers: tuple[HandoverStatus, ...]
    lateness: dict[str, float]
    input_to_ctrl_ms: dict[str, float]
    drops: dict[str, int]
    restarts: dict[str, int]
    scheduling: str = "normal"

    def as_dict(self) -> dict[str, Any]:
        return dict(msgspec.to_builtins(self))


class SessionLedger:
    """Roster, leases and handovers as the decisions tell them."""

    def __init__(self) -> None:
        self.mirror = SessionMirror()
        self.mirror.apply_snapshot(Snapshot(0, 0, 1, 0, "", 0, 0.0, 0, participants=(), leases=()))
        self.handovers: list[HandoverStatus] = []
        self.recent: deque[Event] = deque(maxlen=RECENT_EVENTS)
        self.applied: dict[str, Applied] = {}
        #: Connection number -> participant id, newest connections included.
        self.connections: dict[int, str] = {}
        #: Samples not counted so far, by reason, as events tell (at most a second old).
        self.rejected: dict[tuple[str, str, str], int] = {}
        #: Session time since when a participant has its alignment, or has lost it to a jump of its tracking frame.
        self._aligned_ns: dict[str, int] = {}
        self._void_ns: dict[str, int] = {}
        self._receive_to_step_ns: dict[str, deque[int]] = {}

    def follow(self, decision: Decision, status: tuple[ControlStatus, ...]) -> None:
        """Takes over one step."""
        for admitted in decision.admitted:
            self.connections[admitted.connection] = admitted.participant_id
        for dropped in decision.dropped:
            self.connections.pop(dropped.connection, None)
        for event in decision.events:
            self._follow_alignment(event)
            self.mirror.apply_event(event)
            self.recent.append(event)
            body = event.body
            if isinstance(body, SamplesRejected):
                self.rejected[body.participant, body.device, body.reason] = body.count
            if isinstance(body, Handover):
                self.handovers.append(
                    HandoverStatus(
                        body.object, body.giver, body.receiver, event.session_time * 1e-9, body.duration_ns * 1e-9
                    )
                )
        for outgoing in decision.outgoing:
            if outgoing.connection == HOST and isinstance(outgoing.message, Snapshot):
                self._begin(outgoing.message)
        for robot in status:
            if robot.applied is not None and robot.applied is not self.applied.get(robot.robot):
                self._follow_applied(robot.robot, robot.applied)

    def _begin(self, snapshot: Snapshot) -> None:
        """A resumed session: who was in it, what they held."""
        self.mirror.apply_snapshot(snapshot)
        for info in snapshot.participants:
            if info.alignment is not None:
                self._aligned_ns.setdefault(info.id, snapshot.session_time)

    def _follow_applied(self, robot: str, applied: Applied) -> None:
        before = self.applied.get(robot)
        self.applied[robot] = applied
        if before is None or applied.step_ns != before.step_ns:
            delays = self._receive_to_step_ns.get(robot)
            if delays is None:
                delays = self._receive_to_step_ns[robot] = deque(maxlen=RECEIVE_TO_STEP)
            delays.append(applied.step_ns - applied.receive_ns)

    def _follow_alignment(self, event: Event) -> None:
        """Events tell how an alignment is, not since when. Called before the mirror knows of `event`."""
        body = event.body
        if isinstance(body, AlignmentChanged):
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
            self.rejected = {key: n for key, n in self.rejected.items() if key[0] != body.participant}

    def names(self) -> dict[str, str]:
        """Participant id -> name."""
        return {info.id: info.name for info in self.mirror.participants.values()}

    def _held(self) -> dict[str, list[str]]:
        """Participant id -> robots and objects."""
        held: dict[str, list[str]] = {}
        for lease in self.mirror.leases.values():
            for holder in lease.sub_holders or ((lease.holder,) if lease.holder else ()):
                held.setdefault(holder, []).append(lease.target)
        return held

    def participants(self) -> tuple[ParticipantStatus, ...]:
        """The roster with what each participant holds."""
        held = self._held()
        rows = []
        for info in self.mirror.participants.values():
            alignment = info.alignment
            measured = alignment is not None and alignment.kind == "measured"
            rows.append(
                ParticipantStatus(
                    info.id,
                    info.name,
                    info.role,
                    info.connected,
                    tuple(held.get(info.id, ())),
                    "none" if alignment is None else alignment.kind,
                    alignment.error_at_robot_m * 1e3 if alignment is not None and measured else None,
                )
            )
        return tuple(rows)

    def participant_reports(
        self, now_ns: int, alignments: Mapping[str, AlignmentReport] = MappingProxyType({})
    ) -> tuple[ParticipantReport, ...]:
        """The authority's part of the roster in a `StatusReport`. `alignments`: by participant."""
        held = self._held()
        waits: dict[str, list[str]] = {}
        for lease in self.mirror.leases.values():
            for waiting in lease.queue:
                waits.setdefault(waiting, []).append(lease.target)
        rejected: dict[str, dict[str, int]] = {}
        for (participant, _, reason), count in self.rejected.items():
            counts = rejected.setdefault(participant, {})
            counts[reason] = counts.get(reason, 0) + count
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
                alignment_error_m=0.0 if info.alignment is None else info.alignment.error_at_robot_m,
                tracking_epoch=info.tracking_epoch,
                holds=tuple(held.get(info.id, ())),
                waits_for=tuple(waits.get(info.id, ())),
                rejected=rejected.get(info.id, {}),
                alignment_report=alignments.get(info.id),
            )
            for info in self.mirror.participants.values()
        )

    def receive_to_step(self, robot: str) -> Quantiles | None:
        """How long the newest samples behind a robot's motion waited for the step that used them."""
        return compute_quantiles(self._receive_to_step_ns.get(robot, ()))

    def input_to_ctrl_ms(self) -> dict[str, float]:
        """Per robot: age of the newest applied sample when its step began to use it."""
        return {name: (a.step_ns - a.capture_ns) * 1e-6 for name, a in self.applied.items()}


def make_status(
    stepper: Stepper | None, pacer: Pacer | None, processes: SessionProcesses | None, scheduling: str
) -> SessionStatus:
    """The status now; empty before the first step."""
    drops = {} if processes is None else processes.drops()
    restarts = {} if processes is None else processes.restarts()
    if stepper is None or stepper.last is None:
        return SessionStatus(0.0, 0, 0.0, False, False, (), (), {}, {}, drops, restarts, scheduling)
    now_ns = stepper.clock()
    lateness = {}
    if pacer is not None:
        stats = pacer.get_stats(now_ns)
        lateness = {
            "ticks": stats.ticks,
            "late": stats.late,
            "late_share": stats.late_share,
            "p50_ms": stats.p50_ns * 1e-6,
            "p99_ms": stats.p99_ns * 1e-6,
            "max_ms": stats.max_ns * 1e-6,
        }
    view, ledger, decision = stepper.core.world.view(), stepper.ledger, stepper.last.decision
    return SessionStatus(
        now_ns * 1e-9,
        view.tick,
        view.sim_time,
        decision.paused,
        decision.estop,
        ledger.participants(),
        tuple(ledger.handovers),
        lateness,
        ledger.input_to_ctrl_ms(),
        drops,
        restarts,
        scheduling,
    )
