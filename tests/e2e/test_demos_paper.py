"""The scenes of the paper in one command each: real robots' models, network clients, recorded and verified."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import DEMO_S, iris
from tests.models import robot_models

__all__ = ["robot_models"]
pytestmark = [pytest.mark.e2e, pytest.mark.usefixtures("robot_models")]


def play(folder: Path, *arguments: str) -> dict[str, Any]:
    """Runs a demo that must succeed; its result."""
    done = iris("demo", *arguments, "--json", cwd=folder, timeout_s=DEMO_S)
    assert done.returncode == 0, (done.stdout, done.stderr[-3000:])
    result: dict[str, Any] = json.loads(done.stdout)
    assert result["ok"]
    assert result["problems"] == []
    assert result["verified"], result["verification"]
    assert result["participants"] == ["ann", "bob"]
    return result


def test_two_people_with_two_arms_each_exchange_boards(tmp_path: Path) -> None:
    result = play(tmp_path, "aloha")
    found = {h["object"]: (h["giver"], h["receiver"]) for h in result["handovers"]}
    assert found == {
        "red_board": ("south/right", "north/left"),
        "blue_board": ("north/right", "south/left"),
    }
    for error in result["alignment_mm"].values():
        assert 0.0 < error["at_sheet"] < 2.0 * error["stated_p95"]


def test_iiwa_arms_hand_a_hammer_over(tmp_path: Path) -> None:
    result = play(tmp_path, "iiwa")
    assert [(h["object"], h["giver"], h["receiver"]) for h in result["handovers"]] == [("object1", "left", "right")]


def test_a_demo_that_cannot_be_played_says_why(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    crowd = iris("demo", "aloha", "--operators", "4", cwd=tmp_path)
    assert crowd.returncode == 2
    assert crowd.stderr.startswith("iris-session: demo aloha has two stations with two arms each: 2 operators, not 4")
    monkeypatch.delenv("IRIS_DATA")
    bare = iris("demo", "iiwa", cwd=tmp_path)
    assert bare.returncode == 2
    assert "set IRIS_DATA to a folder that has models/kuka_iiwa_14/iiwa14.xml" in bare.stderr
    assert bare.stderr.count("\n") == 1
