"""The shared session state, rebuilt from one snapshot and the events after it. Pure; used by clients and by the server.

`SessionMirror` never guesses: after a gap in `event_seq` it is not `synced`, and until a new snapshot comes it keeps
the newer events aside (bounded). Two mirrors with equal `event_seq` have equal `mirror_hash()`, whenever they started.
"""

from __future__ import annotations

import hashlib
from collections import deque
from typing import Final, NamedTuple

import msgspec

from iris_session.protocol.common import Alignment, Lease, Pose
from iris_session.protocol.server_messages import (
    AlignmentChanged,
    AnchorInfo,
    AnchorMoved,
    BodyInfo,
    EpisodeChanged,
    EStopChanged,
    Event,
    LeaseChanged,
    LeasesChanged,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
    PauseChanged,
    RobotInfo,
    ScaleChanged,
    SceneChanged,
    Snapshot,
)

MAX_HELD_EVENTS: Final = 256  # held while a snapshot is on its way; the next snapshot covers any further ones
#: Causes of `SceneChanged` that leave robots and bodies as they are; after any other a new snapshot lists them.
SAME_BODIES: Final = frozenset({"reset", "patch", "external"})
_encoder = msgspec.msgpack.Encoder(order="deterministic")


class MissedEvents(NamedTuple):
    """Events `first` to `last` that will not be delivered: a snapshot has their effects, not the events."""

    first: int
    last: int


