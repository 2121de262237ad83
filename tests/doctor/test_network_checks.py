"""Checks of the route to a session on this machine: names, networks, closed ports, introductions."""

from __future__ import annotations

import errno
import socket
from collections.abc import Generator
from typing import ClassVar

import pytest

from iris_session.client.discovery import Address
from iris_session.doctor import network_checks
from iris_session.doctor.findings import failed, ok
from iris_session.doctor.runner import run_checks
from iris_session.link.discovery import FoundSession
from iris_session.protocol.codec import decode_introduction, encode_introduction
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.names import PROTOCOL_VERSION


class Answers:
    """What answers to requests for introductions, by control port; nothing does at other ports."""

    def __init__(self) -> None:
        self.by_port: dict[int, bytes] = {}

    def request(self, host: str, control_port: int, timeout_s: float) -> Generator[None, None, Introduction]:
        yield
        if control_port not in self.by_port:
            raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")
        return decode_introduction(self.by_port[control_port])


@pytest.fixture
def answers(monkeypatch: pytest.MonkeyPatch) -> Answers:
    answers = Answers()
    monkeypatch.setattr(network_checks, "request_introduction", answers.request)
    return answers


ADDRESS = Address("127.0.0.1", 7721)
OTHER_PROGRAM = b"SSH-2.0-OpenSSH_9.2p1 Debian\r\n"


def introduction(protocol: int = PROTOCOL_VERSION) -> bytes:
    beacon = Beacon(protocol, "s1", "lab", "live", "127.0.0.1", 7721, 7722, 0, 0, 0)
    return encode_introduction(Introduction(beacon, pairing=True, participants=3))


def test_port_base_is_distinguished_from_control_port(answers: Answers, monkeypatch: pytest.MonkeyPatch) -> None:
    """`serve --port-base N` is joined at N + 1; the introduction is at N."""
    base = Address("127.0.0.1", 7720)
    assert network_checks.check_port_base(base) is None
    answers.by_port[7721] = OTHER_PROGRAM
    assert network_checks.check_port_base(base) is None
    answers.by_port[7721] = introduction()
    monkeypatch.setattr(network_checks, "LISTEN_S", 0.01)
    monkeypatch.setattr(network_checks, "probe_tcp", lambda *_: None)
    result = run_checks(str(base))
    found = {one.check: one for one in result.findings}
    assert str(ADDRESS) in found["introduction"].text
    assert found["introduction"].advice == f"use {ADDRESS}"
    assert found["join"].state == "skipped"
    assert not result.ok


def test_other_introduction_is_reported(answers: Answers) -> None:
    answers.by_port[7721] = OTHER_PROGRAM
    introduced, version, _ = network_checks.check_introduction(ADDRESS)
    assert introduced.failed
    assert version.state == "skipped"


def test_closed_and_open_ports_are_distinguished() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))  # without listening: no other process gets the port
        port = listener.getsockname()[1]
        found = network_checks.check_tcp(Address("127.0.0.1", port), "127.0.0.1")
        assert found.failed
        assert "nothing listens" in found.text
        introduced, _, _ = network_checks.check_introduction(Address("127.0.0.1", port + 1))
        assert introduced.state == "warning"
        listener.listen(1)
        assert network_checks.check_tcp(Address("127.0.0.1", port), "127.0.0.1").state == "ok"


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (TimeoutError("timed out"), "firewall"),
        (OSError(errno.EHOSTUNREACH, "No route to host"), "switched off"),
        (OSError(errno.EPERM, "Operation not permitted"), ""),
    ],
)
def test_silent_and_unreachable_machines_are_distinguished(
    monkeypatch: pytest.MonkeyPatch, error: OSError, why: str
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(network_checks, "probe_tcp", fail)
    found = network_checks.check_tcp(ADDRESS, "127.0.0.1")
    assert found.failed
    assert why in found.why


def test_foreign_network_is_reported() -> None:
    """Addresses of TEST-NET-3 are in no network."""
    assert network_checks.check_subnet("127.0.0.1").state == "ok"
    found = network_checks.check_subnet("203.0.113.77")
    assert found.state in ("warning", "failed")
    assert "none of" in found.text
    assert found.advice


def test_names_are_resolved() -> None:
    found, ip = network_checks.check_address(Address("localhost", 7721))
    assert found.state == "ok"
    assert ip in ("127.0.0.1", "::1")
    for unknown_name in ("a..b", "x" * 300, ""):
        found, ip = network_checks.check_address(Address(unknown_name, 7721))
        assert (found.state, ip) == ("failed", "")
        # Not this machine, which an empty address means.
        assert network_checks.check_tcp(Address(unknown_name, 7721), ip).failed


class Listener:
    """Beacon listener that hears the given sessions."""

    sessions_heard: tuple[FoundSession, ...] = ()
    ignored: ClassVar[dict[str, int]] = {}

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *_: object) -> None: ...

    def wait(self, timeout_s: float) -> None: ...

    def poll_sessions(self) -> list[FoundSession]:
        return list(self.sessions_heard)


def listening(name: str, address: str) -> FoundSession:
    return FoundSession(name, address, f"id-{address}", "live", "", (address,))


@pytest.mark.parametrize(
    ("sessions", "ignored", "name", "state", "text"),
    [
        ((listening("lab", "10.0.0.1:7721"),), {}, "lab", "ok", "10.0.0.1:7721"),
        ((listening("lab", "10.0.0.1:7721"), listening("lab", "10.0.0.2:7721")), {}, "lab", "failed", "2 sessions"),
        ((listening("other", "10.0.0.1:7721"),), {}, "lab", "failed", "other (10.0.0.1:7721)"),
        ((), {}, "", "warning", "no session"),
        ((), {"other_version": 3}, "", "warning", "another protocol version"),
        ((listening("lab", "10.0.0.1:7721"),), {}, "", "ok", "lab"),
    ],
)
def test_beacon_is_compared_with_the_address(
    monkeypatch: pytest.MonkeyPatch, sessions: object, ignored: dict[str, int], name: str, state: str, text: str
) -> None:
    monkeypatch.setattr(network_checks, "LISTEN_S", 0.01)
    monkeypatch.setattr(network_checks, "BeaconListener", Listener)
    monkeypatch.setattr(Listener, "sessions_heard", sessions)
    monkeypatch.setattr(Listener, "ignored", ignored)
    found, _ = network_checks.check_beacon(name, None)
    assert found.state == state
    assert text in found.text


def test_other_sessions_on_the_network_are_suggested() -> None:
    typed = Address("10.0.0.9", 7721)
    there = [listening("lab", "10.0.0.1:7721"), listening("itself", str(typed))]
    dead = failed("tcp", "nothing listens", "why", "look")
    extended = network_checks.mention_heard_sessions(dead, typed, there)
    assert "lab (10.0.0.1:7721)" in extended.advice
    assert "itself" not in extended.advice
    assert (extended.text, extended.why) == (dead.text, dead.why)
    assert network_checks.mention_heard_sessions(dead, typed, there[1:]) is dead
    well = ok("tcp", "takes connections")
    assert network_checks.mention_heard_sessions(well, typed, there) is well
