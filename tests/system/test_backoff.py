"""Back-off: delays grow to their limit and restart after a success."""

from __future__ import annotations

from iris_session.system.backoff import Backoff


def test_last_delay_repeats_until_reset() -> None:
    backoff = Backoff((0, 5, 20))
    assert [backoff.next_delay() for _ in range(4)] == [0, 5, 20, 20]
    assert backoff.failures == 4
    backoff.reset()
    assert backoff.next_delay() == 0
