"""Order, number and size of chunk requests against a session of plain values, and its misbehaviour."""

from __future__ import annotations

from random import Random

from iris_session.client.core.asset_loader import (
    CHUNK_BYTES,
    FAST_NS,
    FIRST_PAUSE_NS,
    MAX_CHUNK_BYTES,
    MIN_CHUNK_BYTES,
    PATIENCE_NS,
    SLOW_NS,
    WINDOW_BYTES,
    WINDOW_REQUESTS,
    AssetLoader,
    ChunkRequest,
    FailedAsset,
)
from iris_session.protocol.assets import MAX_ASSET_BYTES, AssetChunk, AssetRefused
from iris_session.protocol.names import AssetRefusal


def started(*addresses: str, offset: int = 0) -> AssetLoader:
    loader = AssetLoader()
    for address in addresses:
        assert loader.add(address)
    for address in loader.next_lookups():
        loader.on_missing(address, offset)
    return loader


def answer(
    loader: AssetLoader, ask: ChunkRequest, total: int, size: int = -1, now_ns: int = FAST_NS
) -> bool | FailedAsset | None:
    """Answer, by default as fast as leaves the chunk size unchanged."""
    size = max(0, min(ask.length, total - ask.offset)) if size < 0 else size
    return loader.process_chunk(AssetChunk(1, ask.request_id, ask.address, ask.offset, total), size, now_ns)


def refuse(loader: AssetLoader, ask: ChunkRequest, reason: str, now_ns: int = 0) -> FailedAsset | str:
    return loader.process_refusal(AssetRefused(1, ask.request_id, ask.address, reason, "advice"), now_ns)


def test_chunk_size_follows_the_link_rate() -> None:
    loader = started("a")
    now_ns, lengths = 0, []
    for took_ns in (1, 1, FAST_NS, *[SLOW_NS + 1] * 6, 1):
        ask = next(iter(loader.next_requests(now_ns)))
        lengths.append(ask.length)
        now_ns += took_ns
        assert answer(loader, ask, 100 * WINDOW_BYTES, now_ns=now_ns) is True
        loader.on_stored(ask.length)
        loader.on_link_closed()
    assert lengths[:4] == [CHUNK_BYTES, MAX_CHUNK_BYTES, MAX_CHUNK_BYTES, MAX_CHUNK_BYTES]
    assert lengths[4:8] == [MAX_CHUNK_BYTES >> n for n in range(1, 5)]
    assert lengths[8:] == [MIN_CHUNK_BYTES] * 2
    (ask,) = list(loader.next_requests(now_ns))[:1]
    assert ask.length == 2 * MIN_CHUNK_BYTES


def test_asset_above_the_maximum_is_not_requested() -> None:
    loader = started("a", "b")
    a, b = loader.next_requests(0)
    failed = answer(loader, a, MAX_ASSET_BYTES + 1)
    assert isinstance(failed, FailedAsset)
    assert failed.reason == "protocol"
    assert answer(loader, b, MAX_ASSET_BYTES) is True


def test_temporary_refusals_are_retried_with_growing_delay() -> None:
    loader, now_ns = started("a"), 0
    for pause_ns in (FIRST_PAUSE_NS, 2 * FIRST_PAUSE_NS, 4 * FIRST_PAUSE_NS):
        (ask,) = loader.next_requests(now_ns)
        assert refuse(loader, ask, AssetRefusal.BUSY, now_ns) == ""
        assert loader.refusal == "busy: advice"
        assert list(loader.next_requests(now_ns + pause_ns - 1)) == []
        now_ns += pause_ns
    (ask,) = loader.next_requests(now_ns)
    assert answer(loader, ask, CHUNK_BYTES + 5) is True
    assert loader.refusal == "", "it comes"
    (ask,) = loader.next_requests(now_ns)
    assert refuse(loader, ask, AssetRefusal.BUSY, now_ns) == ""
    (ask,) = loader.next_requests(now_ns + FIRST_PAUSE_NS)  # the first delay again, after a chunk arrived
    assert answer(loader, ask, CHUNK_BYTES + 5) is True
    assert loader.is_complete("a")


