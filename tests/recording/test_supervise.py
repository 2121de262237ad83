"""The recorder as a supervised process, for which the tick loop does not wait: restarts, hangs, the end of a budget."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import pytest

from iris_session.journal.messages import RecorderConfig, RecorderStatus
from iris_session.recording import RecorderProcess, supervise
from iris_session.recording.supervise import CRASHED, HANGING_NS
from iris_session.system import supervised
from tests.threads import Threads

SECOND = 1_000_000_000


class Child:
    """A recorder by the test: it creates its file, as the process does."""

    pid = 4711

    def __init__(self, _: str, *, config: bytes, stderr: Any, **options: Any) -> None:
        self.config = msgspec.msgpack.decode(config, type=RecorderConfig)
        self.exit_status: int | None = None
        self.stderr = stderr
        part = "" if self.config.part == 1 else f".part{self.config.part}"
        Path(self.config.path).with_suffix(f"{part}.rrd").touch()

    @property
    def is_running(self) -> bool:
        return self.exit_status is None

    def end(self, status: int) -> None:
        os.write(self.stderr.fileno(), b"Rerun: something\nrecorder: no space left\nRerun: something else\n")
        self.exit_status = status

    def read_line(self, _: float) -> bytes:
        return b"ready"

    def send_signal(self, number: int) -> None: ...

    def close(self, **_: float) -> int:
        self.exit_status = self.exit_status or 0
        return self.exit_status


class Lab:
    def __init__(self, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.children: list[Child] = []
        self.threads = Threads()
        monkeypatch.setattr(supervised, "threading", self.threads)
        monkeypatch.setattr(supervise, "ChildProcess", self._spawn)
        self.recorder = RecorderProcess(folder / "session.rrd", 0)
        self.recorder.start()
        self.now_ns = SECOND

    def _spawn(self, *arguments: Any, **options: Any) -> Child:
        self.children.append(Child(*arguments, **options))
        return self.children[-1]

    def poll(self, silence_ns: int = 0, status: RecorderStatus | None = None) -> list[str]:
        """Poll after a second, with whatever thread has started by then at its end."""
        self.now_ns += SECOND
        found = self.recorder.poll(self.now_ns, silence_ns, status)
        self.threads.run_started()
        return found + self.recorder.poll(self.now_ns, silence_ns, status)


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    lab = Lab(tmp_path, monkeypatch)
    yield lab
    lab.recorder.close(0.0)


def test_dead_recorder_is_replaced_by_one_of_the_next_part_that_leaves_out_a_picture_that_failed(lab: Lab) -> None:
    assert lab.poll() == []
    lab.children[0].end(CRASHED)
    assert "no space left" in lab.recorder.failure
    (announced,) = lab.poll()
    assert "no space left" in announced
    assert lab.recorder.failure == ""
    assert (lab.recorder.part, lab.recorder.starts, lab.recorder.restarts) == (2, 2, 1)
    assert [child.config.journal_only for child in lab.children] == [False, True]
    lab.children[1].end(CRASHED)
    lab.poll()
    lab.poll()
    assert lab.recorder.alive
    assert "no space left" in lab.recorder.failure, "one after the other has ended"


def test_hanging_recorder_is_announced_once_and_not_ended(lab: Lab) -> None:
    assert len(lab.poll(HANGING_NS + 1)) == 1
    assert lab.recorder.hangs
    assert lab.poll(HANGING_NS + 1) == []
    assert lab.poll() == []
    assert (lab.recorder.hangs, len(lab.children)) == (False, 1)


def test_close_does_not_wait_for_a_hanging_disk(lab: Lab) -> None:
    lab.children[0].end(1)
    lab.recorder.poll(lab.now_ns)
    lab.threads.are_stuck = True
    lab.recorder.stop_restarts()
    lab.threads.run_started()
    assert not lab.recorder.alive, "the successor that is started now would have no supervisor"


def _left(n_bytes: int, *, ended: bool = False) -> RecorderStatus:
    return RecorderStatus(1, 5, 4, budget=100_000_000, budget_left=n_bytes, ended=ended)


def test_end_of_a_budget_is_announced_before_and_when_it_comes_and_nothing_is_restarted(lab: Lab) -> None:
    assert lab.poll(status=RecorderStatus(1, 5, 4)) == lab.poll(status=_left(20_000_000)) == []
    assert lab.recorder.list_warnings() == []
    (announced,) = lab.poll(status=_left(19_900_000))
    assert announced.startswith("19.9 of 100 MB")
    assert lab.poll(status=_left(12_300_000)) == [], "once"
    assert lab.recorder.list_warnings()[0].startswith("12.3 of 100 MB")
    assert not lab.recorder.is_used_up
    lab.children[0].end(0)
    (announced,) = lab.poll(status=_left(0, ended=True))
    assert "100 MB" in announced
    assert lab.recorder.is_used_up
    assert lab.poll(HANGING_NS + 1, _left(0, ended=True)) == []
    assert (lab.recorder.restarts, lab.recorder.failure, lab.recorder.hangs) == (0, "", False)
