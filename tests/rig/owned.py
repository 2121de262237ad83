"""Sessions that a test makes and runs itself, as a program does, in simulated time and without processes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import pytest

from iris_session.client import client as client_module
from iris_session.client import endpoint_resolver
from iris_session.session import processes
from iris_session.session.stepper import Stepper
from tests.rig.front import RigFrontProcess, install_front
from tests.rig.journal import Journal
from tests.rig.network import Network, RigClientSockets, refuse_introduction
from tests.rig.simulation import Simulation, simulate_modules


@contextlib.contextmanager
def simulate_sessions(seed: int = 1) -> Iterator[Simulation]:
    """Let sessions have a front of the rig, and simulated time: `Session.run` sleeps in it, and so moves it on.

    Sessions must not record: see `keep_journal`. Helper threads take steps while the simulation runs, and so does
    whatever a client waits for.
    """
    simulation = Simulation(seed)
    network = Network(simulation)
    with pytest.MonkeyPatch.context() as patch:
        simulate_modules(simulation, patch)
        install_front(network, patch)
        patch.setattr(client_module, "ClientSockets", lambda: RigClientSockets(network, "lan", seed))
        patch.setattr(endpoint_resolver, "request_introduction", refuse_introduction)
        patch.setattr(processes, "FrontProcess", lambda config, scene: RigFrontProcess(config, scene, simulation))
        yield simulation


def keep_journal(stepper: Stepper) -> Journal:
    """Give a stepper that has taken no step yet a journal, which can be verified."""
    core = stepper.core
    journal = stepper.recorder = Journal(core.config, core.world.encode_model())
    return journal
