"""Baseline of the benchmarks: its loop, in simulated time."""

from __future__ import annotations

import pytest

from iris_session.bench import baseline


class Clock:
    """A time module whose time passes only while a program sleeps, or its socket sends."""

    def __init__(self) -> None:
        self.now_ns = 0

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)

    def send(self, _: bytes) -> None:
        self.sleep(0.005)


def test_frame_that_blocks_the_loop_makes_its_own_tick_late(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = Clock()
    monkeypatch.setattr(baseline, "time", clock)
    lateness = baseline._run_loop(clock, 0.2)  # type: ignore[arg-type]
    assert len(lateness) == 100
    late = [ns for ns in lateness if ns > baseline.PERIOD_NS]
    assert 12 <= len(late) <= 24, "the ticks of the twelve frames, and some after them"
