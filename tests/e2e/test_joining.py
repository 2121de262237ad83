"""Joining from another machine: by address and code, by pairing URI, by name; without broadcasts; and never another
session than the one that was meant. Sessions and people are processes in network namespaces."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from iris_session.security import KeyHome, KeyPair
from tests.e2e.conftest import wait
from tests.e2e.networks import SEEN, Machine, Network, Served, require_namespaces

pytestmark = pytest.mark.e2e

#: What a person who follows only the README may take.
README_S = 120.0
FREE_PORTS = ("--control-port", "0", "--state-port", "0")


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    require_namespaces()
    network = Network(tmp_path_factory.mktemp("network"))
    yield network
    network.close()


@pytest.fixture(scope="module")
def lab(network: Network) -> Served:
    return network.server.serve("--interface", network.server.interface, "--name", "lab-1")


def listed(machine: Machine) -> dict[str, str]:
    """Name and address of what `iris-session sessions` hears."""
    done = machine.iris("sessions", "--json")
    report = json.loads(done.stdout)
    assert done.returncode == (0 if report["ok"] else 1)
    return {session["name"]: session["address"] for session in report["sessions"]}


def pair(machine: Machine) -> dict[str, Any]:
    done = machine.iris("pair", "--session", "lab-1", "--no-wait", "--json")
    assert done.returncode == 0, done.stderr
    told: dict[str, Any] = json.loads(done.stdout.splitlines()[0])
    return told


def test_another_machine_finds_pairs_joins_and_comes_back(network: Network, lab: Served) -> None:
    started = time.monotonic()
    server, headset = network.server, network.headset
    assert lab.address == "10.77.1.1:7721"
    wait(lambda: listed(headset) == {"lab-1": "10.77.1.1:7721"}, "the session is listed")
    assert "iris-session pair" in headset.look("10.77.1.1")["failed"]
    told = pair(server)
    assert told["addresses"][0] == "10.77.1.1:7721"
    first = headset.look("10.77.1.1", "--code", told["code"])
    assert not first["failed"]
    assert first["frames"] > SEEN
    for where in (("10.77.1.1:7721",), ("--session", "lab-1"), ("10.77.1.1", "--code", told["code"])):
        assert headset.look(*where)["frames"] > SEEN
    assert time.monotonic() - started < README_S
    assert told["code"].replace("-", "") not in "".join(
        file.read_text(errors="replace") for file in (server.folder / "keys").iterdir()
    )


def test_a_scanned_uri_is_enough_where_broadcasts_are_blocked(network: Network, lab: Served) -> None:
    stranger = Machine(
        network.headset.name, network.headset.interface, network.headset.address, network.headset.folder / "other"
    )
    stranger.folder.mkdir()
    network.block_broadcasts()
    try:
        assert listed(stranger) == {}
        nobody = stranger.iris("emulate", "--session", "lab-1", "--join-timeout", "2")
        assert nobody.returncode == 1
        assert "was not heard" in nobody.stderr
        assert "type its address" in nobody.stderr
        uri = pair(network.server)["uri"]
        assert stranger.look(uri)["frames"] > SEEN
        assert stranger.look("10.77.1.1")["frames"] > SEEN
    finally:
        network.allow_broadcasts()


def test_a_second_session_of_the_same_name_or_ports_is_never_taken_for_the_first(network: Network, lab: Served) -> None:
    server, headset = network.server, network.headset
    same = server.iris("serve", "handover", "--no-record", "--interface", server.interface, "--name", "lab-1")
    assert same.returncode == 2
    assert "port 7720 (introduction) is in use" in same.stderr
    assert "--port-base" in same.stderr
    here = server.serve("--interface", server.interface, "--name", "lab-1", "--port-base", "7730")
    there = headset.serve("--host", "0.0.0.0", "--name", "lab-1", "--advertise", "10.77.1.2")
    try:
        assert (here.name, here.address) == ("lab-1-2", "10.77.1.1:7731")
        assert "another session called 'lab-1' is at 10.77.1.1:7721: this one is called 'lab-1-2'" in here.output
        assert there.name == "lab-1-3"
        everywhere = {"lab-1": "10.77.1.1:7721", "lab-1-2": "10.77.1.1:7731", "lab-1-3": "10.77.1.2:7721"}
        for machine in network.machines:
            wait(lambda machine=machine: listed(machine) == everywhere, f"all are listed on {machine.name}")
        assert server.look("--session", "lab-1-3")["failed"].startswith("refused (unpaired)")
    finally:
        here.stop()
        there.stop()


def test_another_key_than_the_stored_one_is_refused_until_it_is_forgotten(network: Network, lab: Served) -> None:
    headset = network.headset
    headset.iris("keys", "forget", "10.77.1.1:7721")
    impostor = KeyPair.generate().public
    KeyHome(headset.folder / "keys").known_servers.pin("10.77.1.1:7721", "lab-1", impostor)
    for where in (("10.77.1.1",), ("--session", "lab-1")):
        done = headset.iris("emulate", *where)
        assert done.returncode == 1
        assert "keys forget" in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1
    assert headset.iris("keys", "forget", "10.77.1.1:7721").returncode == 0
    assert headset.look("10.77.1.1", "--code", pair(network.server)["code"])["frames"] > SEEN


def test_another_network_is_named_with_both_addresses(network: Network, lab: Served) -> None:
    network.other_subnet()
    done = network.headset.iris("doctor", network.server.address, "--json")
    network.allow_broadcasts()
    found = {one["check"]: one for one in json.loads(done.stdout)["checks"]}
    assert done.returncode == 1
    assert found["subnet"]["state"] == "failed"
    assert "10.77.1.1" in found["subnet"]["text"]
    assert "10.88.1.0/24" in found["subnet"]["text"]
    assert "same network" in found["subnet"]["advice"]


def test_an_interface_that_is_not_there_is_told_with_those_that_are(network: Network) -> None:
    done = network.server.iris("serve", "handover", "--no-record", "--interface", "wlan7")
    assert done.returncode == 2
    assert f"no interface 'wlan7' on this machine, which has {network.server.interface} (10.77.1.1), lo" in done.stderr


def test_a_session_on_ipv6_and_without_beacon(tmp_path: Path) -> None:
    here = Machine("", "lo", "::1", tmp_path)
    try:
        served = here.serve("--host", "::1", "--no-beacon", *FREE_PORTS)
        assert served.address.startswith("[::1]:")
        assert served.address not in listed(here).values()
        assert here.look(served.address)["frames"] > SEEN
        served.stop()
    finally:
        here.close()
