"""Emulated people in a session of the rig: they align, drive, jump, recover, and report."""

from __future__ import annotations

import functools
import io
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace

import msgspec
import pytest

from iris_session.client import Client
from iris_session.emulator import runner
from iris_session.emulator.__main__ import main
from iris_session.emulator.headset import DEFAULT_ANCHOR_ID
from iris_session.emulator.runner import run_headsets
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.entries import AlignmentAlarm, Entry, decode_entries
from iris_session.protocol.names import Device
from tests.rig.owned import simulate_sessions
from tests.rig.session import ADDRESS, Rig
from tests.rig.simulation import Simulation

QUICK = {"viewpoints": 4, "observations_per_viewpoint": 4}


def wait_in(simulation: Simulation) -> Callable[[Sequence[Client], float], list[Client]]:
    """Return what takes the place of `wait_any`: the simulation runs until something has arrived or is due."""

    def wait_any(clients: Sequence[Client], timeout_s: float) -> list[Client]:
        arrived: list[Client] = []
        for client in clients:
            client._sockets.on_arrival = functools.partial(arrived.append, client)  # type: ignore[attr-defined]
        until_ns = simulation.now_ns + round(timeout_s * 1e9)
        dues_ns = {client: client.connection.next_deadline_ns(simulation.now_ns) for client in clients}
        simulation.run(min(until_ns, *dues_ns.values()), lambda: arrived)
        return [one for one in clients if one in arrived or dues_ns[one] <= simulation.now_ns]

    return wait_any


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Iterator[Rig]:
    with Rig(timestep=0.01) as rig:
        monkeypatch.setattr(runner, "wait_any", wait_in(rig.simulation))
        yield rig


def messages_of(session: Rig, kind: type) -> list[Entry]:
    """Return the entries with messages of a type that the journal has."""
    entries = [entry for row in session.journal.rows for entry in decode_entries(row.entries)]
    return [entry for entry in entries if isinstance(entry.message, kind)]


def run_until(
    specs: list[HeadsetSpec], *phases: str, orders: Callable[[], list[tuple[str, str]]] = list
) -> list[HeadsetReport]:
    """Run the people until each has reached the phase at the same index."""
    reached: dict[str, set[str]] = {spec.name: set() for spec in specs}
    wanted = {spec.name: phase for spec, phase in zip(specs, phases, strict=True)}

    def note(report: HeadsetReport) -> None:
        reached[report.name] |= {report.phase}

    def stop() -> bool:
        return all(phase in reached[name] for name, phase in wanted.items())

    reports = run_headsets(ADDRESS, specs, 40.0, note, stop, orders=orders)
    assert stop(), reached
    return reports


def test_two_people_align_and_drive_while_one_observes(session: Rig) -> None:
    specs = [
        HeadsetSpec(name="ann", behaviour="wander", robot="left", seed=1, **QUICK),
        HeadsetSpec(name="bob", behaviour="wander", robot="right", seed=2, **QUICK),
        HeadsetSpec(name="eve", seed=3, **QUICK),
    ]
    reports = run_until(specs, "work", "work", "watch")
    for report in reports:
        assert report.failed == ""
        assert report.alignment_error_mm < 5.0
        assert report.alignment_error_mm < report.stated_error_mm * 1.5
        assert report.observations >= 12
        assert report.samples > 100
        assert report.frames > 50
        assert set(report.rejected) <= {"alignment_version"}
    samples = [(e.connection, e.receive_ns, e.message.device) for e in messages_of(session, Sample)]  # type: ignore[union-attr]
    heads = {(connection, at) for connection, at, device in samples if device == Device.HEAD}
    hands = {(connection, at) for connection, at, device in samples if device != Device.HEAD}
    assert len({connection for connection, _ in heads}) == 3
    assert len(heads & hands) > 50  # samples of one time are sent in one message