class SessionMirror:
    """Roster, leases, alignments, robots, bodies and anchors of the session.

    Attributes:
        synced: False before the first snapshot and after a gap; the others then show the last known state.
        event_seq: Number of the newest event that was applied.
        participants: By id, also those that are in their grace period.
        leases: By name of the robot or object.
        robots: By name.
        anchors: By id, with their poses in the world [m].
        bodies: Bodies in the order of the rows of state frames, as in the epochs from `bodies_since` to `bodies_until`.
        body_index, index_of_id: Row of a body, by its name and by `BodyInfo.id`.
        scene_hash, scene_epoch, scene_revision: Content hash of the scene, and numbers that grow with every jump of
            the scene and every patch.
        tick_period_ns: Simulated time of one tick [ns].
        paused, estop: Whether physics is paused, and whether the session is stopped.
        stop_seq: Number of the newest stop, which `ClearEStop` names.
        episode: The present episode, `None` before the first.
        gaps: Gaps in the numbers of events.
        discarded: Events older than the snapshot, or repeated.
        held_overflow: Events that came while too many waited for a snapshot.
    """

    def __init__(self) -> None:
        self.gaps = 0
        self.discarded = 0
        self.held_overflow = 0
        self.reset()

    def reset(self) -> None:
        """Clear the session, keep the counters."""
        self.synced = False
        self._has_snapshot = False  # a snapshot has come
        self.event_seq = 0
        self.scene_epoch = 0
        self.scene_revision = 0
        self.scene_hash = ""
        self.tick_period_ns = 0
        self.paused = False
        self.estop = False
        self.stop_seq = 0
        self.consent_timeout_ns = 0
        self.episode: EpisodeChanged | None = None
        self.participants: dict[str, ParticipantInfo] = {}
        self.leases: dict[str, Lease] = {}
        self.robots: dict[str, RobotInfo] = {}
        self.anchors: dict[str, AnchorInfo] = {}
        self.bodies: tuple[BodyInfo, ...] = ()
        self.bodies_since = self.bodies_until = 0
        self.body_index: dict[str, int] = {}
        self.index_of_id: dict[int, int] = {}
        self._held: deque[Event] = deque(maxlen=MAX_HELD_EVENTS)

    def apply_snapshot(self, snapshot: Snapshot) -> list[Event | MissedEvents]:
        """Apply a snapshot and the held events after it.

        Args:
            snapshot: The snapshot; one that is older than the known state is discarded unless a gap is open.

        Returns:
            In order, the events since the last one that was applied: each one that arrived, and `MissedEvents` for
            those that did not. Events before the first snapshot are neither.
        """
        if self.synced and snapshot.event_seq < self.event_seq:
            self.discarded += 1
            return []
        held = {event.event_seq: event for event in self._held}
        self._held = deque(maxlen=MAX_HELD_EVENTS)
        covered = self._list_covered_events(held, snapshot.event_seq) if self._has_snapshot else []
        self.event_seq = snapshot.event_seq
        self.scene_epoch = snapshot.scene_epoch
        self.scene_revision = snapshot.scene_revision
        self.scene_hash = snapshot.scene_hash
        self.tick_period_ns = snapshot.tick_period_ns
        self.paused = snapshot.paused
        self.estop = snapshot.estop
        self.stop_seq = snapshot.stop_seq
        self.consent_timeout_ns = snapshot.consent_timeout_ns
        self.episode = snapshot.episode
        self.participants = {p.id: p for p in snapshot.participants}
        self.leases = {lease.target: lease for lease in snapshot.leases}
        self.robots = {robot.name: robot for robot in snapshot.robots}
        self.anchors = {anchor.id: anchor for anchor in snapshot.anchors}
        if snapshot.bodies != self.bodies:
            self.bodies_since = snapshot.scene_epoch
        self.bodies, self.bodies_until = snapshot.bodies, snapshot.scene_epoch
        self.body_index = {body.name: i for i, body in enumerate(snapshot.bodies)}
        self.index_of_id = {body.id: i for i, body in enumerate(snapshot.bodies)}
        self.synced = self._has_snapshot = True
        self.discarded += 0 if covered else sum(seq <= snapshot.event_seq for seq in held)
        return covered + [held[seq] for seq in sorted(held) if seq > snapshot.event_seq and self.apply_event(held[seq])]

    def _list_covered_events(self, held: dict[int, Event], last: int) -> list[Event | MissedEvents]:
        """Return the events up to `last`, which a snapshot contains, with `MissedEvents` for those that did not
        arrive.
        """
        covered: list[Event | MissedEvents] = []
        next_seq = self.event_seq + 1
        for seq in sorted(seq for seq in held if next_seq <= seq <= last):
            if seq > next_seq:
                covered.append(MissedEvents(next_seq, seq - 1))
            covered.append(held[seq])
            next_seq = seq + 1
        if next_seq <= last:
            covered.append(MissedEvents(next_seq, last))
        return covered

    def apply_event(self, event: Event) -> bool:
        """Apply the next event.

        Args:
            event: The event.

        Returns:
            False when it was discarded, or is held until a snapshot comes; `synced` is false then.
        """
        if not self.synced:
            self._hold_event(event)
            return False
        if event.event_seq <= self.event_seq:
            self.discarded += 1
            return False
        if event.event_seq != self.event_seq + 1:
            self.gaps += 1
            self.synced = False
            self._hold_event(event)
            return False
        self.event_seq = event.event_seq
        self._apply_body(event)
        return True

    @property
    def connected(self) -> frozenset[str]:
        """Ids of the participants that are connected now."""
        return frozenset(info.id for info in self.participants.values() if info.connected)

    def find_alignment(self, participant: str) -> Alignment | None:
        """Return `T_world_tracking` of a participant, with its version and stated error.

        Args:
            participant: Id of the participant.

        Returns:
            The alignment, `None` while it has none.
        """
        info = self.participants.get(participant)
        return None if info is None else info.alignment

    def find_tip(self, robot: str) -> tuple[int, Pose] | None:
        """Return where the end effector of a robot is.

        Args:
            robot: Name of the robot.

        Returns:
            Row of the body that carries its site, and `T_body_site` [m]; `None`: there is no such robot.
        """
        info = self.robots.get(robot)
        index = None if info is None else self.index_of_id.get(info.site_body)
        return None if info is None or index is None else (index, info.T_body_site)

    def find_lease_version(self, target: str, participant: str) -> int | None:
        """Return the fencing token of a participant.

        Args:
            target: Name of the robot or object.
            participant: Id of the participant.

        Returns:
            The token, `None` when the participant does not hold it, alone or with others.
        """
        lease = self.leases.get(target)
        if lease is None or not (lease.holder == participant or participant in lease.sub_holders):
            return None
        return lease.lease_version

    def mirror_hash(self) -> str:
        """Return the digest (32 hex digits) of everything shared, independent of when and how this mirror received
        it. Poses of anchors are part of it when there are any.
        """
        state: tuple[object, ...] = (
            self.event_seq,
            self.scene_epoch,
            self.scene_revision,
            self.scene_hash,
            self.tick_period_ns,
            self.paused,
            self.estop,
            self.stop_seq,
            self.episode,
            [self.participants[key] for key in sorted(self.participants)],
            [self.leases[key] for key in sorted(self.leases)],
            [self.robots[key] for key in sorted(self.robots)],
            self.bodies,
        )
        if self.anchors:
            state = (*state, [(key, self.anchors[key].T_world_anchor) for key in sorted(self.anchors)])
        return hashlib.blake2b(_encoder.encode(state), digest_size=16).hexdigest()

    def _hold_event(self, event: Event) -> None:
        if len(self._held) == MAX_HELD_EVENTS:
            self.held_overflow += 1
        self._held.append(event)

    def _apply_body(self, event: Event) -> None:
        match event.body:
            case ParticipantJoined(participant=info) | ParticipantChanged(participant=info):
                self.participants[info.id] = info
            case ParticipantLeft(participant=name, grace=grace):
                self._apply_left(name, grace)
            case LeaseChanged(lease=lease):
                self.leases[lease.target] = lease
            case LeasesChanged(leases=leases):
                self.leases.update((lease.target, lease) for lease in leases)
            case ScaleChanged(robot=robot, scale=scale):
                if robot in self.leases:
                    self.leases[robot] = msgspec.structs.replace(self.leases[robot], scale=scale)
            case AlignmentChanged(participant=name, alignment=alignment):
                info_or_none = self.participants.get(name)
                if info_or_none is not None:
                    self.participants[name] = msgspec.structs.replace(info_or_none, alignment=alignment)
            case AnchorMoved(anchor_id=name, T_world_anchor=pose):
                known = self.anchors.get(name) or AnchorInfo(name, pose)
                self.anchors[name] = msgspec.structs.replace(known, T_world_anchor=pose)
            case SceneChanged(epoch, revision, cause, scene_hash, period_ns):
                self.scene_epoch = epoch
                self.scene_revision = revision
                self.scene_hash = scene_hash or self.scene_hash
                self.tick_period_ns = period_ns or self.tick_period_ns
                self.synced = cause in SAME_BODIES
                if self.synced:
                    self.bodies_until = epoch
            case EStopChanged(active=active, stop_seq=stop_seq):
                self.estop, self.stop_seq = active, stop_seq
            case PauseChanged(paused=paused):
                self.paused = paused
            case EpisodeChanged() as episode:
                self.episode = episode
            case _:  # history only: nothing of it is in a snapshot
                pass

    def _apply_left(self, participant: str, grace: bool) -> None:
        info = self.participants.get(participant)
        if info is None:
            return
        if grace:
            self.participants[participant] = msgspec.structs.replace(info, connected=False)
        else:
            del self.participants[participant]
