"""TCP connections before hello: who is closed, who makes room, who is called a flood. Real TCP connections."""

from __future__ import annotations

import os
import resource
import socket
from collections.abc import Iterator

import pytest

from iris_session.front import visitors
from iris_session.front.audit import AuditTrail
from iris_session.front.connection_guard import HOG_BYTES, LOOK_NS, MAX_SHOWN, OPENED_PER_S, STRANGER_BYTES, Doors
from iris_session.front.connections import ClientTable, Connection, Peer, Route
from iris_session.front.memory import LOOK_NS as MEMORY_LOOK_NS
from iris_session.front.memory import PATIENCE_NS, MemoryWatch
from iris_session.front.traffic import Traffic
from iris_session.front.visitors import Visitor, crowd
from iris_session.link.config import SECOND, FrontLimits
from iris_session.link.sockets import close_tcp, peer_of, tcp_counts
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.entries import Audit, Entry
from iris_session.protocol.limits import Drops

LIMITS = FrontLimits(strangers=3, hello_timeout_ns=10 * SECOND)


class Hall:
    """Doors, and TCP connections through them."""

    def __init__(self) -> None:
        self.now_ns = SECOND
        self.clients, self.drops = ClientTable(), Drops()
        self.told: list[Entry] = []
        self.traffic = Traffic()
        self.doors = Doors(self.clients, self.drops, AuditTrail(self._tell), LIMITS, self.traffic)
        self.listener = socket.create_server(("127.0.0.1", 0))
        self.held: list[socket.socket] = [self.listener]

    def _tell(self, entry: Entry) -> bool:
        self.told.append(entry)
        return True

    @property
    def audits(self) -> list[Audit]:
        return [entry.message for entry in self.told if isinstance(entry.message, Audit)]

    def open(self) -> tuple[Peer, socket.socket]:
        """A new TCP connection: as the front sees it, and its other end."""
        theirs = socket.create_connection(self.listener.getsockname())
        ours, _ = self.listener.accept()
        self.held += [theirs, ours]
        self.doors.opened(ours.fileno(), self.now_ns)
        return Peer(ours.fileno(), ""), theirs

    def hello(self, peer: Peer, number: int = 1) -> Connection:
        route = Route(b"%d" % number)
        address = next(one.getpeername() for one in self.held[1:] if one.fileno() == peer.descriptor)
        connection = Connection(number, route, peer, address, f"key{number}", Hello("operator", "Ann"), 0)
        self.clients.add(connection)
        return connection

    def look(self, after_ns: int = LOOK_NS) -> None:
        self.now_ns += after_ns
        self.doors.turn(self.now_ns)


def is_closed(theirs: socket.socket) -> bool:
    theirs.settimeout(0.05)
    try:
        return theirs.recv(1) == b""
    except TimeoutError:
        return False


@pytest.fixture
def hall() -> Iterator[Hall]:
    one = Hall()
    yield one
    for held in one.held:
        held.close()


def test_who_says_no_hello_is_closed_after_ten_seconds(hall: Hall) -> None:
    (_, silent), (guest, polite), (pairing, paired) = hall.open(), hall.open(), hall.open()
    hall.hello(guest)
    hall.look(9 * SECOND)
    hall.doors.busy(pairing.descriptor, hall.now_ns)
    assert not is_closed(silent)
    hall.look(2 * SECOND)
    assert is_closed(silent)
    assert not is_closed(polite)
    assert not is_closed(paired)
    assert hall.drops.by_reason == {"no_hello": 1}
    hall.look(10 * SECOND)
    assert is_closed(paired)


def test_who_lost_its_connection_has_as_long_to_say_hello_again(hall: Hall) -> None:
    peer, theirs = hall.open()
    connection = hall.hello(peer)
    hall.look(100 * SECOND)
    hall.clients.remove(connection)
    hall.look(9 * SECOND)
    assert not is_closed(theirs)
    hall.look(2 * SECOND)
    assert is_closed(theirs)


def test_who_was_given_up_keeps_its_connection_for_an_estop_for_a_minute(hall: Hall) -> None:
    """A headset that sleeps answers keep-alives for ever: its connections must not gather."""
    peer, theirs = hall.open()
    connection = hall.hello(peer)
    hall.clients.remove(connection)
    hall.clients.give_up(connection)
    hall.look(59 * SECOND)
    assert not is_closed(theirs)
    assert hall.clients.given_up(connection.route, connection.peer) is connection
    hall.look(2 * SECOND)
    assert hall.clients.given_up(connection.route, connection.peer) is None
    hall.look(11 * SECOND)
    assert is_closed(theirs)


