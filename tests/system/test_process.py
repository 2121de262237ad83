"""Child processes: start, read, stop; files of the working folder are not imported; a checkout finds itself."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from iris_session.system import process
from iris_session.system.process import DEVNULL, PIPE, ChildProcess

ROOT = Path(__file__).parents[2]
#: Names of users' own scripts that child processes of a session import as modules.
TRAPS = ("queue", "zmq", "json", "random", "select", "selectors", "anchors", "msgspec", "numpy", "rerun", "rich")
TRAP = "raise SystemExit('a file of the working folder was taken for a module')"


#: Starts a child from a package that only this process can import, as in a checkout that is not installed.
FROM_CHECKOUT = """
import subprocess, sys
sys.path.insert(0, sys.argv[1])
from iris_session.system.process import child_environment, module_command
subprocess.run(module_command("iris_session.where", "a", "b"), env=child_environment(), check=True)
"""


@pytest.fixture
def module_traps(tmp_path: Path) -> Path:
    """A working folder with files named as standard modules."""
    for name in TRAPS:
        (tmp_path / f"{name}.py").write_text(TRAP)
    return tmp_path


@pytest.mark.e2e
def test_child_imports_nothing_from_the_working_folder(module_traps: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(module_traps)
    done = subprocess.run(
        process.module_command("iris_session.netsim.process", "--help"),
        env=process.child_environment(), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert "for a module" not in done.stderr
    assert (done.returncode, "--link" in done.stdout) == (0, True), done.stderr


@pytest.mark.e2e
def test_uninstalled_checkout_starts_its_own_modules(tmp_path: Path) -> None:
    checkout, elsewhere = tmp_path / "checkout", tmp_path / "elsewhere"
    package = checkout / "iris_session"
    (package / "system").mkdir(parents=True)
    elsewhere.mkdir()
    (package / "__init__.py").touch()
    (package / "system" / "__init__.py").touch()
    shutil.copy(process.__file__, package / "system" / "process.py")
    (package / "where.py").write_text("import sys; print(__file__, *sys.argv[1:])")
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, "-P", "-c", FROM_CHECKOUT, str(checkout)],
        cwd=elsewhere, env=environment, capture_output=True, text=True, check=True,
    )  # fmt: skip
    assert done.stdout.split() == [str(package / "where.py"), "a", "b"]


def test_environment_keeps_folders_of_the_user(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(["", "/opt/mine", "", "/opt/yours"]))
    made = process.child_environment(RERUN="on")
    assert made["PYTHONPATH"].split(os.pathsep)[-2:] == ["/opt/mine", "/opt/yours"]
    assert "" not in made["PYTHONPATH"].split(os.pathsep)
    assert made["RERUN"] == "on"
    assert made["PATH"] == os.environ["PATH"]


def test_only_one_module_runs_the_interpreter() -> None:
    calling = [path for path in (ROOT / "iris_session").rglob("*.py") if "sys.executable" in path.read_text()]
    assert calling == [Path(process.__file__)]


@pytest.fixture
def module_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder where children find modules."""
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    return tmp_path


@pytest.mark.e2e
def test_child_reads_configuration_and_answers_in_lines(module_folder: Path) -> None:
    (module_folder / "echo_length.py").write_text(
        "import os, stat, sys; print(stat.filemode(os.fstat(0).st_mode), os.fstat(0).st_nlink)\n"
        "print(len(sys.stdin.buffer.read())); print('cut', end='')"
    )
    with ChildProcess("echo_length", config=bytes(1_000_000), stdout=PIPE) as child:
        assert child.read_line(30.0) == b"-rw------- 0", "an unlinked file, which holds any size without a reader"
        assert child.read_line(30.0) == b"1000000"
        with pytest.raises(EOFError):
            child.read_line(30.0)
        assert child.wait(30.0) == 0
        assert child.exit_status == 0
        assert not child.is_running


@pytest.mark.e2e
def test_silent_child_times_out_and_is_killed(module_folder: Path) -> None:
    (module_folder / "deaf.py").write_text(
        "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up', flush=True); time.sleep(60)"
    )
    with ChildProcess("deaf", stdout=PIPE, stderr=DEVNULL) as child:
        assert child.read_line(30.0) == b"up"
        with pytest.raises(TimeoutError):
            child.read_line(0.01)
        assert child.read_available_lines() == []
        assert child.close(terminate_s=0.05) == -signal.SIGKILL
        assert child.close() == -signal.SIGKILL
