"""The end of a session: signals in any state end it in order, without a traceback, and no process stays."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.e2e.scenario import Hand, Scenario
from tests.e2e.session_process import (
    COMMAND,
    DEADLINE_S,
    FREE_PORTS,
    SessionProcess,
    assert_all_end,
    list_descendants,
    run_verify,
    wait_until,
)  # fmt: skip

pytestmark = pytest.mark.e2e

SERVE = [*COMMAND, "serve", "handover", "--no-beacon", *FREE_PORTS]
#: A session ends within 2 s of Ctrl-C; on a busy machine it may take much longer.
END_S = 30.0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_signal_ends_the_session_in_order(serve: Callable[..., SessionProcess], number: signal.Signals) -> None:
    before = signal.signal(number, signal.SIG_DFL)  # where these tests run under nohup, sessions ignore SIGHUP too
    try:
        server = serve("handover", "--json")
    finally:
        signal.signal(number, before)
    scenario = Scenario(server)
    ann = scenario.join("ann", "observer")
    children = list_descendants(server.process.pid)
    server.process.send_signal(number)
    wait_until(lambda: server.process.poll() is not None, "the session ends")
    assert server.process.wait() == 0, server.output
    assert_all_end(children)
    scenario.run_until(lambda: not ann.connection.is_joined, "ann has disconnected")
    scenario.close()
    assert server.verify()["finished"]


def interrupt(server: SessionProcess) -> None:
    """Press Ctrl-C; the session must end soon, and no process may stay."""
    children = list_descendants(server.process.pid)
    began = time.monotonic()
    server.process.send_signal(signal.SIGINT)
    wait_until(lambda: server.process.poll() is not None, "the session ends", END_S)
    print(f"ended after {time.monotonic() - began:.2f} s")
    assert_all_end(children)


@pytest.mark.long
def test_ctrl_c_while_one_client_joins_and_another_drives(
    scenario: Scenario, driving: Hand, emulate: Callable[..., subprocess.Popen[bytes]]
) -> None:
    headset = emulate(scenario.server.address, "name=eve,behaviour=idle")
    scenario.run_until(lambda: scenario.has_seen_joining("ann", "eve"), "eve has sent hello")
    headset.send_signal(signal.SIGSTOP)
    try:
        interrupt(scenario.server)
    finally:
        headset.send_signal(signal.SIGCONT)
    assert scenario.server.process.returncode == 0
    assert scenario.server.verify()["finished"]


@pytest.mark.long
def test_ctrl_c_while_the_recorder_hangs(scenario: Scenario, driving: Hand) -> None:
    """Rows that the recorder did not receive are lost, which is reported; the rest verifies."""
    scenario.run_until(scenario.server.count_recorded_rows, "rows are in the file")
    scenario.server.children()["recording.process"].suspend()
    scenario.run_for(0.3)
    interrupt(scenario.server)
    assert scenario.server.process.returncode == 1
    assert "recording is missing" in scenario.server.output
    report = run_verify(scenario.server.recording)
    assert not report["finished"]
    assert report["problems"] == []


def test_ctrl_c_while_the_front_hangs(scenario: Scenario, driving: Hand) -> None:
    scenario.server.children()["front.main"].suspend()
    interrupt(scenario.server)
    assert scenario.server.process.returncode == 0
    assert scenario.server.verify()["finished"]


def test_second_interrupt_at_once_ends_without_traceback(tmp_path: Path) -> None:
    process = subprocess.Popen(SERVE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path)
    assert process.stdout is not None
    assert "session 'handover'" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=DEADLINE_S)
    assert "Traceback" not in errors
    assert process.returncode in (0, 130)  # 0: both signals arrived as one
