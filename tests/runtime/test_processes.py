"""When a process that died is started again."""

from __future__ import annotations

from itertools import pairwise

from iris_session.runtime.processes import HEALTHY_NS, RESTART_BACKOFF_NS, _Watch

MS = 1_000_000


def _restarts(watch: _Watch, start_ns: int, until_ns: int) -> list[int]:
    """Times at which a process that dies at once is started again."""
    return [now for now in range(start_ns, until_ns, 50 * MS) if watch.dead(now)]


def test_the_first_restart_is_at_once_and_later_ones_wait_longer() -> None:
    watch = _Watch()
    times = _restarts(watch, 60_000 * MS, 90_000 * MS)
    waits = [b - a for a, b in pairwise(times)]
    assert times[0] == 60_000 * MS
    for wait, backoff in zip(waits, (*RESTART_BACKOFF_NS[1:], *[RESTART_BACKOFF_NS[-1]] * 10), strict=False):
        assert backoff <= wait <= backoff + 100 * MS
    assert watch.restarts == len(times)


def test_a_process_that_lived_long_is_started_at_once_again() -> None:
    watch = _Watch()
    now_ns = 60_000 * MS
    for _ in range(3):
        while not watch.dead(now_ns):
            now_ns += 50 * MS
    assert watch.failures == 3
    assert watch.dead(now_ns + HEALTHY_NS + 50 * MS)
    assert watch.failures == 1
