"""`bench web`: rate and age of the rigid state at browsers behind the web gateway, beside a client without it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np
import psutil

from iris_session.bench.clients import ClientJob
from iris_session.bench.harness import BenchRun, Log, group_clients, measure
from iris_session.bench.report import BenchError, BenchReport, make_bar
from iris_session.demo.scenes import free_bodies_scene
from iris_session.system.extras import require_package

HZ: Final = 60.0
#: Bar of the age of state at a browser [ms].
MAX_AGE_MS: Final = 15.0
REFERENCE: Final = "zeromq"
_CPU_END_S: Final = 0.1  # before the end of the window


def run_web(
    clients: int = 8,
    bodies: int = 300,
    seconds: float = 20.0,
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Publish free bodies in motion without contact to observers behind the web gateway.

    Args:
        clients: Number of browsers.
        bodies: Number of moving bodies.
        seconds: Length of the measured window.
        seed: Random seed.
        progress: Called with short texts.

    Returns:
        The report. Reference: one ZeroMQ client in the same session.
    """
    for package in ("aiohttp", "cryptography"):
        require_package(package, "bench web")
    browsers = [ClientJob(f"browser{i}", "observer") for i in range(clients)]
    meter = _GatewayMeter()
    got = measure(
        free_bodies_scene(bodies, seed).compile(),
        group_clients([ClientJob(REFERENCE, "observer")]),
        seconds,
        browsers=group_clients(browsers),
        actions=[(0.0, meter.read), (max(0.0, seconds - _CPU_END_S), meter.read)],
        progress=progress,
    )
    logs = [got.logs[spec.name] for spec in browsers]
    if any(not len(log["ticks"]) for log in [*logs, got.logs[REFERENCE]]):
        raise BenchError("a client received no state in the measured window")
    rates = [compute_rate(log, got.seconds) for log in logs]
    age_p99s = [float(np.percentile(compute_ages(log), 99)) for log in logs]
    results: dict[str, Any] = {
        "delivered_hz_min": min(rates),
        "delivered_hz_max": max(rates),
        **summarize_ages(logs),
        "age_ms_p99_best": round(min(age_p99s), 3),
        "age_ms_p99_worst": round(max(age_p99s), 3),
        "gateway_cpu_share": round(meter.cpu_share, 3),
        "server_cpu_share": round(got.cpu_share, 3),
        "late_tick_share": round(got.stats.late_share, 6),
        "lateness_ms_p99": round(got.stats.p99_ns * 1e-6, 3),
        "ticks": got.stats.ticks,
        "frames_not_logged": sum(int(log["counts"][1]) for log in logs),
        "scheduling": got.scheduling,
        "drops": got.drops,
    }
    reference = got.logs[REFERENCE]
    measured = {"delivered_hz_min": compute_rate(reference, got.seconds), **summarize_ages([reference])}
    bars = (
        make_bar(results, "delivered_hz_min", ">=", HZ - 1.0),
        make_bar(results, "age_ms_p99", "<=", MAX_AGE_MS),
    )
    params = {"clients": clients, "bodies": bodies, "seconds": seconds, "seed": seed, "hz": int(HZ)}
    return BenchReport("web", params, results, bars, {f"{REFERENCE}_{key}": value for key, value in measured.items()})


def compute_ages(log: Log) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the ages of all states when they were decoded [ms]."""
    ages: np.ndarray[Any, np.dtype[np.float64]] = (log["handed_ns"] - log["state_ns"]) * 1e-6
    return ages


def compute_rate(log: Log, seconds: float) -> float:
    """Return the states per second in a window of `seconds`."""
    return round(len(log["ticks"]) / seconds, 2)


def summarize_ages(logs: list[Log]) -> dict[str, float]:
    """Return percentiles of the ages at all clients of `logs` [ms]."""
    ages = np.concatenate([compute_ages(log) for log in logs])
    return {f"age_ms_p{p}": round(float(np.percentile(ages, p)), 3) for p in (50, 95, 99)}


class _GatewayMeter:
    """Processor time of the gateway between two readings, as a share of one core."""

    def __init__(self) -> None:
        self._readings: list[tuple[float, float]] = []

    def read(self, run: BenchRun) -> None:
        """Take a reading."""
        page = run.session.processes.web
        if page is not None and page.pid:
            times = psutil.Process(page.pid).cpu_times()
            self._readings.append((time.monotonic(), times.user + times.system))

    @property
    def cpu_share(self) -> float:
        """Share between the first and the last reading, 0 without two of one process."""
        if len(self._readings) < 2:
            return 0.0
        (begin_s, before), (end_s, after) = self._readings[0], self._readings[-1]
        return max(0.0, (after - before) / (end_s - begin_s))
