"""Real processes on free ports: `iris-session serve`, clients in this process, emulated people in others.

Everything waits on conditions with a deadline; everything that was started is ended again.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import psutil
import pytest

from anchors.pose import PoseTuple
from iris_session.cli.main import main
from iris_session.client import Client
from iris_session.protocol.server_messages import Event

#: Of every condition. Ten times what it takes at worst on a machine with time to spare: others may use it too.
DEADLINE_S = 60.0
#: A server that starts beside others that compute.
START_S: Final = 90.0
#: Emulated people that are told to end; after it they are killed.
GOODBYE_S: Final = 10.0
#: Commands that end by themselves; and a whole demo, which takes a minute on a machine with time to spare.
COMMAND_S = 120.0
DEMO_S = 300.0
COMMAND = [sys.executable, "-m", "iris_session.cli.main"]
#: Before a command: it is told to end when the tests die, too (servers of a killed run slowed down the next one).
ENDS_WITH_US: Final = ["setpriv", "--pdeathsig", "TERM"] if shutil.which("setpriv") else []
#: Files that begin first: one of them at the end would keep one worker busy while the others have nothing left.
#: Those that compute most lie between those that wait most.
LONGEST: Final = (
    "test_demos_paper.py", "test_resume.py", "test_joining.py", "test_demos_soft.py", "test_docs.py",
    "test_recovery.py", "test_anchors_live.py", "test_contract.py", "test_people.py", "test_handover.py",
    "test_doctor.py", "test_user_loop.py", "test_soak.py", "test_process.py", "test_processes.py",
    "test_demo_link.py", "test_links.py", "test_security.py", "test_scene_change.py",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files first; in a file, those who share a session last: it runs no longer than it is used."""
    places: dict[Path, int] = {}
    for item in items:
        name, path = item.path.name, item.path
        places.setdefault(path, (LONGEST.index(name) if name in LONGEST else len(LONGEST)) * len(items) + len(places))
    items.sort(key=lambda item: (places[item.path], "house" in getattr(item, "fixturenames", ())))


def wait(condition: Callable[[], object], what: str, timeout_s: float = DEADLINE_S) -> None:
    """Polls `condition` until it is true; fails naming `what`."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail(f"not within {timeout_s:g} s: {what}")
        time.sleep(0.005)


def unavailable(what: str) -> None:
    """This machine cannot run a test: skipped for a person, who is told why; where everything must run, a failure."""
    if os.environ.get("CI"):
        pytest.fail(what)
    pytest.skip(what)


def iris(*arguments: str, cwd: Path, timeout_s: float = COMMAND_S) -> subprocess.CompletedProcess[str]:
    """Runs one command to its end."""
    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, check=False, cwd=cwd, timeout=timeout_s
    )


def relatives(pid: int) -> list[psutil.Process]:
    """All processes below `pid`, to look at after it ended."""
    return psutil.Process(pid).children(recursive=True)


def none_left(processes: Sequence[psutil.Process], timeout_s: float = DEADLINE_S) -> None:
    """Fails when one of `processes` does not end by itself; ends it then."""
    _, alive = psutil.wait_procs(list(processes), timeout=timeout_s)
    text = [f"{p.pid} {' '.join(p.cmdline())}" for p in alive if p.is_running()]
    for p in alive:
        p.kill()
    assert not text, f"left behind: {text}"


def tails(folder: Path) -> str:
    """The last lines of everything that the processes of this test said."""
    return "\n".join(f"--- {p.name}\n{p.read_text(errors='replace')[-1500:]}" for p in sorted(folder.rglob("*.out")))


def front_and_recorder(pid: int) -> dict[str, psutil.Process]:
    """The children of a session's process by name."""
    found = {}
    for child in psutil.Process(pid).children():
        line = " ".join(child.cmdline())
        for name in ("front.main", "recording.process"):
            if name in line:
                found[name] = child
    return found


def here(*arguments: str) -> tuple[int, str, str]:
    """Runs one command in this process, which has its modules loaded: exit status, output, errors.

    For commands that start no session. To import what they need takes longer than most of them do.
    """
    out, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(errors):
        status = main(list(arguments))
    return status, out.getvalue(), errors.getvalue()


def verify(recording: Path, status: int = 0) -> dict[str, Any]:
    """Report of `iris-session verify --json`, which must end with `status`."""
    code, out, errors = here("verify", "--json", str(recording))
    assert code == status, (out[-2000:], errors[-2000:])
    report: dict[str, Any] = json.loads(out)["files"][0]
    return report


