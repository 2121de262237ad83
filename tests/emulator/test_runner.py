"""Emulated people in a live session: they align, drive, jump, recover, and report."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import msgspec
import numpy as np
import pytest

from iris_session import SceneBuilder, ScenePublisher, SessionConfig
from iris_session.client import Client
from iris_session.emulator.__main__ import _LinePrinter
from iris_session.emulator.headset import DEFAULT_ANCHOR_ID, DEFAULT_T_WORLD_ANCHOR
from iris_session.emulator.operator import REACT_S, EmulatedOperator
from iris_session.emulator.runner import run_headsets
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec
from iris_session.protocol.client_messages import Observation, Sample, TrackingEpoch
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import AlignmentAlarm
from iris_session.protocol.names import Device
from iris_session.protocol.server_messages import Event, Notice
from tests.client.harness import LiveSession

QUICK = {"viewpoints": 4, "observations_per_viewpoint": 4}


@pytest.fixture
def session() -> Iterator[LiveSession]:
    live = LiveSession(anchors={DEFAULT_ANCHOR_ID: Pose(*DEFAULT_T_WORLD_ANCHOR)}, forward_observations=True)
    yield live
    live.close()


def run_until(
    session: LiveSession,
    specs: list[HeadsetSpec],
    *phases: str,
    timeout_s: float = 40.0,
    orders: Callable[[], list[tuple[str, str]]] = list,
) -> list[HeadsetReport]:
    """Run the people until each has reached the phase at the same index."""
    reached: dict[str, set[str]] = {spec.name: set() for spec in specs}
    wanted = {spec.name: phase for spec, phase in zip(specs, phases, strict=True)}
    deadline = time.monotonic() + timeout_s

    def note(report: HeadsetReport) -> None:
        reached[report.name] |= {report.phase}

    def stop() -> bool:
        assert time.monotonic() < deadline, reached
        return all(phase in reached[name] for name, phase in wanted.items())

    return run_headsets(session.address, specs, report=note, stop=stop, orders=orders)


def test_two_people_align_and_drive_while_one_observes(session: LiveSession) -> None:
    specs = [
        HeadsetSpec(name="ann", behaviour="wander", robot="left", seed=1, **QUICK),
        HeadsetSpec(name="bob", behaviour="wander", robot="right", seed=2, **QUICK),
        HeadsetSpec(name="eve", seed=3, **QUICK),
    ]
    reports = run_until(session, specs, "work", "work", "watch")
    for report in reports:
        assert report.failed == ""
        assert report.alignment_error_mm < 5.0
        assert report.alignment_error_mm < report.stated_error_mm * 1.5
        assert report.observations >= 12
        assert report.samples > 100
        assert report.frames > 50
        # A machine that stalls makes samples stale, and the first estimates of the clocks differ.
        assert set(report.rejected) <= {"alignment_version", "stale", "future"}
    samples = [(e.connection, e.receive_ns, e.message.device) for e in session.messages_of(Sample)]  # type: ignore[union-attr]
    heads = {(connection, at) for connection, at, device in samples if device == Device.HEAD}
    hands = {(connection, at) for connection, at, device in samples if device != Device.HEAD}
    assert len({connection for connection, _ in heads}) == 3
    assert len(heads & hands) > 50  # samples of one time are sent in one message


def test_jump_of_the_tracking_frame_raises_an_alarm_and_restarts_alignment(session: LiveSession) -> None:
    spec = HeadsetSpec(name="ann", behaviour="wander", robot="left", **QUICK)
    began: list[str] = []
    jumped: list[tuple[str, str]] = []

    def note(report: HeadsetReport) -> None:
        if not began or began[-1] != report.phase:
            began.append(report.phase)

    def orders() -> list[tuple[str, str]]:
        if jumped or "work" not in began:
            return []
        jumped.append(("recentre", "ann"))
        return jumped

    (report,) = run_headsets(session.address, [spec], 40.0, note, lambda: began.count("work") == 2, orders=orders)
    assert [p for p in began if p in ("look", "work")] == ["look", "work", "look", "work"]
    assert report.alignment_error_mm < 5.0
    assert [e.message.tracking_epoch for e in session.messages_of(TrackingEpoch)] == [1]  # type: ignore[union-attr]
    epochs = [e.message.tracking_epoch for e in session.messages_of(Observation)]  # type: ignore[union-attr]
    assert epochs == sorted(epochs)
    assert set(epochs) == {0, 1}


def test_observations_are_sent_with_the_head_pose_of_their_time(session: LiveSession) -> None:
    jumped: list[tuple[str, str]] = []

    def orders() -> list[tuple[str, str]]:
        if jumped or not session.messages_of(Observation):
            return []
        jumped.append(("recentre", "eve"))
        return jumped

    run_until(session, [HeadsetSpec(name="eve", **QUICK)], "watch", orders=orders)
    heads = np.array([s.capture_ns for s in samples_of(session, Device.HEAD)])
    epochs = np.array([s.tracking_epoch for s in samples_of(session, Device.HEAD)])
    seen: list[Any] = [entry.message for entry in session.messages_of(Observation)]
    assert {one.tracking_epoch for one in seen} == {0, 1}
    near = 0
    for one in seen:
        # Of samples between two steps, long on a busy machine, one is kept: the nearest may lie beyond the jump.
        near += bool(np.abs(heads - one.capture_ns).min() < 50_000_000)
        if one.tracking_epoch == 0:
            assert one.capture_ns < heads[epochs == 1].min()
        else:
            assert one.capture_ns > heads[epochs == 0].max()
    assert near > len(seen) / 2


def test_bump_moves_head_and_hand_and_the_hand_returns(session: LiveSession) -> None:
    """An idle hand jumps with the tracking frame and returns to its shown place. No alarm is raised."""
    spec = HeadsetSpec(name="ann", behaviour="idle", robot="left", bump_m=(0.0, 0.0, 0.05), **QUICK)
    phase: list[str] = [""]
    bumped_ns: list[int] = []

    def orders() -> list[tuple[str, str]]:
        if phase[0] != "work" or bumped_ns:
            return []
        bumped_ns.append(session.now_ns)
        return [("bump", "ann")]

    def over() -> bool:
        return bool(bumped_ns) and session.now_ns - bumped_ns[0] > 1_500_000_000

    def note(report: HeadsetReport) -> None:
        phase[0] = report.phase

    (report,) = run_headsets(session.address, [spec], 40.0, note, over, orders=orders)
    assert over(), report
    assert not session.messages_of(TrackingEpoch)
    at = report.disturbed_ns["bump"]
    hand = [s for s in samples_of(session, Device.CONTROLLER_RIGHT) if s.capture_ns > at - 200_000_000]
    up = [s.pose.p[2] for s in hand if s.pose is not None]  # the frame rose: what is tracked sank
    before = np.mean([z for s, z in zip(hand, up, strict=True) if s.capture_ns < at])
    shown_ns, first = next((s.capture_ns, z) for s, z in zip(hand, up, strict=True) if s.capture_ns >= at)
    left = 1.0 - (shown_ns - at) / (REACT_S * 1e9)  # by the first sample after it, which a busy machine takes late
    assert first - before == pytest.approx(-0.05 * left, abs=0.008)
    assert up[-1] - before == pytest.approx(0.0, abs=0.003)


@pytest.mark.parametrize("beside", [(), ("shelf",)], ids=["headset", "sheet"])
def test_person_looks_at_the_sheet_after_an_alarm(session: LiveSession, beside: tuple[str]) -> None:
    """Unless the sheet itself was moved."""
    spec = HeadsetSpec(name="ann", behaviour="wander", robot="left", viewpoints=2, observations_per_viewpoint=4)
    began: list[str] = []
    alarmed_ns: list[int] = []

    def note(report: HeadsetReport) -> None:
        if not began or began[-1] != report.phase:
            began.append(report.phase)
        if report.phase == "work" and not alarmed_ns:
            alarmed_ns.append(session.now_ns)
            session.submit_from_front(AlignmentAlarm("changed", 0, DEFAULT_ANCHOR_ID, 0.012, 0, beside))

    def over() -> bool:
        if beside:
            return bool(alarmed_ns) and session.now_ns - alarmed_ns[0] > 1_500_000_000
        return began.count("work") == 2

    (report,) = run_headsets(session.address, [spec], 40.0, note, over)
    assert over(), report
    phases = [phase for phase in began if phase in ("look", "work")]
    assert phases == (["look", "work"] if beside else ["look", "work", "look", "work"])
    assert report.alarms == (0 if beside else 1)


def samples_of(session: LiveSession, device: str) -> list[Sample]:
    return [e.message for e in session.entries if isinstance(e.message, Sample) and e.message.device == device]


def test_killed_front_costs_only_a_reconnect(session: LiveSession) -> None:
    spec = HeadsetSpec(name="ann", behaviour="wander", robot="left", **QUICK)
    phase = [""]
    killed: list[int] = []

    def note(report: HeadsetReport) -> None:
        phase[0] = report.phase
        if report.phase == "work" and not killed:
            killed.append(session.front.pid)
            os.kill(session.front.pid, signal.SIGKILL)
        elif killed and report.reconnects and report.phase == "work" and session.commands["left"] == "pose":
            done.set()

    done = threading.Event()
    deadline = time.monotonic() + 40.0
    (report,) = run_headsets(
        session.address, [spec], report=note, stop=lambda: done.is_set() or time.monotonic() > deadline
    )
    assert done.is_set(), report
    assert report.reconnects == 1
    assert report.failed == ""


def test_lost_session_is_shown_and_fails() -> None:
    live = LiveSession(session_name="lab-7")
    reports: list[tuple[str, str, float]] = []

    def note(report: HeadsetReport) -> None:
        if report.frames > 20:
            live.close()
        reports.append((report.session, report.address, report.lost_s))

    (report,) = run_headsets(live.address, [HeadsetSpec(name="eve", **QUICK)], seconds=7.0, report=note)
    assert {one[:2] for one in reports if one[0]} == {("lab-7", live.address)}
    assert max(one[2] for one in reports) > 2.0
    assert report.phase == "failed"
    assert live.address in report.failed


def test_notice_for_another_participant_is_not_the_own_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Client, "participant_id", "p-1")
    operator = EmulatedOperator("127.0.0.1:1", HeadsetSpec(name="ann", behaviour="wander"), 0)
    for number, participant in enumerate(("p-2", "", "p-1", "p-2")):
        operator.client.on_event(Event(number, 0, 0, Notice("warning", f"for {participant}", participant)))  # type: ignore[misc]
        assert operator._refused_because == ("for p-1" if number >= 2 else "")
    operator.client.close()


def test_lines_name_the_session_once(capsys: pytest.CaptureFixture[str]) -> None:
    show = _LinePrinter()
    report = HeadsetReport(name="ann")
    show(report)
    report.session, report.address, report.phases = "lab\x1b1", "10.0.0.5:7721", {"watch": 1.0}
    show(report)
    report.lost_s = 3.0
    show(report, final=True)
    lines = capsys.readouterr().out.splitlines()
    assert [line.count("10.0.0.5:7721") for line in lines] == [0, 1, 0, 0]
    assert [line.count("session lost") for line in lines] == [0, 0, 0, 1]
    assert all(line.isprintable() for line in lines)


def test_person_without_a_robot_reports_the_reason(session: LiveSession) -> None:
    specs = [HeadsetSpec(name="ann", behaviour="wander", robot="nothing", phase_timeout_s=6.0, **QUICK)]
    (report,) = run_headsets(session.address, specs, seconds=30.0)
    assert "nothing" in report.failed
    assert report.phase == "failed"


def test_session_without_robots_is_joined_without_waiting() -> None:
    scene = SceneBuilder()
    scene.add_box(half_size=(0.1, 0.1, 0.1))
    anchors = {DEFAULT_ANCHOR_ID: DEFAULT_T_WORLD_ANCHOR}
    config = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False, anchors=anchors)
    with ScenePublisher(scene, config) as shown:
        (report,) = run_headsets(shown.address, [HeadsetSpec(name="ann", behaviour="wander", **QUICK)], seconds=60.0)
    assert "no robots" in report.failed


def test_person_without_a_requested_robot_drives_the_assigned_one(session: LiveSession) -> None:
    specs = [HeadsetSpec(name="ann", behaviour="wander", **QUICK)]
    reports: list[str] = []

    def driving() -> bool:
        return any(phase.startswith("work/") for phase in reports)

    (report,) = run_headsets(session.address, specs, 30.0, lambda r: reports.extend(r.phases), driving)
    assert driving(), report


def test_missing_session_is_a_failure_not_an_exception() -> None:
    (report,) = run_headsets("127.0.0.1:1", [HeadsetSpec(name="ann")], seconds=0.3)
    assert report.phase == "failed"
    assert "127.0.0.1:1" in report.failed
    assert report.participant == ""


def test_json_lines_are_printed(session: LiveSession) -> None:
    specs = msgspec.json.encode([HeadsetSpec(name="eve", **QUICK), HeadsetSpec(name="ann", seed=1, **QUICK)])
    command = [sys.executable, "-m", "iris_session.emulator", "--address", session.address, "--specs", "-", "--json"]
    result = subprocess.run([*command, "--seconds", "4"], input=specs, capture_output=True, check=False, timeout=60)
    assert result.returncode == 0, result.stderr
    lines = [json.loads(line) for line in result.stdout.splitlines()]
    assert {line["name"] for line in lines if line["final"]} == {"eve", "ann"}
    assert lines[-1]["frames"] > 0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [([], "no headset"), (["--headset", "name=a,colour=red"], "colour"), (["--specs", "missing.json"], "missing.json")],
)
def test_invalid_command_lines_are_rejected(arguments: list[str], text: str) -> None:
    command = [sys.executable, "-m", "iris_session.emulator", *arguments]
    result = subprocess.run(command, capture_output=True, check=False, timeout=60, text=True)
    assert result.returncode == 2
    assert text in result.stderr
    assert "Traceback" not in result.stderr
