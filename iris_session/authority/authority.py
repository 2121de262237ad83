"""`Authority`: one step of the session as a pure function of its state and `(now_ns, entries, n_ticks, view)`.

Order within a step: urgent entries (e-stop, release, disconnect), membership and requests, samples, expiry, commands.
Reads no clock, random source or set order; equal calls give equal decisions, and `restore(snapshot())` is invisible.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import msgspec

from iris_session.authority import (
    ageing,
    alignment,
    anchoring,
    arbitration,
    episodes,
    handover,
    leases,
    pairs,
    requests,
    roster,
    samples,
    session_control,
    shifts,
)
from iris_session.authority.config import AuthorityConfig, check_config
from iris_session.authority.context import Context
from iris_session.authority.state import HOST_ID, AuthorityState, Participant
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
from iris_session.protocol.server_messages import Audited, EpisodeChanged, Gap, MarkerAdded, Reply
from iris_session.protocol.specs import ObjectSpec, RobotSpec
from iris_session.protocol.status import AlignmentReport, CrossCheckReport, StopReport, UnverifiedReport
from iris_session.protocol.steps import ControlStatus, Decision, OutgoingMessage, WorldView

#: Requests that only a director (or the host) may make; one's own name everyone may change.
DIRECTOR_ONLY: Final = (
    cm.Assign,
    cm.SetMode,
    cm.Control,
    cm.ClearEStop,
    cm.PlaceAlignment,
    cm.MoveAnchor,
    RemoveParticipant,
    cm.Rename,
    cm.SetRole,
)
#: Entries that only the process that owns the session may make.
HOST_ONLY: Final = (
    em.ExternalReset,
    em.StalledGap,
    em.PhysicsDiverged,
    em.FrontRestarted,
    em.RecordingGap,
    em.Audit,
    em.SessionResumed,
    em.SceneLoaded,
    em.ScenePatched,
    em.ObjectsPlaced,
    em.OwnerListens,
)
#: Entries that the front itself makes for the participant of a connection: no envelope, quota or sign of life.
FRONT_MADE: Final = (em.AlignmentProposal, em.AlignmentAlarm, em.TipSolved, em.CrossChecked)

NOT_JOINED: Final = Denial(DenialReason.NOT_JOINED, "this connection is no participant", "say hello first")

_encoder = msgspec.msgpack.Encoder()
_decoder = msgspec.msgpack.Decoder(AuthorityState)


class Authority:
    """The single source of truth of a session: its participants, who drives which robot, and one command per robot and
    step.
    """

    def __init__(self, config: AuthorityConfig, robots: Sequence[RobotSpec], objects: Sequence[ObjectSpec]) -> None:
        """Raise `ValueError` for names that occur twice, unknown modes, policies, or robots in `assignments`."""
        check_config(config, robots, objects)
        self._initial_targets = (tuple(robots), tuple(objects))
        state = AuthorityState(
            robots=session_control.create_robot_leases(self._initial_targets[0], config.default_mode),
            objects=session_control.create_object_leases(self._initial_targets[1]),
            participants={HOST_ID: roster.create_host()},
            anchors={name: alignment.normalise_pose(T) for name, T in config.anchors.items()},
            episode=episodes.create_first(config.task),
        )
        self._ctx = Context(config, robots, objects, state)
        self._commands = arbitration.CommandBuilder()

    def step(
        self,
        now_ns: int,
        entries: Sequence[Entry],
        n_ticks: int,
        view: WorldView,
        control: Sequence[ControlStatus] = (),
    ) -> Decision:
        """Take one step at session time `now_ns` (never decreasing, else `ValueError`) before `n_ticks` of physics.

        `view`: the world after the last tick. `control`: the status that control reported after the previous step.
        """
        ctx = self._ctx
        self._begin_step(now_ns, n_ticks, view, control, resumed=bool(entries) and _is_resume(entries[0]))
        others, observed = self._apply_urgent_entries(entries)
        for entry in others:
            self._apply_entry(entry)
        for entry in observed:
            if isinstance(entry.message, cm.Sample):
                arbitration.process_sample(ctx, entry, entry.message)
        roster.expire_participants(ctx)
        episodes.advance_episode(ctx)
        arbitration.expire_samples(ctx)
        alignment.advance_corrections(ctx)
        ageing.check_ages(ctx)
        pairs.check_pairs(ctx)
        shifts.warn_due(ctx)
        if ctx.state.queue or ctx.state.consents:
            requests.advance_requests(ctx)
        handover.track_handovers(ctx)
        commands = self._commands.build_commands(ctx)
        objects = arbitration.build_object_commands(ctx) if ctx.held_objects else ()
        arbitration.send_feedback(ctx, commands)
        for connection, request_id in ctx.snapshots:
            if connection in ctx.by_connection:
                ctx.outgoing.append(OutgoingMessage(connection, roster.build_snapshot(ctx, request_id)))
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
        """Return the whole state, as MessagePack."""
        return _encoder.encode(self._ctx.state)

    def restore(self, data: bytes) -> None:
        """Continue from a snapshot of a session that began with the same robots and objects, else raise `ValueError`.

        Raises `msgspec.DecodeError` for bytes that are no snapshot.
        """
        state = _decoder.decode(data)
        robots, objects = self._initial_targets if state.scene is None else (state.scene.robots, state.scene.objects)
        had, have = [r.name for r in robots], [o.name for o in objects]
        if list(state.robots) != had or list(state.objects) != have:
            raise ValueError(
                f"the snapshot has robots {list(state.robots)} and objects {list(state.objects)}, "
                f"this session has {had} and {have}"
            )
        self._ctx.set_targets(robots, objects)
        self._ctx.adopt_state(state)
        self._commands = arbitration.CommandBuilder()

    @property
    def last_connection(self) -> int:
        """Highest connection number that was ever admitted: later ones must be higher."""
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
        """Visual changes of the scene since it was loaded, merged."""
        return self._ctx.state.patches

    @property
    def anchors(self) -> dict[str, Pose]:
        """`T_world_anchor` by id, as they are now."""
        return dict(self._ctx.state.anchors)

    @property
    def episode(self) -> EpisodeChanged | None:
        """The present or last episode, `None` before the first."""
        return self._ctx.state.episode

    @property
    def next_episode(self) -> int:
        """Number of the episode that begins next."""
        return episodes.find_next_number(self._ctx)

    @property
    def stop_seq(self) -> int:
        """Number of the newest e-stop, 0 before the first."""
        return self._ctx.state.stop_seq

    @property
    def pause_reason(self) -> str:
        """Reason for which physics stands still until a reset, empty otherwise."""
        return self._ctx.state.diverged

    def build_stop_reports(self) -> tuple[StopReport, ...]:
        """Return the e-stops in force, newest first, the newest of each participant."""
        return session_control.build_stop_reports(self._ctx)

    def find_sender(self, connection: int) -> tuple[str, str]:
        """Return id and name of the participant of a connection; empty strings for one that has none any more."""
        p = self._ctx.by_connection.get(connection)
        return ("", "") if p is None else (p.id, p.name)

    def list_holders(self) -> dict[str, tuple[str, ...]]:
        """Return the participants that hold each robot, by robot."""
        return {name: tuple(g.participant for g in lease.grants) for name, lease in self._ctx.state.robots.items()}

    def build_alignment_reports(self) -> dict[str, AlignmentReport]:
        """Return the state of the alignment of each participant that needs one, by participant id."""
        people = self._ctx.state.participants.values()
        return {p.id: anchoring.build_alignment_report(self._ctx, p) for p in people if p.needs_alignment}

    def build_cross_check_reports(self) -> tuple[CrossCheckReport, ...]:
        """Return the newest cross-checks of headsets."""
        return anchoring.build_cross_check_reports(self._ctx)

    def build_unverified_reports(self) -> tuple[UnverifiedReport, ...]:
        """Return the pairs of headsets of which one is to glance at an anchor."""
        return pairs.build_unverified_reports(self._ctx)

    # --- phases of a step ---

    def _begin_step(
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
        self._has_gap = before is not None and now_ns - before > ctx.config.gap_ns
        if before is not None and self._has_gap and not resumed:
            session_control.record_gap(ctx, now_ns - before)

    def _apply_urgent_entries(self, entries: Sequence[Entry]) -> tuple[list[Entry], list[Entry]]:
        """Apply the urgent entries and sort the rest into requests and samples, within each participant's quota."""
        ctx = self._ctx
        others: list[Entry] = []
        observed: list[Entry] = []
        spent: dict[int, int] = {}
        self._ended_connections: list[int] = []
        self._released_targets: list[tuple[int, int, frozenset[str]]] = []
        for index, entry in enumerate(entries):
            if isinstance(entry.message, URGENT):
                self._apply_urgent_entry(index, entry)
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
                self._reject_over_quota(entry)
            elif isinstance(m, cm.Sample):
                observed.append(entry)
            elif isinstance(m, (cm.Acquire, cm.Grasp)) and self._is_released_again(index, entry.connection, m):
                self._deny_entry(
                    entry, Denial(DenialReason.INVALID, "released again within the same step", "acquire again")
                )
            else:
                others.append(entry)
            p = ctx.by_connection.get(entry.connection)
            if p is not None and entry.receive_ns > p.heard_ns:
                p.heard_ns, p.spared = min(entry.receive_ns, ctx.now_ns), False
        return others, observed

    def _apply_urgent_entry(self, index: int, entry: Entry) -> None:
        ctx, m = self._ctx, entry.message
        p = ctx.by_connection.get(entry.connection)
        if isinstance(m, cm.EStop):
            # An honest stop must not fail on a stale envelope, nor because its sender was just disconnected or is not
            # admitted yet: the front accepts it from every connection whose `hello` it has accepted.
            session_control.latch_estop(ctx, entry.connection, m)
        elif p is None:
            if isinstance(m, (em.Lost, cm.Bye)):
                self._ended_connections.append(entry.connection)
            else:
                samples.count_rejection(ctx, None, "", RejectReason.CONNECTION_EPOCH)
                self._deny_entry(entry, NOT_JOINED)
        elif isinstance(m, em.Lost):
            roster.disconnect_participant(ctx, p, m.reason)
            self._ended_connections.append(entry.connection)
        elif entry.connection_epoch != entry.connection:
            samples.count_rejection(ctx, p, "", RejectReason.CONNECTION_EPOCH)
        elif isinstance(m, cm.Bye):
            roster.process_bye(ctx, p, m.reason)
            self._ended_connections.append(entry.connection)
        elif isinstance(m, cm.Release):
            leases.process_release(ctx, p, m)
            self._released_targets.append((index, entry.connection, frozenset(t.name for t in m.targets)))

    def _is_released_again(self, index: int, connection: int, m: cm.Acquire | cm.Grasp) -> bool:
        """Return true when a later release of this step, applied already, covers the targets of this request."""
        names = {m.object} if isinstance(m, cm.Grasp) else {*m.robots, *m.objects}
        return any(
            sender == connection and index < at and (not released or not names or names & released)
            for at, sender, released in self._released_targets
        )

    def _reject_over_quota(self, entry: Entry) -> None:
        ctx, m = self._ctx, entry.message
        p = ctx.by_connection.get(entry.connection)
        if p is not None and isinstance(m, cm.Sample):
            samples.reject_sample(ctx, p, m, RejectReason.QUOTA)
        else:
            samples.count_rejection(ctx, p, "", RejectReason.QUOTA)
            denial = Denial(DenialReason.QUOTA, f"more than {ctx.config.quota} messages in one step", "send less")
            self._deny_entry(entry, denial)

    def _deny_entry(self, entry: Entry, denial: Denial) -> None:
        """Deny a request without processing it."""
        request_id = getattr(entry.message, "request_id", None)
        if request_id is not None:
            self._ctx.outgoing.append(OutgoingMessage(entry.connection, Reply(request_id, False, denial)))

    def _apply_entry(self, entry: Entry) -> None:
        """Apply an entry that is neither urgent nor a sample."""
        ctx, m = self._ctx, entry.message
        if isinstance(m, em.Join):
            if entry.connection not in self._ended_connections:
                roster.process_join(ctx, entry.connection, m)
            return
        p = ctx.by_connection.get(entry.connection)
        ctx.entry_ns = entry.receive_ns
        if p is None:
            if isinstance(m, FRONT_MADE):
                return  # the connection was lost meanwhile
            samples.count_rejection(ctx, None, "", RejectReason.CONNECTION_EPOCH)
            self._deny_entry(entry, NOT_JOINED)
        elif entry.connection_epoch != entry.connection and not isinstance(m, FRONT_MADE):
            samples.count_rejection(ctx, p, "", RejectReason.CONNECTION_EPOCH)
            denial = Denial(DenialReason.NOT_JOINED, "the envelope names another connection", "use the latest welcome")
            self._deny_entry(entry, denial)
        elif isinstance(m, DIRECTOR_ONLY) and p.role != Role.DIRECTOR and not roster.is_self_rename(ctx, p, m):
            self._deny_entry(entry, Denial(DenialReason.ROLE, f"role {p.role} may not do this", "ask a director"))
        elif isinstance(m, HOST_ONLY):
            if p.id == HOST_ID:
                self._apply_host_entry(m)
        else:
            _HANDLERS[type(m)](ctx, p, m)

    def _apply_host_entry(self, m: em.EntryMessage) -> None:
        ctx = self._ctx
        if isinstance(m, em.ExternalReset):
            session_control.begin_scene_epoch(ctx, "external")
            episodes.complete_reset(ctx)
        elif isinstance(m, em.PhysicsDiverged):
            session_control.record_divergence(ctx, m)
        elif isinstance(m, em.FrontRestarted):
            roster.disconnect_all(ctx, "front_restarted")
        elif isinstance(m, em.OwnerListens):
            ctx.state.owner_listens = True
        elif isinstance(m, em.RecordingGap):
            ctx.emit(Gap("recording", 0, m.rows))
        elif isinstance(m, em.Audit):
            ctx.emit(Audited(m.kind, m.subject, m.name, m.address, m.detail, m.count))
        elif isinstance(m, em.SessionResumed):
            roster.disconnect_all(ctx, "session_resumed")
            anchoring.replace_anchors(ctx, m.anchors)
            session_control.record_gap(ctx, m.gap_ns, "resumed")
            roster.restart_grace_periods(ctx)
            if not m.is_gap_known:
                ageing.add_unknown_age(ctx)
        elif isinstance(m, em.SceneLoaded):
            session_control.load_scene(ctx, m)
            episodes.end_unknown(ctx)
            self._commands = arbitration.CommandBuilder()
        elif isinstance(m, em.ScenePatched):
            session_control.patch_scene(ctx, m)
        elif isinstance(m, em.ObjectsPlaced):
            episodes.place_objects(ctx, m)
        elif isinstance(m, em.StalledGap) and not self._has_gap:
            self._has_gap = True
            session_control.record_gap(ctx, m.duration_ns)


