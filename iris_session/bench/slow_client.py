"""`bench slow-client`: one client stalls for three seconds; measure its recovery, and the effect on the others.

Three kinds of intervals alternate, three times each: `baseline` (no stall), `stopped` (the process of a client is
stopped, SIGSTOP), `stalled` (the link of another client passes nothing). Below 41 s there are fewer rounds.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

from iris_session.bench.clients import ClientJob
from iris_session.bench.harness import (
    BASELINE,
    CLIENTS_PER_PROCESS,
    SHORTEST_STALL_S,
    STALL_S,
    Interval,
    compute_age_p99_ms,
    measure,
    plan_rounds,
    plan_stalls,
    stall_link,
    stop_client,
    summarize_runs,
    summarize_stalls,
)
from iris_session.bench.report import BenchReport, allow_increase, make_bar
from iris_session.demo.scenes import free_bodies_scene

ROUNDS: Final = 3
STOPPED, STALLED = "stopped", "stalled"
#: IRIS SimPublisher 2.2 on a machine of this kind, plain: DESIGN of the project, measured.
REFERENCE: Final = {"resume_first_age_ms": 2980.0, "resume_fresh_after_ms": 4400.0}


def run_slow_client(
    clients: int = 16,
    bodies: int = 300,
    seconds: float = 50.0,
    seed: int = 0,
    curve: bool = False,
    profile: str = "",
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Stall two of the clients in turn."""
    model = free_bodies_scene(bodies, seed).compile()
    specs = [
        ClientJob(f"client{i}", "observer", samples=i < CLIENTS_PER_PROCESS, profile=profile)
        for i in range(clients - 2)
    ]
    stopped = ClientJob(STOPPED, "observer", profile=profile, alone=True)
    stalled = ClientJob(STALLED, "observer", profile=profile or "none", alone=True)
    plan = plan_rounds(dict.fromkeys((BASELINE, STOPPED, STALLED), SHORTEST_STALL_S), seconds, ROUNDS)
    total_s = plan[-1].end_s
    resumed: dict[Interval, int] = {}  # session time [ns] at which the stall ended
    actions = plan_stalls(plan, {STOPPED: stop_client(STOPPED), STALLED: stall_link(STALLED)}, resumed)
    every = [*specs, stopped, stalled]
    got = measure(model, every, total_s, seed=seed, actions=actions, curve=curve, progress=progress)
    results: dict[str, Any] = {}
    for kind, prefix in ((STOPPED, ""), (STALLED, "link_")):
        results |= summarize_stalls(got.logs[kind], got.begin_ns, resumed, kind, prefix)
    others = [got.logs[spec.name] for spec in specs]
    for kind, key in ((STOPPED, ""), (STALLED, "_link"), (BASELINE, "_baseline")):
        stretches = [one for one in plan if one.kind == kind]
        p99s = [compute_age_p99_ms(others, got.begin_ns, one.stall_s, one.end_s) for one in stretches]
        results |= summarize_runs(f"others_age_ms_p99{key}", p99s)
    results |= got.summarize("late_tick_share", "scheduling", "drops")
    params = {"seconds": total_s, "stall_s": STALL_S, "rounds": len(plan) // 3}
    return BenchReport(results, _make_bars(results), REFERENCE, params)


def _make_bars(results: dict[str, Any]) -> list[Any]:
    bound = allow_increase(results["others_age_ms_p99_baseline"])
    keys = ("resume_first_age_ms", "resume_fresh_after_ms", "link_resume_first_age_ms", "link_resume_fresh_after_ms")
    bars = [make_bar(results, key, "<=", 100.0) for key in keys]
    return [*bars, *(make_bar(results, key, "<=", bound) for key in ("others_age_ms_p99", "others_age_ms_p99_link"))]
