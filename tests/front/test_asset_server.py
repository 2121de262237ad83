"""The assets channel of a real front process: chunks, refusals, fairness between clients, and access."""

from __future__ import annotations

import os
import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import msgspec
import psutil
import pytest
import zmq

from iris_session.assets.store import ServedAssets
from iris_session.front.asset_server import AssetAccess, AssetServer, AssetSockets, open_asset_sockets
from iris_session.link import FrontConfig, FrontLimits
from iris_session.link.sockets import bound_port
from iris_session.link.tcp_guard import TcpBounds, TcpGuard, make_reasons
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, MAX_ASSET_REQUESTS, AssetRequest
from iris_session.protocol.client_messages import Heartbeat
from iris_session.protocol.codec import encode_asset_request
from iris_session.protocol.names import AssetRefusal
from iris_session.protocol.server_messages import Event, SceneChanged
from iris_session.protocol.status import GetStatus, StatusReport
from iris_session.protocol.steps import Decision
from iris_session.security import KeyPair
from iris_session.system.priority import LOW_PRIORITY_NICE
from tests.front.asset_rig import Curve, Fetcher, noise, put, with_assets
from tests.front.harness import FrontSession, RawClient
from tests.front.lab import Lab, Open

MIB = 1 << 20


class Shop:
    """A session that serves three assets, and its fetchers, which are kept alive on slow machines, too."""

    def __init__(self, session: FrontSession, root: Path) -> None:
        self.session = session
        self.root = root
        self.data = [noise(3 * MIB + 17), noise(1000), b""]
        self.addresses = [put(root, data) for data in self.data]
        self.show(*self.addresses)
        self._fetchers: list[Fetcher] = []
        self._steps = 0
        self._once, session.once = session.once, self._step  # type: ignore[method-assign,assignment]

    def show(self, *addresses: str) -> None:
        self.session.process.set_scene(with_assets(self.root, *addresses))

    def _step(self, *arguments: object) -> None:
        self._once(*arguments)  # type: ignore[arg-type]
        self._steps += 1
        if self._steps % 100 == 0:
            for client in self.session.clients:
                if client.welcome is not None and not client.socket.closed:
                    client.send(Heartbeat(True))

    def fetcher(self, client: RawClient, curve: Curve | None = None, epoch: int = -1, **options: int) -> Fetcher:
        self._fetchers.append(Fetcher(self.session, client.epoch if epoch < 0 else epoch, curve, **options))
        return self._fetchers[-1]

    def joined(self, name: str = "ann") -> RawClient:
        client = self.session.client()
        client.join("observer", name)
        return client

    def welcome(self, fetcher: Fetcher) -> Fetcher:
        """Wait until the server knows the connection and the assets."""
        passing = (AssetRefusal.NOT_ALLOWED, AssetRefusal.UNKNOWN)
        while fetcher.answer(fetcher.ask(self.addresses[1], 0, 1)) in passing:
            pass
        return fetcher

    def drops(self, reason: str) -> int:
        return self.session.process.link.status.drops.get(reason, 0)

    def close(self) -> None:
        for fetcher in self._fetchers:
            fetcher.close()


@pytest.fixture
def shop(session: FrontSession, tmp_path: Path) -> Iterator[Shop]:
    shop = Shop(session, tmp_path)
    yield shop
    shop.close()


def test_chunks_of_any_size_give_every_byte(shop: Shop) -> None:
    ann = shop.welcome(shop.fetcher(shop.joined()))
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
    assert shop.joined("bob").welcome.endpoints.assets == shop.session.ports.assets  # type: ignore[union-attr]


