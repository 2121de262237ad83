"""Limits of TCP connections, without connections: descriptors, addresses, bytes and times are made up."""

from __future__ import annotations

import os
import resource
import socket
from collections.abc import Callable

import pytest

from iris_session.link.config import SECOND
from iris_session.link.sockets import close_tcp, peer_of, tcp_counts
from iris_session.link.tcp_guard import CLOSE_FAILED, TcpBounds, TcpFlood, TcpGuard, TrafficCounter, make_reasons

FIRST = 100_000  # no descriptor of this process


class Traffic(TrafficCounter):
    """Pending bytes as the test sets them."""

    def __init__(self) -> None:
        super().__init__()
        self.pending: dict[int, int] = {}

    def pending_bytes(self, descriptor: int) -> int:
        return self.pending.get(descriptor, 0)


class Rig:
    """A guard and connections that it guards, by descriptors that count up."""

    def __init__(self, **bounds: int | bool | Callable[[str], int]) -> None:
        self.closed: list[tuple[int, bool]] = []
        self.traffic = Traffic()
        self.guard = TcpGuard(
            TcpBounds(**bounds),  # type: ignore[arg-type]
            make_reasons("media"),
            traffic=self.traffic,
            close=self._close,
        )
        self._next = FIRST

    def _close(self, descriptor: int, peer: tuple[str, int], *, discard: bool = False) -> bool:
        self.closed.append((descriptor - FIRST, discard))
        return True

    def open(self, host: str = "10.0.0.1", key: str = "", unread: int = 0, now_ns: int = SECOND) -> int:
        descriptor = self._next
        self._next += 1
        self.guard.add(descriptor, now_ns, (host, 1000 + descriptor))
        if key:
            self.guard.establish(descriptor, key)
        self.traffic.pending[descriptor] = unread
        return descriptor

    @property
    def left(self) -> list[int]:
        return [descriptor - FIRST for descriptor in self.guard.table]


def test_silent_connections_of_the_address_with_most_are_evicted_and_established_ones_stay() -> None:
    rig = Rig(unauthenticated=3, established=2)
    rig.open("10.0.0.2")
    rig.open(key="ann")
    for _ in range(4):
        rig.open()
    assert rig.guard.tick(SECOND) == ["media_too_many"] * 2
    assert rig.left == [0, 1, 4, 5]


@pytest.mark.parametrize("host", ["10.0.0.{n}", "2001:db8:{n}::1"])
def test_addresses_of_one_network_are_one_owner(host: str) -> None:
    rig = Rig(unauthenticated_per_owner=3)
    rig.open(host.format(n=1))
    for n in range(5):
        rig.open(f"2001:db8::{n:x}")
    assert rig.guard.evict_excess() == []  # this channel has no reason for it
    assert rig.left == [0, 3, 4, 5]


def test_of_established_connections_the_newest_of_the_owner_with_most_are_evicted() -> None:
    rig = Rig(established=4)
    for key in ("ann", "hog", "hog", "bob", "hog", "carl"):
        rig.open(key=key)
    assert rig.guard.tick(SECOND) == ["media_too_many"] * 2
    assert rig.left == [0, 1, 3, 5]


def test_connections_with_a_request_under_way_stay() -> None:
    rig = Rig(established=3, idle_ns=SECOND)
    busy = [rig.open(key="hog") for _ in range(2)]
    for descriptor in busy:
        rig.guard.table[descriptor].requests = 1
    rig.open(key="ann")
    rig.open(key="bob")
    rig.guard.tick(SECOND)
    assert rig.left == [0, 1, 2]
    rig.guard.tick(3 * SECOND)
    assert rig.left == [0, 1], "the other was idle"


def test_an_owner_has_its_share() -> None:
    rig = Rig(established=100, find_share=lambda owner: 1 if owner == "hog" else 3)
    for key in ("hog", "ann", "hog", "ann", "hog"):
        rig.open(key=key)
    rig.guard.tick(SECOND)
    assert rig.left == [0, 1, 3]


def test_silent_connections_are_closed_and_established_ones_may_be_silent() -> None:
    rig = Rig(silence_ns=10 * SECOND)
    rig.open()
    rig.open(key="ann")
    assert rig.guard.tick(11 * SECOND) == []
    assert rig.guard.tick(11 * SECOND + TcpBounds().check_period_ns) == ["media_silent"]
    assert rig.left == [1]


