"""Back-off: delays grow to their limit, and start over after a success."""

from __future__ import annotations

from iris_session.system.backoff import Backoff, doubling_delays


def test_delays_double_up_to_the_limit() -> None:
    assert doubling_delays(100, 500) == (100, 200, 400, 500)
    assert doubling_delays(1.0, 1.0) == (1.0,)


def test_last_delay_repeats_until_reset() -> None:
    backoff = Backoff((0, 5, 20))
    assert [backoff.next_delay() for _ in range(4)] == [0, 5, 20, 20]
    assert backoff.failures == 4
    backoff.reset()
    assert backoff.next_delay() == 0
