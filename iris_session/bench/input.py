"""`bench input`: time from the receipt of a sample to the first state frame at its sender that shows it applied."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from iris_session.bench.baseline import measure_baseline
from iris_session.bench.clients import ClientJob, make_operators
from iris_session.bench.harness import Measurement, measure
from iris_session.bench.report import BenchReport, make_bar, summarize_percentiles
from iris_session.bench.state import SESSION_KEYS
from iris_session.demo.scenes import n_arms_scene
from iris_session.demo.scenes.generators import arm_names
from iris_session.protocol.names import Device


def run_input(
    operators: int = 8,
    robots: int = 8,
    observers: int = 8,
    seconds: float = 20.0,
    curve: bool = False,
    profile: str = "",
    seed: int = 0,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Drive arms with operators while observers watch, at 500 Hz physics.

    Reference: `measure_baseline`.
    """
    model = n_arms_scene(robots).compile()
    specs = make_operators(arm_names(robots)[:operators], profile)
    specs += [ClientJob(f"observer{i}", "observer", profile=profile) for i in range(observers)]
    progress("measuring the baseline of the machine: an empty loop that publishes to as many receivers")
    reference = None if profile else measure_baseline(operators + observers)
    got = measure(model, specs, seconds, seed=seed, curve=curve, progress=progress)
    responses = compute_response_ms(got, [spec.name for spec in specs if spec.robot])
    tick_ms = model.opt.timestep * 1e3
    received = sum(map(len, got.received.values()))
    results: dict[str, Any] = {
        **summarize_percentiles("response_ms", responses),
        "samples_followed": len(responses),
        "samples_per_s": round(received / got.seconds, 1),
        "rejected": got.rejected,
        **got.summarize(*SESSION_KEYS),
    }
    bound = 2.0 * tick_ms + 1e3 / 60.0 + (6.0 if curve else 3.0)  # two ticks, a period of the state, the bar of its age
    bars = [
        make_bar(results, "response_ms_p99", "<=", round(bound, 3)),
        make_bar(results, "late_tick_share", "<", 0.001),
        make_bar(results, "samples_per_s", ">=", 0.98 * 3 * 72.0 * operators),
        make_bar(results, "samples_followed", ">=", 0.95 * 72.0 * operators * (seconds - 1.0)),
    ]
    return BenchReport(results, bars, reference)


def compute_response_ms(got: Measurement, names: list[str]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return the response time of every sample of a driving device [ms].

    It is the delivery time of the first frame whose `applied` has this sample or a newer one, minus the receipt of the
    sample. Samples of the last half second are excluded: their frame may come after the window.
    """
    out: list[np.ndarray[Any, np.dtype[np.float64]]] = []
    for name in names:
        log = got.logs[name]
        samples = got.received.get((got.connections[name], Device.CONTROLLER_RIGHT), [])
        if not samples or not len(log["handed_ns"]):
            continue
        table = np.array(samples, np.int64)
        end_ns = int(log["handed_ns"][-1])
        table = table[(table[:, 1] >= log["handed_ns"][0]) & (table[:, 1] < end_ns - 500_000_000)]
        first = np.searchsorted(np.maximum.accumulate(log["applied_seq"]), table[:, 0])
        shown = first < len(log["handed_ns"])
        out.append((log["handed_ns"][first[shown]] - table[shown, 1]) * 1e-6)
    return np.concatenate(out) if out else np.zeros(0)
