"""What bends, with real processes: a cloth is folded, soft bodies are stowed, by friction, seen through the network."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from tests.e2e.conftest import DEMO_S, iris

pytestmark = pytest.mark.e2e


def play(folder: Path, name: str) -> dict[str, Any]:
    """Runs a demo that must succeed; its result."""
    done = iris("demo", name, "--json", cwd=folder, timeout_s=DEMO_S)
    assert done.returncode == 0, (done.stdout, done.stderr[-3000:])
    result: dict[str, Any] = json.loads(done.stdout)
    assert (result["ok"], result["problems"], result["verified"]) == (True, [], True), result
    return result


def test_two_people_stow_two_soft_bodies(tmp_path: Path) -> None:
    goals = play(tmp_path, "soft")["goals"]
    assert sorted((goal["deformable"], goal["goal"]) for goal in goals) == [("mint", "stowed"), ("rose", "stowed")]


def test_two_people_fold_a_cloth(tmp_path: Path) -> None:
    goals = play(tmp_path, "cloth")["goals"]
    assert [(goal["deformable"], goal["goal"]) for goal in goals] == [("cloth", "folded")]
