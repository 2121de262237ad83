"""Order and limits of chunk requests, without sockets, files or time."""

from __future__ import annotations

from collections import Counter
from random import Random

from iris_session.assets.chunk_scheduler import (
    ADVICE,
    LONGEST_PAUSE_NS,
    MAX_QUEUED,
    MAX_READERS_EACH,
    REQUEST_BURST,
    ChunkScheduler,
)
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, MAX_ASSET_REQUESTS, MAX_ASSET_WINDOW_BYTES, AssetRequest
from iris_session.protocol.names import AssetRefusal

SIZES = {"large": 1 << 30, "small": 100, "empty": 0}
MIB = 1 << 20


def scheduler(people: int = 3) -> ChunkScheduler:
    made = ChunkScheduler(SIZES.get)
    made.set_listeners({number: f"key{number}" for number in range(1, people + 1)})
    return made


def request(
    one: ChunkScheduler, who: int, address: str = "large", offset: int = 0, length: int = MIB, now_ns: int = 0
) -> str:
    request = AssetRequest(1, who, 7, address, offset, length)
    return one.request(b"route%d" % who, 100 + who, f"key{who}", request, now_ns)


def serve(one: ChunkScheduler, turns: int, now_ns: int = 0) -> list[int]:
    """Serve `turns` chunks and return their participants in order."""
    order = []
    for _ in range(turns):
        reader = one.next_reader(now_ns)
        if reader is None:
            break
        order.append(reader.number)
        one.confirm_sent(reader)
    return order


def test_participants_are_served_in_rotation() -> None:
    one = scheduler()
    for _ in range(8):
        assert request(one, 1) == ""
    for who in (2, 3):
        assert request(one, who) == request(one, who) == ""
    assert Counter(serve(one, 6)) == {1: 2, 2: 2, 3: 2}
    assert serve(one, 100) == [1] * 6
    assert one.next_reader(0) is None
    assert one.next_due_ns() is None


