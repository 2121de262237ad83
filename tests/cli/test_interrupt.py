"""Ctrl-C while a command imports its modules: one status, no traceback."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

#: Runs the command line with an interrupt at the moment when the module of the first argument is imported.
CHILD = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a test run in the background ignores it
module = sys.argv.pop(1)
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == module:
            os.kill(os.getpid(), signal.SIGINT)
sys.meta_path.insert(0, Finder())
from iris_session.cli import run_command
sys.exit(run_command())
"""


@pytest.mark.parametrize(
    ("module", "command"),
    [
        ("iris_session.cli.main", ("keys", "list")),
        ("mujoco", ("serve", "handover")),
    ],
)
def test_interrupt_during_imports_is_no_traceback(module: str, command: tuple[str, ...], tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.write_text("no folder")
    process = subprocess.run(
        [sys.executable, "-c", CHILD, module, *command],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
        cwd=tmp_path,
        env={**os.environ, "IRIS_HOME": str(home)},
    )
    assert process.returncode == 130, process.stderr
    assert process.stderr == ""
