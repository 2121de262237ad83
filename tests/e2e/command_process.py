"""Processes that take commands one by one: headsets in C#, and what serves or watches a session beside them."""

from __future__ import annotations

import contextlib
import json
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tests.e2e.session_process import DEADLINE_S, wait_until


class CommandProcess:
    """A process that answers each line of its input by a line of JSON, with `command` and `ok`."""

    def __init__(self, command: list[str], folder: Path, environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=environment,
        )
        self.results: list[dict[str, Any]] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.results.extend(json.loads(line) for line in self.process.stdout)

    def send(self, command: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()

    def do(self, command: str) -> dict[str, Any]:
        """Have a command done and return its result."""
        return self.begin(command)()

    def begin(self, command: str) -> Callable[[], dict[str, Any]]:
        """Have a command done while others do theirs. Returns what waits for its result."""
        name = command.split(maxsplit=1)[0]
        before = self._count(name)
        self.send(command)
        return lambda: self.wait_for(name, before + 1)

    def wait_for(self, name: str, n: int = 1) -> dict[str, Any]:
        """Wait for the `n`-th result of a command."""
        wait_until(
            lambda: self._count(name) >= n or not self._reader.is_alive(),
            f"{n} results of {name}: {self.results}",
            2.0 * DEADLINE_S,
        )
        assert self._count(name) >= n, self.results
        return [one for one in self.results if one["command"] == name][n - 1]

    def _count(self, name: str) -> int:
        return sum(one["command"] == name for one in self.results)

    def end(self) -> int:
        """Let it end by itself, and return its exit status."""
        if self.process.poll() is None:
            self.send("quit")
        return self.process.wait(DEADLINE_S)

    def close(self) -> None:
        """Kill it if it still runs."""
        self.process.kill()
        self._reader.join()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self.process.wait()


class Headset(CommandProcess):
    """A headset in C#."""

    def pair_and_join(self) -> dict[str, Any]:
        """Join by the code that it was given, however often a busy gateway lets it try."""
        joined = self.do("join")
        assert joined["ok"], self.results
        assert any(one["command"] == "pair" and one["ok"] for one in self.results), self.results
        return joined

    def wait_for_view(self, condition: Callable[[dict[str, Any]], object], what: str) -> dict[str, Any]:
        """Ask for what it sees of the session until a condition holds."""
        wait_until(lambda: condition(self.do("view")), what)
        return self.results[-1]

    def wait_until_back(self, epoch: int) -> dict[str, Any]:
        """Wait for a connection that is newer than `epoch`, and return what it sees then."""
        return self.wait_for_view(lambda v: v["phase"] == "Ready" and v["epoch"] > epoch, f"back after {epoch}")
