"""The recorder: its loop in this process, fed and drained by the test, and what only a killed process can show."""

from __future__ import annotations

import errno
import os
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq

from iris_session.journal.errors import WriteError
from iris_session.journal.feed import BATCH_NS
from iris_session.journal.messages import RecorderConfig
from iris_session.protocol.scene import list_assets
from iris_session.protocol.status import ClientReport
from iris_session.recording import RecorderError, Recording, RecordingLock, summarise, verify
from iris_session.recording import process as process_module
from iris_session.recording.process import DRAIN_S, FLUSH_S, REST_FLUSH_S, RecorderLoop
from iris_session.rrd.assets import ALL, list_recorded_assets
from iris_session.rrd.paths import part_path
from tests.recording.support import TICK_NS, LoopRecorder, SmallCore, SmallSession, loop_recorder
from tests.recording.test_recorded_assets import Shared


@pytest.fixture
def one() -> Iterator[LoopRecorder]:
    with loop_recorder() as found:
        yield found


def test_recording_roundtrip_is_exact(one: LoopRecorder) -> None:
    session = SmallSession(one.feed)
    session.take(300)
    one.pump()
    one.finish()
    with Recording.open(one.path) as recording:
        assert recording.header == session.header
        assert recording.finished
        assert recording.all_closed
        assert recording.damage == []
        assert [row.step for row in recording.rows()] == list(range(300))
        assert [k.step for k in recording.keyframes()] == [-1, 99, 199, 299]
        states = list(recording.states())
        assert len(states) == len(session.poses)
        assert all(np.array_equal(s.poses, p.astype(np.float32)) for s, p in zip(states, session.poses, strict=True))
        assert states[-1].presence[0].participant == "p1"
        assert [event.event_seq for event in recording.events()] == list(range(1, 7))
        times, values = recording.metrics()["late_ms"]
        assert values.tolist() == [step / 10 for step in range(300)]
        assert times[-1] == 300 * 2_000_000
    report = verify(one.path, SmallCore)
    assert report.ok, report.line()
    assert (report.steps, report.keyframes) == (300, 4)


def test_raw_samples_of_the_front(one: LoopRecorder) -> None:
    SmallSession(one.feed).take(10)
    with zmq.Context() as context, context.socket(zmq.PUSH) as front:
        front.connect(f"ipc://{one.folder}/s")
        for i in range(0, 50, 2):
            front.send(msgspec.msgpack.encode([(3, 1000 + j, bytes([j, 255])) for j in (i, i + 1)]))
        front.send(b"\xc1 no message")
        one.pump(lambda: (one.loop._samples, one.loop._refused) == (50, 1))
    one.pump()
    one.finish()
    with Recording.open(one.path) as recording:
        samples = list(recording.samples())
    assert [s.receive_ns for s in samples] == list(range(1000, 1050))
    assert (samples[7].connection, samples[7].data) == (3, bytes([7, 255]))


