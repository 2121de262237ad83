"""`iris-session demo handover`: the whole product in one command."""

from __future__ import annotations

import json
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from tests.e2e.conftest import COMMAND, DEMO_S, iris, none_left, relatives, verify, wait

pytestmark = pytest.mark.e2e

#: What a started demo consists of: front, recorder, display and two emulated people.
CHILDREN = 5


def test_the_hammer_changes_hands_and_the_recording_verifies(tmp_path: Path) -> None:
    done = iris("demo", "handover", "--json", cwd=tmp_path, timeout_s=DEMO_S)
    assert done.returncode == 0, (done.stdout, done.stderr[-3000:])
    result = json.loads(done.stdout)  # exactly one object
    assert result["ok"] is True
    assert set(result) >= {
        *("ok", "seconds", "participants", "handovers", "recording", "alignment_mm", "late_tick_share"),
        *("verified", "problems"),
    }
    assert result["participants"] == ["ann", "bob"]
    assert result["problems"] == []
    assert result["verified"] is True
    (handover,) = result["handovers"]
    assert set(handover) == {"object", "giver", "receiver", "at_s", "duration_s"}
    assert handover["object"] == "hammer"
    assert handover["giver"] != handover["receiver"]
    assert 0.0 < handover["at_s"] < result["seconds"]
    assert handover["duration_s"] > 0.1
    for error in result["alignment_mm"].values():
        assert 0.0 < error["at_sheet"] < 2.0 * error["stated_p95"]
    assert 0.0 <= result["late_tick_share"] <= 1.0
    recording = Path(result["recording"])
    assert recording.parts[0] == "sessions"
    assert recording.name == "session.rrd"
    assert "handover" in done.stderr  # the display tells it while it happens
    report = verify(tmp_path / recording)
    assert report["recording_class"] == "closed"
    assert report["finished"]


@pytest.fixture
def demo(tmp_path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A demo that is on its way: every process of it runs and both people have joined."""
    out = tmp_path / "demo.out"
    with out.open("wb") as file:
        process = subprocess.Popen([*COMMAND, "demo", "handover"], stdout=file, stderr=file, cwd=tmp_path)
    wait(lambda: out.read_text().count("participant_joined") == 2, "both people join")
    yield process
    if process.poll() is None:
        for child in relatives(process.pid):
            child.kill()
        process.kill()
        process.wait()


def test_no_handover_in_time_fails_and_says_why(tmp_path: Path) -> None:
    done = iris("demo", "handover", "--json", "--timeout", "4", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    result = json.loads(done.stdout)
    assert result["ok"] is False
    assert result["handovers"] == []
    text = " ".join(result["problems"])
    assert "not done within 4 s" in text
    assert "no handover" in text
    assert result["verified"] is True, "what was recorded is still true"


def test_ctrl_c_in_the_middle_leaves_nothing_behind(demo: subprocess.Popen[bytes], tmp_path: Path) -> None:
    children = relatives(demo.pid)
    assert len(children) == CHILDREN
    demo.send_signal(signal.SIGINT)
    wait(lambda: demo.poll() is not None, "the demo ends")
    assert demo.wait() == 130
    none_left(children)
    assert "interrupted" in (tmp_path / "demo.out").read_text()
    (recording,) = tmp_path.glob("sessions/*/session.rrd")
    assert verify(recording)["finished"]


def test_a_killed_demo_leaves_nothing_behind(demo: subprocess.Popen[bytes], tmp_path: Path) -> None:
    children = relatives(demo.pid)
    assert len(children) == CHILDREN
    demo.kill()
    demo.wait()
    none_left(children)
    assert not [p for p in psutil.process_iter() if p.pid in {c.pid for c in children} and p.is_running()]
    (recording,) = tmp_path.glob("sessions/*/session.rrd")
    assert verify(recording)["finished"]
