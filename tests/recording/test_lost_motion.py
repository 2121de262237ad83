"""Motion that a killed recorder had not written is in copies for the viewer and in repaired files."""

from __future__ import annotations

import errno
import math
import os
import tempfile
from pathlib import Path

import numpy as np
import pyarrow as pa  # type: ignore[import-untyped]
import pytest

from iris_session.protocol.common import Pose
from iris_session.protocol.server_messages import PresenceItem
from iris_session.recording import view_copy
from iris_session.recording.errors import RecorderError
from iris_session.recording.lost_motion import open_with_lost_motion, write_lost_motion
from iris_session.recording.messages import Batch, StateFrame
from iris_session.recording.paths import part_path
from iris_session.recording.repair import repair
from iris_session.recording.rrd_stream import ArrowColumn
from iris_session.recording.view_copy import open_view_file
from iris_session.recording.writer import MIN_PERIOD_NS, RrdWriter
from tests.recording.support import column, journal, make_header, read

BALL = "/scene/1/bodies/ball"
STEPS = 100
STATE_NS = MIN_PERIOD_NS // 40


def make_states(n: int, begin: int = 0) -> list[StateFrame]:
    """Return states in which all bodies and a head move; the head stands still in every second."""
    header, states = make_header(), []
    for i in range(begin, begin + n):
        poses = np.tile((0.01 * i, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0), (len(header.bodies), 1))
        head = PresenceItem("p1", "head", Pose((0.0, 0.0, 1.0 + 0.01 * (i // 2)), (1.0, 0.0, 0.0, 0.0)), i // 2)
        time_ns = (i + 1) * STATE_NS
        states.append(StateFrame(i, i + 1, time_ns * 1e-9, time_ns, poses.tobytes(), (head,)))
    return states


def write_file(path: Path, states: list[StateFrame], *, closed: bool) -> RrdWriter:
    writer = RrdWriter(path, "id")
    header, batch = journal(STEPS)
    writer.write_header(header)
    writer.add(batch)
    for i in range(0, len(states), 5):
        writer.add(Batch(states=states[i : i + 5]))
        writer.flush()
    if closed:
        writer.close()
    return writer


def list_motion(path: Path) -> dict[str, list[list[float]]]:
    """Return session time [s] and translation of the rows of every entity that moves, in order of time."""
    found: dict[str, list[list[float]]] = {}
    for entity, batches in read(path).items():
        of = [one for one in batches if "Transform3D:translation" in one.schema.names]
        if of and entity.startswith(("/scene/", "/presence/")):
            times = [value.value * 1e-9 for batch in of for value in batch.column("session_time")]
            places = [place[0] for place in column(of, "Transform3D:translation")]
            found[entity] = sorted([time, *place] for time, place in zip(times, places, strict=True))
    return found


def test_killed_part_gets_the_motion_of_a_closed_one(tmp_path: Path) -> None:
    states = make_states(STEPS)
    assert states[-1].session_time > 2 * MIN_PERIOD_NS, "some of the motion is written before the kill"
    write_file(tmp_path / "closed.rrd", states, closed=True)
    whole = list_motion(tmp_path / "closed.rrd")
    assert len(whole) == 4
    path = tmp_path / "killed" / "session.rrd"
    path.parent.mkdir()
    killed = write_file(path, states, closed=False)
    left = list_motion(path)
    assert 0 < len(left[BALL]) < len(whole[BALL]) == STEPS
    report = repair(path, tmp_path / "repaired.rrd")
    assert report.ok
    assert list_motion(tmp_path / "repaired.rrd") == whole
    with open_view_file(path) as view:
        assert list_motion(view.path) == whole
    killed.close()


def test_closed_part_lacks_nothing(tmp_path: Path) -> None:
    path = tmp_path / "closed.rrd"
    write_file(path, make_states(20), closed=True)
    assert write_lost_motion(str(path), tmp_path / "motion.rrd") == 0
    assert not (tmp_path / "motion.rrd").exists()


@pytest.mark.parametrize(("n", "lacking"), [(5, 0), (20, 15)])
def test_part_lacks_what_came_after_its_last_motion(tmp_path: Path, n: int, lacking: int) -> None:
    """The first write has motion, those of the next second have none."""
    path = tmp_path / "killed.rrd"
    killed = write_file(path, make_states(n), closed=False)
    assert write_lost_motion(str(path), tmp_path / "motion.rrd") == lacking
    killed.close()


def test_damaged_names_of_bodies_leave_out_their_motion(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = ArrowColumn("bodies", pa.array([None], pa.list_(pa.string())))
    monkeypatch.setattr("iris_session.recording.writer.text_list_column", lambda *_: nothing)
    path = tmp_path / "session.rrd"
    killed = write_file(path, make_states(20), closed=False)
    assert write_lost_motion(str(path), tmp_path / "motion.rrd") == 15
    assert list(list_motion(tmp_path / "motion.rrd")) == ["/presence/p1/head"]
    killed.close()


def test_full_disk_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "session.rrd"
    killed = write_file(path, make_states(20), closed=False)

    def refuse(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(view_copy, "_write_copy", refuse)
        with (
            pytest.raises(RecorderError, match=r"view\.rrd .* temporary, but cannot .*: No space"),
            open_view_file(path),
        ):
            pass
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "gone"))
    with pytest.raises(RecorderError, match="temporary file cannot be written: No such file"), open_view_file(path):
        pass
    killed.close()


def test_only_the_part_that_was_killed_is_followed(tmp_path: Path) -> None:
    first, second = tmp_path / "session.rrd", Path(part_path(str(tmp_path / "session.rrd"), 2))
    killed = write_file(first, make_states(30), closed=False)
    write_file(second, make_states(30, 30), closed=True)
    with open_with_lost_motion([str(first), str(second)]) as files:
        assert [Path(file).name for file in files] == ["session.rrd", "0.rrd", "session.part2.rrd"]
    times = [row[0] for row in list_motion(first)[BALL]]
    assert math.isclose(times[-1], 5 * STATE_NS * 1e-9), "the first flush writes motion"
    killed.close()
