"""Processes of ours: no file of the user's working folder is taken for a module, and a checkout finds itself."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from iris_session.recording import Recording
from iris_session.system import children

ROOT = Path(__file__).parents[2]
#: Names that users give their own scripts, and that what a session starts imports.
TRAPS = ("queue", "zmq", "json", "random", "select", "selectors", "anchors", "msgspec", "numpy", "rerun", "rich")
TRAP = "raise SystemExit('a file of the working folder was taken for a module')"
SERVE = ("serve", "handover", "--no-beacon", "--control-port", "0", "--state-port", "0", "--seconds", "0.5")
#: What the installed command does. An empty part of PYTHONPATH means the working folder, too.
INSTALLED = """
import os
from iris_session.cli.main import main
os.environ["PYTHONPATH"] = os.pathsep
raise SystemExit(main())
"""
#: Starts a child from a package that only this process knows of, as one that runs in a checkout.
FROM_CHECKOUT = """
import subprocess, sys
sys.path.insert(0, sys.argv[1])
from iris_session.system import children
done = subprocess.run(children.command("iris_session.where", "a", "b"), env=children.environment(), check=True)
"""


@pytest.fixture
def trapped(tmp_path: Path) -> Path:
    """A working folder with files named as modules are."""
    for name in TRAPS:
        (tmp_path / f"{name}.py").write_text(TRAP)
    return tmp_path


def test_a_session_takes_no_file_of_the_working_folder_for_a_module(trapped: Path) -> None:
    """With its front, its recorder and its display: started as the installed command is, without that folder."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", INSTALLED, *SERVE, "--record", "session.rrd"],
        cwd=trapped, capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "taken for a module" not in done.stdout + done.stderr
    with Recording.open(trapped / "session.rrd") as recording:
        assert recording.finished


def test_what_checks_files_takes_none_of_the_working_folder(trapped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(trapped)
    done = subprocess.run(
        children.command("iris_session.recording.probe"),
        env=children.environment(), input='["readable", "/none"]\n', capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "taken for a module" not in done.stderr
    assert (done.returncode, done.stdout) == (0, "0\n")


def test_a_checkout_that_is_not_installed_starts_its_own_modules(tmp_path: Path) -> None:
    checkout, elsewhere = tmp_path / "checkout", tmp_path / "elsewhere"
    package = checkout / "iris_session"
    (package / "system").mkdir(parents=True)
    elsewhere.mkdir()
    (package / "__init__.py").touch()
    (package / "system" / "__init__.py").touch()
    shutil.copy(children.__file__, package / "system" / "children.py")
    (package / "where.py").write_text("import sys; print(__file__, *sys.argv[1:])")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-P", "-c", FROM_CHECKOUT, str(checkout)],
        cwd=elsewhere, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.split() == [str(package / "where.py"), "a", "b"]


def test_the_environment_keeps_folders_that_the_user_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", "/opt/mine", "", "/opt/yours"]))
    made = children.environment(RERUN="on")
    assert made["PYTHONPATH"].split(os.pathsep)[-2:] == ["/opt/mine", "/opt/yours"]
    assert "" not in made["PYTHONPATH"].split(os.pathsep)
    assert made["RERUN"] == "on"
    assert made["PATH"] == os.environ["PATH"]


def test_every_process_is_called_so() -> None:
    """No other module runs this interpreter."""
    calling = [path for path in (ROOT / "iris_session").rglob("*.py") if "sys.executable" in path.read_text()]
    assert calling == [Path(children.__file__)]
