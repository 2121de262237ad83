"""Run commands and sessions as processes, and wait for what they do.

Every wait has a condition and a deadline. `SessionProcess` is one session with its recording; the fixtures that start
and end sessions are in `conftest.py`.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import psutil
import pytest

from iris_session.cli.main import main
from iris_session.recording import NotARecordingError, Recording
from tests.loopback import make_loopback_address

#: Deadline of every condition [s]: ten times the worst case on an idle machine, because others may use it too.
DEADLINE_S: Final = 60.0
#: Until a session listens that starts beside processes that compute [s].
START_S: Final = 90.0
#: Commands that end by themselves; and a whole demo, which takes a minute on an idle machine [s].
COMMAND_S: Final = 120.0
DEMO_S: Final = 900.0
#: Options of a demo that must succeed on a busy machine, too: it may be begun twice more, and verifying what it has
#: recorded takes as long again.
DEMO_OPTIONS: Final = ("--json", "--timeout", "360")
COMMAND: Final = [sys.executable, "-m", "iris_session.cli.main"]
#: Limits of time that a machine which stands still for seconds does not reach: no robot holds, no participant leaves
#: and no hand jumps because other programs compute. What happens at these limits is tested in simulated time.
PATIENCE: Final = """
import functools
from msgspec import structs
import iris_session.session.session  # has the class itself
from iris_session import authority
from iris_session.authority import config
from iris_session.link import front_process
from iris_session.recording import supervise
from iris_session.session import processes

long_ns = 60 * 1_000_000_000
front_process.HANGING_NS = front_process.STARVED_NS = supervise.HANGING_NS = long_ns
processes.FrontConfig = functools.partial(
    processes.FrontConfig, heartbeat_ns=long_ns // 6, silence_ns=long_ns, stall_ns=long_ns
)
far = {device: structs.replace(one, noise_m=1.0, noise_rad=3.0) for device, one in config.SPEED_LIMITS.items()}
authority.AuthorityConfig = functools.partial(
    authority.AuthorityConfig, freshness_ns=long_ns, gap_ns=long_ns, heartbeat_timeout_ns=long_ns, speed_limits=far
)
"""
PATIENT_COMMAND: Final = [
    sys.executable,
    "-c",
    f"""
import sys
{PATIENCE}
from iris_session.cli.main import main

sys.exit(main())
""",
]
#: Options of `serve` that bind free ports.
FREE_PORTS: Final = ("--control-port", "0", "--state-port", "0")
#: Prefix of a command that gets SIGTERM when the tests die: servers of a killed run slowed down the next one.
END_WITH_PARENT: Final = ["setpriv", "--pdeathsig", "TERM"] if shutil.which("setpriv") else []


def wait_until(condition: Callable[[], object], what: str, timeout_s: float = DEADLINE_S) -> None:
    """Poll `condition` until it is true. Fail, naming `what`, after `timeout_s`."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"not within {timeout_s:g} s: {what}")
        time.sleep(0.005)


def skip_unless_ci(reason: str) -> None:
    """Skip a test that this machine cannot run, with the reason; fail in CI, where every test must run."""
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)


def run_command(*arguments: str, cwd: Path, timeout_s: float = COMMAND_S) -> subprocess.CompletedProcess[str]:
    """Run one `iris-session` command to its end."""
    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, check=False, cwd=cwd, timeout=timeout_s
    )


def run_in_process(*arguments: str) -> tuple[int, str, str]:
    """Run one command in this process. Return exit status, output, errors.

    For commands that start no session. Importing what they need takes longer than most of them run, and this process
    has imported it.
    """
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        status = main(list(arguments))
    return status, out.getvalue(), errors.getvalue()


def run_verify(recording: Path, status: int = 0) -> dict[str, Any]:
    """Return the report of `iris-session verify --json`, which must end with `status`."""
    code, out, errors = run_in_process("verify", "--json", str(recording))
    assert code == status, (out[-2000:], errors[-2000:])
    report: dict[str, Any] = json.loads(out)["files"][0]
    return report


