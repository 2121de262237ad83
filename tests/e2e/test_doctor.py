"""`iris-session doctor` beside real sessions: keys, ports and processes, late ticks, a full disk."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from iris_session.security import KeyHome, KeyPair
from tests.e2e.session_process import COMMAND, SessionProcess, kill_all, make_serve_command, skip_unless_ci
from tests.rig.test_doctor import Diagnosis

pytestmark = pytest.mark.e2e


#: What the doctor checks until it is admitted. What it says of times later depends on how busy this host is.
ADMISSION = {"address", "tcp", "introduction", "version", "server_key", "key", "code", "role", "join"}


def run_doctor(*arguments: str, home: Path | None = None) -> Diagnosis:
    environment = {**os.environ, **({"IRIS_HOME": str(home)} if home is not None else {})}
    done = subprocess.run(
        [*COMMAND, "doctor", *arguments, "--json"],
        capture_output=True,
        text=True,
        check=False,
        timeout=60.0,
        env=environment,
    )
    assert done.returncode in (0, 1), done.stderr[-2000:]
    return Diagnosis(done.returncode, json.loads(done.stdout))


def examine(*arguments: str, expected: set[str], home: Path | None = None) -> Diagnosis:
    """Run the doctor, which must find these checks of the admission failed and no others."""
    found = run_doctor(*arguments, home=home)
    assert found.list_checks("failed") & ADMISSION == expected, found.document
    return found


def find_lan_address() -> str:
    """Return an address of this machine that is not loopback: encrypted sessions need one."""
    for addresses in psutil.net_if_addrs().values():
        for one in addresses:
            if one.family == socket.AF_INET and not one.address.startswith("127."):
                return one.address
    pytest.fail("this machine has no network address but loopback")


def test_refused_keys_and_codes_at_an_encrypted_session(tmp_path: Path) -> None:
    """A key that is not on the list, a wrong code, a role that the key does not allow, a changed key of the server."""
    home = tmp_path / "home"  # of keys that the session does not know
    recording = tmp_path / "session.rrd"
    server = SessionProcess(tmp_path, recording, make_serve_command("arm", recording, "--host", find_lan_address()))
    try:
        examine(server.address, home=home, expected={"key"}).assert_names("key", "iris-session pair")
        examine(server.address, "--code", "7KQ2-M4XD-9PTR", home=home, expected={"code"}).assert_names("code")
        KeyHome().clients.allow_key("looker", KeyHome(home).load_identity().public, ("observer",))
        examine(server.address, "--role", "director", home=home, expected={"role"}).assert_names("role")
        assert examine(server.address, home=home, expected=set()).checks["key"]["state"] == "ok"
        elsewhere = tmp_path / "elsewhere"
        KeyHome(elsewhere).known_servers.pin(server.address, "arm", KeyPair.generate().public)
        found = examine(server.address, home=elsewhere, expected={"server_key"})
        found.assert_names("server_key", "iris-session keys forget")
    finally:
        server.stop()


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 20 MB: the recorder begins with at least 16 free."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", str(folder)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        skip_unless_ci(f"needs the right to mount a small file system: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)  # processes that are about to end may still use it


@pytest.mark.long
def test_full_disk(small_disk: Path, tmp_path: Path) -> None:
    recording = small_disk / "session.rrd"
    server = SessionProcess(tmp_path, recording, make_serve_command("arm", recording))
    filler = small_disk / "other-data"
    try:
        with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
            while True:
                file.write(bytes(1 << 16))
        found = run_doctor(server.address)
        found.assert_names("disk", "GB")
        assert found.status == 1
    finally:
        kill_all([server])  # finishing the recording would wait for free space
