"""`bench state`: age, accuracy and size of the rigid state when a client's application receives it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from iris_session.bench.baseline import measure_baseline
from iris_session.bench.clients import ClientJob
from iris_session.bench.harness import (
    WARM_UP_S,
    Measurement,
    compute_ages_ms,
    measure,
)
from iris_session.bench.report import BenchError, BenchReport, make_bar, summarize_percentiles
from iris_session.demo.scenes import free_bodies_scene

#: The bar applies under input: this many of the clients send 3 devices x 72 Hz of samples.
SENDERS = 8
SESSION_KEYS = (
    *("server_cpu_share", "late_tick_share", "lateness_ms_p99", "ticks", "frames_not_logged", "late_causes"),
    *("scheduling", "drops"),
)


def run_state(
    clients: int = 16,
    bodies: int = 300,
    seconds: float = 20.0,
    seed: int = 0,
    curve: bool = False,
    profile: str = "",
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Publish free bodies in motion without contact to observers, at 60 Hz.

    Reference: `measure_baseline`.
    """
    model = free_bodies_scene(bodies, seed).compile()
    specs = [ClientJob(f"client{i}", "observer", samples=i < SENDERS, profile=profile) for i in range(clients)]
    progress("measuring the baseline of the machine: an empty loop that publishes to as many receivers")
    reference = None if profile else measure_baseline(clients)
    got = measure(model, specs, seconds, seed=seed, keep_poses=True, curve=curve, progress=progress)
    progress("comparing every delivered frame with the state at its tick")
    logs = list(got.logs.values())
    ages = compute_ages_ms(logs)
    if not len(ages):
        raise BenchError("no client received state: increase --seconds")
    position_mm, rotation_deg = compute_errors(got)
    samples, _, _, messages, total = np.sum([log["counts"] for log in logs], axis=0).tolist()
    inside = np.concatenate([(log["published_ns"] - log["state_ns"]) * 1e-6 for log in logs])
    results: dict[str, Any] = {
        "delivered_hz_min": round(min(len(log["ticks"]) for log in logs) / got.seconds, 2),
        **summarize_percentiles("age_ms", ages, (50, 95, 99)),
        **summarize_percentiles("age_at_publish_ms", inside),
        "bytes_per_frame": round(total / messages, 1),
        "bytes_per_body": round(total / messages / bodies, 2),
        "max_position_error_mm": round(position_mm, 5),
        "max_rotation_error_deg": round(rotation_deg, 5),
        "client_cpu_share": round(float(np.mean([log["cpu_share"][0] for log in logs])), 4),
        "samples_per_s": round(samples / (got.seconds + WARM_UP_S), 1),
        **got.summarize(*SESSION_KEYS),
    }
    bars = [
        make_bar(results, "age_ms_p99", "<=", 6.0 if curve else 3.0),
        make_bar(results, "late_tick_share", "<", 0.001),
        make_bar(results, "max_position_error_mm", "<=", 0.1),
        make_bar(results, "max_rotation_error_deg", "<=", 0.05),
        make_bar(results, "bytes_per_frame", "<=", 200.0 + 12.0 * bodies),  # 3,800 for 300 bodies
        make_bar(results, "delivered_hz_min", ">=", 59.0),
    ]
    return BenchReport(results, bars, reference, {"hz": 60})


def compute_errors(got: Measurement) -> tuple[float, float]:
    """Return the largest position [mm] and rotation [deg] error of all bodies in all delivered frames."""
    frames = [pair for log in got.logs.values() for pair in zip(log["ticks"].tolist(), log["poses"], strict=True)]
    errors = [compute_pose_errors(poses, got.truth[tick]) for tick, poses in frames]
    position_mm, rotation_deg = np.max(errors, axis=0).tolist()
    return position_mm, rotation_deg


def compute_pose_errors(poses: NDArray[np.float64], truth: NDArray[np.float64]) -> tuple[float, float]:
    """Return the largest position [mm] and rotation [deg] error of poses (n, 7). The chord is exact near zero."""
    a, b = poses[:, 3:], truth[:, 3:]
    chord = np.minimum(np.linalg.norm(a - b, axis=1), np.linalg.norm(a + b, axis=1)).max()
    position_m = np.linalg.norm(poses[:, :3] - truth[:, :3], axis=1).max()
    return float(position_m) * 1e3, float(np.degrees(4.0 * np.arcsin(min(chord / 2.0, 1.0))))
