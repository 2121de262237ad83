"""Modules that a command loads at its start: each heavy package delays every command."""

from __future__ import annotations

import os
import subprocess
import sys

SCRIPT = """
import sys
from iris_session.cli.main import main
main(["robots", "handover"])
print(*sys.modules, file=sys.stderr)
"""
#: Loaded where they are used: the display, recordings, inverse kinematics, images, windows.
HEAVY = {"rich", "rerun", "pyarrow", "mink", "scipy", "cv2", "glfw", "matplotlib"}


def test_a_command_that_reads_a_model_loads_nothing_heavy_but_mujoco() -> None:
    environment = {key: value for key, value in os.environ.items() if key != "MUJOCO_GL"}
    command = [sys.executable, "-c", SCRIPT]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=120.0, env=environment)
    loaded = set(done.stderr.split())
    assert "mujoco" in loaded
    assert not loaded & HEAVY
