"""Each demo by its command: the handover, real robots' models and deformables, recorded and verified.

Their recordings are looked at in Rerun's viewer by `tools/look_at_recordings.py`, and read as its dataframes.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.session_process import DEMO_OPTIONS, DEMO_S, run_command, skip_unless_ci
from tests.recording.dataframes import compare_dataframes
from tools.look_at_recordings import MissingViewerError, look_at

pytestmark = [pytest.mark.e2e, pytest.mark.timeout(DEMO_S + 120.0)]


def assert_looks_right(path: Path) -> None:
    """Look at a recording; skip the test, or fail in CI, without a driver."""
    n, problems = compare_dataframes(path)
    assert not problems
    assert n > 10_000
    try:
        look = look_at(path)
    except MissingViewerError as error:
        skip_unless_ci(str(error))
        raise
    assert not look.problems, look


def run_demo(folder: Path, *arguments: str, max_attempts: int = 2) -> dict[str, Any]:
    """Run a demo, which must succeed within so many attempts: a busy machine spoils one. Return its result."""
    done = run_command("demo", *arguments, *DEMO_OPTIONS, cwd=folder, timeout_s=DEMO_S)
    assert done.stdout, done.stderr[-3000:]
    result: dict[str, Any] = json.loads(done.stdout)
    problems = "\n".join([*result["problems"], done.stderr[-6000:], done.stdout])
    assert (done.returncode, result["ok"], result["verified"]) == (0, True, True), problems
    assert result["takes"] <= max_attempts, problems
    assert result["participants"][:2] == ["ann", "bob"], "before a watcher"
    return result


@pytest.mark.long
def test_hammer_is_handed_over(tmp_path: Path) -> None:
    """How well emulated people do it is tested in simulated time, in `tests/rig/test_demos.py`."""
    result = run_demo(tmp_path, "handover")
    assert {"seconds", "recording", "alignment_mm", "late_tick_share"} <= set(result)
    (handover,) = result["handovers"]
    assert set(handover) == {"object", "giver", "receiver", "at_s", "duration_s"}
    assert (handover["object"], handover["giver"], handover["receiver"]) == ("hammer", "left", "right")
    assert_looks_right(tmp_path / result["recording"])


@pytest.mark.long
def test_aloha_operators_exchange_boards(tmp_path: Path) -> None:
    result = run_demo(tmp_path, "aloha", max_attempts=3)  # a board is dropped in about one of twelve, by physics alone
    found = {h["object"]: (h["giver"], h["receiver"]) for h in result["handovers"]}
    assert found == {
        "red_board": ("south/right", "north/left"),
        "blue_board": ("north/right", "south/left"),
    }
    for error in result["alignment_mm"].values():
        assert 0.0 < error["at_sheet"] < 2.0 * error["stated_p95"]
    assert_looks_right(tmp_path / result["recording"])


@pytest.mark.long
def test_panda_operators_hand_over_a_hammer(tmp_path: Path) -> None:
    result = run_demo(tmp_path, "panda")
    assert [(h["object"], h["giver"], h["receiver"]) for h in result["handovers"]] == [("object1", "left", "right")]
    assert_looks_right(tmp_path / result["recording"])


@pytest.mark.long
def test_two_operators_stow_two_soft_bodies(tmp_path: Path) -> None:
    result = run_demo(tmp_path, "soft")
    found = sorted((goal["deformable"], goal["goal"]) for goal in result["goals"])
    assert found == [("mint", "stowed"), ("rose", "stowed")]
    assert_looks_right(tmp_path / result["recording"])


@pytest.mark.long
def test_two_operators_fold_a_cloth(tmp_path: Path) -> None:
    result = run_demo(tmp_path, "cloth", max_attempts=3)  # on a busy machine, one fold in some ten fails
    assert [(goal["deformable"], goal["goal"]) for goal in result["goals"]] == [("cloth", "folded")]
    assert_looks_right(tmp_path / result["recording"])
