"""Ctrl-C once, twice, and a display that takes nothing: the command ends with its status and without a traceback."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.e2e

SERVE = [sys.executable, "-m", "iris_session.cli.main", "serve", "handover", "--no-beacon"]
PORTS = ["--control-port", "0", "--state-port", "0"]


def test_a_second_interrupt_at_once_ends_without_a_traceback(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [*SERVE, *PORTS], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    assert process.stdout is not None
    assert "session 'handover'" in process.stdout.readline()
    process.send_signal(signal.SIGINT)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=30)
    assert "Traceback" not in errors
    assert process.returncode in (0, 130)  # 0: the two came as one


def test_a_display_that_takes_nothing_does_not_keep_the_end(tmp_path: Path) -> None:
    """Standard output is a pipe that is full and that nobody reads."""
    read, write = os.pipe()
    process = subprocess.Popen(
        [*SERVE, *PORTS, "--seconds", "2"], stdout=write, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    )
    assert select.select([read], [], [], 30.0)[0]
    os.read(read, 20)
    os.set_blocking(write, False)
    try:
        while True:
            os.write(write, b"x" * 4096)
    except BlockingIOError:
        os.set_blocking(write, True)
    try:
        _, errors = process.communicate(timeout=20)
    except subprocess.TimeoutExpired:
        os.set_blocking(read, False)
        os.read(read, 1 << 20)  # its last line, to standard output itself, waits as any program does
        _, errors = process.communicate(timeout=30)
    os.close(read)
    os.close(write)
    assert "Traceback" not in errors
    assert process.returncode == 0
