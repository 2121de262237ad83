"""SIGKILL of the command `export`, or of a process of it: the set loads, and the next run ends with its bytes."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from iris_session.bench.export import record_session
from iris_session.dataset import run
from iris_session.dataset.episodes import DatasetError, PlanOptions
from iris_session.dataset.run import DatasetOptions, EpisodeTask, export_dataset, make_episode
from iris_session.system.process import ROOT, child_environment, module_command
from tests.dataset.support import read_files, record
from tests.dataset.test_lerobot import load

KILLS = 20
EPISODES = 6
CHOICE = PlanOptions(("success", "failure"))


def make_or_die(task: EpisodeTask) -> None:
    """Stand for `make_episode` in a process, which is killed at the third episode."""
    if task.index == 2:
        os.kill(os.getpid(), signal.SIGKILL)
    make_episode(task)


def export_with_a_death(recording: str, folder: str) -> None:
    """Export by two processes of which one dies. It runs in a process of its own, since multiprocessing keeps one."""
    run.make_episode = make_or_die
    try:
        export_dataset([Path(recording)], Path(folder), "lerobot", DatasetOptions(100, choice=CHOICE, jobs=2))
    except DatasetError as error:
        print(error)


@pytest.mark.e2e
def test_a_process_that_dies_is_one_line_and_costs_the_episodes_at_work(tmp_path: Path) -> None:
    played = record(tmp_path / "session.rrd")
    code = f"from {__name__} import *; export_with_a_death(*sys.argv[1:])"
    command = [sys.executable, "-c", code, str(played.path), str(tmp_path / "set")]
    done = subprocess.run(command, check=True, env=child_environment(), cwd=ROOT, capture_output=True, text=True)
    assert done.stdout == "a process that made an episode was killed: give fewer --jobs if memory is short\n"
    assert len(load(tmp_path / "set")) < 3
    for name in ("set", "whole"):
        export_dataset([played.path], tmp_path / name, "lerobot", DatasetOptions(100, choice=CHOICE))
    assert read_files(tmp_path / "set") == read_files(tmp_path / "whole")


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as stack:
        yield stack


@pytest.mark.long
@pytest.mark.e2e
@pytest.mark.timeout(3600)  # sixty runs of the command, on a busy machine ten seconds each
@pytest.mark.parametrize("jobs", [1, 2])
def test_killed_at_random_moments(jobs: int, tmp_path: Path, stack: ExitStack) -> None:
    record_session(tmp_path / "session.rrd", EPISODES, 250)
    options = ["--cameras", "operator", "--size", "64x48", "--plain", "--jobs", str(jobs)]

    def start(folder: Path) -> subprocess.Popen[bytes]:
        command = ["export", str(tmp_path / "session.rrd"), "--to", "lerobot", "--out", str(folder), *options]
        command = module_command("iris_session.cli.main", *command)
        process = subprocess.Popen(command, env=child_environment(), start_new_session=True)
        stack.callback(process.kill)  # if the test ends before
        return process

    def wait_until_closed(process: subprocess.Popen[bytes], episodes: int) -> None:
        """Wait until so many episodes are closed, or the process has ended."""
        while process.poll() is None and count_closed(tmp_path / "killed") < episodes:
            time.sleep(0.01)

    began = time.monotonic()
    assert start(tmp_path / "whole").wait() == 0
    whole_s = time.monotonic() - began
    expected, draw = read_files(tmp_path / "whole"), random.Random(jobs)
    closed = []
    for _ in range(KILLS // 2):
        folder = tmp_path / "killed"
        shutil.rmtree(folder, ignore_errors=True)
        for first, last in ((0, EPISODES // 2), (EPISODES // 2, EPISODES - 1)):  # the second run is killed, too
            process = start(folder)
            wait_until_closed(process, draw.randint(first, last))
            with suppress(subprocess.TimeoutExpired):
                process.wait(draw.uniform(0.0, whole_s / EPISODES))
            process.kill()
            process.wait()
            wait_for_group(process.pid)
            if (folder / "meta/info.json").exists():
                closed.append(len(load(folder)))
        assert start(folder).wait() == 0
        assert read_files(folder) == expected
    assert min(closed) < EPISODES
    assert max(closed) > 0


def count_closed(folder: Path) -> int:
    """Return the number of episodes of a set that is being written."""
    with suppress(FileNotFoundError):
        return int(json.loads((folder / "meta/info.json").read_bytes())["total_episodes"])
    return 0


def wait_for_group(group: int) -> None:
    """Wait until no process of a killed run is left: one that was beginning notices when it has begun."""
    deadline = time.monotonic() + 60.0
    with suppress(ProcessLookupError):
        while time.monotonic() < deadline:
            os.killpg(group, 0)
            time.sleep(0.01)
        pytest.fail("a process of the killed run is left")
