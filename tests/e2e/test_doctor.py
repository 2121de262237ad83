"""Planted faults, each of which `iris-session doctor` must name by its check."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from iris_session.client import Client
from iris_session.protocol.codec import encode_introduction
from iris_session.protocol.discovery import Beacon, Introduction
from iris_session.security import KeyHome, KeyPair
from tests.e2e.clinic import doctor
from tests.e2e.conftest import DEADLINE_S, Server, iris, serve_command, wait

pytestmark = pytest.mark.e2e


@contextlib.contextmanager
def block() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Two sockets on neighbouring ports, the lower first. Nobody else can have the ports, and nothing listens yet."""
    for _ in range(1000):
        with socket.socket() as upper, socket.socket() as lower:
            upper.bind(("127.0.0.1", 0))
            try:
                lower.bind(("127.0.0.1", port_of(upper) - 1))
            except OSError:
                continue
            yield lower, upper
            return
    pytest.fail("no two neighbouring ports are free")


def port_of(one: socket.socket) -> int:
    return int(one.getsockname()[1])


# --- the way ---------------------------------------------------------------------------------------------------------


def test_nothing_listens() -> None:
    with block() as (_, upper):
        found = doctor(f"127.0.0.1:{port_of(upper)}")
    found.named("tcp", "nothing listens", "iris-session serve")
    assert found.status == 1
    assert found.checks["join"]["state"] == "skipped"
    assert found.failed() == {"tcp"}


def test_somebody_listens_who_never_answers() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(16)
        found = doctor(f"127.0.0.1:{listener.getsockname()[1]}")
    found.named("join", "no session answers")
    assert found.checks["tcp"]["state"] == "ok"


def test_no_session_of_that_name() -> None:
    found = doctor("--session", "nobody-here")
    found.named("beacon", "nobody-here", "give its address")
    assert found.failed() == {"beacon"}


def test_other_protocol_version() -> None:
    """A session of version 2 introduces itself."""
    with block() as (introducing, control):
        port = port_of(control)
        beacon = Beacon(2, "s2", "future", "live", "127.0.0.1", port, 0, 0, 0, 0)
        for listener in (introducing, control):
            listener.listen(4)

        def introduce() -> None:
            with contextlib.suppress(OSError):
                visitor, _ = introducing.accept()
                with visitor:
                    visitor.sendall(encode_introduction(Introduction(beacon)))

        thread = threading.Thread(target=introduce, daemon=True)
        thread.start()
        found = doctor(f"127.0.0.1:{port}")
        thread.join(5.0)
    found.named("version", "version 2", "update this machine")
    assert found.checks["join"]["state"] == "skipped"


# --- the door --------------------------------------------------------------------------------------------------------


def lan_address() -> str:
    """An address of this machine that is not loopback: encrypted sessions need one."""
    for addresses in psutil.net_if_addrs().values():
        for one in addresses:
            if one.family == socket.AF_INET and not one.address.startswith("127."):
                return one.address
    pytest.fail("this machine has no network address but loopback")


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A session on the network, with keys."""
    folder = tmp_path_factory.mktemp("encrypted")
    recording = folder / "session.rrd"
    server = Server(folder, recording, serve_command("arm", recording, "--host", lan_address()))
    yield server
    server.stop()


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A home of keys of somebody else."""
    return tmp_path / "home"


def test_key_that_is_not_on_the_list(encrypted: Server, home: Path) -> None:
    found = doctor(encrypted.address, home=home)
    found.named("key", "not on the session's list", "iris-session pair")
    assert found.failed() == {"key"}


def test_wrong_code(encrypted: Server, home: Path) -> None:
    found = doctor(encrypted.address, "--code", "7KQ2-M4XD-9PTR", home=home)
    found.named("code", "join code")
    assert found.failed() == {"code"}


def test_role_that_the_key_may_not_have(encrypted: Server, home: Path) -> None:
    KeyHome().clients.allow_key("looker", KeyHome(home).load_identity().public, ("observer",))
    found = doctor(encrypted.address, "--role", "director", home=home)
    found.named("role", "role")
    assert found.failed() == {"role"}
    well = doctor(encrypted.address, home=home)
    assert well.failed() == set(), well.troubles()
    assert well.checks["key"]["state"] == "ok"


def test_another_key_than_the_known_one(encrypted: Server, home: Path) -> None:
    KeyHome(home).known_servers.pin(encrypted.address, "arm", KeyPair.generate().public)
    found = doctor(encrypted.address, home=home)
    found.named("server_key", "is known for", "iris-session keys forget")
    assert found.failed() == {"server_key"}


#: Sessions of other tests tell of themselves too.
CLINIC = f"clinic-{os.getpid()}"


# --- the session -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    folder = tmp_path_factory.mktemp("plain")
    recording = folder / "session.rrd"
    server = Server(folder, recording, serve_command("handover", recording, "--name", CLINIC))
    yield server
    server.stop()


@contextlib.contextmanager
def people(server: Server) -> Iterator[Callable[..., Client]]:
    clients: list[Client] = []

    def join(name: str, **settings: Any) -> Client:
        client = Client(server.address, name=name, devices=("controller/right", "head"), **settings)
        clients.append(client)
        return client.connect(DEADLINE_S).start()

    yield join
    for client in clients:
        client.close()


def test_all_is_well_and_leaves_no_trace(plain: Server) -> None:
    done = iris("doctor", plain.address, cwd=plain.folder)
    assert done.returncode == 0, done.stdout
    assert "FAILED" not in done.stdout
    with Client(plain.address, role="observer", alignment="not_needed", name="look") as client:
        wait(lambda: [p.name for p in client.status().participants if p.connected] == ["look"], "nobody else is here")


