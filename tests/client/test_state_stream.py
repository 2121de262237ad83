"""State channel: newest of a drain, keyframes and deltas, freshness after a stall, hostile bytes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.client.state_stream import PRESENCE_WAITING, StateStream
from iris_session.protocol.codec import encode_presence, encode_state_header
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.server_messages import (
    TOPIC_PRESENCE,
    TOPIC_RIGID,
    Presence,
    PresenceItem,
    StateHeader,
)
from iris_session.streams.rigid import WINDOW, RigidEncoder

MS = 1_000_000
N = 4


class Server:
    """Encodes states as the front does."""

    def __init__(self) -> None:
        self.encoder = RigidEncoder(N)
        self.poses = np.zeros((N, 7))
        self.poses[:, 3] = 1.0

    def frame(self, now_ns: int, epoch: int = 1) -> list[bytes]:
        """A frame in which everybody has moved."""
        self.poses[:, 0] += 0.001
        return self.rest(now_ns, epoch)

    def rest(self, now_ns: int, epoch: int = 1) -> list[bytes]:
        """A frame as things stand."""
        encoded = self.encoder.encode(self.poses, epoch)
        header = StateHeader(epoch, 0, 0, 0.0, now_ns - MS, now_ns, encoded.state_seq, encoded.base_seq)
        return [TOPIC_RIGID, encode_state_header(header), encoded.payload]

    def join(self, stream: StateStream, epoch: int = 1) -> None:
        stream.scene_epoch = epoch
        stream.load_keyframe(*self.encoder.keyframe())


@pytest.fixture
def server() -> Server:
    return Server()


def test_newest_of_a_drain_is_decoded_and_the_rest_counted(server: Server) -> None:
    stream = StateStream()
    server.frame(0)
    server.join(stream)
    state = stream.drain([server.frame(10 * MS), server.frame(20 * MS), server.frame(30 * MS)], 31 * MS)
    assert state is not None
    assert state.age_ns == 2 * MS
    assert np.abs(state.poses - server.poses).max() < 1e-4
    assert not state.poses.flags.writeable
    assert (stream.counters.delivered, stream.counters.superseded) == (1, 2)


def test_frames_before_the_snapshot_and_of_the_past_are_counted(server: Server) -> None:
    stream = StateStream()
    old = server.frame(0)
    assert stream.drain([old], MS) is None
    assert stream.counters.before_snapshot == 1
    server.frame(MS)
    server.join(stream)
    assert stream.drain([old], 2 * MS) is None
    assert stream.counters.out_of_order == 1


def test_losing_more_than_the_window_asks_for_a_snapshot(server: Server) -> None:
    stream = StateStream()
    for i in range(40):
        server.frame(i)
    server.join(stream)
    server.poses[:, 1] += 1.0  # everybody moves, unseen by this client, and rests from then on
    for _ in range(WINDOW + 2):
        server.rest(0)
    assert stream.drain([server.rest(MS)], MS) is None
    assert stream.counters.undecodable == 1
    assert stream.wants_snapshot
    server.join(stream)
    assert not stream.wants_snapshot
    assert stream.drain([server.rest(2 * MS)], 2 * MS) is not None


def test_a_new_epoch_is_handed_out_once_the_session_has_told_of_it(server: Server) -> None:
    stream = StateStream()
    server.frame(0)
    server.join(stream)
    assert stream.drain([server.frame(MS, epoch=2)], MS) is None
    assert stream.counters.other_epoch == 1
    stream.scene_epoch = 2
    state = stream.drain([server.frame(2 * MS, epoch=2)], 3 * MS)
    assert state is not None
    assert np.abs(state.poses - server.poses).max() < 1e-4


def test_after_standing_still_the_first_frame_handed_out_is_fresh(server: Server) -> None:
    stream = StateStream()
    server.frame(0)
    server.join(stream)
    assert stream.drain([server.frame(MS)], MS) is not None
    waiting = [server.frame(17 * MS * i) for i in range(1, 4)]
    now = 3000 * MS
    assert stream.drain(waiting, now) is None
    assert stream.counters.queued_old == 1
    state = stream.drain([server.frame(now + 10 * MS)], now + 11 * MS)
    assert state is not None
    assert state.age_ns == 2 * MS


def test_on_a_slow_link_old_is_the_newest_there_is(server: Server) -> None:
    stream = StateStream()
    server.frame(0)
    server.join(stream)
    stream.drain([], 0)
    handed = [stream.drain([server.frame(t - 300 * MS)], t) for t in range(1000 * MS, 1400 * MS, 40 * MS)]
    assert handed[0] is None
    assert handed[-1] is not None


def test_presence_keeps_the_latest_per_device_and_forgets_who_left() -> None:
    stream = StateStream()
    items = (PresenceItem("p1", "head", IDENTITY), PresenceItem("p2", "head", IDENTITY))
    stream.drain([[TOPIC_PRESENCE, encode_presence(Presence(10, 11, items))]], 12)
    stream.drain([[TOPIC_PRESENCE, encode_presence(Presence(9, 11, items[:1]))]], 12)  # older
    assert set(stream.presence) == {("p1", "head"), ("p2", "head")}
    assert stream.counters.out_of_order == 1
    stream.forget_presence("p1")
    assert set(stream.presence) == {("p2", "head")}


def test_presence_that_nobody_looks_at_does_not_pile_up() -> None:
    stream = StateStream()
    message = [TOPIC_PRESENCE, encode_presence(Presence(10, 11, (PresenceItem("p1", "head", IDENTITY),)))]
    for _ in range(2 * PRESENCE_WAITING - 1):
        stream.drain([message], 12)
    assert stream.counters.presence == PRESENCE_WAITING
    assert set(stream.presence) == {("p1", "head")}
    assert stream.counters.presence == 2 * PRESENCE_WAITING - 1


@given(
    st.lists(st.lists(st.binary(max_size=60) | st.sampled_from([TOPIC_RIGID, TOPIC_PRESENCE]), min_size=1, max_size=4))
)
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_counted_and_harm_nothing(messages: list[list[bytes]]) -> None:
    server, stream = Server(), StateStream()
    server.frame(0)
    server.join(stream)
    stream.drain(messages, MS)
    assert stream.presence == {}
    counted = stream.counters
    assert counted.malformed + counted.unknown_topic + counted.superseded + counted.presence >= len(messages) - 1
    assert stream.drain([server.frame(2 * MS)], 3 * MS) is not None
