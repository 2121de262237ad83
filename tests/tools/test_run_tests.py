"""The table of `make test`: what passed, failed and was not run, and the exit status."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from tools import run_tests, system_packages
from tools.run_tests import Stage, main

SUITE = """
import pytest

def test_passes(): pass
def test_also_passes(): pass
@pytest.mark.skip(reason="no camera")
def test_is_skipped(): pass
"""


@pytest.fixture
def suite(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A file of tests as the only stage, in this process's environment."""
    path = tmp_path / "test_suite.py"
    path.write_text(SUITE)
    command = (sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "--rootdir", str(tmp_path), str(path))
    monkeypatch.setattr(run_tests, "make_stages", lambda: (Stage("unit", command, is_pytest=True),))
    return path


def test_counts_and_tests_that_were_not_run(suite: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 0
    lines = capfd.readouterr().out.splitlines()
    assert "not run: 1 tests: no camera" in lines
    assert lines[-1].startswith("===== 2 passed, 1 skipped in ")


def test_failed_test_sets_the_exit_status(suite: Path, capfd: pytest.CaptureFixture[str]) -> None:
    suite.write_text(SUITE + "def test_fails(): assert False\n")
    assert main([]) == 1
    assert capfd.readouterr().out.splitlines()[-1].startswith("===== 1 failed, 2 passed, 1 skipped in ")


def test_failed_command_counts(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    stages = (Stage("lint", (sys.executable, "-c", "raise SystemExit(2)")), Stage("types", (sys.executable, "-c", "")))
    monkeypatch.setattr(run_tests, "make_stages", lambda: stages)
    assert main([]) == 1
    assert main(["--only", "types"]) == 0
    assert "===== 1 failed, 0 passed in " in capfd.readouterr().out


@pytest.mark.parametrize(("ci", "status"), [("", 0), ("true", 1)])
def test_missing_packages_of_the_system_are_named(
    ci: str, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("CI", ci)
    monkeypatch.setitem(system_packages.PACKAGES, "libegl1", ("drawing", lambda: False))
    monkeypatch.setitem(system_packages.PACKAGES, "chromium", ("pages", lambda: True))
    assert system_packages.main([]) == status
    text = capsys.readouterr().out
    assert "apt-get install --no-install-recommends libegl1" in text
    assert "chromium" not in text
