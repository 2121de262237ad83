"""Assets of a client at a real front: order, lost connections, cache, and faults."""

from __future__ import annotations

import mmap
import os
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
import pytest
import zmq

from iris_session.client import AssetError, AssetFetch, AssetStore, Client, InvalidMessageError, NotConnectedError
from iris_session.client.core import asset_loader as asset_loading
from iris_session.client.group import ClientGroup
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, AssetChunk, AssetRequest
from iris_session.protocol.codec import decode_asset_request, encode_asset_header
from iris_session.protocol.names import AssetRefusal
from tests.assets.test_store import store_part
from tests.client.harness import LiveSession
from tests.front.asset_rig import noise, put
from tests.loopback import make_loopback_address

MIB = 1 << 20
#: More than may be under way, so that a test can act in the middle.
LARGE = 24 * MIB + 3
DEADLINE_S = 60.0


class Store:
    """The assets of the session by address."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.data: dict[str, bytes] = {}
        for size in (1000, LARGE, 0, 700_000, *[2000] * 50):
            data = noise(size)
            self.data[put(root, data)] = data

    @property
    def addresses(self) -> list[str]:
        return list(self.data)

    @property
    def bytes(self) -> int:
        return sum(map(len, self.data.values()))


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return Store(tmp_path / "store")


@pytest.fixture
def live(store: Store) -> Iterator[LiveSession]:
    host = make_loopback_address()  # no other test takes its ports while the front is replaced
    live = LiveSession(host=host, asset_root=str(store.root), assets=(*store.addresses, "0" * 64))
    yield live
    live.close()


@pytest.fixture
def join(live: LiveSession, tmp_path: Path) -> Iterator[Callable[..., Client]]:
    clients: list[Client] = []

    def make(name: str = "ann", cache: str = "cache") -> Client:
        client = Client(live.address, name=name, role="observer", alignment="not_needed")
        client.assets.cache = AssetStore(tmp_path / cache)
        clients.append(client)
        return client.connect(DEADLINE_S)

    yield make
    for client in clients:
        client.close()


def until_done(client: Client, fetch: AssetFetch) -> None:
    assert client.wait_for(lambda _: fetch.done, DEADLINE_S), (fetch.bytes_done, fetch.bytes_total, fetch.pending)


def test_everything_is_fetched_once_and_then_cached(store: Store, join: Callable[..., Client]) -> None:
    client = join()
    seen: list[int] = []

    def decode(_address: str, data: memoryview) -> int:
        return len(data)

    sizes = {address: len(data) for address, data in store.data.items()}
    fetch = client.assets.fetch(sizes, lambda f: seen.append(f.bytes_done), decode)
    assert fetch.bytes_total == store.bytes
    until_done(client, fetch)
    assert fetch.failed == {}
    assert {address: fetch.read(address) for address in store.addresses} == store.data
    assert fetch.decoded == sizes
    assert fetch.bytes_done == fetch.bytes_total == fetch.bytes_received == store.bytes
    assert fetch.cached == 0
    assert seen == sorted(seen)
    assert seen[-1] == store.bytes
    assert client.assets.malformed == 0
    client.close()
    again = join("bob")
    second = again.assets.fetch(store.addresses, decode=decode)
    until_done(again, second)
    assert (second.bytes_received, second.cached, second.decoded) == (0, len(sizes), sizes)
    report = again.status(DEADLINE_S).assets
    assert report is not None
    assert report.bytes_sent == store.bytes


def test_killed_front_costs_no_byte_twice(
    store: Store, live: LiveSession, join: Callable[..., Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(asset_loading, "PATIENCE_NS", 10**18)  # the control connection notices the loss
    client = join()
    killed: list[int] = []

    def kill(fetch: AssetFetch) -> None:
        if fetch.bytes_done > 2 * MIB and not killed:
            killed.append(fetch.bytes_done)
            os.kill(live.front.pid, signal.SIGKILL)

    fetch = client.assets.fetch(store.addresses, kill)
    until_done(client, fetch)
    fetch.check()
    assert 0 < killed[0] < store.bytes
    assert live.front.restarts == 1
    assert {address: fetch.read(address) for address in store.addresses} == store.data
    assert fetch.bytes_received == store.bytes


def test_reconnecting_client_resumes_its_downloads(store: Store, join: Callable[..., Client]) -> None:
    large = store.addresses[1]
    first = join()
    begun = first.assets.fetch([large])
    assert first.wait_for(lambda _: begun.bytes_done >= 2 * MIB, DEADLINE_S)
    first.close()
    assert begun.failed[large].reason == "closed"
    second = join()
    fetch = second.assets.fetch([large])
    until_done(second, fetch)
    assert fetch.read(large) == store.data[large]
    assert 0 < fetch.bytes_received <= len(store.data[large]) - 2 * MIB


def test_failed_assets_have_a_reason_and_the_rest_arrives(store: Store, join: Callable[..., Client]) -> None:
    client = join()
    damaged, good = store.addresses[3], store.addresses[0]
    path = store.root / damaged[:2] / damaged
    path.write_bytes(noise(700_000))

    def decode(address: str, data: memoryview) -> None:
        if address == store.addresses[4]:
            raise ZeroDivisionError("of the application")

    wanted = ["f" * 64, "0" * 64, damaged, store.addresses[4], good]
    fetch = client.assets.fetch(wanted, decode=decode)
    until_done(client, fetch)
    assert {address: error.reason for address, error in fetch.failed.items()} == {
        "f" * 64: AssetRefusal.UNKNOWN,
        "0" * 64: AssetRefusal.UNKNOWN,
        damaged: "hash",
        store.addresses[4]: "decode",
    }
    assert fetch.read(good) == store.data[good]
    assert fetch.bytes_received == 2 * 700_000 + 2000 + 1000  # the damaged one was requested once more, and only once
    with pytest.raises(AssetError, match="twice"):
        fetch.read(damaged)
    with pytest.raises(AssetError, match="refused"):
        fetch.check()
    with pytest.raises(InvalidMessageError, match="no address"):
        client.assets.fetch(["../../etc/passwd"])
    path.write_bytes(store.data[damaged])
    folder = client.assets.cache.root
    assert client.wait_for(lambda _: not list(folder.glob("??/*.part")), DEADLINE_S), "of those nothing is kept open"
    client.close()
    with pytest.raises(NotConnectedError):
        client.assets.fetch([good])


def test_concurrent_clients_by_thread_and_by_group(store: Store, join: Callable[..., Client]) -> None:
    """One with its own thread, two in one loop, one of which shares the cache of the first."""
    threaded, ann, bob = join("eve"), join("ann"), join("bob", "another")
    threaded.start()
    fetches = [client.assets.fetch(store.addresses) for client in (threaded, ann, bob)]
    group = ClientGroup([ann, bob])
    assert threaded.wait_for(lambda _: (group.poll(0.05), all(f.done for f in fetches))[1], DEADLINE_S)
    for fetch in fetches:
        fetch.check()
        assert {address: fetch.read(address) for address in store.addresses} == store.data


def test_session_without_assets_refuses_and_an_unusable_cache_raises(
    store: Store, join: Callable[..., Client], tmp_path: Path
) -> None:
    client = join()
    (tmp_path / "file").write_bytes(b"")
    client.assets.cache = AssetStore(tmp_path / "file")
    fetch = client.assets.fetch(store.addresses[:2])
    until_done(client, fetch)
    assert {error.reason for error in fetch.failed.values()} == {"cache"}
    client.assets.cache = AssetStore(tmp_path / "folder")
    fetch = client.assets.fetch(store.addresses[:2])
    until_done(client, fetch)
    fetch.check()


def test_cancelled_fetch_stops_and_resumes_later(store: Store, join: Callable[..., Client]) -> None:
    client = join()
    large, small = store.addresses[1], store.addresses[0]
    fetch = client.assets.fetch([large, small])
    shared = client.assets.fetch([small])
    assert client.wait_for(lambda _: fetch.bytes_done >= MIB, DEADLINE_S)
    client.assets.cancel(fetch)
    assert fetch.done
    assert fetch.failed[large].reason == "cancelled"
    until_done(client, shared)
    assert shared.read(small) == store.data[small], "another still waits for it"
    again = client.assets.fetch([large])
    until_done(client, again)
    assert again.read(large) == store.data[large]
    assert 0 < again.bytes_received <= len(store.data[large]) - MIB
    client.assets.cancel(again)
    assert again.failed == {}
    assert client.assets.malformed == 0


def test_asset_of_another_fetch_is_not_cancelled(store: Store, join: Callable[..., Client]) -> None:
    client = join()
    large = store.addresses[1]
    fetch, other = client.assets.fetch([large]), client.assets.fetch([large])
    assert client.wait_for(lambda _: fetch.bytes_done >= MIB, DEADLINE_S)
    client.assets.cancel(fetch)
    until_done(client, other)
    assert other.read(large) == store.data[large]
    assert other.bytes_received == len(store.data[large])


def test_each_fetch_gets_the_result_of_its_own_decode_function(store: Store, join: Callable[..., Client]) -> None:
    client = join()
    address = store.addresses[0]

    def failing(_address: str, _data: memoryview) -> None:
        raise ZeroDivisionError("of the application")

    begun = threading.Event()
    late: list[AssetFetch] = []

    def slow(_address: str, data: memoryview) -> int:
        begun.set()
        assert waited.wait(DEADLINE_S)
        return len(data)

    waited = threading.Event()
    fetches = [client.assets.fetch([address], decode=d) for d in (slow, lambda *_: "b", failing, None)]
    assert client.wait_for(lambda _: begun.is_set(), DEADLINE_S)
    late.append(client.assets.fetch([address], decode=lambda *_: "late"))
    waited.set()
    for fetch in (*fetches, *late):
        until_done(client, fetch)
    assert [fetch.decoded.get(address) for fetch in (*fetches, *late)] == [1000, "b", None, None, "late"]
    assert [[error.reason for error in fetch.failed.values()] for fetch in fetches] == [[], [], ["decode"], []]


def test_cache_is_not_replaced_during_a_fetch(store: Store, join: Callable[..., Client], tmp_path: Path) -> None:
    client = join()
    fetch = client.assets.fetch(store.addresses)
    client.assets.cache = AssetStore(tmp_path / "another")
    with pytest.raises(AssetError, match="exchanged"):
        client.assets.fetch(store.addresses[:1])
    until_done(client, fetch)
    fetch.check()
    assert {address: fetch.read(address) for address in store.addresses} == store.data


# --- hostile session -------------------------------------------------------------------------------------------------


class HostileSession:
    """Answers requests for assets in a thread: `answers(request)` makes the frames of each message."""

    def __init__(self, answers: Callable[[AssetRequest], list[list[bytes]]]) -> None:
        self._answers = answers
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._socket = self._context.socket(zmq.ROUTER)
        self.port = self._socket.bind_to_random_port("tcp://0.0.0.0")  # the client takes the host of its session
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._closing.is_set():
            if not self._socket.poll(20):
                continue
            route, data = self._socket.recv_multipart()
            request = decode_asset_request(data)
            for frames in self._answers(request):
                self._socket.send_multipart([route, *frames])

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._context.destroy(linger=0)


def chunk(request: AssetRequest, total: int, data: bytes, **other: int) -> list[bytes]:
    header = AssetChunk(1, request.request_id, request.address, request.offset, total)
    return [encode_asset_header(msgspec.structs.replace(header, **other)), data]


@pytest.fixture
def redirect_to(join: Callable[..., Client]) -> Iterator[Callable[..., tuple[Client, HostileSession]]]:
    liars: list[HostileSession] = []

    def make(answers: Callable[[AssetRequest], list[list[bytes]]], name: str = "ann") -> tuple[Client, HostileSession]:
        liars.append(HostileSession(answers))
        client = join(name)
        welcome = client.connection.welcome
        assert welcome is not None
        endpoints = msgspec.structs.replace(welcome.endpoints, assets=liars[-1].port)
        client.connection.welcome = msgspec.structs.replace(welcome, endpoints=endpoints)
        return client, liars[-1]

    yield make
    for liar in liars:
        liar.close()


@pytest.mark.parametrize(
    ("answers", "reason"),
    [
        (lambda r: [chunk(r, 5, b"wrong")], "hash"),
        (lambda r: [chunk(r, 2**50, b"x")], "protocol"),
        (lambda r: [chunk(r, 10**9 + r.request_id, b"x" * 1000)], "protocol"),
        (lambda r: [chunk(r, 9, b"")], "protocol"),
        (
            lambda r: [chunk(r, 5, b"wrong", offset=1), chunk(r, 5, b"wrong", request_id=77), chunk(r, 5, b"wrong")],
            "hash",
        ),
        (lambda r: [[b"\xc1"], [b"", b"", b""], chunk(r, 5, b"wrong")], "hash"),
    ],
    ids=["other bytes", "without end", "another size each time", "nothing", "for something else", "no protocol"],
)
def test_wrong_answers_end_with_a_reason_and_store_nothing(
    store: Store,
    join: Callable[..., Client],
    redirect_to: Callable[..., tuple[Client, HostileSession]],
    answers: Callable[[AssetRequest], list[list[bytes]]],
    reason: str,
) -> None:
    client, _ = redirect_to(answers)
    address = store.addresses[0]
    fetch = client.assets.fetch([address])
    until_done(client, fetch)
    assert fetch.failed[address].reason == reason
    assert client.assets.cache.find(address) is None
    honest = join("bob")
    again = honest.assets.fetch([address])
    until_done(honest, again)
    assert again.read(address) == store.data[address], "what the liar left in the cache does no harm"


def test_oversized_frame_is_not_read_into_memory(
    store: Store, redirect_to: Callable[..., tuple[Client, HostileSession]]
) -> None:
    """libzmq closes the connection; the client asks again by another."""
    address, data = store.addresses[0], store.data[store.addresses[0]]
    offsets: list[int] = []

    def answers(request: AssetRequest) -> list[list[bytes]]:
        offsets.append(request.offset)
        large = bytes(MAX_ASSET_CHUNK_BYTES + 1)
        return [chunk(request, len(large), large) if len(offsets) == 1 else chunk(request, len(data), data)]

    client, _ = redirect_to(answers)
    fetch = client.assets.fetch([address])
    assert client.wait_for(lambda _: len(offsets) == 1, DEADLINE_S)
    client.assets._close_link()  # as after `PATIENCE_NS`
    until_done(client, fetch)
    assert offsets == [0, 0]
    assert (fetch.read(address), fetch.bytes_received, client.assets.malformed) == (data, len(data), 0)


LOST, WAITED = "0" * 64, "1" * 64


def test_stored_asset_is_read_or_mapped_and_others_raise(tmp_path: Path) -> None:
    cache = AssetStore(tmp_path)
    here = store_part(cache, b"bytes of an asset")
    fetch = AssetFetch(cache, [here, LOST, WAITED], {here: 17}, None, None)
    fetch.on_found(here, 17, (), fetched=True)
    fetch.fail(LOST, AssetError(LOST, "unknown", "nobody has it"))
    assert fetch.read(here) == fetch.view(here) == b"bytes of an asset"
    assert isinstance(fetch.view(here).obj, mmap.mmap), "a large one is not in memory twice"
    for access in (fetch.read, fetch.view):
        with pytest.raises(AssetError, match="nobody has it"):
            access(LOST)
        with pytest.raises(AssetError, match="not come yet"):
            access(WAITED)
    assert not fetch.done