def test_unavailable_assets_are_refused_with_reason_and_advice(shop: Shop, tmp_path: Path) -> None:
    ann = shop.welcome(shop.fetcher(shop.joined()))
    there = shop.addresses[0]
    hidden = put(tmp_path, b"of another session")
    for address in ("", "../../etc/passwd", there[:-1], there.upper(), "0" * 64, hidden):
        assert ann.answer(ann.ask(address)) == AssetRefusal.UNKNOWN
    for offset, length in ((len(shop.data[0]) + 1, 1), (2**63 - 1, 1), (0, 0), (0, MAX_ASSET_CHUNK_BYTES + 1)):
        assert ann.answer(ann.ask(there, offset, length)) == AssetRefusal.BAD_RANGE
    assert ann.answer(ann.ask(there, 0, 2**63 - 1)) == AssetRefusal.BAD_RANGE
    ann.ask(there, version=2)
    ann.socket.send_multipart([b"\xc1", b"x" * 700])
    shop.session.pump(lambda: ann.take() > 0 and {0} <= ann.refusals.keys(), "answers without a number")
    stranger = shop.fetcher(shop.joined("bob"), epoch=999)
    assert stranger.answer(stranger.ask(there)) == AssetRefusal.NOT_ALLOWED
    assert all(refused.advice for refused in (*ann.refusals.values(), *stranger.refusals.values()))
    assert ann.answer(ann.ask(shop.addresses[1])) == shop.data[1]
    shop.session.pump(lambda: shop.drops("assets_malformed") == 1 == shop.drops("assets_version"), "they are counted")


def test_asset_missing_on_disk_is_refused_and_others_are_served(shop: Shop) -> None:
    ann = shop.welcome(shop.fetcher(shop.joined()))
    (shop.root / shop.addresses[0][:2] / shop.addresses[0]).unlink()
    assert ann.answer(ann.ask(shop.addresses[0])) == AssetRefusal.UNKNOWN
    assert ann.answer(ann.ask(shop.addresses[1])) == shop.data[1]


def test_previous_scene_is_served_and_older_ones_are_not(shop: Shop) -> None:
    ann = shop.welcome(shop.fetcher(shop.joined()))
    second, third = put(shop.root, b"second"), put(shop.root, b"third")

    def once(address: str, answer: object) -> None:
        while ann.answer(ann.ask(address)) != answer:
            pass

    shop.show(second)
    once(second, b"second")
    assert ann.answer(ann.ask(shop.addresses[1])) == shop.data[1]
    shop.show(third)
    once(third, b"third")
    assert ann.answer(ann.ask(second)) == b"second"
    assert ann.answer(ann.ask(shop.addresses[1])) == AssetRefusal.UNKNOWN


def test_announced_and_recently_replaced_specifications_are_served(shop: Shop) -> None:
    client = shop.joined()
    ann = shop.welcome(shop.fetcher(client))
    looks = []
    for number in range(1, 21):
        looks.append(put(shop.root, b"look %d" % number))
        info = with_assets(shop.root, looks[-1], shop.addresses[1])
        shop.session.process.set_scene(msgspec.structs.replace(info, scene_hash=looks[-1]))
        event = Event(number, number, 0, SceneChanged(1, number, "patch", looks[-1]))
        shop.session.once(Decision((), events=(event,)))
        client.wait_for(Event, number)
        assert ann.answer(ann.ask(looks[-1])) == b"look %d" % number
    assert ann.answer(ann.ask(looks[-5])) == b"look 16"
    assert ann.answer(ann.ask(shop.addresses[0])) == AssetRefusal.UNKNOWN


def test_stalled_client_delays_no_other_and_is_served_later(shop: Shop) -> None:
    slow = shop.welcome(shop.fetcher(shop.joined("eve"), hwm=1, rcvbuf=4096))
    asked = [slow.ask(shop.addresses[0], 0, MIB) for _ in range(8)]
    more = [slow.ask(shop.addresses[0], MIB, MIB) for _ in range(8)]
    ann = shop.welcome(shop.fetcher(shop.joined()))
    for _ in range(10):
        assert ann.answer(ann.ask(shop.addresses[0], MIB, MIB)) == shop.data[0][MIB : 2 * MIB]
    assert len(slow.chunks) <= 1
    assert {slow.answer(one) == shop.data[0][:MIB] for one in asked} == {True}
    for one in more:  # those that did not fit beside the first eight were refused, or had their turn by then
        assert slow.answer(one) in (shop.data[0][MIB : 2 * MIB], AssetRefusal.TOO_MANY)


def test_flood_of_requests_is_bounded_and_cut_off(shop: Shop) -> None:
    ann = shop.welcome(shop.fetcher(shop.joined()))
    eve = shop.fetcher(shop.joined("eve"), hwm=1, rcvbuf=4096)
    shop.session.pump(lambda: _flood(shop, eve), "eve is cut off")
    assert shop.drops("assets_too_many_outstanding") + shop.drops("assets_rate") > MAX_ASSET_REQUESTS
    assert ann.answer(ann.ask(shop.addresses[1])) == shop.data[1]


