"""User loops with the MuJoCo that is installed; the tool runs the same checks over versions."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import mujoco

TOOL = Path(__file__).parents[2] / "tools" / "user_loop_versions.py"


def test_user_loops_leave_trajectories_alone_with_this_mujoco(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(TOOL), "--here"], capture_output=True, text=True, check=False, timeout=120.0, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    results = json.loads(done.stdout.splitlines()[-1])
    assert results.pop("mujoco") == mujoco.__version__
    assert all(results.values()), results
