"""`iris-session view --web`: the viewer of the package as a page, on this machine only, until Ctrl-C."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from tests.e2e.session_process import assert_all_end, list_descendants
from tests.recording.support import journal, write

DEADLINE_S = 60.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("session") / "session.rrd", *journal(40))


@contextmanager
def viewed(path: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start the command; yield it and the address that it prints."""
    command = [sys.executable, "-m", "iris_session.cli.main", "view", str(path), "--web", "--no-open"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as process:
        assert process.stdout is not None
        lines = []
        try:
            for line in process.stdout:
                lines.append(line)
                if found := re.search(r"in a browser on this machine: (http://\S+)", line):
                    yield process, found[1]
                    return
            pytest.fail("".join(lines))
        finally:
            process.kill()


@pytest.mark.e2e
def test_page_is_served_on_this_machine_only_until_ctrl_c(recording: Path) -> None:
    with viewed(recording) as (process, address):
        with urllib.request.urlopen(address, timeout=DEADLINE_S) as answer:
            page = answer.read().decode()
        assert "re_viewer" in page
        viewers = list_descendants(process.pid)
        listening = [
            connection.laddr
            for viewer in viewers
            for connection in viewer.net_connections("inet")
            if connection.status == psutil.CONN_LISTEN
        ]
        assert {where.ip for where in listening} == {"127.0.0.1"}
        ports = {int(port) for port in re.findall(r"127\.0\.0\.1(?::|%3A)(\d+)", address)}
        assert {where.port for where in listening} == ports
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 0
        assert_all_end(viewers)


@pytest.mark.e2e
def test_viewer_that_is_killed_ends_the_command(recording: Path) -> None:
    with viewed(recording) as (process, _):
        (viewer,) = list_descendants(process.pid)
        viewer.kill()
        assert process.wait(DEADLINE_S) == 1
        assert process.stdout is not None
        assert "Rerun's viewer ended with exit status -9" in process.stdout.read()


@pytest.mark.e2e
def test_terminated_command_ends_the_viewer(recording: Path) -> None:
    with viewed(recording) as (process, _):
        viewers = list_descendants(process.pid)
        process.terminate()
        assert process.wait(DEADLINE_S) == 0
        assert_all_end(viewers)
