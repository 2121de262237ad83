"""Two machines on one cable, for `tools/planted_faults.py`: Linux network namespaces, each with an address, a firewall
and homes of keys. What they run ends with the lab. Needs root, `ip`, `nft` and `mount`."""

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

sys.path.insert(0, str(Path(__file__).parents[1]))  # machines are those of the tests

from tests.namespaces import Namespace, connect

COMMAND: Final = (sys.executable, "-m", "iris_session.cli.main")
DEADLINE_S: Final = 60.0
NETWORK: Final = "10.77.2"


class LabError(Exception):
    """The fault could not be planted; that says nothing about the doctor."""


def system(*words: str) -> str:
    """Runs a command of the system; what it printed."""
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise LabError(f"{' '.join(words)}: {done.stderr.strip()}")
    return done.stdout


def wait(true: Callable[[], bool], what: str) -> None:
    """Until it is so."""
    until = time.monotonic() + DEADLINE_S
    while not true():
        if time.monotonic() > until:
            raise LabError(f"waited {DEADLINE_S:g} s in vain for {what}")
        time.sleep(0.1)


class Machine(Namespace):
    """One machine, and what can befall it."""

    def iris(self, *arguments: str, keys: str = "keys") -> subprocess.CompletedProcess[str]:
        """One command, to its end. `keys`: another home than the usual one is another user."""
        return subprocess.run(
            self.words(*COMMAND, *arguments),
            capture_output=True,
            text=True,
            check=False,
            cwd=self.folder,
            env=self.environment(keys),
            timeout=DEADLINE_S,
        )

    def start(self, *command: str, says: str, keys: str = "keys") -> subprocess.Popen[bytes]:
        """A process that goes on, from when its output matches `says`; `stop` ends it."""
        out = self.folder / f"{len(self.running)}.out"
        with out.open("wb") as file:
            process = subprocess.Popen(
                self.words(*command),
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
            return re.search(says, out.read_text(errors="replace")) is not None

        wait(ready, f"{says!r} of {command}")
        return process

    @contextlib.contextmanager
    def doing(self, *command: str, says: str, keys: str = "keys") -> Iterator[subprocess.Popen[bytes]]:
        process = self.start(*command, says=says, keys=keys)
        try:
            yield process
        finally:
            stop(process)

    def serve(self, *arguments: str, keys: str = "keys") -> subprocess.Popen[bytes]:
        return self.start(*COMMAND, "serve", "handover", *arguments, says=r"on \S+:\d+,", keys=keys)

    @contextlib.contextmanager
    def firewall(self, *rules: str) -> Iterator[None]:
        """Meanwhile these packets that come in are thrown away, such as `tcp dport 7722`."""
        system(*self.words("nft", "add table inet planted"))
        try:
            system(*self.words("nft", "add chain inet planted in { type filter hook input priority 0; }"))
            for rule in rules:
                system(*self.words("nft", f"add rule inet planted in {rule} drop"))
            yield
        finally:
            system(*self.words("nft", "delete table inet planted"))

    @contextlib.contextmanager
    def addressed(self, address: str, *, too: bool = False) -> Iterator[None]:
        """Meanwhile it has this address, with its prefix length, in place of its own, or `too`."""
        own = f"{self.address}/24"
        self._address("add", address)
        if not too:
            self._address("del", own)
        try:
            yield
        finally:
            self._address("del", address)
            if not too:
                self._address("add", own)

    def _address(self, change: str, address: str) -> None:
        system("ip", "-n", self.name, "addr", change, address, "brd", "+", "dev", self.interface)


def stop(process: subprocess.Popen[bytes]) -> None:
    """Ctrl-C, also to one that was stopped; kills what does not heed it."""
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
    """`server` and `client`. The network is another than that of this machine, which nothing here touches."""

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
        """A disk of the server with room for so much."""
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

    def code(self, *options: str) -> str:
        """A new join code of the session `lab-1`."""
        done = self.server.iris("pair", "--session", "lab-1", "--no-wait", "--json", *options)
        if done.returncode:
            raise LabError(done.stderr.strip())
        return str(json.loads(done.stdout.splitlines()[0])["code"])

    def key_of(self, keys: str) -> str:
        """Public key of one of the client's users."""
        shown: dict[str, Any] = json.loads(self.client.iris("keys", "show", "--json", keys=keys).stdout)
        return str(shown["identity"]["key"])


def require() -> None:
    """Raises `LabError` where no lab can be made."""
    if sys.platform != "linux" or os.geteuid() != 0:
        raise LabError("network namespaces need Linux and root")
    missing = [tool for tool in ("ip", "nft", "mount") if shutil.which(tool) is None]
    if missing:
        raise LabError(f"{', '.join(missing)} not found (Debian: apt-get install iproute2 nftables mount)")
