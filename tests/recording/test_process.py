"""The recorder as a real process: files, crashes, end, errors."""

from __future__ import annotations

import errno
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq

from iris_session.journal.feed import BATCH_NS
from iris_session.journal.messages import FRAME, HEADER, Batch, RecorderConfig, encode_batch, encode_header
from iris_session.protocol.names import ArrayKind
from iris_session.protocol.scene import list_assets
from iris_session.protocol.server_messages import ParticipantInfo
from iris_session.protocol.status import ClientReport
from iris_session.recording import (
    RecorderError,
    RecorderFeed,
    RecorderProcess,
    Recording,
    RecordingLock,
    summarise,
    supervise,
    verify,
)
from iris_session.recording import process as process_module
from iris_session.recording.process import DRAIN_S, FLUSH_S
from iris_session.rrd.assets import ALL, list_recorded_assets
from iris_session.rrd.paths import part_path
from iris_session.scene import AssetStore, decode_arrays
from iris_session.scene.mujoco_assets import read_flex_mesh
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.streams.deformable import DeformableEncoder
from iris_session.system.process import ChildProcess
from tests.recording.support import (
    TICK_NS,
    SmallCore,
    SmallSession,
    column,
    make_header,
    read,
    record,
    recorder,
    wait_until,
)
from tests.recording.test_recorded_assets import Shared
from tests.scene.models import flexes

pytestmark = pytest.mark.e2e
REPOSITORY = Path(__file__).parents[2]


def test_recording_roundtrip_is_exact(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "session.rrd"
    session = record(path, 300)
    with Recording.open(path) as recording:
        assert recording.header == session.header
        assert recording.finished
        assert recording.damage == []
        assert [row.step for row in recording.rows()] == list(range(300))
        assert [k.step for k in recording.keyframes()] == [-1, 99, 199, 299]
        states = list(recording.states())
        assert len(states) == len(session.poses)
        assert all(np.array_equal(s.poses, p.astype(np.float32)) for s, p in zip(states, session.poses, strict=True))
        assert states[-1].presence[0].participant == "p1"
        assert [event.body.text for event in recording.events()] == [f"event {50 * i}" for i in range(6)]
        times, values = recording.metrics()["late_ms"]
        assert values.tolist() == [step / 10 for step in range(300)]
        assert times[-1] == 300 * 2_000_000
    report = verify(path, SmallCore)
    assert report.ok, report.line()
    assert (report.steps, report.keyframes) == (300, 4)


def test_rerun_reads_the_file_and_adds_an_index(tmp_path: Path) -> None:
    record(tmp_path / "session.rrd", 100)
    rerun = Path(sys.executable).parent / "rerun"
    for arguments in (["optimize", "session.rrd", "-o", "indexed.rrd"], ["verify", "indexed.rrd"]):
        command = [rerun, "rrd", *arguments]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=60)
        assert done.returncode == 0, done.stderr
    report = verify(tmp_path / "indexed.rrd", SmallCore)
    assert report.ok, report.line()


