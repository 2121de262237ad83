"""`iris-session doctor` must name each planted fault by its check."""

from __future__ import annotations

import contextlib
import json
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
from iris_session.protocol.names import LateCause
from iris_session.security import KeyHome, KeyPair
from tests.e2e.session_process import (
    COMMAND,
    DEADLINE_S,
    SessionProcess,
    kill_all,
    make_serve_command,
    skip_unless_ci,
    wait_until,
)
from tests.slow_scene import write_slow_scene

pytestmark = pytest.mark.e2e


class Diagnosis:
    """The result of one run of the doctor."""

    def __init__(self, status: int, out: str) -> None:
        self.status = status
        self.document: dict[str, Any] = json.loads(out)
        self.checks = {check["check"]: check for check in self.document["checks"]}

    def assert_names(self, check: str, *values: str, state: str = "failed") -> None:
        """Check that `check` has this state, names these values, and gives a cause or advice."""
        found = self.checks[check]
        assert found["state"] == state, self.troubles()
        text = f"{found['text']} {found['why']} {found['advice']}"
        assert all(value in text for value in values), text
        assert found["advice"] or found["why"], "a failed check needs a cause or advice"

    def troubles(self) -> list[dict[str, str]]:
        return [check for check in self.checks.values() if check["state"] in ("failed", "warning")]

    def failed(self) -> set[str]:
        """Names of the failed checks, without ticks that the scheduler made late: they say how busy this host is."""
        late = self.checks.get("ticks", {}).get("why", "").startswith("scheduler")
        failed = {name for name, check in self.checks.items() if check["state"] == "failed"}
        return failed - {"ticks"} if late else failed


def run_doctor(*arguments: str, home: Path | None = None) -> Diagnosis:
    environment = {**os.environ, **({"IRIS_HOME": str(home)} if home is not None else {})}
    done = subprocess.run(
        [*COMMAND, "doctor", *arguments, "--json"],
        capture_output=True,
        text=True,
        check=False,
        timeout=60.0,
        env=environment,
    )
    assert done.returncode in (0, 1), done.stderr[-2000:]
    return Diagnosis(done.returncode, done.stdout)


def examine(*arguments: str, expected: set[str], home: Path | None = None) -> Diagnosis:
    """Run the doctor, which must find these checks failed and no others.

    It is right to find more while this machine stands still: then, at most twice, it is run anew. What it is to find is
    planted, and stays.
    """
    for _ in range(3):
        found = run_doctor(*arguments, home=home)
        if found.failed() == expected:
            break
    assert found.failed() == expected, found.troubles()
    return found


