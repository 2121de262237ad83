"""What must hold of alignments in every step of a random session, kept from outside: from events and entries.

An alignment in doubt begins no engagement. One in use never leaps unannounced, and never changes while a clutch is
engaged. The command of a robot is made of the sample and of the alignment at the moment of engagement, whatever was
corrected since.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

from anchors.pose import apply, compose, distance, inverse, quat_angle
from iris_session.authority import AuthorityConfig
from iris_session.authority.state import AuthorityState, Participant
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.common import Alignment, Pose
from iris_session.protocol.entries import Entry
from iris_session.protocol.server_messages import AlignmentRun, Notice
from iris_session.protocol.steps import Decision


@dataclass
class Before:
    """One participant before a step."""

    connection: int
    tracking_epoch: int
    alignment: Alignment | None
    offset: Pose | None
    engagements: frozenset[int]
    doubt: str


@dataclass
class AlignmentBooks:
    """`came`: corrections by how they came, so that a test can tell whether it has shown anything."""

    config: AuthorityConfig
    came: Counter[str] = field(default_factory=Counter)
    _before: dict[str, Before] = field(default_factory=dict)
    _used: set[str] = field(default_factory=set)
    _told_ns: dict[str, int] = field(default_factory=dict)
    _frozen: dict[int, Pose] = field(default_factory=dict)

    def begin(self, state: AuthorityState) -> None:
        """Before a step."""
        self._before = {
            p.id: Before(p.connection, p.tracking_epoch, p.alignment, p.offset, engagements(state, p), p.doubt)
            for p in state.participants.values()
        }

    def check(self, state: AuthorityState, decision: Decision, entries: Sequence[Entry], now_ns: int) -> None:
        """After it."""
        for event in decision.events:
            if isinstance(event.body, Notice) and "is off by" in event.body.text:
                self._told_ns.setdefault(event.body.participant, now_ns)
            if isinstance(event.body, AlignmentRun) and event.body.running:
                self._used.discard(event.body.participant)
        for p in state.participants.values():
            if p.id in self._before:
                self._check_doubt(state, p, self._before[p.id])
                self._check_change(state, p, self._before[p.id], now_ns)
            if p.alignment is None:
                self._used.discard(p.id)
            elif engagements(state, p):
                self._used.add(p.id)
        self._check_commands(state, decision, entries)
        assert len(state.cross_checks) <= self.config.max_participants**2
        for c in state.cross_checks.values():
            assert c.a in state.participants
            assert c.b in state.participants

    def _check_doubt(self, state: AuthorityState, p: Participant, before: Before) -> None:
        assert p.alignment is not None or not p.doubt
        if before.doubt and p.doubt:
            self.came["doubted"] += 1
            begun = engagements(state, p) - before.engagements
            leases = (*state.robots.values(), *state.objects.values())
            devices = {g.device for lease in leases for g in lease.grants if g.engagement in begun}
            assert devices <= {"joints"}, "an alignment in doubt began an engagement"

    def _check_change(self, state: AuthorityState, p: Participant, before: Before, now_ns: int) -> None:
        old, new = before.alignment, p.alignment
        if old is None or old == new:
            return
        kept = before.engagements & engagements(state, p)
        assert not kept, "an alignment changed while its wearer was engaged"
        same_frame = (p.tracking_epoch, p.connection) == (before.tracking_epoch, before.connection)
        if new is None or not same_frame:
            self._used.discard(p.id)  # it may be aligned in the new frame already
            self._told_ns.pop(p.id, None)
        if new is None or p.id not in self._used:
            return
        assert new.version > old.version
        if new.kind == "placed" or p.offset != before.offset or p.offset is not None:
            self.came["placed"] += 1
            return
        p_tracking = apply(inverse(pair(new.T_world_tracking)), p.pivot_world)
        moved = distance(apply(pair(old.T_world_tracking), p_tracking), p.pivot_world)
        turned = quat_angle(old.T_world_tracking.q, new.T_world_tracking.q)
        seconds = self.config.slide_ns * 1e-9
        if moved <= self.config.slide_m_per_s * seconds + 1e-6 and turned <= math.radians(0.3) * seconds + 1e-4:
            self.came["slid"] += 1
            return
        assert now_ns - self._told_ns.pop(p.id, now_ns) >= self.config.announce_ns, "it came without a word"
        self.came["announced"] += 1

    def _check_commands(self, state: AuthorityState, decision: Decision, entries: Sequence[Entry]) -> None:
        sent = {
            (e.connection, e.message.device, e.message.seq): e.message for e in entries if isinstance(e.message, Sample)
        }
        for source in (s for c in decision.commands for s in c.sources):
            p = state.participants[source.participant]
            if source.pose_world is None or p.alignment is None:
                continue
            T = self._frozen.setdefault(source.engagement, p.alignment.T_world_tracking)
            sample = sent.get((p.connection, source.device, source.seq))
            if source.new and sample is not None and sample.pose is not None:
                assert pair(source.pose_world) == compose(pair(T), pair(sample.pose)), "a correction moved a robot"


def engagements(state: AuthorityState, p: Participant) -> frozenset[int]:
    """Numbers of everything that `p` moves now."""
    leases = (*state.robots.values(), *state.objects.values())
    return frozenset(g.engagement for lease in leases for g in lease.grants if g.participant == p.id and g.engagement)


def pair(T: Pose) -> tuple[tuple[float, float, float], tuple[float, float, float, float]]:
    return T.p, T.q
