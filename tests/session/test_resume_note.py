"""The note beside a recording: written completely, and never over that of the next session."""

from __future__ import annotations

import os
import stat
import threading
from pathlib import Path

import pytest

from iris_session.session.resume import NOTE_FILE, Listening, ResumeNote, ResumeNoteWriter


def test_late_note_does_not_overwrite_that_of_the_next_session(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keeper, disk = ResumeNoteWriter(tmp_path / NOTE_FILE), HangingDisk(monkeypatch)
    keeper.offer(ResumeNote("s1", Listening("too late")))
    assert disk.reached.wait(30.0)
    keeper.close(0.0)
    disk.works.set()
    keeper._thread.join(30.0)
    assert list(tmp_path.iterdir()) == []


class HangingDisk:
    """`fsync` waits until it `works`."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.reached, self.works = threading.Event(), threading.Event()
        self.synced_folders = 0
        monkeypatch.setattr(os, "fsync", self)

    def __call__(self, descriptor: int) -> None:
        self.synced_folders += stat.S_ISDIR(os.fstat(descriptor).st_mode)
        self.reached.set()
        assert self.works.wait(30.0)
