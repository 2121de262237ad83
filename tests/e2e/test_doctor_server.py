"""Faults of the server's machine that the doctor names: other programs on its processor, a full disk."""

from __future__ import annotations

import contextlib
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from iris_session.client import Client
from iris_session.protocol.names import LateCause
from tests.e2e.clinic import doctor
from tests.e2e.conftest import Server, end_all, serve_command, unavailable, wait

pytestmark = pytest.mark.e2e

OVERLOADED = """
import os, sys, time
from iris_session import Session, SessionConfig
from iris_session.demo.scenes import scene_path
config = SessionConfig(control_port=0, state_port=0, record=False, realtime=False)
with Session(scene_path("arm"), config=config) as session:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # the front may go where it likes
    print(f"on {session.address}, recording to nothing", flush=True)
    session.run()
"""
HOG = "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\nwhile True: pass\n"

#: Late ticks of a session that has not the processor it needs: a few seconds' worth.
MANY = 50


def test_late_ticks_and_who_is_to_blame(tmp_path: Path) -> None:
    """Other programs have the processor of the session, which may not run before them."""
    with contextlib.ExitStack() as stack:
        server = Server(tmp_path, tmp_path / "none", [sys.executable, "-c", OVERLOADED])
        stack.callback(server.stop)
        for _ in range(3):
            hog = stack.enter_context(subprocess.Popen([sys.executable, "-c", HOG]))
            stack.callback(hog.kill)
        wait_ticks(server)
        found = doctor(server.address)
    state = found.checks["ticks"]["state"]
    assert state in ("failed", "warning"), found.troubles()
    found.named("ticks", "scheduler: the session did not get the processor", state=state)


def wait_ticks(server: Server) -> None:
    """Until late ticks have been counted, more than those of a start, and the scheduler's are most of them."""
    with Client(server.address, role="observer", name="watch", alignment="not_needed") as client:

        def late() -> bool:
            causes = client.status().late_causes
            return sum(causes.values()) >= MANY and max(causes, key=lambda name: causes[name]) == LateCause.SCHEDULER

        wait(late, "late ticks, most of them the scheduler's")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 20 MB: the recorder begins with at least 16 free."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", str(folder)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        unavailable(f"needs the right to mount a small file system: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)  # what ends a moment later may still use it


def test_full_disk(small_disk: Path, tmp_path: Path) -> None:
    recording = small_disk / "session.rrd"
    server = Server(tmp_path, recording, serve_command("arm", recording))
    filler = small_disk / "other-data"
    filler.write_bytes(b"")
    try:
        with filler.open("wb") as file, contextlib.suppress(OSError):
            while True:
                file.write(bytes(1 << 16))
                file.flush()
        found = doctor(server.address)
        found.named("disk", "GB left", "make room")
        assert found.status == 1
    finally:
        end_all([server])  # finishing the recording would wait for room
