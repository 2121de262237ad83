"""Real simulators in environments of their own: what an observer receives is what the simulator says."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tools.simulators import CASES, PACKAGES

pytestmark = [pytest.mark.e2e, pytest.mark.long]

ROOT = Path(__file__).parents[2]
TOOL = ROOT / "tools" / "simulators.py"


def test_every_simulator_has_a_case() -> None:
    assert set(CASES) == set(PACKAGES)


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", list(PACKAGES))
def test_observers_see_what_the_simulator_says(name: str) -> None:
    """The first run makes the environment: Genesis takes 4 GB, the others 0.4 to 0.7 GB."""
    done = subprocess.run(
        [sys.executable, str(TOOL), name, "--json"], capture_output=True, text=True, check=False, cwd=ROOT
    )
    result = json.loads(done.stdout.splitlines()[-1])
    assert done.returncode == 0, result
    assert result["passed"] == result["of"] == 1
