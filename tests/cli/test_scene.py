"""`scene inspect` and `scene export` of files that MuJoCo does not read, and of models."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import trimesh

from tests.cli.conftest import CommandLine
from tests.scene.arm import write_arm
from tests.scene.importers.test_gltf import furniture


def test_inspect_of_an_arm(tmp_path: Path, cli: CommandLine) -> None:
    urdf = write_arm(tmp_path)
    shown = cli.run("scene", "inspect", urdf, "--assets", tmp_path / "assets")
    assert "arm/link5: 2 mesh" in shown  # the hand is fixed to it
    assert "9 bodies (9 " in shown
    assert cli.json("scene", "inspect", urdf, "--assets", tmp_path / "assets")["moving"] == 9


def test_export_of_files_and_models(tmp_path: Path, cli: CommandLine) -> None:
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "box.stl")
    for name in ("model.xml", "other.mjcf"):
        (tmp_path / name).write_text('<mujoco><worldbody><geom type="box" size=".5 1 1.5"/></worldbody></mujoco>')
    names = ("box.stl", "model.xml", "other.mjcf")
    for source in (*(tmp_path / name for name in names), furniture(tmp_path / "furniture.glb")):
        out = tmp_path / f"{source.stem}_out.glb"
        assert str(out) in cli.run("scene", "export", source, out, "--assets", tmp_path / "assets")
        extents = sorted(trimesh.load_scene(out).extents)
        if source.stem != "furniture":
            assert extents == pytest.approx([1, 2, 3], abs=1e-6)


def test_export_does_not_overwrite_referenced_files(tmp_path: Path, cli: CommandLine) -> None:
    part, urdf = tmp_path / "part.glb", tmp_path / "arm.urdf"
    trimesh.creation.box((1, 2, 3)).export(part)
    urdf.write_text(
        '<robot name="arm"><link name="base"><visual><geometry><mesh filename="part.glb"/></geometry></visual></link>'
        "</robot>"
    )
    before, assets = part.read_bytes(), ("--assets", tmp_path / "assets")
    assert f"{part} is part of {urdf}" in cli.refuse("scene", "export", urdf, part, *assets)
    assert part.read_bytes() == before
    cli.run("scene", "export", urdf, tmp_path / "out.glb", *assets)


def test_inspect_prints_the_extent(tmp_path: Path, cli: CommandLine) -> None:
    box = tmp_path / "box.stl"
    mesh = trimesh.creation.box((30, 20, 10))
    mesh.apply_translation((0, 0, 5))
    mesh.export(box)
    assets = ("--assets", tmp_path / "assets")
    shown = cli.run("scene", "inspect", box, *assets)
    assert "(-15, -10, 0) to (15, 10, 10), planes" in shown
    assert "(--scale 0.001)" in shown
    found = cli.json("scene", "inspect", box, *assets, "--scale", "0.001")
    assert found["extent"]["size"] == pytest.approx([0.03, 0.02, 0.01])
    assert found["notes"] == []
    (note,) = cli.json("scene", "inspect", box, *assets, "--scale", "0.00001")["notes"]
    assert "--scale 1000" in note


def test_millimetres_are_suspected_in_robots_and_models(tmp_path: Path, cli: CommandLine) -> None:
    trimesh.creation.box((300, 200, 100)).export(tmp_path / "box.stl")
    mesh = '<visual><geometry><mesh filename="box.stl"/></geometry></visual>'
    (tmp_path / "arm.urdf").write_text(f'<robot name="arm"><link name="base">{mesh}</link></robot>')
    geom = '<asset><mesh file="box.stl"/></asset><worldbody><geom type="mesh" mesh="box"/></worldbody>'
    (tmp_path / "model.xml").write_text(f"<mujoco>{geom}</mujoco>")
    ground = '<geom type="box" size="30 30 .1"/>'
    (tmp_path / "hall.xml").write_text(f"<mujoco><worldbody>{ground}</worldbody></mujoco>")
    wanted = "300 m large: in millimetres where metres are meant?"
    for name in ("arm.urdf", "model.xml", "hall.xml"):
        assert (wanted in cli.run("scene", "inspect", tmp_path / name, "--assets", tmp_path / "assets")) == (
            name != "hall.xml"
        )


def test_collision_shapes_are_drawn_by_the_option_that_the_advice_names(tmp_path: Path, cli: CommandLine) -> None:
    arm, assets = tmp_path / "arm.urdf", ("--assets", tmp_path / "assets")
    shape = '<collision><geometry><sphere radius="0.1"/></geometry></collision>'
    arm.write_text(f'<robot name="arm"><link name="base">{shape}</link></robot>')
    (skipped,) = cli.json("scene", "inspect", arm, *assets)["skipped"]
    (option,) = re.findall(r"--\w+", skipped)
    assert cli.json("scene", "inspect", arm, *assets, option)["skipped"] == []
    cli.refuse("scene", "inspect", "arm", *assets, option)


def test_export_does_not_overwrite_input(tmp_path: Path, cli: CommandLine) -> None:
    part = furniture(tmp_path / "part.glb")
    before = part.read_bytes()
    (tmp_path / "link.glb").symlink_to(part)
    (tmp_path / "hard.glb").hardlink_to(part)
    for name in ("part.glb", "link.glb", "hard.glb", "../" + tmp_path.name + "/part.glb"):
        assert "input file" in cli.refuse("scene", "export", part, tmp_path / name, "--assets", tmp_path / "assets")
    assert part.read_bytes() == before


@pytest.mark.parametrize(
    ("name", "content", "text"),
    [
        ("lost.glb", None, "no such file"),
        ("a.step", b"x", "supported are "),
        ("a.glb", b"glTF", "it is cut"),
        (
            "a.urdf",
            b"<robot name='r'><link name='a'><visual><geometry><mesh filename='../x/y.stl'/></geometry></visual>"
            b"</link></robot>",
            "--package-dir DIR",
        ),
    ],
)
def test_invalid_files_are_one_line_errors(
    tmp_path: Path, cli: CommandLine, name: str, content: bytes | None, text: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    assert text in cli.refuse("scene", "inspect", tmp_path / name, "--assets", tmp_path / "assets")
