"""`scene inspect` and `scene export` of files that MuJoCo does not read, and of models, which it does."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import trimesh

from iris_session.cli.main import main
from tests.scene.arm import write_arm
from tests.scene.test_gltf import furniture


def run(*arguments: object) -> int:
    return main([str(argument) for argument in arguments])


def test_inspect_of_an_arm(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = write_arm(tmp_path)
    assert run("scene", "inspect", urdf, "--assets", tmp_path / "assets") == 0
    shown = capsys.readouterr().out
    assert "arm/link5: 2 mesh" in shown  # the hand is fixed to it
    assert "9 bodies (9 move), 11 objects" in shown
    assert run("scene", "inspect", urdf, "--assets", tmp_path / "assets", "--json") == 0
    assert json.loads(capsys.readouterr().out)["moving"] == 9


def test_export_of_files_and_models(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.stl")
    for name in ("model.xml", "other.mjcf"):
        (tmp_path / name).write_text('<mujoco><worldbody><geom type="box" size=".5 1 1.5"/></worldbody></mujoco>')
    names = ("box.stl", "model.xml", "other.mjcf")
    for source in (*(tmp_path / name for name in names), furniture(tmp_path / "furniture.glb")):
        out = tmp_path / f"{source.stem}_out.glb"
        assert run("scene", "export", source, out, "--assets", tmp_path / "assets") == 0
        assert str(out) in capsys.readouterr().out
        extents = sorted(trimesh.load_scene(out).extents)
        if source.stem != "furniture":
            assert extents == pytest.approx([1, 2, 3], abs=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("lost.glb", None, "no such file"),
        ("a.step", b"", "are not read. These are: "),
        ("a.glb", b"glTF", "it is cut"),
        (
            "a.urdf",
            b"<robot name='r'><link name='a'><visual><geometry><mesh filename='../x/y.stl'/></geometry></visual>"
            b"</link></robot>",
            "--package-dir DIR",
        ),
    ],
)
def test_faults_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], name: str, content: bytes | None, text: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert run("scene", "inspect", tmp_path / name, "--assets", tmp_path / "assets") != 0
    error = capsys.readouterr().err
    assert text in error
    assert error.count("\n") == 1