def serve_command(scene: str, recording: Path, *arguments: str) -> list[str]:
    ports = ["--control-port", "0", "--state-port", "0"]
    return [*COMMAND, "serve", scene, *ports, "--record", str(recording), *arguments]


class Server:
    """One process with a session and its recording. It must print `on HOST:PORT,` and `recording to`."""

    def __init__(self, folder: Path, recording: Path, command: Sequence[str]) -> None:
        self.folder = folder
        self.recording = recording
        self._out = folder / "serve.out"
        with self._out.open("wb") as out:
            self.process = subprocess.Popen([*ENDS_WITH_US, *command], stdout=out, stderr=subprocess.STDOUT, cwd=folder)
        try:
            wait(self._listens_or_ended, "the session listens", START_S)
        except BaseException:
            self.process.kill()
            self.process.wait()
            raise
        match = re.search(r"on (\S+:\d+),", self.output)
        assert match, self.output
        self.address = match.group(1)

    def _listens_or_ended(self) -> bool:
        return "recording to" in self.output or self.process.poll() is not None

    @property
    def output(self) -> str:
        return self._out.read_text(errors="replace")

    def children(self) -> dict[str, psutil.Process]:
        """Front and recorder by name."""
        return front_and_recorder(self.process.pid)

    def stop(self) -> None:
        """Ctrl-C; the process must end in order."""
        self.process.send_signal(signal.SIGINT)
        assert self.process.wait(DEADLINE_S) == 0, self.output

    def verify(self) -> dict[str, Any]:
        """`iris-session verify --json` of the recording; it must be identical. Gives the report of the file."""
        return verify(self.recording)

    def finish(self) -> dict[str, Any]:
        """Stops and verifies; nothing may stay behind."""
        children = relatives(self.process.pid)
        self.stop()
        none_left(children)
        return self.verify()


