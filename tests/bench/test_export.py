"""`bench export`: its session has the episodes that it promises, and its results are what the export reports."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from iris_session.bench.export import measure_growth, measure_writer, record_session, summarize_export
from iris_session.dataset.cameras import PictureSpec
from iris_session.dataset.episodes import make_plan
from iris_session.dataset.run import DatasetOptions, export_dataset
from iris_session.session.verification import verify_recording


def test_session_has_episodes_that_verify(tmp_path: Path) -> None:
    record_session(tmp_path / "session.rrd", 3, 60)
    assert verify_recording(tmp_path / "session.rrd").ok
    plan = make_plan([tmp_path / "session.rrd"])
    assert [one.end_step - one.first_step for one in plan.episodes] == [60, 60, 60]
    report = export_dataset([tmp_path / "session.rrd"], tmp_path / "set", "lerobot", DatasetOptions(100))
    assert (report.episodes, report.frames, len(report.seconds)) == (3, 36, 3)
    assert sum(report.shares.values()) == 1.0 or abs(sum(report.shares.values()) - 1.0) < 1e-9


def test_results() -> None:
    report = {"closing": [1.0, *[5.0] * 18, 1.1], "shares": {"draw": 0.5, "encode": 0.25}, "frames": 7}
    results = summarize_export(report, 60.0, 100.0, (1.0, 2.0))
    assert results["episodes_per_minute"] == 20.0
    assert results["first_to_last_ratio"] == round(5.05 / 4.0, 3)
    assert (results["share_draw"], results["share_encode"], results["frames"]) == (0.5, 0.25, 7)


def test_early_and_late_episodes_are_made_in_turn(tmp_path: Path) -> None:
    record_session(tmp_path / "session.rrd", 3, 60)
    first, last = measure_growth(tmp_path / "session.rrd", tmp_path / "made", PictureSpec())
    assert first > 0.0
    assert last > 0.0
    assert [path.name for path in sorted((tmp_path / "made").iterdir())] == ["0-0", "0-1", "1-0", "1-1"]


def test_our_writer_is_measured(tmp_path: Path) -> None:
    assert measure_writer(tmp_path, np.zeros((4, 240, 320, 3), np.uint8)) > 0.0
