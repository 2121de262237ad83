"""Output of `iris-session status`: screens, metrics, lines. With a session: tests/rig."""

from __future__ import annotations

import argparse
import re
from typing import Any

import msgspec
import pytest

from iris_session.cli.common import print_result
from iris_session.cli.metrics import format_metrics
from iris_session.cli.status import format_status
from iris_session.protocol.media import StreamBudget
from iris_session.protocol.status import (
    AlignmentReport,
    AssetsReport,
    MediaStreamReport,
    ParticipantReport,
    Quantiles,
    RecorderReport,
    RobotReport,
    StatusReport,
    StopReport,
)
from tests.cli.conftest import CommandLine

ANN = ParticipantReport(
    "p1",
    'ann "\x1b[2J\n',
    "operator",
    True,
    alignment="measured",
    alignment_age_ns=3_000_000_000,
    alignment_error_m=0.0042,
    holds=("left",),
    samples_per_s=72.0,
    state_age=Quantiles(1.5, 4.0),
    capture_to_receive=Quantiles(8.0, 20.0),
    missed_share=0.1,
    rtt_ms=2.0,
    heard_ns=10_000_000,
    rejected={"stale": 2},
    reported=True,
    shown_age_ms=61.5,
)
BOB = ParticipantReport("p2", "bob", "operator", False, alignment_void_ns=4_000_000_000, lost="silent")
REPORT = StatusReport(
    1,
    "s1",
    "lab",
    60_000_000_000,
    tick=30_000,
    late_share=0.02,
    late_causes={"physics": 9},
    lateness=Quantiles(0.3, 2.5),
    step_to_publish=Quantiles(0.5, 1.0),
    participants=(ANN, BOB),
    robots=(
        RobotReport("left", "exclusive", "p1", "ann", "pose", "", Quantiles(1.0, 3.0), ("p2",)),
        RobotReport("right", "exclusive", state="hold", hold_reason="no_lease"),
    ),
    recorder=RecorderReport("running", "/data/s.rrd", 1_000_000, 5_000_000_000),
    drops={"rate": 3},
    restarts={"front": 1, "recorder": 0},
    warnings=("mind the gap",),
    authority_silent_ns=2_000_000,
)
#: One line of the exposition format: a name, labels with escaped values, a number.
SAMPLE = re.compile(r'iris_session_[a-z_]+(\{[a-z_]+="(\\.|[^"\\])*"(,[a-z_]+="(\\.|[^"\\])*")*\})? -?[0-9.e+-]+')


def show(capsys: pytest.CaptureFixture[str], **changes: object) -> list[str]:
    """Return the lines that a report is printed as, changed in some fields."""
    report = msgspec.structs.replace(REPORT, **changes)
    print_result(argparse.Namespace(json=False), report, format_status(report))
    return capsys.readouterr().out.splitlines()


def test_screen_shows_every_part(capsys: pytest.CaptureFixture[str]) -> None:
    shown = show(
        capsys, paused=True, pause_reason="NaN in QPOS at DOF 3", assets=AssetsReport(183, 17_500_000, 400, 3, 2)
    )
    text = "\n".join(shown)
    assert len(shown) < 28
    for words in ("lab", "measured 4 mm, 3 s", "1.5/4.0", "OFFLINE silent", "void for 4 s", "no_lease", "physics 9"):
        assert words in text
    for words in ("device -> front 20.0 ms", "front 1", "mind the gap", "NaN in QPOS", "iris-session reset"):
        assert words in text
    assert "tick 0.5, network 1.0, render 60.0" in text
    assert "183 served, 17.5 MB sent, 3 refused; 2 clients" in text
    assert all(line.isprintable() for line in shown), "names come from other users"


def test_status_shows_streams_with_subscribers_faults_and_ages(capsys: pytest.CaptureFixture[str]) -> None:
    ann = ParticipantReport("p1", "ann", "observer", True, media=(StreamBudget("room", "full", 20.0),))
    budget = StreamBudget("room", "quarter", 5.0)
    bob = ParticipantReport("p2", "bob", "observer", True, media=(budget,), media_drops=7)
    well = MediaStreamReport("room", 30.0, 20.0, "cam-1", encoding="cloud", age_ms=20.0, title="The room")
    faulty = msgspec.structs.replace(
        well, stream="hand", stale=True, age_ms=2_500.0, fault="frozen", detail="3 s\x1b[2J"
    )
    lines = show(capsys, participants=(ann, bob), media=(well, faulty))
    receivers = "ann (p1) full, bob (p2) quarter"
    assert f"media room (The room): 30 Hz, 20.0 Mbit/s from cam-1; {receivers}; newest frame 20 ms old" in lines
    assert any(
        line.startswith("media hand") and "STALE, no frame for 2.5 s; FAULT frozen: 3 s" in line for line in lines
    )
    assert any("7 to bob (p2)" in line for line in lines)


@pytest.mark.parametrize(
    "changes", [{"alignment": "placed"}, {"alignment": "measured", "alignment_report": AlignmentReport(offset=True)}]
)
def test_placed_and_moved_alignments_have_no_stated_error(
    changes: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    lines = show(capsys, participants=(msgspec.structs.replace(ANN, **changes),))
    assert any(f"{changes['alignment']} -, 3 s" in line for line in lines)


def test_whoever_stopped_the_session_is_listed(capsys: pytest.CaptureFixture[str]) -> None:
    stops = (StopReport(4, "p2", "bob", "a hand in the cell", 12_300_000_000), StopReport(3, "", "", "", 0))
    lines = show(capsys, estop=True, stops=stops)
    assert any("e-stop 4" in line and "bob (p2)" in line and "12.3 s" in line and "a hand" in line for line in lines)
    assert any("e-stop 3" in line and "not joined" in line for line in lines)


def test_empty_report_can_be_shown() -> None:
    empty = StatusReport(0, "", "", 0)
    assert list(format_status(empty))
    assert "iris_session_late_tick_share 0" in format_metrics(empty)


def test_metrics_are_well_formed() -> None:
    text = format_metrics(REPORT)
    assert text.endswith("\n")
    names: list[str] = []
    for line in text.splitlines():
        if line.startswith("# TYPE "):
            names.append(line.split()[2])
            assert line.split()[3] in ("gauge", "counter")
        elif not line.startswith("# HELP "):
            assert SAMPLE.fullmatch(line), line
            assert line.startswith(names[-1])
    assert len(names) == len(set(names))
    for sample in (
        'late_ticks{cause="physics"} 9',
        'robot_held{robot="left",holder="ann"} 1',
        'robot_state{robot="right",state="hold",reason="no_lease"} 1',
        'participant_connected{participant="p2",name="bob",role="operator"} 0',
        'tick_lateness_seconds{quantile="0.99"} 0.0025',
        "recorder_disk_free_bytes 5e+09",
    ):
        assert f"iris_session_{sample}\n" in text
    assert 'name="ann \\"\x1b[2J\\n"' in text
    assert 'reason="stale"} 2' in text
    lines_of_bob = [line for line in text.splitlines() if 'name="bob"' in line]
    assert not any("state_age" in line or "missed" in line for line in lines_of_bob), "not measured"


def test_doctor_takes_an_address_as_a_check(cli: CommandLine) -> None:
    assert "is not HOST:PORT" in cli.run("doctor", "nowhere:port", status=1)
