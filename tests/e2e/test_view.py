"""`iris-session view --web`: the viewer of the package as a page, on this machine only, until Ctrl-C."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import psutil
import pytest

from iris_session.rrd.file import scan_file
from tests.e2e.session_process import assert_all_end, list_descendants
from tests.recording.support import journal, wait_until, write

DEADLINE_S = 60.0
pytestmark = [pytest.mark.e2e, pytest.mark.long]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("session") / "session.rrd", *journal(40))


@contextmanager
def viewed(*arguments: object) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """Start a command that shows a page; yield it and the address that it prints."""
    command = [sys.executable, "-m", "iris_session.cli.main", *map(str, arguments)]
    environment = {name: value for name, value in os.environ.items() if name not in ("DISPLAY", "WAYLAND_DISPLAY")}
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment
    ) as process:
        assert process.stdout is not None
        lines = []
        try:
            for line in process.stdout:
                lines.append(line)
                if found := re.search(r"in a browser on this machine: (http://127\S+/\?url=\S+)", line):
                    yield process, found[1]
                    return
            pytest.fail("".join(lines))
        finally:
            process.kill()


def test_page_is_served_on_this_machine_only_until_ctrl_c(recording: Path) -> None:
    with viewed("view", recording, "--web", "--no-open") as (process, address):
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


def test_viewer_that_is_killed_ends_the_command(recording: Path) -> None:
    with viewed("view", recording, "--web", "--no-open") as (process, _):
        (viewer,) = list_descendants(process.pid)
        viewer.kill()
        assert process.wait(DEADLINE_S) == 1
        assert process.stdout is not None
        assert "Rerun's viewer ended with exit status -9" in process.stdout.read()


def is_answered(address: str) -> bool:
    try:
        urllib.request.urlopen(address, timeout=DEADLINE_S).close()
    except urllib.error.URLError:
        return False
    return True


def test_serve_shows_its_recording_while_it_is_written(tmp_path: Path) -> None:
    """The viewer and the process that feeds it end with the session."""
    path = tmp_path / "session.rrd"
    ports = ("--control-port", "0", "--state-port", "0", "--no-beacon", "--no-web")
    with viewed("serve", "handover", *ports, "--record", path, "--view") as (process, address):
        wait_until(lambda: is_answered(address), DEADLINE_S)
        children = list_descendants(process.pid)
        wait_until(lambda: any("live_feed" in " ".join(p.cmdline()) for p in list_descendants(process.pid)), DEADLINE_S)
        children += list_descendants(process.pid)
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE_S) == 0
        assert_all_end(children)
        assert not is_answered(address)
    wait_until(lambda: scan_file(path).indexed, 3 * DEADLINE_S)  # written when a processor has nothing else to do
