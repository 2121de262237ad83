"""Asking a process of its own what Rerun can read: it is kept for the next who asks, and its end harms nobody."""

from __future__ import annotations

import os
import threading
import warnings
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from iris_session.recording import probe
from iris_session.recording.probe import Prober
from tests.recording.support import journal, write


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return write(tmp_path / "session.rrd", *journal(20))


@pytest.fixture(autouse=True)
def _none_before() -> Iterator[None]:
    probe._spare.end()
    yield
    probe._spare.end()


def asked() -> list[psutil.Process]:
    return [p for p in psutil.Process().children() if "iris_session.recording.probe" in p.cmdline()]


def test_a_process_that_answered_is_asked_again_and_at_most_one_is_kept(path: Path) -> None:
    with Prober() as first, Prober() as second:
        assert asked() == []
        assert first.is_readable(path)
        (one,) = asked()
        assert second.count_recordings(path) == 1
        (other,) = set(asked()) - {one}
    assert asked() in ([one], [other])
    (kept,) = asked()
    with Prober() as prober:
        assert not prober.is_readable(path.with_name("none.rrd"))
        assert prober.is_readable(path)
        assert asked() == [kept]
        prober.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)  # an answer may still be on its way
        assert asked() == []


def test_one_that_ended_between_two_questions_is_not_taken_for_a_damaged_file(path: Path) -> None:
    with Prober() as prober:
        assert prober.is_readable(path)
        asked()[0].kill()
        assert prober.is_readable(path)


def test_one_that_ended_meanwhile_is_not_taken_for_a_damaged_file(path: Path) -> None:
    with Prober() as prober:
        assert prober.is_readable(path)
    (kept,) = asked()
    kept.kill()
    with Prober() as prober:
        assert prober.is_readable(path)
    assert kept not in asked()


def test_it_ends_where_nobody_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "IDLE_S", 0.01)
    reading, writing = os.pipe()
    with open(reading) as questions, open(writing, "w"):
        monkeypatch.setattr("sys.stdin", questions)
        main = threading.Thread(target=probe.main, daemon=True)
        main.start()
        main.join(60.0)
        assert not main.is_alive()


def test_a_fork_does_not_ask_what_its_parent_started(path: Path) -> None:
    with Prober() as prober:
        assert prober.is_readable(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads: the fork does nothing but look
        pid = os.fork()
    if pid == 0:
        os._exit(0 if probe._spare.take() is None else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert len(asked()) == 1
