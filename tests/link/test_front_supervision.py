"""When a front counts as dead, hanging or starved, and how it is replaced: with processes and a clock of the test."""

from __future__ import annotations

import errno
import os
import signal
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
import zmq.auth

from iris_session.front.loop import Front
from iris_session.link import FrontConfig, FrontError, FrontLink, FrontProcess, Ports, front_process
from iris_session.link.config import FrontStart
from iris_session.link.front_process import HANGING_NS, START_S, STARVED_NS, StarvationDetector
from iris_session.security import KeyHome
from iris_session.system import supervised
from tests.front.harness import scene
from tests.threads import Threads

SECOND = 1_000_000_000
PORTS = Ports("127.0.0.1", 7001, 7002, 7003, 7004, 7005)


class Child:
    """A front process by the test."""

    pid = 4711

    def __init__(self, config: bytes) -> None:
        self.start = msgspec.msgpack.decode(config, type=FrontStart)
        self.exit_status: int | None = None

    @property
    def is_running(self) -> bool:
        return self.exit_status is None

    def send_signal(self, number: int) -> None:
        self.exit_status = -number

    def close(self, *, exit_s: float = 0.0, terminate_s: float = 0.0) -> int:
        self.send_signal(signal.SIGKILL)
        return -signal.SIGKILL


class Link:
    """The link to it."""

    def __init__(self, _: FrontConfig) -> None:
        self.ports: Ports | None = None
        self.failure, self.overrun, self.silence_ns, self.handback = "", False, 0, b"tokens"
        self.on_receive: Callable[[], None] = lambda: None

    def open(self, path: Path) -> str:
        self.ports, self.silence_ns = None, 0
        return f"ipc://{path}"

    def receive(self) -> None:
        self.on_receive()

    def send_end(self) -> None: ...

    def close(self) -> None: ...


