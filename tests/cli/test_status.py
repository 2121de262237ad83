"""Output of `iris-session status` and `doctor`: screens, metrics, lines. End to end: tests/e2e."""

from __future__ import annotations

import re

import msgspec
import pytest

from iris_session.cli.doctor import format_findings, format_verdict
from iris_session.cli.main import main
from iris_session.cli.metrics import format_metrics
from iris_session.cli.status import format_status
from iris_session.doctor.findings import Finding, failed, ok, warning
from iris_session.protocol.media import StreamBudget
from iris_session.protocol.status import (
    NOT_PUBLISHED,
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


def test_screen_shows_every_part() -> None:
    shown = format_status(REPORT)
    text = "\n".join(shown)
    assert len(shown) < 25
    for words in ("lab", "measured 4 mm, 3 s", "1.5/4.0", "OFFLINE silent", "void for 4 s", "no_lease", "physics 9"):
        assert words in text
    assert "device -> front 20.0 ms" in text
    assert "front 1" in text
    assert "mind the gap" in text
    assert all(line.isprintable() for line in shown)


def test_status_shows_assets() -> None:
    without = format_status(msgspec.structs.replace(REPORT, assets=AssetsReport()))
    assert "assets:" not in "\n".join(without)
    report = msgspec.structs.replace(REPORT, assets=AssetsReport(183, 17_500_000, 400, 3, 2))
    text = "\n".join(format_status(report))
    for value in ("183 served", "17.5 MB", "3 refused", "2 clients"):
        assert value in text
    assert "iris_session_assets_bytes_total 17500000" in format_metrics(report)


def test_status_shows_media_with_subscribers() -> None:
    ann = ParticipantReport("p1", "ann", "observer", True, media=(StreamBudget("cloud", "full", 20.0),))
    bob = ParticipantReport(
        "p2", "bob", "observer", True, media=(StreamBudget("cloud", "quarter", 5.0),), media_drops=7
    )
    streams = (MediaStreamReport("cloud", 30.0, 20.0, "cam-1", 2), MediaStreamReport("cloth", 60.0, 2.0))
    text = "\n".join(format_status(msgspec.structs.replace(REPORT, participants=(ann, bob), media=streams)))
    assert "ann (p1) full, bob (p2) quarter; newest frame" in text
    assert "7 to bob (p2)" in text
    assert "60 Hz, 2.0 Mbit/s" in text


def test_status_shows_title_fault_and_age_of_streams() -> None:
    well = MediaStreamReport("room", 30.0, 20.0, "cam-1", encoding="cloud", age_ms=20.0, title="The room")
    faulty = msgspec.structs.replace(
        well, stream="hand", stale=True, age_ms=2_500.0, fault="moved", detail="3 cm\x1b[2J"
    )
    lines = format_status(msgspec.structs.replace(REPORT, media=(well, faulty)))
    assert "media room (The room): 30 Hz, 20.0 Mbit/s from cam-1; no subscribers; newest frame 20 ms old" in lines
    (shown,) = [line for line in lines if line.startswith("media hand")]
    assert "STALE, no frame for 2.5 s; FAULT moved: 3 cm" in shown
    assert shown.isprintable()


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"stalled": True, "authority_silent_ns": 2_500_000_000}, "STALLED for 2.5 s"),
        ({"authority_silent_ns": -1}, "NOT STARTED"),
        ({"estop": True}, "E-STOP"),
        ({"paused": True}, "paused"),
        ({}, "running"),
        ({"warnings": ("a disk", f"{NOT_PUBLISHED} 8.5 s: the program stands still")}, "'lab'  silent for 8.5 s  tick"),
    ],
)
def test_first_line_shows_state(fields: dict[str, object], words: str) -> None:
    assert words in format_status(msgspec.structs.replace(REPORT, **fields))[0]


def test_the_reason_of_a_pause_is_shown() -> None:
    lines = format_status(msgspec.structs.replace(REPORT, paused=True, pause_reason="NaN in QPOS at DOF 3"))
    assert "paused" in lines[0]
    assert any("NaN in QPOS" in line and "iris-session reset" in line for line in lines)


def test_a_placed_alignment_has_no_stated_error() -> None:
    placed = msgspec.structs.replace(ANN, alignment="placed", alignment_error_m=0.0)
    (row,) = (
        line for line in format_status(msgspec.structs.replace(REPORT, participants=(placed,))) if "placed" in line
    )
    assert "placed -, 3 s" in row
    moved = msgspec.structs.replace(ANN, alignment_error_m=0.0, alignment_report=AlignmentReport(offset=True))
    assert any("measured -, 3 s" in r for r in format_status(msgspec.structs.replace(REPORT, participants=(moved,))))


def test_whoever_stopped_the_session_is_listed() -> None:
    stops = (StopReport(4, "p2", "bob", "a hand\nin the cell", 12_300_000_000), StopReport(3, "", "", "", 0))
    lines = format_status(msgspec.structs.replace(REPORT, estop=True, stops=stops))
    assert any("e-stop 4" in line and "bob (p2)" in line and "12.3 s" in line and "a hand" in line for line in lines)
    assert any("e-stop 3" in line and "not joined" in line for line in lines)


def test_empty_report_can_be_shown() -> None:
    empty = StatusReport(0, "", "", 0)
    assert format_status(empty)
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


def test_doctor_prints_findings_as_lines() -> None:
    found = [
        ok("tcp", "open"),
        warning("age", "old \x1b[31m", "Wi-Fi", "nearer"),
        failed("key", "unknown", "", "pair"),
        Finding("join", "skipped", "not looked at"),
    ]
    shown = format_findings(found)
    assert [line.split()[0] for line in shown] == ["ok", "WARNING", "why:", "do:", "FAILED", "do:"]
    assert all(line.isprintable() for line in shown)
    assert format_verdict(found) == "FAILED: key; warnings: age; 1 skipped"
    assert len(format_findings(found, show_skipped=True)) == len(shown) + 1
    assert "warnings: age" in format_verdict(found[:2])
    assert format_verdict(found[:1]) == "all well"


def test_invalid_address(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["doctor", "nowhere:port"]) == 1
    assert "is not HOST:PORT" in capsys.readouterr().out
    assert main(["status", "nowhere:port"]) == 2
    assert "is not HOST:PORT" in capsys.readouterr().err
