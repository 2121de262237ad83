"""The processes of a benchmark beside its session: each runs one plug-in, which the benchmark calls by lines of JSON.

    python -m iris_session.bench.plugins iris_session.bench.clients:StateClients

The first line of standard input has the arguments of the plug-in, every later one is a call: `["measure", 1000, 2000]`.
Each is answered by one line, the first too: what the method returned, as JSON. Between calls the plug-in is polled.
"""

from __future__ import annotations

import importlib
import json
import select
import sys
import time
from typing import Any, Final, get_type_hints

import msgspec

from iris_session.bench.report import BenchError
from iris_session.system.process import PIPE, ChildProcess, take_stdout

#: Time in which a call is answered, such as that for pictures or for a whole window [s].
ANSWER_S: Final = 600.0
POLL_S: Final = 0.02
#: In which a process that has closed its output ends [s].
EXIT_S: Final = 10.0


class Plugin:
    """Base of plug-ins. Public methods are calls. Arguments of the constructor have annotations: they come as JSON."""

    def poll(self) -> None:
        """Do what is due between calls; takes `POLL_S` at most."""
        time.sleep(POLL_S)

    def close(self) -> None:
        """Release what the plug-in holds; the session may have ended first."""


class PluginProcess(ChildProcess):
    """A process that runs a plug-in.

    Args:
        plugin: Module and class of the plug-in, `module:Class`.
        arguments: Of its constructor.
    """

    def __init__(self, plugin: str, *arguments: Any) -> None:
        self._name = plugin.partition(":")[2]
        # Ctrl-C ends the benchmark, which ends this.
        super().__init__("iris_session.bench.plugins", [plugin], stdout=PIPE, own_group=True)
        self._answers: list[bytes] = []
        self.write(msgspec.json.encode(arguments) + b"\n")

    def send(self, method: str, *arguments: Any) -> None:
        """Call a method; `read` returns its answer."""
        self.write(json.dumps([method, *arguments]).encode() + b"\n")

    def has_answered(self) -> bool:
        """Return whether an answer can be read without waiting. Raises `BenchError` if the process has ended."""
        self._answers += self.read_available_lines()
        if not self._answers and not self.is_running:
            raise self._make_error()
        return bool(self._answers)

    def read(self, timeout_s: float = ANSWER_S) -> Any:
        """Return the next answer. Raises `BenchError` if there is none within `timeout_s`."""
        if self._answers:
            return json.loads(self._answers.pop(0))
        try:
            return json.loads(self.read_line(timeout_s))
        except TimeoutError as error:
            raise BenchError(f"{self._name}: {error}") from None
        except EOFError:
            raise self._make_error() from None

    def ask(self, method: str, *arguments: Any, timeout_s: float = ANSWER_S) -> Any:
        """Call a method and return its answer. Raises `BenchError`."""
        self.send(method, *arguments)
        return self.read(timeout_s)

    def _make_error(self) -> BenchError:
        return BenchError(f"{self._name}, a process of the benchmark, failed with exit status {self.wait(EXIT_S)}")


def run_plugin(name: str) -> None:
    """Make a plug-in of its arguments on standard input, and answer calls until standard input ends."""
    module, _, kind = name.partition(":")
    plugin_type: type[Plugin] = getattr(importlib.import_module(module), kind)
    # Without a buffer, so that `poll` sees a line that has come.
    with open(sys.stdin.fileno(), "rb", buffering=0, closefd=False) as calls, open(take_stdout(), "wb", 0) as answers:
        kinds = get_type_hints(plugin_type.__init__)
        plugin = plugin_type(*map(msgspec.convert, json.loads(calls.readline()), kinds.values()))
        try:
            answers.write(b"null\n")
            ready = select.poll()
            ready.register(calls, select.POLLIN)
            while True:
                while not ready.poll(0):
                    plugin.poll()
                line = calls.readline()
                if not line:
                    return
                method, *arguments = json.loads(line)
                answers.write(msgspec.json.encode(getattr(plugin, method)(*arguments)) + b"\n")
        finally:
            plugin.close()


if __name__ == "__main__":
    run_plugin(sys.argv[1])
