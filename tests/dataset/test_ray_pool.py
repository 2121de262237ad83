"""Episodes made on a Ray cluster: the bytes of one process; what a node lacks, and workers that die, are named."""

from __future__ import annotations

import importlib.machinery
import importlib.util
import os
import pickle
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import chdir
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import psutil
import pytest

from iris_session.cli.common import CommandError
from iris_session.cli.main import main
from iris_session.cli.recording_dataset import check_cluster_reachable
from iris_session.dataset import ray_pool
from iris_session.dataset.cameras import PictureSpec, parse_cameras
from iris_session.dataset.episodes import DatasetError, PlanOptions
from iris_session.dataset.ray_pool import RayPool, make_files
from iris_session.dataset.run import DatasetOptions, export_dataset, find_version
from iris_session.system.process import ROOT, child_environment, module_command
from tests.dataset.support import read_files, record
from tests.dataset.test_killed import count_closed
from tests.dataset.test_run import make_tasks
from tests.replay.support import Played

PICTURES = PictureSpec(parse_cameras("operator"), 64, 48, plain=True)
LABELS = ("success", "failure")


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return record(tmp_path_factory.mktemp("played") / "session.rrd")


# --- without Ray ------------------------------------------------------------------------------------------------------


class StandIn(ModuleType):
    """A module `ray` that runs tasks here, when their results are asked for."""

    def __init__(self, cpus: int) -> None:
        super().__init__("ray")
        self.__spec__ = importlib.machinery.ModuleSpec("ray", None)
        self.did: list[str] = []
        self._cpus = cpus
        self.exceptions = ModuleType("ray.exceptions")
        self.exceptions.RayError = type("RayError", (Exception,), {})
        self.exceptions.RayTaskError = type("RayTaskError", (self.exceptions.RayError,), {})

    def is_initialized(self) -> bool:
        return self.did.count("init") > self.did.count("shutdown")

    def init(self, address: str, **options: Any) -> None:
        if address == "nowhere":
            raise ConnectionError("nothing\nlistens there")
        self.did.append("init")

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": self._cpus}

    def remote(self, max_retries: int) -> Callable[[Callable[..., Any]], Any]:
        ray = self

        class Function:
            def __init__(self, function: Callable[..., Any]) -> None:
                self._function = function

            def options(self, name: str) -> Function:
                return self

            def remote(self, *arguments: Any) -> Callable[[], Any]:
                ray.did.append("begin")
                return lambda: self._function(*arguments)

        return Function

    def get(self, begun: Callable[[], Any]) -> Any:
        with chdir("/"):  # workers have a folder of their own
            return begun()

    def cancel(self, begun: Any) -> None:
        self.did.append("cancel")

    def wait(self, begun: list[Any], num_returns: int, timeout: float) -> None:
        self.did.append("wait")

    def shutdown(self) -> None:
        self.did.append("shutdown")


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> Iterator[StandIn]:
    ray = StandIn(1)
    monkeypatch.setitem(sys.modules, "ray", ray)
    monkeypatch.setitem(sys.modules, "ray.exceptions", ray.exceptions)
    monkeypatch.setattr(ray_pool, "_maker", None)
    yield ray
    if ray_pool._maker is not None:
        ray_pool._maker.close()


