"""What somebody at the terminal, or a test, does to emulated headsets while they run: lines of `KIND NAME`."""

from __future__ import annotations

import os
import select
import sys
from collections.abc import Sequence
from typing import Final

#: What can be done to the tracking frame of a headset: `Person.disturb`.
KINDS: Final = ("bump", "drift", "recentre", "steady")
MAX_LINE: Final = 256  # bytes; a longer line is no order


class Orders:
    """Calling it gives the orders that have come since, as (kind, name); it never waits. `names`: of the people."""

    def __init__(self, fd: int, names: Sequence[str]) -> None:
        self._fd = fd
        self._ready = select.poll()  # takes files as well as pipes, and descriptors above 1023
        self._ready.register(fd, select.POLLIN)
        self._names = tuple(names)
        self._rest = b""
        self._open = True

    def __call__(self) -> list[tuple[str, str]]:
        while self._open and self._ready.poll(0):
            data = os.read(self._fd, 4096)
            self._open = bool(data)
            self._rest += data
            if self._open and b"\n" not in data and len(self._rest) > MAX_LINE:
                self._rest = self._rest[-MAX_LINE:]
        *lines, self._rest = self._rest.split(b"\n")
        return [order for line in lines if line.strip() for order in self._read(line)]

    def _read(self, line: bytes) -> list[tuple[str, str]]:
        """One order, or a word on standard error about what is none."""
        kind, _, name = line[:MAX_LINE].decode(errors="replace").strip().partition(" ")
        if kind in KINDS and name in self._names:
            return [(kind, name)]
        known = f"{', '.join(KINDS[:-1])} or {KINDS[-1]}, then one of {', '.join(self._names)}"
        print(f"no order: {kind} {name}".rstrip() + f"; it is {known}", file=sys.stderr, flush=True)
        return []
