"""Unique names of sessions on one network, and the notes about them."""

from __future__ import annotations

import contextlib
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from iris_session.link.discovery import BeaconListener
from iris_session.protocol.codec import encode_beacon
from iris_session.protocol.discovery import Beacon
from iris_session.session.unique_name import LISTEN_S, NameFinder


@contextmanager
def neighbours(*names: str) -> Iterator[NameFinder]:
    """Return a `NameFinder` on a free port that receives beacons of sessions with these names."""
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as free:
            free.bind(("", 0))
            port = free.getsockname()[1]
        made = NameFinder(port)
        for number, name in enumerate(names):
            beacon = Beacon(1, f"s{number}", name, "live", "127.0.0.1", 7721 + 10 * number, 0, 0, 0, 0)
            sender.sendto(encode_beacon(beacon), ("127.0.0.1", port))
        yield made
        made.close()


def test_free_name_is_kept() -> None:
    with neighbours("other") as near:
        assert near.find_free_name("lab") == "lab"
        assert near.notes == []


def test_name_in_use_gets_the_next_free_number() -> None:
    with neighbours("lab", "lab-2", "lab-4") as near:
        assert near.find_free_name("lab") == "lab-3"
        (note,) = near.notes
        assert "127.0.0.1:7721" in note
        assert "'lab-3'" in note


def test_long_name_stays_within_the_limit() -> None:
    with neighbours("x" * 48) as near:
        free = near.find_free_name("x" * 48)
    assert free == "x" * 44 + "-2"


def test_finder_waits_only_for_the_rest_of_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    with neighbours("lab") as near:
        time.sleep(LISTEN_S)
        monkeypatch.setattr(BeaconListener, "wait", lambda self, timeout_s: pytest.fail("waits again"))
        assert near.find_free_name("lab") == "lab-2"


def test_finder_without_beacons_keeps_the_name() -> None:
    near = NameFinder(0)
    assert near.find_free_name("lab") == "lab"
    near.close()


def test_finder_port_in_use_is_noted_and_keeps_the_name() -> None:
    with contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as greedy:
        greedy.bind(("", 0))
        near = NameFinder(greedy.getsockname()[1])
        assert near.find_free_name("lab") == "lab"
        assert "cannot be found" in near.notes[0]
        near.close()