def test_raw_samples_are_left_out_while_the_disk_is_nearly_full(
    one: LoopRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = one.loop
    batch = msgspec.msgpack.encode([(1, 5, b"x")] * 3)
    loop._process_samples(batch)
    monkeypatch.setattr(process_module, "get_free_bytes", lambda _path: process_module.JOURNAL_RESERVE_BYTES - 1)
    loop._send_status(-1)
    loop._process_samples(batch)
    assert (loop._samples, loop._samples_left_out, len(loop._writer._samples)) == (6, 3, 3)
    loop._disk_free, loop._write_s = 0, 2 * process_module.SLOW_WRITE_S  # a slow disk, of unknown size
    loop._process_samples(batch)
    assert loop._samples_left_out == 6


def test_reports_of_clients_are_plotted_and_no_raw_samples(one: LoopRecorder) -> None:
    reports = [ClientReport(1.0, 2.5, delivered=60), ClientReport(0.0, 0.0, delivered=60), ClientReport(1.0, 2.0, 0)]
    batch = [(7, 5 + i, msgspec.msgpack.encode(("p1", report))) for i, report in enumerate(reports)]
    one.loop._process_samples(msgspec.msgpack.encode([*batch, (7, 9, b"\x92 damaged"), (7, 9, b"\x80")]))
    assert one.loop._writer._reports == [("p1", 5, 2.5)], "of frames that were sent again the age is not known"
    assert (one.loop._samples, one.loop._refused) == (1, 1)


def test_recording_that_is_being_written_says_so(one: LoopRecorder) -> None:
    session = SmallSession(one.feed)
    session.take(100)
    one.pump()
    report = verify(one.folder, SmallCore)  # the folder stands for its session.rrd
    assert (report.ok, report.steps, report.is_being_written, report.finished) == (True, 100, True, False)
    with Recording.open(one.path) as recording:
        assert "being written" in summarise(recording).ending
    session.take(50)
    one.pump()
    one.finish()
    report = verify(one.path, SmallCore)
    assert (report.ok, report.steps, report.is_being_written, report.finished) == (True, 150, False, True)


def test_recorder_that_was_killed_is_followed_by_the_next_part(one: LoopRecorder) -> None:
    session = SmallSession(one.feed)
    session.take(100)
    one.pump()
    session.take(50)  # not written yet
    one.kill()
    session.take(50)
    one.begin(2)
    one.pump()
    session.take(50)
    one.pump()
    one.finish()
    assert (one.feed.stats.recorders, one.feed.stats.dropped_rows) == (2, 0)
    report = verify(one.path, SmallCore)
    assert (report.ok, report.parts, report.steps) == (True, 2, 250), report.line()


def test_error_in_the_picture_leaves_out_the_picture(one: LoopRecorder) -> None:
    """Each later recorder gets what has ended the one before."""
    session = SmallSession(one.feed)
    session.take(50)
    one.pump()
    one.feed.add_state(50, 50, 0.1, 51 * TICK_NS, np.zeros(5))  # no poses
    session.take(50)
    with pytest.raises(ValueError, match="reshape"):
        one.pump()
    one.kill()
    one.begin(2, journal_only=True)
    one.pump()
    one.finish()
    report = verify(one.path, SmallCore)
    assert (report.ok, report.parts, report.steps, report.finished) == (True, 2, 100, True), report.line()


def test_no_part_is_begun_while_another_session_continues_the_recording(
    one: LoopRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(process_module, "TRIED_S", 0.0)
    SmallSession(one.feed).take(20)
    one.pump()
    one.kill()
    mine = RecordingLock(one.path, shared=False)
    with pytest.raises(RecorderError):
        one.begin(2)
    assert not os.path.exists(part_path(str(one.path), 2))
    mine.release()


def test_session_that_never_began_leaves_no_file(tmp_path: Path) -> None:
    with tempfile.TemporaryDirectory(prefix="iris-") as sockets:
        path = tmp_path / "new" / "session.rrd"
        config = RecorderConfig(str(path), 1, "r", f"ipc://{sockets}/f", f"ipc://{sockets}/s", 0, os.getppid())
        loop = RecorderLoop(config)
        assert path.exists()
        loop.stop()
        before = set(threading.enumerate())
        assert loop.run() == 0
    assert list(tmp_path.iterdir()) == []
    for thread in set(threading.enumerate()) - before:  # that which ends an orphan whose disk hangs
        thread.join(30.0)
        assert not thread.is_alive(), thread.name


def test_file_that_is_removed_or_cannot_be_written_is_an_error(one: LoopRecorder) -> None:
    SmallSession(one.feed).take(20)
    one.pump()
    one.path.unlink()
    with pytest.raises(WriteError, match=str(one.path)):
        one.loop._syncer.sync()

    def refuse(_: object) -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    stream: Any = one.loop._writer.stream
    stream._file = SimpleNamespace(write=refuse, close=stream._file.close, fileno=stream._file.fileno)
    one.loop._writer.add_sample(1, 5, b"x")
    with pytest.raises(WriteError, match=str(one.path)):
        one.loop._flush()


@pytest.mark.parametrize("name", ["session.rrd", "file/session.rrd", "x" * 300])
def test_path_that_cannot_be_recorded_to_is_refused(tmp_path: Path, name: str) -> None:
    for existing in ("session.rrd", "file"):
        (tmp_path / existing).write_bytes(b"something of yours")
    with pytest.raises(RecorderError) as failure:
        process_module.claim_file(tmp_path / name)
    assert "\n" not in str(failure.value)
    assert (tmp_path / "session.rrd").read_bytes() == b"something of yours"


def test_disk_that_takes_nothing_is_found_before_the_session_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A quota, for example: the free bytes of the disk do not show it."""

    def refuse(*_: object) -> int:
        raise OSError(errno.EDQUOT, os.strerror(errno.EDQUOT))

    monkeypatch.setattr(process_module.os, "write", refuse)
    with pytest.raises(RecorderError, match="quota"):
        process_module.claim_file(tmp_path / "session.rrd")
    assert list(tmp_path.iterdir()) == []


def test_assets_follow_the_journal_and_each_part_has_them(tmp_path: Path) -> None:
    shared = Shared(tmp_path / "store")
    lost = max(list_recorded_assets(shared.spec, ALL), key=lambda one: len(shared.store.view(one)))
    data = shared.store.path(lost).read_bytes()
    shared.store.path(lost).unlink()
    expected = {shared.scene_hash, *list_assets(shared.spec)}
    with loop_recorder(record_assets=ALL) as one:
        session = SmallSession(one.feed)
        one.feed.send_patch(str(shared.store.root), shared.scene_hash)
        session.take(50)
        one.pump(lambda: one.loop._writer.assets.left_out == 1)
        one.kill()
        shared.store.path(lost).write_bytes(data)
        one.begin(2)._writer.assets.is_ending = True  # no patch is waited for
        session.take(50)
        one.pump(lambda: not one.feed._window and not one.loop._writer.assets)
        one.finish()
        assert one.loop._writer.assets.left_out == 0
        report = verify(one.path, SmallCore)
        assert report.ok, report.line()
        with Recording.open(one.path) as recording:
            assert set(dict(recording.assets())) == expected
            assert summarise(recording).assets.left_out == ()
        with Recording.open(part_path(str(one.path), 2), warn=False) as recording:
            assert set(dict(recording.assets())) == expected


def test_killed_recorder_loses_at_most_a_quarter_second() -> None:
    """Delays of batch, transfer and write add up."""
    assert BATCH_NS * 1e-9 + DRAIN_S + FLUSH_S + DRAIN_S <= 0.25
    assert BATCH_NS * 1e-9 + DRAIN_S + REST_FLUSH_S + DRAIN_S <= 2.0, "of a scene at rest"
