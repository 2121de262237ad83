"""Media of a client: subscriptions, drops, sources, and misuse. Levels and budgets are decided in the front."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
import zmq

from iris_session.client import Client, InvalidMessageError, NotConnectedError
from iris_session.client.sockets import ClientSockets
from iris_session.protocol.media import StreamBudget
from iris_session.protocol.names import BudgetClass
from iris_session.protocol.status import ClientReport, DeliveryBudget
from tests.client.session import ClientSession

Join = Callable[..., Client]


def test_newest_frame_is_delivered_once(session: ClientSession, join: Join) -> None:
    ann = join()
    feed = ann.media.subscribe("cloud")
    assert ann.media.subscribe("cloud") is feed
    ann.sleep(0.1)
    for data in (b"old", b"points"):
        session.publish_media("cloud", data)
    ann.poll()
    frame = feed.pop_newest()
    assert frame is not None
    assert (frame.data, frame.header.stream, feed.budget_class) == (b"points", "cloud", BudgetClass.FULL)
    assert (feed.received, feed.superseded) == (2, 1)
    assert frame is feed.newest
    assert abs(frame.age_ns) < ann.clock_error_ns()
    assert feed.pop_newest() is None
    session.publish_media("other", b"")
    session.publish_media("cloud", b"next")
    ann.poll()
    assert (feed.received, feed.pop_newest() is feed.newest) == (3, True)
    ann.media.unsubscribe("cloud")
    assert ann.media.subscribe("cloud") is not feed


def test_subscriptions_survive_a_restart_of_the_front(session: ClientSession, join: Join) -> None:
    ann = join()
    feed = ann.media.subscribe("cloud")
    ann.sleep(0.1)
    before = session.sockets_of(ann).topics.copy()
    session.kill_front()
    assert ann.wait_for(lambda c: not c.ready)
    assert ann.wait_for(lambda c: c.ready)
    ann.sleep(0.1)
    after = session.sockets_of(ann).topics
    assert len(before) == len(after) == 1
    assert before != after, "topics name the connection"
    session.publish_media("cloud", b"points")
    ann.poll()
    assert feed.received == 1


def test_budget_of_the_session_and_limit_of_the_client_are_reported(
    session: ClientSession, join: Join, monkeypatch: pytest.MonkeyPatch
) -> None:
    session.budget = DeliveryBudget(BudgetClass.HALF, reason="client", streams=(StreamBudget("cloud", "quarter"),))
    ann = join()
    cloud, depth = ann.media.subscribe("cloud"), ann.media.subscribe("depth")
    ann.sleep(0.1)
    assert (cloud.budget_class, depth.budget_class) == (BudgetClass.QUARTER, BudgetClass.HALF)
    assert ann.media.delivery == session.budget
    ann.media.limit_mbit_per_s = 0.5
    ann.sleep(1.0 - session.now_ns % 1e9 * 1e-9)
    reports: list[ClientReport] = []
    send = ann.connection.send
    monkeypatch.setattr(ann.connection, "send", lambda message: (reports.append(message), send(message))[1])
    for _ in range(3):
        session.publish_media("cloud", bytes(1000), capture_ns=session.now_ns - 30_000_000)
        ann.sleep(0.3)
    ann.sleep(1.5)
    report = max(reports, key=lambda one: one.media_bytes_per_s)
    assert report.media_limit_mbit_per_s == 0.5
    assert report.media_age_ms == pytest.approx(30.0, abs=ann.clock_error_ns() * 1e-6)
    assert 1000.0 < report.media_bytes_per_s < 3300.0
    assert reports[-1].media_bytes_per_s == 0.0


def test_invalid_stream_names_are_rejected(session: ClientSession) -> None:
    ann = session.make_client()
    for name in ("", "a/b", "-a", "x" * 49, "ä"):
        with pytest.raises(InvalidMessageError):
            ann.media.subscribe(name)
    with pytest.raises(NotConnectedError):
        ann.media.publish("cloud", b"")
    ann.connect()
    with pytest.raises(InvalidMessageError, match="full"):
        ann.media.publish("cloud", {"half": b""})


def test_source_publishes_frames(session: ClientSession, join: Join) -> None:
    camera = join("cam", role="camera")
    assert camera.media.publish("depth", {"full": b"all", "half": b"less"}, capture_ns=5)
    ((stream, frames),) = session.sockets_of(camera).published
    assert (stream, frames[1:]) == ("depth", [b"all", b"less"])


def test_frames_of_an_unsubscribed_stream_are_late_and_not_malformed(session: ClientSession, join: Join) -> None:
    ann = join()
    ann.media.subscribe("cloud")
    ann.sleep(0.1)
    session.publish_media("cloud", b"points")
    ann.media.unsubscribe("cloud")
    ann.poll()
    assert (ann.media.late, ann.media.malformed) == (1, 0)
    session.sockets_of(ann)._media += [[b"topic", b"\xc1", b""], [b"topic"]]
    ann.poll()
    assert (ann.media.late, ann.media.malformed) == (1, 2)


@pytest.mark.parametrize("streams", [1, 8])
def test_source_queues_two_frames_of_each_stream(streams: int) -> None:
    """The session does not read. A camera process sends a cloud and the pictures of its cameras at once."""
    with zmq.Context() as context, context.socket(zmq.PULL) as session:
        session.setsockopt(zmq.RCVHWM, 1)
        session.setsockopt(zmq.RCVBUF, 1 << 16)  # bytes; else the system lets it grow to hold several frames
        session.setsockopt(zmq.LINGER, 0)
        port = session.bind_to_random_port("tcp://127.0.0.1")
        sockets = ClientSockets()
        sockets.set_target("127.0.0.1", 0, None)
        frame = bytes(4 << 20)  # more than the system buffers
        deadline = time.monotonic() + 30.0
        while not sockets.send_media(port, "0", [frame]):
            assert time.monotonic() < deadline
        taken = [sockets.send_media(port, str(i % streams), [frame]) for i in range(2 * streams + 16)]
        sockets.close()
    # On their way besides: one being written, one in the system's send buffer, one being read, one read.
    assert 2 * streams - 1 <= sum(taken) <= 2 * streams + 4