def test_raw_samples_of_the_front(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        SmallSession(feed).take(10)
        with zmq.Context() as context, context.socket(zmq.PUSH) as front:
            front.connect(process.samples_endpoint)
            for i in range(0, 50, 2):
                front.send(msgspec.msgpack.encode([(3, 1000 + j, bytes([j, 255])) for j in (i, i + 1)]))
            front.send(b"\xc1 no message")
            wait_until(lambda: _status(feed).samples == 50 and _status(feed).samples_refused == 1)
        assert feed.close(20.0)
        assert process.close()
    with Recording.open(path) as recording:
        samples = list(recording.samples())
    assert [s.receive_ns for s in samples] == list(range(1000, 1050))
    assert samples[7].connection == 3
    assert samples[7].data == bytes([7, 255])


@pytest.mark.parametrize("slow", ["disk", "processor"])
def test_raw_samples_are_left_out_only_when_the_disk_is_slow(slow: str, tmp_path: Path) -> None:
    loop = process_module.RecorderLoop(make_loop_config(tmp_path))
    stream: Any = loop._writer._stream
    target, name = (stream._file, "write") if slow == "disk" else (stream, "_read")
    work = getattr(target, name)

    def work_slowly(*given: Any) -> Any:
        loop.stop()  # after this flush
        time.sleep(1.5 * process_module.SLOW_WRITE_S)
        return work(*given)

    if slow == "disk":
        stream._file = SimpleNamespace(write=work_slowly, close=stream._file.close)
    else:
        stream._read = work_slowly
    loop._writer.add_sample(1, 5, b"x")
    loop._loop()
    loop._process_samples(msgspec.msgpack.encode([(1, 5, b"x")] * 3))
    assert loop._samples_left_out == (3 if slow == "disk" else 0)
    loop._context.destroy(linger=0)
    loop._syncer.stop()
    loop._writer.close()


def make_loop_config(folder: Path) -> RecorderConfig:
    return RecorderConfig(
        str(folder / "session.rrd"), 1, "r", f"ipc://{folder}/f", f"ipc://{folder}/s", 0, os.getppid()
    )


def test_raw_samples_are_left_out_while_the_disk_is_nearly_full(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = process_module.RecorderLoop(make_loop_config(tmp_path))
    batch = msgspec.msgpack.encode([(1, 5, b"x")] * 3)
    loop._process_samples(batch)
    monkeypatch.setattr(process_module, "get_free_bytes", lambda _path: process_module.JOURNAL_RESERVE_BYTES - 1)
    loop._send_status(-1)
    loop._process_samples(batch)
    assert (loop._samples, loop._samples_left_out, len(loop._writer._samples)) == (6, 3, 3)
    loop._disk_free, loop._write_s = 0, 2 * process_module.SLOW_WRITE_S  # a slow disk, of unknown size
    loop._process_samples(batch)
    assert loop._samples_left_out == 6
    loop._syncer.stop()
    loop._writer.close()
    loop._context.destroy(linger=0)


def test_reports_of_clients_are_plotted_and_no_raw_samples(tmp_path: Path) -> None:
    config = RecorderConfig(
        str(tmp_path / "session.rrd"), 1, "r", f"ipc://{tmp_path}/f", f"ipc://{tmp_path}/s", 0, os.getpid(), ""
    )
    loop = process_module.RecorderLoop(config)
    reports = [ClientReport(1.0, 2.5, delivered=60), ClientReport(0.0, 0.0, delivered=60), ClientReport(1.0, 2.0, 0)]
    batch = [(7, 5 + i, msgspec.msgpack.encode(("p1", report))) for i, report in enumerate(reports)]
    loop._process_samples(msgspec.msgpack.encode([*batch, (7, 9, b"\x92 damaged"), (7, 9, b"\x80")]))
    assert loop._writer._reports == [("p1", 5, 2.5)], "of frames that were sent again the age is not known"
    assert (loop._samples, loop._refused) == (1, 1)
    loop._syncer.stop()
    loop._writer.close()
    loop._context.destroy(linger=0)


def test_name_of_a_participant_that_breaks_a_limit_is_left_out(tmp_path: Path) -> None:
    """Each later recorder gets the same."""
    config = RecorderConfig(
        str(tmp_path / "session.rrd"), 1, "r", f"ipc://{tmp_path}/f", f"ipc://{tmp_path}/s", 0, os.getpid(), ""
    )
    loop = process_module.RecorderLoop(config)
    known = encode_batch(Batch(people=[ParticipantInfo("p1", "n" * 100, "operator", True)]))
    loop._process_message([FRAME.pack(HEADER, 7), encode_header(make_header()), known])
    assert (loop._expecting, loop._refused) == (7, 1)
    loop._syncer.stop()
    loop._writer.close()
    loop._context.destroy(linger=0)


def test_recording_that_is_being_written_says_so(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        session.take(100)
        wait_until(lambda: _status(feed).written >= 5)
        report = verify(path, SmallCore)
        assert report.is_being_written
        assert report.ok, report.line()
        assert 0 < report.steps <= 100
        assert "being written" in report.line()
        assert str(process.pid) in report.line()
        session.take(50)
        assert feed.close(20.0)
        assert process.close()
    report = verify(tmp_path, SmallCore)  # the folder stands for its session.rrd
    assert report.ok, report.line()
    assert (report.steps, report.is_being_written, report.finished) == (150, False, True)


def test_batch_beyond_a_limit_is_counted_and_its_journal_kept(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        session.take(5)
        feed.add_metric(4, 5 * TICK_NS, "n" * 100, 1.0)
        session.take(100)
        assert feed.close(20.0)
        assert feed.stats.recorder is not None
        assert feed.stats.recorder.samples_refused == 1
        assert process.alive
        assert process.close()
    report = verify(path, SmallCore)
    assert report.ok, report.line()
    assert report.steps == 105


def test_killed_recorder_loses_no_row(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        session.take(150, pause_s=0.002)
        wait_until(lambda: _status(feed).written >= 3)
        os.kill(process.pid, signal.SIGKILL)
        wait_until(lambda: not process.alive)
        assert "signal 9" in process.failure
        session.take(100, pause_s=0.002)
        process.restart()
        session.take(100, pause_s=0.002)
        assert feed.close(20.0)
        assert process.close()
        assert feed.stats.recorders == 2
        assert feed.stats.dropped_rows == 0
    assert os.path.exists(part_path(str(path), 2))
    report = verify(path, SmallCore)
    assert report.parts == 2
    assert report.steps == 350
    assert report.ok, report.line()


def test_error_in_the_picture_leaves_out_the_picture(tmp_path: Path) -> None:
    """Each later recorder gets what has ended the one before."""
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        session.take(50)
        feed.add_state(50, 50, 0.1, 51 * TICK_NS, np.zeros(5))  # no poses
        session.take(50)
        wait_until(lambda: feed.flush() is None and not process.alive)  # sends once the recorder is ready
        assert "exit status 1" in process.failure
        assert process.failure.endswith(
            "ValueError: cannot reshape array of size 5 into shape (7) (the next one leaves out the picture)"
        )
        assert not process.journal_only
        process.restart()
        assert process.journal_only
        session.take(50)
        assert feed.close(20.0)
        assert process.close()
        assert feed.stats.recorders == 2
    report = verify(path, SmallCore)
    assert report.ok, report.line()
    assert (report.parts, report.steps, report.finished) == (2, 150, True)


def test_failed_start_of_a_recorder_is_retried_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        session.take(50)
        os.kill(process.pid, signal.SIGKILL)
        wait_until(lambda: not process.alive)
        with monkeypatch.context() as patch:
            patch.setattr(subprocess, "Popen", _no_memory)
            with pytest.raises(RecorderError, match="Cannot allocate memory"):
                process.restart()
        assert not process.alive
        process.restart()
        session.take(50)
        assert feed.close(20.0)
        assert process.close()
    report = verify(path, SmallCore)
    assert report.ok, report.line()
    assert report.steps == 100


def test_killed_recorder_has_written_acknowledged_rows(tmp_path: Path) -> None:
    """Checked without the next part. The recorder acknowledges several times a second."""
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        while (written := _status(feed).written) < 20:
            session.take(1, pause_s=0.002)
        os.kill(process.pid, signal.SIGKILL)
        wait_until(lambda: not process.alive)
    with Recording.open(path) as recording:
        assert not recording.finished
        steps = [row.step for row in recording.rows()]
    assert steps == list(range(len(steps)))
    assert len(steps) >= written - 1, "a row or more in every batch but that of the first keyframe"


def test_killed_recorder_loses_at_most_a_quarter_second() -> None:
    """Delays of batch, transfer and write add up."""
    assert BATCH_NS * 1e-9 + DRAIN_S + FLUSH_S + DRAIN_S <= 0.25


def test_file_is_finished_when_the_parent_dies(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    script = (
        "import os, sys, time; from pathlib import Path; from tests.recording.support import *\n"
        "r = recorder(Path(sys.argv[1])); process, feed = r.__enter__()\n"
        "s = SmallSession(feed); s.take(200); \n"
        "while feed.stats.recorder is None or feed.stats.recorder.expecting < 20: time.sleep(0.01); feed.flush()\n"
        "print(process.pid, flush=True); os.kill(os.getpid(), 9)"
    )
    folder = tmp_path / "tmp"
    folder.mkdir()
    done = subprocess.run(
        [sys.executable, "-c", script, str(path)],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        timeout=60,
        check=False,
        env={**os.environ, "TMPDIR": str(folder)},
    )
    pid = int(done.stdout)
    wait_until(lambda: not _exists(pid))
    assert list(folder.iterdir()) == [], "nobody else can remove the folder of the sockets"
    with Recording.open(path) as recording:
        assert recording.finished
        assert [row.step for row in recording.rows()] == list(range(200))
        summary = summarise(recording)
    assert summary.ok
    assert "killed" in summary.ending, "a file that was closed by its recorder alone does not pass for a whole session"


def test_session_that_never_began_leaves_no_file(tmp_path: Path) -> None:
    with recorder(tmp_path / "new" / "session.rrd"):
        assert (tmp_path / "new" / "session.rrd").exists()
    assert list(tmp_path.iterdir()) == []


def test_folder_too_long_for_a_socket_is_not_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder = tmp_path / ("x" * 100)
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    record(tmp_path / "session.rrd", 20)
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_only_the_session_ends_its_recorder(tmp_path: Path, number: signal.Signals) -> None:
    """Of Ctrl-C and of a service manager's SIGTERM every process hears, and a file that ends early is not finished."""
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        os.kill(process.pid, number)
        session.take(100)
        assert feed.close(20.0)
        assert process.close()
    assert verify(path, SmallCore).ok


def test_vertices_are_written_without_delaying_the_journal(tmp_path: Path) -> None:
    """Also those that were sent while the recorder was suspended, up to the bound."""
    path, model = tmp_path / "session.rrd", flexes()
    store = AssetStore(tmp_path / "assets")
    parsed = parse_mujoco(model, store)
    encoder = DeformableEncoder(read_flex_mesh(model, 0).topology)
    rest = decode_arrays(store.get(parsed.spec.deformables[0].address), ArrayKind.DEFORMABLE)["position"]
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        feed.send_patch(str(store.root), parsed.scene_hash)
        for i in range(40):
            if i == 10:
                wait_until(lambda: _status(feed).written >= 4)
                os.kill(process.pid, signal.SIGSTOP)
            if i == 30:
                os.kill(process.pid, signal.SIGCONT)
            session.take(25)
            frames = encoder.encode(rest + 0.01 * i)
            assert frames is not None
            feed.send_vertices("flex-0", frames["full"], (session.step_count - 8) * TICK_NS)  # a state is every eighth
        assert feed.close(20.0)
        assert feed.stats.recorder is not None
        assert feed.stats.recorder.vertices_refused == 0
        assert process.close()
    report = verify(path, SmallCore)
    assert (report.ok, report.steps) == (True, 1000), report.line()
    rows = [row for row in column(read(path)["/scene/1/world/cloth"], "Mesh3D:vertex_positions") if row is not None]
    assert len(rows) >= 30
    highest = max(max(z for _, _, z in row) for row in rows)
    assert highest == pytest.approx(rest[:, 2].max() + 0.39, abs=0.001)


def test_moved_file_is_written_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        session.take(50)
        wait_until(lambda: _status(feed).written >= 4)
        moved = path.rename(tmp_path / "moved.rrd")
        session.take(50)
        assert feed.close(20.0)
        assert process.close()
    report = verify(moved, SmallCore)
    assert report.ok, report.line()
    assert (report.steps, report.finished) == (100, True)


def test_removed_file_is_reported_and_a_new_part_begun(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        session.take(50)
        wait_until(lambda: _status(feed).written >= 4)
        path.unlink()
        wait_until(lambda: not process.alive)
        assert "removed" in process.failure
        process.restart()
        session.take(150)
        assert feed.close(20.0)
        assert process.close()
    report = verify(path, SmallCore)
    assert not report.ok
    assert report.gaps[0][0] == 0
    assert report.last_step == 199


def test_file_that_is_removed_at_the_end_is_no_clean_end(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        SmallSession(feed).take(50)
        assert feed.close(20.0)
        path.unlink()
        assert not process.close()


def test_no_part_is_begun_while_another_session_continues_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        SmallSession(feed).take(20)
        wait_until(lambda: _status(feed).written >= 1)
        os.kill(process.pid, signal.SIGKILL)
        wait_until(lambda: not process.alive)
        mine = RecordingLock(path, shared=False)
        process.restart()
        wait_until(lambda: not process.alive)
        assert "is in use" in process.failure
        assert not os.path.exists(part_path(str(path), 2))
        mine.release()


def test_existing_file_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    path.write_bytes(b"something of yours")
    process = RecorderProcess(path, 0)
    with pytest.raises(RecorderError, match="exists"):
        process.start()
    assert path.read_bytes() == b"something of yours"
    assert not process.alive


def test_recorder_that_ends_as_it_starts_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supervise, "ChildProcess", lambda _, **options: ChildProcess("iris_session.none", **options))
    with pytest.raises(RecorderError, match=r"the recorder ended as it started: .*No module named iris_session\.none"):
        RecorderProcess(tmp_path / "session.rrd", 0).start()


def test_name_that_is_too_long_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecorderError, match=r"cannot record to .*: File name too long"):
        process_module.claim_file(tmp_path / ("x" * 300))


def test_unwritable_path_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    process = RecorderProcess(tmp_path / "file" / "session.rrd", 0)
    with pytest.raises(RecorderError) as failure:
        process.start()
    assert "\n" not in str(failure.value)
    assert "record" in str(failure.value)


def test_full_disk_is_reported_and_the_next_part_continues(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        session.take(50)
        wait_until(lambda: _status(feed).written >= 4)
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (path.stat().st_size + 1000,) * 2)
        session.take(200, pause_s=0.002)
        wait_until(lambda: not process.alive)
        feed.flush()
        assert "cannot be written" in _status(feed).fault
        assert "cannot be written" in process.failure
        process.restart()
        session.take(50)
        assert feed.close(20.0)
        assert process.close()
    report = verify(path, SmallCore)
    assert report.steps == 300
    assert report.ok, report.line()


@pytest.mark.long
def test_part_that_cannot_be_begun_leaves_no_file(tmp_path: Path) -> None:
    """While the disk is full each attempt uses the same number, and nothing is missing afterwards."""
    path = tmp_path / "session.rrd"
    with recorder(path) as (process, feed):
        session = SmallSession(feed)
        session.take(50)
        wait_until(lambda: _status(feed).written >= 4)
        before = resource.getrlimit(resource.RLIMIT_FSIZE)
        os.kill(process.pid, signal.SIGKILL)
        wait_until(lambda: not process.alive)
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, before[1]))  # the configuration fits, a recording does not
        try:
            process.restart()
            wait_until(lambda: not process.alive)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert not os.path.exists(part_path(str(path), 2))
        process.restart()
        session.take(50)
        assert feed.close(20.0)
        assert process.close()
    report = verify(path, SmallCore)
    assert report.ok, report.line()
    assert (report.steps, report.parts, report.notes) == (100, 2, [])


def test_assets_follow_the_journal_and_each_part_has_them(tmp_path: Path) -> None:
    path = tmp_path / "session.rrd"
    shared = Shared(tmp_path / "store")
    lost = max(list_recorded_assets(shared.spec, ALL), key=shared.store.size)
    data = shared.store.path(lost).read_bytes()
    shared.store.path(lost).unlink()
    process = RecorderProcess(path, time.monotonic_ns(), record_assets=ALL)
    process.start()
    feed = RecorderFeed(process.feed_endpoint)
    try:
        session = SmallSession(feed)
        feed.send_patch(str(shared.store.root), shared.scene_hash)
        session.take(50)
        wait_until(lambda: _status(feed).assets_left_out == 1)
        os.kill(process.pid, signal.SIGKILL)
        wait_until(lambda: not process.alive)
        shared.store.path(lost).write_bytes(data)
        process.restart()
        session.take(50)
        assert feed.close(20.0)
        assert process.close()
        assert feed.stats.recorder is not None
        assert feed.stats.recorder.assets_left_out == 0
    finally:
        feed.close(0.0)
        process.close()
    report = verify(path, SmallCore)
    assert report.ok, report.line()
    with Recording.open(path) as recording:
        assert set(dict(recording.assets())) == {shared.scene_hash, *list_assets(shared.spec)}
        assert summarise(recording).assets.left_out == ()
    part2 = Path(part_path(str(path), 2))
    with Recording.open(part2, warn=False) as recording:
        assert len(dict(recording.assets())) == len({shared.scene_hash, *list_assets(shared.spec)})


def test_assets_are_written_as_the_disk_takes_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    loop = process_module.RecorderLoop(
        RecorderConfig(
            str(tmp_path / "session.rrd"), 1, "r", f"ipc://{tmp_path}/f", f"ipc://{tmp_path}/s", 0, os.getpid(), ""
        )
    )
    shared = Shared(tmp_path / "store")
    loop._writer.assets.add_scene(shared.assets, is_patch=False)
    now_s, bytes_per_s, asked = 0.0, 5e6, []
    monkeypatch.setattr(process_module.time, "monotonic", lambda: now_s)

    def write(max_bytes: int) -> None:
        nonlocal now_s
        asked.append(max_bytes)
        now_s += max_bytes / bytes_per_s
        loop._writer._stream.size += max_bytes

    monkeypatch.setattr(loop._writer, "write_assets", write)
    loop._write_assets()
    loop._write_assets()
    bytes_per_s = 1e3
    loop._write_assets()
    loop._write_assets()
    bytes_per_s = 1e12
    loop._write_assets()
    loop._write_assets()
    loop._write_s = 2 * process_module.SLOW_WRITE_S
    loop._write_assets()
    least, most = process_module.MIN_ASSETS_BYTES, process_module.MAX_ASSETS_BYTES
    assert asked == [most, 100_000, 100_000, least, least, most], "20 ms, and none while the disk is slow"
    monkeypatch.undo()
    loop._syncer.stop()
    loop._writer.close()
    loop._context.destroy(linger=0)


def _no_memory(*_: object, **__: object) -> None:
    raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))


def _status(feed):  # type: ignore[no-untyped-def]
    """Wait for the recorder's newest status."""
    until = time.monotonic() + 20.0
    feed.flush()
    while feed.stats.recorder is None:
        assert time.monotonic() < until, "the recorder says nothing"
        time.sleep(0.01)
        feed.flush()
    return feed.stats.recorder


def _exists(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # An orphan in a container may stay a zombie: nobody reaps it.
    return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
