"""The feed against a recorder emulated by the test: order, repetition, backlog and loss."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zmq

from iris_session.journal.feed import BATCH_ROWS, JOURNAL_SHARE
from iris_session.journal.messages import (
    FRAME,
    HEADER,
    Batch,
    RecorderStatus,
    RobotLabels,
    SceneAssets,
    SceneModel,
    decode_batch,
    encode_status,
)
from iris_session.journal.rows import check_keyframe
from iris_session.protocol.common import Denial, Pose
from iris_session.protocol.server_messages import (
    BodyInfo,
    Event,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
    PresenceItem,
    Reply,
)
from iris_session.protocol.steps import Decision, OutgoingMessage
from iris_session.recording import Keyframe, RecorderFeed, make_row
from iris_session.streams.deformable import DeformableEncoder
from iris_session.streams.deformable_topology import DeformableTopology
from tests.recording.support import make_header

ROOT = b"r" * 16


class PlayedRecorder:
    """The other end of the socket: keeps what it received, and sends statuses."""

    def __init__(self, endpoint: str) -> None:
        self.context = zmq.Context()
        self.socket = self.context.socket(zmq.DEALER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.bind(endpoint)

    def say(self, feed: RecorderFeed, instance: int, expecting: int, written: int) -> None:
        self.socket.send(encode_status(RecorderStatus(instance, expecting, written)))
        assert feed._socket.poll(30_000), "the status does not arrive"
        feed.flush()

    def take(self, n: int) -> list[tuple[bytes, int, bytes]]:
        """Receive the next `n` messages as (kind, number, body)."""
        out = []
        for _ in range(n):
            assert self.socket.poll(30_000), f"only {len(out)} of {n} messages came"
            head, body, *self.more = self.socket.recv_multipart()
            out.append((*FRAME.unpack(head), body))
        return out

    def is_quiet(self) -> bool:
        return not self.socket.poll(50)


@pytest.fixture
def played(tmp_path: Path) -> Iterator[tuple[PlayedRecorder, str]]:
    endpoint = f"ipc://{tmp_path}/f"
    recorder = PlayedRecorder(endpoint)
    yield recorder, endpoint
    recorder.context.destroy(linger=0)


@pytest.fixture
def feed(played: tuple[PlayedRecorder, str]) -> Iterator[RecorderFeed]:
    feed = RecorderFeed(played[1])
    feed.send_header(make_header())
    yield feed
    feed.close(0.0)


def steps(feed: RecorderFeed, first: int, n: int) -> None:
    for step in range(first, first + n):
        feed.add_row(make_row(ROOT, step, step * 2_000_000, 1, [], b"d" * 16))


def numbers(batch: Batch) -> list[int]:
    return [row.step for row in batch.rows]


def test_rows_are_sent_within_twenty_milliseconds(feed: RecorderFeed, played) -> None:  # type: ignore[no-untyped-def]
    played[0].say(feed, 1, -1, -1)
    played[0].take(1)
    steps(feed, 0, BATCH_ROWS - 1)
    assert played[0].is_quiet()
    steps(feed, BATCH_ROWS - 1, 1)
    assert len(numbers(decode_batch(played[0].take(1)[0][2]))) == BATCH_ROWS
    feed.add_row(make_row(ROOT, 10, 100_000_000, 0, [], b"d" * 16))
    feed.add_row(make_row(ROOT, 11, 120_000_000, 0, [], b"d" * 16))  # paused: 50 steps a second
    assert numbers(decode_batch(played[0].take(1)[0][2])) == [10, 11]


def test_acknowledged_rows_are_removed_and_a_new_recorder_gets_the_others(feed: RecorderFeed, played) -> None:  # type: ignore[no-untyped-def]
    played[0].say(feed, 1, -1, -1)
    steps(feed, 0, 50)
    played[0].take(6)
    played[0].say(feed, 1, 5, 2)
    assert feed.stats.window_bytes > 0
    played[0].say(feed, 2, -1, -1)
    again = played[0].take(3)
    assert (again[0][0], again[0][1]) == (HEADER, 3)
    assert [number for _, number, _ in again[1:]] == [3, 4]
    assert numbers(decode_batch(again[1][2])) == list(range(30, 40))
    played[0].say(feed, 2, 5, 4)
    assert feed.stats.window_bytes == 0
    assert feed.stats.recorders == 2
    assert feed.close(0.0)


def test_what_exceeds_the_window_waits_and_is_sent_in_order(played) -> None:  # type: ignore[no-untyped-def]
    recorder, endpoint = played
    feed = RecorderFeed(endpoint, window_bytes=2000)
    feed.send_header(make_header())
    steps(feed, 0, 300)
    assert feed.stats.waiting_batches > 10
    assert feed.stats.window_bytes < 4000, "one batch more than the limit"
    assert feed.stats.dropped_rows == 0
    recorder.say(feed, 1, -1, -1)
    got: list[int] = []
    written = -1
    recorder.take(1)
    while len(got) < 300:
        for _, number, body in recorder.take(1):
            got += numbers(decode_batch(body))
            written = number
        recorder.say(feed, 1, written + 1, written)
    assert got == list(range(300))
    assert (feed.stats.waiting_batches, feed.stats.waiting_bytes) == (0, 0)
    assert feed.close(0.0)


def test_full_backlog_drops_rows_counts_and_reports_them(played) -> None:  # type: ignore[no-untyped-def]
    recorder, endpoint = played
    feed = RecorderFeed(endpoint, window_bytes=3000, backlog_bytes=3000)
    feed.send_header(make_header())
    steps(feed, 0, 500)
    lost = feed.stats.dropped_rows
    assert 0 < lost < 500
    assert "limit" in feed.stats.drop_reason
    assert feed.take_gap() == lost
    assert feed.take_gap() == 0
    assert not feed.wants_keyframe, "a snapshot costs time and there is no room for it"
    recorder.say(feed, 1, -1, -1)
    recorder.take(1)
    while feed.stats.window_bytes:
        _, number, _ = recorder.take(1)[0]
        recorder.say(feed, 1, number + 1, number)
    assert feed.wants_keyframe
    feed.add_keyframe(Keyframe(499, b"", b"", b""), ROOT)
    assert not feed.wants_keyframe
    batch = decode_batch(recorder.take(1)[0][2])
    assert batch.dropped_rows == lost
    assert batch.keyframes[0].step == 499
    assert not feed.close(0.0)


def test_the_rest_of_a_nearly_full_backlog_is_for_the_journal(played) -> None:  # type: ignore[no-untyped-def]
    _, endpoint = played
    limit = 60_000
    feed = RecorderFeed(endpoint, window_bytes=2000, backlog_bytes=limit)
    feed.send_header(make_header())
    for step in range(1000):
        feed.add_state(step, step, 0.1, 70, np.arange(21.0).reshape(3, 7))
        steps(feed, step, 1)
        if feed.stats.dropped_items:
            break
    assert feed.stats.dropped_items > 0
    assert feed.stats.dropped_rows == 0
    assert JOURNAL_SHARE * limit < feed.stats.waiting_bytes < limit
    feed.close(0.0)


def test_rows_not_received_before_the_end_are_counted(played) -> None:  # type: ignore[no-untyped-def]
    _, endpoint = played
    feed = RecorderFeed(endpoint, window_bytes=2000)
    feed.send_header(make_header())
    steps(feed, 0, 300)
    waiting = sum(rows for _, rows, _ in feed._backlog)
    assert not feed.close(0.0)
    assert feed.stats.dropped_rows == waiting > 0
    assert "ended before" in feed.stats.drop_reason
    assert not feed.close(0.0), "asked again"


@pytest.mark.parametrize(
    ("cpu_step_s", "alive", "waits"),
    [(0.01, True, 50), (0.0, True, 4), (0.01, False, 1)],
    ids=["slow", "hangs", "gone"],
)
def test_close_waits_for_a_slow_recorder_but_not_for_one_that_hangs_or_is_gone(
    feed: RecorderFeed, played, cpu_step_s: float, alive: bool, waits: int
) -> None:  # type: ignore[no-untyped-def]
    played[0].say(feed, 1, -1, -1)
    steps(feed, 0, 10)
    asked: list[float] = []

    def cpu_s() -> float:
        asked.append(cpu_step_s * len(asked))
        return asked[-1]

    assert not feed.close(1.0, lambda: alive, 0.06, cpu_s)
    assert len(asked) == pytest.approx(waits, abs=1)


def test_silence_of_a_busy_recorder_is_measured(feed: RecorderFeed, played) -> None:  # type: ignore[no-untyped-def]
    played[0].say(feed, 1, -1, -1)
    steps(feed, 0, 100)
    quiet_ns = feed.silence_ns
    assert quiet_ns > 0
    steps(feed, 100, 100)
    assert feed.silence_ns > quiet_ns
    played[0].say(feed, 1, 10, 9)
    feed.flush()
    assert feed.silence_ns == 0
    played[0].say(feed, 1, 20, 19)
    feed.add_row(make_row(ROOT, 200, 60_000_000_000, 0, [], b"d" * 16))  # the session itself stood still
    assert feed.silence_ns == 0


def test_states_events_and_denials_are_sent_with_the_rows(feed: RecorderFeed, played) -> None:  # type: ignore[no-untyped-def]
    played[0].say(feed, 1, -1, -1)
    played[0].take(1)
    head = PresenceItem("p1", "head", Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0)), 5)
    denial = Denial("held", "left is held", "ask", "left", "p2", "Ada")
    replies = (OutgoingMessage(4, Reply(1, False, denial)), OutgoingMessage(5, Reply(2, True)))
    feed.add_decision(3, 70, Decision(commands=(), outgoing=replies, presence=(head,)))
    feed.add_state(3, 9, 0.1, 70, np.arange(21.0).reshape(3, 7), (), b"measured")
    feed.add_metric(3, 70, "late_ms", 2.5)
    feed.add_keyframe(Keyframe(2, b"p", b"a", b"c"), ROOT)
    batch = decode_batch(played[0].take(1)[0][2])
    assert [(d.connection, d.denial) for d in batch.denials] == [(4, denial)]
    assert batch.states[0].presence == (head,)
    assert batch.states[0].robots == b"measured"
    assert np.frombuffer(batch.states[0].poses).tolist() == list(range(21))
    assert batch.metrics[0].value == 2.5
    assert check_keyframe(batch.keyframes[0]) == ""
    assert batch.keyframes[0].chain == ROOT


def test_state_has_all_presence_since_the_last(feed: RecorderFeed, played) -> None:  # type: ignore[no-untyped-def]
    played[0].say(feed, 1, -1, -1)
    played[0].take(1)
    pose = Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    ann, bob, newer = (PresenceItem(who, "head", pose, at) for who, at in (("p1", 5), ("p2", 6), ("p1", 7)))
    for step, items in enumerate(((ann,), (bob,), (), (newer,))):
        feed.add_decision(step, step, Decision(commands=(), presence=items))
    feed.add_state(3, 9, 0.1, 70, np.zeros((0, 7)))
    feed.add_state(4, 10, 0.2, 80, np.zeros((0, 7)))
    feed.add_decision(5, 5, Decision(commands=(), presence=(ann, bob)))
    feed.add_decision(6, 6, Decision(commands=(), events=(Event(1, 6, 6, ParticipantLeft("p1", "bye")),)))
    feed.add_state(6, 11, 0.3, 90, np.zeros((0, 7)))
    feed.flush()
    first, second, third = decode_batch(played[0].take(1)[0][2]).states
    assert set(first.presence) == {newer, bob}
    assert second.presence == ()
    assert third.presence == (bob,), "who has left is not seen again"


def test_recorder_that_starts_later_knows_participants_by_name(feed: RecorderFeed, played) -> None:  # type: ignore[no-untyped-def]
    ann, bob, eve = (
        ParticipantInfo(f"p{i}", name, "operator", True) for i, name in ((1, "ann"), (2, "bob"), (3, "eve"))
    )
    bodies = (
        ParticipantJoined(ann),
        ParticipantJoined(bob),
        ParticipantJoined(eve),
        ParticipantChanged(msgspec.structs.replace(bob, name="rob")),
        ParticipantLeft("p3", "bye"),  # which the later recorder may still have to write
    )
    feed.add_decision(0, 0, Decision(commands=(), events=tuple(Event(i, 0, 0, body) for i, body in enumerate(bodies))))
    played[0].say(feed, 2, -1, -1)
    played[0].take(1)
    people = decode_batch(played[0].more[0]).people
    assert [(one.id, one.name) for one in people] == [("p1", "ann"), ("p2", "rob"), ("p3", "eve")]


def test_simulated_time_goes_on_over_resets(feed: RecorderFeed, played) -> None:  # type: ignore[no-untyped-def]
    """Also that of a publisher whose time is the time of day, and who plays a log again and again."""
    played[0].say(feed, 1, -1, -1)
    played[0].take(1)
    for step, time_s in enumerate((0.5, 2.0, 0.0, 0.5, 0.25, 1.7e9, 1.7e9 + 1.0, 1.7e9, 1.7e9 + 1.0, 1.7e9)):
        feed.add_state(step, step, time_s, step, np.zeros((0, 7)))
    feed.flush()
    states = decode_batch(played[0].take(1)[0][2]).states
    assert [state.sim_before for state in states] == [0.0, 0.0, 2.0, 2.0, *[2.25] * 3, *[3.25] * 2, 4.25]


def test_scene_precedes_its_row_and_is_repeated_for_a_new_recorder(
    played: tuple[PlayedRecorder, str], feed: RecorderFeed
) -> None:
    recorder, *_ = played
    recorder.say(feed, 1, -1, -1)
    recorder.take(1)
    assert [decode_batch(frame) for frame in recorder.more] == [Batch(assets=[SceneAssets()])]
    steps(feed, 0, 3)
    bodies = (BodyInfo(1, "cup", moving=True),)
    robots = (RobotLabels("left", "base", ("hinge",), ("rad",)),)
    feed.send_scene("hash", b"packed", bodies, "/store", "ab", robots)
    steps(feed, 3, BATCH_ROWS)
    before, scene, after = (decode_batch(body) for _, _, body in recorder.take(3))
    assert [row.step for row in before.rows] == [0, 1, 2]
    assert (scene.scenes, scene.rows) == ([SceneModel(2, 4_000_000, "hash", b"packed", bodies)], [])
    assert scene.assets == [SceneAssets(2, 4_000_000, "/store", "ab", robots)]
    assert after.rows[0].step == 3
    recorder.say(feed, 1, 3, 2)
    recorder.say(feed, 2, -1, -1)  # everything is in the file of the one before
    recorder.take(1)
    known = [Batch(scenes=scene.scenes, assets=scene.assets)]
    assert [decode_batch(frame) for frame in recorder.more] == known
    feed.send_patch("/store", "cd")
    (patch,) = (decode_batch(body) for _, _, body in recorder.take(1))
    assert (patch.scenes, patch.assets) == ([], [SceneAssets(12, 24_000_000, "/store", "cd", robots)])
    recorder.say(feed, 3, -1, -1)
    recorder.take(1)
    assert [decode_batch(frame) for frame in recorder.more] == [Batch(scenes=scene.scenes, assets=patch.assets)]


@pytest.fixture
def square() -> bytes:
    """Return a frame of four vertices."""
    encoder = DeformableEncoder(DeformableTopology(4, faces=[(0, 1, 3), (0, 3, 2)]))
    frames = encoder.encode(np.arange(12.0).reshape(4, 3))
    assert frames is not None
    return frames["full"]


def test_vertices_have_a_rate_and_are_dropped_while_batches_wait(played, square: bytes) -> None:  # type: ignore[no-untyped-def]
    recorder, endpoint = played
    feed = RecorderFeed(endpoint, window_bytes=1)
    feed.send_header(make_header())
    for now_ns in (0, 20_000_000, 50_000_000):
        feed.add_vertices("flex-0", square, now_ns)
    feed.add_vertices("flex-1", square, 50_000_000)
    recorder.say(feed, 1, -1, -1)  # has seen none of them
    feed.add_vertices("flex-0", square, 60_000_000)
    feed.flush()
    steps(feed, 0, BATCH_ROWS)
    feed.add_vertices("flex-0", square, 200_000_000)
    assert (feed.stats.waiting_batches, feed.stats.dropped_vertices) == (2, 1)
    vertices = [one for _, _, body in recorder.take(2)[1:] for one in decode_batch(body).vertices]
    assert [(one.stream, one.session_time) for one in vertices] == [
        ("flex-0", 0),
        ("flex-0", 50_000_000),
        ("flex-1", 50_000_000),
    ]
    feed.close(0.0)


def test_nothing_waits_after_the_budget_is_used_up(feed: RecorderFeed, played) -> None:  # type: ignore[no-untyped-def]
    played[0].say(feed, 1, -1, -1)
    steps(feed, 0, 30)
    played[0].take(4)
    for instance, expecting in ((1, 3), (2, -1)):  # also from a recorder that finds it used up
        played[0].socket.send(encode_status(RecorderStatus(instance, expecting, 0, budget=10**8, ended=True)))
        assert feed._socket.poll(30_000)
        feed.flush()
        steps(feed, 30, 200)
        feed.send_patch("/assets", "hash")
        assert (feed.stats.window_bytes, feed.stats.dropped_rows, feed.take_gap()) == (0, 0, 0)
        assert (feed.wants_keyframe, feed.silence_ns) == (False, 0)
        assert played[0].is_quiet(), "not even the header"
    assert feed.close()
