"""Rigid state and presence on the state socket: encodes each frame once, and stamps it when it is sent."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import msgspec
import numpy as np
import zmq

from iris_session.link.config import SceneInfo
from iris_session.protocol.server_messages import TOPIC_PRESENCE, TOPIC_RIGID, TOPIC_ROBOTS, StateHeader
from iris_session.streams.rigid import RigidEncoder

POSE_BYTES = 56  # seven float64
#: Delays are reported of so long: a frame that was late before says nothing about the present.
RECENT_NS = 5_000_000_000
_encoder = msgspec.msgpack.Encoder()
_decode_header = msgspec.msgpack.Decoder(StateHeader).decode


class _RawPresence(msgspec.Struct, array_like=True):
    """`Presence` on the wire, its items encoded already."""

    session_time: int
    published_ns: int
    items: msgspec.Raw


class _RawRobotStates(msgspec.Struct, array_like=True):
    """`RobotStates` on the wire, its robots encoded already."""

    scene_epoch: int
    tick: int
    sim_time: float
    session_time: int
    published_ns: int
    robots: msgspec.Raw


class StatePublisher:
    """Publish the latest state. Nothing is queued here; a subscriber that does not keep up loses frames of its queue.

    Attributes:
        frames: State frames sent so far.
        scene: The present scene.
    """

    def __init__(
        self, state: zmq.Socket[bytes], scene: SceneInfo, now_ns: Callable[[], int], first_seq: int = 1
    ) -> None:
        self._state: zmq.Socket[bytes] | None = state
        self._now_ns = now_ns
        self._next_seq = first_seq
        self.frames = 0
        # When each of the newest frames was handed to the socket, and how long after the end of its tick; without
        # those that are sent again while their source is silent.
        self._delays: deque[tuple[int, int]] = deque(maxlen=300)
        self._last_session_time = -1
        self.scene = scene
        self._reset_encoder()

    @property
    def newest_delay_ns(self) -> int:
        """Time from the end of the tick of the newest frame until it was sent [ns], 0 before the first."""
        return self._delays[-1][1] if self._delays else 0

    def read_recent_delays_ns(self) -> list[int]:
        """Return the delays of all frames of the last seconds [ns], oldest first."""
        since_ns = self._now_ns() - RECENT_NS
        return [delay for at_ns, delay in self._delays if at_ns > since_ns]

    def replace_socket(self, state: zmq.Socket[bytes] | None) -> None:
        """Send on another socket from now on, and close the one before. `None`: nothing is sent until the next call."""
        if self._state is not None:
            self._state.close(linger=0)
        self._state = state

    def poll(self) -> None:
        """Let libzmq process events of connections, which it does only when called: else they would pile up while no
        state is sent."""
        if self._state is not None:
            self._state.get(zmq.EVENTS)

    def set_scene(self, scene: SceneInfo) -> None:
        """Set the scene of later frames. A patch of the present scene does not change its bodies."""
        before, self.scene = self.scene, scene
        if scene.patches and scene.bodies == before.bodies:
            return
        self._reset_encoder()

    def _reset_encoder(self) -> None:
        self._encoder = RigidEncoder(len(self.scene.bodies), self._next_seq)
        self._published = False

    def publish(self, header: bytes, poses: bytes) -> bool:
        """Encode and send one state.

        Args:
            header: Encoded `StateHeader` without its `published_ns` and `*_seq`.
            poses: float64 (n_bodies, 7), `x y z qw qx qy qz`, world frame.

        Returns:
            False if the poses are not those of the present scene.
        """
        n = len(self.scene.bodies)
        if len(poses) != n * POSE_BYTES:
            return False
        head = _decode_header(header)
        frame = self._encoder.encode(np.frombuffer(poses, np.float64).reshape(n, 7), head.scene_epoch)
        self._published = True
        self._next_seq = frame.state_seq + 1
        published_ns = self._now_ns()
        if head.session_time != self._last_session_time:
            self._delays.append((published_ns, published_ns - head.session_time))
        self._last_session_time = head.session_time
        stamped = msgspec.structs.replace(
            head, published_ns=published_ns, state_seq=frame.state_seq, base_seq=frame.base_seq
        )
        if self._state is not None:
            self._state.send_multipart((TOPIC_RIGID, _encoder.encode(stamped), frame.payload))
            self.frames += 1
        return True

    def publish_presence(self, session_time: int, items: bytes) -> None:
        """Send presence. `items`: encoded array of `PresenceItem`, forwarded unchanged."""
        if self._state is not None:
            presence = _RawPresence(session_time, self._now_ns(), msgspec.Raw(items))
            self._state.send_multipart((TOPIC_PRESENCE, _encoder.encode(presence)))

    def publish_robots(self, header: bytes, robots: bytes) -> None:
        """Send the states of the robots. `header`: that of the state; `robots`: encoded array of `RobotState`."""
        if self._state is not None:
            head = _decode_header(header)
            times = (head.scene_epoch, head.tick, head.sim_time, head.session_time, self._now_ns())
            self._state.send_multipart((TOPIC_ROBOTS, _encoder.encode(_RawRobotStates(*times, msgspec.Raw(robots)))))

    def read_keyframe(self) -> tuple[int, bytes]:
        """Return `(state_seq, float64 (n, 7) poses)` for a snapshot: of the newest frame, at first of the scene."""
        if not self._published:
            return 0, self.scene.poses
        seq, poses = self._encoder.keyframe()
        return seq, poses.tobytes()
