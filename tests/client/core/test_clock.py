"""Clock synchronisation against a simulated network: error within the stated bound, monotonic, slewed."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.client.core.clock import BURST, JUMP, LARGE_NS, SLEW, ClockSync

SECOND = 1_000_000_000
OFFSET = 5 * SECOND  # session time - local time


def exchange(
    clock: ClockSync, local_ns: int, out_ns: int, back_ns: int, offset_ns: int = OFFSET, held_ns: int = 0
) -> int:
    """Run one exchange that starts at `local_ns`; return the local time of its end."""
    t1 = local_ns + out_ns + offset_ns
    end = local_ns + out_ns + held_ns + back_ns
    clock.process_pong(local_ns, t1, t1 + held_ns, end)
    return end


@given(
    seed=st.integers(0, 2**32 - 1),
    drift=st.floats(-90e-6, 90e-6),
    delay_ms=st.floats(0.05, 40.0),
    offset=st.integers(-(10**15), 10**15),
)
@settings(max_examples=60, deadline=None)
def test_error_stays_within_the_stated_bound(seed: int, drift: float, delay_ms: float, offset: int) -> None:
    rng = np.random.default_rng(seed)
    clock = ClockSync()
    local, last = 0, None
    for _ in range(80):
        out, back = (int(1e6 * (delay_ms + rng.exponential(delay_ms))) for _ in range(2))
        true_offset = offset + int(drift * local)
        local = exchange(clock, local, out, back, true_offset) + int(rng.uniform(0.0, 1.0) * SECOND)
        for ahead in (0, SECOND // 3):
            error = abs(clock.session_ns(local + ahead) - (local + ahead + offset + int(drift * (local + ahead))))
            assert error <= clock.error_bound_ns(local + ahead) + 5
        now = clock.session_ns(local)
        assert last is None or now >= last
        last = now


def test_start_on_a_busy_link_does_not_leave_samples_in_the_future_for_seconds() -> None:
    """An uplink with a 40 ms queue puts our stamps 20 ms ahead; after it drains they must fit within 5 ms."""
    clock = ClockSync()
    local = 0
    for _ in range(BURST):
        local = exchange(clock, local, 40_000_000, 0)
    local = exchange(clock, local, 0, 0)

    def ahead(after_ns: int) -> int:
        return clock.session_ns(local + after_ns) - (local + after_ns + OFFSET)

    assert ahead(0) == pytest.approx(20_000_000, abs=10)
    assert ahead(SECOND // 10) == pytest.approx(10_000_000, abs=10)
    assert ahead(SECOND * 3 // 20) == pytest.approx(LARGE_NS, abs=10)
    assert ahead(SECOND // 4) == pytest.approx(LARGE_NS - SLEW * SECOND / 10, abs=10)
    assert ahead(SECOND) == pytest.approx(0, abs=10)


@pytest.mark.parametrize("stamps", [(10, 5, 5, 9), (0, 10, 5, 20), (0, 0, 30, 20)])
def test_impossible_exchanges_are_counted_and_ignored(stamps: tuple[int, int, int, int]) -> None:
    clock = ClockSync()
    clock.process_pong(*stamps)
    assert clock.rejected == 1
    assert not clock.synced


def test_pings_start_as_a_burst_then_slow_down() -> None:
    clock = ClockSync()
    sent = [t for t in range(0, 3 * SECOND, 1_000_000) if clock.poll_ping(t)]
    assert sum(t < SECOND // 4 for t in sent) == BURST
    assert 4 <= sum(t >= SECOND // 4 for t in sent) <= 7
    clock.reset()
    assert clock.poll_ping(0)


def synchronise(clock: ClockSync, local_ns: int = 0) -> int:
    for _ in range(16):
        local_ns = exchange(clock, local_ns, 300_000, 300_000) + SECOND // 2
    return local_ns


def test_suspended_machine_is_synchronised_after_four_exchanges() -> None:
    clock = ClockSync()
    local = synchronise(clock)
    slept = 3600 * SECOND  # our clock stopped, the session's continued
    for i in range(JUMP):
        assert abs(clock.session_ns(local) - local - OFFSET) < 1_000_000, "a single outlier changes nothing"
        local = exchange(clock, local, 300_000, 300_000, OFFSET + slept)
        truth = local + OFFSET + slept
        assert abs(clock.session_ns(local) - truth) <= clock.error_bound_ns(local), "the bound is honest throughout"
        assert i == JUMP - 1 or clock.poll_ping(local), "found out quickly"
    assert abs(clock.session_ns(local) - local - OFFSET - slept) < 1_000_000
    assert clock.error_bound_ns(local) < 1_000_000