@contextlib.contextmanager
def reserve_two_ports() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Reserve two adjacent ports: yield their sockets, lower first. Nothing listens on them yet."""
    for _ in range(1000):
        with socket.socket() as upper, socket.socket() as lower:
            upper.bind(("127.0.0.1", 0))
            try:
                lower.bind(("127.0.0.1", get_port(upper) - 1))
            except OSError:
                continue
            yield lower, upper
            return
    pytest.fail("no two adjacent ports are free")


def get_port(one: socket.socket) -> int:
    return int(one.getsockname()[1])


# --- network ---------------------------------------------------------------------------------------------------------


def test_no_listener() -> None:
    with reserve_two_ports() as (_, upper):
        found = run_doctor(f"127.0.0.1:{get_port(upper)}")
    found.assert_names("tcp")
    assert found.status == 1
    assert found.checks["join"]["state"] == "skipped"
    assert found.failed() == {"tcp"}


@pytest.mark.long
def test_listener_that_never_answers() -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen(16)
        found = run_doctor(f"127.0.0.1:{listener.getsockname()[1]}")
    found.assert_names("join")
    assert found.checks["tcp"]["state"] == "ok"


def test_unknown_session_name() -> None:
    found = run_doctor("--session", "nobody-here")
    found.assert_names("beacon", "nobody-here")
    assert found.failed() == {"beacon"}


def test_other_protocol_version() -> None:
    """A session of protocol version 2 introduces itself."""
    with reserve_two_ports() as (introducing, control):
        port = get_port(control)
        beacon = Beacon(2, "s2", "future", "live", "127.0.0.1", port, 0, 0, 0, 0)
        for listener in (introducing, control):
            listener.listen(4)

        def introduce() -> None:
            with contextlib.suppress(OSError):
                peer, _ = introducing.accept()
                with peer:
                    peer.sendall(encode_introduction(Introduction(beacon)))

        thread = threading.Thread(target=introduce, daemon=True)
        thread.start()
        found = run_doctor(f"127.0.0.1:{port}")
        thread.join(5.0)
    found.assert_names("version", "2")
    assert found.checks["join"]["state"] == "skipped"


# --- keys and roles --------------------------------------------------------------------------------------------------


def find_lan_address() -> str:
    """Return an address of this machine that is not loopback: encrypted sessions need one."""
    for addresses in psutil.net_if_addrs().values():
        for one in addresses:
            if one.family == socket.AF_INET and not one.address.startswith("127."):
                return one.address
    pytest.fail("this machine has no network address but loopback")


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SessionProcess]:
    """A session on the network, encrypted."""
    folder = tmp_path_factory.mktemp("encrypted")
    recording = folder / "session.rrd"
    server = SessionProcess(folder, recording, make_serve_command("arm", recording, "--host", find_lan_address()))
    yield server
    server.stop()


@pytest.fixture
def home(tmp_path: Path) -> Path:
    """A home of keys that the session does not know."""
    return tmp_path / "home"


@pytest.mark.long
def test_key_that_is_not_on_the_allow_list(encrypted: SessionProcess, home: Path) -> None:
    found = examine(encrypted.address, home=home, expected={"key"})
    found.assert_names("key", "iris-session pair")


def test_wrong_join_code(encrypted: SessionProcess, home: Path) -> None:
    found = examine(encrypted.address, "--code", "7KQ2-M4XD-9PTR", home=home, expected={"code"})
    found.assert_names("code")


@pytest.mark.long
def test_role_that_the_key_does_not_allow(encrypted: SessionProcess, home: Path) -> None:
    KeyHome().clients.allow_key("looker", KeyHome(home).load_identity().public, ("observer",))
    found = examine(encrypted.address, "--role", "director", home=home, expected={"role"})
    found.assert_names("role")
    well = examine(encrypted.address, home=home, expected=set())
    assert well.checks["key"]["state"] == "ok"


def test_changed_server_key(encrypted: SessionProcess, home: Path) -> None:
    KeyHome(home).known_servers.pin(encrypted.address, "arm", KeyPair.generate().public)
    found = examine(encrypted.address, home=home, expected={"server_key"})
    found.assert_names("server_key", "iris-session keys forget")


#: Unique, because the beacons of other tests' sessions are heard, too.
SESSION_NAME = f"doctor-{os.getpid()}"


# --- session and participants ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SessionProcess]:
    folder = tmp_path_factory.mktemp("plain")
    recording = folder / "session.rrd"
    options = ("--name", SESSION_NAME, "--host", "127.0.0.1")
    server = SessionProcess(folder, recording, make_serve_command(str(write_slow_scene(folder)), recording, *options))
    yield server
    server.stop()


@contextlib.contextmanager
def open_clients(server: SessionProcess) -> Iterator[Callable[..., Client]]:
    clients: list[Client] = []

    def join(name: str, **settings: Any) -> Client:
        client = Client(server.address, name=name, devices=("desktop", "head"), **settings)
        clients.append(client)
        return client.connect(DEADLINE_S).start()

    yield join
    for client in clients:
        client.close()


def test_healthy_session_passes_and_no_participant_stays(plain: SessionProcess) -> None:
    found = examine(plain.address, expected=set())
    assert found.status == int(any(check["state"] == "failed" for check in found.checks.values()))
    with Client(plain.address, role="observer", alignment="not_needed", name="look") as client:
        wait_until(
            lambda: [p.name for p in client.status().participants if p.connected] == ["look"], "no other participant"
        )


def test_session_given_by_name(plain: SessionProcess) -> None:
    found = examine("--session", SESSION_NAME, expected=set())
    assert found.document["address"] == plain.address
    assert found.document["report"]["session_name"] == SESSION_NAME


class Forwarder:
    """Forward one TCP port of 127.0.0.2 to this machine, as a firewall that opens that port only."""

    def __init__(self, port: int) -> None:
        self._listener = socket.create_server(("127.0.0.2", port))
        self._port = port
        self._open: list[socket.socket] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                peer, _ = self._listener.accept()
                inside = socket.create_connection(("127.0.0.1", self._port))
                self._open += [peer, inside]
                for source, sink in ((peer, inside), (inside, peer)):
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


@pytest.mark.long
def test_firewall_that_opens_only_the_control_port(plain: SessionProcess) -> None:
    port = int(plain.address.rsplit(":", 1)[1])
    with contextlib.closing(Forwarder(port)):
        found = examine(f"127.0.0.2:{port}", expected={"state"})
    found.assert_names("state", "(state)")
    assert found.checks["join"]["state"] == "ok"
    assert found.checks["introduction"]["state"] == "warning"


def test_missing_alignment_missing_lease_and_stopped_client(plain: SessionProcess) -> None:
    with open_clients(plain) as join, run_carl(plain) as carl:
        ann = join("ann", alignment="not_needed")
        ann.acquire(["left"])
        bob = join("bob")
        wait_until(
            lambda: any(lease.target == "right" and lease.holder for lease in ann.mirror.leases.values()),
            "carl's robot",
        )
        carl.send_signal(signal.SIGSTOP)
        found = examine(plain.address, expected={"alignment", "clients"})
        found.assert_names("alignment", "bob")
        found.assert_names("leases", "bob", "left: ann", "right: carl", state="warning")
        found.assert_names("clients", "carl")
        assert found.status == 1
        bob.close()


def test_jumped_tracking_frame_and_late_samples(plain: SessionProcess) -> None:
    """The alignment of eva is void since its tracking frame jumped; samples of fay arrive two seconds late."""
    with open_clients(plain) as join:
        director = join("dora", role="director", alignment="not_needed")
        eva = join("eva", role="observer")
        director.alignment.place(eva.participant_id, ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
        wait_until(lambda: eva.alignment.current is not None and eva.alignment.current.kind == "placed", "an alignment")
        eva.alignment.report_tracking_jump()
        wait_until(lambda: eva.alignment.current is None or eva.alignment.current.kind == "none", "a void alignment")
        with sending_late(join("fay", role="observer", alignment="not_needed")):
            found = run_doctor(plain.address)
        found.assert_names("alignment", "eva", "lost", "tracking frame", state="warning")
        found.assert_names("age", "device -> front", "(fay)", state="warning")
        assert "state -> client" in found.checks["age"]["text"]


@contextlib.contextmanager
def sending_late(client: Client) -> Iterator[None]:
    """Send samples captured two seconds ago in the background; enter once the status shows their delay."""
    end = threading.Event()

    def send() -> None:
        while not end.wait(0.02):
            client.send_sample(
                "head", ((0.0, 0.0, 1.5), (1.0, 0.0, 0.0, 0.0)), capture_ns=client.session_now_ns() - 2_000_000_000
            )

    thread = threading.Thread(target=send)
    thread.start()
    try:
        wait_until(lambda: any(p.capture_to_receive for p in client.status().participants), "the delay in the status")
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
def run_carl(server: SessionProcess) -> Iterator[subprocess.Popen[bytes]]:
    """Run a client named carl, which holds the right robot, in a process."""
    process = subprocess.Popen([sys.executable, "-c", CARL, server.address])
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def test_emergency_stop(plain: SessionProcess) -> None:
    with open_clients(plain) as join:
        director = join("dora", role="director", alignment="not_needed")
        director.estop("test")
        wait_until(lambda: director.mirror.estop, "the e-stop")
        run_doctor(plain.address).assert_names("session", "emergency stop")
        director.clear_estop()


def test_checks_of_the_server(plain: SessionProcess) -> None:
    found = run_doctor("--server", plain.address)
    assert {"scheduling", "processors", "key_home", "ports", "interfaces", "clock_source", "disk"} <= set(found.checks)
    assert found.checks["session"]["state"] == "ok"
    ports = found.checks["ports"]
    assert ports["state"] == "ok", ports
    assert plain.address.rsplit(":", 1)[1] in ports["text"]
    assert "front.main" in ports["text"]


def test_suspended_session(plain: SessionProcess) -> None:
    plain.process.send_signal(signal.SIGSTOP)
    try:
        found = run_doctor(plain.address)
    finally:
        plain.process.send_signal(signal.SIGCONT)
    found.assert_names("session")
    assert {"session", "join"} <= found.failed()


# --- the machine of the session --------------------------------------------------------------------------------------


OVERLOADED = """
import os, sys, time
from iris_session import Session, SessionConfig
from iris_session.demo.scenes import scene_path
config = SessionConfig(control_port=0, state_port=0, record=False, realtime=False)
with Session(scene_path("arm"), config=config) as session:
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})  # not of the front, which runs already
    print(f"on {session.address}, recording to nothing", flush=True)
    session.run()
