"""The context of one step: state, configuration, time, view, and the effects collected so far.

Every other module of this room is functions over a `Context`. It holds no state of its own that outlives a step
except caches that are derived from `State` and rebuilt by `adopt`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from iris_session.authority.config import AuthorityConfig
from iris_session.authority.state import HOST_ID, NO_CONNECTION, Grant, LeaseState, Participant, State
from iris_session.protocol.common import Denial, Lease
from iris_session.protocol.names import DenialReason, LeaseMode, Role, TargetKind
from iris_session.protocol.server_messages import (
    Event,
    EventKind,
    LeaseChanged,
    ParticipantChanged,
    ParticipantInfo,
    PresenceItem,
    Refused,
    Reply,
    ServerMessage,
)
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.steps import Admitted, ControlStatus, Dropped, FixedView, Outgoing, WorldView

#: Roles of people, who preempt agents in mode `priority`. A leader arm is moved by a human hand.
HUMAN = (Role.OPERATOR, Role.DIRECTOR, Role.LEADER)


class Context:
    """State plus the step in progress."""

    def __init__(
        self, config: AuthorityConfig, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec], state: State
    ) -> None:
        self.config = config
        self.use(robots, objects)
        #: Scale of a robot that nobody has set another for.
        self.plain_scale = min(max(1.0, config.min_scale), config.max_scale)
        self.view: WorldView = FixedView()
        self.control: Sequence[ControlStatus] = ()
        self.now_ns = 0
        #: When the front stamped the entry that is being handled.
        self.entry_ns = 0
        self.adopt(state)
        self.clear_effects()

    def use(self, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec]) -> None:
        """The robots and objects that there are from now on."""
        self.robots = {r.name: r for r in robots}
        self.objects = {o.name: o for o in objects}

    def adopt(self, state: State) -> None:
        """Takes over `state` and rebuilds everything derived from it."""
        self.state = state
        # For look-ups only: its order is not that of the state, so nothing may iterate over it.
        self.by_connection = {p.connection: p for p in state.participants.values() if p.connection != NO_CONNECTION}
        self.refresh_held()

    def refresh_held(self) -> None:
        """Objects that somebody holds, in the order of the specification."""
        self.held_objects = [lease for lease in self.state.objects.values() if lease.grants]

    def clear_effects(self) -> None:
        """Empties the effects before a step."""
        self.outgoing: list[Outgoing] = []
        self.admitted: list[Admitted] = []
        self.dropped: list[Dropped] = []
        self.events: list[Event] = []
        self.presence: dict[tuple[str, str], PresenceItem] = {}
        self.snapshots: dict[tuple[int, int], None] = {}  # (connection, request_id) in order
        self.reset = False
        self.step_ticks = 0
        self.estop_arrived = False

    # --- effects ---

    def emit(self, body: EventKind) -> None:
        """Appends one event to the shared history."""
        state = self.state
        state.event_seq += 1
        self.events.append(Event(state.event_seq, state.step, self.now_ns, body))

    def send(self, p: Participant, message: ServerMessage) -> None:
        """A message for one participant; nothing while its connection is lost."""
        if p.connection != NO_CONNECTION:
            self.outgoing.append(Outgoing(p.connection, message))

    def refuse(self, connection: int, code: str, message: str, advice: str = "") -> None:
        """Answers a `hello` with no; the front closes the connection."""
        self.outgoing.append(Outgoing(connection, Refused(code, message, advice)))

    def accept(self, p: Participant, request_id: int, leases: Sequence[LeaseState] = ()) -> None:
        """Answers a request with yes and the leases as they are now."""
        self.send(p, Reply(request_id, True, None, tuple(self.lease_info(lease) for lease in leases)))

    def deny(self, p: Participant, request_id: int, denial: Denial) -> None:
        """Answers a request with a typed no."""
        self.send(p, Reply(request_id, False, denial))

    # --- look-ups and views ---

    def lease(self, kind: str, name: str) -> LeaseState | None:
        """The lease of a target, `None` when kind or name is unknown."""
        if kind == TargetKind.ROBOT:
            return self.state.robots.get(name)
        return self.state.objects.get(name) if kind == TargetKind.OBJECT else None

    def person(self, name: str) -> Participant | None:
        """A participant by id, or by name when exactly one has it."""
        found = self.state.participants.get(name)
        if found is None:
            named = [p for p in self.state.participants.values() if p.name == name and p.id != HOST_ID]
            found = named[0] if len(named) == 1 else None
        return found

    def holder(self, lease: LeaseState) -> str:
        """Participant in charge of a target: the overriding human, else the first holder; empty when free."""
        return lease.override or (lease.grants[0].participant if lease.grants else "")

    def scale(self, lease: LeaseState) -> float:
        """Motion scaling of the one in charge; that of a free robot is what its next holder begins with."""
        holder = self.holder(lease)
        return next((g.scale for g in lease.grants if g.participant == holder), self.plain_scale)

    def lease_info(self, lease: LeaseState) -> Lease:
        """A lease as everyone sees it. In mode `priority` an agent and its stand-by human are both sub-holders."""
        holder = self.holder(lease)
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
            self.scale(lease) if lease.kind == TargetKind.ROBOT else 1.0,
        )

    def publish(self, lease: LeaseState, cause: str, previous_holder: str = "") -> None:
        """Tells everyone how a lease is now."""
        self.emit(LeaseChanged(self.lease_info(lease), cause, previous_holder))

    def info(self, p: Participant) -> ParticipantInfo:
        """One row of the roster."""
        connected = p.connection != NO_CONNECTION
        return ParticipantInfo(p.id, p.name, p.role, connected, p.devices, p.worn, p.tracking_epoch, p.alignment)

    def publish_participant(self, p: Participant) -> None:
        """Tells everyone how a participant is now. The host is not in the roster."""
        if p.id != HOST_ID:
            self.emit(ParticipantChanged(self.info(p)))

    def leases_of(self, p: Participant) -> list[LeaseState]:
        """Every target that `p` holds, robots first, in the order of the specification."""
        held = [*self.state.robots.values(), *self.held_objects]
        return [lease for lease in held if any(g.participant == p.id for g in lease.grants)]


def no_such(kind: str, name: str, known: Iterable[str]) -> Denial:
    """For a robot, an object or an anchor that the scene does not have; `known` are those that it has."""
    return Denial(DenialReason.UNKNOWN_TARGET, f"no {kind} {name!r}", listed(f"{kind}s", known), name)


def listed(kinds: str, names: Iterable[str]) -> str:
    """`robots: left, right`, or `robots: none`."""
    return f"{kinds}: {some(names) or 'none'}"


def some(names: Iterable[str], most: int = 6) -> str:
    """Names for an error text, which must stay within the length of a `Text` on the wire."""
    listed = list(names)
    rest = f" and {len(listed) - most} more" if len(listed) > most else ""
    return ", ".join(listed[:most]) + rest


def find_grant(lease: LeaseState, participant: str, device: str = "") -> Grant | None:
    """The grant that `participant` may use with `device`: one bound to that hand first, else one bound to none."""
    loose = None
    for g in lease.grants:
        if g.participant == participant:
            if g.hand and g.hand == device:
                return g
            if not g.hand:
                loose = g
    return loose
