"""Unique names of sessions on one network, and the notes about them."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from iris_session.link.discovery import DiscoveryError, FoundSession
from iris_session.session import unique_name
from iris_session.session.unique_name import NameFinder


class Network:
    """Other sessions and the clock.

    Attributes:
        names: Of the sessions that are heard.
        error: Of opening the port.
    """

    def __init__(self) -> None:
        self.names: tuple[str, ...] = ()
        self.now_s = 100.0
        self.error: DiscoveryError | None = None

    def open_listener(self, port: int) -> Network:
        if self.error is not None:
            raise self.error
        return self

    def wait(self, timeout_s: float) -> None:
        self.now_s += timeout_s

    def poll_sessions(self) -> list[FoundSession]:
        where = [(name, f"192.0.2.{n}:7721", f"s{n}") for n, name in enumerate(self.names)]
        return [FoundSession(name, address, id, "live", "", (address,)) for name, address, id in where]

    def close(self) -> None: ...


@pytest.fixture
def network(monkeypatch: pytest.MonkeyPatch) -> Network:
    network = Network()
    monkeypatch.setattr(unique_name, "BeaconListener", network.open_listener)
    monkeypatch.setattr(unique_name, "time", SimpleNamespace(monotonic=lambda: network.now_s))
    return network


@pytest.mark.parametrize(
    ("heard", "name", "free"),
    [
        (("other",), "lab", "lab"),
        (("lab", "lab-2", "lab-4"), "lab", "lab-3"),
        (("x" * 48,), "x" * 48, "x" * 44 + "-2"),
    ],
)
def test_name_in_use_gets_the_next_free_number(network: Network, heard: tuple[str], name: str, free: str) -> None:
    network.names = heard
    finder = NameFinder(7720)
    assert finder.find_free_name(name) == free
    assert [("192.0.2.0:7721" in note, repr(free) in note) for note in finder.notes] == [(True, True)] * (free != name)
    finder.close()


def test_finder_without_beacons_or_a_port_keeps_the_name(network: Network) -> None:
    network.names = ("lab",)
    silent = NameFinder(0)
    assert (silent.find_free_name("lab"), silent.notes) == ("lab", [])
    network.error = DiscoveryError("port 7720 is in use")
    finder = NameFinder(7720)
    assert finder.find_free_name("lab") == "lab"
    assert "port 7720 is in use" in finder.notes[0]
