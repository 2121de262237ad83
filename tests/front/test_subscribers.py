"""Who stands before the state socket, and who is in. Real ZeroMQ sockets."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Iterator

import pytest
import zmq

from iris_session.front.subscribers import LOOK_NS, Subscribers
from iris_session.link.config import SECOND, FrontConfig, FrontLimits
from iris_session.link.sockets import bound_port, open_state, watch_tcp
from iris_session.protocol.limits import Drops

LIMITS = FrontLimits(strangers=4, subscribers=3, hello_timeout_ns=1000 * SECOND)


class Hall:
    """A state socket, and whoever comes to it."""

    def __init__(self) -> None:
        self.now_ns = SECOND
        self.drops = Drops()
        self.floods: list[str] = []
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.subscribers = Subscribers(
            self.drops, LIMITS, lambda address, what, now_ns: self.floods.append(what), lambda address, now_ns: None
        )
        self.tcp: list[socket.socket] = []
        self.subs: list[zmq.Socket[bytes]] = []
        self.opened = 0
        self.open()

    def open(self, port: int = 0) -> None:
        self.state = open_state(self.context, FrontConfig(state_port=port), None)
        self.opened += 1
        self.port = bound_port(self.state)
        self.subscribers.watch(self.state, watch_tcp(self.state, f"state-{self.opened}"))

    def bare(self, host: str = "127.0.0.1") -> socket.socket:
        """A TCP connection that says nothing, from an address of this machine."""
        self.tcp.append(socket.create_connection(("127.0.0.1", self.port), source_address=(host, 0)))
        return self.tcp[-1]

    def subscriber(self) -> zmq.Socket[bytes]:
        one: zmq.Socket[bytes] = self.context.socket(zmq.SUB)
        one.linger = 0
        one.connect(f"tcp://127.0.0.1:{self.port}")
        one.subscribe(b"rigid")
        self.subs.append(one)
        return one

    def turns(self, until: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + 30.0
        while not until():
            assert time.monotonic() < deadline, f"no {what}"
            self.now_ns += LOOK_NS // 10
            self.subscribers.turn(self.now_ns)
            time.sleep(0.001)

    def gets_state(self, one: zmq.Socket[bytes]) -> bool:
        self.state.send_multipart((b"rigid", b""))
        return bool(one.poll(0))

    def close(self) -> None:
        self.subscribers.close()
        for one in self.tcp:
            one.close()
        self.context.destroy(linger=0)


def ended(tcp: socket.socket) -> bool:
    """Whether the other end has closed it, after its greeting."""
    tcp.setblocking(False)
    try:
        while tcp.recv(1024):
            pass
    except BlockingIOError:
        return False
    return True


@pytest.fixture
def hall() -> Iterator[Hall]:
    one = Hall()
    yield one
    one.close()


def test_bare_connections_keep_no_subscriber_out(hall: Hall) -> None:
    for _ in range(LIMITS.subscribers + 1):
        hall.bare()
    hall.turns(lambda: len(hall.subscribers) == LIMITS.subscribers + 1, "bare connections")
    ann = hall.subscriber()
    hall.turns(lambda: hall.gets_state(ann), "state")
    assert hall.drops.by_reason == {}


def test_of_bare_connections_those_of_whoever_has_most_make_room(hall: Hall) -> None:
    newcomer = hall.bare("127.0.0.2")
    hog = [hall.bare() for _ in range(LIMITS.strangers + 1)]
    hall.turns(lambda: hall.drops.by_reason.get("strangers_too_many") == 2, "room")
    hall.turns(lambda: ended(hog[0]) and ended(hog[1]), "an end of the oldest of them")
    assert not any(map(ended, (newcomer, *hog[2:])))


def test_who_does_not_subscribe_is_closed_after_a_while(hall: Hall) -> None:
    ann = hall.subscriber()
    hall.turns(lambda: hall.gets_state(ann), "state")
    hall.bare()
    hall.turns(lambda: len(hall.subscribers) == 2, "both")
    hall.now_ns += 1001 * SECOND
    hall.turns(lambda: len(hall.subscribers) == 1, "the end of the silent one")
    assert hall.drops.by_reason == {"no_subscription": 1}
    ann.recv_multipart()
    hall.turns(lambda: hall.gets_state(ann), "state")


def test_subscribers_are_bounded_and_those_of_before_stay(hall: Hall) -> None:
    first = [hall.subscriber() for _ in range(LIMITS.subscribers)]
    hall.turns(lambda: all(hall.gets_state(one) for one in first), "state for all")
    hall.subscriber()
    hall.turns(lambda: hall.drops.by_reason.get("subscribers_too_many", 0) > 0, "room")
    for one in first:
        while one.poll(0):
            one.recv_multipart()
    hall.turns(lambda: all(hall.gets_state(one) for one in first), "state for those of before")


def test_a_subscriber_that_talks_is_cut_off(hall: Hall) -> None:
    quiet, talker = hall.subscriber(), hall.subscriber()
    hall.turns(lambda: hall.gets_state(quiet), "state")
    number = 0

    def cut() -> bool:
        nonlocal number
        for _ in range(8):
            number += 1
            talker.subscribe(b"%900d" % number)
        return "flood_cut" in hall.drops.by_reason

    hall.turns(cut, "end of the flood")
    assert hall.floods == ["subscriptions"]
    assert hall.drops.by_reason["flood_cut"] == 1
    quiet.recv_multipart()
    hall.turns(lambda: hall.gets_state(quiet), "state")


def test_nobody_of_a_closed_state_socket_is_counted_any_more(hall: Hall) -> None:
    for opened in range(3):
        ann = hall.subscriber()
        hall.bare()
        hall.turns(lambda ann=ann: hall.gets_state(ann) and len(hall.subscribers) == 2, "both")  # type: ignore[misc]
        before = hall.subscribers._monitor
        assert before is not None
        hall.state.close(linger=0)
        hall.turns(lambda: len(hall.subscribers) == 0, "nobody")
        ann.close()
        hall.open()
        assert before.closed
        assert hall.opened == opened + 2
