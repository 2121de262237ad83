"""Limits on TCP connections and hellos, against real TCP connections and real ZeroMQ sockets."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import pytest
import zmq

from iris_session.front.connection_guard import (
    BEFORE_HELLO,
    CONNECTIONS_PER_S,
    MAX_TOPIC_BYTES,
    MAX_WARNINGS,
    UNKNOWN_TOPIC_WEIGHT,
    StateGuard,
    max_connections_per_key,
)
from iris_session.front.connections import FrontConnection, Route
from iris_session.link.config import SECOND, FrontConfig
from iris_session.link.sockets import bound_port, open_state, watch_tcp
from iris_session.link.tcp_guard import TcpBounds
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.limits import Drops
from tests.front.control_rig import CHECK_PERIOD_NS, LIMITS, ControlSocketRig, is_closed


@pytest.fixture
def rig() -> Iterator[ControlSocketRig]:
    one = ControlSocketRig()
    yield one
    for held in one.held:
        held.close()


def test_connection_without_hello_is_closed_after_ten_seconds(rig: ControlSocketRig) -> None:
    (_, silent), (guest, polite), (pairing, paired) = rig.open(), rig.open(), rig.open()
    rig.hello(guest)
    rig.look(9 * SECOND)
    rig.guard.touch(pairing.descriptor, rig.now_ns)
    assert not is_closed(silent)
    rig.look(2 * SECOND)
    assert is_closed(silent)
    assert not is_closed(polite)
    assert not is_closed(paired)
    assert rig.drops.by_reason == {"no_hello": 1}
    rig.look(10 * SECOND)
    assert is_closed(paired)


def test_silent_client_keeps_its_connection_for_an_estop_for_a_minute(rig: ControlSocketRig) -> None:
    """A sleeping headset answers keep-alives for ever: its connections must not accumulate."""
    peer, theirs = rig.open()
    connection = rig.hello(peer)
    rig.clients.remove(connection)
    rig.clients.keep_for_estop(connection)
    rig.look(59 * SECOND)
    assert not is_closed(theirs)
    assert rig.clients.find_kept(connection.route, connection.peer) is connection
    rig.look(2 * SECOND)
    assert rig.clients.find_kept(connection.route, connection.peer) is None
    rig.look(11 * SECOND)
    assert is_closed(theirs)


def test_oldest_silent_connections_are_evicted(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(5)]
    rig.hello(crowd[0][0])
    rig.look()
    assert [is_closed(theirs) for _, theirs in crowd] == [False, True, False, False, False]
    assert rig.drops.by_reason == {"strangers_too_many": 1}


def test_flood_is_cut_off_reported_and_banned_for_a_time(rig: ControlSocketRig) -> None:
    peer, theirs = rig.open()
    ann = rig.hello(peer)
    assert not any(rig.guard.rate_limit(peer, ann, "sample", rig.now_ns) for _ in range(LIMITS.excess_burst))
    assert rig.guard.rate_limit(peer, ann, "sample", rig.now_ns)
    assert is_closed(theirs)
    (flood,) = rig.audits
    assert (flood.kind, flood.name, flood.address, flood.detail) == ("flood", "Ann", "127.0.0.1", "sample")
    assert rig.guard.list_warnings(rig.now_ns) == ("flood from 127.0.0.1 (Ann): sample",)
    assert rig.guard.is_banned("key1", rig.now_ns)
    assert not rig.guard.is_banned("key2", rig.now_ns)
    rig.look(4 * SECOND)
    assert not rig.guard.is_banned("key1", rig.now_ns)
    assert rig.guard.list_warnings(rig.now_ns + 60 * SECOND) == ()


def test_strangers_behind_a_gateway_do_not_end_those_who_have_joined(rig: ControlSocketRig) -> None:
    peer, theirs = rig.open()
    gateway = rig.hello(peer)
    ann = FrontConnection(
        2, Route(b"1", "ann"), peer, gateway.address, "key2", Hello("operator", "Ann"), gateway.number
    )
    rig.clients.add(ann)
    assert not any(
        rig.guard.rate_limit(peer, gateway, BEFORE_HELLO, rig.now_ns) for _ in range(2 * LIMITS.excess_burst)
    )
    assert not is_closed(theirs)
    assert {flood.detail for flood in rig.audits} == {BEFORE_HELLO}, "it is reported"
    rig.clients.remove(ann)
    assert rig.guard.rate_limit(peer, gateway, BEFORE_HELLO, rig.now_ns)
    assert is_closed(theirs)


def test_reconnecting_flooders_are_limited_more_each_time(rig: ControlSocketRig) -> None:
    borne = []
    for _ in range(3):
        peer, theirs = rig.open()
        n = 0
        while not rig.guard.rate_limit(peer, None, "before hello", rig.now_ns):
            n += 1
        assert is_closed(theirs)
        borne.append(n)
    assert borne == [LIMITS.excess_burst // 4, LIMITS.excess_burst // 16, LIMITS.excess_burst // 16]
    rig.look(4 * SECOND)
    peer, _ = rig.open()
    assert not any(rig.guard.rate_limit(peer, None, "before hello", rig.now_ns) for _ in range(borne[0]))


def test_many_connections_within_a_second_are_reported(rig: ControlSocketRig) -> None:
    peer, _ = rig.open()
    for _ in range(CONNECTIONS_PER_S):
        rig.guard.add(peer.descriptor, rig.now_ns)
    assert [audit.detail for audit in rig.audits] == ["connections"]
    rig.now_ns += 2 * SECOND
    rig.guard.add(peer.descriptor, rig.now_ns)
    assert len(rig.audits) == 1


def test_memory_of_floods_is_bounded(rig: ControlSocketRig) -> None:
    for i in range(1000):
        rig.guard.report_flood(f"10.0.{i // 250}.{i % 250}", "x" * 600, rig.now_ns)
    assert {len(text) for text in rig.guard.list_warnings(rig.now_ns)} == {MAX_TEXT}
    assert len(rig.guard.list_warnings(rig.now_ns)) == MAX_WARNINGS


# --- subscribers of the state socket --------------------------------------------------------------------------------

#: Topics that do not exist and may be subscribed to.
MAX_UNKNOWN = TcpBounds().counted_messages // UNKNOWN_TOPIC_WEIGHT


class StateSocketRig:
    """A state socket and its TCP connections."""

    def __init__(self) -> None:
        self.now_ns = SECOND
        self.drops = Drops()
        self.floods: list[str] = []
        self.subs: list[zmq.Socket[bytes]] = []
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.state = open_state(self.context, FrontConfig(state_port=0), None)
        self.port = bound_port(self.state)
        self.subscribers = StateGuard(
            self.state,
            watch_tcp(self.state, "state"),
            TcpBounds(silence_ns=1000 * SECOND, bytes_period_ns=0),
            self.drops,
            lambda address, key, now_ns: self.floods.append(address),
            lambda address, now_ns: None,
        )

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
            self.now_ns += CHECK_PERIOD_NS // 10
            self.subscribers.tick(self.now_ns)
            time.sleep(0.001)

    def gets_state(self, one: zmq.Socket[bytes]) -> bool:
        self.state.send_multipart((b"rigid", b""))
        return bool(one.poll(0))

    def close(self) -> None:
        self.subscribers.close()
        self.context.destroy(linger=0)


@pytest.fixture
def state_rig() -> Iterator[StateSocketRig]:
    one = StateSocketRig()
    yield one
    one.close()


def test_one_key_leaves_connections_to_others() -> None:
    assert [max_connections_per_key(n) for n in (1, 2, 4, 64)] == [1, 2, 3, 48]


def count_topic(state_rig: StateSocketRig, topics: list[bytes]) -> None:
    """Subscribe to topics that do not exist by one connection, until it is closed or all were read."""
    talker = state_rig.subscriber()
    state_rig.turns(lambda: state_rig.gets_state(talker), "state")
    counts = state_rig.drops.by_reason
    for i, topic in enumerate(topics):
        talker.subscribe(topic)
        state_rig.turns(lambda i=i: counts.get("state_topic_unknown", 0) > i or "flood_cut" in counts, "a topic")  # type: ignore[misc]


def test_topics_that_do_not_exist_are_counted_and_sixteen_are_enough(state_rig: StateSocketRig) -> None:
    quiet = state_rig.subscriber()
    count_topic(state_rig, [b"x%d" % i for i in range(MAX_UNKNOWN)])
    assert state_rig.drops.by_reason == {"state_topic_unknown": MAX_UNKNOWN}
    count_topic(state_rig, [b"y%d" % i for i in range(MAX_UNKNOWN + 1)])
    state_rig.turns(lambda: "flood_cut" in state_rig.drops.by_reason, "its end")
    assert state_rig.floods == ["127.0.0.1"]
    state_rig.turns(lambda: state_rig.gets_state(quiet), "state of another")


def test_a_long_topic_ends_its_connection_at_once(state_rig: StateSocketRig) -> None:
    count_topic(state_rig, [b"x" * (MAX_TOPIC_BYTES + 1)])
    state_rig.turns(lambda: "flood_cut" in state_rig.drops.by_reason, "its end")


def test_every_beginning_of_a_topic_may_be_subscribed_to(state_rig: StateSocketRig) -> None:
    ann = state_rig.subscriber()
    for topic in (b"", b"r", b"rigid", b"pres", b"presence"):
        ann.subscribe(topic)
    state_rig.turns(lambda: state_rig.gets_state(ann), "state")
    for _ in range(50):
        state_rig.subscribers.tick(state_rig.now_ns)
    assert state_rig.drops.by_reason == {}
