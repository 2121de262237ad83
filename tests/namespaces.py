"""Machines of their own on this one: Linux network namespaces, two of them on one cable. Needs root and `ip`.

For tests and tools alike, so nothing of pytest is in here.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path


@dataclass
class Namespace:
    """One of them: `address` on `interface`; `folder`: its disk, with homes of keys. Without a `name`: this machine."""

    name: str
    interface: str
    address: str
    folder: Path
    running: list[subprocess.Popen[bytes]] = field(default_factory=list)

    def words(self, *command: str) -> list[str]:
        """A command, as it is run inside."""
        return ["ip", "netns", "exec", self.name, *command] if self.name else [*command]

    def environment(self, keys: str = "keys") -> dict[str, str]:
        """`keys`: another home than the usual one is another user."""
        return {**os.environ, "IRIS_HOME": str(self.folder / keys)}


def connect(ip: Callable[..., object], one: Namespace, other: Namespace) -> None:
    """Makes both, with a cable between them. `ip`: runs that command, and raises when it fails."""
    for machine in (one, other):
        machine.folder.mkdir(parents=True)
        ip("netns", "add", machine.name)
        ip("-n", machine.name, "link", "set", "lo", "up")
    ends = ("link", "add", one.interface, "netns", one.name, "type", "veth")
    ip(*ends, "peer", "name", other.interface, "netns", other.name)
    for machine in (one, other):
        ip("-n", machine.name, "addr", "add", f"{machine.address}/24", "brd", "+", "dev", machine.interface)
        ip("-n", machine.name, "link", "set", machine.interface, "up")