def list_descendants(pid: int) -> list[psutil.Process]:
    """Return all processes below `pid`, to check after it ended."""
    return psutil.Process(pid).children(recursive=True)


def assert_all_end(processes: Sequence[psutil.Process], timeout_s: float = DEADLINE_S) -> None:
    """Fail when one of `processes` does not end by itself; kill it then."""
    _, alive = psutil.wait_procs(list(processes), timeout=timeout_s)
    text = [f"{p.pid} {' '.join(p.cmdline())}" for p in alive if p.is_running()]
    for p in alive:
        p.kill()
    assert not text, f"left behind: {text}"


def read_output_tails(folder: Path) -> str:
    """Return the last lines of every output file of the processes of a test."""
    return "\n".join(f"--- {p.name}\n{p.read_text(errors='replace')[-1500:]}" for p in sorted(folder.rglob("*.out")))


def make_serve_command(scene: str, recording: Path, *arguments: str) -> list[str]:
    """Return a command that serves a scene on free ports of a loopback address of its own."""
    host = make_loopback_address()
    return [*PATIENT_COMMAND, "serve", scene, "--host", host, *FREE_PORTS, "--record", str(recording), *arguments]


class SessionProcess:
    """One process with a session and its recording. It must print `on HOST:PORT,` and `recording to`."""

    def __init__(self, folder: Path, recording: Path, command: Sequence[str]) -> None:
        self.folder = folder
        self.recording = recording
        self._out = folder / "serve.out"
        with self._out.open("wb") as out:
            self.process = subprocess.Popen(
                [*END_WITH_PARENT, *command], stdout=out, stderr=subprocess.STDOUT, cwd=folder
            )
        try:
            wait_until(self._is_listening_or_ended, "the session listens", START_S)
        except BaseException:
            self.process.kill()
            self.process.wait()
            raise
        match = re.search(r"on (\S+:\d+),", self.output)
        assert match, self.output
        self.address = match.group(1)

    def _is_listening_or_ended(self) -> bool:
        return "recording to" in self.output or self.process.poll() is not None

    @property
    def output(self) -> str:
        return self._out.read_text(errors="replace")

    def children(self) -> dict[str, psutil.Process]:
        """Return front and recorder by the name of their module."""
        found = {}
        for child in psutil.Process(self.process.pid).children():
            try:
                line = " ".join(child.cmdline())
            except psutil.Error:  # it has just ended
                continue
            for name in ("front.main", "recording.process", "web.gateway"):
                if name in line:
                    found[name] = child
        return found

    def stop(self) -> None:
        """Press Ctrl-C; the process must end in order."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(DEADLINE_S) == 0, self.output

    def kill(self) -> None:
        """Kill the authority. Front and recorder notice it."""
        self.process.kill()
        self.process.wait()

    def count_recorded_rows(self) -> int:
        """Return how many steps are in the file so far; on a busy machine none for seconds."""
        try:
            with Recording.open(self.recording, warn=False) as recording:
                return recording.count_rows()
        except (NotARecordingError, RuntimeError):  # not begun; of Rerun: a message was partly written
            return 0

    def verify(self) -> dict[str, Any]:
        """Verify the recording, which must be identical. Return the report of `iris-session verify --json`."""
        return run_verify(self.recording)

    def finish(self) -> dict[str, Any]:
        """Stop and verify; no process may stay."""
        children = list_descendants(self.process.pid)
        self.stop()
        assert_all_end(children)
        return self.verify()


def kill_all(servers: Sequence[SessionProcess]) -> None:
    """Kill what a failed test left running."""
    for server in servers:
        if server.process.poll() is None:
            children = list_descendants(server.process.pid)
            server.kill()
            psutil.wait_procs(children, timeout=DEADLINE_S)