"""
HOG = "import os\nos.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\nwhile True: pass\n"

#: Late ticks of a few seconds of a session without enough processor time.
MANY_LATE_TICKS = 50


@pytest.mark.long
def test_late_ticks_name_their_cause(tmp_path: Path) -> None:
    """Other programs occupy the processor of the session."""
    with contextlib.ExitStack() as stack:
        server = SessionProcess(tmp_path, tmp_path / "none", [sys.executable, "-c", OVERLOADED])
        stack.callback(server.stop)
        for _ in range(3):
            hog = stack.enter_context(subprocess.Popen([sys.executable, "-c", HOG]))
            stack.callback(hog.kill)
        wait_for_late_ticks(server)
        found = run_doctor(server.address)
    state = found.checks["ticks"]["state"]
    assert state in ("failed", "warning"), found.troubles()
    found.assert_names("ticks", "scheduler", state=state)


def wait_for_late_ticks(server: SessionProcess) -> None:
    """Wait until more late ticks were counted than at a start, most of them of the scheduler."""
    with Client(server.address, role="observer", name="watch", alignment="not_needed") as client:

        def late() -> bool:
            causes = client.status().late_causes
            return (
                sum(causes.values()) >= MANY_LATE_TICKS
                and max(causes, key=lambda name: causes[name]) == LateCause.SCHEDULER
            )

        wait_until(late, "late ticks, most of them of the scheduler")


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 20 MB: the recorder begins with at least 16 free."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=20m", "tmpfs", str(folder)], capture_output=True, text=True, check=False
    )
    if mounted.returncode:
        skip_unless_ci(f"needs the right to mount a small file system: {mounted.stderr.strip()}")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)  # processes that are about to end may still use it


@pytest.mark.long
def test_full_disk(small_disk: Path, tmp_path: Path) -> None:
    recording = small_disk / "session.rrd"
    server = SessionProcess(tmp_path, recording, make_serve_command("arm", recording))
    filler = small_disk / "other-data"
    try:
        with filler.open("wb", buffering=0) as file, contextlib.suppress(OSError):
            while True:
                file.write(bytes(1 << 16))
        found = run_doctor(server.address)
        found.assert_names("disk", "GB")
        assert found.status == 1
    finally:
        kill_all([server])  # finishing the recording would wait for free space