class Supervision:
    """A `FrontProcess` and what it sees.

    Attributes:
        children: Started so far.
        error: Of the next starts.
        times: Of the process: on a processor, ready without one [ns].
        state: Letter of the process, as of proc_pid_stat(5).
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        self.children: list[Child] = []
        self.error: OSError | None = None
        self.times, self.state = (0, 0), "S"
        clock = SimpleNamespace(
            monotonic=lambda: self.now_s, monotonic_ns=lambda: round(self.now_s * 1e9), sleep=self.advance
        )
        monkeypatch.setattr(front_process, "time", clock)
        self.threads = Threads()
        monkeypatch.setattr(supervised, "threading", self.threads)
        monkeypatch.setattr(front_process, "FrontLink", Link)
        monkeypatch.setattr(front_process, "ChildProcess", self._spawn)
        monkeypatch.setattr(front_process, "_read_times", lambda pid: self.times)
        monkeypatch.setattr(front_process, "_read_state", lambda pid: self.state)
        self.process = FrontProcess(FrontConfig(control_port=0, state_port=0), scene())
        self.link: Any = self.process.link

    def _spawn(self, module: str, *, config: bytes, own_session: bool) -> Child:
        assert own_session
        if self.error is not None:
            raise self.error
        self.children.append(Child(config))
        return self.children[-1]

    def advance(self, seconds: float) -> None:
        self.now_s += seconds

    def start(self) -> None:
        self.link.on_receive = self.make_ready
        assert self.process.start() == PORTS
        self.link.on_receive = lambda: None

    def make_ready(self) -> None:
        self.link.ports = PORTS

    def poll(self) -> str:
        """Return what is announced, with the successor that is started meanwhile."""
        now_ns = round(self.now_s * 1e9)
        announced = [*self.process.poll(now_ns), *self.process.poll(now_ns)]
        self.threads.run_started()
        return "; ".join(announced)

    def is_silent_for(self, silence_ns: int) -> str:
        """Let the front say nothing for so long. Return what is announced then."""
        announced = ""
        while self.link.silence_ns < silence_ns and not announced:
            self.link.silence_ns += SECOND // 10
            self.advance(0.1)
            announced = self.poll()
        return announced


@pytest.fixture
def front(monkeypatch: pytest.MonkeyPatch) -> Iterator[Supervision]:
    front = Supervision(monkeypatch)
    yield front
    front.process.close()


@pytest.mark.parametrize(("state", "limit_ns"), [("S", HANGING_NS), ("R", STARVED_NS)])
def test_front_that_hangs_is_replaced_and_one_without_processor_time_is_waited_for(
    front: Supervision, state: str, limit_ns: int
) -> None:
    front.start()
    front.state = state
    assert front.is_silent_for(limit_ns) == ""
    assert "said nothing for" in front.is_silent_for(limit_ns + SECOND // 10)
    assert len(front.children) == 2


def test_front_that_reads_nothing_or_does_not_listen_is_replaced(front: Supervision) -> None:
    front.start()
    front.link.overrun = True
    assert "read nothing any more" in front.poll()
    front.link.overrun = False
    front.advance(START_S)
    assert front.poll() == ""
    front.advance(0.1)
    assert "did not listen within 60 s" in front.poll()


def test_successor_has_ports_and_memory_of_the_one_before(front: Supervision) -> None:
    front.start()
    front.children[0].exit_status = 1
    front.process.anchors = {}
    assert "ended with status 1" in front.poll()
    start = front.children[1].start
    got = (start.config.control_port, start.config.state_port, start.config.media_port, start.handback)
    assert got == (PORTS.control, PORTS.state, PORTS.media, b"tokens")
    assert start.config.anchors == {}
    assert start.link_endpoint != front.children[0].start.link_endpoint
    assert front.process.restarts == 1


def test_failed_restart_is_announced_and_tried_again(front: Supervision) -> None:
    front.start()
    front.children[0].exit_status = 1
    front.error = OSError(errno.ENOMEM, os.strerror(errno.ENOMEM))
    front.poll()
    assert os.strerror(errno.ENOMEM) in front.poll()
    front.error = None
    front.advance(1.0)
    assert front.poll() == ""
    assert front.process.pid == Child.pid


@pytest.mark.parametrize("ends", [True, False])
def test_front_that_does_not_start_is_an_error(front: Supervision, ends: bool) -> None:
    def receive() -> None:
        front.link.failure = "port 1 is in use" if ends else ""

    front.link.on_receive = receive
    with pytest.raises(FrontError, match="port 1 is in use" if ends else "2 s"):
        front.process.start(timeout_s=2.0)
    assert not front.children[0].is_running


@pytest.mark.parametrize(("name", "used"), [("short", None), ("x" * 100, "/tmp")])
def test_folder_too_long_for_a_socket_is_not_used(monkeypatch: pytest.MonkeyPatch, name: str, used: str | None) -> None:
    monkeypatch.setattr(tempfile, "tempdir", f"/folder/{name}")
    assert front_process._find_socket_folder() == used


# --- starved or hanging -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("ran_s", "waited_s", "state", "starved"),
    [
        (0.0, 0.0, "R", True),  # the kernel counts a wait when it ends
        (0.1, 0.9, "S", True),
        (0.9, 0.1, "R", False),
        (0.0, 0.0, "S", False),
        (0.0, 0.0, "T", False),
    ],
)
def test_starved_process_is_one_that_could_not_run_for_most_of_the_time(
    front: Supervision, ran_s: float, waited_s: float, state: str, starved: bool
) -> None:
    detector = StarvationDetector()
    detector.sample(4711, 0)
    front.times, front.state = (round(ran_s * 1e9), round(waited_s * 1e9)), state
    assert detector.sample(4711, SECOND) is starved
    assert detector.sample(4712, 2 * SECOND) is (state == "R"), "of another process this is the first sample"


def test_ended_process_is_not_starved_and_times_of_a_running_one_are_read() -> None:
    assert not StarvationDetector().sample(1 << 30, 0)
    ran_ns, waited_ns = front_process._read_times(os.getpid())
    assert ran_ns > 0 <= waited_ns
    assert front_process._read_state(os.getpid()) == "R"


# --- what the front refuses at its start ------------------------------------------------------------------------------


def start_front(tmp_path: Path, **config: Any) -> None:
    """Make a front, as its process does at the start."""
    link = FrontLink(FrontConfig())
    endpoint = link.open(tmp_path / "link")
    try:
        Front(FrontStart(FrontConfig(control_port=0, state_port=0, **config), scene(), endpoint, 0, b""))
    finally:
        link.close()


def test_damaged_allow_list_is_an_error_and_unchanged(tmp_path: Path) -> None:
    home = tmp_path / "home"
    KeyHome(home).load_server_key()
    damaged = home / "clients.json"
    damaged.write_text("[{")
    damaged.chmod(0o600)
    with pytest.raises(FrontError, match=r"clients\.json"):
        start_front(tmp_path, curve=True, key_home=str(home))
    assert damaged.read_text() == "[{"


@pytest.mark.parametrize(
    ("host", "secret_file", "folder", "text"),
    [
        ("203.0.113.9", "server.key_secret", ".", r"203\.0\.113\.9"),  # TEST-NET-3, nobody's
        ("127.0.0.1", "server.key_secret", "missing", "missing"),
        ("127.0.0.1", "nothing", ".", "nothing"),
        ("127.0.0.1", "server.key", ".", r"server\.key"),
    ],
)
def test_unusable_address_or_key_is_named(tmp_path: Path, host: str, secret_file: str, folder: str, text: str) -> None:
    zmq.auth.create_certificates(tmp_path, "server")
    (tmp_path / "server.key_secret").chmod(0o600)
    keys = {"curve_secret_file": str(tmp_path / secret_file), "curve_clients_dir": str(tmp_path / folder)}
    with pytest.raises(FrontError, match=text):
        start_front(tmp_path, host=host, **keys)
