"""`iris-session doctor` beside a session in the rig: it names each planted fault by its check, and no other."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Generator, Iterator
from typing import Any, ClassVar, Final

import pytest

from iris_session.doctor import join_checks, network_checks
from iris_session.link.discovery import FoundSession
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.protocol.errors import ProtocolVersionError
from iris_session.protocol.names import PROTOCOL_VERSION
from tests.rig.network import RigClientSockets
from tests.rig.session import ADDRESS, Rig
from tests.rig.simulation import SECOND

NAME: Final = "lab-1"
CONTROL: Final = 7721


class Diagnosis:
    """What one run of the doctor has found. `document`: its JSON object."""

    def __init__(self, status: int, document: dict[str, Any]) -> None:
        self.status = status
        self.document = document
        self.checks = {check["check"]: check for check in document["checks"]}

    def list_checks(self, state: str) -> set[str]:
        return {name for name, check in self.checks.items() if check["state"] == state}

    def assert_names(self, check: str, *values: str, state: str = "failed") -> None:
        """Assert that the check has this state, names these values and gives a cause or advice."""
        found = self.checks[check]
        assert found["state"] == state, found
        text = f"{found['text']} {found['why']} {found['advice']}"
        assert all(value in text for value in values), text
        assert found["why"] or found["advice"]


class Lab:
    """A session, what the doctor's machine hears and reaches of it, and the doctor.

    Attributes:
        closed_ports: TCP ports, with the error that a connection to them ends in.
        introduce: Answers a request for the introduction of the session.
    """

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.closed_ports: dict[int, OSError] = {}
        self.introduce: Callable[[], Introduction] = lambda: Introduction(
            Beacon(PROTOCOL_VERSION, "s1", NAME, "live", "127.0.0.1", CONTROL, CONTROL + 1, 0, 0, 0)
        )

    def probe_tcp(self, ip: str, port: int, timeout_s: float) -> None:
        if self.rig._network.front is None:
            raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")
        if port in self.closed_ports:
            raise self.closed_ports[port]

    def request_introduction(self, *_: object) -> Generator[None, None, Introduction]:
        self.probe_tcp("127.0.0.1", CONTROL - 1, 0.0)
        return self.introduce()
        yield

    def examine(self, *arguments: str, failed: set[str], address: str = ADDRESS) -> Diagnosis:
        """Run the doctor, which must find exactly these checks failed."""
        code, out, errors = self.rig.run_command("doctor", *([address] if address else []), *arguments, "--json")
        assert out, errors
        found = Diagnosis(code, json.loads(out))
        assert found.list_checks("failed") == failed, out
        assert code == (1 if failed else 0)
        return found


class Listener:
    """Hears the beacon of the session."""

    ignored: ClassVar[dict[str, int]] = {}

    def __enter__(self) -> Listener:
        return self

    def __exit__(self, *_: object) -> None: ...

    def wait(self, timeout_s: float) -> None:
        network_checks.time.sleep(timeout_s)

    def poll_sessions(self) -> list[FoundSession]:
        return [FoundSession(NAME, ADDRESS, "s1", "live", "", ("127.0.0.1",))]


@pytest.fixture
def lab(monkeypatch: pytest.MonkeyPatch) -> Iterator[Lab]:
    with Rig(timestep=0.01, name=NAME) as rig:
        lab = Lab(rig)
        monkeypatch.setattr(network_checks, "BeaconListener", Listener)
        monkeypatch.setattr(network_checks, "probe_tcp", lab.probe_tcp)
        monkeypatch.setattr(network_checks, "request_introduction", lab.request_introduction)
        yield lab


def test_healthy_session_passes_and_no_participant_stays(lab: Lab) -> None:
    lab.rig.join("ann", "observer")
    found = lab.examine(failed=set())
    assert found.list_checks("warning") <= {"warnings"}, "that a loop of the rig has no real-time priority"
    lab.rig.run(0.2)
    assert [one.name for one in lab.rig.clients[0].status().participants if one.connected] == ["ann"]


def test_session_is_found_by_its_name(lab: Lab) -> None:
    found = lab.examine("--session", NAME, address="", failed=set())
    assert (found.document["address"], found.document["report"]["session_name"]) == (ADDRESS, NAME)
    lab.examine("--session", "nobody-here", address="", failed={"beacon"}).assert_names("beacon", "'nobody-here'")


def test_listener_that_never_answers(lab: Lab) -> None:
    lab.rig.suspend_machine(60.0)
    found = lab.examine(failed={"join"})
    found.assert_names("join", f"{join_checks.JOIN_S:g} s")
    assert found.checks["tcp"]["state"] == "ok"


def test_firewall_that_opens_only_the_control_port(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RigClientSockets, "open_state", lambda *_: None)
    lab.closed_ports = dict.fromkeys((CONTROL - 1, CONTROL + 1), TimeoutError("timed out"))
    found = lab.examine(failed={"state"})
    found.assert_names("state", f"{CONTROL + 1} (state)", "firewall")
    assert found.checks["join"]["state"] == "ok"
    assert found.checks["introduction"]["state"] == "warning"


def test_other_protocol_version(lab: Lab) -> None:
    def introduce() -> Introduction:
        raise ProtocolVersionError(PROTOCOL_VERSION + 1)

    lab.introduce = introduce
    found = lab.examine(failed={"version"})
    found.assert_names("version", f"version {PROTOCOL_VERSION + 1}")
    assert found.checks["join"]["state"] == "skipped"


def test_jumped_tracking_frame_and_late_samples(lab: Lab) -> None:
    """The alignment of eva is void since its tracking frame jumped; samples of fay arrive two seconds late."""
    rig = lab.rig
    director, eva = rig.join("dora", "director"), rig.join("eva", "observer", alignment="measured")
    fay = rig.join("fay", "observer")
    director.alignment.place(eva.participant_id, ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    rig.run(0.2)
    eva.alignment.report_tracking_jump()

    def send() -> None:
        if fay.ready:
            late_ns = fay.session_now_ns() - 2 * SECOND
            fay.send_sample("head", ((0.0, 0.0, 1.5), (1.0, 0.0, 0.0, 0.0)), capture_ns=late_ns)
            rig.simulation.call_at(rig.simulation.now_ns + SECOND // 50, send)

    send()
    rig.run(1.0)
    found = lab.examine(failed=set())
    found.assert_names("alignment", "eva", "lost", "tracking frame", state="warning")
    found.assert_names("age", "device -> front", "(fay)", state="warning")


def test_session_that_stands_still(lab: Lab) -> None:
    lab.rig.stop_loop(60.0)
    lab.rig.run(1.0)
    lab.examine(failed={"session", "join"})
