"""Joining from another machine: by address and code, by name, by pairing URI, and never a session with another key.

Sessions and clients are processes in network namespaces.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.e2e.session_process import wait_until
from tests.e2e.virtual_network import ENOUGH_FRAMES, Machine, Network, ServedSession, require_namespaces

pytestmark = pytest.mark.e2e


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    require_namespaces()
    network = Network(tmp_path_factory.mktemp("network"))
    yield network
    network.close()


@pytest.fixture(scope="module")
def lab(network: Network) -> ServedSession:
    return network.server.serve("--interface", network.server.interface, "--name", "lab-1")


def list_sessions(machine: Machine) -> dict[str, str]:
    """Return name and address of the sessions that `iris-session sessions` hears."""
    done = machine.run_command("sessions", "--json")
    report = json.loads(done.stdout)
    assert done.returncode == (0 if report["ok"] else 1)
    return {session["name"]: session["address"] for session in report["sessions"]}


def pair(machine: Machine) -> dict[str, Any]:
    done = machine.run_command("pair", "--session", "lab-1", "--no-wait", "--json")
    assert done.returncode == 0, done.stderr
    shown: dict[str, Any] = json.loads(done.stdout.splitlines()[0])
    return shown


def test_other_machine_finds_pairs_joins_and_rejoins(network: Network, lab: ServedSession) -> None:
    server, headset = network.server, network.headset
    assert lab.address == "10.77.1.1:7721"
    wait_until(lambda: list_sessions(headset) == {"lab-1": "10.77.1.1:7721"}, "the session is listed")
    assert "iris-session pair" in headset.run_observer("10.77.1.1")["failed"]
    shown = pair(server)
    assert shown["addresses"][0] == "10.77.1.1:7721"
    first = headset.run_observer("10.77.1.1", "--code", shown["code"])
    assert not first["failed"]
    assert first["frames"] > ENOUGH_FRAMES
    for target in (("10.77.1.1:7721",), ("--session", "lab-1"), ("10.77.1.1", "--code", shown["code"])):
        assert headset.run_observer(*target)["frames"] > ENOUGH_FRAMES
    assert shown["code"].replace("-", "") not in "".join(
        file.read_text(errors="replace") for file in (server.folder / "keys").iterdir()
    )


def test_pairing_uri_is_sufficient_where_broadcasts_are_blocked(network: Network, lab: ServedSession) -> None:
    other_user = Machine(
        network.headset.name, network.headset.interface, network.headset.address, network.headset.folder / "other"
    )
    other_user.folder.mkdir()
    network.block_broadcasts()
    try:
        assert list_sessions(other_user) == {}
        done = other_user.run_command("emulate", "--session", "lab-1", "--join-timeout", "2")
        assert done.returncode == 1
        assert "lab-1" in done.stderr
        uri = pair(network.server)["uri"]
        assert other_user.run_observer(uri)["frames"] > ENOUGH_FRAMES
        assert other_user.run_observer("10.77.1.1")["frames"] > ENOUGH_FRAMES
    finally:
        network.allow_broadcasts()
