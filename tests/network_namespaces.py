"""Linux network namespaces as two emulated machines on one cable. Needs root and `ip`.

Used by tests and tools, so it does not import pytest.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Namespace:
    """`address` on `interface`; `folder`: its disk, with homes of keys. Without a `name`: this machine."""

    name: str
    interface: str
    address: str
    folder: Path
    running: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def wrap_command(self, *command: str) -> list[str]:
        """Return a command that runs inside."""
        return ["ip", "netns", "exec", self.name, *command] if self.name else [*command]

    def environment(self, keys: str = "keys") -> dict[str, str]:
        """Return the environment of a user: each home of `keys` is a user."""
        return {**os.environ, "IRIS_HOME": str(self.folder / keys)}


def connect(ip: Callable[..., object], one: Namespace, other: Namespace) -> None:
    """Create both, with a cable between them. `ip`: runs that command, and raises when it fails."""
    for machine in (one, other):
        machine.folder.mkdir(parents=True)
        ip("netns", "add", machine.name)
        ip("-n", machine.name, "link", "set", "lo", "up")
    ends = ("link", "add", one.interface, "netns", one.name, "type", "veth")
    ip(*ends, "peer", "name", other.interface, "netns", other.name)
    for machine in (one, other):
        ip("-n", machine.name, "addr", "add", f"{machine.address}/24", "brd", "+", "dev", machine.interface)
        ip("-n", machine.name, "link", "set", machine.interface, "up")
