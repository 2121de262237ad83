"""State channel of a client: from frames to the newest scene. Pure: bytes and times are passed in.

Bounded staleness: the caller drains its socket and passes all received messages; only the newest rigid frame is
decoded. After a silence (this client or its link stood still) frames have waited in queues: they are dropped until a
fresh one comes, so the first frame handed out is fresh. On a link where every frame is old, the newest one counts as
fresh.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.codec import decode_presence, decode_robot_states, decode_state_header
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.server_messages import (
    TOPIC_PRESENCE,
    TOPIC_RIGID,
    TOPIC_ROBOTS,
    PresenceItem,
    RobotStates,
    StateHeader,
)
from iris_session.streams.errors import StreamError
from iris_session.streams.rigid import RigidDecoder

Poses = NDArray[np.float64]

STALLED_NS: Final = 50_000_000  # no frame for this long: the next frames may have waited in queues
QUEUED_NS: Final = 60_000_000  # a frame published this long ago waited in a queue ...
FLUSH_NS: Final = 150_000_000  # ... but after this long without a fresher one it is the newest there is (slow link)
_USUAL: Final = 8  # frames over which the usual age of frames on this link is averaged

PRESENCE_WAITING: Final = 8  # presence messages that may wait to be decoded; decoding several at once is cheaper


@dataclass(frozen=True, slots=True)
class SceneState:
    """The newest decoded state.

    Attributes:
        header: Numbers, times and applied samples of its frame.
        poses: (n, 7) float64, world frame, `x y z qw qx qy qz` [m], in the order of `Snapshot.bodies`; read-only.
        received_ns: Session time when it was handed to the application [ns].
        age_ns: That minus the end of its tick [ns].
    """

    header: StateHeader
    poses: Poses
    received_ns: int
    age_ns: int


@dataclass(slots=True)
class StateCounters:
    """Counters of state frames. Every frame that came is either `delivered` or counted in exactly one other field.

    Presence is counted when it is decoded, at most `PRESENCE_WAITING` messages later.
    """

    delivered: int = 0
    superseded: int = 0  # a newer one was there in the same drain
    queued_old: int = 0  # waited in a queue while this client stood still
    out_of_order: int = 0
    before_snapshot: int = 0
    other_epoch: int = 0  # of a scene whose event has not come yet, or of the one before
    undecodable: int = 0  # base frame missing: a snapshot was requested
    malformed: int = 0
    unknown_topic: int = 0
    bytes_received: int = 0
    rigid_messages: int = 0
    rigid_bytes: int = 0  # topic, header and poses of those
    presence: int = 0
    robot_states: int = 0


class StateStream:
    """Decoder of the newest frame of each drain. `wants_snapshot` becomes true when the deltas have lost their base.

    `scene_epoch`: the newest epoch whose bodies the application knows, by events or snapshot. Frames of other epochs
    are decoded and counted, but not handed out, because their bodies may differ.
    """

    def __init__(self) -> None:
        self.counters = StateCounters()
        self._presence: dict[tuple[str, str], PresenceItem] = {}
        self._presence_ns = 0
        self._presence_waiting: list[bytes] = []
        self._robots: RobotStates | None = None
        self._robots_waiting: bytes | None = None
        self.scene_epoch = 0
        self.wants_snapshot = False
        self._decoder: RigidDecoder | None = None
        self.restart()

    def reset(self) -> None:
        """Clear all frames for another connection: its frames may be numbered from the beginning."""
        self._decoder = None
        self._presence = {}
        self._presence_ns = 0
        self._presence_waiting = []
        self._robots = self._robots_waiting = None
        self.wants_snapshot = False
        self.restart()

    def restart(self) -> None:
        """Prepare for frames by another route: its queues are still empty, and the usual age may differ."""
        self._came_ns = -1  # time of the last frame; on the client's own clock, as the next one
        self._flush_until = 0  # old frames are dropped until then
        self._usual_age = 0
        self._was_late = False

    def load_keyframe(self, state_seq: int, poses: Poses) -> None:
        """Take the poses (n, 7) of a snapshot; poses of newer frames are kept."""
        if self._decoder is None or self._decoder.n_bodies != len(poses):
            self._decoder = RigidDecoder(len(poses))
        self._decoder.load_keyframe(state_seq, poses)
        self.wants_snapshot = False

    def drain(self, messages: Sequence[Sequence[bytes]], now_ns: int, local_ns: int) -> SceneState | None:
        """Process all received messages, oldest first; return the newest scene if there is one.

        `now_ns`: present session time, `local_ns`: the client's monotonic clock.
        """
        newest: tuple[StateHeader, bytes] | None = None
        for frames in messages:
            self.counters.bytes_received += sum(map(len, frames))
            if frames[0] == TOPIC_PRESENCE and len(frames) == 2:
                self._presence_waiting.append(frames[1])
            elif frames[0] == TOPIC_RIGID and len(frames) == 3:
                try:
                    header = decode_state_header(frames[1])
                except ProtocolError:
                    self.counters.malformed += 1
                    continue
                self.counters.rigid_messages += 1
                self.counters.rigid_bytes += sum(map(len, frames))
                self.counters.superseded += newest is not None
                newest = header, frames[2]
            elif frames[0] == TOPIC_ROBOTS and len(frames) == 2:
                self.counters.robot_states += 1
                self._robots_waiting = frames[1]
            elif frames[0] in (TOPIC_RIGID, TOPIC_PRESENCE, TOPIC_ROBOTS):
                self.counters.malformed += 1
            else:
                self.counters.unknown_topic += 1
        state = None if newest is None else self._decode(*newest, now_ns, local_ns)
        if len(self._presence_waiting) >= PRESENCE_WAITING:
            self._decode_presence()
        return state

    def check_fresh(self, local_ns: int) -> bool:
        """Return whether the last drained state is still to be passed on, at `local_ns` on the client's clock.

        It is not when the client stood still since then: fresh frames follow directly. This applies once in a row,
        because an application that always decodes that slowly would never get any state.
        """
        late = local_ns - self._came_ns > STALLED_NS
        held_back = late and not self._was_late
        self._was_late = late
        if held_back:
            self.counters.delivered -= 1
            self.counters.queued_old += 1
        return not held_back

    @property
    def presence(self) -> dict[tuple[str, str], PresenceItem]:
        """Heads and hands of all participants by `(participant, device)`. Decoded on access: the scene has priority."""
        self._decode_presence()
        return self._presence

    @property
    def robots(self) -> RobotStates | None:
        """The newest states of the robots of the present scene, `None` before the first. Decoded on access."""
        waiting, self._robots_waiting = self._robots_waiting, None
        if waiting is not None:
            try:
                self._robots = decode_robot_states(waiting)
            except ProtocolError:
                self.counters.malformed += 1
        if self._robots is not None and self._robots.scene_epoch != self.scene_epoch:
            return None
        return self._robots

    def retain_presence(self, participants: Container[str]) -> None:
        """Remove all participants but these: presence that they sent before leaving may arrive late and is not
        shown.
        """
        self._decode_presence()
        for key in [key for key in self._presence if key[0] not in participants]:
            del self._presence[key]

    def remove_presence(self, participant: str) -> None:
        """Remove a participant that left."""
        presence = self.presence
        for key in [key for key in presence if key[0] == participant]:
            del presence[key]

    def _decode(self, header: StateHeader, payload: bytes, now_ns: int, local_ns: int) -> SceneState | None:
        if self._is_from_queue(now_ns - header.published_ns, local_ns):
            self.counters.queued_old += 1
            return None
        decoder = self._decoder
        if decoder is None:
            self.counters.before_snapshot += 1
            return None
        if header.state_seq <= decoder.state_seq:
            self.counters.out_of_order += 1
            return None
        try:
            complete = decoder.apply(header.state_seq, header.base_seq, payload)
        except StreamError:
            self.counters.malformed += 1
            self.wants_snapshot = True  # perhaps the bodies changed
            return None
        if header.scene_epoch != self.scene_epoch:
            self.counters.other_epoch += 1
            return None
        if not complete:
            self.counters.undecodable += 1
            self.wants_snapshot = True
            return None
        self.counters.delivered += 1
        poses = decoder.poses.view()
        poses.flags.writeable = False
        return SceneState(header, poses, now_ns, now_ns - header.session_time)

    def _is_from_queue(self, age_ns: int, local_ns: int) -> bool:
        """Return whether a frame that comes now is to be dropped, because fresher ones must be right behind it."""
        stood_still = self._came_ns >= 0 and local_ns - self._came_ns > STALLED_NS
        self._came_ns = local_ns
        old = age_ns > max(QUEUED_NS, 2 * self._usual_age)
        if old and stood_still and not self._flush_until:
            self._flush_until = local_ns + FLUSH_NS
        if old and local_ns < self._flush_until:
            return True
        # No fresher frame came in time, so this is the usual age of frames on this link from now on.
        weight = 1 if (old and self._flush_until) or not self._usual_age else _USUAL
        self._usual_age += (age_ns - self._usual_age) // weight
        self._flush_until = 0
        return False

    def _decode_presence(self) -> None:
        waiting, self._presence_waiting = self._presence_waiting, []
        for data in waiting:
            try:
                presence = decode_presence(data)
            except ProtocolError:
                self.counters.malformed += 1
                continue
            if presence.session_time < self._presence_ns:
                self.counters.out_of_order += 1
                continue
            self.counters.presence += 1
            self._presence_ns = presence.session_time
            self._presence.update(((item.participant, item.device), item) for item in presence.items)


def poses_from_bytes(data: bytes, n_bodies: int) -> Poses | None:
    """Return the bulk frame of a snapshot as (n, 7) float64, or `None` when its size is wrong."""
    if len(data) != n_bodies * 7 * 8:
        return None
    return np.frombuffer(data, dtype="<f8").reshape(n_bodies, 7).astype(np.float64)
