"""`iris-session status` of a session with people in it: text, JSON, metrics."""

from __future__ import annotations

import json
import signal
import subprocess
import urllib.request
from pathlib import Path

import pytest

from iris_session.client import Client
from tests.e2e.conftest import COMMAND, DEADLINE_S, Server, iris

pytestmark = pytest.mark.e2e


def test_status_for_people_and_programs(house: Server) -> None:
    with Client(house.address, name="ann", alignment="not_needed").connect(DEADLINE_S).start() as ann:
        ann.acquire(["left"])
        text = iris("status", house.address, cwd=house.folder)
        assert text.returncode == 0, text.stderr
        assert "ann (p" in text.stdout
        assert "late ticks:" in text.stdout
        report = json.loads(iris("status", house.address, "--json", cwd=house.folder).stdout)
        holders = {robot["name"]: robot["holder_name"] for robot in report["robots"]}
        assert holders == {"left": "ann", "right": ""}
        assert {p["name"] for p in report["participants"]} >= {"ann", "status"}


def test_status_of_a_session_that_stands_still(house: Server) -> None:
    Client(house.address, role="observer").connect(DEADLINE_S).close()  # it steps
    house.process.send_signal(signal.SIGSTOP)
    try:
        done = iris("status", house.address, cwd=house.folder)
    finally:
        house.process.send_signal(signal.SIGCONT)
    assert done.returncode == 0, done.stderr
    assert "STALLED for" in done.stdout.splitlines()[0]


def test_status_of_nothing(tmp_path: Path) -> None:
    done = iris("status", "127.0.0.1:1", cwd=tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("iris-session: no session answers at 127.0.0.1:1")
    assert len(done.stderr.splitlines()) == 1


def test_metrics(house: Server) -> None:
    metrics = iris("status", house.address, "--prometheus", cwd=house.folder).stdout
    assert 'iris_session_robot_held{robot="right",holder=""} 0' in metrics
    assert "iris_session_stalled 0" in metrics
    with subprocess.Popen(
        [*COMMAND, "status", house.address, "--metrics-port", "0"],
        stdout=subprocess.PIPE,
        text=True,
        # Tests that run in the background inherit that Ctrl-C is ignored; a command in a terminal does not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509 (no threads yet)
    ) as process:
        try:
            assert process.stdout is not None
            url = process.stdout.readline().split()[-1]
            with urllib.request.urlopen(url, timeout=10.0) as answer:
                assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
                assert "iris_session_time_seconds" in answer.read().decode()
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(10.0)
        assert process.returncode == 130
