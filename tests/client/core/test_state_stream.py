"""State channel: newest of a drain, keyframes and deltas, freshness after a stall, hostile bytes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.client.core.state_stream import PRESENCE_WAITING, SceneState, StateStream
from iris_session.protocol.codec import encode_presence, encode_state_header
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.server_messages import TOPIC_PRESENCE, TOPIC_RIGID, Presence, PresenceItem, StateHeader
from iris_session.streams.rigid import WINDOW, RigidEncoder

MS = 1_000_000
LOCAL = 86_400_000 * MS  # our clock minus session time
N = 4


class Server:
    """Encodes states as the front does."""

    def __init__(self) -> None:
        self.encoder = RigidEncoder(N)
        self.poses = np.zeros((N, 7))
        self.poses[:, 3] = 1.0

    def frame(self, now_ns: int, epoch: int = 1) -> list[bytes]:
        """A frame in which every body has moved."""
        self.poses[:, 0] += 0.001
        return self.rest(now_ns, epoch)

    def rest(self, now_ns: int, epoch: int = 1) -> list[bytes]:
        """A frame without further motion."""
        encoded = self.encoder.encode(self.poses, epoch)
        header = StateHeader(epoch, 0, 0, 0.0, now_ns - MS, now_ns, encoded.state_seq, encoded.base_seq)
        return [TOPIC_RIGID, encode_state_header(header), encoded.payload]

    def join(self, stream: StateStream, epoch: int = 1) -> None:
        stream.scene_epoch = epoch
        stream.load_keyframe(*self.encoder.keyframe())


def drain(stream: StateStream, messages: Sequence[Sequence[bytes]], now_ns: int) -> SceneState | None:
    """Drain at session time `now_ns`; the client's own clock differs."""
    return stream.drain(messages, now_ns, now_ns + LOCAL)


@pytest.fixture
def server() -> Server:
    return Server()


def test_newest_frame_of_a_drain_is_decoded_and_the_rest_counted(server: Server) -> None:
    stream = StateStream()
    server.frame(0)
    server.join(stream)
    state = drain(stream, [server.frame(10 * MS), server.frame(20 * MS), server.frame(30 * MS)], 31 * MS)
    assert state is not None
    assert state.age_ns == 2 * MS
    assert np.abs(state.poses - server.poses).max() < 1e-4
    assert not state.poses.flags.writeable
    assert (stream.counters.delivered, stream.counters.superseded) == (1, 2)


def test_loss_beyond_the_window_requests_a_snapshot(server: Server) -> None:
    stream = StateStream()
    for i in range(40):
        server.frame(i)
    server.join(stream)
    server.poses[:, 1] += 1.0  # all bodies move, unseen by this client, and then rest
    for _ in range(WINDOW + 2):
        server.rest(0)
    assert drain(stream, [server.rest(MS)], MS) is None
    assert stream.counters.undecodable == 1
    assert stream.wants_snapshot
    server.join(stream)
    assert not stream.wants_snapshot
    assert drain(stream, [server.rest(2 * MS)], 2 * MS) is not None


def test_new_epoch_is_delivered_once_the_session_has_announced_it(server: Server) -> None:
    stream = StateStream()
    server.frame(0)
    server.join(stream)
    assert drain(stream, [server.frame(MS, epoch=2)], MS) is None
    assert stream.counters.other_epoch == 1
    stream.scene_epoch = 2
    state = drain(stream, [server.frame(2 * MS, epoch=2)], 3 * MS)
    assert state is not None
    assert np.abs(state.poses - server.poses).max() < 1e-4


def test_slow_link_delivers_the_newest_available_frame(server: Server) -> None:
    stream = StateStream()
    server.frame(0)
    server.join(stream)
    assert drain(stream, [server.frame(0)], 0) is not None
    handed = [drain(stream, [server.frame(t - 300 * MS)], t) for t in range(1000 * MS, 1400 * MS, 40 * MS)]
    assert handed[0] is None
    assert handed[-1] is not None


@pytest.mark.parametrize("polling", [True, False])
def test_stall_of_link_or_client_is_detected(server: Server, polling: bool) -> None:
    """The link stalled while the client polled, or the client stalled while waiting for frames."""
    stream = StateStream()
    server.frame(0)
    server.join(stream)
    assert drain(stream, [server.frame(MS)], MS) is not None
    for t in range(20 * MS, 3000 * MS, 20 * MS) if polling else ():
        assert drain(stream, [], t) is None
    assert drain(stream, [server.frame(20 * MS)], 3000 * MS) is None
    assert drain(stream, [server.frame(40 * MS)], 3001 * MS) is None
    assert drain(stream, [server.frame(3000 * MS)], 3002 * MS) is not None
    assert stream.counters.queued_old == 2


def test_frame_in_hand_during_a_stall_is_not_delivered(server: Server) -> None:
    """It was read from the socket, then the process was stopped for three seconds."""
    stream = StateStream()
    server.frame(0)
    server.join(stream)
    assert drain(stream, [server.frame(MS)], MS) is not None
    assert stream.check_fresh(2 * MS + LOCAL)
    assert drain(stream, [server.frame(17 * MS)], 17 * MS) is not None
    assert not stream.check_fresh(3000 * MS + LOCAL)
    assert drain(stream, [server.frame(33 * MS)], 3001 * MS) is None  # nor frames queued meanwhile
    assert drain(stream, [server.frame(3002 * MS)], 3003 * MS) is not None
    assert stream.check_fresh(3004 * MS + LOCAL)
    assert (stream.counters.delivered, stream.counters.queued_old) == (2, 2)


def test_unread_presence_is_bounded() -> None:
    stream = StateStream()
    message = [TOPIC_PRESENCE, encode_presence(Presence(10, 11, (PresenceItem("p1", "head", IDENTITY),)))]
    for _ in range(2 * PRESENCE_WAITING - 1):
        drain(stream, [message], 12)
    assert stream.counters.presence == PRESENCE_WAITING
    assert set(stream.presence) == {("p1", "head")}
    assert stream.counters.presence == 2 * PRESENCE_WAITING - 1


@given(
    st.lists(st.lists(st.binary(max_size=60) | st.sampled_from([TOPIC_RIGID, TOPIC_PRESENCE]), min_size=1, max_size=4))
)
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_counted_and_harmless(messages: list[list[bytes]]) -> None:
    server, stream = Server(), StateStream()
    server.frame(0)
    server.join(stream)
    drain(stream, messages, MS)
    assert stream.presence == {}
    counted = stream.counters
    assert counted.malformed + counted.unknown_topic + counted.superseded + counted.presence >= len(messages) - 1
    assert drain(stream, [server.frame(2 * MS)], 3 * MS) is not None
