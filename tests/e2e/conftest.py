"""Order of the end-to-end tests, and fixtures that start and end sessions and emulated headsets on free ports."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

import pytest

from iris_session.client import Client
from iris_session.client import client as client_module
from tests.e2e.browser import Browser, Page, printed_address, require_browser
from tests.e2e.scenario import Hand, Scenario
from tests.e2e.session_process import (
    COMMAND,
    DEADLINE_S,
    END_WITH_PARENT,
    PATIENCE,
    SessionProcess,
    kill_all,
    make_serve_command,
    run_in_process,
)

#: Emulated headsets leave the session within it; then they are killed [s].
SHUTDOWN_S: Final = 10.0
#: Files that begin first: one of them at the end would keep one worker busy while the others have nothing left.
#: Those that compute most lie between those that wait most.
LONGEST: Final = (
    "test_resume.py", "test_joining.py", "test_process_failures.py", "test_soak.py", "test_process.py",
    "test_shutdown.py", "test_security.py",
)  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run long files first; within a file, run the tests of the shared session last, so that it is short-lived."""
    places: dict[Path, int] = {}
    for item in items:
        name, path = item.path.name, item.path
        places.setdefault(path, (LONGEST.index(name) if name in LONGEST else len(LONGEST)) * len(items) + len(places))
    items.sort(key=lambda item: (places[item.path], "shared_session" in getattr(item, "fixturenames", ())))


@pytest.fixture(autouse=True)
def _wait_longer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let clients wait for answers as long as the tests do: a busy machine may stop a process for seconds."""
    monkeypatch.setattr(client_module, "DEFAULT_TIMEOUT_S", DEADLINE_S)
    for waiting in (Client.connect, Client.wait_for, Client.status, Client.request):
        monkeypatch.setattr(waiting, "__defaults__", (DEADLINE_S,))


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., SessionProcess]]:
    """Start `iris-session serve` with a scene and more options."""
    servers: list[SessionProcess] = []

    def start(scene: str = "handover", *arguments: str) -> SessionProcess:
        folder = tmp_path / f"server{len(servers)}"
        folder.mkdir()
        recording = folder / "session.rrd"
        server = SessionProcess(folder, recording, make_serve_command(scene, recording, *arguments))
        servers.append(server)
        return server

    yield start
    kill_all(servers)


@pytest.fixture
def own_scenario(serve: Callable[..., SessionProcess]) -> Iterator[Scenario]:
    """A session of the handover scene, without clients, that the test may end."""
    scenario = Scenario(serve())
    yield scenario
    scenario.close()


@pytest.fixture
def marked_scenario(serve: Callable[..., SessionProcess], tmp_path: Path) -> Iterator[Scenario]:
    """A session of the handover scene whose sheet has marks."""
    status, text, errors = run_in_process("anchors", "example", "handover", "--marks")
    assert status == 0, errors
    path = tmp_path / "anchors.toml"
    path.write_text(text)
    scenario = Scenario(serve("handover", "--anchors", str(path)))
    yield scenario
    scenario.close()


@pytest.fixture
def script_scenario(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Scenario]:
    """The session of the script `SCRIPT` of the test's module, with `PATIENCE`."""
    (tmp_path / "script.py").write_text(PATIENCE + request.module.SCRIPT)
    server = SessionProcess(tmp_path, tmp_path / "session.rrd", [sys.executable, str(tmp_path / "script.py")])
    scenario = Scenario(server)
    yield scenario
    scenario.close()
    kill_all([server])


@pytest.fixture
def scenario(own_scenario: Scenario) -> Scenario:
    """The session of a test."""
    return own_scenario


@pytest.fixture
def driving(scenario: Scenario) -> Hand:
    """Ann moves the left robot."""
    return scenario.drive("ann", "left", (0.0, 0.05, 0.0))


@pytest.fixture(scope="module")
def shared_session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[SessionProcess]:
    """One session of the handover scene for the tests of a file that leave it as it was. Its recording is verified."""
    folder = tmp_path_factory.mktemp("shared")
    recording = folder / "session.rrd"
    server = SessionProcess(folder, recording, make_serve_command("handover", recording))
    try:
        yield server
        server.finish()
    finally:
        kill_all([server])


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    require_browser()
    made = Browser()
    yield made
    made.close()


@pytest.fixture
def open_page(browser: Browser) -> Iterator[Callable[..., Page]]:
    """Open the page of a session by the address that the session printed."""
    pages: list[Page] = []

    def open_one(server: SessionProcess, name: str, **options: Any) -> Page:
        page = browser.open(f"{name}-{time.monotonic_ns()}", printed_address(server), **options)
        pages.append(page)
        page.wait_until_ready()
        return page

    yield open_one
    for page in pages:
        page.close()


@pytest.fixture
def emulate(tmp_path: Path) -> Iterator[Callable[..., subprocess.Popen[bytes]]]:
    """Start emulated headsets in a process of their own; its output is shown when a condition fails."""
    started: list[subprocess.Popen[bytes]] = []

    def start(address: str, *headsets: str, seconds: float = 100.0) -> subprocess.Popen[bytes]:
        options = [x for headset in headsets for x in ("--headset", headset)]
        with (tmp_path / f"emulator{len(started)}.out").open("wb") as out:
            process = subprocess.Popen(
                [*END_WITH_PARENT, *COMMAND, "emulate", address, *options, "--seconds", str(seconds)],
                stdout=out,
                stderr=out,
            )
        started.append(process)
        return process

    yield start
    for process in started:  # first by a signal: the session keeps the robots of a killed headset for a while
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    for process in started:
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(SHUTDOWN_S)
        if process.poll() is None:
            process.kill()
        process.wait()
