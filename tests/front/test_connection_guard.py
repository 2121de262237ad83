"""Limits on TCP connections, hellos and memory, against real TCP connections and real ZeroMQ sockets."""

from __future__ import annotations

import os
import resource
import socket
import time
from collections.abc import Callable, Iterator

import pytest
import zmq

from iris_session.front import connection_guard
from iris_session.front.audit import AuditTrail
from iris_session.front.connection_guard import (
    CHECK_PERIOD_NS,
    EVICTION_PAUSE_NS,
    FLOOD_CONNECTIONS_PER_S,
    MAX_SOURCES,
    MAX_WARNINGS,
    MEMORY_PERIOD_NS,
    MIN_EVICT_BYTES,
    SILENT_CONNECTION_BYTES,
    ConnectionGuard,
    HelloRateLimiter,
    MemoryGuard,
    SubscriberGuard,
    TcpConnection,
    max_connections_per_key,
    select_evictions,
)
from iris_session.front.connections import ConnectionTable, FrontConnection, Peer, Route, TrafficCounter
from iris_session.link.config import SECOND, FrontConfig, FrontLimits
from iris_session.link.sockets import bound_port, close_tcp, open_state, peer_of, tcp_counts, watch_tcp
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.entries import Audit, Entry
from iris_session.protocol.limits import Drops

LIMITS = FrontLimits(strangers=3, hello_timeout_ns=10 * SECOND)


class ControlSocketRig:
    """A connection guard, and TCP connections that it guards."""

    def __init__(self) -> None:
        self.now_ns = SECOND
        self.clients, self.drops = ConnectionTable(), Drops()
        self.reported: list[Entry] = []
        self.traffic = TrafficCounter()
        self.guard = ConnectionGuard(self.clients, self.drops, AuditTrail(self._record), LIMITS, self.traffic)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.held: list[socket.socket] = [self.listener]

    def _record(self, entry: Entry) -> bool:
        self.reported.append(entry)
        return True

    @property
    def audits(self) -> list[Audit]:
        return [entry.message for entry in self.reported if isinstance(entry.message, Audit)]

    def open(self) -> tuple[Peer, socket.socket]:
        """A new TCP connection: as the front sees it, and its other end."""
        theirs = socket.create_connection(self.listener.getsockname())
        ours, _ = self.listener.accept()
        self.held += [theirs, ours]
        self.guard.add(ours.fileno(), self.now_ns)
        return Peer(ours.fileno(), ""), theirs

    def hello(self, peer: Peer, number: int = 1) -> FrontConnection:
        route = Route(b"%d" % number)
        address = next(one.getpeername() for one in self.held[1:] if one.fileno() == peer.descriptor)
        connection = FrontConnection(number, route, peer, address, f"key{number}", Hello("operator", "Ann"), 0)
        self.clients.add(connection)
        return connection

    def look(self, after_ns: int = CHECK_PERIOD_NS) -> None:
        self.now_ns += after_ns
        self.guard.tick(self.now_ns)


def is_closed(theirs: socket.socket) -> bool:
    theirs.settimeout(0.05)
    try:
        return theirs.recv(1) == b""
    except TimeoutError:
        return False


@pytest.fixture
def rig() -> Iterator[ControlSocketRig]:
    one = ControlSocketRig()
    yield one
    for held in one.held:
        held.close()


def test_who_says_no_hello_is_closed_after_ten_seconds(rig: ControlSocketRig) -> None:
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


def test_who_lost_its_connection_has_as_long_to_say_hello_again(rig: ControlSocketRig) -> None:
    peer, theirs = rig.open()
    connection = rig.hello(peer)
    rig.look(100 * SECOND)
    rig.clients.remove(connection)
    rig.look(9 * SECOND)
    assert not is_closed(theirs)
    rig.look(2 * SECOND)
    assert is_closed(theirs)


def test_who_was_given_up_keeps_its_connection_for_an_estop_for_a_minute(rig: ControlSocketRig) -> None:
    """A headset that sleeps answers keep-alives for ever: its connections must not gather."""
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


def test_the_oldest_silent_ones_make_room(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(5)]
    rig.hello(crowd[0][0])
    rig.look()
    assert [is_closed(theirs) for _, theirs in crowd] == [False, True, False, False, False]
    assert rig.drops.by_reason == {"strangers_too_many": 1}


def test_far_too_much_is_cut_off_named_and_kept_out_for_a_while(rig: ControlSocketRig) -> None:
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


def test_strangers_who_come_back_at_once_are_borne_less_and_less(rig: ControlSocketRig) -> None:
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


