"""`bench web`: evaluation of logs."""

from __future__ import annotations

import math

import numpy as np

from iris_session.bench.web import make_web_bars, summarize_tab

MS = 1_000_000


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
