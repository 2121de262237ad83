"""`bench slow-client`: one client stalls for three seconds; measure its recovery, and the effect on the others.

Three kinds of intervals alternate, three times each: `baseline` (no stall), `stopped` (the process of a client is
stopped, SIGSTOP), `stalled` (the link of another client passes nothing). Below 41 s there are fewer rounds.
"""

from __future__ import annotations

import signal
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from iris_session.bench.clients import ClientJob
from iris_session.bench.harness import CLIENTS_PER_PROCESS, Action, BenchRun, Log, assign_links, group_clients, measure
from iris_session.bench.report import NO_BARS, BenchReport, compute_percentile, make_bar
from iris_session.demo.scenes import free_bodies_scene
from iris_session.netsim.process import make_link_address

ROUNDS: Final = 3
STALL_S: Final = 3.0
LEAD_S: Final = 0.5  # from the beginning of an interval to the stall
#: Shortest interval: the lead, the stall, and a second to recover.
SHORTEST_S: Final = LEAD_S + STALL_S + 1.0
#: A frame is fresh if it is at most this much older than the median of the client before the stall.
FRESH_MS: Final = 20.0
STOPPED, STALLED, BASELINE = "stopped", "stalled", "baseline"
#: IRIS SimPublisher 2.2 on a machine of this kind, plain: DESIGN of the project, measured.
REFERENCE: Final = {"resume_first_age_ms": 2980.0, "resume_fresh_after_ms": 4400.0}


class StallInterval(NamedTuple):
    """One interval of the window, in seconds from the beginning of the window."""

    kind: str
    begin_s: float
    end_s: float

    @property
    def stall_s(self) -> float:
        return self.begin_s + LEAD_S

    @property
    def resume_s(self) -> float:
        return self.stall_s + STALL_S


def plan_intervals(seconds: float) -> list[StallInterval]:
    """Return rounds of baseline, stopped and stalled: as many as fit, at most `ROUNDS`."""
    rounds = max(1, min(ROUNDS, int(seconds / (3 * SHORTEST_S))))
    length_s = max(SHORTEST_S, seconds / (3 * rounds))
    kinds = (BASELINE, STOPPED, STALLED) * rounds
    return [StallInterval(kind, i * length_s, (i + 1) * length_s) for i, kind in enumerate(kinds)]


