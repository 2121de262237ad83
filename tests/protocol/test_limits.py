"""Limits of every message, token buckets, drop counters."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from iris_session.protocol import codec
from iris_session.protocol.client_messages import Hello, Sample
from iris_session.protocol.limits import LIMITS, SERVER_LIMITS, Drops, KeyedBuckets, Limit, RateLimiter, find_network

SECOND = 1_000_000_000


def test_every_message_has_limits() -> None:
    assert set(LIMITS) == set(codec.CLIENT_TYPES.values())
    assert set(SERVER_LIMITS) == set(codec.SERVER_TYPES.values())
    assert all(limit.max_bytes > 0 and limit.per_second > 0 and limit.burst > 0 for limit in LIMITS.values())


def test_burst_then_rate() -> None:
    limiter = RateLimiter({Sample: Limit(1, per_second=10, burst=5)})
    assert [limiter.allow(Sample, 0) for _ in range(7)] == [True] * 5 + [False] * 2
    assert not limiter.allow(Sample, SECOND // 10 - 1)
    assert limiter.allow(Sample, SECOND // 10)
    assert not limiter.allow(Sample, SECOND // 10)
    assert [limiter.allow(Sample, 100 * SECOND) for _ in range(6)] == [True] * 5 + [False]


def test_backward_time_adds_no_tokens() -> None:
    limiter = RateLimiter({Hello: Limit(1, per_second=1, burst=1)})
    assert limiter.allow(Hello, 10 * SECOND)
    assert not limiter.allow(Hello, 0)
    assert not limiter.allow(Hello, 10 * SECOND)
    assert limiter.allow(Hello, 11 * SECOND)


def test_buckets_are_of_one_key() -> None:
    buckets = KeyedBuckets(10.0, 3, max_keys=2)
    assert [buckets.take("a", 0) for _ in range(4)] == [True, True, True, False]
    assert buckets.take("b", 0, 3)
    assert not buckets.take("b", 0)
    assert buckets.take("a", SECOND // 10)
    assert not buckets.take("a", SECOND // 10)


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("::ffff:10.0.0.1", "10.0.0.1"),
        ("2001:db8:0:1:2::3", "2001:db8:0:1::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("", ""),
    ],
)
def test_ipv6_addresses_of_one_network_count_as_one(address: str, network: str) -> None:
    assert find_network(address) == network


def test_factor_is_of_rate_and_burst() -> None:
    buckets = KeyedBuckets(10.0, 3, max_keys=2)
    assert buckets.take("a", 0, 6, factor=2)
    assert buckets.take("a", SECOND // 10, 2, factor=2)
    assert not buckets.take("a", SECOND // 10, factor=2)


def test_key_that_was_not_used_for_longest_is_forgotten() -> None:
    buckets = KeyedBuckets(10.0, 1, max_keys=2)
    assert [buckets.take(key, 0) for key in "abac"] == [True, True, False, True]
    assert not buckets.take("a", 0)
    assert buckets.take("b", 0)


@given(st.lists(st.integers(0, SECOND // 50), max_size=300), st.integers(1, 200), st.integers(1, 20))
def test_accepted_messages_never_exceed_rate_and_burst(gaps: list[int], per_second: int, burst: int) -> None:
    limiter = RateLimiter({Sample: Limit(1, per_second=per_second, burst=burst)})
    now = passed = 0
    for gap in gaps:
        now += gap
        passed += limiter.allow(Sample, now)
    assert passed <= burst + now * per_second / SECOND


def test_drops_are_counted_by_reason_and_connection() -> None:
    drops = Drops()
    drops.count("rate", 3)
    drops.count("rate", 3, n=2)
    drops.count("unknown_key")
    assert drops.by_reason == {"rate": 3, "unknown_key": 1}
    assert drops.by_connection == {3: 3}
    assert drops.version == 3
    drops.remove(3)
    assert drops.by_connection == {}
    assert Drops().by_reason == {}
