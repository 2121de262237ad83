"""Assets of a client: order, lost connections, cache, and faults of the session, on a channel in memory."""

from __future__ import annotations

import hashlib
import random
import threading
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest

from iris_session.client import AssetError, AssetFetch, AssetStore, Client, InvalidMessageError, NotConnectedError
from iris_session.client.core import asset_loader
from iris_session.protocol.assets import AssetRequest
from iris_session.protocol.names import AssetRefusal
from tests.client.session import ClientSession, MemoryAssets, make_chunk
from tests.client.threads import ThreadedClient

MIB = 1 << 20
#: More than the window of requests, so that a test can act in the middle.
LARGE = 7 * MIB + 3
_random = random.Random(1)


class Shared:
    """A session with assets: `data` by address, the first small, the second large."""

    def __init__(self, session: ClientSession, folder: Path) -> None:
        self.session, self.folder = session, folder
        self.store = session.store = AssetStore(folder / "store")
        values = [_random.randbytes(size) for size in (1000, LARGE, 0, 700_000, *[2000] * 50)]
        self.data = {self.store.put(value): value for value in values}
        self.addresses = list(self.data)
        session.assets = (*self.addresses, "0" * 64)

    @property
    def bytes(self) -> int:
        return sum(map(len, self.data.values()))

    def join(self, name: str = "ann", cache: str = "cache") -> Client:
        client = self.session.make_client(name, role="observer")
        client.assets.cache = AssetStore(self.folder / cache)
        return client.connect()

    def channel_of(self, client: Client) -> MemoryAssets:
        return self.session.sockets_of(client).assets


@pytest.fixture
def shared(session: ClientSession, tmp_path: Path) -> Shared:
    return Shared(session, tmp_path)


def finish(client: Client, *fetches: AssetFetch) -> None:
    assert client.wait_for(lambda _: all(fetch.done for fetch in fetches)), [len(f.pending) for f in fetches]


def read_all(fetch: AssetFetch) -> dict[str, bytes]:
    return {address: fetch.read(address) for address in fetch.addresses}


def test_everything_is_fetched_once_and_then_cached(shared: Shared) -> None:
    client = shared.join()
    seen: list[int] = []

    def decode(_address: str, data: memoryview) -> int:
        return len(data)

    sizes = {address: len(data) for address, data in shared.data.items()}
    fetch = client.assets.fetch(sizes, lambda f: seen.append(f.bytes_done), decode)
    assert fetch.bytes_total == shared.bytes
    finish(client, fetch)
    assert fetch.failed == {}
    assert read_all(fetch) == shared.data
    assert fetch.decoded == sizes
    assert fetch.bytes_done == fetch.bytes_total == fetch.bytes_received == shared.channel_of(client).bytes_sent
    assert fetch.cached == 0
    assert seen == sorted(seen)
    assert seen[-1] == shared.bytes
    assert client.assets.malformed == 0
    client.close()
    again = shared.join("bob")
    second = again.assets.fetch(shared.addresses, decode=decode)
    finish(again, second)
    assert (second.bytes_received, second.cached, second.decoded) == (0, len(sizes), sizes)
    assert shared.channel_of(again).opened == 0


def test_lost_connection_costs_only_data_under_way(shared: Shared) -> None:
    client, cuts = shared.join(), [200, 2 * MIB, 4 * MIB, 6 * MIB]
    n_cuts = len(cuts)
    channel = shared.channel_of(client)
    channel.cuts = cuts
    fetch = client.assets.fetch(shared.addresses)
    finish(client, fetch)
    assert read_all(fetch) == shared.data
    assert cuts == [], "all were made"
    assert channel.opened == n_cuts + 1
    most = fetch.bytes_total + n_cuts * asset_loader.WINDOW_BYTES
    assert channel.bytes_sent <= most, "nothing came more often than it was lost"
    assert client.connection.counters.reconnects == 0


