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

    `body_index` and `index_of_id` give the row of a body in state frames, by name and by `BodyInfo.id`. `synced` is
    false before the first snapshot and after a gap; the other attributes then show the last known state. `bodies` are
    those of the epochs from `bodies_since` to `bodies_until`, as far as is known. `stop_seq`: number of the newest
    stop, which `ClearEStop` names. Counters: `gaps`, `discarded` (events older than the snapshot or repeated),
    `held_overflow`.
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

        Returns, in order, the events since the last one that was applied: each one that arrived, and `MissedEvents` for
        those that did not. Events before the first snapshot are neither. An older snapshot than the known state
        (`event_seq`) is discarded unless a gap is open.
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
        """Apply the next event. Return false when it was discarded, or held until a snapshot comes (`synced` is then
        false).
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
        """Return the alignment of one participant, `None` while it has none."""
        info = self.participants.get(participant)
        return None if info is None else info.alignment

    def find_tip(self, robot: str) -> tuple[int, Pose] | None:
        """Return the row of the body that carries the robot's end-effector site, and `T_body_site`; `None`: no such
        robot.
        """
        info = self.robots.get(robot)
        index = None if info is None else self.index_of_id.get(info.site_body)
        return None if info is None or index is None else (index, info.T_body_site)

    def find_lease_version(self, target: str, participant: str) -> int | None:
        """Return the fencing token of `target` when `participant` holds it (alone or with others), else `None`."""
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
