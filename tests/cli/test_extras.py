"""Commands without the packages of extras: one line that names the extra, no traceback, no false verdict."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from iris_session.rrd.file import END_MESSAGE, FILE_HEAD, MAGIC
from iris_session.system.extras import EXTRAS

#: Runs the command line where no package of an extra can be imported, also in its child processes.
BLOCKER = """
import sys
class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {packages!r}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Blocker())
"""


@pytest.fixture
def base_install(tmp_path: Path) -> dict[str, str]:
    """Environment in which Python has the base install alone."""
    folder = tmp_path / "site"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(BLOCKER.format(packages=set(EXTRAS)))
    root = str(Path(__file__).parents[2])
    return {
        "PYTHONPATH": f"{folder}:{root}",
        "PATH": "/usr/bin:/bin",
        "HOME": str(tmp_path),
        "IRIS_HOME": str(tmp_path / "keys"),
    }


@pytest.mark.parametrize(
    ("command", "extra"),
    [
        (("verify", "session.rrd"), "recording"),
        (("view", "session.rrd"), "recording"),
        (("demo", "handover"), "recording"),
        (("anchors", "print", "--size", "150mm", "--out", "sheet.pdf"), "opencv"),
        (("scene", "inspect", "scene.obj"), "files"),
    ],
)
def test_missing_extra_is_one_line(
    command: tuple[str, ...], extra: str, base_install: dict[str, str], tmp_path: Path
) -> None:
    (tmp_path / "session.rrd").write_bytes(MAGIC.ljust(FILE_HEAD, b"\0") + END_MESSAGE)
    (tmp_path / "scene.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    done = subprocess.run(
        [sys.executable, "-m", "iris_session.cli.main", *command],
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
        cwd=tmp_path,
        env=base_install,
    )
    lines = done.stderr.splitlines()
    assert done.returncode in (1, 2)
    assert len(lines) == 1, done.stderr
    assert f"iris-session[{extra}" in lines[0]