def test_part_is_discarded_once_in_all() -> None:
    """Otherwise a session could send something and then state a smaller size for ever."""
    loader = started("a", offset=1000)
    (ask,) = loader.next_requests(0)
    assert refuse(loader, ask, AssetRefusal.BAD_RANGE) == "a"
    loader.on_missing("a", 0)
    (ask,) = loader.next_requests(0)
    assert answer(loader, ask, 10**9, 1000) is True
    failed = refuse(loader, next(iter(loader.next_requests(0))), AssetRefusal.BAD_RANGE)
    assert isinstance(failed, FailedAsset)
    assert failed.reason == AssetRefusal.BAD_RANGE
    assert loader.add("a"), "a repeated request starts again"
    assert list(loader.next_lookups()) == ["a"]
    loader.on_missing("a", 1000)
    (ask,) = loader.next_requests(0)
    assert refuse(loader, ask, AssetRefusal.BAD_RANGE) == "a"


def test_contradicting_answers_are_rejected() -> None:
    loader = started("a", "b", "c")
    a, b, c = loader.next_requests(0)
    answer(loader, a, 4 * CHUNK_BYTES)
    a2 = next(iter(loader.next_requests(0)))
    assert isinstance(answer(loader, b, 100, size=0), FailedAsset)  # nothing, where there is something
    assert isinstance(answer(loader, c, 2**40, size=CHUNK_BYTES + 1), FailedAsset)  # more than requested
    assert isinstance(answer(loader, a2, 5 * CHUNK_BYTES), FailedAsset)  # other size than before
    assert loader.idle
    assert answer(loader, c, 5) is False
    assert loader.process_refusal(AssetRefused(1, 999, "", AssetRefusal.UNKNOWN), 0) == ""


def test_long_silence_is_overdue() -> None:
    loader = started("a", "b")
    asks = list(loader.next_requests(1000))
    assert not loader.is_overdue(1000 + PATIENCE_NS)
    answer(loader, asks[0], 5, now_ns=5000)
    assert not loader.is_overdue(2000 + PATIENCE_NS)
    assert loader.is_overdue(5001 + PATIENCE_NS)
    loader.on_link_closed()
    assert not loader.is_overdue(5001 + PATIENCE_NS)


def test_all_assets_complete_despite_random_faults() -> None:
    """A session that refuses, disconnects, sends less than requested, and a slow cache."""
    for seed in range(20):
        rng = Random(seed)
        sizes = {f"{i}": rng.choice((0, 5, CHUNK_BYTES, 3 * CHUNK_BYTES + 1, 2 * WINDOW_BYTES)) for i in range(40)}
        loader = AssetLoader()
        for address in sizes:
            loader.add(address)
        got = dict.fromkeys(sizes, 0)
        asks: list[ChunkRequest] = []
        unstored: list[int] = []
        for now_ns in range(0, 10**15, 20_000_000):
            for address in loader.next_lookups():
                loader.on_missing(address, 0)
            asks += loader.next_requests(now_ns)
            assert sum(ask.length for ask in asks) + sum(unstored) <= WINDOW_BYTES
            assert len(asks) <= WINDOW_REQUESTS
            for _ in range(rng.randrange(6)):
                if not asks:
                    break
                ask = asks.pop(0)
                there = min(ask.length, sizes[ask.address] - ask.offset)
                if rng.random() < 0.1:
                    assert refuse(loader, ask, AssetRefusal.TOO_MANY, now_ns) == ""
                    continue
                size = there if rng.random() < 0.8 else min(there, 1 + rng.randrange(CHUNK_BYTES))
                if answer(loader, ask, sizes[ask.address], size, now_ns) is True:
                    assert ask.offset == got[ask.address]
                    got[ask.address] += size
                    unstored.append(size)
                    if loader.is_complete(ask.address):
                        loader.remove(ask.address)
            if rng.random() < 0.02:
                loader.on_link_closed()
                asks.clear()
            while unstored and rng.random() < 0.7:
                loader.on_stored(unstored.pop())
            if loader.idle:
                break
        assert got == sizes