def test_a_session_by_its_name(plain: Server) -> None:
    found = doctor("--session", CLINIC)
    assert found.failed() == set(), found.troubles()
    assert found.document["address"] == plain.address
    assert found.document["report"]["session_name"] == CLINIC


class Forwarder:
    """Lets one TCP port of this machine through to 127.0.0.2, as a firewall that knows of that port only."""

    def __init__(self, port: int) -> None:
        self._listener = socket.create_server(("127.0.0.2", port))
        self._port = port
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                visitor, _ = self._listener.accept()
                inside = socket.create_connection(("127.0.0.1", self._port))
                self._open += [visitor, inside]
                for source, sink in ((visitor, inside), (inside, visitor)):
                    threading.Thread(target=self._pump, args=(source, sink), daemon=True).start()

    @staticmethod
    def _pump(source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(65536):
                sink.sendall(data)

    def close(self) -> None:
        self._listener.shutdown(socket.SHUT_RDWR)
        for one in (self._listener, *self._open):
            one.close()


def test_firewall_that_lets_the_control_port_through_only(plain: Server) -> None:
    port = int(plain.address.rsplit(":", 1)[1])
    with contextlib.closing(Forwarder(port)):
        found = doctor(f"127.0.0.2:{port}")
    found.named("state", "nothing listens", "(state)")
    assert found.checks["join"]["state"] == "ok"
    assert found.checks["introduction"]["state"] == "warning"
    assert found.failed() == {"state"}


def test_no_alignment_no_lease_and_a_stopped_client(plain: Server) -> None:
    with people(plain) as join, somebody(plain) as carl:
        ann = join("ann", alignment="not_needed")
        ann.acquire(["left"])
        bob = join("bob")
        wait(
            lambda: any(lease.target == "right" and lease.holder for lease in ann.mirror.leases.values()),
            "carl's robot",
        )
        carl.send_signal(signal.SIGSTOP)
        found = doctor(plain.address)
        found.named("alignment", "bob has no alignment", "bring the sheet into view")
        found.named("leases", "bob has no robot", "left: ann", "right: carl", state="warning")
        found.named("clients", "carl")
        assert found.failed() == {"alignment", "clients"}, found.troubles()
        assert found.status == 1
        bob.close()


def test_a_jumped_tracking_frame_and_a_slow_way_of_samples(plain: Server) -> None:
    """eva's alignment is void since her tracking frame jumped; fay's samples come two seconds old."""
    with people(plain) as join:
        director = join("dora", role="director", alignment="not_needed")
        eva = join("eva", role="observer")
        director.place_alignment(eva.participant_id, ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
        wait(lambda: eva.alignment is not None and eva.alignment.kind == "placed", "an alignment")
        eva.new_tracking_frame()
        wait(lambda: eva.alignment is None or eva.alignment.kind == "none", "that it is void")
        with sends_late(join("fay", role="observer", alignment="not_needed")):
            found = doctor(plain.address)
        found.named("alignment", "eva has no alignment (lost", "its tracking frame jumped", "sheet", state="warning")
        found.named("age", "device -> front is slow", "(fay)", "network between the headset", state="warning")
        assert "state -> client" in found.checks["age"]["text"]


@contextlib.contextmanager
def sends_late(client: Client) -> Iterator[None]:
    """Meanwhile it sends what was captured two seconds ago; from when on the session has noticed."""
    end = threading.Event()

    def send() -> None:
        while not end.wait(0.02):
            client.send_sample(
                "head", ((0.0, 0.0, 1.5), (1.0, 0.0, 0.0, 0.0)), capture_ns=client.session_now_ns() - 2_000_000_000
            )

    thread = threading.Thread(target=send)
    thread.start()
    try:
        wait(lambda: any(p.capture_to_receive for p in client.status().participants), "how late it comes")
        yield
    finally:
        end.set()
        thread.join()


CARL = """
import sys
from iris_session import Client
with Client(sys.argv[1], name="carl", alignment="not_needed") as carl:
    carl.acquire(["right"])
    carl.sleep(60)
"""


@contextlib.contextmanager
def somebody(server: Server) -> Iterator[subprocess.Popen[bytes]]:
    """carl, who has the right robot, in a process of his own."""
    process = subprocess.Popen([sys.executable, "-c", CARL, server.address])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_session_that_somebody_stopped(plain: Server) -> None:
    with people(plain) as join:
        director = join("dora", role="director", alignment="not_needed")
        director.estop("look out")
        wait(lambda: director.mirror.estop, "the stop")
        doctor(plain.address).named("session", "emergency stop")
        director.clear_estop()


def test_server_side(plain: Server) -> None:
    found = doctor("--server", plain.address)
    assert {"scheduling", "processors", "key_home", "ports", "interfaces", "clock_source", "disk"} <= set(found.checks)
    assert found.checks["session"]["state"] == "ok"
    ports = found.checks["ports"]
    assert ports["state"] == "ok", ports
    assert plain.address.rsplit(":", 1)[1] in ports["text"]
    assert "front.main" in ports["text"]


def test_session_that_stands_still(plain: Server) -> None:
    plain.process.send_signal(signal.SIGSTOP)
    try:
        found = doctor(plain.address)
    finally:
        plain.process.send_signal(signal.SIGCONT)
    found.named("session", "has not taken a step")
    assert {"session", "join"} <= found.failed()
