"""Streams, subscriptions and due frames, without sockets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec
import pytest

from iris_session.front.media.budget import NONE_LEVEL, SECOND
from iris_session.front.media.scheduler import (
    LOCAL,
    MAX_DETAIL,
    MAX_TITLE,
    STUCK_BYTES,
    DeliveryCounters,
    MediaScheduler,
    MediaSubscriber,
)
from iris_session.protocol.codec import decode_media_header
from iris_session.protocol.media import MAX_STREAMS, MediaHeader, MediaPush, StreamCamera, StreamInfo, make_topic

MS = 1_000_000
ANN, BOB = 7, 8


class Wire:
    """Connections that take what they are asked to, by number."""

    def __init__(self, **levels: int) -> None:
        self.hub = MediaScheduler()
        self.now_ns = 5 * SECOND
        self.full: set[int] = set()
        self.got: dict[int, list[tuple[MediaHeader, bytes]]] = {ANN: [], BOB: []}
        self.allow(**levels)

    def allow(self, ann: int = 0, bob: int = 0) -> None:
        listeners = {ANN: MediaSubscriber("a", {"cloud": ann}), BOB: MediaSubscriber("b", {"cloud": bob})}
        self.hub.set_subscribers(listeners, self.now_ns)

    def send(self, topic: bytes, header: bytes, frame: bytes) -> bool:
        number = int(topic.split(b"/")[1])
        if number in self.full:
            return False
        head = decode_media_header(header)
        assert topic == make_topic(number, head.stream) + head.budget_class.encode()
        self.got[number].append((head, frame))
        return True

    def push(
        self, n: int = 1, stream: str = "cloud", source: str = "", frames: Mapping[str, bytes] | None = None
    ) -> bool:
        taken = True
        frames = frames or {"full": b"x" * 100}
        for _ in range(n):
            self.now_ns += 16 * MS
            push = MediaPush(stream, 3, self.now_ns - MS, tuple(frames))
            taken = self.hub.push(push, list(frames.values()), source, self.now_ns) and taken
            self.hub.flush(self.send, self.now_ns)
        return taken


def test_subscribers_get_frames_of_their_level() -> None:
    wire = Wire(ann=0, bob=2)
    assert wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    assert wire.hub.subscribe(BOB, "cloud", "b", 2, SECOND)
    wire.push(8)
    assert [len(wire.got[who]) for who in (ANN, BOB)] == [8, 2]
    header, frame = wire.got[BOB][-1]
    assert (header.stream, header.budget_class, header.scene_epoch, header.seq % 4) == ("cloud", "quarter", 3, 0)
    assert (header.published_ns - header.capture_ns, header.dropped, frame) == (MS, 0, b"x" * 100)
    wire.allow(ann=NONE_LEVEL, bob=1)
    wire.push(8)
    assert [len(wire.got[who]) for who in (ANN, BOB)] == [8, 6]


def test_coarser_class_is_sent_at_full_rate() -> None:
    wire = Wire(ann=1, bob=2)
    wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    wire.hub.subscribe(BOB, "cloud", "b", 2, SECOND)
    wire.push(4, frames={"full": b"full", "half": b"half"})
    assert [frame for _, frame in wire.got[ANN]] == [b"half"] * 4
    assert [frame for _, frame in wire.got[BOB]] == [b"half"] * 2, "every second of the next better one"


def test_full_connection_gets_the_newest_frame_later_and_delays_no_other() -> None:
    wire = Wire()
    wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    wire.hub.subscribe(BOB, "cloud", "b", 2, SECOND)
    wire.full = {BOB}
    wire.push(5)
    assert (len(wire.got[ANN]), len(wire.got[BOB])) == (5, 0)
    assert wire.hub.read_counters(BOB) == DeliveryCounters(0, 5, 0)
    wire.full = set()
    assert not wire.hub.flush(wire.send, wire.now_ns)
    ((header, _),) = wire.got[BOB]
    assert (header.seq, header.dropped) == (wire.got[ANN][-1][0].seq, 4)
    assert wire.hub.pop_drops() == ({}, {BOB: 4})
    assert wire.hub.pop_drops() == ({}, {})


def test_only_the_key_of_a_connection_may_subscribe_to_it() -> None:
    wire = Wire()
    assert not wire.hub.subscribe(ANN, "cloud", "b", 2, SECOND)
    assert not wire.hub.subscribe(99, "cloud", "a", 1, SECOND)
    assert wire.hub.pop_drops()[0] == {"media_refused": 2}
    assert wire.hub.list_subscriptions(ANN) == []


def test_closed_connection_gets_nothing() -> None:
    wire = Wire()
    wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    wire.full = {ANN}
    wire.push()
    wire.hub.set_subscribers({BOB: MediaSubscriber("b", {})}, SECOND)
    wire.full = set()
    wire.push()
    assert wire.got[ANN] == []
    assert wire.hub.read_counters(ANN) == DeliveryCounters()


def test_one_of_two_connections_of_a_client_closes() -> None:
    """It has connected again; the end of the connection before is noticed later."""
    wire = Wire()
    wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    wire.hub.subscribe(ANN, "cloud", "a", 3, SECOND)
    wire.hub.remove_reader(1)
    wire.push()
    assert len(wire.got[ANN]) == 1
    wire.hub.unsubscribe(ANN, "cloud", 3)
    wire.hub.unsubscribe(ANN, "cloud", 3)
    wire.push()
    assert len(wire.got[ANN]) == 1
    assert wire.hub.read_counters(ANN).delivered == 1


def test_memory_shortage_pauses_all_media() -> None:
    wire = Wire()
    wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    wire.hub.subscribe(BOB, "cloud", "b", 2, SECOND)
    assert not wire.hub.release_frames(wire.now_ns + SECOND), "there is nothing"
    wire.full = {BOB}
    assert wire.push(frames={"full": bytes(STUCK_BYTES)})
    assert wire.hub.release_frames(wire.now_ns + SECOND)
    assert wire.hub.pop_stuck() == {2}
    assert wire.hub.pop_stuck() == set()
    wire.full = set()
    assert not wire.push()
    assert not wire.hub.release_frames(wire.now_ns + SECOND)
    assert [len(wire.got[who]) for who in (ANN, BOB)] == [1, 0]
    assert wire.hub.pop_drops()[0] == {"media_memory": 2}
    wire.now_ns += SECOND
    assert wire.push()
    assert [len(wire.got[who]) for who in (ANN, BOB)] == [2, 1]


@pytest.mark.parametrize(
    ("stream", "frames"),
    [
        ("a/b", {"full": b""}),
        ("", {"full": b""}),
        ("cloud", {"half": b""}),
        ("cloud", {"full": b"", "none": b""}),
        ("cloud", {"full": b"", "huge": b""}),
    ],
)
def test_frames_that_do_not_fit_are_counted(stream: str, frames: dict[str, bytes]) -> None:
    wire = Wire()
    assert not wire.push(stream=stream, frames=frames)
    push = MediaPush("cloud", 0, 0, ("full",))
    assert not wire.hub.push(push, [], "", wire.now_ns)
    assert wire.hub.pop_drops()[0] == {"media_malformed": 2}
    assert wire.hub.read_streams() == {}


def test_streams_and_subscriptions_are_bounded() -> None:
    wire = Wire()
    for n in range(MAX_STREAMS + 1):
        assert wire.push(stream=f"s{n}") == (n < MAX_STREAMS)
        assert wire.hub.subscribe(ANN, f"s{n}", "a", 1, SECOND) == (n < MAX_STREAMS)
    assert wire.hub.pop_drops()[0] == {"media_streams_full": 1, "media_subscriptions_full": 1}
    wire.now_ns += 100 * SECOND
    wire.hub.sample_rates(wire.now_ns)
    assert wire.hub.read_streams() == {}
    assert wire.push(stream="another")


def test_stream_belongs_to_one_connection_of_its_key() -> None:
    """On plain loopback all sources have the key "", and two processes may have the key of one user."""
    wire = Wire()
    wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)

    def push(connection: int | None, info: StreamInfo | None = None) -> bool:
        push = MediaPush("cloud", 3, wire.now_ns, info=info)
        return wire.hub.push(push, [b"%d" % (connection or 0)], "", wire.now_ns, connection)

    room = StreamInfo("Room")
    assert push(11, room)
    assert [push(12), push(None), push(LOCAL), push(11)] == [False, False, False, True]
    assert wire.hub.pop_drops()[0] == {"media_stream_taken": 3}
    wire.hub.release_streams(12)
    assert not push(12)
    wire.hub.release_streams(11)
    assert push(None), "frames of the one that has ended may come after its end"
    assert push(12)
    assert wire.hub.read_streams()["cloud"].info == room, "a source that has connected again is the same one"
    assert not push(11)
    wire.now_ns += 4 * SECOND
    assert push(11)
    assert not push(12)


def test_rates_cover_the_last_seconds() -> None:
    wire = Wire()
    for _ in range(12):
        wire.push(16)
        wire.hub.sample_rates(wire.now_ns)
    facts = wire.hub.read_streams()["cloud"]
    assert facts.hz == pytest.approx(62.5)
    assert facts.rates == pytest.approx(tuple(6250.0 / 2**level for level in range(NONE_LEVEL)))


def test_new_subscriber_gets_the_newest_frame_of_a_stream_at_rest() -> None:
    wire = Wire(bob=1)
    wire.push(3)
    assert wire.hub.subscribe(ANN, "cloud", "a", 1, wire.now_ns)
    assert wire.hub.subscribe(BOB, "cloud", "b", 2, wire.now_ns)
    wire.hub.flush(wire.send, wire.now_ns)
    assert [[head.budget_class for head, _ in wire.got[who]] for who in (ANN, BOB)] == [["full"], ["half"]]
    assert wire.hub.read_counters(ANN) == DeliveryCounters(1, 1, wire.hub.read_counters(ANN).bytes)
    wire.hub.flush(wire.send, wire.now_ns)
    assert len(wire.got[ANN]) == 1


def test_subscribing_over_and_over_gets_no_frame_each_time() -> None:
    wire = Wire()
    wire.push()
    for _ in range(200):
        wire.now_ns += 5 * MS
        wire.hub.subscribe(ANN, "cloud", "a", 1, wire.now_ns)
        wire.hub.flush(wire.send, wire.now_ns)
        wire.hub.unsubscribe(ANN, "cloud", 1)
    assert MAX_STREAMS <= len(wire.got[ANN]) <= MAX_STREAMS + 2
    assert wire.hub.pop_drops()[0]["media_newest_rate"] == 200 - len(wire.got[ANN])
    wire.push()
    wire.hub.subscribe(ANN, "cloud", "a", 1, wire.now_ns)
    before = len(wire.got[ANN])
    wire.push()
    assert len(wire.got[ANN]) == before + 1  # frames after it come as ever


def test_restarted_front_numbers_frames_above_its_predecessor() -> None:
    wire, later = Wire(), Wire()
    wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    later.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    wire.push(30)
    later.now_ns = wire.now_ns
    later.push()
    assert later.got[ANN][0][0].seq > wire.got[ANN][-1][0].seq


def describe(wire: Wire, info: StreamInfo | None, source: str = "", *frames: bytes) -> StreamInfo:
    """Send an info, with a frame or alone, and return that of the stream then."""
    push = MediaPush("cloud", 3, wire.now_ns, ("full",) * len(frames), info=info)
    wire.hub.push(push, frames, source, wire.now_ns)
    return wire.hub.read_streams()["cloud"].info


def test_info_may_come_without_a_frame() -> None:
    """A camera that gives no picture tells so, before the first one and after the last."""
    wire = Wire()
    dark = StreamInfo("Room", fault="source", detail="no such device")
    assert describe(wire, dark) == dark
    wire.push()
    for _ in range(70):
        wire.now_ns += SECOND
        assert describe(wire, dark) == dark
        wire.hub.sample_rates(wire.now_ns)
    wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    wire.hub.flush(wire.send, wire.now_ns)
    assert [frame for _, frame in wire.got[ANN]] == [b"x" * 100], "kept as long as its source is there"
    wire.now_ns += 4 * SECOND
    assert describe(wire, None, "other", b"x") == StreamInfo(), "of another source"


@pytest.mark.parametrize(
    "changes",
    [
        {"hz": math.nan},
        {"hz": math.inf},
        {"hz": -1.0},
        {"camera": StreamCamera(2**40, 1, 1.0, 1.0, 0.0, 0.0)},
        {"camera": StreamCamera(1, 1, math.nan, 1.0, 0.0, 0.0)},
        {"camera": StreamCamera(1, 1, 1.0, 1.0, 0.0, 0.0, position=(1e300, 0.0, 0.0))},
        {"camera": StreamCamera(1, 1, 1.0, 1.0, 0.0, 0.0, orientation=(math.nan, 0.0, 0.0, 0.0))},
    ],
)
def test_impossible_info_is_counted_and_the_frame_is_taken(changes: dict[str, Any]) -> None:
    wire = Wire()
    wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    good = StreamInfo("Room")
    describe(wire, good, "", b"x")
    assert describe(wire, msgspec.structs.replace(good, **changes), "", b"y") == good
    assert wire.hub.pop_drops()[0] == {"media_info_malformed": 1}
    wire.hub.flush(wire.send, wire.now_ns)
    assert wire.got[ANN][-1][1] == b"y"


def test_texts_of_an_info_are_cut_and_printable() -> None:
    wire = Wire()
    info = describe(wire, StreamInfo("t" * 512, detail="d" * 512), "", b"x")
    assert (info.title, info.detail) == ("t" * MAX_TITLE, "d" * MAX_DETAIL)
    assert describe(wire, StreamInfo("a\x1b[2Jb", detail="c\nd")) == StreamInfo("a [2Jb", detail="c d")


@pytest.mark.parametrize(("hz", "late_ns"), [(30.0, SECOND), (1.0, 3 * SECOND), (0.0, None)])
def test_stream_is_stale_without_the_frames_that_it_means_to_have(hz: float, late_ns: int | None) -> None:
    wire = Wire()
    describe(wire, StreamInfo(hz=hz), "", b"x")
    facts = wire.hub.read_streams()["cloud"]
    last = facts.received_ns + (late_ns or 59 * SECOND)
    assert not facts.is_stale(last)
    assert facts.is_stale(last + MS) == (late_ns is not None)
    wire.now_ns = last + MS
    describe(wire, StreamInfo(hz=hz))
    assert wire.hub.read_streams()["cloud"].is_stale(last + MS) == (late_ns is not None), "an info is no frame"
    describe(wire, None, "", b"x")
    assert not wire.hub.read_streams()["cloud"].is_stale(last + MS)


def test_pace_of_a_connection_is_told_once_for_each_of_its_readers() -> None:
    wire = Wire()

    def allow(pace: float) -> None:
        wire.hub.set_subscribers({ANN: MediaSubscriber("a", {}, 0, pace), BOB: MediaSubscriber("b", {})}, SECOND)

    wire.hub.subscribe(ANN, "cloud", "a", 1, SECOND)
    wire.hub.subscribe(BOB, "cloud", "b", 2, SECOND)
    assert wire.hub.pop_paces() == {}
    allow(5e6)
    assert wire.hub.pop_paces() == {1: 5e6}
    assert wire.hub.pop_paces() == {}
    wire.hub.subscribe(ANN, "camera", "a", 3, SECOND)
    assert wire.hub.pop_paces() == {3: 5e6}
    wire.hub.remove_reader(3)
    wire.hub.subscribe(ANN, "camera", "a", 3, SECOND)  # another connection with this descriptor
    assert wire.hub.pop_paces() == {3: 5e6}
    allow(0.0)
    assert wire.hub.pop_paces() == {1: 0.0, 3: 0.0}
    assert wire.hub.pop_paces() == {}
