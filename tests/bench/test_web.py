"""`bench web`: evaluation of logs, and a short run with every key. Speed is not tested."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from iris_session.bench.slow_client import BASELINE
from iris_session.bench.web import FROZEN, LOADING, make_web_bars, plan_web_intervals, summarize_tab
from iris_session.bench.web_tab import STOPS, STOPS_S
from tests.bench.test_report import _bench, _check
from tests.e2e.browser import require_browser

MS = 1_000_000
KEYS = {
    *("delivered_hz_min", "age_ms_p50", "age_ms_p95", "age_ms_p99", "others_age_ms_p99_baseline"),
    *(
        "others_age_ms_p99_with_frozen_tab",
        "assets_mb",
        "gateway_cpu_share",
        "gateway_memory_mib",
        "server_cpu_share",
        "late_tick_share",
        "ticks",
    ),
}
TAB_KEYS = {
    *("tab_state_hz", "tab_drawn_hz", "tab_age_ms_p50", "tab_age_ms_p99", "js_ms_per_frame_p50", "js_ms_per_frame_p99"),
    *("render_ms_per_frame_p50", "heap_growth_mib", "estops", "estop_ms_p50", "estop_ms_max"),
}


def test_intervals_alternate_and_leave_room_for_the_stops() -> None:
    plan = plan_web_intervals(65.0)
    assert [s.kind for s in plan] == [BASELINE, FROZEN, LOADING] * 3
    assert plan[-1].end_s + STOPS_S == 65.0
    assert len(plan_web_intervals(1.0)) == 3
    assert len(plan_web_intervals(300.0)) == 9, "the rest is quiet"


def test_e_stops_are_paired_with_the_clicks_before_them() -> None:
    log = {
        "js_ms": np.array([1.0, 2.0, 9.0]),
        "render_ms": np.array([0.5, 1.0, 2.0]),
        "ages_ms": np.array([3.0, 4.0]),
        "hz": np.array([60.0, 30.0]),
        "clicks_ns": np.array([1000 * MS, 2000 * MS, 3000 * MS]),
        "memory": np.array([[0.0, 9.0, 100.0], [60.0, 10.0, 110.0], [120.0, 10.25, 111.0]]),
        "renderer": np.array(["none"]),
    }
    stops = [(500 * MS, 501 * MS), (1008 * MS, 1010 * MS), (2018 * MS, 2020 * MS)]  # the third has not come
    found = summarize_tab(log, stops)
    assert (found["estops"], found["estop_ms_p50"], found["estop_ms_max"]) == (2, 15.0, 20.0)
    assert (found["estop_click_to_front_ms_p50"], found["estop_front_to_hold_ms_p50"]) == (13.0, 2.0)
    assert found["js_ms_per_frame_p50"] == 2.0
    assert found["heap_growth_mib"] == 0.25, "from the second reading on"
    assert summarize_tab(log, [])["estop_ms_max"] == math.inf


def test_bars_follow_the_baseline_and_the_length() -> None:
    results = {
        "delivered_hz_min": 59.0,
        "age_ms_p99": 9.0,
        "others_age_ms_p99_baseline": 10.0,
        "others_age_ms_p99_with_frozen_tab": 12.0,
        "others_age_ms_p99_with_assets_in_flight": math.inf,
    }
    assert [bar.ok for bar in make_web_bars(results, 300.0)] == [True, True, True, False]
    assert make_web_bars(results, 300.0)[2].bound == 12.0
    tab = {"js_ms_per_frame_p50": 2.1, "estop_ms_max": 99.0, "heap_growth_mib": 0.5}
    assert {bar.key for bar in make_web_bars(results | tab, 300.0)} >= tab.keys()
    assert "heap_growth_mib" not in {bar.key for bar in make_web_bars(results | tab, 65.0)}


@pytest.mark.long
@pytest.mark.e2e
def test_web(tmp_path: Path) -> None:
    """A tab, a browser that is disturbed, another one, and a client beside them, encrypted."""
    require_browser()
    options = ("--clients", "3", "--vertices", "100", "--seconds", "27", "--curve")
    result = _bench(tmp_path, "web", *options)
    _check(result, "web", KEYS | TAB_KEYS)
    got, reference = result["results"], result["reference"]
    assert 0.0 < got["age_ms_p50"] <= got["age_ms_p95"] <= got["age_ms_p99"]
    assert 0.0 < got["delivered_hz_min"] < 70.0
    # Null where a busy machine has delivered nothing in time.
    assert {"others_age_ms_p99_with_assets_in_flight", "resume_first_age_ms", "resume_fresh_after_ms"} <= got.keys()
    assert got["gateway_cpu_share"] > 0.0, "the states have come through the gateway"
    assert got["assets_mb"] > 0.0
    assert 0.0 < got["render_ms_per_frame_p50"] <= got["js_ms_per_frame_p50"]
    assert got["estops"] == STOPS
    assert got["estop_click_to_front_ms_p50"] > 0.0
    assert reference["zeromq_delivered_hz_min"] > 0.0
    assert 0.0 < reference["zeromq_age_ms_p50"] <= reference["zeromq_age_ms_p99"]
