"""The assets channel: chunks, refusals, keys, and the thread. Fairness is in `assets.chunk_scheduler`."""

from __future__ import annotations

import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import psutil
import pytest
import zmq

from iris_session.assets.store import ServedAssets
from iris_session.front.asset_server import AssetAccess, AssetServer, AssetSockets, open_asset_sockets
from iris_session.link import FrontConfig
from iris_session.link.sockets import bound_port
from iris_session.link.tcp_guard import TcpBounds, TcpGuard, make_reasons
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, AssetRequest
from iris_session.protocol.codec import encode_asset_request
from iris_session.protocol.names import AssetRefusal
from iris_session.security import KeyPair
from iris_session.system.priority import LOW_PRIORITY_NICE
from tests.front.asset_rig import Fetcher, noise, put, with_assets
from tests.front.lab import Lab
from tests.front.process_harness import ProcessClient

MIB = 1 << 20


class Shop:
    """A server without a front, which serves three assets to connection 1, and clients of it."""

    host = "127.0.0.1"

    def __init__(self, root: Path) -> None:
        self.root = root
        self.data = [noise(3 * MIB + 17), noise(1000), b""]
        self.addresses = [put(root, data) for data in self.data]
        self.sockets = open_asset_sockets(FrontConfig(), None)
        guard = TcpGuard(TcpBounds(), make_reasons("assets"), self.sockets.monitor)
        self.server = AssetServer(self.sockets, guard, time.monotonic_ns)
        self.server.set_access(AssetAccess({1: ""}, frozenset(), ((str(root), tuple(self.addresses)),)))
        self.ports = SimpleNamespace(assets=bound_port(self.sockets.socket))
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._fetchers: list[Fetcher] = []
        self.server.start()

    def fetcher(self, epoch: int = 1) -> Fetcher:
        self._fetchers.append(Fetcher(self, epoch))
        return self._fetchers[-1]

    def pump(self, until: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + 30.0
        while not until():
            assert time.monotonic() < deadline, what
            time.sleep(0.001)

    def close(self) -> None:
        for fetcher in self._fetchers:
            fetcher.close()
        self.context.destroy(linger=0)
        self.server.close()


@pytest.fixture
def shop(tmp_path: Path) -> Iterator[Shop]:
    shop = Shop(tmp_path)
    yield shop
    shop.close()


def test_chunks_of_any_size_give_every_byte(shop: Shop) -> None:
    ann = shop.fetcher()
    large = shop.addresses[0]
    got, total = b"", 1
    while len(got) < total:
        request = ann.ask(large, len(got), 700_001)
        got += bytes(ann.answer(request))  # type: ignore[arg-type]
        total = ann.chunks[request][0].total
    assert got == shop.data[0]
    assert ann.answer(ann.ask(shop.addresses[1])) == shop.data[1]
    assert ann.answer(ann.ask(shop.addresses[2])) == b""
    assert ann.answer(ann.ask(large, len(got) - 5)) == shop.data[0][-5:]
    assert ann.answer(ann.ask(large, len(got))) == b""


def test_unavailable_assets_are_refused_with_reason_and_advice(shop: Shop, tmp_path: Path) -> None:
    ann = shop.fetcher()
    there = shop.addresses[0]
    hidden = put(tmp_path, b"of another session")
    for address in ("", "../../etc/passwd", there[:-1], there.upper(), "0" * 64, hidden):
        assert ann.answer(ann.ask(address)) == AssetRefusal.UNKNOWN
    for offset, length in ((len(shop.data[0]) + 1, 1), (2**63 - 1, 1), (0, 0), (0, MAX_ASSET_CHUNK_BYTES + 1)):
        assert ann.answer(ann.ask(there, offset, length)) == AssetRefusal.BAD_RANGE
    assert ann.answer(ann.ask(there, 0, 2**63 - 1)) == AssetRefusal.BAD_RANGE
    ann.ask(there, version=2)
    ann.socket.send_multipart([b"\xc1", b"x" * 700])
    shop.pump(lambda: ann.take() > 0 and {0} <= ann.refusals.keys(), "answers without a number")
    unknown = shop.fetcher(epoch=999)
    assert unknown.answer(unknown.ask(there)) == AssetRefusal.NOT_ALLOWED
    assert all(refused.advice for refused in (*ann.refusals.values(), *unknown.refusals.values()))
    assert ann.answer(ann.ask(shop.addresses[1])) == shop.data[1]
    reasons = shop.server.drops.by_reason
    assert reasons["assets_malformed"] == reasons["assets_version"] == 1


def test_asset_missing_on_disk_is_refused_and_others_are_served(shop: Shop) -> None:
    ann = shop.fetcher()
    (shop.root / shop.addresses[0][:2] / shop.addresses[0]).unlink()
    assert ann.answer(ann.ask(shop.addresses[0])) == AssetRefusal.UNKNOWN
    assert ann.answer(ann.ask(shop.addresses[1])) == shop.data[1]


# --- keys ------------------------------------------------------------------------------------------------------------


def test_only_the_key_of_the_connection_fetches_until_it_is_revoked(process_lab: Lab, tmp_path: Path) -> None:
    lab, session = process_lab, process_lab.session
    data = noise(MIB)
    address = put(tmp_path / "store", data)
    session.process.set_scene(with_assets(tmp_path / "store", address))
    ann, client = lab.allowed("ann")
    bob, other = lab.allowed("bob")
    passing = (AssetRefusal.NOT_ALLOWED, AssetRefusal.UNKNOWN)

    def welcome(client: ProcessClient, pair: KeyPair) -> Fetcher:
        """Return a fetcher that the server knows, with the assets."""
        fetcher = Fetcher(session, client.epoch, lab.curve(pair))
        while fetcher.answer(fetcher.ask(address, 0, 1)) in passing:
            pass
        return fetcher

    anns = welcome(client, ann)
    assert anns.answer(anns.ask(address)) == data
    eve = Fetcher(session, client.epoch, lab.curve(KeyPair.generate()))
    eve.ask(address)
    posing = Fetcher(session, client.epoch, lab.curve(bob))
    assert posing.answer(posing.ask(address)) == AssetRefusal.NOT_ALLOWED
    session.wait_drops("assets_unknown_key")
    lab.home.clients.revoke_key(ann.fingerprint)
    lab.audits("key_revoked")
    bobs = welcome(other, bob)
    before = anns.take()
    anns.ask(address)
    again = Fetcher(session, client.epoch, lab.curve(ann))
    again.ask(address)
    session.wait_drops("assets_unknown_key", session.process.link.status.drops["assets_unknown_key"] + 1)
    assert bobs.answer(bobs.ask(address)) == data
    assert (anns.take(), again.take(), eve.take()) == (before, 0, 0)
    for one in (anns, eve, posing, bobs, again):
        one.close()


# --- the thread ------------------------------------------------------------------------------------------------------


@pytest.fixture
def alone(tmp_path: Path) -> Iterator[tuple[AssetServer, AssetSockets, str]]:
    """The server thread without a front; it serves one asset to connection 1."""
    sockets = open_asset_sockets(FrontConfig(), None)
    guard = TcpGuard(TcpBounds(), make_reasons("assets"), sockets.monitor)
    server = AssetServer(sockets, guard, time.monotonic_ns)
    address = put(tmp_path, b"asset")
    server.set_access(AssetAccess({1: ""}, frozenset(), ((str(tmp_path), (address,)),)))
    server.start()
    yield server, sockets, address
    server.close()


def _fetched(sockets: AssetSockets, address: str) -> bytes | None:
    """Fetch one asset by a new connection; `None` when that was closed instead."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as dealer:
        dealer.linger = 0
        dealer.setsockopt(zmq.RECONNECT_IVL, -1)
        ended = dealer.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        dealer.connect(f"tcp://127.0.0.1:{bound_port(sockets.socket)}")
        dealer.send(encode_asset_request(AssetRequest(1, 1, 1, address, 0, 100)))
        poller = zmq.Poller()
        poller.register(dealer, zmq.POLLIN)
        poller.register(ended, zmq.POLLIN)
        came = dict(poller.poll(30_000))
        dealer.disable_monitor()
        ended.close(linger=0)
        assert came
        return dealer.recv_multipart()[-1] if dealer in came else None


def test_fault_of_the_thread_loses_pending_work_and_is_logged_once(
    alone: tuple[AssetServer, AssetSockets, str],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    server, sockets, address = alone
    assert _fetched(sockets, address) == b"asset"
    with monkeypatch.context() as broken:

        def fail(*_: object) -> None:
            raise ZeroDivisionError("planted")

        broken.setattr(ServedAssets, "chunk", fail)
        assert [_fetched(sockets, address) for _ in range(2)] == [None, None]
    assert _fetched(sockets, address) == b"asset"
    assert server.drops.by_reason["assets_fault"] == 2
    assert caplog.text.count("thread of assets, which continues: ZeroDivisionError") == 1


def test_io_threads_of_assets_have_low_priority(alone: tuple[AssetServer, AssetSockets, str]) -> None:
    ours = os.getpriority(os.PRIO_PROCESS, 0)
    low = min(19, ours + LOW_PRIORITY_NICE)
    found = Counter(os.getpriority(os.PRIO_PROCESS, thread.id) for thread in psutil.Process().threads())
    assert found[low] >= 2  # libzmq's I/O thread and its reaper; none that holds Python's lock
    python = [thread.native_id for thread in threading.enumerate() if thread.native_id is not None]
    assert {os.getpriority(os.PRIO_PROCESS, number) for number in python} == {ours}


def test_late_loop_sends_chunks_one_by_one(alone: tuple[AssetServer, AssetSockets, str]) -> None:
    server, sockets, address = alone
    server.late_until_ns = time.monotonic_ns() + 10**12
    assert _fetched(sockets, address) == b"asset"  # slowly, but it goes on
