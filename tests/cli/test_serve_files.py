"""`serve` with files that MuJoCo does not simulate: what is shown, what is refused and why."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from iris_session.cli.main import main
from iris_session.cli.serve import file_to_show

TRIANGLE = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
ARM = '<robot name="arm"><link name="base"><visual><geometry><sphere radius="0.1"/></geometry></visual></link></robot>'
QUIET = ("--no-record", "--no-beacon", "--control-port", "0", "--state-port", "0")


@pytest.fixture
def part(tmp_path: Path) -> Path:
    path = tmp_path / "Part no. 1.off"
    path.write_text(TRIANGLE)
    return path


def test_what_mujoco_simulates_or_is_not_there_is_no_file_to_show(tmp_path: Path, part: Path) -> None:
    for name in ("scene.xml", "scene.MJCF", "scene.mjb", "handover"):
        (tmp_path / name).write_text("")
        assert file_to_show(str(tmp_path / name)) is None
    assert file_to_show(str(part)) == part
    assert file_to_show(str(tmp_path / "missing.glb")) is None
    assert file_to_show(str(tmp_path)) is None
    assert file_to_show(None) is None


@pytest.mark.parametrize("name", ["part.off", "arm.urdf"])
def test_a_file_is_shown_until_the_end(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / name
    path.write_text(ARM if name.endswith("urdf") else TRIANGLE)
    assert main(["serve", str(path), "--seconds", "0.1", "--json", *QUIET]) == 0
    out, errors = capfd.readouterr()
    assert json.loads(out)["ok"]
    assert f"session '{path.stem}' on 127.0.0.1:" in errors
    assert f"showing {name}, which nobody drives" in errors


@pytest.mark.parametrize(
    "option",
    [("--robots", "robots.toml"), ("--assign", "ann=left"), ("--mode", "request"), ("--assignment", "nearest")],
)
def test_what_is_shown_has_no_robots_to_speak_of(
    option: tuple[str, str], part: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", str(part), *option, *QUIET]) == 2
    error = capsys.readouterr().err
    assert f"{option[0]}: nobody drives what is in {part.name}" in error
    assert error.count("\n") == 1


def test_a_package_elsewhere_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    arm = tmp_path / "arm" / "arm.urdf"
    for path in (arm.parent, tmp_path / "models" / "part"):
        path.mkdir(parents=True)
    (tmp_path / "models" / "part" / "a.off").write_text(TRIANGLE)
    arm.write_text(ARM.replace('<sphere radius="0.1"/>', '<mesh filename="package://part/a.off"/>'))
    assert main(["serve", str(arm), *QUIET]) == 2
    assert "(here: --package-dir DIR)" in capfd.readouterr().err
    named = ("--package-dir", str(tmp_path / "models"))
    assert main(["serve", str(arm), *named, "--seconds", "0.1", "--json", *QUIET]) == 0
    capfd.readouterr()
    assert main(["serve", "handover", *named, *QUIET]) == 2
    assert "--package-dir goes with a file to show" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("name", "says"), [("part.off", "damaged"), ("part.docx", "are not read"), ("arm.urdf", "arm")]
)
def test_a_file_that_cannot_be_read_is_one_line(
    name: str, says: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / name
    path.write_text("nothing of the kind")
    assert main(["serve", str(path), *QUIET]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert error.count("\n") == 1
