"""Who has a recording in use: shared by a session's processes, alone for who continues it; and who is named."""

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
        """Process id of one more."""
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
        """What somebody is told who does not get the lock."""
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


def test_a_session_shares_it_and_who_continues_it_is_told_whose_it_is(others: Holders) -> None:
    first = others.hold("shared")
    assert others.refusal() == f"the session that it is of still runs: process {first}"
    second = others.hold("shared")
    named = ", ".join(map(str, sorted((first, second))))
    assert others.refusal() == f"the session that it is of still runs: processes {named}"
    RecordingLock(others.path, shared=True, patience_s=0.0).release()


def test_who_continues_it_has_it_alone_and_is_named(others: Holders) -> None:
    alone = others.hold("alone")
    assert others.refusal() == f"it is being resumed by process {alone}"
    assert others.refusal(shared=True) == f"it is being resumed by process {alone}"


def test_who_has_another_file_of_that_number_is_not_named(others: Holders, tmp_path: Path) -> None:
    """`/proc/locks` names a file by its number, which is one file's on each of several file systems."""
    holder = others.hold("shared")
    beside = tmp_path / "other.rrd"
    beside.write_bytes(b"another")
    with beside.open("rb") as file, pytest.MonkeyPatch.context() as patch:
        patch.setattr(lock, "_is_of", lambda _lock, _file: True)
        assert lock._holders(os.fstat(file.fileno())) == []
        with others.path.open("rb") as of_it:
            assert (holder, "READ") in lock._holders(os.fstat(of_it.fileno()))


def test_where_the_system_does_not_tell_nobody_is_named(others: Holders, monkeypatch: pytest.MonkeyPatch) -> None:
    others.hold("shared")
    monkeypatch.setattr(lock, "_holders", lambda _file: [])
    assert others.refusal() == "the session that it is of still runs, or is being resumed"


def test_a_lock_ends_with_its_process_and_waits_for_it(others: Holders) -> None:
    others.hold("shared")
    others._stack.close()
    held = RecordingLock(others.path, shared=False)
    held.release()
    held.release()


def test_a_file_that_is_not_there_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RecorderError, match=r"nothing\.rrd cannot be opened: No such file"):
        RecordingLock(tmp_path / "nothing.rrd", shared=False)
