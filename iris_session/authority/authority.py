"""`Authority`: one step of the session as a pure function of its state and `(now_ns, entries, n_ticks, view)`.

Order within a step: urgent entries (e-stop, release, disconnect), membership and requests, samples, expiry, commands.
Reads no clock, random source or set order; equal calls give equal decisions, and `restore(snapshot())` is invisible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import msgspec

from iris_session.authority import (
    alignment,
    anchoring,
    arbitration,
    corrections,
    episodes,
    feedback,
    grasps,
    handover,
    leases,
    requests,
    roster,
    samples,
    scaling,
    scenes,
    stops,
)
from iris_session.authority.config import AuthorityConfig, check_config
from iris_session.authority.context import Context
from iris_session.authority.state import HOST_ID, Participant, State
from iris_session.protocol import client_messages as cm
from iris_session.protocol import entries as em
from iris_session.protocol.client_messages import RemoveParticipant
from iris_session.protocol.common import Denial, Pose
from iris_session.protocol.entries import HOST, URGENT, Entry
from iris_session.protocol.names import (
    DenialReason,
    RejectReason,
    Role,
)
from iris_session.protocol.scene import PatchOp
from iris_session.protocol.server_messages import Audited, Gap, MarkerAdded, Reply
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.status import AlignmentReport, CrossCheckReport
from iris_session.protocol.steps import ControlStatus, Decision, Outgoing, WorldView

#: Requests that only a director (or the host) may make.
DIRECTING: Final = (
    cm.Assign,
    cm.SetMode,
    cm.Control,
    cm.ClearEStop,
    cm.PlaceAlignment,
    cm.MoveAnchor,
    RemoveParticipant,
)
#: Entries that only the process that owns the session may make.
HOST_ONLY: Final = (
    em.ExternalReset,
    em.StalledGap,
    em.FrontRestarted,
    em.RecordingGap,
    em.Audit,
    em.SessionResumed,
    em.SceneLoaded,
    em.ScenePatched,
)
#: Entries that the front makes of its own, for the participant of a connection: no envelope, quota or sign of life.
FRONT_MADE: Final = (em.AlignmentProposal, em.AlignmentAlarm, em.CrossChecked)

NOT_JOINED: Final = Denial(DenialReason.NOT_JOINED, "this connection is no participant", "say hello first")

_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(State)


class Authority:
    """The one truth of a session: who is in it, who drives which robot, and what every robot does in each step."""

    def __init__(self, config: AuthorityConfig, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec]) -> None:
        """Raises `ValueError` for names that occur twice, unknown modes, policies, or robots in `assignments`."""
        check_config(config, robots, objects)
        self._first = (tuple(robots), tuple(objects))
        state = State(
            robots=scenes.robot_leases(self._first[0], config.default_mode),
            objects=scenes.object_leases(self._first[1]),
            participants={HOST_ID: roster.host()},
            anchors={name: corrections.clean(T) for name, T in config.anchors.items()},
        )
        self._ctx = Context(config, robots, objects, state)
        self._commands = arbitration.Commands()

    def step(
        self,
        now_ns: int,
        entries: Sequence[Entry],
        n_ticks: int,
        view: WorldView,
        control: Sequence[ControlStatus] = (),
    ) -> Decision:
        """Takes one step at session time `now_ns` (never decreasing, else `ValueError`) before `n_ticks` of physics.

        `view`: the world after the last tick. `control`: what control reported after the previous step.
        """
        ctx = self._ctx
        self._begin(now_ns, n_ticks, view, control, resumed=bool(entries) and _resumes(entries[0]))
        others, observed = self._urgent(entries)
        for entry in others:
            self._request(entry)
        for entry in observed:
            if isinstance(entry.message, cm.Sample):
                arbitration.sample(ctx, entry, entry.message)
        roster.expire(ctx)
        arbitration.expire_samples(ctx)
        corrections.advance(ctx)
        if ctx.state.queue or ctx.state.consents:
            requests.advance(ctx)
        handover.observe(ctx)
        commands = self._commands.build(ctx)
        objects = grasps.build(ctx) if ctx.held_objects else ()
        feedback.report(ctx, commands)
        for connection, request_id in ctx.snapshots:
            if connection in ctx.by_connection:
                ctx.outgoing.append(Outgoing(connection, roster.snapshot(ctx, request_id)))
        state = ctx.state
        return Decision(
            commands,
            objects,
            tuple(ctx.outgoing),
            tuple(ctx.admitted),
            tuple(ctx.dropped),
            tuple(ctx.events),
            tuple(ctx.presence.values()),
            state.scene_epoch,
            state.scene_revision,
            state.event_seq,
            ctx.reset,
            state.paused,
            state.estop,
            ctx.step_ticks,
        )

    def snapshot(self) -> bytes:
        """The whole state, as MessagePack."""
        return _encoder.encode(self._ctx.state)

    def restore(self, data: bytes) -> None:
        """Continues from a snapshot of a session that began with the same robots and objects, else `ValueError`.

        Raises `msgspec.DecodeError` for bytes that are no snapshot.
        """
        state = _decoder.decode(data)
        robots, objects = self._first if state.scene is None else (state.scene.robots, state.scene.objects)
        had, have = [r.name for r in robots], [o.name for o in objects]
        if list(state.robots) != had or list(state.objects) != have:
            raise ValueError(
                f"the snapshot has robots {list(state.robots)} and objects {list(state.objects)}, "
                f"this session has {had} and {have}"
            )
        self._ctx.use(robots, objects)
        self._ctx.adopt(state)
        self._commands = arbitration.Commands()

    @property
    def last_connection(self) -> int:
        """Highest connection number that was ever let in: no other one may come again."""
        return self._ctx.state.last_connection

    @property
    def now_ns(self) -> int:
        """Session time of the newest step, 0 before the first."""
        return self._ctx.state.now_ns or 0

    @property
    def scene(self) -> em.SceneLoaded | None:
        """The scene that was loaded last, None while it is the one that the session began with."""
        return self._ctx.state.scene

    @property
    def patches(self) -> tuple[PatchOp, ...]:
        """What has changed in how the scene is drawn since it was loaded."""
        return self._ctx.state.patches

    @property
    def anchors(self) -> dict[str, Pose]:
        """`T_world_anchor` by id, as they are now."""
        return dict(self._ctx.state.anchors)

    def alignment_reports(self) -> dict[str, AlignmentReport]:
        """How the alignments of those who need one stand, by participant."""
        people = self._ctx.state.participants.values()
        return {p.id: anchoring.alignment_report(self._ctx, p) for p in people if p.needs_alignment}

    def cross_check_reports(self) -> tuple[CrossCheckReport, ...]:
        """The newest comparisons of headsets."""
        return anchoring.cross_check_reports(self._ctx)

    # --- phases of a step ---

    def _begin(
        self, now_ns: int, n_ticks: int, view: WorldView, control: Sequence[ControlStatus], *, resumed: bool
    ) -> None:
        ctx = self._ctx
        before = ctx.state.now_ns
        if n_ticks < 0 or (before is not None and now_ns < before):
            raise ValueError(f"n_ticks {n_ticks} must be >= 0, and session time {now_ns} ns at least {before} ns")
        ctx.now_ns = ctx.state.now_ns = now_ns
        ctx.view, ctx.control = view, control
        ctx.state.step += 1
        ctx.clear_effects()
        self._gap_seen = before is not None and now_ns - before > ctx.config.gap_ns
        if before is not None and self._gap_seen and not resumed:
            stops.gap(ctx, now_ns - before)

    def _urgent(self, entries: Sequence[Entry]) -> tuple[list[Entry], list[Entry]]:
        """Applies the urgent lane and sorts the rest into requests and samples, within everyone's quota."""
        ctx = self._ctx
        others: list[Entry] = []
        observed: list[Entry] = []
        spent: dict[int, int] = {}
        self._gone: list[int] = []
        self._released: list[tuple[int, int, frozenset[str]]] = []
        for index, entry in enumerate(entries):
            if isinstance(entry.message, URGENT):
                self._apply_urgent(index, entry)
        for index, entry in enumerate(entries):
            m = entry.message
            if isinstance(m, URGENT):
                continue
            if isinstance(m, FRONT_MADE):
                others.append(entry)
                continue
            n = spent.get(entry.connection, 0) + 1
            spent[entry.connection] = n
            if n > ctx.config.quota and entry.connection != HOST:
                self._over_quota(entry)
            elif isinstance(m, cm.Sample):
                observed.append(entry)
            elif isinstance(m, (cm.Acquire, cm.Grasp)) and self._released_again(index, entry.connection, m):
                self._deny(entry, Denial(DenialReason.INVALID, "released again within the same step", "acquire again"))
            else:
                others.append(entry)
            p = ctx.by_connection.get(entry.connection)
            if p is not None and entry.receive_ns > p.heard_ns:
                p.heard_ns, p.spared = min(entry.receive_ns, ctx.now_ns), False
        return others, observed

    def _apply_urgent(self, index: int, entry: Entry) -> None:
        ctx, m = self._ctx, entry.message
        p = ctx.by_connection.get(entry.connection)
        if isinstance(m, cm.EStop):
            # An honest stop must not fail on a stale envelope, nor because its sender was just given up or is not yet
            # let in: the front takes it from anyone whose `hello` it has accepted.
            stops.estop(ctx, p.id if p is not None else "", m)
        elif p is None:
            if isinstance(m, (em.Lost, cm.Bye)):
                self._gone.append(entry.connection)
            else:
                samples.count(ctx, None, "", RejectReason.CONNECTION_EPOCH)
                self._deny(entry, NOT_JOINED)
        elif isinstance(m, em.Lost):
            roster.lose(ctx, p, m.reason)
            self._gone.append(entry.connection)
        elif entry.connection_epoch != entry.connection:
            samples.count(ctx, p, "", RejectReason.CONNECTION_EPOCH)
        elif isinstance(m, cm.Bye):
            roster.leave(ctx, p, m.reason)
            self._gone.append(entry.connection)
        elif isinstance(m, cm.Release):
            leases.release(ctx, p, m)
            self._released.append((index, entry.connection, frozenset(t.name for t in m.targets)))

    def _released_again(self, index: int, connection: int, m: cm.Acquire | cm.Grasp) -> bool:
        """Whether a later release of this step, applied already, meant what this request asks for."""
        names = {m.object} if isinstance(m, cm.Grasp) else {*m.robots, *m.objects}
        return any(
            sender == connection and index < at and (not released or not names or names & released)
            for at, sender, released in self._released
        )

    def _over_quota(self, entry: Entry) -> None:
        ctx, m = self._ctx, entry.message
        p = ctx.by_connection.get(entry.connection)
        if p is not None and isinstance(m, cm.Sample):
            samples.reject(ctx, p, m, RejectReason.QUOTA)
        else:
            samples.count(ctx, p, "", RejectReason.QUOTA)
            denial = Denial(DenialReason.QUOTA, f"more than {ctx.config.quota} messages in one step", "send less")
            self._deny(entry, denial)

    def _deny(self, entry: Entry, denial: Denial) -> None:
        """Answers a request that was not even looked at."""
        request_id = getattr(entry.message, "request_id", None)
        if request_id is not None:
            self._ctx.outgoing.append(Outgoing(entry.connection, Reply(request_id, False, denial)))

    def _request(self, entry: Entry) -> None:
        """Everything that is neither urgent nor a sample."""
        ctx, m = self._ctx, entry.message
        if isinstance(m, em.Join):
            if entry.connection not in self._gone:
                roster.join(ctx, entry.connection, m)
            return
        p = ctx.by_connection.get(entry.connection)
        ctx.entry_ns = entry.receive_ns
        if p is None:
            if isinstance(m, FRONT_MADE):
                return  # the connection was lost meanwhile
            samples.count(ctx, None, "", RejectReason.CONNECTION_EPOCH)
            self._deny(entry, NOT_JOINED)
        elif entry.connection_epoch != entry.connection and not isinstance(m, FRONT_MADE):
            samples.count(ctx, p, "", RejectReason.CONNECTION_EPOCH)
            denial = Denial(DenialReason.NOT_JOINED, "the envelope names another connection", "use the latest welcome")
            self._deny(entry, denial)
        elif isinstance(m, DIRECTING) and p.role != Role.DIRECTOR:
            self._deny(entry, Denial(DenialReason.ROLE, f"role {p.role} may not do this", "ask a director"))
        elif isinstance(m, HOST_ONLY):
            if p.id == HOST_ID:
                self._host(m)
        else:
            _HANDLERS[type(m)](ctx, p, m)

    def _host(self, m: em.EntryMessage) -> None:
        ctx = self._ctx
        if isinstance(m, em.ExternalReset):
            stops.new_scene(ctx, "external")
        elif isinstance(m, em.FrontRestarted):
            roster.lose_everyone(ctx, "front_restarted")
        elif isinstance(m, em.RecordingGap):
            ctx.emit(Gap("recording", 0, m.rows))
        elif isinstance(m, em.Audit):
            ctx.emit(Audited(m.kind, m.subject, m.name, m.address, m.detail, m.count))
        elif isinstance(m, em.SessionResumed):
            roster.lose_everyone(ctx, "session_resumed")
            anchoring.give_anew(ctx, m.anchors)
            stops.gap(ctx, m.gap_ns, "resumed")
            roster.begin_grace_anew(ctx)
        elif isinstance(m, em.SceneLoaded):
            scenes.load(ctx, m)
            self._commands = arbitration.Commands()
        elif isinstance(m, em.ScenePatched):
            scenes.patch(ctx, m)
        elif isinstance(m, em.StalledGap) and not self._gap_seen:
            self._gap_seen = True
            stops.gap(ctx, m.duration_ns)


