"""`serve`: files that MuJoCo does not simulate, rejected options, and `--anchors`."""

from __future__ import annotations

from pathlib import Path

import pytest

from iris_session.cli import serve
from iris_session.cli.main import build_parser
from iris_session.cli.scene import find_scene_file
from iris_session.protocol.errors import IrisError
from iris_session.session.config import DEFAULT_SHEET_M, SessionConfig
from tests.cli.conftest import CommandLine

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
    assert find_scene_file("nowhere") is None, "the caller lists the scene names"
    assert find_scene_file("missing.xml") is None
    monkeypatch.setenv("HOME", str(tmp_path))
    assert find_scene_file(f"~/{part.name}") == part


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("missing.glb", ": Part no. 1.off, a.glb, b.urdf, c.xml"),
        ("lost/missing.glb", "no folder"),
        (".", ": Part no. 1.off, a.glb, b.urdf, c.xml"),
        ("folder.glb", "is a folder"),
        ("part.docx", ".docx cannot be read; supported are dae, glb, gltf, mjb, mjcf, obj,"),
        ("part", "without a suffix"),
        ("empty.glb", "is empty: 0 bytes"),
        ("~nobody-is-called-so/a.glb", "home folder"),
        ("arm.urdf.xacro", "xacro arm.urdf.xacro > arm.urdf"),
    ],
)
def test_unusable_files_are_reported_with_candidates(tmp_path: Path, part: Path, name: str, expected: str) -> None:
    for there in ("a.glb", "b.urdf", "c.xml", "part.docx", "part", "arm.urdf.xacro"):
        (tmp_path / there).write_text("x")
    (tmp_path / "folder.glb").mkdir()
    if name == "empty.glb":
        (tmp_path / name).write_text("")
    with pytest.raises(IrisError) as raised:
        find_scene_file(name if name.startswith("~") else str(tmp_path / name))
    assert expected in str(raised.value)
    assert part.is_file()


def test_file_is_shown_until_the_end(part: Path, cli: CommandLine) -> None:
    assert cli.json("serve", part, "--scale", "0.5", "--seconds", "0.1", *QUIET)["ok"]
    assert "session 'Part-no.-1' on 127.0.0.1:" in cli.err
    assert "extent is 0.5 x 0.5 x 0 m" in cli.err
    assert "to drive it" not in cli.err


def test_a_urdf_that_is_shown_says_how_it_gets_a_robot(tmp_path: Path, cli: CommandLine) -> None:
    arm = tmp_path / "arm.urdf"
    box = '<visual><geometry><box size="0.1 0.1 0.4"/></geometry></visual>'
    arm.write_text(f'<robot name="arm"><link name="base">{box}</link></robot>')
    cli.json("serve", arm, "--seconds", "0.1", *QUIET)
    assert "to drive it: mujoco.MjSpec.from_file, spec.add_actuator for each joint" in cli.err


@pytest.mark.parametrize("given", ["0", "nan", "small"])
def test_invalid_scale_is_rejected(given: str, part: Path, cli: CommandLine) -> None:
    assert f"{given!r} is" in cli.refuse("serve", part, f"--scale={given}", *QUIET)


@pytest.mark.parametrize(
    "option",
    [("--robots", "robots.toml"), ("--assign", "ann=left"), ("--mode", "request")],
)
def test_robot_options_are_rejected_for_shown_files(option: tuple[str, str], part: Path, cli: CommandLine) -> None:
    assert f"{option[0]}: {part.name} has no robots" in cli.refuse("serve", part, *option, *QUIET)


def test_package_dir_is_used(tmp_path: Path, cli: CommandLine) -> None:
    arm = tmp_path / "arm" / "arm.urdf"
    for path in (arm.parent, tmp_path / "models" / "part"):
        path.mkdir(parents=True)
    (tmp_path / "models" / "part" / "a.off").write_text(TRIANGLE)
    arm.write_text(ARM.replace('<sphere radius="0.1"/>', '<mesh filename="package://part/a.off"/>'))
    assert "(here: --package-dir DIR)" in cli.refuse("serve", arm, *QUIET)
    named = ("--package-dir", tmp_path / "models")
    cli.json("serve", arm, *named, "--seconds", "0.1", *QUIET)
    assert "--package-dir" in cli.refuse("serve", "handover", *named, *QUIET)
    missing = tmp_path / "nodir"
    assert f"--package-dir {missing}: no such folder\n" in cli.refuse("serve", arm, "--package-dir", missing, *QUIET)


DOOR = (
    'format = 1\nreference = "door"\n[anchors.door]\nposition_m = [1.0, 2.0, 0.5]\n'
    "quaternion_wxyz = [0.0, 0.0, 0.0, 1.0]\nsize_m = 0.12\n"
)


def test_file_replaces_the_anchors_of_the_scene(tmp_path: Path) -> None:
    path = tmp_path / "anchors.toml"
    path.write_text(DOOR)
    arguments = build_parser().parse_args(["serve", "arm", "--no-record", "--anchors", str(path)])
    config = serve.create_session(arguments).config
    assert config.anchors == {"door": ((1.0, 2.0, 0.5), (0.0, 0.0, 0.0, 1.0))}
    assert config.sheet_sizes() == {"door": 0.12}
    plain = serve.create_session(build_parser().parse_args(["serve", "arm", "--no-record"])).config
    assert set(plain.anchors) == {"table"}


def test_example_file_is_valid(tmp_path: Path, cli: CommandLine) -> None:
    for words in ([], ["arms4"]):
        text = cli.run("anchors", "example", *words)
        path = tmp_path / "example.toml"
        path.write_text(text)
        arguments = build_parser().parse_args(["serve", "arms4", "--no-record", "--anchors", str(path)])
        config = serve.create_session(arguments).config
        assert set(config.anchors) == {"table"}
        assert config.sheet_sizes() == {"table": DEFAULT_SHEET_M}
    own = serve.create_session(build_parser().parse_args(["serve", "arms4", "--no-record"])).config
    assert config.anchors == own.anchors, "that of the scene"
    assert cli.json("anchors", "example", "arms4") == {"toml": text}


def test_resumed_session_gets_new_anchors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Effect in the session: tests/session/test_resume.py."""
    path = tmp_path / "anchors.toml"
    path.write_text(DOOR)
    opened: list[SessionConfig] = []
    monkeypatch.setattr("iris_session.session.session.Session", lambda model, config: opened.append(config))
    for given in (["--anchors", str(path)], []):
        serve.resume_session(build_parser().parse_args(["serve", "--resume", str(tmp_path), *given]))
    assert [set(config.anchors) for config in opened] == [{"door"}, {"table"}]
    assert opened[0].resume == tmp_path
