"""`iris-session demo handover`, when its operators fail and when it is interrupted."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from iris_session.demo import run
from iris_session.demo.demos import make_demo
from iris_session.session.config import SessionConfig
from tests.e2e.session_process import (
    COMMAND,
    DEMO_S,
    assert_all_end,
    list_descendants,
    run_verify,
    wait_until,
)

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(DEMO_S + 120.0)]


#: Processes of a demo: front, recorder, display and two emulated headsets.
CHILDREN = 5


@pytest.mark.long
def test_failed_operators_begin_again_from_a_reset_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    listed = run._EmulatorGroup.list_failures
    failed: list[str] = []

    def fail_once_at_work(people: run._EmulatorGroup) -> list[str]:
        if not failed and any("close" in phase for one in people.reports.values() for phase in one.phases):
            failed.append("ann: dropped it")
            return failed
        return listed(people)

    monkeypatch.setattr(run._EmulatorGroup, "list_failures", fail_once_at_work)
    config = SessionConfig(control_port=0, state_port=0, record=tmp_path / "session.rrd")
    result = run.run_demo(make_demo("handover"), config, timeout_s=360.0)
    assert (result.ok, result.verified) == (True, True), result.problems
    assert 2 <= result.attempts <= 3  # on a busy machine an operator may fail by itself, too
    assert "dropped it" in "".join(result.notes)
    assert [one.object for one in result.handovers] == ["hammer"]


@pytest.fixture
def demo(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A running demo: every process has started and both operators have joined."""
    out = tmp_path / "demo.out"
    with out.open("wb") as file:
        process = subprocess.Popen([*COMMAND, "demo", "handover"], stdout=file, stderr=file, cwd=tmp_path)
    wait_until(lambda: out.read_text().count("participant_joined") == 2, "both operators join")
    yield process
    if process.poll() is None:
        for child in list_descendants(process.pid):
            child.kill()
        process.kill()
        process.wait()


@pytest.mark.long
def test_ctrl_c_leaves_no_process_and_a_finished_recording(demo: subprocess.Popen[bytes], tmp_path: Path) -> None:
    children = list_descendants(demo.pid)
    assert len(children) == CHILDREN
    demo.send_signal(signal.SIGINT)
    wait_until(lambda: demo.poll() is not None, "the demo ends")
    assert demo.wait() == 130
    assert_all_end(children)
    assert "interrupted" in (tmp_path / "demo.out").read_text()
    (recording,) = tmp_path.glob("sessions/*/session.rrd")
    assert run_verify(recording)["finished"]
