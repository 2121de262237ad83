"""`iris-session status` of a session with participants: text, JSON, metrics."""

from __future__ import annotations

import json
import signal
import subprocess
import urllib.request
from pathlib import Path

import pytest

from iris_session.client import Client
from tests.e2e.session_process import COMMAND, DEADLINE_S, SessionProcess, run_command, wait_until

pytestmark = pytest.mark.e2e


def test_status_as_text_and_json(shared_session: SessionProcess) -> None:
    with Client(shared_session.address, name="ann", alignment="not_needed").connect(DEADLINE_S).start() as ann:
        ann.acquire(["left"])
        text = run_command("status", shared_session.address, cwd=shared_session.folder)
        assert text.returncode == 0, text.stderr
        assert "ann" in text.stdout
        report = json.loads(run_command("status", shared_session.address, "--json", cwd=shared_session.folder).stdout)
        holders = {robot["name"]: robot["holder_name"] for robot in report["robots"]}
        assert holders == {"left": "ann", "right": ""}
        assert {p["name"] for p in report["participants"]} >= {"ann", "status"}


def test_status_of_a_suspended_session_is_stalled(shared_session: SessionProcess) -> None:
    Client(shared_session.address, role="observer").connect(DEADLINE_S).close()  # the session steps
    shared_session.process.send_signal(signal.SIGSTOP)
    try:
        done = run_command("status", shared_session.address, cwd=shared_session.folder)
    finally:
        shared_session.process.send_signal(signal.SIGCONT)
    assert done.returncode == 0, done.stderr
    assert "STALLED" in done.stdout.splitlines()[0]


def test_status_without_a_session_is_one_line(tmp_path: Path) -> None:
    done = run_command("status", "127.0.0.1:1", cwd=tmp_path)
    assert done.returncode == 2
    assert "127.0.0.1:1" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.long
def test_status_as_metrics(shared_session: SessionProcess) -> None:
    def are_right() -> bool:
        """On a busy machine the session may stand still at this moment, which is reported as stalled."""
        metrics = run_command("status", shared_session.address, "--prometheus", cwd=shared_session.folder).stdout
        assert 'iris_session_robot_held{robot="right",holder=""} 0' in metrics
        return "iris_session_stalled 0" in metrics

    wait_until(are_right, "the metrics of a session that steps")
    with subprocess.Popen(
        [*COMMAND, "status", shared_session.address, "--metrics-port", "0"],
        stdout=subprocess.PIPE,
        text=True,
        # Tests in the background inherit an ignored SIGINT; a command in a terminal does not.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # noqa: PLW1509 (no threads yet)
    ) as process:
        try:
            assert process.stdout is not None
            url = process.stdout.readline().split()[-1]
            with urllib.request.urlopen(url, timeout=DEADLINE_S) as answer:
                assert answer.headers["Content-Type"].startswith("text/plain; version=0.0.4")
                assert "iris_session_time_seconds" in answer.read().decode()
        finally:
            process.send_signal(signal.SIGINT)
            process.wait(DEADLINE_S)
        assert process.returncode == 130
