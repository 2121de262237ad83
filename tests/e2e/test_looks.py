"""Recordings of real sessions in Rerun's viewer, checked by `tools/look_at_recordings.py`, and in its dataframes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.e2e.session_process import DEMO_OPTIONS, DEMO_S, run_command, skip_unless_ci
from tests.recording.dataframes import compare_dataframes
from tools.look_at_recordings import MissingViewerError, look_at

pytestmark = [pytest.mark.e2e, pytest.mark.long, pytest.mark.timeout(DEMO_S + 120.0)]


def assert_looks_right(path: Path) -> None:
    """Look at a recording; skip the test, or fail in CI, without a driver."""
    try:
        look = look_at(path)
    except MissingViewerError as error:
        skip_unless_ci(str(error))
        raise
    assert not look.problems, look


@pytest.mark.parametrize("demo", ["handover", "aloha", "panda", "soft", "cloth"])
def test_demos_are_seen_without_errors(demo: str, tmp_path: Path) -> None:
    done = run_command("demo", demo, *DEMO_OPTIONS, cwd=tmp_path, timeout_s=DEMO_S)
    assert done.stdout, done.stderr[-3000:]
    # Whether its operators succeeded does not matter here.
    recording = Path(tmp_path, json.loads(done.stdout)["recording"])
    assert_looks_right(recording)
    n, problems = compare_dataframes(recording)
    assert not problems
    assert n > 10_000
