"""`iris-session estop`, `clear-estop`, `pause`, `assign`, ...: a running session controlled from another terminal."""

from __future__ import annotations

import os
import pty
import re
import subprocess
import termios
from pathlib import Path

import pytest

from tests.e2e.session_process import make_serve_command, wait_until

pytestmark = pytest.mark.e2e


def test_keys_of_the_terminal_stop_and_clear(tmp_path: Path) -> None:
    """Space stops; after Ctrl-C the terminal is as it was before."""
    parent, terminal = pty.openpty()
    before = termios.tcgetattr(terminal)
    screen = b""

    def read_screen() -> bytes:
        nonlocal screen
        while True:
            try:
                screen += os.read(parent, 65536)
            except BlockingIOError:
                return screen

    def read_state() -> bytes:
        """Return the newest state in the title; events say E-STOP too, with who it was."""
        return ([b"", *re.findall(rb"running|E-STOP(?! by)", read_screen())])[-1]

    os.set_blocking(parent, False)
    command = make_serve_command("handover", tmp_path / "session.rrd", "--no-beacon")
    process = subprocess.Popen(
        ["setsid", "--ctty", *command], stdin=terminal, stdout=terminal, stderr=terminal, cwd=tmp_path
    )
    try:
        wait_until(lambda: b"space e-stop" in read_screen(), "the footer is shown")
        os.write(parent, b" ")
        wait_until(lambda: read_state() == b"E-STOP", "the e-stop is shown")
        os.write(parent, b"c")
        wait_until(lambda: read_state() == b"running", "it is cleared")
        termios.tcsetattr(terminal, termios.TCSANOW, before)  # as a shell does after Ctrl-Z
        wait_until(lambda: not termios.tcgetattr(terminal)[3] & termios.ICANON, "keys count without Enter again")
        os.write(parent, b" ")
        wait_until(lambda: read_state() == b"E-STOP", "the e-stop is shown again")
        os.write(parent, b"\x03")
        wait_until(lambda: read_screen() is not None and process.poll() is not None, "the session ends")
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, read_screen().decode(errors="replace")
    assert termios.tcgetattr(terminal) == before
    os.close(parent)
    os.close(terminal)