def run_slow_client(
    clients: int = 16,
    bodies: int = 300,
    seconds: float = 50.0,
    seed: int = 0,
    curve: bool = False,
    profile: str = "",
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Stall two of the clients in turn.

    Args:
        clients: Number of observers, two of which stall.
        bodies: Number of moving bodies.
        seconds: Length of the measured window.
        seed: Random seed.
        curve: Encrypt and authenticate.
        profile: Link profile of every client; bars do not apply then. Without it only the stalled client has a link,
            which forwards without delay.
        progress: Called with short texts.
    """
    model = free_bodies_scene(bodies, seed).compile()
    specs = [ClientJob(f"client{i}", "observer", samples=i < CLIENTS_PER_PROCESS) for i in range(clients - 2)]
    names = [spec.name for spec in specs]
    specs, links = assign_links([*specs, ClientJob(STOPPED, "observer"), ClientJob(STALLED, "observer")], profile)
    stalled = make_link_address(clients - 1)
    specs[-1] = msgspec.structs.replace(specs[-1], link=stalled)
    links[stalled] = profile or "none"
    groups = [*group_clients(specs[:-2]), *((spec,) for spec in specs[-2:])]
    plan = plan_intervals(seconds)
    total_s = plan[-1].end_s
    resumed: dict[StallInterval, int] = {}  # session time [ns] at which the stall ended
    actions = _plan_actions(plan, stalled, resumed)
    got = measure(model, groups, total_s, links=links, seed=seed, actions=actions, curve=curve, progress=progress)
    results: dict[str, Any] = {}
    for kind, prefix in ((STOPPED, ""), (STALLED, "link_")):
        after = [measure_after_stall(got.logs[kind], got.begin_ns, s, resumed[s]) for s in plan if s.kind == kind]
        results[f"{prefix}resume_first_age_ms"] = round(max(first for first, _ in after), 3)
        results[f"{prefix}resume_fresh_after_ms"] = round(max(fresh for _, fresh in after), 3)
    for kind, key in ((STOPPED, ""), (STALLED, "_link"), (BASELINE, "_baseline")):
        p99s = [measure_others_p99(got.logs, names, got.begin_ns, s) for s in plan if s.kind == kind]
        results[f"others_age_ms_p99{key}"] = round(float(np.median(p99s)), 3)
        results[f"others_age_ms_p99{key}_runs"] = {str(i + 1): round(p99, 3) for i, p99 in enumerate(p99s)}
    results |= {"late_tick_share": round(got.stats.late_share, 6), "scheduling": got.scheduling, "drops": got.drops}
    params: dict[str, Any] = {"clients": clients, "bodies": bodies, "seconds": total_s, "stall_s": STALL_S}
    params |= {"rounds": len(plan) // 3, "seed": seed, "curve": curve}
    if profile:
        params |= {"profile": profile, "bars": NO_BARS}
    bars = () if profile else tuple(_make_bars(results))
    return BenchReport("slow-client", params, results, bars, REFERENCE)


def measure_after_stall(log: Log, begin_ns: int, interval: StallInterval, resumed_ns: int) -> tuple[float, float]:
    """Return the age of the first frame after the stall, and the time from its end to the first fresh frame [ms].

    Infinite if no frame arrived within the interval.
    """
    handed, ages = log["handed_ns"], log["handed_ns"] - log["state_ns"]
    before = _select_between(log, begin_ns, interval.begin_s, interval.stall_s)
    usual_ns = float(np.median(ages[before])) if before.any() else 0.0
    after = (handed >= resumed_ns) & (handed < begin_ns + interval.end_s * 1e9)
    if not after.any():
        return float("inf"), float("inf")
    fresh = after & (ages <= usual_ns + FRESH_MS * 1e6)
    first_ms = float(ages[after][0]) * 1e-6
    return first_ms, float(handed[fresh][0] - resumed_ns) * 1e-6 if fresh.any() else float("inf")


def measure_others_p99(logs: dict[str, Log], names: list[str], begin_ns: int, interval: StallInterval) -> float:
    """Return the 99th percentile of the age at the clients `names` from the stall on [ms]; in a baseline interval from
    the same time on."""
    ages = [
        (log["handed_ns"] - log["state_ns"])[_select_between(log, begin_ns, interval.stall_s, interval.end_s)]
        for log in (logs[name] for name in names)
    ]
    return compute_percentile(np.concatenate(ages) * 1e-6, 99)


def _select_between(log: Log, begin_ns: int, from_s: float, to_s: float) -> NDArray[np.bool_]:
    handed = log["handed_ns"] - begin_ns
    return (handed >= from_s * 1e9) & (handed < to_s * 1e9)


def _plan_actions(plan: list[StallInterval], link: str, resumed: dict[StallInterval, int]) -> list[Action]:
    """Return the actions that begin and end stalls; their ends are stored in `resumed` [session time, ns]."""
    actions: list[Action] = []
    for interval in plan:
        if interval.kind == STOPPED:
            actions.append((interval.stall_s, lambda arena: arena.by_client[STOPPED].send_signal(signal.SIGSTOP)))
        elif interval.kind == STALLED:
            actions.append((interval.stall_s, lambda arena: _post_link_command(arena, "stall", link)))
        if interval.kind != BASELINE:
            actions.append((interval.resume_s, lambda arena, s=interval: _end_stall(arena, s, link, resumed)))  # type: ignore[misc]
    return actions


def _end_stall(arena: BenchRun, interval: StallInterval, link: str, resumed: dict[StallInterval, int]) -> None:
    resumed[interval] = arena.session.clock()
    if interval.kind == STOPPED:
        arena.by_client[STOPPED].send_signal(signal.SIGCONT)
    else:
        _post_link_command(arena, "resume", link)


def _post_link_command(arena: BenchRun, command: str, link: str) -> None:
    assert arena.proxy is not None
    arena.proxy.send(f"{command} @{link}")


def _make_bars(results: dict[str, Any]) -> list[Any]:
    baseline = results["others_age_ms_p99_baseline"]
    bound = round(baseline + max(0.2 * baseline, 1.0), 3)
    keys = ("resume_first_age_ms", "resume_fresh_after_ms", "link_resume_first_age_ms", "link_resume_fresh_after_ms")
    bars = [make_bar(results, key, "<=", 100.0) for key in keys]
    return [*bars, *(make_bar(results, key, "<=", bound) for key in ("others_age_ms_p99", "others_age_ms_p99_link"))]
