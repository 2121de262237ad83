"""Since when something is silent that came regularly: not before it could have been expected."""

from __future__ import annotations

from iris_session.session.cadence import SILENT_NS, USUAL, Cadence

MS = 1_000_000


def follow(cadence: Cadence, first_ns: int, period_ns: int, count: int) -> int:
    for i in range(count):
        cadence.came(first_ns + i * period_ns)
    return first_ns + (count - 1) * period_ns


def test_what_came_once_or_never_is_not_silent() -> None:
    cadence = Cadence()
    assert not cadence.silent_ns(3600 * SILENT_NS)
    cadence.came(0)
    assert not cadence.silent_ns(3600 * SILENT_NS)


def test_a_quick_source_is_silent_after_a_second_and_speaks_again() -> None:
    cadence = Cadence()
    last_ns = follow(cadence, 0, 16 * MS, 100)
    assert not cadence.silent_ns(last_ns + SILENT_NS)
    assert cadence.silent_ns(last_ns + SILENT_NS + MS) == SILENT_NS + MS
    cadence.came(last_ns + 300 * SILENT_NS)
    assert not cadence.silent_ns(last_ns + 300 * SILENT_NS + MS)
    again_ns = follow(cadence, last_ns + 301 * SILENT_NS, 16 * MS, 100)
    assert cadence.silent_ns(again_ns + 2 * SILENT_NS), "the long silence is not its rhythm"


def test_a_slow_source_has_its_time() -> None:
    cadence = Cadence()
    last_ns = follow(cadence, 0, 5 * SILENT_NS, 20)
    assert not cadence.silent_ns(last_ns + USUAL * 5 * SILENT_NS)
    assert cadence.silent_ns(last_ns + (USUAL * 5 + 1) * SILENT_NS)


def test_two_at_the_same_moment_are_a_rhythm_too() -> None:
    cadence = Cadence()
    cadence.came(5)
    cadence.came(5)
    assert cadence.silent_ns(5 + 2 * SILENT_NS) == 2 * SILENT_NS
