"""Whose turn it is, and what is refused: without sockets, files or time."""

from __future__ import annotations

from collections import Counter
from random import Random

from iris_session.assets.chunk_scheduler import (
    ADVICE,
    LONGEST_PAUSE_NS,
    MAX_QUEUED,
    MAX_READERS_EACH,
    REQUEST_BURST,
    AssetHub,
)
from iris_session.protocol.assets import (
    MAX_ASSET_CHUNK_BYTES,
    MAX_ASSET_REQUESTS,
    MAX_ASSET_WINDOW_BYTES,
    AssetRequest,
)
from iris_session.protocol.names import AssetRefusal

SIZES = {"large": 1 << 30, "small": 100, "empty": 0}
MIB = 1 << 20


def hub(people: int = 3) -> AssetHub:
    made = AssetHub(SIZES.get)
    made.allow({number: f"key{number}" for number in range(1, people + 1)})
    return made


def ask(one: AssetHub, who: int, address: str = "large", offset: int = 0, length: int = MIB, now_ns: int = 0) -> str:
    request = AssetRequest(1, who, 7, address, offset, length)
    return one.ask(b"route%d" % who, 100 + who, f"key{who}", request, now_ns)


def served(one: AssetHub, turns: int, now_ns: int = 0) -> list[int]:
    """The participants whose chunks went out, turn by turn."""
    order = []
    for _ in range(turns):
        reader = one.turn(now_ns)
        if reader is None:
            break
        order.append(reader.number)
        one.sent(reader)
    return order


def test_turns_go_around_however_much_somebody_waits_for() -> None:
    one = hub()
    for _ in range(8):
        assert ask(one, 1) == ""
    for who in (2, 3):
        assert ask(one, who) == ask(one, who) == ""
    assert Counter(served(one, 6)) == {1: 2, 2: 2, 3: 2}
    assert served(one, 100) == [1] * 6
    assert one.turn(0) is None
    assert one.next_turn_ns() is None


