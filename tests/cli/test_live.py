"""Live view of a running session in the terminal."""

from __future__ import annotations

import io
import json
import os
import signal
import sys

import msgspec
import pytest

from iris_session.cli.live import TerminalView, _render_table, describe_episode, format_event, main
from iris_session.protocol.server_messages import EpisodeChanged, Event, MarkerAdded, SamplesRejected

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


def test_events_are_printable_lines() -> None:
    line = format_event(Event(1, 0, 1_500_000_000, MarkerAdded("p1", "")), "ann: a\x1b[2Jb\nc\u202ed")
    assert line == "    1.50 s  marker_added         ann: a\ufffd[2Jb\ufffdc\ufffdd"


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


def test_episode_has_a_line_that_says_what_to_do() -> None:
    now = EpisodeChanged(
        13, "countdown", "", "p1", "pour", "Pour the cup.", 50, 12, "p1", "ann", until_ns=3_000_000_000
    )
    assert describe_episode(None, 0) == ""
    assert describe_episode(now, 900_000_000) == "Pour the cup: episode 13, 12 of 50: begins in 3 s, d cancels"
    for state, text in {
        "idle": "e starts the next one",
        "running": "is recorded, by ann",
        "confirm": "discard it? d confirms within 3 s",
        "left": "ann is disconnected: t takes it over, within 3 s",
        "closing": "is closing (verdict: e success, f failure, d discard)",
        "success": "success",
    }.items():
        line = describe_episode(msgspec.structs.replace(now, state=state), 0)
        assert line == f"Pour the cup: episode 13, 12 of 50: {text}"
    assert describe_episode(EpisodeChanged(1, "running", started_by_name="bob"), 0) == "episode 1: is recorded, by bob"


class _Session:
    """The part of a session that `TerminalView` uses."""

    episode = None

    def clock(self) -> int:
        return 0

    def __init__(self) -> None:
        self.events: list[Event] = []

    def recent_events(self) -> list[Event]:
        return self.events

    def status(self) -> _Session:
        return self

    def as_dict(self) -> dict[str, object]:
        return {"text": "x" * 200_000}


def test_slow_display_delays_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Refreshes that do not fit into the pipe are skipped; none is truncated, and no event is lost."""
    session = _Session()
    view = TerminalView(session, io.StringIO(), "title")  # type: ignore[arg-type]
    read, write = os.pipe()
    os.set_blocking(read, False)
    os.set_blocking(write, False)
    view._pipe = write
    session.events = [
        Event(1, 0, 0, SamplesRejected("p1", "head", "seq", 1)),
        Event(2, 0, 0, MarkerAdded("p1", "hello")),
    ]
    for _ in range(3):
        view.update(force=True)
    session.events.append(Event(3, 0, 0, MarkerAdded("p1", "later")))
    got = b""
    for _ in range(20):  # 64 KiB each
        got += os.read(read, 1 << 20)
        view.update(force=True)
    first, second = (json.loads(line) for line in got.splitlines()[:2])
    assert [[event.split()[-1] for event in one["events"]] for one in (first, second)] == [["hello"], ["later"]]
    assert first["status"]["text"] == "x" * 200_000
    os.close(read)
    view._pending = b"x"
    view.update(force=True)
    assert view._pending == b"x", "a display that has ended interrupts nothing"
    os.close(write)
