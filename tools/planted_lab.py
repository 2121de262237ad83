"""Two emulated machines on one cable, for `tools/planted_faults.py`: Linux network namespaces with address, firewall
and key folders. Their processes end with the lab. Needs root, `ip`, `nft` and `mount`."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final

sys.path.insert(0, str(Path(__file__).parents[1]))  # the namespaces are those of the tests

from iris_session.demo.scenes import scene_path
from tests.network_namespaces import Namespace, connect

COMMAND: Final = (sys.executable, "-m", "iris_session.cli.main")
DEADLINE_S: Final = 60.0
NETWORK: Final = "10.77.2"


def write_slow_scene(folder: Path) -> Path:
    """Write the handover scene at 100 Hz, and return its file: a machine busy for some ms makes no tick late."""
    for file in (scene_path("handover"), scene_path("arm")):
        text, n = re.subn(r'timestep="[\d.]+"', 'timestep="0.01"', file.read_text())
        assert n == 1, file
        (folder / file.name).write_text(text)
    return folder / "handover.xml"


class LabError(Exception):
    """The fault could not be planted. The doctor was not tested."""


def system(*words: str) -> str:
    """Run a system command. Return its output."""
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise LabError(f"{' '.join(words)}: {done.stderr.strip()}")
    return done.stdout


def wait(true: Callable[[], bool], what: str) -> None:
    """Wait until a condition holds. Raise `LabError` after `DEADLINE_S`."""
    until = time.monotonic() + DEADLINE_S
    while not true():
        if time.monotonic() > until:
            raise LabError(f"timeout of {DEADLINE_S:g} s: {what}")
        time.sleep(0.1)


class Machine(Namespace):
    """One emulated machine, and the faults it can have."""

    def iris(self, *arguments: str, keys: str = "keys") -> subprocess.CompletedProcess[str]:
        """Run one `iris-session` command to its end. `keys`: key folder; another folder is another user."""
        return subprocess.run(
            self.wrap_command(*COMMAND, *arguments),
            capture_output=True,
            text=True,
            check=False,
            cwd=self.folder,
            env=self.environment(keys),
            timeout=DEADLINE_S,
        )

    def start(self, *command: str, ready_line: str, keys: str = "keys") -> subprocess.Popen[bytes]:
        """Start a process and wait until its output matches `ready_line`. End it with `stop`."""
        out = self.folder / f"{len(self.running)}.out"
        with out.open("wb") as file:
            process = subprocess.Popen(
                self.wrap_command(*command),
                stdin=subprocess.PIPE,
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=self.folder,
                env=self.environment(keys),
            )
        self.running.append(process)

        def ready() -> bool:
            if process.poll() is not None:
                raise LabError(f"{' '.join(command)} ended: {out.read_text(errors='replace')[-500:]}")
            return re.search(ready_line, out.read_text(errors="replace")) is not None

        wait(ready, f"{ready_line!r} of {command}")
        return process

    @contextlib.contextmanager
    def running_process(self, *command: str, ready_line: str, keys: str = "keys") -> Iterator[subprocess.Popen[bytes]]:
        """Start a process as `start` does, and stop it at the end."""
        process = self.start(*command, ready_line=ready_line, keys=keys)
        try:
            yield process
        finally:
            stop(process)

    def serve(self, *arguments: str, keys: str = "keys") -> subprocess.Popen[bytes]:
        """Start a session with a slow loop: how busy this machine is must not look like a fault."""
        scene = str(write_slow_scene(self.folder))
        return self.start(*COMMAND, "serve", scene, *arguments, ready_line=r"on \S+:\d+,", keys=keys)

    @contextlib.contextmanager
    def firewall(self, *rules: str) -> Iterator[None]:
        """Drop incoming packets that match the rules, such as `tcp dport 7722`, until the end."""
        system(*self.wrap_command("nft", "add table inet planted"))
        try:
            system(*self.wrap_command("nft", "add chain inet planted in { type filter hook input priority 0; }"))
            for rule in rules:
                system(*self.wrap_command("nft", f"add rule inet planted in {rule} drop"))
            yield
        finally:
            system(*self.wrap_command("nft", "delete table inet planted"))

    @contextlib.contextmanager
    def addressed(self, address: str, *, additional: bool = False) -> Iterator[None]:
        """Set an address with prefix length until the end; `additional`: keep the machine's own address too."""
        own = f"{self.address}/24"
        self._address("add", address)
        if not additional:
            self._address("del", own)
        try:
            yield
        finally:
            self._address("del", address)
            if not additional:
                self._address("add", own)

    def _address(self, change: str, address: str) -> None:
        system("ip", "-n", self.name, "addr", change, address, "brd", "+", "dev", self.interface)


def stop(process: subprocess.Popen[bytes]) -> None:
    """Interrupt a process, also a stopped one; kill it if it does not end."""
    if process.stdin is not None:
        process.stdin.close()
    for number in (signal.SIGCONT, signal.SIGINT):
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(number)
    try:
        process.wait(20.0)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


class Lab:
    """Two machines, `server` and `client`, in a network of their own. The network of this machine is not touched."""

    def __init__(self, folder: Path) -> None:
        mark = os.getpid() % 100_000
        self.server = Machine(f"iris-fs{mark}", f"ifs{mark}", f"{NETWORK}.1", folder / "server")
        self.client = Machine(f"iris-fc{mark}", f"ifc{mark}", f"{NETWORK}.2", folder / "client")
        self._mounted: list[Path] = []

    def __enter__(self) -> Lab:
        try:
            connect(partial(system, "ip"), self.server, self.client)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def small_disk(self, mib: int) -> Path:
        """Mount a disk of this size on the server."""
        path = self.server.folder / f"disk{len(self._mounted)}"
        path.mkdir()
        system("mount", "-t", "tmpfs", "-o", f"size={mib}m", "tmpfs", str(path))
        self._mounted.append(path)
        return path

    def close(self) -> None:
        for machine in (self.client, self.server):
            for process in machine.running:
                if process.poll() is None:
                    stop(process)
        for path in self._mounted:
            subprocess.run(["umount", "-l", str(path)], capture_output=True, check=False)
        for machine in (self.client, self.server):
            subprocess.run(["ip", "netns", "del", machine.name], capture_output=True, check=False)

    def create_code(self, *options: str) -> str:
        """Create a join code of the session `lab-1`."""
        done = self.server.iris("pair", "--session", "lab-1", "--no-wait", "--json", *options)
        if done.returncode:
            raise LabError(done.stderr.strip())
        return str(json.loads(done.stdout.splitlines()[0])["code"])

    def read_public_key(self, keys: str) -> str:
        """Return the public key of a user of the client."""
        self.client.iris("keys", "allow", "me", keys=keys)  # creates the key
        shown: dict[str, Any] = json.loads(self.client.iris("keys", "show", "--json", keys=keys).stdout)
        return str(shown["identity"]["key"])


def check_requirements() -> None:
    """Raise `LabError` if this machine cannot run a lab."""
    if sys.platform != "linux" or os.geteuid() != 0:
        raise LabError("network namespaces need Linux and root")
    missing = [tool for tool in ("ip", "nft", "mount") if shutil.which(tool) is None]
    if missing:
        raise LabError(f"{', '.join(missing)} not found (Debian: apt-get install iproute2 nftables mount)")