def test_files_of_tasks_become_the_same_set(
    played: Played, tmp_path: Path, ray: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(played.path.parent)
    for to in ("lerobot", "robomimic", "mcap"):
        for name, open_pool in (("one", None), ("tasks", partial(RayPool, "local", None))):
            options = DatasetOptions(100, PICTURES, PlanOptions(LABELS))
            export_dataset([Path(played.path.name)], tmp_path / to / name, to, options, open_pool=open_pool)
        assert read_files(tmp_path / to / "tasks") == read_files(tmp_path / to / "one")
    assert ray.did.count("begin") == 9
    assert ray.did[-1] == "shutdown"


def test_a_cluster_of_the_caller_goes_on(played: Played, tmp_path: Path, ray: StandIn) -> None:
    ray.init("auto")
    export_dataset([played.path], tmp_path / "set", "lerobot", open_pool=partial(RayPool, "auto", None))
    assert "shutdown" not in ray.did


def test_what_is_begun_is_cancelled(played: Played, tmp_path: Path, ray: StandIn) -> None:
    pool = RayPool("auto", 3, {})
    assert pool.depth == 3
    tasks = make_tasks(played, tmp_path)
    begun = [pool.begin(task) for task in tasks]
    pool.take(tasks[0], begun[0])
    pool.close()
    assert ray.did == ["init", "begin", "begin", "begin", "cancel", "cancel", "wait", "shutdown"]


def test_what_a_node_lacks_is_named(
    played: Played, tmp_path: Path, ray: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("platform.node", lambda: "lab3")
    task = make_tasks(played, tmp_path)[0]
    away = msgspec.structs.replace(task, planned=msgspec.structs.replace(task.planned, path="/nowhere/session.rrd"))
    for versions, wanted, problem in (
        ({"numpy": "0.1"}, task, f"node lab3 has numpy {find_version('numpy')}, not 0.1: install the same"),
        ({"nothing-of-this-name": "1.2"}, task, "node lab3 has no nothing-of-this-name 1.2: install the same"),
        ({}, away, "node lab3: there is no recording /nowhere/session.rrd: every node needs the recordings under"),
    ):
        pool = RayPool("auto", None, versions)
        with pytest.raises(DatasetError, match=problem):
            pool.take(wanted, pool.begin(wanted))


def test_workers_that_die_are_named(played: Played, tmp_path: Path, ray: StandIn) -> None:
    def die(begun: Any) -> None:
        raise ray.exceptions.RayError("The worker died.\nLook into its log.")

    pool, task = RayPool("auto", None, {}), make_tasks(played, tmp_path)[1]
    assert pool.depth == 2
    ray.get = die
    problem = r"^session.rrd: episode 2 was not made in 3 attempts: The worker died. Look into its log.$"
    with pytest.raises(DatasetError, match=problem):
        pool.take(task, pool.begin(task))


def test_a_lost_cluster_is_named_and_left(played: Played, tmp_path: Path, ray: StandIn) -> None:
    def lose(*_: Any) -> Any:
        raise ConnectionError("Ray Client lost\nthe cluster")

    pool, task = RayPool("auto", None, {}), make_tasks(played, tmp_path)[1]
    begun = pool.begin(task)
    ray.get = ray.cancel = ray.cluster_resources = lose
    for use in (lambda: pool.depth, lambda: pool.take(task, begun)):
        with pytest.raises(DatasetError, match=r"^the Ray cluster is lost: Ray Client lost the cluster$"):
            use()
    pool.close()
    assert ray.did[-1] == "shutdown"


def test_a_node_without_the_package_is_named_and_a_defect_is_not_hidden(
    played: Played, tmp_path: Path, ray: StandIn, monkeypatch: pytest.MonkeyPatch
) -> None:
    pool, task = RayPool("auto", None, {}), make_tasks(played, tmp_path)[0]
    error = ray.exceptions.RayTaskError("ray::make_files() (pid=7, ip=10.0.0.3)\na traceback")
    missing = "The remote function failed to import on the worker. ...\n\nModuleNotFoundError: No module named 'x'\n"

    def fail(begun: Any) -> None:
        raise error

    ray.get = fail
    error.cause = RuntimeError(missing)
    with pytest.raises(DatasetError, match=r"^node 10.0.0.3 has no usable iris-session \(ModuleNotFoundError: No mod"):
        pool.take(task, pool.begin(task))
    error.cause = ZeroDivisionError("division by zero")
    with pytest.raises(ray.exceptions.RayTaskError, match="a traceback"):
        pool.take(task, pool.begin(task))

    def refuse(*arguments: Any) -> None:
        raise ModuleNotFoundError("No module named 'x'")

    monkeypatch.setattr(pool._make, "remote", refuse)
    with pytest.raises(
        DatasetError, match=r"^the head of the cluster has no usable iris-session \(No module named 'x'"
    ):
        pool.begin(task)


def test_no_cluster_is_one_line(played: Played, tmp_path: Path, ray: StandIn) -> None:
    with pytest.raises(DatasetError, match=r"^no Ray cluster can be used at 'nowhere': nothing listens there$"):
        export_dataset([played.path], tmp_path / "set", "lerobot", open_pool=partial(RayPool, "nowhere", None))


@pytest.mark.parametrize("scheme", ["", "ray://"])
def test_an_address_where_nothing_listens_is_refused_at_once(scheme: str) -> None:
    """Ray would try for minutes."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        address = f"{scheme}127.0.0.1:{server.getsockname()[1]}"
        check_cluster_reachable(address)
    with pytest.raises(CommandError, match=f"^no Ray cluster answers at {address}: "):
        check_cluster_reachable(address)
    check_cluster_reachable("auto")


def test_a_missing_package_is_named(
    played: Played, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "ray" else find(name, *more))
    command = ["export", str(played.path), "--to", "lerobot", "--out", str(tmp_path / "set"), "--ray", "local"]
    assert main(command) == 2
    wanted = "--ray needs ray, which is not installed: pip install 'iris-session[ray]'"
    assert capsys.readouterr().err == f"iris-session: {wanted}\n"


# --- with Ray ---------------------------------------------------------------------------------------------------------


def make_or_die(task: bytes, versions: dict[str, str]) -> Any:
    """Stand for `make_files`: the first attempt at an episode dies, and every attempt at one that must not be made."""
    attempts = Path(os.environ["ATTEMPTS"])
    episode = pickle.loads(task).episode.number
    with (attempts / str(episode)).open("a") as file:
        file.write("x")
    if (attempts / str(episode)).stat().st_size == 1 or str(episode) == os.environ["NEVER"]:
        os.kill(os.getpid(), signal.SIGKILL)
    return make_files(task, versions)


def make_or_wait(task: bytes, versions: dict[str, str]) -> Any:
    """Stand for `make_files`: only the first episode is ever made."""
    if pickle.loads(task).episode.number > 1:
        threading.Event().wait()
    return make_files(task, versions)


def export_by(make: Callable[..., Any], *command: str) -> None:
    """Run the command with other workers. It runs in a process of its own, which Ray's threads do not outlive."""
    ray_pool.make_files = make
    sys.exit(main([*command]))


@pytest.fixture
def environment() -> Iterator[dict[str, str]]:
    """Environment of commands with Ray, whose sockets need a short path."""
    pytest.importorskip("ray", reason="Ray is not installed: pip install -e '.[ray]'")
    with tempfile.TemporaryDirectory(prefix="r", ignore_cleanup_errors=True) as folder:
        yield child_environment(TMPDIR=folder)


def make_command(recording: Path, folder: Path) -> list[str]:
    command = ["export", str(recording), "--to", "lerobot", "--out", str(folder), "--ray", "local", "--fps", "100"]
    return [*command, "--labels", ",".join(LABELS), "--cameras", "operator", "--size", "64x48", "--plain"]


def make_code(make: Callable[..., Any]) -> list[str]:
    return [sys.executable, "-c", f"from {__name__} import *; export_by({make.__name__}, *sys.argv[1:])"]


def without_progress(errors: str) -> list[str]:
    return [line for line in errors.splitlines() if not line.endswith((" episodes", ": reading"))]


@pytest.mark.long
@pytest.mark.e2e
def test_a_local_ray_makes_the_same_bytes(played: Played, tmp_path: Path, environment: dict[str, str]) -> None:
    export_dataset([played.path], tmp_path / "one", "lerobot", DatasetOptions(100, PICTURES, PlanOptions(LABELS)))
    command = module_command("iris_session.cli.main", *make_command(played.path, tmp_path / "ray"))
    done = subprocess.run(command, check=False, env=environment, capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.startswith(f"{tmp_path / 'ray'}: 3 episodes, 30 frames, lerobot\n")
    assert without_progress(done.stderr) == []
    assert read_files(tmp_path / "ray") == read_files(tmp_path / "one")


@pytest.mark.long
@pytest.mark.e2e
def test_a_killed_worker_is_replaced_and_one_that_always_dies_is_named(
    played: Played, tmp_path: Path, environment: dict[str, str]
) -> None:
    command = [*make_code(make_or_die), *make_command(played.path, tmp_path / "set")]

    def export(never: str) -> tuple[subprocess.CompletedProcess[str], dict[str, int]]:
        """Return what came of the command, and how often each episode was tried."""
        attempts = tmp_path / f"attempts{never}"
        attempts.mkdir()
        here = {**environment, "ATTEMPTS": str(attempts), "NEVER": never}
        done = subprocess.run(command, check=False, env=here, cwd=ROOT, capture_output=True, text=True)
        return done, {path.name: path.stat().st_size for path in attempts.iterdir()}

    done, attempts = export("3")
    named = "iris-session: session.rrd: episode 3 was not made in 3 attempts: The worker died unexpectedly"
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.splitlines()[-1].startswith(named)
    assert attempts == {"1": 2, "2": 2, "3": 3}
    assert count_closed(tmp_path / "set") == 2
    done, attempts = export("")
    assert (done.returncode, attempts) == (0, {"3": 2})
    assert done.stdout.startswith(f"{tmp_path / 'set'}: 3 episodes, 30 frames, lerobot\n")
    export_dataset([played.path], tmp_path / "one", "lerobot", DatasetOptions(100, PICTURES, PlanOptions(LABELS)))
    assert read_files(tmp_path / "set") == read_files(tmp_path / "one")


@pytest.mark.long
@pytest.mark.e2e
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_an_export_that_ends_leaves_no_process(
    number: signal.Signals, played: Played, tmp_path: Path, environment: dict[str, str]
) -> None:
    process = subprocess.Popen(
        [*make_code(make_or_wait), *make_command(played.path, tmp_path / "set")],
        env=environment,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while process.poll() is None and count_closed(tmp_path / "set") < 1:
        time.sleep(0.01)  # the second episode never comes
    assert process.poll() is None, process.communicate()
    processes = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(number)
    output, errors = process.communicate()
    assert process.returncode == (130 if number == signal.SIGINT else -number)
    assert output == ""
    assert len(without_progress(errors)) == (number == signal.SIGINT)  # how to go on
    assert len(processes) > 3
    # After SIGKILL, Ray's own agents notice within a minute.
    assert psutil.wait_procs(processes, timeout=300)[1] == []
    if number == signal.SIGINT:
        assert not list(Path(environment["TMPDIR"]).glob("iris-export-*"))
    assert count_closed(tmp_path / "set") == 1
