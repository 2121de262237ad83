"""The assets channel: chunks, refusals, keys, faults, and its thread pass by pass."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from iris_session.assets.store import ServedAssets
from iris_session.front import asset_server
from iris_session.front.asset_server import CHUNKS, YIELD_MS, AssetAccess, AssetServer, open_asset_sockets
from iris_session.link import FrontConfig
from iris_session.link.sockets import bound_port
from iris_session.link.tcp_guard import TcpBounds, TcpGuard, make_reasons
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, AssetChunk, AssetRefused, AssetRequest
from iris_session.protocol.codec import decode_asset_chunk, decode_asset_refused, encode_asset_request
from iris_session.protocol.names import AssetRefusal
from iris_session.security import KeyPair
from tests.front.fakes import put

MIB = 1 << 20


class Fetcher:
    """A DEALER on the assets port; keeps the answers to its requests by number."""

    def __init__(self, shop: Shop, epoch: int = 1, pair: KeyPair | None = None) -> None:
        shop.fetchers.append(self)
        self.epoch = epoch
        self.socket = shop.context.socket(zmq.DEALER)
        self.socket.linger = 0
        if pair is not None and shop.key is not None:
            self.socket.curve_serverkey = shop.key.public.encode()
            self.socket.curve_publickey, self.socket.curve_secretkey = pair.public.encode(), pair.secret.encode()
        self.socket.connect(f"tcp://127.0.0.1:{bound_port(shop.sockets.socket)}")
        self.chunks: dict[int, tuple[AssetChunk, bytes]] = {}
        self.refusals: dict[int, AssetRefused] = {}
        self._next = 0

    def ask(self, address: str, offset: int = 0, length: int = 1 << 20, version: int = 1) -> int:
        self._next += 1
        request = AssetRequest(version, self.epoch, self._next, address, offset, length)
        self.socket.send(encode_asset_request(request))
        return self._next

    def take(self, timeout_ms: int = 0) -> int:
        """Read what arrived. Return the number of answers."""
        while self.socket.poll(timeout_ms):
            timeout_ms = 0
            frames = self.socket.recv_multipart()
            if len(frames) == 2:
                chunk = decode_asset_chunk(frames[0], len(frames[1]))
                self.chunks[chunk.request_id] = chunk, frames[1]
            else:
                refused = decode_asset_refused(frames[0])
                self.refusals[refused.request_id] = refused
        return len(self.chunks) + len(self.refusals)

    def answer(self, request_id: int) -> bytes | str:
        """Wait for a chunk, or for the reason of its refusal."""
        deadline = time.monotonic() + 30.0
        while request_id not in self.chunks and request_id not in self.refusals:
            assert time.monotonic() < deadline, f"no answer {request_id}"
            self.take(100)
        return self.chunks[request_id][1] if request_id in self.chunks else self.refusals[request_id].reason


class Shop:
    """A server without a front, which serves three assets to connection 1, and clients of it."""

    def __init__(self, root: Path, key: KeyPair | None = None) -> None:
        self.root = root
        self.key = key
        self.data = [os.urandom(3 * MIB + 17), os.urandom(1000), b""]
        self.addresses = [put(root, data) for data in self.data]
        self.sockets = open_asset_sockets(FrontConfig(), key)
        guard = TcpGuard(TcpBounds(), make_reasons("assets"), self.sockets.monitor)
        self.server = AssetServer(self.sockets, guard, lambda: self.now_ns or time.monotonic_ns())
        self.now_ns = 0  # present time where the thread has not begun, and the test does its work; 0: of the clock
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.fetchers: list[Fetcher] = []
        self.allow({1: ""})

    def allow(self, clients: dict[int, str], *keys: KeyPair, gateways: frozenset[int] = frozenset()) -> None:
        marks = frozenset(pair.fingerprint for pair in keys)
        self.server.set_access(AssetAccess(clients, marks, ((str(self.root), tuple(self.addresses)),), gateways))

    def receive(self, fetcher: Fetcher, n: int, address: str = "") -> None:
        """Send so many requests for 5 bytes, and process them."""
        wanted = self.server.requests + n
        for _ in range(n):
            fetcher.ask(address or self.addresses[1], 0, 5)
        while self.server.requests < wanted and self.sockets.socket.poll(30_000):
            self.server._receive_requests()
        assert self.server.requests == wanted

    def close(self) -> None:
        self.context.destroy(linger=0)
        self.server.close()


@pytest.fixture
def still(tmp_path: Path) -> Iterator[Shop]:
    """A server whose thread has not begun."""
    shop = Shop(tmp_path)
    shop.now_ns = 1
    yield shop
    shop.close()


@pytest.fixture
def shop(tmp_path: Path) -> Iterator[Shop]:
    shop = Shop(tmp_path)
    shop.server.start()
    yield shop
    shop.close()


def test_chunks_of_any_size_give_every_byte(shop: Shop) -> None:
    ann = Fetcher(shop)
    large = shop.addresses[0]
    got, total = b"", 1
    while len(got) < total:
        request = ann.ask(large, len(got), 700_001)
        got += bytes(ann.answer(request))  # type: ignore[arg-type]
        total = ann.chunks[request][0].total
    assert got == shop.data[0]
    assert ann.answer(ann.ask(shop.addresses[2])) == b""
    assert ann.answer(ann.ask(large, len(got) - 5)) == shop.data[0][-5:]
    assert ann.answer(ann.ask(large, len(got))) == b""


def test_unavailable_assets_are_refused_with_reason_and_advice(shop: Shop) -> None:
    ann, unknown = Fetcher(shop), Fetcher(shop, epoch=999)
    there, missing = shop.addresses[:2]
    (shop.root / missing[:2] / missing).unlink()
    hidden = put(shop.root, b"of another session")
    for address in ("", "../../etc/passwd", there[:-1], there.upper(), "0" * 64, hidden, missing):
        assert ann.answer(ann.ask(address)) == AssetRefusal.UNKNOWN
    for offset, length in ((len(shop.data[0]) + 1, 1), (2**63 - 1, 1), (0, 0), (0, MAX_ASSET_CHUNK_BYTES + 1)):
        assert ann.answer(ann.ask(there, offset, length)) == AssetRefusal.BAD_RANGE
    ann.ask(there, version=2)
    ann.socket.send_multipart([b"\xc1", b"x" * 700])
    assert ann.answer(0), "it has no number"
    assert unknown.answer(unknown.ask(there)) == AssetRefusal.NOT_ALLOWED
    assert all(refused.advice for refused in (*ann.refusals.values(), *unknown.refusals.values()))
    assert ann.answer(ann.ask(there, 0, 3)) == shop.data[0][:3]
    assert shop.server.drops.by_reason["assets_malformed"] == shop.server.drops.by_reason["assets_version"] == 1


def test_only_the_key_of_the_connection_fetches_until_it_is_revoked(tmp_path: Path) -> None:
    shop = Shop(tmp_path, KeyPair.generate())
    ann, bob, eve = (KeyPair.generate() for _ in range(3))
    shop.allow({1: ann.fingerprint, 2: bob.fingerprint}, ann, bob)
    shop.server.start()
    anns, posing, bobs = Fetcher(shop, 1, ann), Fetcher(shop, 1, bob), Fetcher(shop, 2, bob)
    address = shop.addresses[1]
    assert anns.answer(anns.ask(address)) == shop.data[1]
    assert posing.answer(posing.ask(address)) == AssetRefusal.NOT_ALLOWED
    shop.allow({2: bob.fingerprint}, bob)
    before = anns.take()
    late = [Fetcher(shop, 1, pair) for pair in (eve, ann)]
    for one in (*late, anns):
        one.ask(address)
    assert bobs.answer(bobs.ask(address)) == shop.data[1]
    deadline = time.monotonic() + 30.0
    while shop.server.drops.by_reason.get("assets_unknown_key", 0) < 2:
        assert time.monotonic() < deadline
        time.sleep(0.002)
    assert anns.take() - before in (0, len(anns.refusals)), "it is disconnected, or refused when it comes again"
    assert [one.take() for one in late] == [0, 0]
    shop.close()


def test_fault_of_the_thread_loses_pending_work_and_is_logged_once(
    shop: Shop, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(asset_server, "FAULT_S", 0.01)
    faults = iter([True, True])
    chunk = ServedAssets.chunk

    def fail(files: ServedAssets, address: str, offset: int, length: int) -> memoryview | None:
        return chunk(files, address, offset, 1 // 0 if next(faults, False) else length)  # type: ignore[return-value]

    monkeypatch.setattr(ServedAssets, "chunk", fail)
    for n in (1, 2):
        Fetcher(shop).ask(shop.addresses[1])
        deadline = time.monotonic() + 30.0
        while shop.server.drops.by_reason.get("assets_fault", 0) < n:
            assert time.monotonic() < deadline
            time.sleep(0.002)
    ann = Fetcher(shop)
    assert ann.answer(ann.ask(shop.addresses[1])) == shop.data[1]
    assert caplog.text.count("thread of assets, which continues: ZeroDivisionError") == 1


# --- pass by pass ----------------------------------------------------------------------------------------------------


def test_requests_of_closed_connections_are_removed_and_their_refusals_counted(still: Shop) -> None:
    still.server._queue_refusal(b"gone", 7, "", AssetRefusal.NOT_ALLOWED)
    assert still.server.drops.by_reason == {"assets_not_allowed": 1, "assets_refusal_unsent": 1}
    still.receive(Fetcher(still), 1)
    request = AssetRequest(1, 1, 7, still.addresses[0], 0, 100)
    assert still.server._scheduler.request(b"gone", 99, "", request, 1) == ""
    assert still.server.pending_readers == 2
    still.server._send_chunks()
    assert (still.server.sent_bytes, still.server.pending_readers) == (5, 0)


def test_late_loop_sends_one_chunk_per_interval(still: Shop) -> None:
    still.receive(Fetcher(still), 4)
    still.server.late_until_ns = 2
    still.server._send_chunks()
    assert (still.server.sent_bytes, still.server._poll_timeout_ms()) == (5, YIELD_MS)
    still.server.late_until_ns = 0
    still.server._send_chunks()
    assert (still.server.sent_bytes, still.server._poll_timeout_ms()) == (5 + 5 * CHUNKS, 0)


def test_only_refused_requests_count_as_a_flood(still: Shop) -> None:
    ann = Fetcher(still)
    for n in range(1, TcpBounds().counted_messages + 10):
        still.now_ns += 10_000_000  # slower than any rate
        still.receive(ann, 1)
        still.server._send_chunks()
        assert still.server.sent_bytes == 5 * n
    assert still.server.drops.by_reason == {}


def test_what_those_behind_a_gateway_cause_does_not_count_against_it(still: Shop) -> None:
    still.allow({1: "", 2: ""}, gateways=frozenset({2}))
    ann, gateway, n = Fetcher(still), Fetcher(still, epoch=2), TcpBounds().counted_messages // 8
    for _ in range(10):
        still.now_ns += 1_000_000_000  # slower than any rate
        still.receive(gateway, n, "0" * 64)
    assert still.server.drops.by_reason["assets_unknown_asset"] == 10 * n
    assert "assets_flood" not in still.server.drops.by_reason
    still.now_ns += 1_000_000_000
    still.receive(ann, 8 * n + 1, "0" * 64)
    assert still.server.drops.by_reason["assets_flood"] == 1
