"""Copies made by Rerun's tools read and verify like the original, and changes in them are found."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from iris_session.journal.messages import Batch, DenialRecord, MetricRecord, StateFrame
from iris_session.protocol.common import Denial
from iris_session.protocol.server_messages import Event, MarkerAdded
from iris_session.recording import CLOSED, OPEN, Recording, verify
from iris_session.recording import parts as recording_parts
from iris_session.recording.writer import RrdWriter
from iris_session.rrd.paths import part_path
from tests.recording.support import SmallCore, journal, write

STEPS = 120
RERUN = Path(sys.executable).parent / "rerun"
#: Defaults; small chunks with several columns; many small ones.
OPTIONS = ((), ("--split-size-ratio", "1.5", "--max-size", "12KiB"), ("--split-size-ratio", "1", "--max-rows", "7"))


def optimize(copy: Path, *files: Path | str) -> Path:
    """Make a copy with `rerun rrd optimize`. `files`: files, after options."""
    done = subprocess.run([RERUN, "rrd", "optimize", *files, "-o", copy], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return copy


def record(path: Path, recording_class: str) -> Path:
    """Record a session with data of every kind."""
    header, batch = journal(STEPS, recording_class)
    writer = RrdWriter(path, "id")
    writer.write_header(header)
    rng = np.random.default_rng(5)
    for i in range(0, STEPS, 20):
        part = Batch(rows=batch.rows[i : i + 20])
        part.keyframes = [k for k in batch.keyframes if i == 0 > k.step or i <= k.step < i + 20]
        for row in part.rows:
            poses = rng.normal(size=(len(header.bodies), 7))
            part.states.append(StateFrame(row.step, row.step + 1, row.step / 500, row.now_ns, poses.tobytes()))
            part.metrics.append(MetricRecord(row.step, row.now_ns, "late_ms", row.step / 7))
            writer.add_sample(3, row.now_ns, rng.bytes(row.step % 50))
        now_ns = part.rows[0].now_ns
        part.events.append(Event(i // 20 + 1, i, now_ns, MarkerAdded("p1", f"event {i}")))
        part.denials += [DenialRecord(i, now_ns, 3, Denial("held", "it is held"))] * 2  # twice the same
        writer.add(part)
        writer.flush()
    writer.close()
    return path


def contents(path: Path) -> dict[str, Any]:
    """Return everything that `Recording` reads."""
    with Recording.open(path) as recording:
        assert recording.damage == recording.notes == []
        return {
            "header": recording.header,
            "end": recording.end,
            "rows": list(recording.rows()),
            "later": [row.step for row in recording.rows(after=77)],
            "keyframes": list(recording.keyframes()),
            "states": [state._replace(poses=state.poses.tobytes()) for state in recording.states()],  # type: ignore[arg-type]
            "events": list(recording.events()),
            "denials": list(recording.denials()),
            "samples": list(recording.samples()),
            "metrics": {name: (t.tolist(), v.tolist()) for name, (t, v) in recording.metrics().items()},
        }


@pytest.mark.parametrize(
    ("recording_class", "options"),
    [*((OPEN, options) for options in OPTIONS), (CLOSED, OPTIONS[1])],
)
def test_optimized_copy_reads_and_verifies_like_the_original(
    tmp_path: Path, recording_class: str, options: tuple[str, ...]
) -> None:
    path = record(tmp_path / "session.rrd", recording_class)
    copy = optimize(tmp_path / "indexed.rrd", *options, path)
    original = contents(path)
    assert (len(original["rows"]), len(original["states"]), len(original["samples"])) == (STEPS, STEPS, STEPS)
    assert len(original["denials"]) == 12
    assert contents(copy) == original
    report = verify(copy, SmallCore)
    assert report.ok, report.line()
    assert (report.steps, report.keyframes, report.finished) == (STEPS, 3, True)


@pytest.fixture
def parts(tmp_path: Path) -> tuple[Path, Path]:
    """Two parts; the second repeats fifteen rows."""
    header, batch = journal(STEPS, OPEN)
    rows, keyframes = batch.rows, batch.keyframes
    first, second = tmp_path / "session.rrd", Path(part_path(str(tmp_path / "session.rrd"), 2))
    write(first, header, Batch(rows=rows[:110], keyframes=keyframes[:3]))
    write(second, header, Batch(rows=rows[95:], keyframes=keyframes[2:]))
    return first, second


def test_parts_may_be_optimized_separately_or_merged(
    tmp_path: Path, parts: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(recording_parts, "REPEATED_ITEMS", 20)
    first, second = parts
    (tmp_path / "out").mkdir()
    for part in parts:
        optimize(tmp_path / "out" / part.name, part)
    reports = [verify(tmp_path / "out" / first.name, SmallCore)]
    reports += [verify(optimize(tmp_path / "one.rrd", *files), SmallCore) for files in (parts, (second, first))]
    for report in reports:
        assert report.ok, report.line()
        assert (report.steps, report.keyframes, report.finished) == (STEPS, 3, True)
    assert [report.parts for report in reports] == [2, 1, 1]
