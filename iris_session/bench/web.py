"""`bench web`: browsers behind the web gateway, one of them a tab of a real Chromium, beside a client without gateway.

Three kinds of intervals alternate, three times each: `baseline`, `frozen` (the process of one browser is stopped for
three seconds, SIGSTOP) and `loading` (the same browser fetches 200 MB of assets). In the last seconds of the window the
tab presses the e-stop. Without Chromium, or with `tab=False`, all browsers are without a picture.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np

from iris_session.bench.clients import BROWSERS, TABS, ClientJob
from iris_session.bench.harness import (
    BASELINE,
    SHORTEST_STALL_S,
    Interval,
    Log,
    Measurement,
    compute_age_p99_ms,
    compute_ages_ms,
    measure,
    plan_rounds,
    plan_stalls,
    stop_client,
    summarize_runs,
    summarize_stalls,
)
from iris_session.bench.report import (
    Bar,
    BenchError,
    BenchReport,
    allow_increase,
    compute_percentile,
    make_bar,
    summarize_percentiles,
)
from iris_session.bench.web_tab import STOPS_S, MissingToolError, find_tools
from iris_session.demo.scenes.aloha import aloha_scene
from iris_session.system.extras import require_package

PERCENTILES: Final = (50, 95, 99)
#: Shortest window after which the heap has a bar [s].
FLAT_S: Final = 300.0
ROUNDS: Final = 3
FROZEN, LOADING = "frozen", "loading"
#: Shortest lengths of the intervals [s].
LENGTHS_S: Final = {BASELINE: SHORTEST_STALL_S, FROZEN: SHORTEST_STALL_S, LOADING: 10.0}
REFERENCE, TAB, SPECIAL = "zeromq", "tab", "special"
#: The scene: the ALOHA stations in free motion, and a sheet of vertices that swings above them. What it moves is what a
#: page has to draw; its physics costs little, so that it is not what is measured. Speed of the hinges at the beginning
#: [rad/s], and of the sheet.
_SPEED: Final = 0.3
_SHEET_SPEED: Final = 0.8
_STIFF: Final = 1000.0  # N s/m
_SHEET_M: Final = 0.6  # edge
_SHEET: Final = """
<mujoco>
  <worldbody>
    <body name="swing">
      <inertial pos="0 0 0" mass="1" diaginertia="0.1 0.1 0.1"/>
      <joint name="swing" axis="0 1 0"/>
      <flexcomp name="sheet" type="grid" dim="2" count="{side} {side} 1" spacing="{step} {step} {step}" radius="0.002"
                mass="1" rigid="true" rgba="0.2 0.5 0.8 1">
        <contact contype="0" conaffinity="0" selfcollide="none"/>
      </flexcomp>
    </body>
  </worldbody>
