"""The C# client in a console, on both runtimes, with a live session on another machine, by the encrypted web wire."""

from __future__ import annotations

import contextlib
import json
import signal
import subprocess
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import psutil
import pytest

from tests.csharp.conftest import built as built  # noqa: PLC0414  a fixture
from tests.e2e.session_process import DEADLINE_S, PATIENT_COMMAND, wait_until
from tests.e2e.virtual_network import Network, ServedSession, require_namespaces
from tools.csharp.project import Build
from tools.csharp.toolchain import RUNTIMES

pytestmark = pytest.mark.e2e

#: What a hand may be away from where it should be after a move of 10 cm [mm].
MOVE_MM: Final = 5.0
#: A headset that stood still has a fresh state within it [ms].
FRESH_MS: Final = 100.0
STILL_S: Final = 3.0
#: Draw calls of a frame that a Quest 3 can do.
DRAW_CALLS: Final = 200
#: What a body is drawn away from where the newest state has it, while the arms stand still [mm].
DRAWN_MM: Final = 1.0


class Headset:
    """A headset in a process, which takes commands one by one. `ended`: its exit status, once it has ended."""

    def __init__(self, command: list[str], folder: Path, environment: dict[str, str]) -> None:
        self.process = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env=environment,
        )
        self.results: list[dict[str, Any]] = []
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        self.results.extend(json.loads(line) for line in self.process.stdout)

    def send(self, command: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(command + "\n")
        self.process.stdin.flush()

    def do(self, command: str) -> dict[str, Any]:
        """Have a command done and return its result."""
        name = command.split(maxsplit=1)[0]
        before = self._count(name)
        self.send(command)
        return self.wait_for(name, before + 1)

    def wait_for(self, name: str, n: int = 1) -> dict[str, Any]:
        """Wait for the `n`-th result of a command."""
        wait_until(
            lambda: self._count(name) >= n or not self._reader.is_alive(), f"{n} results of {name}: {self.results}"
        )
        assert self._count(name) >= n, self.results
        return [one for one in self.results if one["command"] == name][n - 1]

    def _count(self, name: str) -> int:
        return sum(one["command"] == name for one in self.results)

    def wait_for_view(self, condition: Callable[[dict[str, Any]], object], what: str) -> dict[str, Any]:
        """Ask for what it sees of the session until a condition holds."""
        wait_until(lambda: condition(self.do("view")), what)
        return self.results[-1]

    def end(self) -> int:
        """Let it leave the session, and return its exit status."""
        if self.process.poll() is None:
            self.send("quit")
        return self.process.wait(DEADLINE_S)

    def close(self) -> None:
        """Kill it if it still runs."""
        self.process.kill()
        self._reader.join()
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with contextlib.suppress(BrokenPipeError):
                    pipe.close()
        self.process.wait()


StartHeadset = Callable[..., Headset]


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Network]:
    require_namespaces()
    network = Network(tmp_path_factory.mktemp("network"))
    yield network
    network.close()


@pytest.fixture
def start(network: Network, built: Build) -> Iterator[StartHeadset]:
    """Start a headset on the machine of headsets; each `user` has an identity."""
    started: list[Headset] = []

    def start_one(runtime: str, user: str, *options: str) -> Headset:
        folder = network.headset.folder / user
        folder.mkdir(exist_ok=True)
        program = built.make_command(runtime, "headless")
        command = [*program, "run", "--json", "--identity", str(folder / "identity"), "--name", user, *options]
        started.append(Headset(network.headset.wrap_command(*command), folder, network.headset.environment()))
        return started[-1]

    yield start_one
    for headset in started:
        headset.close()


def pair(network: Network) -> str:
    """Return a new join code of the session."""
    done = network.server.run_command("pair", "--no-wait", "--json")
    assert done.returncode == 0, done.stderr
    code: str = json.loads(done.stdout.splitlines()[0])["code"]
    return code


def serve(network: Network, scene: str) -> ServedSession:
    """Serve a scene to the other machine, alone."""
    network.server.close()
    arguments = ("--interface", network.server.interface, "--name", scene)
    return network.server.serve(*arguments, scene=scene, command=PATIENT_COMMAND)