def test_what_is_not_taken_slowly_is_never_cut_off(rig: ControlSocketRig) -> None:
    peer, theirs = rig.open()
    for _ in range(3 * LIMITS.excess_burst):
        rig.now_ns += SECOND // 400
        assert not rig.guard.rate_limit(peer, None, "before hello", rig.now_ns)
    assert not is_closed(theirs)


def test_many_connections_within_a_second_are_named(rig: ControlSocketRig) -> None:
    peer, _ = rig.open()
    for _ in range(FLOOD_CONNECTIONS_PER_S):
        rig.guard.add(peer.descriptor, rig.now_ns)
    assert [audit.detail for audit in rig.audits] == ["connections"]
    rig.now_ns += 2 * SECOND
    rig.guard.add(peer.descriptor, rig.now_ns)
    assert len(rig.audits) == 1


def test_what_is_remembered_of_floods_is_bounded(rig: ControlSocketRig) -> None:
    for i in range(1000):
        rig.guard.report_flood(f"10.0.{i // 250}.{i % 250}", "sample", rig.now_ns)
    assert len(rig.guard.list_warnings(rig.now_ns)) == MAX_WARNINGS
    rig.guard.report_flood("", "memory: closed Ann", rig.now_ns, warning="memory ran short: closed Ann")
    assert rig.guard.list_warnings(rig.now_ns)[-1] == "memory ran short: closed Ann"


