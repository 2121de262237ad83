"""Token buckets and drop counters."""

from __future__ import annotations

from iris_session.protocol.token_bucket import Drops, TokenBucket

SECOND = 1_000_000_000


def test_a_bucket_allows_its_burst_and_then_its_rate() -> None:
    bucket = TokenBucket(rate=10.0, burst=3)
    now = 5 * SECOND
    assert [bucket.take(now) for _ in range(4)] == [True, True, True, False]
    taken = sum(bucket.take(now + i * SECOND // 100) for i in range(1, 201))
    assert taken == 20


def test_a_bucket_holds_no_more_than_its_burst() -> None:
    bucket = TokenBucket(rate=1000.0, burst=2)
    assert [bucket.take(3600 * SECOND) for _ in range(3)] == [True, True, False]


def test_drops_are_counted_by_reason_and_connection() -> None:
    drops = Drops()
    drops.count("rate", 3)
    drops.count("rate", 3, n=2)
    drops.count("stranger")
    assert drops.by_reason == {"rate": 3, "stranger": 1}
    assert drops.by_connection == {3: 3}
    assert drops.version == 3
    drops.forget(3)
    assert drops.by_connection == {}
    assert Drops().by_reason == {}
