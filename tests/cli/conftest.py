"""The command line as a fixture: `cli.run("keys", "list")`."""

from __future__ import annotations

import json
from typing import Any

import pytest

from iris_session.cli.main import main


class CommandLine:
    """Runs commands and checks their exit status. `out`, `err`: what the last one and its processes printed."""

    def __init__(self, capfd: pytest.CaptureFixture[str]) -> None:
        self._capfd = capfd
        self.out = self.err = ""

    def run(self, *words: object, status: int = 0) -> str:
        """Run a command and return its standard output."""
        self._capfd.readouterr()
        try:
            found = main([*map(str, words)])
        except SystemExit as ended:  # of the parser
            found = int(ended.code or 0)
        self.out, self.err = self._capfd.readouterr()
        assert found == status, self.err
        return self.out

    def json(self, *words: object, status: int = 0) -> dict[str, Any]:
        """Return the object that a command prints with `--json`."""
        result: dict[str, Any] = json.loads(self.run(*words, "--json", status=status))
        return result

    def refuse(self, *words: object, status: int = 2) -> str:
        """Return the error of a command: one line, and nothing else."""
        assert self.run(*words, status=status) == "" or status == 1
        assert self.err.startswith("iris-session")
        assert self.err.count("\n") == 1, self.err
        return self.err


@pytest.fixture
def cli(capfd: pytest.CaptureFixture[str]) -> CommandLine:
    return CommandLine(capfd)
