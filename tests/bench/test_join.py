"""`bench join` with a small scene: every key is present, and counts are right. Speed is not tested."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.bench.test_report import _bench, _check

KEYS = {
    *("ready_s", "server_rss_mib", "first_picture_s", "complete_s", "bytes", "warm_complete_s", "warm_bytes"),
    "others_age_ms_p99",
}


@pytest.mark.long
@pytest.mark.e2e
def test_join_of_a_small_scene(tmp_path: Path) -> None:
    # Joining and what follows take four seconds on an idle machine; state is measured until the end of the window.
    options = ("--objects", "70", "--assets-mb", "3", "--clients", "1", "--seconds", "25")
    result = _bench(tmp_path, "join", *options)
    _check(result, "join", KEYS)
    found = result["results"]
    assert 1.5e6 < found["bytes"] < 6e6
    assert found["assets"] > 120  # 60 meshes and 60 textures, and the scene
    assert found["warm_bytes"] == 0
    assert 0.0 < found["first_picture_s"] <= found["complete_s"]
    assert result["reference"]["bare_transfer_s"] > 0.0
    assert result["reference"]["others_age_ms_p99_memory_copied"] > 0.0
    held = {one["key"]: one["ok"] for one in result["bars"]}
    assert held.keys() == {"ready_s", "server_rss_mib", "complete_s", "warm_bytes", "others_age_ms_p99"}
    assert held["warm_bytes"]
