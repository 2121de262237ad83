"""Running the doctor, and reading what it says."""

from __future__ import annotations

import json
import os
import subprocess
from pathlib import Path
from typing import Any

from tests.e2e.conftest import COMMAND


class Diagnosis:
    """What one run of the doctor said."""

    def __init__(self, status: int, out: str) -> None:
        self.status = status
        self.document: dict[str, Any] = json.loads(out)
        self.checks = {check["check"]: check for check in self.document["checks"]}

    def named(self, check: str, *texts: str, state: str = "failed") -> None:
        """That this check is not well, and says so in these words."""
        found = self.checks[check]
        assert found["state"] == state, self.troubles()
        told = f"{found['text']} {found['why']} {found['advice']}"
        assert all(text in told for text in texts), told
        assert found["advice"] or found["why"], "a doctor who only says that you are ill"

    def troubles(self) -> list[dict[str, str]]:
        return [check for check in self.checks.values() if check["state"] in ("failed", "warning")]

    def failed(self) -> set[str]:
        return {name for name, check in self.checks.items() if check["state"] == "failed"}


def doctor(*arguments: str, home: Path | None = None) -> Diagnosis:
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
    return Diagnosis(done.returncode, done.stdout)