def test_failed_assets_have_a_reason_and_the_rest_arrives(shared: Shared) -> None:
    client = shared.join()
    good, damaged, undecodable = shared.addresses[0], shared.addresses[3], shared.addresses[4]

    def answer(request: AssetRequest) -> Sequence[Sequence[bytes]]:
        if request.address != damaged:
            return shared.session.answer_asset(request)
        return [make_chunk(request, 700_000, bytes(min(request.length, 700_000 - request.offset)))]

    shared.channel_of(client).answers = answer

    def decode(address: str, data: memoryview) -> None:
        if address == undecodable:
            raise ZeroDivisionError

    wanted = ["f" * 64, "0" * 64, damaged, undecodable, good]
    sizes = {address: len(shared.data.get(address, b"")) for address in wanted}
    fetch = client.assets.fetch(sizes, decode=decode)
    finish(client, fetch)
    assert {address: error.reason for address, error in fetch.failed.items()} == {
        "f" * 64: AssetRefusal.UNKNOWN,
        "0" * 64: AssetRefusal.UNKNOWN,
        damaged: "hash",
        undecodable: "decode",
    }
    assert fetch.read(good) == shared.data[good]
    assert fetch.bytes_received == 2 * 700_000 + 2000 + 1000  # the damaged one was requested once more, and only once
    with pytest.raises(AssetError) as raised:
        fetch.read(damaged)
    assert raised.value.reason == "hash"
    with pytest.raises(AssetError):
        fetch.check()
    with pytest.raises(InvalidMessageError):
        client.assets.fetch(["../../etc/passwd"])
    assert not list(client.assets.cache.root.glob("??/*.part")), "of those nothing is kept open"
    client.close()
    with pytest.raises(NotConnectedError):
        client.assets.fetch([good])


def test_unusable_cache_is_a_failure(shared: Shared, tmp_path: Path) -> None:
    client = shared.join()
    (tmp_path / "file").write_bytes(b"")
    client.assets.cache = AssetStore(tmp_path / "file")
    fetch = client.assets.fetch(shared.addresses[:2])
    finish(client, fetch)
    assert {error.reason for error in fetch.failed.values()} == {"cache"}


def test_cancelled_fetch_stops_and_resumes_later(shared: Shared) -> None:
    client = shared.join()
    small, large = shared.addresses[:2]
    fetch = client.assets.fetch([large, small])
    same = client.assets.fetch([small])
    assert client.wait_for(lambda _: fetch.bytes_done >= MIB)
    client.assets.cancel(fetch)
    assert fetch.done
    assert fetch.failed[large].reason == "cancelled"
    finish(client, same)
    assert same.read(small) == shared.data[small], "another still waits for it"
    again, beside = client.assets.fetch([large]), client.assets.fetch([large])
    client.assets.cancel(beside)
    finish(client, again)
    assert again.read(large) == shared.data[large]
    assert 0 < again.bytes_received <= LARGE - MIB
    client.assets.cancel(again)
    assert again.failed == {}
    assert client.assets.malformed == 0


# --- hostile session -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answers", "reason"),
    [
        (lambda r: [make_chunk(r, 10**9 + r.request_id, b"x" * 1000)], "protocol"),
        (lambda r: [[b"\xc1"], [b"", b"", b""], make_chunk(r, 5, b"wrong")], "hash"),
    ],
    ids=["another size each time", "no protocol"],
)
def test_wrong_answers_end_with_a_reason_and_store_nothing(
    shared: Shared, answers: Callable[[AssetRequest], Sequence[Sequence[bytes]]], reason: str
) -> None:
    client = shared.join()
    shared.channel_of(client).answers = answers
    address = shared.addresses[0]
    fetch = client.assets.fetch([address])
    finish(client, fetch)
    assert fetch.failed[address].reason == reason
    assert client.assets.cache.find(address) is None
    honest = shared.join("bob")
    again = honest.assets.fetch([address])
    finish(honest, again)
    assert again.read(address) == shared.data[address], "what the liar left in the cache does no harm"


# --- the threads ------------------------------------------------------------------------------------------------------


@pytest.fixture
def threaded(tmp_path: Path) -> Iterator[ThreadedClient]:
    """A client whose assets have the bytes `asset`, and are stored and decoded by real threads."""
    with ThreadedClient() as threaded:
        threaded.client.assets.cache = AssetStore(tmp_path / "cache")
        threaded.sockets.assets.answers = lambda request: [make_chunk(request, 5, b"asset")]
        yield threaded


ASSET = hashlib.sha256(b"asset").hexdigest()


def test_decode_function_may_use_the_client_until_it_is_closed(threaded: ThreadedClient) -> None:
    client = threaded.client
    begun, may_end = threading.Event(), threading.Event()
    seen: list[Any] = []

    def decode(_address: str, data: memoryview) -> None:
        begun.set()
        assert may_end.wait(30.0)
        seen.append((len(data), client.scene.presence))

    fetch = client.assets.fetch([ASSET], decode=decode)
    assert client.wait_for(lambda _: begun.is_set(), 30.0)
    closing = threading.Thread(target=client.close, daemon=True)
    closing.start()
    while not fetch.done:  # it had the lock and releases it
        closing.join(0.001)
    may_end.set()
    closing.join(30.0)
    assert not closing.is_alive()
    assert fetch.failed[ASSET].reason == "closed"
    assert seen == [(5, {})]
