"""Two machines on one network, as network namespaces with addresses of their own. Needs root and `ip` (iproute2)."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import psutil

from tests.e2e.session_process import COMMAND, DEADLINE_S, list_descendants, skip_unless_ci, wait_until
from tests.network_namespaces import Namespace, connect

#: Frames of state after which an observer counts as having joined.
ENOUGH_FRAMES: Final = 20


def ip(*arguments: str) -> None:
    done = subprocess.run(["ip", *arguments], capture_output=True, text=True, check=False)
    assert done.returncode == 0, f"ip {' '.join(arguments)}: {done.stderr}"


class Machine(Namespace):
    """A network namespace that runs `iris-session` commands."""

    def command(self, *arguments: str) -> list[str]:
        return self.wrap_command(*COMMAND, *arguments)

    def run_command(self, *arguments: str, timeout_s: float = DEADLINE_S) -> subprocess.CompletedProcess[str]:
        """Run one command to its end."""
        return subprocess.run(
            self.command(*arguments),
            capture_output=True,
            text=True,
            check=False,
            cwd=self.folder,
            env=self.environment(),
            timeout=timeout_s,
        )

    def run_observer(self, *target: str) -> dict[str, Any]:
        """Run an emulated observer until it has received enough frames or failed. Return its last report."""
        command = self.command("emulate", *target, "--behaviour", "observer", "--seconds", f"{DEADLINE_S}", "--json")
        process = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=self.folder, env=self.environment()
        )
        assert process.stdout is not None
        report: dict[str, Any] = {}
        interrupted = False
        for line in process.stdout:
            report = json.loads(line)
            if report["frames"] > ENOUGH_FRAMES and not interrupted:
                interrupted = True
                process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=DEADLINE_S)
        assert report, errors
        assert process.returncode == (1 if report["failed"] else 0), errors
        return report

    def serve(
        self, *arguments: str, scene: str = "handover", command: Sequence[str] = COMMAND, keys: str = "keys"
    ) -> ServedSession:
        out = self.folder / f"serve{len(self.running)}.out"
        with out.open("wb") as file:
            process = subprocess.Popen(
                self.wrap_command(*command, "serve", scene, "--no-record", *arguments),
                stdout=file,
                stderr=subprocess.STDOUT,
                cwd=self.folder,
                env=self.environment(keys),
            )
        self.running.append(process)
        served = ServedSession(process, out)
        wait_until(lambda: served.is_listening or process.poll() is not None, "the session listens")
        assert process.poll() is None, served.output
        return served

    def close(self) -> None:
        """Kill what a failed test left running."""
        for process in self.running:
            if process.poll() is None:
                children = list_descendants(process.pid)
                process.kill()
                process.wait()
                psutil.wait_procs(children, timeout=5.0)


@dataclass
class ServedSession:
    """A session that a machine serves."""

    process: subprocess.Popen[bytes]
    out: Path

    @property
    def output(self) -> str:
        return self.out.read_text(errors="replace")

    @property
    def is_listening(self) -> bool:
        return re.search(r"on (\S+:\d+),", self.output) is not None

    @property
    def address(self) -> str:
        found = re.search(r"on (\S+:\d+),", self.output)
        assert found
        return found[1]


class Network:
    """`server` and `headset`, with one cable between them."""

    def __init__(self, folder: Path) -> None:
        mark = f"{os.getpid() % 100_000}"
        self.server = Machine(f"iris-s{mark}", f"irs{mark}", "10.77.1.1", folder / "server")
        self.headset = Machine(f"iris-h{mark}", f"irh{mark}", "10.77.1.2", folder / "headset")
        self.machines = (self.server, self.headset)
        try:
            connect(ip, *self.machines)
        except BaseException:
            self.close()
            raise

    def block_broadcasts(self) -> None:
        """Keep broadcasts from the headset, as some access points do: its address gets a /32 prefix."""
        name, interface = self.headset.name, self.headset.interface
        ip("-n", name, "addr", "flush", "dev", interface)
        ip("-n", name, "addr", "add", f"{self.headset.address}/32", "dev", interface)
        ip("-n", name, "route", "add", "10.77.1.0/24", "dev", interface)

    def allow_broadcasts(self) -> None:
        name, interface = self.headset.name, self.headset.interface
        ip("-n", name, "addr", "flush", "dev", interface)
        ip("-n", name, "addr", "add", f"{self.headset.address}/24", "brd", "+", "dev", interface)

    def close(self) -> None:
        for machine in self.machines:
            machine.close()
            subprocess.run(["ip", "netns", "del", machine.name], capture_output=True, check=False)


def require_namespaces() -> None:
    """Skip without root and `ip`, which creating network namespaces requires."""
    if sys.platform != "linux" or os.geteuid() != 0 or shutil.which("ip") is None:
        skip_unless_ci("network namespaces need Linux, root, and ip (Debian: iproute2)")
