"""Settings of every test: hypothesis draws the same examples each time, and no process may stay.

`HYPOTHESIS=random` draws others (`make test-random`): they find more, but a check that blocks changes must repeat. A
twentieth of the values are constants that hypothesis finds in those of our modules that are loaded; these differ where
a process has run other tests before. Failing examples are kept with `@example`.
"""

from __future__ import annotations

import contextlib
import gc
import os
import re
import signal
import sys
import uuid
from collections.abc import Generator, Iterator
from pathlib import Path

import psutil
import pytest
from hypothesis import HealthCheck, settings

from iris_session.security import KeyHome
from tests.models import DATA, MENAGERIE
from tools.system_packages import OPENGL, find_missing

# A run in the background inherits that Ctrl-C is ignored, and so would every process that a test starts and interrupts.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

#: A busy machine is slow in everything: no deadline, no complaint about slow examples.
settings.register_profile(
    "same", derandomize=True, deadline=None, print_blob=True, suppress_health_check=[HealthCheck.too_slow]
)
settings.register_profile("random", settings.get_profile("same"), derandomize=False)
settings.load_profile(os.environ.get("HYPOTHESIS", "same"))

#: In the environment of every process that the tests start, also of one whose parent has died.
RUN_VARIABLE = "IRIS_TEST_RUN"
#: Time for processes that end by themselves after the last test, on a busy machine [s].
ENDING_S = 120.0


#: Missing packages of the system without which nothing can be drawn.
NO_OPENGL = sorted({*OPENGL} & {*find_missing()})


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Leave what is loaded for all tests out of garbage collections: each would visit 400,000 objects in vain."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests in a browser: one that draws in software takes all cores, so these run one by one."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker("browser")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Skip tests that fail to draw on a machine without OpenGL; in CI they fail."""
    report = yield
    if NO_OPENGL and report.failed and not os.environ.get("CI") and re.search("OpenGL|EGL", report.longreprtext):
        report.outcome = "skipped"
        path, line, _ = item.location
        report.longrepr = (path, line or 0, f"needs OpenGL: apt-get install {' '.join(NO_OPENGL)}")
    return report


def _find_test_processes() -> list[psutil.Process]:
    """Return the running processes that the tests of this process started.

    Those that index a finished recording run on by design, only while the machine is idle; they are killed.
    """
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            marked = process.pid != os.getpid() and process.environ().get(RUN_VARIABLE) == os.environ[RUN_VARIABLE]
            if not marked or process.status() == psutil.STATUS_ZOMBIE:
                continue
            if "iris_session.rrd.index" in process.cmdline():
                for one in (*process.children(recursive=True), process):
                    one.kill()
            else:
                found.append(process)
    return found


@pytest.fixture(scope="session", autouse=True)
def _check_processes_end() -> Iterator[None]:
    """Fail after the last test with the processes that still run, and kill them."""
    os.environ[RUN_VARIABLE] = uuid.uuid4().hex
    yield
    _, alive = psutil.wait_procs(_find_test_processes(), ENDING_S)
    left = []
    for process in alive:
        with contextlib.suppress(psutil.Error):
            left.append(f"{process.pid} {' '.join(process.cmdline())}")
            process.kill()
    assert not left, f"processes were left behind: {left}"


@pytest.fixture(scope="session", autouse=True)
def _isolate_keys_and_assets(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the keys, cached assets and robot models of the user from the tests and the processes that they start.

    So the robots are the same everywhere, and none is downloaded.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("IRIS_DATA", raising=False)
        patch.setenv("MENAGERIE_ROOT", str(MENAGERIE))
        patch.setenv("IRIS_HOME", str(tmp_path_factory.mktemp("keys") / "home"))
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))  # shared by the tests of one run
        yield


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> KeyHome:
    """The home of keys of a test of its own, which the environment names."""
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "home"))
    return KeyHome()


@pytest.fixture(autouse=True)
def _check_priority_is_kept() -> Iterator[None]:
    """Fail when a test has lowered the priority of this process: later tests, and what they start, would starve."""
    before = os.getpriority(os.PRIO_PROCESS, 0)
    yield
    assert os.getpriority(os.PRIO_PROCESS, 0) == before


@pytest.fixture(scope="session")
def rgbd() -> Path:
    """The folder of real RGB-D frames. Without it a test is not run; in CI with `IRIS_DATA`, that is a failure."""
    folder = Path(DATA, "rgbd").resolve()
    if not (DATA and folder.is_dir()):
        reason = f"needs real RGB-D frames: a folder rgbd/ in IRIS_DATA={DATA}"
        if os.environ.get("CI") and DATA:
            pytest.fail(reason)
        pytest.skip(reason)
    return folder


@pytest.fixture
def untraced() -> Iterator[None]:
    """Disable coverage for long runs of physics and control: it doubles their time, and no bound needs it."""
    tracer = sys.gettrace()
    sys.settrace(None)
    yield
    sys.settrace(tracer)
