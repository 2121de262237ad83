"""Joining from another machine: by address and code, by pairing URI, by name, without broadcasts, and never a session
other than the intended one. Sessions and clients are processes in network namespaces."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from iris_session.security import KeyHome, KeyPair
from tests.e2e.session_process import FREE_PORTS, wait_until
from tests.e2e.virtual_network import ENOUGH_FRAMES, Machine, Network, ServedSession, require_namespaces

pytestmark = pytest.mark.e2e

#: Limit for a user who follows the README [s].
README_S = 120.0


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


@pytest.mark.long
def test_other_machine_finds_pairs_joins_and_rejoins(network: Network, lab: ServedSession) -> None:
    started = time.monotonic()
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
    assert time.monotonic() - started < README_S
    assert shown["code"].replace("-", "") not in "".join(
        file.read_text(errors="replace") for file in (server.folder / "keys").iterdir()
    )


@pytest.mark.long
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


@pytest.mark.long
def test_second_session_of_the_same_name_or_ports_is_renamed_or_refused(network: Network, lab: ServedSession) -> None:
    server, headset = network.server, network.headset
    same = server.run_command("serve", "handover", "--no-record", "--interface", server.interface, "--name", "lab-1")
    assert same.returncode == 2
    assert "7720" in same.stderr
    assert "--port-base" in same.stderr
    first = server.serve("--interface", server.interface, "--name", "lab-1", "--port-base", "7730")
    second = headset.serve("--host", "0.0.0.0", "--name", "lab-1", "--advertise", "10.77.1.2")
    try:
        assert (first.name, first.address) == ("lab-1-2", "10.77.1.1:7731")
        assert "10.77.1.1:7721" in first.output
        assert second.name == "lab-1-3"
        all_sessions = {"lab-1": "10.77.1.1:7721", "lab-1-2": "10.77.1.1:7731", "lab-1-3": "10.77.1.2:7721"}
        for machine in network.machines:
            wait_until(
                lambda machine=machine: list_sessions(machine) == all_sessions, f"all are listed on {machine.name}"
            )
        assert server.run_observer("--session", "lab-1-3")["failed"].startswith("refused (unpaired)")
    finally:
        first.stop()
        second.stop()


def test_changed_server_key_is_refused_until_it_is_forgotten(network: Network, lab: ServedSession) -> None:
    headset = network.headset
    headset.run_command("keys", "forget", "10.77.1.1:7721")
    impostor = KeyPair.generate().public
    KeyHome(headset.folder / "keys").known_servers.pin("10.77.1.1:7721", "lab-1", impostor)
    for target in (("10.77.1.1",), ("--session", "lab-1")):
        done = headset.run_command("emulate", *target)
        assert done.returncode == 1
        assert "keys forget" in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
    assert headset.run_command("keys", "forget", "10.77.1.1:7721").returncode == 0
    assert headset.run_observer("10.77.1.1", "--code", pair(network.server)["code"])["frames"] > ENOUGH_FRAMES


def test_doctor_names_both_addresses_of_different_subnets(network: Network, lab: ServedSession) -> None:
    network.move_to_other_subnet()
    done = network.headset.run_command("doctor", network.server.address, "--json")
    network.allow_broadcasts()
    found = {check["check"]: check for check in json.loads(done.stdout)["checks"]}
    assert done.returncode == 1
    assert found["subnet"]["state"] == "failed"
    assert "10.77.1.1" in found["subnet"]["text"]
    assert "10.88.1.0/24" in found["subnet"]["text"]
    assert found["subnet"]["advice"]


def test_unknown_interface_error_lists_the_interfaces(network: Network) -> None:
    done = network.server.run_command("serve", "handover", "--no-record", "--interface", "wlan7")
    assert done.returncode == 2
    assert "wlan7" in done.stderr
    assert f"{network.server.interface} (10.77.1.1)" in done.stderr


@pytest.mark.long
def test_session_on_ipv6_without_beacon(tmp_path: Path) -> None:
    machine = Machine("", "lo", "::1", tmp_path)
    try:
        served = machine.serve("--host", "::1", "--no-beacon", *FREE_PORTS)
        assert served.address.startswith("[::1]:")
        assert served.address not in list_sessions(machine).values()
        assert machine.run_observer(served.address)["frames"] > ENOUGH_FRAMES
        served.stop()
    finally:
        machine.close()
