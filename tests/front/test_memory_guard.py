"""Limit on the memory of the front: whose connection is closed."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import pytest

from iris_session.front.connection_guard import SILENT_BYTES
from iris_session.front.memory_guard import EVICTION_PAUSE_NS, MEMORY_PERIOD_NS, MIN_EVICT_BYTES, MemoryGuard
from iris_session.link.tcp_guard import PendingConnection
from iris_session.protocol.limits import Drops
from tests.front.control_rig import ControlSocketRig, is_closed

MIB = 1 << 20


@pytest.fixture
def rig() -> Iterator[ControlSocketRig]:
    one = ControlSocketRig()
    yield one
    for held in one.held:
        held.close()


def evict(rig: ControlSocketRig, release_media: Callable[[], str] = lambda: "", max_bytes: int = 1) -> str:
    """Let a memory guard look at the rig while too much memory is held. Return what was closed."""
    evicted: list[str] = []
    resident = [0, max_bytes + 4 * MIB]
    guard = MemoryGuard(
        max_bytes,
        (rig.guard.list_pending,),
        release_media,
        lambda label, now_ns: evicted.append(label),
        rig.drops,
        lambda: resident.pop(0) if len(resident) > 1 else resident[0],
        lambda: None,
    )
    guard.tick(MEMORY_PERIOD_NS)
    return evicted[0] if evicted else ""


def test_room_is_made_by_the_newest_strangers_when_no_client_stands_out(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(4 * MIN_EVICT_BYTES // SILENT_BYTES // 3)]
    rig.hello(crowd[0][0], 1)
    rig.hello(crowd[-1][0], 2)
    newest_first = [theirs for _, theirs in crowd[-2:0:-1]]
    quarter = len(newest_first) // 4
    assert evict(rig) == "connections without hello"
    assert [is_closed(theirs) for theirs in newest_first] == [True] * quarter + [False] * (len(newest_first) - quarter)
    assert not is_closed(crowd[0][1])
    assert not is_closed(crowd[-1][1])
    assert rig.drops.by_reason == {"memory": quarter}


def test_nobody_is_closed_for_memory_that_nobody_holds(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(3)]
    rig.hello(crowd[0][0])
    rig.traffic.count_sent(crowd[0][0].descriptor, [b"x" * (MIN_EVICT_BYTES // 2)])
    assert evict(rig) == ""
    assert not any(is_closed(theirs) for _, theirs in crowd)
    assert rig.drops.by_reason == {"memory_elsewhere": 1}


def test_room_is_made_by_the_client_for_whom_most_waits_not_by_the_newest(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(4)]
    for number in range(3):
        rig.hello(crowd[number][0], number)
    rig.traffic.count_sent(crowd[0][0].descriptor, [b"x" * 3 * MIN_EVICT_BYTES])
    rig.traffic.count_sent(crowd[1][0].descriptor, [b"x" * MIN_EVICT_BYTES] * 4)
    evict(rig)
    assert [is_closed(theirs) for _, theirs in crowd] == [False, True, False, False]
    assert rig.guard.is_banned("key1", rig.clients.by_number[1].last_heard_ns)


def test_room_is_made_by_media_where_no_connection_holds_much(rig: ControlSocketRig) -> None:
    crowd = [rig.open() for _ in range(2)]
    rig.hello(crowd[0][0])
    assert evict(rig, lambda: "media") == "media"
    assert [is_closed(theirs) for _, theirs in crowd] == [False, False]
    assert evict(rig, lambda: "") == ""
    rig.traffic.count_sent(crowd[0][0].descriptor, [b"x" * 2 * MIN_EVICT_BYTES])
    assert evict(rig, lambda: "media") == "Ann from 127.0.0.1"


class FakeMemory:
    """A memory guard with memory that the test sets."""

    def __init__(self) -> None:
        self.held, self.free = 100, 0
        self.shed: list[int] = []
        self.reported: list[tuple[str, int]] = []
        self.now_ns = 0
        self.watch = MemoryGuard(
            50,
            (lambda: [PendingConnection("ann", MIN_EVICT_BYTES, "Ann", self._shed)],),
            lambda: "",
            self._record,
            Drops(),
            lambda: self.held + self.free,
            self._trim,
        )

    def _record(self, whom: str, now_ns: int) -> None:
        self.reported.append((whom, now_ns))

    def _trim(self) -> None:
        self.free = 0

    def _shed(self) -> int:
        self.shed.append(self.now_ns)
        return 1

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