def _flood(shop: Shop, eve: Fetcher) -> bool:
    if eve.socket.poll(0, 2):
        for _ in range(100):
            eve.ask(shop.addresses[0])
    return shop.drops("assets_flood") > 0


def test_silent_asset_connection_is_closed(open_session: Open) -> None:
    session = open_session(limits=FrontLimits(hello_timeout_ns=500_000_000))
    with socket.create_connection((session.host, session.ports.assets)) as silent:
        assert session.wait_drops("assets_silent") >= 1
        silent.settimeout(30.0)
        while silent.recv(4096):
            pass


def test_leaving_client_loses_its_asset_connection(shop: Shop) -> None:
    eve, ann = shop.joined("eve"), shop.joined()
    fetcher = shop.welcome(shop.fetcher(eve))
    monitor = fetcher.socket.get_monitor_socket(0x0200)  # zmq.EVENT_DISCONNECTED
    eve.close()
    shop.session.pump(lambda: bool(monitor.poll(0)), "the end of eve's connection")
    anns = shop.welcome(shop.fetcher(ann))
    assert anns.answer(anns.ask(shop.addresses[1])) == shop.data[1]


def test_status_counts_sent_assets(shop: Shop) -> None:
    client = shop.joined()
    ann = shop.welcome(shop.fetcher(client))
    ann.answer(ann.ask(shop.addresses[0]))
    ann.answer(ann.ask("0" * 64))

    def told() -> bool:
        if shop.session.step % 200 == 0:
            client.send(GetStatus())
        reports = [report.assets for report in client.got(StatusReport)]
        report = reports[-1] if reports else None
        return report is not None and report.bytes_sent > MIB and report.refusals > 0 and report.served == 3

    shop.session.pump(told, "the counters of assets")


def test_restarted_front_serves_assets_on_the_same_port(shop: Shop) -> None:
    shop.welcome(shop.fetcher(shop.joined()))
    port = shop.session.ports.assets
    shop.session.process.restart()
    shop.session.pump(lambda: shop.session.process.link.ports is not None, "a new front")
    assert shop.session.process.link.ports is not None
    assert shop.session.process.link.ports.assets == port
    bob = shop.welcome(shop.fetcher(shop.joined("bob")))
    assert bob.answer(bob.ask(shop.addresses[1])) == shop.data[1]


# --- keys ------------------------------------------------------------------------------------------------------------


def test_only_the_key_of_the_connection_fetches_until_it_is_revoked(lab: Lab, tmp_path: Path) -> None:
    shop = Shop(lab.session, tmp_path / "store")
    ann, client = lab.allowed("ann")
    bob, other = lab.allowed("bob")
    anns = shop.welcome(shop.fetcher(client, lab.curve(ann)))
    assert anns.answer(anns.ask(shop.addresses[0])) == shop.data[0][:MIB]
    eve = shop.fetcher(client, lab.curve(KeyPair.generate()))
    eve.ask(shop.addresses[1])
    posing = shop.fetcher(client, lab.curve(bob))
    assert posing.answer(posing.ask(shop.addresses[1])) == AssetRefusal.NOT_ALLOWED
    shop.session.pump(lambda: shop.drops("assets_unknown_key") > 0, "eve's key is refused")
    lab.home.clients.revoke_key(ann.fingerprint)
    lab.audits("key_revoked")
    bobs = shop.welcome(shop.fetcher(other, lab.curve(bob)))
    before = anns.take()
    anns.ask(shop.addresses[1])
    again = shop.fetcher(client, lab.curve(ann))
    again.ask(shop.addresses[1])
    refused = shop.drops("assets_unknown_key")
    shop.session.pump(lambda: shop.drops("assets_unknown_key") > refused, "the revoked key is refused")
    assert bobs.answer(bobs.ask(shop.addresses[1])) == shop.data[1]
    assert (anns.take(), again.take(), eve.take()) == (before, 0, 0)
    shop.close()


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
    assert server.read_counters().reasons["assets_fault"] == 2
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