</mujoco>
"""


def run_web(
    clients: int = 8,
    vertices: int = 10_000,
    seconds: float = 65.0,
    seed: int = 0,
    curve: bool = False,
    tab: bool = True,
    progress: Callable[[str], None] = lambda _: None,
) -> BenchReport:
    """Show the ALOHA stations and a sheet of vertices in motion to observers behind the web gateway.

    Reference: one ZeroMQ client in the same session.
    """
    for package in ("aiohttp", "cryptography"):
        require_package(package, "bench web")
    if math.isqrt(vertices) ** 2 != vertices:
        raise BenchError(f"--vertices {vertices}: the sheet is square, choose {math.isqrt(vertices) ** 2}")
    missing = "" if tab else "not asked for"
    if tab:
        try:
            find_tools()
        except MissingToolError as error:
            missing = str(error)
    if missing:
        progress(f"no tab of a real browser: {missing}")
    plan = plan_rounds(LENGTHS_S, seconds - STOPS_S, ROUNDS)
    total_s = max(seconds, plan[-1].end_s + STOPS_S)
    names = [f"browser{i}" for i in range(clients - (1 if missing else 2))]
    loads_s = tuple(one.stall_s for one in plan if one.kind == LOADING)
    every = [
        ClientJob(REFERENCE, "observer"),
        *(ClientJob(name, "observer", plugin=BROWSERS) for name in names),
        ClientJob(SPECIAL, "observer", plugin=BROWSERS, alone=True, loads_s=loads_s),
    ]
    if not missing:
        every.append(ClientJob(TAB, "director", plugin=TABS))
    resumed: dict[Interval, int] = {}
    got = measure(
        make_web_model(vertices, seed),
        every,
        total_s,
        actions=plan_stalls(plan, {FROZEN: stop_client(SPECIAL)}, resumed),
        curve=curve,
        assets=True,
        progress=progress,
    )
    if any(not len(got.logs[name]["ticks"]) for name in [*names, REFERENCE]):
        raise BenchError("a client received no state in the measured window")
    results = summarize_browsers(got, names, plan, resumed)
    if not missing:
        results |= summarize_tab(got.logs[TAB], got.stops)
        results["delivered_hz_min"] = min(results["delivered_hz_min"], results["tab_state_hz"])
    if "gateway" in got.usage.rss:
        rss, rss_after = got.usage.rss["gateway"]
        results["gateway_cpu_share"] = round(got.usage.cpu_shares["gateway"], 3)
        results["gateway_memory_mib"] = round(rss_after / 2**20, 1)
        results["gateway_growth_mib"] = round((rss_after - rss) / 2**20, 1)
    results |= got.summarize(
        *("server_cpu_share", "late_tick_share", "lateness_ms_p99", "ticks", "frames_not_logged", "scheduling", "drops")
    )
    params = {"seconds": total_s, "rounds": len(plan) // 3, "tab": missing or "chromium", "hz": 60}
    log = got.logs[REFERENCE]
    measured = {
        "delivered_hz_min": compute_rate(log, got.seconds),
        **summarize_percentiles("age_ms", compute_ages_ms([log]), PERCENTILES),
    }
    reference = {f"{REFERENCE}_{key}": value for key, value in measured.items()}
    return BenchReport(results, make_web_bars(results, total_s), reference, params)


def make_web_bars(results: dict[str, Any], seconds: float) -> list[Bar]:
    """Return the bars of the results that there are."""
    disturbed = allow_increase(results["others_age_ms_p99_baseline"])
    bars = [
        make_bar(results, "delivered_hz_min", ">=", 58.0),
        make_bar(results, "age_ms_p99", "<=", 15.0),
        make_bar(results, "others_age_ms_p99_with_frozen_tab", "<=", disturbed),
        make_bar(results, "others_age_ms_p99_with_assets_in_flight", "<=", disturbed),
    ]
    if "js_ms_per_frame_p50" in results:
        bars.append(make_bar(results, "js_ms_per_frame_p50", "<=", 2.0))
        bars.append(make_bar(results, "estop_ms_max", "<=", 100.0))
        if seconds >= FLAT_S:
            bars.append(make_bar(results, "heap_growth_mib", "<=", 1.0))
    return bars


# --- evaluation -------------------------------------------------------------------------------------------------------


def compute_rate(log: Log, seconds: float) -> float:
    """Return the states per second in a window of `seconds`."""
    return round(len(log["ticks"]) / seconds, 2)


def summarize_browsers(
    got: Measurement, names: list[str], plan: list[Interval], resumed: dict[Interval, int]
) -> dict[str, Any]:
    """Return the results of the browsers without a picture. `names`: those that are never disturbed."""
    logs = [got.logs[name] for name in names]
    results: dict[str, Any] = {
        "delivered_hz_min": min(compute_rate(log, got.seconds) for log in logs),
        **summarize_percentiles("age_ms", compute_ages_ms(logs), PERCENTILES),
    }
    loads = got.logs[SPECIAL]["loads"].reshape(-1, 3)
    loading = [((begin_ns - got.begin_ns) * 1e-9, (end_ns - got.begin_ns) * 1e-9) for begin_ns, end_ns, _ in loads]
    spans = {
        "baseline": [(one.stall_s, one.end_s) for one in plan if one.kind == BASELINE],
        "with_frozen_tab": [(one.stall_s, one.end_s) for one in plan if one.kind == FROZEN],
        "with_assets_in_flight": loading,
    }
    for key, own in spans.items():
        p99s = [compute_age_p99_ms(logs, got.begin_ns, *span) for span in own] or [math.inf]
        results |= summarize_runs(f"others_age_ms_p99_{key}", p99s)
    results |= summarize_stalls(got.logs[SPECIAL], got.begin_ns, resumed, FROZEN)
    results["assets_mb"] = round(float(loads[:, 2].sum()) * 1e-6, 1)
    results["assets_s"] = round(float(sum(end_s - begin_s for begin_s, end_s in loading)), 3)
    return results


def summarize_tab(log: Log, stops: Sequence[tuple[int, int]]) -> dict[str, Any]:
    """Return the results of the tab. `stops`: as in `Measurement`."""
    if not len(log["js_ms"]) or not len(log["ages_ms"]):
        raise BenchError("the tab drew nothing in the measured window")
    clicks_ns = log["clicks_ns"].tolist()
    pairs = [(at, *found) for at in clicks_ns if (found := next((stop for stop in stops if stop[0] >= at), None))]
    parts = np.array(pairs, np.float64).reshape(-1, 3) * 1e-6
    total, sending, holding = (parts[:, b] - parts[:, a] for a, b in ((0, 2), (0, 1), (1, 2)))
    memory = log["memory"]
    return {
        "tab_state_hz": round(float(log["hz"][0]), 2),
        "tab_drawn_hz": round(float(log["hz"][1]), 2),
        **summarize_percentiles("tab_age_ms", log["ages_ms"]),
        **summarize_percentiles("js_ms_per_frame", log["js_ms"]),
        "render_ms_per_frame_p50": compute_percentile(log["render_ms"], 50),
        "heap_mib": {f"{at_s:.0f} s": round(float(heap), 2) for at_s, heap, _ in memory},
        "heap_growth_mib": round(float(memory[-1, 1] - memory[min(1, len(memory) - 2), 1]), 2),
        "tab_memory_mib": {f"{at_s:.0f} s": round(float(resident), 1) for at_s, _, resident in memory},
        "estops": len(pairs),
        "estop_ms_p50": compute_percentile(total, 50),
        "estop_ms_max": compute_percentile(total, 100),
        "estop_click_to_front_ms_p50": compute_percentile(sending, 50),
        "estop_front_to_hold_ms_p50": compute_percentile(holding, 50),
        "tab_renderer": str(log["renderer"][0]),
    }


def make_web_model(vertices: int, seed: int) -> Any:
    """Return the model as an `mujoco.MjModel`, keyframe `home`. `seed`: of the velocities.

    Raises:
        ModelNotFoundError: The model of ALOHA is not installed.
    """
    import mujoco

    spec = aloha_scene()
    (home,) = spec.keys
    qpos = [*home.qpos, 0.0]
    spec.delete(home)
    side = math.isqrt(vertices)
    sheet = mujoco.MjSpec.from_string(_SHEET.format(side=side, step=_SHEET_M / (side - 1)))
    spec.attach(sheet, prefix="sheet/", frame=spec.worldbody.add_frame(pos=[0.0, 0.0, 0.6]))
    disabled = mujoco.mjtDisableBit
    for bit in (disabled.mjDSBL_CONSTRAINT, disabled.mjDSBL_ACTUATION, disabled.mjDSBL_GRAVITY, disabled.mjDSBL_SPRING):
        spec.option.disableflags |= int(bit)  # nothing slows down or collides
    spec.add_key(name="home", qpos=qpos, qvel=[0.0] * (len(qpos) - 2))  # two boards have quaternions
    model = spec.compile()
    rng = np.random.default_rng(seed)
    is_hinge = model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)
    is_slide = model.jnt_type == int(mujoco.mjtJoint.mjJNT_SLIDE)
    model.dof_damping[:] = 0.0
    model.dof_damping[model.jnt_dofadr[is_slide]] = _STIFF  # fingers would fly away
    model.key_qvel[0, model.jnt_dofadr[is_hinge]] = rng.uniform(-_SPEED, _SPEED, int(is_hinge.sum()))
    model.key_qvel[0, model.jnt_dofadr[model.joint("sheet/swing").id]] = _SHEET_SPEED
    return model
