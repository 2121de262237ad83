"""A link over real TCP, impaired by the proxy: `tests/rig/test_links.py` has the same, and more, in simulated time."""

from __future__ import annotations

import pytest

from iris_session.client import Client
from iris_session.netsim.process import ImpairmentProcess
from tests.e2e.scenario import Scenario
from tests.loopback import make_loopback_address

pytestmark = pytest.mark.e2e

LINK = make_loopback_address()  # of no other test


def test_client_resumes_identity_and_lease_after_cut_and_stall(scenario: Scenario) -> None:
    watcher = scenario.join("watcher", "observer")
    assert watcher.connection.welcome is not None
    host, _, port = scenario.server.address.rpartition(":")
    ports = [int(port), watcher.connection.welcome.endpoints.state]
    with ImpairmentProcess({LINK: "good-wifi"}, ports, target=host, seed=1) as proxy:
        client = Client(f"{LINK}:{port}", name="ann", devices=("desktop",), alignment="not_needed")
        ann = scenario.add(client)
        ann.acquire(["left"])
        hand = scenario.add_hand(ann, "left")
        scenario.engage(hand)
        me = ann.participant_id
        for command in ("cut", "stall"):
            version, reconnects = watcher.mirror.leases["left"].lease_version, ann.connection.counters.reconnects
            proxy.execute(command)
            scenario.run_until(lambda: not watcher.mirror.participants[me].connected, f"ann has left: {command}")
            assert watcher.mirror.leases["left"].holder == me, "in the grace period"
            if command == "stall":
                proxy.execute("resume")
            scenario.run_until(
                lambda version=version: watcher.mirror.leases["left"].lease_version > version,  # type: ignore[misc]
                f"ann's lease is resumed: {command}",
            )
            scenario.run_until(lambda: ann.ready, "ann is ready")
            assert ann.connection.counters.reconnects > reconnects
            assert ann.participant_id == me
            assert watcher.mirror.leases["left"].holder == me
            scenario.engage(hand)
    scenario.server.finish()
