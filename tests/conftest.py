"""Settings of every test: hypothesis draws the same examples in continuous integration, so a failure there repeats."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest
from hypothesis import settings

settings.register_profile("ci", derandomize=True, deadline=None, print_blob=True)
settings.register_profile("local", deadline=None)
settings.load_profile("ci" if os.environ.get("CI") else "local")


@pytest.fixture(scope="session", autouse=True)
def _home_of_keys(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keys of the tests, and of every process that they start, are not those of whoever runs them."""
    before = os.environ.get("IRIS_HOME")
    os.environ["IRIS_HOME"] = str(tmp_path_factory.mktemp("keys") / "home")
    yield
    if before is None:
        del os.environ["IRIS_HOME"]
    else:
        os.environ["IRIS_HOME"] = before
