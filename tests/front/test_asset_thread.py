"""The thread of the asset server, pass by pass: counters, order of chunks, and evictions."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq

from iris_session.front.asset_server import CHUNKS, YIELD_MS, AssetAccess, AssetServer, open_asset_sockets
from iris_session.link import FrontConfig
from iris_session.link.sockets import bound_port
from iris_session.link.tcp_guard import TcpBounds, TcpGuard, make_reasons
from iris_session.protocol.assets import AssetRequest
from iris_session.protocol.codec import encode_asset_request
from iris_session.protocol.names import AssetRefusal
from tests.front.asset_rig import put


class Still:
    """The server before its thread has begun: this thread does its work, step by step, at `now_ns`."""

    def __init__(self, root: Path) -> None:
        self.sockets = open_asset_sockets(FrontConfig(), None)
        guard = TcpGuard(TcpBounds(), make_reasons("assets"), self.sockets.monitor)
        self.now_ns = 1
        self.server = AssetServer(self.sockets, guard, lambda: self.now_ns)
        self.address = put(root, b"asset")
        self.server.set_access(AssetAccess({1: ""}, frozenset(), ((str(root), (self.address,)),)))
        self.context = zmq.Context()
        self.dealer = self.context.socket(zmq.DEALER)
        self.dealer.connect(f"tcp://127.0.0.1:{bound_port(self.sockets.socket)}")

    def take(self, n: int) -> None:
        """Send so many requests, and poll until all are processed."""
        wanted = self.server.requests + n
        for _ in range(n):
            self.dealer.send(encode_asset_request(AssetRequest(1, 1, 1, self.address, 0, 100)))
        while self.server.requests < wanted and self.sockets.socket.poll(30_000):
            self.server._receive_requests()
        assert self.server.requests == wanted

    @property
    def chunks(self) -> int:
        """Number of chunks that were sent."""
        return self.server.sent_bytes // len(b"asset")


@pytest.fixture
def still(tmp_path: Path) -> Iterator[Still]:
    still = Still(tmp_path)
    yield still
    still.context.destroy(linger=0)
    still.server.close()


def test_requests_of_closed_connections_are_removed_and_their_refusals_counted(still: Still) -> None:
    still.server._queue_refusal(b"gone", 7, "", AssetRefusal.NOT_ALLOWED)
    assert still.server.drops.by_reason == {"assets_not_allowed": 1, "assets_refusal_unsent": 1}
    still.take(1)
    assert still.server._scheduler.request(b"gone", 99, "", AssetRequest(1, 1, 7, still.address, 0, 100), 1) == ""
    assert still.server.pending_readers == 2
    still.server._send_chunks()
    assert (still.chunks, still.server.pending_readers) == (1, 0)


def test_late_loop_sends_one_chunk_per_interval(still: Still) -> None:
    still.take(4)
    assert still.server.drops.by_reason == {}, "whoever asks after a table was published is answered by it"
    still.server.late_until_ns = 2
    still.server._send_chunks()
    assert (still.chunks, still.server._poll_timeout_ms()) == (1, YIELD_MS)
    still.server.late_until_ns = 0
    still.server._send_chunks()
    assert (still.chunks, still.server._poll_timeout_ms()) == (1 + CHUNKS, 0)


def test_only_refused_requests_count_as_a_flood(still: Still) -> None:
    for n in range(1, TcpBounds().counted_messages + 10):
        still.now_ns += 10_000_000  # slower than any rate
        still.take(1)
        still.server._send_chunks()
        assert still.chunks == n
    assert still.server.drops.by_reason == {}
