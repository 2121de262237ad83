"""A session with many clients has descriptors above 1023, which `select.select` rejects: our code never uses it."""

from __future__ import annotations

import os
import resource
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from iris_session.cli.live import TerminalView
from iris_session.emulator.runner import DisturbanceReader
from iris_session.netsim.process import ImpairmentProcess
from iris_session.protocol.server_messages import Event, MarkerAdded
from iris_session.recording import RecorderProcess
from tests.loopback import make_loopback_address

ROOT = Path(__file__).parents[1]
BEYOND = 1024


@pytest.fixture
def no_low_descriptors() -> Iterator[None]:
    """Occupy every descriptor below 1024."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 4 * BEYOND), hard))
    taken = [os.open(os.devnull, os.O_RDONLY)]
    try:
        while taken[-1] < BEYOND:
            taken.append(os.dup(taken[0]))
        yield
    finally:
        for fd in taken:
            os.close(fd)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


class _Session:
    """The part of a session that `TerminalView` uses; its status fills a pipe, so that writing must wait."""

    def recent_events(self) -> list[Event]:
        return [Event(1, 0, 0, MarkerAdded("p1", "hello"))]

    def status(self) -> _Session:
        return self

    def as_dict(self) -> dict[str, str]:
        return {"text": "x" * 200_000}


def test_nothing_uses_select() -> None:
    users = [path for path in (ROOT / "iris_session").rglob("*.py") if "select.select(" in path.read_text("utf-8")]
    assert users == []


@pytest.mark.usefixtures("no_low_descriptors")
def test_orders_are_read() -> None:
    read, write = os.pipe()
    assert read > BEYOND
    os.write(write, b"bump ann\n")
    assert DisturbanceReader(read, ["ann"])() == [("bump", "ann")]
    os.close(read)
    os.close(write)


@pytest.mark.e2e
@pytest.mark.usefixtures("no_low_descriptors")
def test_processes_are_read(tmp_path: Path) -> None:
    recorder = RecorderProcess(tmp_path / "session.rrd", time.monotonic_ns())
    recorder.start()
    assert recorder.alive
    assert recorder.close()
    with ImpairmentProcess({make_loopback_address(): "none"}, []) as proxy:
        assert proxy.execute("stats")["ok"]
    with (tmp_path / "shown").open("w+") as out:
        with TerminalView(_Session(), out, "title").open() as update:  # type: ignore[arg-type]
            update()
        out.seek(0)
        assert "hello" in out.read()
