"""The C# of this checkout, compiled once, and the results of its tests on each runtime, run once for all workers."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import pytest
from filelock import FileLock

from iris_session.assets.store import default_root
from tests.e2e.session_process import skip_unless_ci
from tools.csharp.project import Build, build, run_tests
from tools.system_packages import CSHARP, find_missing

#: Of the user, taken before the tests get a cache of their own: the tool chain is 180 MB.
FOLDER: Final = default_root("csharp")


@pytest.fixture(scope="session")
def built() -> Build:
    """Everything compiled for both runtimes. Without Mono and NUnit tests are not run; in CI that is a failure."""
    if missing := [name for name in find_missing() if name in CSHARP]:
        skip_unless_ci(f"needs {', '.join(missing)}: apt-get install")
    return build(FOLDER)


@pytest.fixture(scope="session")
def run_suite(built: Build, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], list[dict[str, Any]]]:
    """Return the results of all NUnit tests on a runtime: see `run_tests`."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent
    known: dict[str, list[dict[str, Any]]] = {}

    def run(runtime: str) -> list[dict[str, Any]]:
        if runtime not in known:
            results = folder / f"csharp-{runtime}.json"
            with FileLock(f"{results}.lock"):
                if not results.exists():
                    unfinished = Path(f"{results}.new")
                    run_tests(built, runtime, unfinished)
                    unfinished.rename(results)
            known[runtime] = [json.loads(line) for line in results.read_text().splitlines()]
        return known[runtime]

    return run