def _resumes(entry: Entry) -> bool:
    """Whether a step begins with the news that the session goes on from a recording, which tells of the gap itself."""
    return entry.connection == HOST and isinstance(entry.message, em.SessionResumed)


def _heartbeat(ctx: Context, p: Participant, m: cm.Heartbeat) -> None:
    roster.set_worn(ctx, p, m.worn)


def _marker(ctx: Context, p: Participant, m: cm.Marker) -> None:
    ctx.emit(MarkerAdded(p.id, m.text))
    ctx.accept(p, m.request_id)


def _get_snapshot(ctx: Context, p: Participant, m: cm.GetSnapshot) -> None:
    ctx.snapshots[(p.connection, m.request_id)] = None


def _observation(ctx: Context, p: Participant, m: cm.Observation) -> None:
    """Kept in the journal only; the estimator in the front makes proposals of it."""


_HANDLERS: Final[dict[type, Callable[[Context, Participant, Any], None]]] = {
    cm.Heartbeat: _heartbeat,
    cm.GetSnapshot: _get_snapshot,
    cm.Acquire: requests.acquire,
    cm.Consent: requests.consent,
    cm.Assign: requests.assign,
    cm.SetMode: requests.set_mode,
    cm.SetScale: scaling.set_scale,
    cm.Grasp: requests.grasp,
    cm.Observation: _observation,
    em.AlignmentProposal: alignment.propose,
    em.AlignmentAlarm: anchoring.alarm,
    em.CrossChecked: anchoring.cross_checked,
    cm.PlaceAlignment: alignment.place,
    cm.Align: anchoring.align,
    cm.MoveAnchor: anchoring.move_anchor,
    cm.TrackingEpoch: alignment.tracking_epoch,
    cm.Episode: episodes.episode,
    cm.ClearEStop: stops.clear_estop,
    cm.Control: stops.control,
    cm.Marker: _marker,
    RemoveParticipant: roster.remove_participant,
}
