"""Hellos of one source use up nobody else's, and memory of sources is bounded."""

from __future__ import annotations

from iris_session.front.shares import MAX_SOURCES, HelloShares, connections_of_one
from iris_session.link.config import SECOND, FrontLimits

LIMITS = FrontLimits(hellos_per_second=10.0, hello_burst=20, hellos_per_source=1.0, hello_source_burst=4)


def taken(shares: HelloShares, source: str, now_ns: int, n: int = 1000) -> int:
    return sum(shares.take(source, now_ns) for _ in range(n))


def test_a_newcomer_gets_in_whatever_another_does() -> None:
    shares = HelloShares(LIMITS)
    assert taken(shares, "flood", SECOND) == 24
    assert taken(shares, "ann", SECOND) == 4
    assert taken(shares, "bob", SECOND, 2) == 2
    assert taken(shares, "flood", 2 * SECOND) == 11
    assert taken(shares, "ann", 2 * SECOND) == 1


def test_one_key_of_many_clients_has_what_nobody_else_uses() -> None:
    assert taken(HelloShares(FrontLimits()), "lab", SECOND, 64) == 64


def test_sources_are_bounded_and_the_newest_kept() -> None:
    shares = HelloShares(LIMITS)
    taken(shares, "first", SECOND)
    for number in range(MAX_SOURCES):
        shares.take(f"key{number}", SECOND)
    assert len(shares._own) == MAX_SOURCES
    assert taken(shares, f"key{MAX_SOURCES - 1}", SECOND) == 3


def test_one_key_leaves_connections_to_others() -> None:
    assert [connections_of_one(n) for n in (1, 2, 4, 64)] == [1, 2, 3, 48]