@pytest.mark.parametrize("beside", [(), ("shelf",)], ids=["headset", "sheet"])
def test_person_looks_at_the_sheet_after_an_alarm(session: Rig, beside: tuple[str]) -> None:
    """Unless the sheet itself was moved."""
    front = session.session.stepper.front
    from_front: list[AlignmentAlarm] = []
    poll = front.poll

    def poll_with_alarms() -> list[Entry]:
        alarms = [Entry(1, 1, session.session.clock(), from_front.pop()) for _ in range(len(from_front))]
        return [*poll(), *alarms]

    front.poll = poll_with_alarms  # type: ignore[method-assign]
    spec = HeadsetSpec(name="ann", behaviour="wander", robot="left", viewpoints=2, observations_per_viewpoint=4)
    began: list[str] = []
    alarmed_ns: list[int] = []

    def note(report: HeadsetReport) -> None:
        if not began or began[-1] != report.phase:
            began.append(report.phase)
        if report.phase == "work" and not alarmed_ns:
            alarmed_ns.append(session.session.clock())
            from_front.append(AlignmentAlarm("changed", 0, DEFAULT_ANCHOR_ID, 0.012, 0, beside))

    def over() -> bool:
        if beside:
            return bool(alarmed_ns) and session.session.clock() - alarmed_ns[0] > 1_500_000_000
        return began.count("work") == 2

    (report,) = run_headsets(ADDRESS, [spec], 40.0, note, over)
    assert over(), report
    phases = [phase for phase in began if phase in ("look", "work")]
    assert phases == (["look", "work"] if beside else ["look", "work", "look", "work"])
    assert report.alarms == (0 if beside else 1)


def test_lost_session_is_shown_and_fails(session: Rig) -> None:
    reports: list[tuple[str, str, float]] = []

    def note(report: HeadsetReport) -> None:
        if report.frames > 20:
            session.session.close()
        reports.append((report.session, report.address, report.lost_s))

    (report,) = run_headsets(ADDRESS, [HeadsetSpec(name="eve", **QUICK)], seconds=7.0, report=note)
    assert {one[:2] for one in reports if one[0]} == {("session", ADDRESS)}
    assert max(one[2] for one in reports) > 2.0
    assert report.phase == "failed"
    assert ADDRESS in report.failed


def test_person_without_a_robot_reports_the_reason(session: Rig) -> None:
    specs = [HeadsetSpec(name="ann", behaviour="wander", robot="nothing", phase_timeout_s=6.0, **QUICK)]
    (report,) = run_headsets(ADDRESS, specs, seconds=30.0)
    assert "nothing" in report.failed
    assert report.phase == "failed"


def test_missing_session_is_a_failure_not_an_exception(monkeypatch: pytest.MonkeyPatch) -> None:
    with simulate_sessions() as simulation:
        monkeypatch.setattr(runner, "wait_any", wait_in(simulation))
        (report,) = run_headsets(ADDRESS, [HeadsetSpec(name="ann")], seconds=0.3)
    assert report.phase == "failed"
    assert ADDRESS in report.failed
    assert report.participant == ""


@pytest.mark.usefixtures("session")
def test_json_lines_are_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    specs = msgspec.json.encode([HeadsetSpec(name="eve", **QUICK), HeadsetSpec(name="ann", seed=1, **QUICK)])
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(specs)))
    monkeypatch.setattr("signal.signal", lambda *_: None)
    assert main(["--address", ADDRESS, "--specs", "-", "--json", "--seconds", "4"]) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert {line["name"] for line in lines if line["final"]} == {"eve", "ann"}
    assert lines[-1]["frames"] > 0


@pytest.mark.parametrize(
    ("arguments", "text"),
    [([], "no headset"), (["--headset", "name=a,colour=red"], "colour"), (["--specs", "missing.json"], "missing.json")],
)
def test_invalid_command_lines_are_rejected(
    capsys: pytest.CaptureFixture[str], arguments: list[str], text: str
) -> None:
    assert main(arguments) == 2
    assert text in capsys.readouterr().err
