"""Checks of the route to a session on this machine: names, networks, closed ports, introductions."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator
from typing import ClassVar

import pytest

from iris_session.client.address import Address
from iris_session.doctor import network_checks
from iris_session.doctor.findings import failed, ok
from iris_session.doctor.runner import run_checks
from iris_session.link.discovery import DiscoveryError, FoundSession
from iris_session.protocol.codec import encode_introduction
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.names import PROTOCOL_VERSION


@contextlib.contextmanager
def serve_bytes(data: bytes) -> Iterator[Address]:
    """Send `data` to every connection to the port below the address."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(4)

        def answer() -> None:
            with contextlib.suppress(OSError):
                connection, _ = listener.accept()
                with connection:
                    connection.sendall(data)

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield Address("127.0.0.1", listener.getsockname()[1] + 1)
        thread.join(5.0)


@contextlib.contextmanager
def serve_introduction(times: int = 1) -> Iterator[Address]:
    """Serve an introduction below the control port, whose address is yielded."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(4)
        port = listener.getsockname()[1] + 1
        beacon = Beacon(PROTOCOL_VERSION, "s1", "lab", "live", "127.0.0.1", port, 7722, 0, 0, 0)

        def answer() -> None:
            with contextlib.suppress(OSError):
                for _ in range(times):
                    connection, _ = listener.accept()
                    with connection:
                        connection.sendall(encode_introduction(Introduction(beacon)))

        thread = threading.Thread(target=answer, daemon=True)
        thread.start()
        yield Address("127.0.0.1", port)
        thread.join(5.0)


def introduction(protocol: int = PROTOCOL_VERSION) -> bytes:
    beacon = Beacon(protocol, "s1", "lab", "live", "127.0.0.1", 7721, 7722, 0, 0, 0)
    return encode_introduction(Introduction(beacon, pairing=True, participants=3))


def test_introduction_is_ok() -> None:
    with serve_bytes(introduction()) as address:
        introduced, version, message = network_checks.check_introduction(address)
    assert (introduced.state, version.state) == ("ok", "ok")
    assert "'lab' (live), 3 participants" in introduced.text
    assert message is not None


@pytest.mark.parametrize(("theirs", "older"), [(PROTOCOL_VERSION + 1, "this machine"), (0, "the session")])
def test_other_protocol_version_is_reported(theirs: int, older: str) -> None:
    with serve_bytes(introduction(theirs)) as address:
        _, version, message = network_checks.check_introduction(address)
    assert version.failed
    assert f"version {theirs}" in version.text
    assert version.advice.startswith(f"update {older}")
    assert message is None


def test_port_base_is_distinguished_from_control_port() -> None:
    """`serve --port-base N` is joined at N + 1; the introduction is at N."""
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # without listening: no other process gets the port
        assert network_checks.check_port_base(Address("127.0.0.1", closed.getsockname()[1])) is None
    with serve_bytes(b"SSH-2.0-OpenSSH_9.2\r\n" + bytes(64)) as above:
        assert network_checks.check_port_base(Address("127.0.0.1", above.port - 1)) is None
    with serve_introduction() as above:
        base = Address("127.0.0.1", above.port - 1)
        found = network_checks.check_port_base(base)
    assert found is not None
    assert found.failed
    assert f"control port is {above}" in found.text
    assert found.advice == f"use {above}"


def test_run_ends_at_port_base(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_checks, "LISTEN_S", 0.01)
    with serve_introduction(times=2) as above:
        result = run_checks(f"127.0.0.1:{above.port - 1}")
    found = {one.check: one for one in result.findings}
    assert found["introduction"].advice == f"use {above}"
    assert found["join"].state == "skipped"
    assert not result.ok


def test_other_introduction_is_reported() -> None:
    with serve_bytes(b"SSH-2.0-OpenSSH_9.2p1 Debian\r\n") as address:
        introduced, version, _ = network_checks.check_introduction(address)
    assert introduced.state in ("failed", "warning")
    assert version.state == "skipped"


def test_closed_port_is_reported() -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))  # without listening: no other process gets the port
        port = closed.getsockname()[1]
        found = network_checks.check_tcp(Address("127.0.0.1", port), "127.0.0.1")
        introduced, _, _ = network_checks.check_introduction(Address("127.0.0.1", port + 1))
    assert found.failed
    assert "nothing listens" in found.text
    assert introduced.state == "warning"


def test_open_port_is_ok() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(1)
        assert network_checks.check_tcp(Address("127.0.0.1", listener.getsockname()[1]), "127.0.0.1").state == "ok"


def test_firewall_is_distinguished_from_closed_port(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_checks, "CONNECT_S", 0.2)
    with socket.socket() as listener, contextlib.ExitStack() as stack:
        listener.bind(("127.0.0.1", 0))
        listener.listen(0)  # full after one: the system drops the rest
        for _ in range(3):
            filling = stack.enter_context(socket.socket())
            filling.setblocking(False)
            filling.connect_ex(listener.getsockname())
        found = network_checks.check_tcp(Address("127.0.0.1", listener.getsockname()[1]), "127.0.0.1")
    assert found.failed
    assert "firewall" in found.why


def test_own_machine_and_networks_are_ok() -> None:
    assert network_checks.check_subnet("127.0.0.1").state == "ok"
    assert network_checks.check_subnet("::1").state == "ok"
    for name, network in network_checks.list_own_networks():
        inside = str(next(network.hosts()))
        found = network_checks.check_subnet(inside)
        assert found.state == "ok"
        assert name in found.text or str(network) in found.text or "the network of" in found.text


def test_foreign_network_is_reported() -> None:
    """Addresses of TEST-NET-3 are in no network."""
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
        assert network_checks.check_tcp(
            Address(unknown_name, 7721), ip
        ).failed  # not this machine, which an empty address means
        assert network_checks.check_tcp(Address(unknown_name, 7721), unknown_name).failed
    found, ip = network_checks.check_address(Address("no-such-machine.invalid", 7721))
    assert found.failed
    assert ip == ""


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
    monkeypatch: pytest.MonkeyPatch,
    sessions: tuple[FoundSession, ...],
    ignored: dict[str, int],
    name: str,
    state: str,
    text: str,
) -> None:
    monkeypatch.setattr(network_checks, "LISTEN_S", 0.01)
    monkeypatch.setattr(network_checks, "BeaconListener", Listener)
    monkeypatch.setattr(Listener, "sessions_heard", sessions)
    monkeypatch.setattr(Listener, "ignored", ignored)
    found, _ = network_checks.check_beacon(name, None)
    assert found.state == state
    assert text in found.text


@pytest.mark.parametrize(("name", "state"), [("lab", "failed"), ("", "warning")])
def test_port_that_cannot_be_opened_is_a_failure_where_a_name_must_be_found(
    monkeypatch: pytest.MonkeyPatch, name: str, state: str
) -> None:
    def fail() -> None:
        raise DiscoveryError("port 7720 is in use")

    monkeypatch.setattr(network_checks, "BeaconListener", fail)
    found, heard = network_checks.check_beacon(name, None)
    assert (found.state, heard) == (state, [])


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


def test_link_local_networks_are_not_listed() -> None:
    assert not any(network.version == 6 and network.is_link_local for _, network in network_checks.list_own_networks())
