"""Connections to the assets channel that end while the session continues: nothing blocks, nothing repeats for ever."""

from __future__ import annotations

import contextlib
import hashlib
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest

from iris_session.client import AssetStore, Client
from iris_session.client.core import asset_loader as asset_loading
from iris_session.protocol.assets import AssetRequest
from tests.client.harness import LiveSession
from tests.client.test_assets import HostileSession, chunk
from tests.front.asset_rig import noise, put

MIB = 1 << 20
DEADLINE_S = 30.0


class Relay:
    """Between clients and a port.

    After each given total of bytes from the port it closes every connection with the data under way.
    """

    def __init__(self, port: int, cuts: list[int]) -> None:
        self._to, self._cuts = port, cuts
        self._listening = socket.create_server(("127.0.0.1", 0))
        self._ends: list[socket.socket] = []
        self._threads: list[threading.Thread] = []
        self.port = self._listening.getsockname()[1]
        self.accepted = self.came = 0
        self._start(self._accept)

    def _start(self, work: Callable[..., None], *of: object) -> None:
        self._threads.append(threading.Thread(target=work, args=of, daemon=True))
        self._threads[-1].start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                near = self._listening.accept()[0]
                far = socket.create_connection(("127.0.0.1", self._to))
                self.accepted += 1
                self._ends += [near, far]
                self._start(self._forward, near, far, False)
                self._start(self._forward, far, near, True)

    def _forward(self, source: socket.socket, sink: socket.socket, counts: bool) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65_536):
                self.came += counts * len(data)
                if counts and self._cuts and self.came >= self._cuts[0]:
                    self._cuts.pop(0)
                    self._close_connections()
                sink.sendall(data)
        _close_socket(sink)

    def _close_connections(self) -> None:
        for end in self._ends:
            _close_socket(end)

    def close(self) -> None:
        _close_socket(self._listening)
        self._threads[0].join()
        self._close_connections()
        for thread in self._threads:
            thread.join()
        for one in (self._listening, *self._ends):
            one.close()


def _close_socket(one: socket.socket) -> None:
    with contextlib.suppress(OSError):
        one.shutdown(socket.SHUT_RDWR)


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LiveSession]:
    addresses = tuple(put(tmp_path / "store", noise(size)) for size in (24 * MIB, *[300_000] * 20))
    live = LiveSession(asset_root=str(tmp_path / "store"), assets=addresses)
    yield live
    live.close()


@pytest.mark.parametrize("cuts", [[200], [5 * MIB], [6 * MIB, 9 * MIB, 12 * MIB]], ids=["at first", "once", "often"])
def test_lost_connection_costs_only_data_under_way(
    live: LiveSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cuts: list[int]
) -> None:
    monkeypatch.setattr(asset_loading, "PATIENCE_NS", 10**18)  # the reconnect must not come from the patience
    addresses, n_cuts = live.front.scene.assets, len(cuts)
    client = Client(live.address, role="observer", alignment="not_needed")
    client.assets.cache = AssetStore(tmp_path / "cache")
    client.connect(DEADLINE_S)
    welcome = client.connection.welcome
    assert welcome is not None
    relay = Relay(welcome.endpoints.assets, cuts)
    endpoints = msgspec.structs.replace(welcome.endpoints, assets=relay.port)
    client.connection.welcome = msgspec.structs.replace(welcome, endpoints=endpoints)
    try:
        fetch = client.assets.fetch(addresses)
        done = client.wait_for(lambda _: fetch.done or relay.came > 200 * MIB, DEADLINE_S)
        assert done, (fetch.bytes_done, relay.came)
        fetch.check()
        assert not cuts, "all were made"
        assert relay.accepted <= n_cuts + 2
        most = fetch.bytes_total + (n_cuts + 1) * asset_loading.WINDOW_BYTES
        assert relay.came <= most, "nothing came more often than it was lost"
        assert client.connection.counters.reconnects == 0
    finally:
        client.close()
        relay.close()


def test_decode_function_may_use_the_client_until_it_is_closed(live: LiveSession, tmp_path: Path) -> None:
    client = Client(live.address, role="observer", alignment="not_needed")
    client.assets.cache = AssetStore(tmp_path / "cache")
    client.connect(DEADLINE_S)
    address = live.front.scene.assets[1]
    begun, lets_go, seen = threading.Event(), threading.Event(), []

    def decode(_address: str, data: memoryview) -> None:
        begun.set()
        assert lets_go.wait(DEADLINE_S)
        seen.append((len(data), client.scene.presence))

    fetch = client.assets.fetch([address], decode=decode)
    assert client.wait_for(lambda _: begun.is_set(), DEADLINE_S)
    closing = threading.Thread(target=client.close, daemon=True)
    closing.start()
    until = time.monotonic() + DEADLINE_S
    while not fetch.done and time.monotonic() < until:  # it had the lock and releases it
        time.sleep(0.001)
    lets_go.set()
    closing.join(DEADLINE_S)
    assert not closing.is_alive()
    assert fetch.failed[address].reason == "closed"
    assert seen == [(300_000, {})]


def test_connection_without_answers_is_replaced(
    live: LiveSession, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(asset_loading, "PATIENCE_NS", 100_000_000)
    data, asked = b"asset", []

    def answers(request: AssetRequest) -> list[list[bytes]]:
        asked.append(request.request_id)
        return [chunk(request, len(data), data)] if len(asked) > 1 else []

    client = Client(live.address, role="observer", alignment="not_needed")
    client.assets.cache = AssetStore(tmp_path / "cache")
    client.connect(DEADLINE_S)
    other, welcome = HostileSession(answers), client.connection.welcome
    assert welcome is not None
    endpoints = msgspec.structs.replace(welcome.endpoints, assets=other.port)
    client.connection.welcome = msgspec.structs.replace(welcome, endpoints=endpoints)
    try:
        fetch = client.assets.fetch([hashlib.sha256(data).hexdigest()])
        assert client.wait_for(lambda _: fetch.done, DEADLINE_S)
        fetch.check()
        assert len(asked) > 1
    finally:
        client.close()
        other.close()
