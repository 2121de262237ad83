"""The context of one step: state, configuration, time, view, and the effects collected so far.

Every other module of this room is functions over a `Context`; their arguments are `ctx`, a participant `p`, a grant `g`
and a message `m`. It holds no state of its own that outlives a step except caches that are derived from
`AuthorityState` and rebuilt by `adopt_state`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import msgspec

from iris_session.authority.config import AuthorityConfig
from iris_session.authority.state import HOST_ID, NO_CONNECTION, AuthorityState, LeaseGrant, LeaseState, Participant
from iris_session.protocol.common import Denial, Lease
from iris_session.protocol.names import DenialReason, EpisodeState, LeaseMode, Role, TargetKind
from iris_session.protocol.server_messages import (
    MAX_LEASES,
    AlignmentChanged,
    Event,
    EventKind,
    LeaseChanged,
    LeasesChanged,
    ParticipantChanged,
    ParticipantInfo,
    PresenceItem,
    Refused,
    Reply,
    ServerMessage,
)
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import Admitted, ControlStatus, Dropped, FixedView, OutgoingMessage, WorldView

#: Roles of people: they preempt agents in mode `priority`. A leader arm is moved by a human hand.
HUMAN = (Role.OPERATOR, Role.DIRECTOR, Role.LEADER)


class Context:
    """State plus the step in progress."""

    def __init__(
        self, config: AuthorityConfig, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec], state: AuthorityState
    ) -> None:
        self.config = config
        self.set_targets(robots, objects)
        #: Scale of a robot until another one is set.
        self.default_scale = min(max(1.0, config.min_scale), config.max_scale)
        self.view: WorldView = FixedView()
        self.control: Sequence[ControlStatus] = ()
        self.now_ns = 0
        #: When the front stamped the entry that is being handled.
        self.entry_ns = 0
        self.adopt_state(state)
        self.clear_effects()

    def set_targets(self, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec]) -> None:
        """Set the robots and objects of the scene."""
        self.robots = {r.name: r for r in robots}
        self.objects = {o.name: o for o in objects}

    def adopt_state(self, state: AuthorityState) -> None:
        """Replace the state by `state` and rebuild everything derived from it."""
        self.state = state
        # For look-ups only: its order is not that of the state, so nothing may iterate over it.
        self.by_connection = {p.connection: p for p in state.participants.values() if p.connection != NO_CONNECTION}
        self.update_held_objects()

    def update_held_objects(self) -> None:
        """Rebuild the list of objects with grants, in the order of the specification."""
        self.held_objects = [lease for lease in self.state.objects.values() if lease.grants]

    def clear_effects(self) -> None:
        """Empty the effects before a step."""
        self.outgoing: list[OutgoingMessage] = []
        self.admitted: list[Admitted] = []
        self.dropped: list[Dropped] = []
        self.events: list[Event] = []
        self.presence: dict[tuple[str, str], PresenceItem] = {}
        self.snapshots: dict[tuple[int, int], None] = {}  # (connection, request_id) in order
        self.reset = False
        self.step_ticks = 0
        #: Connections whose e-stop was counted in this step. For look-ups only.
        self.stopped_by: set[int] = set()

    @property
    def is_closing(self) -> bool:
        """True while an episode is closing, so that every robot holds."""
        return self.state.episode is not None and self.state.episode.state == EpisodeState.CLOSING

    # --- effects ---

    def emit(self, body: EventKind) -> None:
        """Append one event to the shared history."""
        state = self.state
        state.event_seq += 1
        self.events.append(Event(state.event_seq, state.step, self.now_ns, body))

    def send(self, p: Participant, message: ServerMessage) -> None:
        """Send a message to one participant; do nothing while it is disconnected."""
        if p.connection != NO_CONNECTION:
            self.outgoing.append(OutgoingMessage(p.connection, message))

    def refuse_hello(self, connection: int, code: str, message: str, advice: str = "") -> None:
        """Refuse a `hello`; the front closes the connection."""
        self.outgoing.append(OutgoingMessage(connection, Refused(code, message, advice)))

    def accept(self, p: Participant, request_id: int, leases: Sequence[LeaseState] = ()) -> None:
        """Grant a request and reply with the leases as they are now."""
        self.send(p, Reply(request_id, True, None, tuple(self.to_lease(lease) for lease in leases)))

    def deny(self, p: Participant, request_id: int, denial: Denial) -> None:
        """Deny a request with a typed reason."""
        self.send(p, Reply(request_id, False, denial))

    # --- look-ups and views ---

    def find_lease(self, kind: str, name: str) -> LeaseState | None:
        """Return the lease of a target, `None` when kind or name is unknown."""
        if kind == TargetKind.ROBOT:
            return self.state.robots.get(name)
        return self.state.objects.get(name) if kind == TargetKind.OBJECT else None

    def find_participant(self, name: str) -> Participant | None:
        """Return a participant by id, or by name when exactly one has it."""
        found = self.state.participants.get(name)
        if found is None:
            named = [p for p in self.state.participants.values() if p.name == name and p.id != HOST_ID]
            found = named[0] if len(named) == 1 else None
        return found

    def get_holder(self, lease: LeaseState) -> str:
        """Return the participant in charge of a target: the overriding human, else the first holder;
        empty when free.
        """
        return lease.override or (lease.grants[0].participant if lease.grants else "")

    def get_scale(self, lease: LeaseState) -> float:
        """Return the motion scaling of the participant in charge; for a free robot, that of its next holder."""
        holder = self.get_holder(lease)
        return next((g.scale for g in lease.grants if g.participant == holder), self.default_scale)

    def to_lease(self, lease: LeaseState) -> Lease:
        """Return a lease in its public form. In mode `priority` an agent and its stand-by human are both
        sub-holders.
        """
        holder = self.get_holder(lease)
        expires = self.state.participants[holder].expires_ns if holder else 0
        weights: dict[str, float] = {}
        if lease.mode == LeaseMode.SHARED or len(lease.grants) > 1:
            for g in lease.grants:
                in_charge = lease.mode == LeaseMode.SHARED or g.participant == holder
                weights[g.participant] = g.weight if in_charge else 0.0
        waiting = [w.participant for w in self.state.queue if w.any_robot or lease.target in w.robots]
        return Lease(
            lease.target,
            lease.kind,
            lease.mode,
            holder,
            lease.version,
            expires,
            tuple(waiting) if lease.kind == TargetKind.ROBOT else (),
            tuple(weights),
            tuple(weights.values()),
            self.get_scale(lease) if lease.kind == TargetKind.ROBOT else 1.0,
        )

    def publish_lease(self, lease: LeaseState, cause: str, previous_holder: str = "") -> None:
        """Publish the present state of a lease as an event, in one with those just before it of the same cause."""
        change = LeaseChanged(self.to_lease(lease), cause, previous_holder)
        last = self.events[-1] if self.events else None
        merged = _merge_changes(last.body, change) if last is not None else None
        if last is None or merged is None:
            self.emit(change)
        else:
            self.events[-1] = msgspec.structs.replace(last, body=merged)

    def to_participant_info(self, p: Participant) -> ParticipantInfo:
        """Return one row of the roster."""
        connected = p.connection != NO_CONNECTION
        return ParticipantInfo(
            p.id, p.name, p.role, connected, p.devices, p.worn, p.tracking_epoch, p.published_alignment
        )

    def publish_participant(self, p: Participant) -> None:
        """Publish the present state of a participant as an event. The host is not in the roster."""
        if p.id != HOST_ID:
            self.emit(ParticipantChanged(self.to_participant_info(p)))

    def publish_alignment(self, p: Participant) -> None:
        """Publish the alignment of a participant, which has one, as an event."""
        alignment = p.published_alignment
        assert alignment is not None
        self.emit(AlignmentChanged(p.id, alignment))

    def list_leases(self, p: Participant) -> list[LeaseState]:
        """Return every target that `p` holds, robots first, in the order of the specification."""
        held = [*self.state.robots.values(), *self.held_objects]
        return [lease for lease in held if any(g.participant == p.id for g in lease.grants)]


def _merge_changes(before: EventKind, change: LeaseChanged) -> LeasesChanged | None:
    """Return one event for both, `None` when `before` is no change of leases for the same cause, or full."""
    if not isinstance(before, (LeaseChanged, LeasesChanged)) or before.cause != change.cause:
        return None
    singles = (before,) if isinstance(before, LeaseChanged) else before.to_single_changes()
    changes = (*singles, change)
    if len(changes) > MAX_LEASES:
        return None
    leases, holders = tuple(c.lease for c in changes), tuple(c.previous_holder for c in changes)
    return LeasesChanged(leases, change.cause, holders)


def build_unknown_denial(kind: str, name: str, known: Iterable[str]) -> Denial:
    """Return the denial for a robot, object or anchor that the scene does not have; `known` lists those that it has."""
    return Denial(DenialReason.UNKNOWN_TARGET, f"no {kind} {name!r}", format_names(f"{kind}s", known), name)


def build_absent_denial(participant: str) -> Denial:
    """Return the denial for a participant that the session does not have."""
    text = f"no participant {participant}"
    return Denial(DenialReason.UNKNOWN_PARTICIPANT, text, "use an id of the roster")


def build_value_denial(kind: str, value: str, known: Iterable[str]) -> Denial:
    """Return the denial for an unknown value of an enumeration, such as an action or a device."""
    return Denial(DenialReason.UNKNOWN_VALUE, f"unknown {kind} {value}", f"{kind}s: {', '.join(sorted(known))}")


def format_names(kinds: str, names: Iterable[str]) -> str:
    """Return `robots: left, right`, or `robots: none`."""
    return f"{kinds}: {join_names(names) or 'none'}"


def join_names(names: Iterable[str], max_count: int = 6) -> str:
    """Return names for an error text, at most `max_count`: it must fit the `Text` of a message."""
    listed = list(names)
    rest = f" and {len(listed) - max_count} more" if len(listed) > max_count else ""
    return ", ".join(listed[:max_count]) + rest


def find_grant(lease: LeaseState, participant: str, device: str = "") -> LeaseGrant | None:
    """Return the grant that `participant` may use with `device`: one bound to that hand first, else one bound to
    none.
    """
    loose = None
    for g in lease.grants:
        if g.participant == participant:
            if g.hand and g.hand == device:
                return g
            if not g.hand:
                loose = g
    return loose
