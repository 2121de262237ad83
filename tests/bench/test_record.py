"""`bench record`: evaluation of rounds, sizes and kills."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from iris_session.bench.record import (
    AUTHORITY,
    BODIES,
    BOTH,
    RECORDER,
    FileSize,
    Kill,
    Round,
    make_record_bars,
    make_record_scene,
    measure_size,
    read_losses,
    summarize_kills,
    summarize_rounds,
    summarize_sizes,
)
from iris_session.journal.messages import StateFrame
from iris_session.recording.writer import RrdWriter
from iris_session.rrd.paths import part_path
from iris_session.viewer.scene_layer import escape_entity_part
from tests.recording.support import journal, read, write


def test_scene_has_as_many_moving_bodies_as_it_says() -> None:
    model = make_record_scene(0).compile()
    assert sum(model.body_weldid != 0) == BODIES


def _results(late_on: int) -> dict[str, object]:
    rounds = [Round(True, late_on, 1000, 0.04), Round(False, 0, 1000, 0.0), Round(False, 4, 1000, 0.0)]
    rounds.append(Round(True, late_on, 1000, 0.02))
    results = summarize_rounds(rounds) | summarize_sizes([FileSize(3_000_000, 2_500_000, 4_000_000, 30.0)])
    return (
        results
        | summarize_kills([Kill(RECORDER, 0.1), Kill(AUTHORITY, 0.0)])
        | {"kill_rows_missing": 0, "rest_mb_per_hour": 18.0}
    )


@pytest.mark.parametrize(("late_on", "ok"), [(6, True), (7, False)])
def test_late_ticks_are_compared_with_those_without_recording_and_their_spread(late_on: int, ok: bool) -> None:
    results = _results(late_on)
    assert (results["late_tick_share_off"], results["late_tick_share_off_spread"]) == (0.002, 0.004)
    assert results["writer_cpu_share"] == 0.03
    (bar,) = (bar for bar in make_record_bars(results) if bar.key == "late_tick_share_on")
    assert (bar.bound, bar.ok) == (0.006, ok)


def test_sizes_and_losses_are_summarized() -> None:
    results = _results(0)
    assert (results["mb_per_min"], results["naive_mb_per_min"], results["size_ratio"]) == (6.0, 5.0, 1.2)
    assert (results["live_log_mb_per_min"], results["live_log_size_ratio"]) == (8.0, 0.75)
    assert (results["kill_loss_s_max"], results["kill_loss_s_p50"]) == (0.1, 0.05)
    assert results["kill_loss_s_max_by_kind"] == {RECORDER: 0.1, AUTHORITY: 0.0}
    assert results["kills"] == {RECORDER: 1, AUTHORITY: 1, BOTH: 0}


def test_losses_are_from_the_newest_row_of_a_part_to_its_kill(tmp_path: Path) -> None:
    header, batch = journal(60)
    first, rows, keyframes = tmp_path / "session.rrd", batch.rows, batch.keyframes
    batch.rows, batch.keyframes = rows[:30], keyframes[:1]
    write(first, header, batch)
    batch.rows, batch.keyframes = rows[33:], keyframes[1:]
    write(Path(part_path(str(first), 2)), header, batch)
    kills = [(RECORDER, rows[29].now_ns + 50_000_000), (BOTH, rows[-1].now_ns + 20_000_000)]
    losses, missing = read_losses(first, kills)
    assert [(loss.kind, round(loss.loss_s, 6)) for loss in losses] == [(RECORDER, 0.05), (BOTH, 0.02)]
    assert missing == 3


@pytest.mark.parametrize("log", ["naive", "live"])
def test_naive_logs_have_every_pose_of_moving_bodies(tmp_path: Path, log: str) -> None:
    header, batch = journal(60)
    poses = np.tile((0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0), (len(header.bodies), 1)).tobytes()
    batch.states += [StateFrame(row.step, 1, row.step * 2e-3, row.now_ns, poses) for row in batch.rows[::8]]
    writer = RrdWriter(tmp_path / "session.rrd", "id")
    writer.write_header(header)
    writer.add(batch)
    writer.close()
    size = measure_size(tmp_path / "session.rrd", tmp_path)
    assert size.duration_s == pytest.approx(59 * 2e-3)
    assert getattr(size, log) == (tmp_path / f"{log}.rrd").stat().st_size
    rows = {f"/bodies/{escape_entity_part(body.name)}": 0 for body in header.bodies if body.moving}
    scene = 0
    for entity, batches in read(tmp_path / f"{log}.rrd").items():
        if entity in rows:
            rows[entity] = sum(one.num_rows for one in batches)
        scene += entity.startswith("/scene/")
    assert list(rows.values()) == [8] * 3
    assert scene > 3
