"""Settings of every test: hypothesis draws the same examples every time, and no process may stay behind.

`HYPOTHESIS=random` draws others (`make test-random`): they find more, but what blocks a change must repeat. A twentieth
of the values are constants that hypothesis finds in those of our modules that are loaded: these differ where a process
has run other tests before. What failed is kept with `@example`.
"""

from __future__ import annotations

import contextlib
import os
import sys
import uuid
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from hypothesis import HealthCheck, settings

#: A busy machine is slow in everything: no deadline, no complaint about slow examples.
settings.register_profile(
    "same", derandomize=True, deadline=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("random", settings.get_profile("same"), derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS", "same"))

#: In the environment of every process that the tests start, also of one whose parent has died.
MARK = "IRIS_TEST_RUN"
#: What ends by itself may take this long, on a machine that others keep busy.
ENDING_S = 30.0
#: Exit status where something was left behind: a second judgement of single tests (status 1) would not see it.
LEFT_BEHIND = 7
SAID = "processes were left behind"
_left_behind: list[str] = []

#: Rooms whose tests have processes, sockets or threads, and so a machine that may be taken away for a second.
LIVE = {
    "alignment", "assets", "bench", "cli", "client", "demo", "doctor", "e2e", "emulator", "front", "link", "netsim",
    "recording", "security", "session", "system", "tools",
}  # fmt: skip


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks what may be judged a second time (Makefile)."""
    here = Path(__file__).parent
    for item in items:
        if item.path.relative_to(here).parts[0] in LIVE or item.get_closest_marker("e2e"):
            item.add_marker("live")


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """In the process that all workers report to."""
    if report.when == "teardown" and report.failed and SAID in report.longreprtext:
        _left_behind.append(report.nodeid)


def pytest_sessionfinish(session: pytest.Session) -> None:
    if _left_behind:
        session.exitstatus = LEFT_BEHIND


def _ours() -> list[psutil.Process]:
    """Processes that were started by the tests of this one."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            marked = process.pid != os.getpid() and process.environ().get(MARK) == os.environ[MARK]
            if marked and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process)
    return found


@pytest.fixture(scope="session", autouse=True)
def _no_process_stays() -> Iterator[None]:
    """Ends with an error that names what still runs after the last test, and ends it."""
    os.environ[MARK] = uuid.uuid4().hex
    yield
    _, alive = psutil.wait_procs(_ours(), ENDING_S)
    left = []
    for process in alive:
        with contextlib.suppress(psutil.Error):
            left.append(f"{process.pid} {' '.join(process.cmdline())}")
            process.kill()
    assert not left, f"{SAID}: {left}"


@pytest.fixture(scope="session", autouse=True)
def _home_of_keys(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keys of the tests, and of every process that they start, are not those of whoever runs them."""
    before = os.environ.get("IRIS_HOME")
    os.environ["IRIS_HOME"] = str(tmp_path_factory.mktemp("keys") / "home")
    os.environ["XDG_CACHE_HOME"] = str(tmp_path_factory.mktemp("cache"))  # assets of one run, shared by its tests
    yield
    if before is None:
        del os.environ["IRIS_HOME"]
    else:
        os.environ["IRIS_HOME"] = before


@pytest.fixture
def untraced() -> Iterator[None]:
    """Long plays of physics and control, which no bound of coverage needs: the recorder would double their time."""
    tracer = sys.gettrace()
    sys.settrace(None)
    yield
    sys.settrace(tracer)
