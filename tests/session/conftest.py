"""Sessions without processes, in simulated time."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.rig.owned import simulate_sessions
from tests.rig.simulation import Simulation


@pytest.fixture
def simulation() -> Iterator[Simulation]:
    with simulate_sessions() as simulation:
        yield simulation
