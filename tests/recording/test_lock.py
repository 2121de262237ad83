"""Locks of recordings: shared by a session's processes, exclusive for a resume, with named holders."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import IO

import pytest

from iris_session.recording import lock
from iris_session.recording.errors import RecorderError
from iris_session.recording.lock import RecordingInUseError, RecordingLock

#: Takes a lock (`shared` or `alone`) on a file, says so, and ends with its standard input.
HOLDER = """
import sys
from iris_session.recording.lock import RecordingLock
held = RecordingLock(sys.argv[1], shared=sys.argv[2] == "shared")
print("held", flush=True)
sys.stdin.read()
"""


class Holders:
    """Other processes with locks on one recording."""

    def __init__(self, path: Path, stack: ExitStack) -> None:
        self.path = path
        self._stack = stack

    def hold(self, kind: str) -> int:
        """Lock by one more process. Return its id."""
        command = [sys.executable, "-c", HOLDER, str(self.path), kind]
        process = self._stack.enter_context(
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        )
        self._stack.callback(process.kill)
        out: IO[str] | None = process.stdout
        assert out is not None
        assert out.readline() == "held\n"
        return process.pid

    def refusal(self, *, shared: bool = False) -> str:
        """Return the error of a process that does not get the lock."""
        with pytest.raises(RecordingInUseError) as refused:
            RecordingLock(self.path, shared=shared, patience_s=0.0)
        text = str(refused.value)
        assert text.startswith(f"{self.path} is in use: ")
        return text.partition(" is in use: ")[2]


@pytest.fixture
def others(tmp_path: Path) -> Iterator[Holders]:
    path = tmp_path / "session.rrd"
    path.write_bytes(b"recording")
    with ExitStack() as stack:
        yield Holders(path, stack)


def test_lock_is_shared_by_a_session_and_refused_to_others_with_its_holder(others: Holders) -> None:
    first = others.hold("shared")
    assert others.refusal().endswith(f"process {first}")
    second = others.hold("shared")
    named = ", ".join(map(str, sorted((first, second))))
    assert others.refusal().endswith(f"processes {named}")
    RecordingLock(others.path, shared=True, patience_s=0.0).release()


def test_exclusive_lock_names_its_holder(others: Holders) -> None:
    alone = others.hold("alone")
    assert others.refusal().endswith(f"resumed by process {alone}")
    assert others.refusal(shared=True).endswith(f"resumed by process {alone}")


def test_holder_of_the_same_inode_elsewhere_is_not_named(others: Holders, tmp_path: Path) -> None:
    """`/proc/locks` names files by inode, which is unique only within a file system."""
    holder = others.hold("shared")
    beside = tmp_path / "other.rrd"
    beside.write_bytes(b"another")
    with beside.open("rb") as file, pytest.MonkeyPatch.context() as patch:
        patch.setattr(lock, "_read_locks", lambda: [(holder, "READ", os.fstat(file.fileno()).st_ino)])
        assert lock._list_holders(os.fstat(file.fileno())) == []
    with others.path.open("rb") as of_it:
        assert (holder, "READ") in lock._list_holders(os.fstat(of_it.fileno()))


def test_recordings_that_are_written_are_listed(others: Holders) -> None:
    assert str(others.path) not in lock.list_written()
    others.hold("shared")
    assert str(others.path) in lock.list_written()


def test_unknown_holder_is_not_named(others: Holders, monkeypatch: pytest.MonkeyPatch) -> None:
    others.hold("shared")
    monkeypatch.setattr(lock, "_list_holders", lambda _file: [])
    assert "process" not in others.refusal()


def test_lock_ends_with_its_process(others: Holders) -> None:
    others.hold("shared")
    others._stack.close()
    held = RecordingLock(others.path, shared=False)
    held.release()
    held.release()


def test_lock_of_a_missing_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecorderError, match=r"nothing\.rrd.*No such file"):
        RecordingLock(tmp_path / "nothing.rrd", shared=False)
