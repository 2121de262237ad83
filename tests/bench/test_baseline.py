"""Baseline of the benchmarks: receivers in other processes, and their failures."""

from __future__ import annotations

import subprocess
import sys

import pytest

from iris_session.bench import baseline as room
from iris_session.bench.baseline import measure_baseline
from iris_session.bench.report import BenchError


def test_every_receiver_is_measured_and_ended() -> None:
    found = measure_baseline(5, seconds=1.5)
    assert 0.0 < found["bare_age_ms_p50"] <= found["bare_age_ms_p99"]
    assert 0.0 <= found["bare_late_tick_share"] <= 1.0
    assert found["bare_lateness_ms_p99"] > 0.0


def test_blocked_loop_is_late() -> None:
    class SlowSocket:
        """A socket that takes 5 ms for every frame."""

        def send(self, _: bytes) -> None:
            room.time.sleep(0.005)

    lateness = room._run_loop(SlowSocket(), 0.2)  # type: ignore[arg-type]
    assert sum(ns > room.PERIOD_NS for ns in lateness) >= 8  # each of about 12 frames delays its own tick


def test_failed_receiver_is_named() -> None:
    dead = subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"], stdout=subprocess.PIPE)
    with pytest.raises(BenchError, match="failed with status 3"):
        room._read_ages(dead)
