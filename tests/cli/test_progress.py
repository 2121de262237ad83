"""Progress of long work, in a terminal and in a file."""

from __future__ import annotations

from pathlib import Path

import pytest

from iris_session.cli import progress
from iris_session.cli.progress import LINE_PERIOD_S, ProgressLine


def test_a_file_gets_a_whole_line_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    now_s = 100.0
    monkeypatch.setattr(progress.time, "monotonic", lambda: now_s)
    with ProgressLine(Path("session.rrd")) as line:
        line.show("step 1 of 3")
        now_s += LINE_PERIOD_S
        line.show("step 2 of 3")
        now_s += LINE_PERIOD_S / 2
        line.show("step 3 of 3", at_once=True)
    assert capsys.readouterr().err == "session.rrd: step 2 of 3\n", "short work says nothing, no control characters"
