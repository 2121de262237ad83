"""SIGKILL of the command `export` at random moments: the set loads each time, and the next run ends with its bytes."""

from __future__ import annotations

import random
import shutil
import subprocess
import time
from contextlib import suppress
from pathlib import Path

import pytest

from iris_session.bench.export import record_session
from iris_session.system.process import child_environment, module_command
from tests.dataset.test_lerobot import load, read_files

KILLS = 20


@pytest.mark.long
@pytest.mark.e2e
def test_killed_at_random_moments(tmp_path: Path) -> None:
    record_session(tmp_path / "session.rrd", 6, 250)
    options = ["--cameras", "operator", "--size", "64x48", "--plain"]

    def start(folder: Path) -> subprocess.Popen[bytes]:
        command = ["export", str(tmp_path / "session.rrd"), "--to", "lerobot", "--out", str(folder), *options]
        return subprocess.Popen(module_command("iris_session.cli.main", *command), env=child_environment())

    began = time.monotonic()
    assert start(tmp_path / "whole").wait() == 0
    whole_s = time.monotonic() - began
    expected, draw = read_files(tmp_path / "whole"), random.Random(1)
    closed = []
    for _ in range(KILLS // 2):
        folder = tmp_path / "killed"
        shutil.rmtree(folder, ignore_errors=True)
        for _ in range(2):  # the second run is killed, too
            process = start(folder)
            with suppress(subprocess.TimeoutExpired):  # the second run may have little left to do
                process.wait(whole_s * draw.uniform(0.1, 0.7))
            process.kill()
            process.wait()
            if (folder / "meta/info.json").exists():
                closed.append(len(load(folder)))
        assert start(folder).wait() == 0
        assert read_files(folder) == expected
    assert min(closed, default=0) < 6
    assert max(closed, default=0) > 0