class Hand:
    """One person's right hand, or a policy's: sends samples of one device that drives `robot`.

    The pose is in the tracking frame, which is the world for clients that need no alignment.
    """

    def __init__(self, client: Client, robot: str, device: str = "controller/right") -> None:
        self.client = client
        self.robot = robot
        self.device = device
        self.pose: PoseTuple = ((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
        self.clutch = False
        self.velocity = (0.0, 0.0, 0.0)
        self.sending = True
        self._next = 0.0

    def step(self) -> None:
        now = time.monotonic()
        if not self.sending or now < self._next:
            return
        dt = 1.0 / 72.0
        self._next = now + dt
        p = self.pose[0]
        v = self.velocity
        self.pose = ((p[0] + v[0] * dt, p[1] + v[1] * dt, p[2] + v[2] * dt), self.pose[1])
        self.client.send_sample(self.device, self.pose, robots=[self.robot], clutch=self.clutch)

    @property
    def tip(self) -> PoseTuple:
        tip = self.client.scene.tip_pose(self.robot)
        assert tip is not None
        return tip


class Stage:
    """The people of one test; `run` keeps all of them alive until a condition holds."""

    def __init__(self, server: Server) -> None:
        self.server = server
        self.clients: list[Client] = []
        self.hands: list[Hand] = []
        self.events: dict[str, list[Event]] = {}

    def join(self, name: str, role: str = "operator", identity: str | None = None) -> Client:
        """A client that needs no alignment (remote VR, policy, desktop)."""
        log = self.events[name] = []
        client = Client(
            self.server.address,
            role=role,
            name=name,
            devices=("controller/right", "head", "joints", "target"),
            alignment="not_needed",
            identity=identity,
            on_event=log.append,
        )
        return self.come_in(client)

    def come_in(self, client: Client) -> Client:
        """Joins while everybody else is kept alive: on a busy machine it takes longer than a silence that is borne."""
        self.clients.append(client)
        client.open()
        self.run(lambda: client.ready, f"{client.name} is in")
        return client

    def hand(self, client: Client, robot: str) -> Hand:
        """Somebody's right hand, who sees the robot."""
        self.run(lambda: client.scene.tip_pose(robot) is not None, f"{client.name} sees {robot}")
        hand = Hand(client, robot)
        self.hands.append(hand)
        return hand

    def engage(self, hand: Hand) -> None:
        """Opens, then closes the clutch, and waits until the robot follows; again, as people do, when it does not."""
        closed_at = 0.0

        def clutched() -> bool:
            nonlocal closed_at
            if time.monotonic() > closed_at + 2.0:  # on a busy machine no sample may have counted while it was open
                hand.clutch = False
                self.seconds(0.1)
                hand.clutch, closed_at = True, time.monotonic()
            return self.following(hand)

        self.run(clutched, f"{hand.robot} follows {hand.client.name}")

    def following(self, hand: Hand) -> bool:
        state = hand.client.scene.state
        mine = hand.client.connection.participant_id
        return state is not None and any(
            a.robot == hand.robot and a.participant == mine and state.header.session_time - a.step_ns < 100_000_000
            for a in state.header.applied
        )

    def step(self) -> None:
        for hand in self.hands:
            hand.step()
        for client in self.clients:
            client.poll(0.0)
        time.sleep(0.002)

    def run(self, condition: Callable[[], object], what: str, timeout_s: float = DEADLINE_S) -> None:
        deadline = time.monotonic() + timeout_s
        while not condition():
            if time.monotonic() > deadline:
                pytest.fail(f"not within {timeout_s:g} s: {what}\n{tails(self.server.folder.parent)}")
            self.step()

    def seconds(self, seconds: float) -> None:
        """Lets the session go on for a stretch of its own time."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.step()

    def height(self, name: str, body: str) -> float:
        """Where `name` sees a body [m]; 0 before the first picture."""
        watcher = next(client for client in self.clients if client.name == name)
        state = watcher.scene.state
        return 0.0 if state is None else float(state.poses[watcher.mirror.body_index[body]][2])

    def bodies(self, name: str) -> list[str]:
        """Tags of the events that `name` has seen."""
        return [type(event.body).__name__ for event in self.events[name]]

    def close(self) -> None:
        for client in self.clients:
            client.close()


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., Server]]:
    servers: list[Server] = []

    def start(scene: str = "handover", *arguments: str) -> Server:
        folder = tmp_path / f"server{len(servers)}"
        folder.mkdir()
        recording = folder / "session.rrd"
        server = Server(folder, recording, serve_command(scene, recording, *arguments))
        servers.append(server)
        return server

    yield start
    end_all(servers)


def end_all(servers: Sequence[Server]) -> None:
    """Ends what a failed test left running."""
    for server in servers:
        if server.process.poll() is None:
            children = relatives(server.process.pid)
            server.process.kill()
            server.process.wait()
            psutil.wait_procs(children, timeout=DEADLINE_S)


@pytest.fixture
def stage(serve: Callable[..., Server]) -> Iterator[Stage]:
    """The demo scene with nobody in it."""
    stage = Stage(serve())
    yield stage
    stage.close()


@pytest.fixture(scope="module")
def house(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One session of the demo scene for the tests of a file that leave it as it was; what it recorded is verified."""
    folder = tmp_path_factory.mktemp("house")
    recording = folder / "session.rrd"
    server = Server(folder, recording, serve_command("handover", recording))
    try:
        yield server
        server.finish()
    finally:
        end_all([server])


@pytest.fixture
def visit(house: Server) -> Iterator[Stage]:
    """People in the house: the scene is at its beginning, and nobody else is there or holds anything."""
    with Client(house.address, role="director", name="host", alignment="not_needed").connect(DEADLINE_S) as host:

        def alone() -> bool:
            others = [p for p in host.mirror.participants.values() if p.id != host.participant_id and p.connected]
            return not others and not any(lease.holder for lease in host.mirror.leases.values())

        assert host.wait_for(lambda _: alone(), DEADLINE_S), "somebody is still there"
        host.control("reset")
    stage = Stage(house)
    yield stage
    stage.close()


@pytest.fixture
def emulate(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Starts emulated people in a process of their own; what they say is shown when a condition fails."""
    started: list[subprocess.Popen[bytes]] = []

    def start(address: str, *headsets: str, seconds: float = 100.0) -> subprocess.Popen[bytes]:
        options = [x for headset in headsets for x in ("--headset", headset)]
        with (tmp_path / f"emulator{len(started)}.out").open("wb") as out:
            process = subprocess.Popen(
                [*ENDS_WITH_US, *COMMAND, "emulate", address, *options, "--seconds", str(seconds)],
                stdout=out,
                stderr=out,
            )
        started.append(process)
        return process

    yield start
    for process in started:  # they say goodbye: who is killed keeps robots for a while
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    for process in started:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(GOODBYE_S)
        if process.poll() is None:
            process.kill()
        process.wait()