def test_the_oldest_silent_ones_make_room(hall: Hall) -> None:
    crowd = [hall.open() for _ in range(5)]
    hall.hello(crowd[0][0])
    hall.look()
    assert [is_closed(theirs) for _, theirs in crowd] == [False, True, False, False, False]
    assert hall.drops.by_reason == {"strangers_too_many": 1}


def test_far_too_much_is_cut_off_named_and_kept_out_for_a_while(hall: Hall) -> None:
    peer, theirs = hall.open()
    ann = hall.hello(peer)
    assert not any(hall.doors.excess(peer, ann, "sample", hall.now_ns) for _ in range(LIMITS.excess_burst))
    assert hall.doors.excess(peer, ann, "sample", hall.now_ns)
    assert is_closed(theirs)
    (flood,) = hall.audits
    assert (flood.kind, flood.name, flood.address, flood.detail) == ("flood", "Ann", "127.0.0.1", "sample")
    assert hall.doors.warnings(hall.now_ns) == ("flood from 127.0.0.1 (Ann): sample",)
    assert hall.doors.barred("key1", hall.now_ns)
    assert not hall.doors.barred("key2", hall.now_ns)
    hall.look(4 * SECOND)
    assert not hall.doors.barred("key1", hall.now_ns)
    assert hall.doors.warnings(hall.now_ns + 60 * SECOND) == ()