def test_room_is_made_by_the_newest_strangers_when_no_client_stands_out(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(4 * MIN_EVICT_BYTES // SILENT_CONNECTION_BYTES // 3)]
    rig.hello(crowd[0][0], 1)
    rig.hello(crowd[-1][0], 2)
    newest_first = [theirs for _, theirs in crowd[-2:0:-1]]
    quarter = len(newest_first) // 4
    assert rig.guard.evict_for_memory() == "connections without hello"
    assert [is_closed(theirs) for theirs in newest_first] == [True] * quarter + [False] * (len(newest_first) - quarter)
    assert not is_closed(crowd[0][1])
    assert not is_closed(crowd[-1][1])
    assert rig.drops.by_reason == {"memory": quarter}


def test_nobody_is_closed_for_memory_that_nobody_holds(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(3)]
    rig.hello(crowd[0][0])
    rig.traffic.count_sent(crowd[0][0].descriptor, [b"x" * (MIN_EVICT_BYTES // 2)])
    assert rig.guard.evict_for_memory() == ""
    assert not any(is_closed(theirs) for _, theirs in crowd)
    assert rig.drops.by_reason == {"memory_elsewhere": 1}


def test_room_is_made_by_the_client_for_whom_most_waits_not_by_the_newest(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(4)]
    for number in range(3):
        rig.hello(crowd[number][0], number)
    rig.traffic.count_sent(crowd[0][0].descriptor, [b"x" * 3 * MIN_EVICT_BYTES])
    rig.traffic.count_sent(crowd[1][0].descriptor, [b"x" * MIN_EVICT_BYTES] * 4)
    rig.guard.evict_for_memory()
    assert [is_closed(theirs) for _, theirs in crowd] == [False, True, False, False]
    assert rig.guard.is_banned("key1", rig.clients.by_number[1].last_heard_ns)


def test_room_is_made_by_media_where_no_connection_holds_much(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(2)]
    rig.hello(crowd[0][0])
    assert rig.guard.evict_for_memory(lambda: "media") == "media"
    assert [is_closed(theirs) for _, theirs in crowd] == [False, False]
    assert rig.guard.evict_for_memory(lambda: "") == ""
    rig.traffic.count_sent(crowd[0][0].descriptor, [b"x" * 2 * MIN_EVICT_BYTES])
    assert rig.guard.evict_for_memory(lambda: "media") == "Ann from 127.0.0.1"


def test_room_is_made_by_strangers_who_hold_more_than_any_client(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(3)]
    rig.hello(crowd[0][0])
    rig.traffic.count_sent(crowd[0][0].descriptor, [b"x" * MIN_EVICT_BYTES])
    for stranger, _ in crowd[1:]:
        rig.traffic.count_sent(stranger.descriptor, [b"x" * (MIN_EVICT_BYTES // 2 + 1)])
    assert rig.guard.evict_for_memory() == "connections without hello"
    assert not is_closed(crowd[0][1])


def test_a_close_that_fails_is_tried_again(rig: ControlSocketRig, monkeypatch: pytest.MonkeyPatch) -> None:
    _, theirs = rig.open()
    with monkeypatch.context() as patch:
        patch.setattr(connection_guard, "close_tcp", lambda *_: False)
        rig.look(11 * SECOND)
    assert not is_closed(theirs)
    rig.look()
    assert is_closed(theirs)
    assert rig.drops.by_reason == {"close_failed": 1, "no_hello": 1}


def test_a_close_needs_no_descriptor_of_its_own(rig: ControlSocketRig) -> None:
    peer, theirs = rig.open()
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
    try:
        with pytest.raises(OSError, match="Too many open files"):
            os.dup(0)
        assert peer_of(peer.descriptor) == theirs.getsockname()
        assert tcp_counts(peer.descriptor) is not None
        assert close_tcp(peer.descriptor, theirs.getsockname())
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    assert is_closed(theirs)


def test_what_is_no_tcp_connection_is_left_alone() -> None:
    read, write = os.pipe()
    for descriptor in (read, 10_000):
        assert peer_of(descriptor) == ("", 0)
        assert tcp_counts(descriptor) is None
        assert not close_tcp(descriptor, ("", 0))
    os.write(write, b"x")
    assert os.read(read, 1) == b"x"
    os.close(read)
    os.close(write)


def test_who_has_most_makes_room_in_the_given_order() -> None:
    def visitor(who: str) -> TcpConnection:
        one = TcpConnection(("", 0), 0)
        one.owner = who
        return one

    door = list(enumerate(map(visitor, "baaabcab")))
    assert select_evictions(door, 8) == select_evictions(door, 100) == []
    assert select_evictions(door, 7) == [1]
    assert select_evictions(door, 3) == [1, 0, 2, 3, 4]
    assert sorted(select_evictions(door, 0)) == list(range(8))


class FakeMemory:
    """A memory guard with memory that the test sets."""

    def __init__(self) -> None:
        self.held, self.free = 100, 0
        self.shed: list[int] = []
        self.reported: list[tuple[str, int]] = []
        self.now_ns = 0
        self.watch = MemoryGuard(50, self._shed, self._record, lambda: self.held + self.free, self._trim)

    def _record(self, whom: str, now_ns: int) -> None:
        self.reported.append((whom, now_ns))

    def _trim(self) -> None:
        self.free = 0

    def _shed(self) -> str:
        self.shed.append(self.now_ns)
        return "Ann"

    def look(self, after_ns: int = MEMORY_PERIOD_NS) -> None:
        self.now_ns += after_ns
        self.watch.tick(self.now_ns)


def test_memory_above_the_bound_costs_somebody_their_connection() -> None:
    memory = FakeMemory()
    memory.look()
    memory.held = 150
    memory.look()
    assert memory.shed == []
    memory.held = 151
    memory.look()
    memory.look()  # libzmq has not freed it yet
    assert len(memory.shed) == 1
    assert memory.reported == [("Ann", memory.shed[0])]
    memory.look(EVICTION_PAUSE_NS)
    assert len(memory.shed) == 2


def test_memory_that_is_free_but_kept_costs_nobody() -> None:
    memory = FakeMemory()
    memory.look()
    memory.free = 1000
    memory.look()
    assert memory.shed == []
    assert memory.free == 0


# --- subscribers of the state socket --------------------------------------------------------------------------------

STATE_LIMITS = FrontLimits(strangers=4, subscribers=3, hello_timeout_ns=1000 * SECOND)


class StateSocketRig:
    """A state socket and its TCP connections."""

    def __init__(self) -> None:
        self.now_ns = SECOND
        self.drops = Drops()
        self.floods: list[str] = []
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.subscribers = SubscriberGuard(
            self.drops,
            STATE_LIMITS,
            lambda address, what, now_ns: self.floods.append(what),
            lambda address, now_ns: None,
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
        """A TCP connection that says nothing, from an address of this memory."""
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
            self.now_ns += CHECK_PERIOD_NS // 10
            self.subscribers.tick(self.now_ns)
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
def state_rig() -> Iterator[StateSocketRig]:
    one = StateSocketRig()
    yield one
    one.close()


def test_bare_connections_keep_no_subscriber_out(state_rig: StateSocketRig) -> None:
    for _ in range(STATE_LIMITS.subscribers + 1):
        state_rig.bare()
    state_rig.turns(lambda: len(state_rig.subscribers) == STATE_LIMITS.subscribers + 1, "bare connections")
    ann = state_rig.subscriber()
    state_rig.turns(lambda: state_rig.gets_state(ann), "state")
    assert state_rig.drops.by_reason == {}


def test_of_bare_connections_those_of_whoever_has_most_make_room(state_rig: StateSocketRig) -> None:
    newcomer = state_rig.bare("127.0.0.2")
    hog = [state_rig.bare() for _ in range(STATE_LIMITS.strangers + 1)]
    state_rig.turns(lambda: state_rig.drops.by_reason.get("strangers_too_many") == 2, "room")
    state_rig.turns(lambda: ended(hog[0]) and ended(hog[1]), "an end of the oldest of them")
    assert not any(map(ended, (newcomer, *hog[2:])))


def test_who_does_not_subscribe_is_closed_after_a_while(state_rig: StateSocketRig) -> None:
    ann = state_rig.subscriber()
    state_rig.turns(lambda: state_rig.gets_state(ann), "state")
    state_rig.bare()
    state_rig.turns(lambda: len(state_rig.subscribers) == 2, "both")
    state_rig.now_ns += 1001 * SECOND
    state_rig.turns(lambda: len(state_rig.subscribers) == 1, "the end of the silent one")
    assert state_rig.drops.by_reason == {"no_subscription": 1}
    ann.recv_multipart()
    state_rig.turns(lambda: state_rig.gets_state(ann), "state")


def test_subscribers_are_bounded_and_those_of_before_stay(state_rig: StateSocketRig) -> None:
    first = [state_rig.subscriber() for _ in range(STATE_LIMITS.subscribers)]
    state_rig.turns(lambda: all(state_rig.gets_state(one) for one in first), "state for all")
    state_rig.subscriber()
    state_rig.turns(lambda: state_rig.drops.by_reason.get("subscribers_too_many", 0) > 0, "room")
    for one in first:
        while one.poll(0):
            one.recv_multipart()
    state_rig.turns(lambda: all(state_rig.gets_state(one) for one in first), "state for those of before")


def test_a_subscriber_that_talks_is_cut_off(state_rig: StateSocketRig) -> None:
    quiet, talker = state_rig.subscriber(), state_rig.subscriber()
    state_rig.turns(lambda: state_rig.gets_state(quiet), "state")
    number = 0

    def cut() -> bool:
        nonlocal number
        for _ in range(8):
            number += 1
            talker.subscribe(b"%900d" % number)
        return "flood_cut" in state_rig.drops.by_reason

    state_rig.turns(cut, "end of the flood")
    assert state_rig.floods == ["subscriptions"]
    assert state_rig.drops.by_reason["flood_cut"] == 1
    quiet.recv_multipart()
    state_rig.turns(lambda: state_rig.gets_state(quiet), "state")


def test_nobody_of_a_closed_state_socket_is_counted_any_more(state_rig: StateSocketRig) -> None:
    for opened in range(3):
        ann = state_rig.subscriber()
        state_rig.bare()
        state_rig.turns(lambda ann=ann: state_rig.gets_state(ann) and len(state_rig.subscribers) == 2, "both")  # type: ignore[misc]
        before = state_rig.subscribers._monitor
        assert before is not None
        state_rig.state.close(linger=0)
        state_rig.turns(lambda: len(state_rig.subscribers) == 0, "nobody")
        ann.close()
        state_rig.open()
        assert before.closed
        assert state_rig.opened == opened + 2


# --- hellos ---------------------------------------------------------------------------------------------------------

HELLO_LIMITS = FrontLimits(hellos_per_second=10.0, hello_burst=20, hellos_per_source=1.0, hello_source_burst=4)


def taken(shares: HelloRateLimiter, source: str, now_ns: int, n: int = 1000) -> int:
    return sum(shares.allow(source, now_ns) for _ in range(n))


def test_a_newcomer_gets_in_whatever_another_does() -> None:
    shares = HelloRateLimiter(HELLO_LIMITS)
    assert taken(shares, "flood", SECOND) == 24
    assert taken(shares, "ann", SECOND) == 4
    assert taken(shares, "bob", SECOND, 2) == 2
    assert taken(shares, "flood", 2 * SECOND) == 11
    assert taken(shares, "ann", 2 * SECOND) == 1


def test_one_key_of_many_clients_has_what_nobody_else_uses() -> None:
    assert taken(HelloRateLimiter(FrontLimits()), "lab", SECOND, 64) == 64


def test_sources_are_bounded_and_the_newest_kept() -> None:
    shares = HelloRateLimiter(HELLO_LIMITS)
    taken(shares, "first", SECOND)
    for number in range(MAX_SOURCES):
        shares.allow(f"key{number}", SECOND)
    assert len(shares._own) == MAX_SOURCES
    assert taken(shares, f"key{MAX_SOURCES - 1}", SECOND) == 3


def test_one_key_leaves_connections_to_others() -> None:
    assert [max_connections_per_key(n) for n in (1, 2, 4, 64)] == [1, 2, 3, 48]