def test_windows_of_bytes_and_requests_are_limited() -> None:
    one = scheduler()
    for _ in range(MAX_ASSET_WINDOW_BYTES // MIB):
        assert request(one, 1) == ""
    assert request(one, 1, length=1) == AssetRefusal.TOO_MANY
    assert request(one, 2, "small") == ""
    serve(one, 2)
    assert request(one, 1, length=1) == ""
    for _ in range(MAX_ASSET_REQUESTS - 1):
        assert request(one, 3, "small") == ""
    assert request(one, 3, "empty") == ""
    assert request(one, 3, "empty") == AssetRefusal.TOO_MANY


def test_refusals_have_their_reason() -> None:
    one = scheduler()
    assert request(one, 9) == AssetRefusal.NOT_ALLOWED
    assert one.request(b"x", 1, "key2", AssetRequest(1, 1, 7, "large", 0, 1), 0) == AssetRefusal.NOT_ALLOWED
    assert request(one, 1, "nothing") == AssetRefusal.UNKNOWN
    assert request(one, 1, "small", 101) == AssetRefusal.BAD_RANGE
    assert request(one, 1, "small", 0, 0) == AssetRefusal.BAD_RANGE
    assert request(one, 1, "small", 0, MAX_ASSET_CHUNK_BYTES + 1) == AssetRefusal.BAD_RANGE
    assert request(one, 1, "small", 100) == request(one, 1, "empty") == ""
    reasons = {value for key, value in vars(AssetRefusal).items() if key.isupper() and isinstance(value, str)}
    assert reasons == set(ADVICE)


def test_request_rate_is_limited_beside_the_window() -> None:
    one = scheduler()
    refused: list[str] = []
    for _ in range(REQUEST_BURST + 10):
        refused.append(request(one, 1, "empty"))
        serve(one, 1)
    assert refused.count("") == REQUEST_BURST
    assert refused[-10:] == [AssetRefusal.RATE] * 10
    assert request(one, 2, "empty") == ""
    assert request(one, 1, "empty", now_ns=1_000_000_000) == ""


def test_connections_per_participant_are_limited() -> None:
    one = scheduler()
    for i in range(MAX_READERS_EACH):
        assert one.request(b"%d" % i, i, "key1", AssetRequest(1, 1, 7, "large", 0, 1), 0) == ""
    late = AssetRequest(1, 1, 7, "large", 0, 1)
    assert one.request(b"late", 50, "key1", late, 0) == AssetRefusal.BUSY
    one.remove_descriptor(0)
    assert one.request(b"late", 50, "key1", late, 0) == ""


def test_full_connection_is_skipped_with_growing_delay() -> None:
    one = scheduler()
    request(one, 1)
    request(one, 2)
    pauses, now_ns = [], 0
    for _ in range(10):
        reader = one.next_reader(now_ns)
        assert reader is not None
        if reader.number != 1:
            reader = one.next_reader(now_ns)
        assert reader is not None
        assert reader.number == 1
        one.defer(reader, now_ns)
        pauses.append(reader.retry_ns - now_ns)
        assert {one.next_reader(now_ns), one.next_reader(now_ns)} == {
            one.next_reader(now_ns)
        }  # only the other connection is served
        now_ns = reader.retry_ns
    assert pauses == sorted(pauses)
    assert pauses[0] < pauses[-1] == LONGEST_PAUSE_NS
    one.defer(reader, now_ns)
    assert request(one, 1, "small", now_ns=now_ns) == ""  # it reads again
    assert reader.retry_ns == 0
    one.confirm_sent(reader)
    one.defer(reader, now_ns)
    assert reader.retry_ns - now_ns == pauses[0], "what got through ends the long pauses"


def test_disconnected_participant_has_no_pending_requests() -> None:
    one = scheduler()
    for who in (1, 2, 3):
        request(one, who)
    assert one.set_listeners({2: "key2"}) == [101, 103]
    assert serve(one, 10) == [2]
    request(one, 2)
    one.remove_descriptor(102)
    assert (one.n_waiting, serve(one, 1)) == (0, [])


def test_reused_name_of_another_peer_starts_empty() -> None:
    one = scheduler()
    request(one, 1)
    assert one.request(b"route1", 999, "key2", AssetRequest(1, 2, 7, "small", 0, 1), 0) == ""
    assert serve(one, 10) == [2]


def test_refusals_are_queued_behind_chunks_and_bounded() -> None:
    one = scheduler()
    assert not one.queue_refusal(b"route1", 1, "", AssetRefusal.UNKNOWN)
    request(one, 1)
    assert one.has_pending(b"route1")
    kept = [one.queue_refusal(b"route1", i, "", AssetRefusal.UNKNOWN) for i in range(MAX_QUEUED + 5)]
    assert kept.count(True) == MAX_QUEUED - 1
    reader = one.next_reader(0)
    assert reader is not None
    assert [pending.refusal for pending in reader.queue] == ["", *[AssetRefusal.UNKNOWN] * (MAX_QUEUED - 1)]
    assert len(serve(one, 1000)) == MAX_QUEUED


def test_any_sequence_keeps_rotation_and_windows_consistent() -> None:
    rng = Random(5)
    one = scheduler(4)
    for now_ns in range(5000):
        who = rng.randrange(1, 6)
        match rng.randrange(6):
            case 0 | 1 | 2:
                request(one, who, rng.choice(list(SIZES)), 0, rng.randrange(0, MIB), now_ns)
            case 3:
                reader = one.next_reader(now_ns)
                if reader is not None:
                    one.confirm_sent(reader) if rng.random() < 0.5 else one.defer(reader, now_ns)
            case 4:
                one.remove_descriptor(100 + who) if rng.random() < 0.1 else one.queue_refusal(
                    b"route%d" % who, 1, "", "busy"
                )
            case _:
                one.set_listeners({n: f"key{n}" for n in range(1, 5) if rng.random() < 0.95})
        waiting = [reader for reader in one._readers.values() if reader.queue]
        assert set(map(id, waiting)) == set(map(id, one._ring))
        assert len(one._ring) == len(waiting)
        for reader in waiting:
            assert reader.queued_bytes == sum(pending.length for pending in reader.queue) <= MAX_ASSET_WINDOW_BYTES


def test_gateway_connection_is_served_in_order_within_the_limits_of_one() -> None:
    """One connection that requests for several participants."""
    one = ChunkScheduler(SIZES.get)
    one.set_listeners({1: "gateway", 2: "gateway", 3: "gateway"})
    asked = [1, 1, 2, 3, 2, 1]
    for request_id, number in enumerate(asked):
        request = AssetRequest(1, number, request_id, "small", 0, 10)
        assert one.request(b"route", 100, "gateway", request, 0) == ""
    answered = []
    while (reader := one.next_reader(0)) is not None:
        answered.append(reader.queue[0].request_id)
        one.confirm_sent(reader)
    assert answered == list(range(len(asked)))
    refused = Counter(
        one.request(b"route", 100, "gateway", AssetRequest(1, 1 + n % 3, n, "nothing", 0, 10), 0)
        for n in range(REQUEST_BURST)
    )
    assert refused[AssetRefusal.RATE] == len(asked), "another name is no other allowance"