def _is_resume(entry: Entry) -> bool:
    """Return true when the entry resumes the session from a recording; it reports the gap itself."""
    return entry.connection == HOST and isinstance(entry.message, em.SessionResumed)


def _process_heartbeat(ctx: Context, p: Participant, m: cm.Heartbeat) -> None:
    roster.set_worn(ctx, p, m.worn)


def _process_marker(ctx: Context, p: Participant, m: cm.Marker) -> None:
    ctx.emit(MarkerAdded(p.id, m.text))
    ctx.accept(p, m.request_id)


def _request_snapshot(ctx: Context, p: Participant, m: cm.GetSnapshot) -> None:
    ctx.snapshots[(p.connection, m.request_id)] = None


def _ignore_observation(ctx: Context, p: Participant, m: cm.Observation) -> None:
    """Do nothing: observations are only journaled; the estimator in the front makes proposals from them."""


_HANDLERS: Final[dict[type, Callable[[Context, Participant, Any], None]]] = {
    cm.Heartbeat: _process_heartbeat,
    cm.GetSnapshot: _request_snapshot,
    cm.Acquire: requests.acquire_targets,
    cm.Withdraw: requests.withdraw_request,
    cm.Consent: requests.answer_consent,
    cm.Assign: requests.assign_robots,
    cm.SetMode: requests.set_mode,
    cm.SetScale: requests.set_scale,
    cm.Grasp: requests.grasp_object,
    cm.Observation: _ignore_observation,
    em.AlignmentProposal: pairs.process_proposal,
    em.AlignmentAlarm: anchoring.raise_alarm,
    em.TipSolved: anchoring.publish_tip,
    em.CrossChecked: anchoring.record_cross_check,
    cm.PlaceAlignment: alignment.place_alignment,
    cm.Align: anchoring.control_alignment_run,
    cm.MoveAnchor: anchoring.move_anchor,
    cm.TrackingEpoch: alignment.set_tracking_epoch,
    cm.Episode: episodes.control_episode,
    cm.ClearEStop: session_control.clear_estop,
    cm.Control: session_control.control_session,
    cm.Marker: _process_marker,
    RemoveParticipant: roster.process_removal,
    cm.Rename: roster.rename_participant,
    cm.SetRole: roster.set_role,
}