def test_strangers_who_come_back_at_once_are_borne_less_and_less(hall: Hall) -> None:
    borne = []
    for _ in range(3):
        peer, theirs = hall.open()
        n = 0
        while not hall.doors.excess(peer, None, "before hello", hall.now_ns):
            n += 1
        assert is_closed(theirs)
        borne.append(n)
    assert borne == [LIMITS.excess_burst // 4, LIMITS.excess_burst // 16, LIMITS.excess_burst // 16]
    hall.look(4 * SECOND)
    peer, _ = hall.open()
    assert not any(hall.doors.excess(peer, None, "before hello", hall.now_ns) for _ in range(borne[0]))


def test_what_is_not_taken_slowly_is_never_cut_off(hall: Hall) -> None:
    peer, theirs = hall.open()
    for _ in range(3 * LIMITS.excess_burst):
        hall.now_ns += SECOND // 400
        assert not hall.doors.excess(peer, None, "before hello", hall.now_ns)
    assert not is_closed(theirs)


def test_many_connections_within_a_second_are_named(hall: Hall) -> None:
    peer, _ = hall.open()
    for _ in range(OPENED_PER_S):
        hall.doors.opened(peer.descriptor, hall.now_ns)
    assert [audit.detail for audit in hall.audits] == ["connections"]
    hall.now_ns += 2 * SECOND
    hall.doors.opened(peer.descriptor, hall.now_ns)
    assert len(hall.audits) == 1


def test_what_is_remembered_of_floods_is_bounded(hall: Hall) -> None:
    for i in range(1000):
        hall.doors.flood(f"10.0.{i // 250}.{i % 250}", "sample", hall.now_ns)
    assert len(hall.doors.warnings(hall.now_ns)) == MAX_SHOWN
    hall.doors.flood("", "memory: closed Ann", hall.now_ns, warning="memory ran short: closed Ann")
    assert hall.doors.warnings(hall.now_ns)[-1] == "memory ran short: closed Ann"


def test_room_is_made_by_the_newest_strangers_when_no_client_stands_out(hall: Hall) -> None:
    crowd = [hall.open() for _ in range(4 * HOG_BYTES // STRANGER_BYTES // 3)]
    hall.hello(crowd[0][0], 1)
    hall.hello(crowd[-1][0], 2)
    newest_first = [theirs for _, theirs in crowd[-2:0:-1]]
    quarter = len(newest_first) // 4
    assert hall.doors.shed() == "connections without hello"
    assert [is_closed(theirs) for theirs in newest_first] == [True] * quarter + [False] * (len(newest_first) - quarter)
    assert not is_closed(crowd[0][1])
    assert not is_closed(crowd[-1][1])
    assert hall.drops.by_reason == {"memory": quarter}


def test_nobody_is_closed_for_memory_that_nobody_holds(hall: Hall) -> None:
    crowd = [hall.open() for _ in range(3)]
    hall.hello(crowd[0][0])
    hall.traffic.handed(crowd[0][0].descriptor, [b"x" * (HOG_BYTES // 2)])
    assert hall.doors.shed() == ""
    assert not any(is_closed(theirs) for _, theirs in crowd)
    assert hall.drops.by_reason == {"memory_elsewhere": 1}


def test_room_is_made_by_the_client_for_whom_most_waits_not_by_the_newest(hall: Hall) -> None:
    crowd = [hall.open() for _ in range(4)]
    for number in range(3):
        hall.hello(crowd[number][0], number)
    hall.traffic.handed(crowd[0][0].descriptor, [b"x" * 3 * HOG_BYTES])
    hall.traffic.handed(crowd[1][0].descriptor, [b"x" * HOG_BYTES] * 4)
    hall.doors.shed()
    assert [is_closed(theirs) for _, theirs in crowd] == [False, True, False, False]
    assert hall.doors.barred("key1", hall.clients.by_number[1].last_heard_ns)


def test_room_is_made_by_media_where_no_connection_holds_much(hall: Hall) -> None:
    crowd = [hall.open() for _ in range(2)]
    hall.hello(crowd[0][0])
    assert hall.doors.shed(lambda: "media") == "media"
    assert [is_closed(theirs) for _, theirs in crowd] == [False, False]
    assert hall.doors.shed(lambda: "") == ""
    hall.traffic.handed(crowd[0][0].descriptor, [b"x" * 2 * HOG_BYTES])
    assert hall.doors.shed(lambda: "media") == "Ann from 127.0.0.1"


def test_room_is_made_by_strangers_who_hold_more_than_any_client(hall: Hall) -> None:
    crowd = [hall.open() for _ in range(3)]
    hall.hello(crowd[0][0])
    hall.traffic.handed(crowd[0][0].descriptor, [b"x" * HOG_BYTES])
    for stranger, _ in crowd[1:]:
        hall.traffic.handed(stranger.descriptor, [b"x" * (HOG_BYTES // 2 + 1)])
    assert hall.doors.shed() == "connections without hello"
    assert not is_closed(crowd[0][1])


def test_a_close_that_fails_is_tried_again(hall: Hall, monkeypatch: pytest.MonkeyPatch) -> None:
    _, theirs = hall.open()
    with monkeypatch.context() as patch:
        patch.setattr(visitors, "close_tcp", lambda *_: False)
        hall.look(11 * SECOND)
    assert not is_closed(theirs)
    hall.look()
    assert is_closed(theirs)
    assert hall.drops.by_reason == {"close_failed": 1, "no_hello": 1}


def test_a_close_needs_no_descriptor_of_its_own(hall: Hall) -> None:
    peer, theirs = hall.open()
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
    def visitor(who: str) -> Visitor:
        one = Visitor(("", 0), 0)
        one.who = who
        return one

    door = list(enumerate(map(visitor, "baaabcab")))
    assert crowd(door, 8) == crowd(door, 100) == []
    assert crowd(door, 7) == [1]
    assert crowd(door, 3) == [1, 0, 2, 3, 4]
    assert sorted(crowd(door, 0)) == list(range(8))


class Machine:
    """Memory that is what the test says."""

    def __init__(self) -> None:
        self.held, self.free = 100, 0
        self.shed: list[int] = []
        self.told: list[tuple[str, int]] = []
        self.now_ns = 0
        self.watch = MemoryWatch(50, self._shed, self._tell, lambda: self.held + self.free, self._trim)

    def _tell(self, whom: str, now_ns: int) -> None:
        self.told.append((whom, now_ns))

    def _trim(self) -> None:
        self.free = 0

    def _shed(self) -> str:
        self.shed.append(self.now_ns)
        return "Ann"

    def look(self, after_ns: int = MEMORY_LOOK_NS) -> None:
        self.now_ns += after_ns
        self.watch.turn(self.now_ns)


def test_memory_above_the_bound_costs_somebody_their_connection() -> None:
    machine = Machine()
    machine.look()
    machine.held = 150
    machine.look()
    assert machine.shed == []
    machine.held = 151
    machine.look()
    machine.look()  # libzmq has not freed it yet
    assert len(machine.shed) == 1
    assert machine.told == [("Ann", machine.shed[0])]
    machine.look(PATIENCE_NS)
    assert len(machine.shed) == 2


def test_memory_that_is_free_but_kept_costs_nobody() -> None:
    machine = Machine()
    machine.look()
    machine.free = 1000
    machine.look()
    assert machine.shed == []
    assert machine.free == 0