@pytest.mark.parametrize("key", ["camera", ""])
def test_unread_bytes_count_by_owner(key: str) -> None:
    rig = Rig(unread_bytes=8192, owner_bytes=8192)
    mine = [rig.open(key=key, unread=n) for n in (3000, 4000, 3500)]
    rig.open("10.0.0.2", key="other", unread=7000)
    assert rig.guard.tick(SECOND) == ["media_flood"]
    assert rig.left == [0, 2, 3]
    assert rig.closed == [(1, True)]
    owner = key or "10.0.0.1"
    assert sum(one.bytes for one in rig.guard.list_pending() if one.owner == owner) == 6500
    assert rig.guard.pop_floods() == [TcpFlood("10.0.0.1", key, SECOND, 4000)]
    assert rig.guard.tick(2 * SECOND) == [], "each is within the bound, and so is their sum"
    assert len(mine) == 3


def test_unread_bytes_are_bounded_over_all_owners() -> None:
    rig = Rig(unread_bytes=8192, owner_bytes=8192, total_bytes=12_000)
    for n, key in enumerate(("ann", "bob", "carl", "dana")):
        rig.open(key=key, unread=3000 + n)
    assert rig.guard.tick(SECOND) == ["media_flood"]
    assert rig.left == [0, 1, 2]


def test_unread_bytes_may_grow_with_the_age_of_a_connection() -> None:
    rig = Rig(unread_bytes=1000, unread_bytes_per_s=100, established=9)
    rig.open(key="ann", unread=1900, now_ns=SECOND)
    rig.open(key="bob", unread=1900, now_ns=3 * SECOND)
    assert rig.guard.tick(10 * SECOND + 1) == ["media_flood"]
    assert rig.left == [0]


def test_bytes_of_some_are_examined_in_turn() -> None:
    rig = Rig(unread_bytes=1000, examined=2, bytes_period_ns=0)
    for n in range(5):
        rig.open(key="ann", unread=2000 if n in (1, 4) else 0)
    assert [len(rig.guard.tick(SECOND)) for _ in range(3)] == [1, 0, 1]


def test_counted_messages_end_a_connection() -> None:
    rig = Rig(counted_messages=16)
    ann, bob = rig.open(key="ann"), rig.open(key="bob")
    assert [rig.guard.record_message(ann, (10,), 8) for _ in range(3)] == ["", "", "media_flood"]
    assert rig.guard.record_message(bob, (10,) * 100, 0) == ""
    assert [flood.key_id for flood in rig.guard.pop_floods()] == ["ann"]
    assert rig.guard.record_message(ann, (10,), 8) == "", "what had arrived before"


def test_a_close_that_fails_is_tried_again() -> None:
    can_close = False
    server = socket.create_server(("127.0.0.1", 0))
    theirs = socket.create_connection(server.getsockname())
    ours, address = server.accept()
    with server, theirs, ours:
        guard = TcpGuard(TcpBounds(), make_reasons("media"), close=lambda *_, **__: can_close)
        guard.add(ours.fileno(), SECOND)
        assert guard.evict(ours.fileno(), "media_silent") == CLOSE_FAILED
        assert [one.address for one in guard.table.values()] == [address]
        can_close = True
        assert guard.evict(ours.fileno(), "media_silent") == "media_silent"
        assert guard.evict(ours.fileno(), "media_silent") == ""


# --- closing one connection of libzmq -------------------------------------------------------------------------------


def test_close_needs_no_new_descriptor() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        theirs = socket.create_connection(server.getsockname())
        ours, address = server.accept()
        with theirs, ours:
            soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
            resource.setrlimit(resource.RLIMIT_NOFILE, (3, hard))
            try:
                with pytest.raises(OSError, match="Too many open files"):
                    os.dup(0)
                assert peer_of(ours.fileno()) == address
                assert tcp_counts(ours.fileno()) is not None
                assert close_tcp(ours.fileno(), address)
            finally:
                resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
            assert theirs.recv(1) == b""


@pytest.mark.parametrize("discard", [False, True])
def test_close_discards_what_is_unread(discard: bool) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        theirs = socket.create_connection(server.getsockname())
        ours, address = server.accept()
        with theirs, ours:
            theirs.sendall(bytes(1000))
            ours.recv(1, socket.MSG_PEEK)  # it has come
            assert close_tcp(ours.fileno(), address, discard=discard)
            assert len(ours.recv(2000)) == (0 if discard else 1000)
            assert theirs.recv(1) == b""


def test_descriptors_that_are_not_tcp_stay_open() -> None:
    read, write = os.pipe()
    for descriptor in (read, 10_000):
        assert peer_of(descriptor) == ("", 0)
        assert tcp_counts(descriptor) is None
        assert not close_tcp(descriptor, ("", 0))
    os.write(write, b"x")
    assert os.read(read, 1) == b"x"
    os.close(read)
    os.close(write)
