"""Live view of a running session in the terminal."""

from __future__ import annotations

import io
import json
import os
import signal
import sys

import pytest

from iris_session.cli.live import EventFilter, TerminalView, _render_table, format_event, main
from iris_session.protocol.common import IDENTITY, Alignment, Lease
from iris_session.protocol.server_messages import (
    AlignmentChanged,
    Event,
    Handover,
    HeadsetsCompared,
    LeaseChanged,
    MarkerAdded,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
)

STATUS = {
    "session_time_s": 12.3,
    "tick": 6150,
    "paused": False,
    "estop": True,
    "participants": [
        {"id": "p1", "name": "ann", "role": "operator", "connected": False, "holds": ["left"], "alignment": "measured",
         "alignment_error_m": 0.0042},
    ],
    "input_to_ctrl_ms": {"left": 21.0},
    "lateness": {"late_share": 0.001, "p99_ms": 0.8},
    "handovers": 1,
    "drops": {"slow": 3},
}  # fmt: skip


def test_events_are_readable_lines() -> None:
    info = ParticipantInfo("p1", "ann", "operator", True)
    joined = format_event(Event(1, 0, 1_500_000_000, ParticipantJoined(info, False)))
    assert "1.50 s" in joined
    assert "participant=p1 name=ann role=operator" in joined
    lease = Lease("left", "robot", "exclusive", "p1", 1)
    assert "target=left holder=p1 cause=acquired" in format_event(Event(2, 0, 0, LeaseChanged(lease, "acquired")))
    for alignment, shown in (
        (Alignment(2, "placed", IDENTITY), "kind=placed error_mm=-"),
        (Alignment(2, "measured", IDENTITY, error_at_robot_m=0.0042), "kind=measured error_mm=4.2"),
        (Alignment(2, "measured", IDENTITY, offset=True), "kind=measured error_mm=-"),
    ):
        assert shown in format_event(Event(2, 0, 0, AlignmentChanged("p1", alignment)))
    assert "text=hello" in format_event(Event(3, 0, 0, MarkerAdded("p1", "hello")))
    assert "giver=left receiver=right" in format_event(
        Event(4, 0, 0, Handover("hammer", "left", "right", "p1", "p2", 2_000_000))
    )


def test_numbers_are_rounded() -> None:
    compared = HeadsetsCompared("p1", "p2", "table", 0.0012345678, 1e-7, 0.0059999999, (0.1234567, -1e-9, 1.0), 40)
    line = format_event(Event(1, 0, 0, compared))
    assert line.endswith("error_m=0.001235 error_rad=0.0 expected_p95_m=0.006 p_world=[0.1235, 0.0, 1.0] n=40")


def test_unchanged_cross_checks_are_hidden() -> None:
    noteworthy = EventFilter()

    def report(error_m: float, a: str = "p1", b: str = "p2") -> bool:
        return noteworthy(Event(1, 0, 0, HeadsetsCompared(a, b, "table", error_m, 0.0, 0.006, (0.0, 0.0, 0.0), 40)))

    assert [report(0.001), report(0.005), report(0.011, "p2", "p1")] == [True, False, False]
    assert [report(0.02), report(0.03), report(0.004)] == [True, False, True]
    assert report(0.001, "p1", "p3")
    assert noteworthy(Event(2, 0, 0, ParticipantLeft("p2", "bye", grace=False)))
    assert [report(0.001), report(0.001, "p1", "p3")] == [True, False], "somebody new has the name"
    assert noteworthy(Event(3, 0, 0, MarkerAdded("p1", "hello")))


def test_table_shows_participants_and_why_nothing_moves() -> None:
    from rich.console import Console

    console = Console(file=io.StringIO(), width=140)
    status = {**STATUS, "paused": True, "pause_reason": "NaN in QPOS at DOF 3"}
    console.print(_render_table("lab", status, ["something happened"]))
    assert isinstance(console.file, io.StringIO)
    text = console.file.getvalue()
    for part in ("ann (p1) [offline]", "4.2 mm", "21 ms", "E-STOP", "late 0.10 %", "drops 3", "something happened"):
        assert part in text
    assert "NaN in QPOS at DOF 3" in text


def test_display_prints_events_and_ignores_truncated_lines(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    lines = '{"status": {}, "events": ["one"]}\n{"status": {}, "ev\n{"status": {}, "events": ["two"]}\n'
    monkeypatch.setattr(sys, "stdin", io.StringIO(lines))
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    assert main("title") == 0
    assert capsys.readouterr().out.split() == ["one", "two"]


class _Session:
    """The part of a session that `TerminalView` uses."""

    def __init__(self) -> None:
        self.events: list[Event] = []

    def recent_events(self) -> list[Event]:
        return self.events

    def status(self) -> _Session:
        return self

    def as_dict(self) -> dict[str, object]:
        return {"text": "x" * 200_000}


def test_slow_display_delays_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refreshes that do not fit into the pipe are skipped and counted; none is truncated, and no event is lost."""
    session = _Session()
    view = TerminalView(session, io.StringIO(), "title")  # type: ignore[arg-type]
    read, write = os.pipe()
    os.set_blocking(write, False)
    view._pipe = write
    session.events = [Event(1, 0, 0, MarkerAdded("p1", "hello"))]
    for _ in range(3):
        view.update(force=True)
    assert view.skipped == 2
    got = b""
    while not got.endswith(b"\n"):
        got += os.read(read, 1 << 20)
        view.update(force=True)
    first = got.splitlines()[0]
    assert [json.loads(first)["events"][0].split()[-1], json.loads(first)["status"]["text"][:2]] == ["text=hello", "xx"]
    view._pending = b""
    view.skipped = 3
    os.close(read)
    view._pending = b"x"
    view.update(force=True)
    assert view.skipped == 4
    os.close(write)
    assert json.dumps(session.as_dict())


def test_events_have_no_control_characters() -> None:
    line = format_event(Event(1, 0, 0, MarkerAdded("p1", "a\x1b[2Jb\nc\u202ed")))
    assert line.endswith("text=a\ufffd[2Jb\ufffdc\ufffdd")
