"""The NUnit tests of unity_client pass on .NET and on Mono: one test here for each fixture there."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from tools.csharp.project import find_projects
from tools.csharp.toolchain import RUNTIMES

pytestmark = pytest.mark.e2e


def _list_fixtures() -> Iterator[str]:
    """Yield the full name of every class with the attribute TestFixture in sources of tests."""
    for path in (path for project in find_projects() if project.is_test for path in project.sources):
        text = path.read_text(encoding="utf-8-sig")
        namespace = re.search(r"^namespace ([\w.]+)", text, re.MULTILINE)
        for name in re.findall(r"\[TestFixture.*?\bclass (\w+)", text, re.DOTALL):
            yield f"{namespace[1]}.{name}" if namespace else name


FIXTURES = sorted(_list_fixtures())


@pytest.mark.parametrize("fixture", FIXTURES)
@pytest.mark.parametrize("runtime", RUNTIMES)
def test_fixture(runtime: str, fixture: str, run_suite: Callable[[str], list[dict[str, Any]]]) -> None:
    results = [one for one in run_suite(runtime) if one["fixture"] == fixture]
    failures = [f"{one['name']}\n{one['failure']}" for one in results if one["failure"]]
    if failures:
        pytest.fail(f"{len(failures)} of {len(results)} failed on {runtime}\n\n" + "\n\n".join(failures), pytrace=False)
    ran = [one for one in results if not one["skipped"]]
    assert ran, [one["skipped"] for one in results]


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_every_fixture_that_ran_is_listed(runtime: str, run_suite: Callable[[str], list[dict[str, Any]]]) -> None:
    assert {one["fixture"] for one in run_suite(runtime)} == {*FIXTURES}
