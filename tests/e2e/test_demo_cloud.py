"""`iris-session demo cloud`: drawn depth cameras beside a handover, at an observer and in the recording.

Drawing in software takes a core: the Makefile runs it alone, as it does with browsers.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from iris_session import Recording
from tests.e2e.session_process import DEMO_S
from tests.e2e.test_demo_scenes import run_demo

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(DEMO_S + 60.0)]


@pytest.mark.long
def test_depth_cameras_show_the_room_of_a_handover(tmp_path: Path) -> None:
    result = run_demo(tmp_path, "cloud", max_attempts=3)
    assert [one["object"] for one in result["handovers"]] == ["hammer"]
    assert list(result["streams"]) == ["watcher1"]
    streams = result["streams"]["watcher1"]
    assert [(one["stream"], one["encoding"]) for one in streams] == [
        ("room", "cloud"),
        ("room-front", "jpeg"),
        ("room-back", "jpeg"),
    ]
    for one in streams:
        assert one["frames"] > 0
        assert one["hz"] == pytest.approx(one["frames"] / one["seconds"])
        assert 0.0 < one["age_ms"] <= one["age_ms_p99"] < 10_000.0
        assert one["silent_s"] < 5.0
    assert streams[0]["points"] > 10_000
    assert streams[0]["voxel_m"] == pytest.approx(0.01)
    assert sum(streams[0]["ages_ms"].values()) == pytest.approx(streams[0]["age_ms"], rel=0.5)

    with Recording.open(tmp_path / result["recording"]) as recording:
        clouds = list(recording.clouds("room"))
        pictures = {name: len(list(recording.pictures(f"room-{name}"))) for name in ("front", "back")}
    assert min(pictures.values()) > 0
    times = np.array([one.capture_ns for one in clouds])
    assert len(times) > 3
    assert np.median(np.diff(times)) > 0.3e9  # 2 Hz, of frames that come ten times a second