def test_a_window_of_bytes_and_one_of_requests() -> None:
    one = hub()
    for _ in range(MAX_ASSET_WINDOW_BYTES // MIB):
        assert ask(one, 1) == ""
    assert ask(one, 1, length=1) == AssetRefusal.TOO_MANY
    assert ask(one, 2, "small") == ""
    served(one, 2)
    assert ask(one, 1, length=1) == ""
    for _ in range(MAX_ASSET_REQUESTS - 1):
        assert ask(one, 3, "small") == ""
    assert ask(one, 3, "empty") == ""
    assert ask(one, 3, "empty") == AssetRefusal.TOO_MANY


def test_a_length_counts_only_as_far_as_the_asset_goes() -> None:
    one = hub()
    for _ in range(MAX_ASSET_REQUESTS):
        assert ask(one, 1, "small", 40, MAX_ASSET_CHUNK_BYTES) == ""
    reader = one.turn(0)
    assert reader is not None
    assert (reader.queue[0].length, reader.queue[0].total) == (60, 100)


def test_what_is_refused_and_why() -> None:
    one = hub()
    assert ask(one, 9) == AssetRefusal.NOT_ALLOWED
    assert one.ask(b"x", 1, "key2", AssetRequest(1, 1, 7, "large", 0, 1), 0) == AssetRefusal.NOT_ALLOWED
    assert ask(one, 1, "nothing") == AssetRefusal.UNKNOWN
    assert ask(one, 1, "small", 101) == AssetRefusal.BAD_RANGE
    assert ask(one, 1, "small", 0, 0) == AssetRefusal.BAD_RANGE
    assert ask(one, 1, "small", 0, MAX_ASSET_CHUNK_BYTES + 1) == AssetRefusal.BAD_RANGE
    assert ask(one, 1, "small", 100) == ask(one, 1, "empty") == ""
    reasons = {value for key, value in vars(AssetRefusal).items() if key.isupper() and isinstance(value, str)}
    assert reasons == set(ADVICE)


def test_a_rate_that_no_window_bounds() -> None:
    one = hub()
    refused: list[str] = []
    for _ in range(REQUEST_BURST + 10):
        refused.append(ask(one, 1, "empty"))
        served(one, 1)
    assert refused.count("") == REQUEST_BURST
    assert refused[-10:] == [AssetRefusal.RATE] * 10
    assert ask(one, 2, "empty") == ""
    assert ask(one, 1, "empty", now_ns=1_000_000_000) == ""


def test_a_participant_has_few_connections() -> None:
    one = hub()
    for i in range(MAX_READERS_EACH):
        assert one.ask(b"%d" % i, i, "key1", AssetRequest(1, 1, 7, "large", 0, 1), 0) == ""
    late = AssetRequest(1, 1, 7, "large", 0, 1)
    assert one.ask(b"late", 50, "key1", late, 0) == AssetRefusal.BUSY
    one.left(0)
    assert one.ask(b"late", 50, "key1", late, 0) == ""


def test_a_full_connection_is_passed_over_for_longer_and_longer() -> None:
    one = hub()
    ask(one, 1)
    ask(one, 2)
    pauses, now_ns = [], 0
    for _ in range(10):
        reader = one.turn(now_ns)
        assert reader is not None
        if reader.number != 1:
            reader = one.turn(now_ns)
        assert reader is not None
        assert reader.number == 1
        one.full(reader, now_ns)
        pauses.append(reader.retry_ns - now_ns)
        assert {one.turn(now_ns), one.turn(now_ns)} == {one.turn(now_ns)}  # only the other one's turn
        now_ns = reader.retry_ns
    assert pauses == sorted(pauses)
    assert pauses[0] < pauses[-1] == LONGEST_PAUSE_NS
    one.full(reader, now_ns)
    assert ask(one, 1, "small", now_ns=now_ns) == ""  # it reads again
    assert reader.retry_ns == 0
    one.sent(reader)
    one.full(reader, now_ns)
    assert reader.retry_ns - now_ns == pauses[0], "what got through ends the long pauses"


def test_who_left_waits_for_nothing() -> None:
    one = hub()
    for who in (1, 2, 3):
        ask(one, who)
    assert one.allow({2: "key2"}) == [101, 103]
    assert served(one, 10) == [2]
    ask(one, 2)
    one.left(102)
    assert (one.waiting, served(one, 1)) == (0, [])


def test_begun_anew_nobody_waits_and_everybody_may_ask() -> None:
    one = hub()
    ask(one, 1)
    ask(one, 2)
    assert one.begin_anew() == [101, 102]
    assert (one.waiting, one.turn(0), one.next_turn_ns()) == (0, None, None)
    assert ask(one, 1) == ""
    assert served(one, 10) == [1]


def test_another_peer_by_the_same_name_is_somebody_else() -> None:
    one = hub()
    ask(one, 1)
    assert one.ask(b"route1", 999, "key2", AssetRequest(1, 2, 7, "small", 0, 1), 0) == ""
    assert served(one, 10) == [2]


def test_refusals_wait_behind_chunks_and_are_bounded() -> None:
    one = hub()
    assert not one.refuse(b"route1", 1, "", AssetRefusal.UNKNOWN)
    ask(one, 1)
    assert one.queues(b"route1")
    kept = [one.refuse(b"route1", i, "", AssetRefusal.UNKNOWN) for i in range(MAX_QUEUED + 5)]
    assert kept.count(True) == MAX_QUEUED - 1
    reader = one.turn(0)
    assert reader is not None
    assert [wanted.refused for wanted in reader.queue] == ["", *[AssetRefusal.UNKNOWN] * (MAX_QUEUED - 1)]
    assert len(served(one, 1000)) == MAX_QUEUED


def test_whatever_happens_turns_and_windows_stay_in_step() -> None:
    rng = Random(5)
    one = hub(4)
    for now_ns in range(5000):
        who = rng.randrange(1, 6)
        match rng.randrange(6):
            case 0 | 1 | 2:
                ask(one, who, rng.choice(list(SIZES)), 0, rng.randrange(0, MIB), now_ns)
            case 3:
                reader = one.turn(now_ns)
                if reader is not None:
                    one.sent(reader) if rng.random() < 0.5 else one.full(reader, now_ns)
            case 4:
                one.left(100 + who) if rng.random() < 0.1 else one.refuse(b"route%d" % who, 1, "", "busy")
            case _:
                one.allow({n: f"key{n}" for n in range(1, 5) if rng.random() < 0.95})
        waiting = [reader for reader in one._readers.values() if reader.queue]
        assert set(map(id, waiting)) == set(map(id, one._ring))
        assert len(one._ring) == len(waiting)
        for reader in waiting:
            assert reader.queued_bytes == sum(wanted.length for wanted in reader.queue) <= MAX_ASSET_WINDOW_BYTES


def test_one_connection_that_asks_for_several_participants_loses_nothing_and_gains_nothing() -> None:
    """As that of a gateway. Each request is answered, in their order, and the limits are those of one connection."""
    one = AssetHub(SIZES.get)
    one.allow({1: "gateway", 2: "gateway", 3: "gateway"})
    asked = [1, 1, 2, 3, 2, 1]
    for request_id, number in enumerate(asked):
        request = AssetRequest(1, number, request_id, "small", 0, 10)
        assert one.ask(b"route", 100, "gateway", request, 0) == ""
    answered = []
    while (reader := one.turn(0)) is not None:
        answered.append(reader.queue[0].request_id)
        one.sent(reader)
    assert answered == list(range(len(asked)))
    refused = Counter(
        one.ask(b"route", 100, "gateway", AssetRequest(1, 1 + n % 3, n, "nothing", 0, 10), 0)
        for n in range(REQUEST_BURST)
    )
    assert refused[AssetRefusal.RATE] == len(asked), "another name is no other allowance"
