"""User loops with the MuJoCo that is installed, and with the oldest that is supported: watched, driven, verified."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest

TOOL = Path(__file__).parents[2] / "tools" / "user_loop_versions.py"


@pytest.mark.e2e
@pytest.mark.parametrize("version", ["3.3.0", mujoco.__version__])
def test_user_loops_leave_trajectories_alone_and_robots_follow(version: str, tmp_path: Path) -> None:
    what = ["--here"] if version == mujoco.__version__ else ["--borrow", version]
    done = subprocess.run(
        [sys.executable, str(TOOL), *what], capture_output=True, text=True, check=False, timeout=240.0, cwd=tmp_path
    )
    assert done.returncode == 0, done.stdout + done.stderr
    results = json.loads(done.stdout.splitlines()[0])
    assert results.pop("mujoco") == version
    assert {name for name in results if name.endswith("verified")} == {"user_loop_verified", "run_verified"}
    assert all(results.values()), results
