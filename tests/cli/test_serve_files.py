"""`serve` with files that MuJoCo does not simulate: what is shown, and what is refused."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path

import pytest
import trimesh

from iris_session.cli import scene
from iris_session.cli.common import CommandError
from iris_session.cli.main import main
from iris_session.cli.scene import find_scene_file
from iris_session.scene import report

TRIANGLE = "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
ARM = '<robot name="arm"><link name="base"><visual><geometry><sphere radius="0.1"/></geometry></visual></link></robot>'
QUIET = ("--no-record", "--no-beacon", "--control-port", "0", "--state-port", "0")


@pytest.fixture
def part(tmp_path: Path) -> Path:
    path = tmp_path / "Part no. 1.off"
    path.write_text(TRIANGLE)
    return path


def test_scene_argument_is_a_file_a_model_or_a_name(
    tmp_path: Path, part: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("scene.xml", "scene.MJCF", "scene.mjb"):
        (tmp_path / name).write_text("")
        assert find_scene_file(str(tmp_path / name)) is None
    assert find_scene_file(str(part)) == part
    (tmp_path / "arms3").mkdir()
    monkeypatch.chdir(tmp_path)
    assert find_scene_file("arms3") is None, "a folder is not in the way of a scene's name"
    assert find_scene_file("nowhere") is None, "whoever looks for names says what there is"
    assert find_scene_file("missing.xml") is None
    monkeypatch.setenv("HOME", str(tmp_path))
    assert find_scene_file(f"~/{part.name}") == part


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("missing.glb", "no such file; in its folder: a.glb, Part no. 1.off, b.urdf, c.xml"),
        ("lost/missing.glb", "no such file; there is no folder"),
        (".", "is a folder: name a file; in it: Part no. 1.off, a.glb, b.urdf, c.xml"),
        ("folder.glb", "is a folder: name a file; none in it is of a kind that is read"),
        (
            "part.docx",
            "part.docx: files that end in .docx cannot be read; supported are 3mf, dae, glb, gltf, mjb, mjcf, obj,",
        ),
        ("part", "part: a file without a suffix"),
        ("empty.glb", "is empty: 0 bytes"),
        ("~nobody-is-called-so/a.glb", "no such home folder"),
        ("arm.urdf.xacro", "xacro arm.urdf.xacro > arm.urdf"),
    ],
)
def test_unusable_files_are_reported_with_candidates(tmp_path: Path, part: Path, name: str, says: str) -> None:
    for there in ("a.glb", "b.urdf", "c.xml", "part.docx", "part", "arm.urdf.xacro"):
        (tmp_path / there).write_text("x")
    (tmp_path / "folder.glb").mkdir()
    if name == "empty.glb":
        (tmp_path / name).write_text("")
    with pytest.raises(CommandError) as raised:
        find_scene_file(name if name.startswith("~") else str(tmp_path / name))
    assert says in str(raised.value)
    assert raised.value.status == 2
    assert part.is_file()


@pytest.mark.parametrize("name", ["part.off", "arm.urdf"])
def test_a_file_is_shown_until_the_end(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / name
    path.write_text(ARM if name.endswith("urdf") else TRIANGLE)
    assert main(["serve", str(path), "--seconds", "0.1", "--json", *QUIET]) == 0
    out, errors = capfd.readouterr()
    assert json.loads(out)["ok"]
    assert f"session '{path.stem}' on 127.0.0.1:" in errors
    extent = "0.2 x 0.2 x 0.2 m" if name.endswith("urdf") else "1 x 1 x 0 m"
    assert f"showing {name}, without robots; its extent is {extent}" in errors
    assert "metres are meant" not in errors


def test_a_file_in_millimetres_is_noticed_and_scaled(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "part.off"
    path.write_text(TRIANGLE.replace("1 0 0", "120 0 0").replace("0 1 0", "0 40 0"))
    assert main(["serve", str(path), "--seconds", "0.1", *QUIET]) == 0
    assert (
        "part.off is 120 m large: in millimetres where metres are meant? scale=0.001 (--scale 0.001) makes it 0.12 m"
        in capfd.readouterr().out
    )
    assert main(["serve", str(path), "--scale", "0.001", "--seconds", "0.1", *QUIET]) == 0
    out = capfd.readouterr().out
    assert "its extent is 0.12 x 0.04 x 0 m" in out
    assert "metres are meant" not in out


@pytest.mark.parametrize("given", ["0", "-1", "nan", "inf", "small"])
def test_invalid_scale_is_refused(given: str, part: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as raised:
        main(["serve", str(part), f"--scale={given}", *QUIET])
    assert raised.value.code == 2
    assert f"{given!r} is not a factor" in capsys.readouterr().err


def test_what_mujoco_simulates_is_not_scaled(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments in (("serve", "handover"), ("scene", "inspect", "scene.xml")):
        assert main([*arguments, "--scale", "2"]) == 2
        error = capsys.readouterr().err
        assert f"--scale cannot be used with {arguments[-1]}" in error
        assert error.count("\n") == 1


@pytest.mark.parametrize(
    "option",
    [("--robots", "robots.toml"), ("--assign", "ann=left"), ("--mode", "request"), ("--assignment", "nearest")],
)
def test_robot_options_are_refused_for_shown_files(
    option: tuple[str, str], part: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", str(part), *option, *QUIET]) == 2
    error = capsys.readouterr().err
    assert f"{option[0]}: {part.name} has no robots" in error
    assert error.count("\n") == 1


def test_package_dir_is_used(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
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
    assert "--package-dir applies to files to show" in capfd.readouterr().err
    assert main(["serve", str(arm), "--package-dir", str(tmp_path / "nodir"), *QUIET]) == 2
    assert capfd.readouterr().err == f"iris-session: --package-dir {tmp_path / 'nodir'}: no such folder\n"


@pytest.mark.parametrize(
    ("name", "says"), [("part.off", "damaged"), ("part.docx", "cannot be read"), ("arm.urdf", "arm")]
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


def test_serve_and_inspect_tell_one_extent(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A ball on a node that is turned is as large as before; the box around it is not."""
    ball = trimesh.Scene()
    turned = trimesh.transformations.rotation_matrix(math.radians(45), (1, 1, 0))
    ball.add_geometry(trimesh.creation.icosphere(radius=0.5), transform=turned)
    path = tmp_path / "ball.glb"
    ball.export(path)
    assert main(["serve", str(path), "--seconds", "0.1", *QUIET]) == 0
    served = re.search(r"extent is (.+) m$", capfd.readouterr().out, re.MULTILINE)
    assert main(["scene", "inspect", str(path)]) == 0
    inspected = re.search(r"extent: (.+) m along", capfd.readouterr().out)
    assert served
    assert inspected
    assert served[1] == inspected[1]
    assert max(map(float, served[1].split(" x "))) < 1.05


def test_progress_is_printed_for_large_files(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scene, "_LARGE_FILE_BYTES", 1000)
    monkeypatch.setattr(scene, "_MANY_TRIANGLES", 1000)
    monkeypatch.setattr(report, "LARGE_MESH", 1000)
    path = tmp_path / "scan.stl"
    trimesh.creation.icosphere(subdivisions=3).export(path)
    assert main(["serve", str(path), "--seconds", "0.1", *QUIET]) == 0
    out, errors = capfd.readouterr()
    assert errors.splitlines()[:2] == [
        "reading scan.stl (0.1 MB)",
        "preparing meshes of scan.stl (1,280 triangles; cached for the next time)",
    ]
    advice = "mesh scan has 1,280 triangles: over 1,000, simplify it"
    assert advice in out
    assert main(["scene", "inspect", str(path)]) == 0
    assert f"headset: {advice}" in capfd.readouterr().out
    small = tmp_path / "small.off"
    small.write_text(TRIANGLE)
    assert main(["scene", "inspect", str(small)]) == 0
    assert capfd.readouterr().err == ""