def find_process(served: ServedSession, module: str) -> psutil.Process:
    """Return a process of a session by its module."""
    children = psutil.Process(served.process.pid).children(recursive=True)
    return next(one for one in children if module in " ".join(one.cmdline()))


def test_two_headsets_find_pair_align_and_move_arms(network: Network, start: StartHeadset) -> None:
    serve(network, "aloha")
    assert start("mono", "eve", "--code", "AAAA-AAAA-AAAA").process.wait(DEADLINE_S) == 2
    stranger = start("mono", "eve", "--address", "https://10.77.1.1:7725").do("join")
    assert (stranger["ok"], stranger["problem"]) == (False, "UnknownCertificate")
    ann, bob = start("mono", "ann", "--code", pair(network)), start("dotnet", "bob", "--code", pair(network))
    for headset in (ann, bob):
        assert headset.wait_for("pair")["ok"]
        assert headset.do("join")["bodies"] > 0
    for headset in (ann, bob, ann):  # those who saw a sheet before are asked to glance at it once more
        aligned = headset.do("align")
        assert aligned["true_m"] <= aligned["stated_m"]
    drawn = ann.do("draw")  # by the Unity layer on stand-ins of the engine
    assert drawn["ok"], str(drawn)
    assert 0 < drawn["draws"] <= DRAW_CALLS
    assert drawn["error_mm"] <= DRAWN_MM, str(drawn)
    assert drawn["people"] > 0
    assert bob.do("acquire south/left")["ok"]
    assert ann.do("until lease_changed")["what"] == "south/left by bob"
    denied = ann.do("acquire south/left")
    assert (denied["reason"], denied["holder"]) == ("held", "bob")
    assert ann.do("acquire north/right")["ok"]
    for headset, robot in ((ann, "north/right"), (bob, "south/left")):
        moved = headset.do(f"move {robot} 0 0 0.1")
        assert moved["error_mm"] <= MOVE_MM, str(moved)
    assert ann.do("estop")["ok"]
    assert bob.do("view")["stopped"]
    network.server.close()
    assert ann.do("draw dimmed")["dimmed"]
    assert [headset.end() for headset in (ann, bob)] == [1, 0]


@pytest.mark.long
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_what_fails_costs_neither_lease_nor_alignment(network: Network, start: StartHeadset, runtime: str) -> None:
    """Front and gateway are killed, the headset stands still, and is killed."""
    served = serve(network, "handover")
    user = f"kim-{runtime}"
    headset = start(runtime, user, "--code", pair(network))
    assert headset.do("join")["ok"]
    assert headset.do("align")["ok"]
    assert headset.do("acquire left")["ok"]
    for module in ("web.gateway", "front.main"):
        epoch = headset.do("view")["epoch"]
        find_process(served, module).kill()
        back = headset.wait_for_view(lambda v, old=epoch: v["phase"] == "Ready" and v["epoch"] > old, "it is back")
        assert (back["resumed"], back["ours"], back["alignment"]) == (True, ["left"], "Aligned")
        assert headset.do("align")["ok"]
        assert headset.do("move left 0 0 0.05")["error_mm"] <= MOVE_MM
    headset.process.send_signal(signal.SIGSTOP)
    threading.Event().wait(STILL_S)
    headset.process.send_signal(signal.SIGCONT)
    measured = headset.do("measure 2")
    assert 0.0 <= measured["recovery_ms"] <= FRESH_MS, str(measured)
    headset.process.kill()
    headset.process.wait()
    again = start(runtime, user, "--address", "https://10.77.1.1:7725")
    joined = again.do("join")
    assert (joined["ok"], joined["resumed"]) == (True, True)
    assert again.do("view")["ours"] == ["left"]
    assert again.do("align")["ok"]
    assert again.do("move left 0 0 0.05")["error_mm"] <= MOVE_MM
    assert again.end() == 0
    served.process.send_signal(signal.SIGINT)
    assert served.process.wait(DEADLINE_S) == 0
