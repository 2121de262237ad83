"""Raw samples on their way to the recorder: batches, shares of keys and of all, what observers leave in a recording."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zmq

from iris_session.front import raw_feed
from iris_session.front.connections import FrontConnection, Peer, Route
from iris_session.front.raw_feed import (
    BATCH_BYTES,
    BURST_S,
    KEY_BYTES_PER_S,
    KEY_SHARE,
    LOG_PERIOD_NS,
    NOT_READ,
    PRESENCE_BYTES_PER_S,
    PRESENCE_DEVICES,
    PRESENCE_HZ,
    PRESENCE_SHARE,
    TOTAL_BYTES_PER_S,
    TOTAL_SHARE,
    PresenceLimiter,
    RawFeed,
)
from iris_session.protocol.client_messages import Hello, Sample
from iris_session.protocol.common import Pose, Target
from iris_session.protocol.limits import Drops
from iris_session.protocol.status import ClientReport

SECOND = 1_000_000_000
POSE = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
#: The largest sample that a client can send: about 6 kB.
LARGE = Sample("head", "pose", 1, 0, 1, 0, 1, pose=POSE, hand_joints=(0.1,) * 182, q=(0.1,) * 64, qd=(0.1,) * 64)
LARGE_BYTES = len(msgspec.msgpack.encode(LARGE))


def connection(number: int, key: str, role: str = "operator") -> FrontConnection:
    hello = Hello(role, f"name of {key}", secret=b"s" * 16)
    return FrontConnection(number, Route(bytes([number])), Peer(number, key), ("10.0.0.1", 5), key, hello, 0)


class Rig:
    """A feed with a socket that reads it, which may also not be read."""

    def __init__(self, path: Path) -> None:
        self.drops = Drops()
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.recorder = self.context.socket(zmq.PULL)
        self.recorder.setsockopt(zmq.RCVHWM, 1)
        self.recorder.bind(f"ipc://{path}/raw")
        self.feed = RawFeed(self.context, f"ipc://{path}/raw", self.drops)

    def receive(self, n: int) -> list[Any]:
        """Wait for so many rows. Return all that have come."""
        rows: list[Any] = []
        while self.recorder.poll(30_000 if len(rows) < n else 300):
            rows += msgspec.msgpack.decode(self.recorder.recv())
        return rows


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    yield rig
    rig.context.destroy(linger=0)


def test_reports_of_participants_go_with_the_samples(rig: Rig) -> None:
    ann, stranger = connection(1, "ann"), connection(2, "stranger")
    ann.participant_id = "p1"
    report = ClientReport(1.5, 2.5, delivered=60)
    for one in (ann, stranger):
        rig.feed.send_report(one, 7, report)
    rig.feed.tick(SECOND)
    ((number, receive_ns, data),) = rig.receive(1)
    assert (number, receive_ns) == (1, 7)
    assert data[0] == 0x92, "which no message begins with"
    assert msgspec.msgpack.decode(data, type=tuple[str, ClientReport]) == ("p1", report)


def test_one_key_has_its_share_over_all_its_connections(rig: Rig, caplog: pytest.LogCaptureFixture) -> None:
    """A key that sends all it can (600 samples a second, eight connections) leaves the others theirs."""
    eves = [connection(10 + i, "eve") for i in range(8)]
    ann = connection(1, "ann")
    sent = 0
    with caplog.at_level(logging.WARNING):
        for tick in range(1000):  # ten seconds
            now_ns = tick * SECOND // 100
            for eve in eves:
                for _ in range(6):
                    rig.feed.send(eve, now_ns, LARGE)
            rig.feed.send(ann, now_ns, LARGE)
            rig.feed.tick(now_ns)
            sent += 48
            while rig.recorder.poll(0):
                rig.recorder.recv()
    left_out = rig.drops.by_reason[KEY_SHARE]
    assert (sent - left_out) * LARGE_BYTES <= KEY_BYTES_PER_S * (10 + BURST_S)
    assert (sent - left_out) * LARGE_BYTES >= KEY_BYTES_PER_S * 9
    assert 1 not in rig.drops.by_connection
    lines = [record.message for record in caplog.records]
    assert 1 <= len(lines) <= 10 * SECOND // LOG_PERIOD_NS + 1
    assert "name of eve" in lines[0]


def test_all_keys_together_are_bounded(rig: Rig) -> None:
    keys = [connection(i, f"key {i}") for i in range(60)]
    sent = 0
    for tick in range(300):
        for one in keys:
            rig.feed.send(one, tick * SECOND // 100, LARGE)
            sent += 1
        rig.feed.tick(tick * SECOND // 100)
        while rig.recorder.poll(0):
            rig.recorder.recv()
    assert (sent - rig.drops.by_reason[TOTAL_SHARE]) * LARGE_BYTES <= TOTAL_BYTES_PER_S * (3 + BURST_S)


def test_recorder_that_does_not_read_costs_bounded_memory(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(raw_feed, "BATCHES_IN_TRANSIT", 4)
    feed = RawFeed(rig.context, "inproc://unread", rig.drops)
    ann = connection(1, "ann")
    n = 20 * BATCH_BYTES // LARGE_BYTES
    for _ in range(n):
        feed.send(ann, 0, LARGE)
    feed.tick(0)
    assert n - 5 * (BATCH_BYTES // LARGE_BYTES + 1) <= rig.drops.by_reason[NOT_READ] < n
    feed.close()
    feed._socket.close(linger=0)  # type: ignore[union-attr]


def test_of_observers_only_presence_at_display_rate_counts() -> None:
    drops = Drops()
    limiter, eve = PresenceLimiter(drops), connection(1, "eve", "observer")
    kept = []
    for i in range(1200):  # two seconds at the limit of a connection, every sample an edge
        sample = msgspec.structs.replace(LARGE, seq=i, buttons=i % 2)
        kept.append(limiter.limit(eve, sample, i * SECOND // 600))
    passed = [one for one in kept if one is not None]
    assert 2 * PRESENCE_HZ - 2 <= len(passed) <= 2 * PRESENCE_HZ + 2
    assert all(len(msgspec.msgpack.encode(one)) < 300 for one in passed)
    assert {(one.pose, one.buttons, one.hand_joints, one.q) for one in passed} == {(POSE, 0, (), ())}
    assert drops.by_reason == {}, "a headset that samples faster than a display does nothing wrong"


def test_headset_taken_off_is_said_at_once() -> None:
    limiter, eve = PresenceLimiter(Drops()), connection(1, "eve", "observer")
    on = Sample("head", "pose", 1, 0, 1, 0, 1, pose=POSE)
    assert limiter.limit(eve, on, 0) is on
    off = msgspec.structs.replace(on, worn=False)
    assert limiter.limit(eve, off, 1) is off
    assert limiter.limit(eve, off, 2) is None


@pytest.mark.parametrize("devices", [1, 40])
def test_observers_of_one_key_have_one_share(devices: int) -> None:
    drops = Drops()
    limiter = PresenceLimiter(drops)
    eves = [connection(i, "eve", "observer") for i in range(8)]
    targets = tuple(Target("t" * 64, i) for i in range(8))
    written = 0
    for i in range(6000):
        for eve in eves:
            sample = Sample(f"{i % devices}{'d' * 60}", "pose", i, 0, 1, 0, 1, targets, worn=bool(i % 2), pose=POSE)
            passed = limiter.limit(eve, sample, i * SECOND // 600)
            written += 0 if passed is None else len(msgspec.msgpack.encode(passed))
    assert written <= PRESENCE_BYTES_PER_S * (10 + BURST_S)
    assert drops.by_reason[PRESENCE_SHARE] > 0
    assert all(len(eve.presence_due_ns) <= PRESENCE_DEVICES for eve in eves)
