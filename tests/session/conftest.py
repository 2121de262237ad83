"""The model of the demo, and sessions without processes, in simulated time."""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import pytest

from iris_session.demo.scenes import scene_path
from iris_session.physics import load_model
from tests.rig.owned import simulate_sessions
from tests.rig.simulation import Simulation


@pytest.fixture
def model() -> mujoco.MjModel:
    return load_model(scene_path("handover"))


@pytest.fixture
def simulation() -> Iterator[Simulation]:
    with simulate_sessions() as simulation:
        yield simulation
