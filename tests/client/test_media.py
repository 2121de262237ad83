"""Media of a client: subscriptions, drops, sources, and misuse."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator

import pytest
import zmq

from iris_session.client import Client, InvalidMessageError, NotConnectedError
from iris_session.client.sockets import ClientSockets
from tests.client.harness import LiveSession

DEADLINE_S = 30.0


@pytest.fixture
def cloud(session: LiveSession) -> Iterator[threading.Event]:
    """The session publishes `cloud` until this is set."""
    stop = threading.Event()

    def publish() -> None:
        while not stop.wait(0.01):
            session.front.publish_media("cloud", b"points", session.now_ns, 1, "bytes")

    thread = threading.Thread(target=publish)
    thread.start()
    yield stop
    stop.set()
    thread.join()


@pytest.mark.usefixtures("cloud")
def test_newest_frame_is_delivered_once(join: Callable[..., Client]) -> None:
    ann = join()
    assert ann.wait_for(lambda one: one.clock_error_ns() < 20_000_000, DEADLINE_S)
    feed = ann.media.subscribe("cloud")
    assert ann.media.subscribe("cloud") is feed
    assert ann.wait_for(lambda _: feed.received >= 3, DEADLINE_S)
    frame = feed.pop_newest()
    assert frame is not None
    assert (frame.data, frame.header.stream, feed.budget_class) == (b"points", "cloud", "full")
    assert frame is feed.newest
    assert -20_000_000 < frame.age_ns < DEADLINE_S * 1e9  # negative only by the error of the clock
    assert feed.pop_newest() is None
    assert ann.wait_for(lambda _: feed.pop_newest() is not None, DEADLINE_S)
    assert ann.wait_for(lambda one: bool(one.media.delivery and one.media.delivery.streams), DEADLINE_S)
    ann.media.unsubscribe("cloud")
    assert ann.media.subscribe("cloud") is not feed


@pytest.mark.usefixtures("cloud")
def test_only_the_polling_thread_uses_the_socket(join: Callable[..., Client], monkeypatch: pytest.MonkeyPatch) -> None:
    ann = join()
    touched: list[tuple[str, threading.Thread]] = []
    sockets = ann._sockets
    real = {name: getattr(sockets, name) for name in ("subscribe_media", "unsubscribe_media")}

    def watched(name: str) -> Callable[..., None]:
        def call(*arguments: object) -> None:
            touched.append((name, threading.current_thread()))
            real[name](*arguments)

        return call

    for name in real:
        monkeypatch.setattr(sockets, name, watched(name))
    ann.start()
    cloud, depth = ann.media.subscribe("cloud"), ann.media.subscribe("depth")
    assert ann.wait_for(lambda _: cloud.received >= 1, DEADLINE_S)
    assert ann.wait_for(lambda one: "depth" in one.media._subscribed, DEADLINE_S)  # else there is nothing to end
    ann.media.unsubscribe("depth")
    assert ann.wait_for(lambda _: "unsubscribe_media" in dict(touched), DEADLINE_S)
    assert {thread for _, thread in touched} == {ann._loop._thread}
    assert depth.newest is None


@pytest.mark.usefixtures("cloud")
def test_subscriptions_survive_a_restart_of_the_front(session: LiveSession, join: Callable[..., Client]) -> None:
    ann = join()
    feed = ann.media.subscribe("cloud")
    assert ann.wait_for(lambda _: feed.received >= 1, DEADLINE_S)
    generation, newest = ann.connection.generation, feed.newest
    assert newest is not None
    session.front._process.kill()  # type: ignore[union-attr]
    assert ann.wait_for(lambda one: one.connection.generation > generation and one.ready, DEADLINE_S)
    received = feed.received
    assert ann.wait_for(lambda _: feed.received > received, DEADLINE_S)
    assert feed.newest is not None
    assert feed.newest.header.seq > newest.header.seq


@pytest.mark.usefixtures("cloud")
def test_level_limit_of_the_client_applies(join: Callable[..., Client]) -> None:
    ann = join()
    feed = ann.media.subscribe("cloud")
    assert ann.wait_for(lambda _: feed.received >= 1, DEADLINE_S)
    ann.media.limit_mbit_per_s = 0.0001
    assert ann.wait_for(lambda _: feed.budget_class == "none", DEADLINE_S)
    assert ann.media.delivery is not None
    assert "client" in ann.media.delivery.reason


def test_invalid_stream_names_are_rejected(join: Callable[..., Client]) -> None:
    ann = join(connect=False)
    for name in ("", "a/b", "-a", "x" * 49, "ä"):
        with pytest.raises(InvalidMessageError, match="media stream"):
            ann.media.subscribe(name)
    with pytest.raises(NotConnectedError):
        ann.media.publish("cloud", b"")
    ann.connect()
    with pytest.raises(InvalidMessageError, match="has class 'full'"):
        ann.media.publish("cloud", {"half": b""})


def test_source_publishes_frames(join: Callable[..., Client]) -> None:
    camera, ann = join("cam", role="camera"), join("ann")
    feed = ann.media.subscribe("depth")

    def comes(_: Client) -> bool:
        camera.media.publish("depth", {"full": b"all", "half": b"less"}, capture_ns=5)
        camera.poll()
        return feed.received > 0

    assert ann.wait_for(comes, DEADLINE_S)
    assert feed.newest is not None
    assert (feed.newest.data, feed.newest.header.capture_ns) == (b"all", 5)


@pytest.mark.usefixtures("cloud")
def test_frames_of_an_unsubscribed_stream_are_late_and_not_malformed(join: Callable[..., Client]) -> None:
    ann = join()
    feed = ann.media.subscribe("cloud")
    assert ann.wait_for(lambda _: feed.received >= 3, DEADLINE_S)
    assert ann._sockets._media is not None
    assert ann._sockets._media.poll(30_000)  # one has arrived already
    ann.media.unsubscribe("cloud")
    assert ann.wait_for(lambda one: one.media.late > 0, DEADLINE_S)
    assert ann.media.malformed == 0


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
        deadline = time.monotonic() + DEADLINE_S
        while not sockets.send_media(port, "0", [frame]):
            assert time.monotonic() < deadline
        taken = [sockets.send_media(port, str(i % streams), [frame]) for i in range(2 * streams + 16)]
        sockets.close()
    # On their way besides: one being written, one in the system's send buffer, one being read, one read.
    assert 2 * streams - 1 <= sum(taken) <= 2 * streams + 4
