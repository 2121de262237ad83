"""Suspected unit mistakes: reported where they are likely, with the option that replaces the present value."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh

from iris_session.scene import AssetStore
from iris_session.scene.builder import SceneBuilder
from iris_session.scene.importers.units import Drawn, colour_question, degrees_question, file_question, robot_question
from iris_session.scene.result import Joint

MM = "in millimetres where metres are meant?"
OFTEN = "divided by 1,000 once too often?"
JOINT = (
    '<joint name="j" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 {z}"/>'
    '<axis xyz="0 1 0"/><limit lower="-{q}" upper="{q}" effort="1" velocity="1"/></joint>'
)
ROBOT = (
    '<robot name="r"><link name="base"><visual><geometry>{base}</geometry><material name="blue"><color rgba="{rgba}"/>'
    '</material></visual></link><link name="arm"/>{joint}</robot>'
)


def notes_of(builder: SceneBuilder, tmp_path: Path) -> tuple[str, ...]:
    return builder.build(AssetStore(tmp_path / "assets")).notes


def urdf(path: Path, base: str, *, z: float = 0.3, q: float = 1.5, rgba: str = "0.1 0.2 0.9 1") -> Path:
    path.write_text(ROBOT.format(base=base, rgba=rgba, joint=JOINT.format(z=z, q=q)))
    return path


@pytest.mark.parametrize(
    ("side", "scale", "expected"),
    [
        (0.5, [1.0], None),
        (100.0, [1.0], f"100 m large: {MM} scale=0.001 (--scale 0.001) makes it 0.1 m"),
        (1000.0, [10.0] * 3, f"1000 m large: {MM} scale=0.01 (--scale 0.01) in place of the present one makes it 1 m"),
        (0.0005, [5e-4], f"0.5 mm large: {OFTEN} scale=0.5 (--scale 0.5) in place of the present one makes it 0.5 m"),
        (0.0003, [1e-3] * 3, f"0.3 mm large: {OFTEN} leaving out scale (--scale) makes it 0.3 m"),
        (100.0, [1.0, 1.0, -2.0], f"100 m large: {MM} scale=(0.001, 0.001, -0.002) in place of the present one"),
    ],
)
def test_advised_scale_replaces_the_given_one(side: float, scale: list[float], expected: str | None) -> None:
    found = file_question("a.stl", side, scale)
    assert len(found) == (expected is not None)
    assert expected is None or found[0].startswith(f"a.stl is {expected}")


@pytest.mark.parametrize(
    ("reach", "drawn", "scale", "expected"),
    [
        (0.9, Drawn("mesh, a.stl,", 0.2, (1, 1, 1)), 1.0, None),
        (0.0, Drawn("mesh, a.stl,", 0.2, (1, 1, 1)), 1.0, None),
        (
            0.9,
            Drawn("mesh, a.stl,", 200.0, (1, 1, 1)),
            1.0,
            'a.stl, is 200 m large: * scale="0.001 0.001 0.001" at its',
        ),
        (0.9, Drawn("mesh, a.stl,", 200.0, (2, 2, 1)), 1.0, '* scale="0.002 0.002 0.001" at its <mesh>'),
        (0.9, Drawn("mesh, a.stl,", 0.0002, (1e-3,) * 3), 1.0, "* leaving out scale at its <mesh> makes it 0.2 m"),
        (0.9, Drawn("shape, a box,", 200.0), 1.0, "shape, a box, is 200 m large: * its sizes divided by 1,000 make"),
        (350.0, Drawn("mesh, a.stl,", 0.2, (1, 1, 1)), 1.0, "joints reach over 350 m: * xyz of their <origin> divided"),
        (900.0, Drawn("mesh, a.stl,", 200.0, (1, 1, 1)), 1.0, "r is 900 m large: * scale=0.001 (--scale 0.001) makes"),
        (0.9, Drawn("mesh, a.stl,", 0.2, (1, 1, 1)), 1e-3, "r is 0.9 mm large: * leaving out scale (--scale) makes it"),
        (0.9, Drawn("mesh, a.stl,", 200.0, (1, 1, 1)), 1e-3, "joints reach over 0.9 mm: * leaving out scale (--scale)"),
        (0.0, Drawn("mesh, a.stl,", 0.2, (1, 1, 1)), 1e-3, "r is 0.2 mm large: * leaving out scale (--scale) makes"),
    ],
)
def test_units_of_a_robot(reach: float, drawn: Drawn, scale: float, expected: str | None) -> None:
    found = robot_question("r", reach, [Drawn("mesh, b.stl,", 1e-4, (1, 1, 1)), drawn], scale)
    assert len(found) == (expected is not None)
    for part in (expected or "").split("* "):
        assert part in found[0] if expected else True


def test_note_names_the_file_that_was_added(tmp_path: Path) -> None:
    ball = tmp_path / "ball_mm.stl"
    trimesh.creation.icosphere(radius=50).export(ball)
    scene = SceneBuilder()
    scene.add_file(ball, name="right", scale=0.001)
    scene.add_file(ball)
    (note,) = notes_of(scene, tmp_path)
    assert note.endswith("scale=0.001 (--scale 0.001) makes it 0.1 m")


def test_rotated_part_keeps_its_size(tmp_path: Path) -> None:
    """A disc of 9 m: the box around the box around it has sides of 13 m."""
    rod = trimesh.creation.cylinder(4.5, 0.1, sections=64)
    scene = trimesh.Scene()
    scene.add_geometry(rod, transform=trimesh.transformations.rotation_matrix(0.785398, (0, 0, 1)))
    scene.export(tmp_path / "disc.glb")
    builder = SceneBuilder()
    builder.add_file(tmp_path / "disc.glb")
    assert notes_of(builder, tmp_path) == ()


def test_robot_in_other_units(tmp_path: Path) -> None:
    trimesh.creation.box((0.3, 0.2, 0.1)).export(tmp_path / "base.stl")
    mesh = '<mesh filename="base.stl" scale="{0} {0} {0}"/>'
    scene = SceneBuilder()
    scene.add_urdf(urdf(tmp_path / "right.urdf", mesh.format(1)))
    assert notes_of(scene, tmp_path) == ()
    scene.add_urdf(urdf(tmp_path / "far.urdf", mesh.format(1), z=350.0))
    scene.add_urdf(urdf(tmp_path / "big.urdf", mesh.format(1000)))
    scene.add_urdf(urdf(tmp_path / "small.urdf", mesh.format(1)), scale=0.001)
    scene.add_urdf(urdf(tmp_path / "turns.urdf", mesh.format(1), q=90))
    scene.add_urdf(urdf(tmp_path / "blue.urdf", mesh.format(1), rgba="26 51 230 255"))
    far, big, small, turns, blue = notes_of(scene, tmp_path)
    assert far.startswith(f"far.urdf: its joints reach over 350 m: {MM} xyz of their <origin> divided by 1,000 makes")
    assert big.startswith("big.urdf: its largest mesh, base.stl, is 300 m large:")
    assert "<mesh> makes it 0.3 m" in big
    assert small.endswith("(--scale) makes it 0.3 m")
    assert turns.startswith("turns.urdf: limits of joint j are -90 to 90 rad: degrees where radians are meant?")
    assert turns.endswith("Then it is -1.571 to 1.571")
    assert blue.startswith(
        "blue.urdf: rgba of material 'blue' is 26 51 230 255, drawn as the nearest numbers from 0 to 1"
    )
    assert blue.endswith("divided by 255 it is 0.102 0.2 0.902 1")


def test_limits_in_degrees_are_suspected() -> None:
    def joint(kind: str, low: float, high: float) -> Joint:
        return Joint("j", kind, low, high, 0.0)

    right = [joint("revolute", -12.6, 12.6), joint("prismatic", 0, 30), joint("continuous", -99, 99)]
    endless = [joint("revolute", -1e16, 1e16), joint("revolute", float("-inf"), float("inf"))]
    assert degrees_question("r", [*right, *endless]) == ()
    (question,) = degrees_question("r", [*right, joint("revolute", 0, 170), joint("revolute", -90, 0)])
    assert question.startswith("r: limits of 2 joints, as j, are 0 to 170 rad")
    assert question.endswith("Then it is 0 to 2.967")


def test_colours_above_1_are_suspected() -> None:
    assert colour_question("r", "m", (0.0, 1.0, 0.5, 1.0)) == ()
    assert colour_question("r", "m", (0.0, 1.0005, 0.5, 1.0)) == (), "rounding"
    assert colour_question("r", "m", (255, 0, 0, 1))[0].endswith("divided by 255 it is 1 0 0 1")
    assert colour_question("r", "m", (0.5, 0, 0, 255))[0].endswith("divided by 255 it is 0.5 0 0 1")
    assert colour_question("r", "m", (-1, 0, 0, 1))[0].endswith("from 0 to 1, which are meant")
