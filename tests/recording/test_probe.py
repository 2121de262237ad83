"""The probe process that reads files with Rerun: reuse, end, restart."""

from __future__ import annotations

import os
import threading
import time
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
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
    found = []
    for process in psutil.Process().children():
        with suppress(psutil.NoSuchProcess):  # another one, which has ended
            if "iris_session.recording.probe" in process.cmdline():
                found.append(process)
    return found


def test_message_that_claims_a_terabyte_is_not_readable(tmp_path: Path) -> None:
    """One flipped bit in the length of a batch of columns: Arrow zeroes as many bytes, page by page."""
    path, most = tmp_path / "session.rrd", 0
    path.write_bytes((Path(__file__).parent / "claims_a_terabyte.rrd").read_bytes())
    with Prober() as prober, ThreadPoolExecutor() as pool:
        answer = pool.submit(prober.is_readable, path)
        while not answer.done():
            for child in asked():
                with suppress(psutil.NoSuchProcess):
                    most = max(most, child.memory_info().rss)
                    if most > 3 << 30:
                        child.kill()
            time.sleep(0.01)
        assert not answer.result()
    assert 0 < most < 1 << 30


@pytest.mark.long
def test_probe_process_is_reused_and_at_most_one_kept(path: Path) -> None:
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


@pytest.mark.long
def test_probe_that_ended_between_requests_is_restarted(path: Path) -> None:
    with Prober() as prober:
        assert prober.is_readable(path)
        asked()[0].kill()
        assert prober.is_readable(path)


def test_probe_that_ended_during_a_request_is_restarted(path: Path) -> None:
    with Prober() as prober:
        assert prober.is_readable(path)
    (kept,) = asked()
    kept.kill()
    with Prober() as prober:
        assert prober.is_readable(path)
    assert kept not in asked()


def test_idle_probe_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(probe, "IDLE_S", 0.01)
    reading, writing = os.pipe()
    with open(reading) as questions, open(writing, "w"):
        monkeypatch.setattr("sys.stdin", questions)
        main = threading.Thread(target=probe.main, daemon=True)
        main.start()
        main.join(60.0)
        assert not main.is_alive()


def test_forked_process_does_not_use_the_probe_of_its_parent(path: Path) -> None:
    with Prober() as prober:
        assert prober.is_readable(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # other threads: the fork does nothing but look
        pid = os.fork()
    if pid == 0:
        os._exit(0 if probe._spare.pop_child() is None else 1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    assert len(asked()) == 1
