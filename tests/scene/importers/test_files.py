"""OBJ, STL, PLY, OFF, DAE: geometry, colours, textures, and the files that a file may refer to."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from iris_session.scene import AssetStore, SceneBuildError, decode_image, decode_mesh
from iris_session.scene.builder import SceneBuilder
from iris_session.scene.importers.files import load_file
from iris_session.scene.importers.references import References
from iris_session.scene.nodes import MAX_FILE_BYTES, to_matrix
from iris_session.scene.result import ComposedScene

PIXELS = np.random.default_rng(2).integers(0, 255, (4, 8, 3), dtype=np.uint8)
OBJ = """mtllib parts.mtl
v 0 0 0
v 1 0 0
v 0 1 0
v 0 0 1
vt 0 0
vt 1 0
vt 0 0.25
usemtl red
f 1 2 3
usemtl painted
f 1/1 2/2 4/3
"""
MTL = """newmtl red
Kd 0.8 0.2 0.2
d 0.4
newmtl painted
Kd 1 1 1
map_Kd picture.png
"""


def build(path: Path, tmp_path: Path, **options: object) -> tuple[ComposedScene, AssetStore]:
    store = AssetStore(tmp_path / "store")
    scene = SceneBuilder("test")
    scene.add_file(path, **options)
    return scene.build(store), store


def write_obj(folder: Path) -> Path:
    Image.fromarray(PIXELS).save(folder / "picture.png")
    (folder / "parts.mtl").write_text(MTL)
    (folder / "parts.obj").write_text(OBJ)
    return folder / "parts.obj"


def test_obj_with_materials_and_a_texture(tmp_path: Path) -> None:
    scene, store = build(write_obj(tmp_path), tmp_path)
    assert scene.skipped == ()
    by_name = {visual.name: visual for visual in scene.spec.visuals}
    assert by_name["red"].rgba == pytest.approx((0.8, 0.2, 0.2, 0.4), abs=0.003)
    painted = by_name["painted"]
    level = scene.spec.textures[scene.spec.materials[painted.material].find_texture()].levels[0]
    np.testing.assert_array_equal(decode_image(store.get(level.address), level.encoding), PIXELS)
    mesh = decode_mesh(store.get(scene.spec.meshes[painted.geometry.mesh].levels[0].address))
    assert mesh.uv is not None
    at = {tuple(p): tuple(uv) for p, uv in zip(mesh.position.tolist(), mesh.uv.tolist(), strict=True)}
    assert at == {(0, 0, 0): (0, 1), (1, 0, 0): (1, 1), (0, 0, 1): (0, 0.75)}  # v goes down here, up in the file


def test_text_of_another_system_is_no_cut_file(tmp_path: Path) -> None:
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    text = trimesh.exchange.ply.export_ply(box, encoding="ascii")
    (tmp_path / "box.ply").write_bytes(text.replace(b"\n", b"\r\n"))
    scene, _ = build(tmp_path / "box.ply", tmp_path)
    assert len(scene.spec.visuals) == 1


@pytest.mark.parametrize("kind", ["stl", "ply", "off", "obj", "dae"])
def test_geometry_of_every_format(tmp_path: Path, kind: str) -> None:
    mesh = trimesh.creation.annulus(0.2, 0.5, 0.3)
    path = tmp_path / f"ring.{kind}"
    mesh.export(path)
    scene, store = build(path, tmp_path, name="ring", movable=True, up="z")
    assert scene.moving == ("ring",)
    visual = scene.spec.visuals[0]
    assert kind in ("dae", "obj") or visual.name == "ring", "where the file has no name for it"
    found = decode_mesh(store.get(scene.spec.meshes[visual.geometry.mesh].levels[0].address))
    again = trimesh.Trimesh(found.position, found.index, process=True).apply_transform(to_matrix(visual.T_body_visual))
    np.testing.assert_allclose(again.bounds, mesh.bounds, atol=1e-6)
    assert again.volume == pytest.approx(mesh.volume, rel=1e-5)


def test_scale_and_up_axis(tmp_path: Path) -> None:
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "a.stl")
    for up, size in ((None, (1, 2, 3)), ("z", (1, 2, 3)), ("y", (1, 3, 2))):
        scene, _ = build(tmp_path / "a.stl", tmp_path, scale=0.01, up=up, position=(0, 0, 5))
        assert scene.spec.environment.center == pytest.approx((0, 0, 5))
        mesh = scene.spec.meshes[0]
        T = to_matrix(scene.spec.visuals[0].T_body_visual)[:3, :3]
        extent = np.abs(T @ (np.array(mesh.high) - mesh.low))
        np.testing.assert_allclose(extent, 0.01 * np.array(size), atol=1e-7)
    trimesh.creation.box((1, 2, 3)).export(tmp_path / "x.dae")
    text = (tmp_path / "x.dae").read_text()
    assert "<up_axis>" in text
    (tmp_path / "x.dae").write_text(re.sub("[XYZ]_UP", "X_UP", text))
    with pytest.raises(SceneBuildError, match=r"x\.dae .*up='y' or up='z'"):
        build(tmp_path / "x.dae", tmp_path)
    build(tmp_path / "x.dae", tmp_path, up="z")
    with pytest.raises(SceneBuildError, match="up is 'x'"):
        build(tmp_path / "a.stl", tmp_path, up="x")
    with pytest.raises(SceneBuildError, match="scale is 0"):
        build(tmp_path / "a.stl", tmp_path, scale=0)
    for scale in (float("nan"), "big", (1, 2), [[1], [1, 2]], None):
        with pytest.raises(SceneBuildError, match="scale"):
            build(tmp_path / "a.stl", tmp_path, scale=scale)


def test_colours_at_vertices(tmp_path: Path) -> None:
    box = trimesh.creation.box()
    colors = np.random.default_rng(1).integers(0, 255, (8, 4), dtype=np.uint8)
    box.visual.vertex_colors = colors
    box.export(tmp_path / "a.ply")
    scene, store = build(tmp_path / "a.ply", tmp_path)
    mesh = decode_mesh(store.get(scene.spec.meshes[0].levels[0].address))
    assert mesh.color is not None
    for position, color in zip(mesh.position, mesh.color, strict=True):
        vertex = int(np.flatnonzero((box.vertices == position).all(axis=1))[0])
        assert color.tolist() == colors[vertex].tolist()
    assert scene.spec.visuals[0].rgba == (1.0, 1.0, 1.0, 1.0)
    # a given colour replaces them
    scene, store = build(tmp_path / "a.ply", tmp_path, rgba=(0, 1, 0, 1))
    assert decode_mesh(store.get(scene.spec.meshes[0].levels[0].address)).color is None
    assert scene.spec.visuals[0].rgba == (0.0, 1.0, 0.0, 1.0)


def test_missing_references_are_reported(tmp_path: Path) -> None:
    path = write_obj(tmp_path)
    (tmp_path / "picture.png").unlink()
    scene, _ = build(path, tmp_path)
    assert any("picture.png: " in line for line in scene.skipped)
    (tmp_path / "parts.mtl").write_text(MTL.replace("picture.png", "../../etc/passwd"))
    scene, _ = build(path, tmp_path)
    assert any("outside of" in line for line in scene.skipped)


@pytest.mark.parametrize(
    ("name", "data", "named"),
    [
        ("a.stl", b"", "0 bytes"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 7\n", "a.off"),
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 nan\nf 1 2 3\n", "a.obj"),
        ("a.dae", b"<COLLADA>", "a.dae"),
        ("a.dae", b"<!DOCTYPE COLLADA [<!ENTITY a SYSTEM 'file:///etc/passwd'>]><COLLADA/>", "DOCTYPE"),
        ("a.dae", "<!DOCTYPE COLLADA [<!ENTITY a 'b'>]><COLLADA/>".encode("utf-16"), "DOCTYPE"),
        ("a.dae", b"<?xml version='1.0' encoding='UTF-7'?><COLLADA/>", "UTF-8"),
        ("a.glb", b"glTF", "a.glb"),
        ("a.glb", b"\x89PNG", "b'glTF'"),
        ("a.gltf", b"[]", "a.gltf"),
        ("a.gltf", b"{", "a.gltf"),
        ("a.step", b"x", ".step"),
        ("a", b"x", "glb"),
        ("a.urdf", b"<robot/>", "add_urdf"),
        ("a.xml", b"<mujoco/>", "Session('a.xml')"),
        ("a.urdf.xacro", b"<robot/>", "xacro a.urdf.xacro > a.urdf"),
    ],
)
def test_invalid_files_are_rejected(tmp_path: Path, name: str, data: bytes, named: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(SceneBuildError, match=re.escape(named)):
        load_file(tmp_path / name)


def test_missing_and_large_files_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(SceneBuildError, match="no such file"):
        load_file(tmp_path / "lost.stl")
    (tmp_path / "folder.stl").mkdir()
    with pytest.raises(SceneBuildError, match=r"is a folder: .* \(dae, "):
        load_file(tmp_path / "folder.stl")
    with (tmp_path / "large.stl").open("wb") as file:
        file.truncate(MAX_FILE_BYTES + 1)
    with pytest.raises(SceneBuildError, match="at most 512 MiB"):
        load_file(tmp_path / "large.stl")


@pytest.mark.parametrize(
    ("package", "name"), [("trimesh", "a.stl"), ("collada", "a.dae"), ("defusedxml", "a.urdf"), ("PIL", "a.png")]
)
def test_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, package: str, name: str) -> None:
    (tmp_path / name).write_bytes(b"<robot name='r'><link name='a'/></robot>")
    monkeypatch.setitem(sys.modules, package, None)
    scene = SceneBuilder()
    add = {
        "PIL": lambda: scene.add_box(half_size=(1, 1, 1), texture=tmp_path / name),
        "defusedxml": lambda: scene.add_urdf(tmp_path / name),
    }.get(package, lambda: scene.add_file(tmp_path / name))
    with pytest.raises(SceneBuildError, match=r"pip install 'iris-session\[(files|scene)\]'"):
        add()


def test_folders_that_belong_to_a_file(tmp_path: Path) -> None:
    package = tmp_path / "package"
    for folder in ("urdf/deep", "meshes", "secret"):
        (package / folder).mkdir(parents=True)
    (tmp_path / "other").mkdir()
    for path in ("urdf/deep/a.stl", "meshes/a b.stl", "secret/a.stl", "../other/a.stl"):
        (package / path).write_bytes(b"x")
    (package / "urdf" / "meshes").symlink_to(tmp_path / "other")
    model = package / "urdf" / "robot.urdf"
    model.write_text("")
    references = References(model)
    assert references.find("deep/a.stl") == package / "urdf/deep/a.stl"
    assert references.find("../meshes/a%20b.stl") == package / "meshes/a b.stl"
    assert references.find(f"file://{package}/meshes/a b.stl") == package / "meshes/a b.stl"
    assert references.find("package://package/meshes/a b.stl") == package / "meshes/a b.stl"
    for outside in ("../secret/a.stl", "../../other/a.stl", "meshes/a.stl", "/etc/passwd", "file:///etc/passwd"):
        with pytest.raises(SceneBuildError, match="outside of"):
            references.find(outside)
    for wrong in ("package://package/../other/a.stl", "package://../other/a.stl", "package:///etc/passwd"):
        with pytest.raises(SceneBuildError, match="package"):
            references.find(wrong)
    (package / "package.xml").write_text("<package> <name> official </name> </package>")
    assert References(model).find("../secret/a.stl") == package / "secret/a.stl"
    assert References(model).find("package://official/secret/a.stl") == package / "secret/a.stl"
    assert References(model).find("package://package/secret/a.stl") == package / "secret/a.stl"
    assert References(model, [tmp_path / "other"]).find("../../other/a.stl") == tmp_path / "other/a.stl"
    with pytest.raises(SceneBuildError, match="no such folder"):
        References(model, [tmp_path / "lost"])


def test_a_file_among_downloads_does_not_reach_the_users_images(tmp_path: Path) -> None:
    home = tmp_path / "ann"
    for folder in ("Downloads", "images", "franka/urdf", "franka/images"):
        (home / folder).mkdir(parents=True)
    for path in ("images/private.png", "Downloads/own.png", "franka/images/skin.png"):
        (home / path).write_bytes(b"x")
    references = References(home / "Downloads" / "robot.urdf")
    assert references.find("own.png") == home / "Downloads/own.png"
    with pytest.raises(SceneBuildError, match="outside of its own folders"):
        references.find("../images/private.png")
    assert References(home / "franka/urdf/robot.urdf").find("../images/skin.png") == home / "franka/images/skin.png"
    given = References(home / "Downloads" / "robot.urdf", [home / "images"])
    assert given.find("../images/private.png") == home / "images/private.png"


def test_folder_needs_a_manifest_to_be_a_package(tmp_path: Path) -> None:
    """A downloaded URDF must not expose files beside the downloads folder."""
    home = tmp_path / "ann"
    for folder in ("Downloads", "Pictures", ".ssh", "gripper"):
        (home / folder).mkdir(parents=True)
    for path in ("Pictures/private.png", ".ssh/key", "gripper/a.stl"):
        (home / path).write_bytes(b"x")
    model = home / "Downloads" / "robot.urdf"
    model.write_text("")
    names = ("Pictures/private.png", ".ssh/key", "ann/Pictures/private.png", "gripper/a.stl")
    for name in names:
        with pytest.raises(SceneBuildError, match=r"no package\.xml"):
            References(model).find(f"package://{name}")
    (home / "gripper" / "package.xml").write_text("<package><name>gripper</name></package>")
    assert References(model).find("package://gripper/a.stl") == home / "gripper" / "a.stl"
    for given in (home, home / "Pictures"):
        assert References(model, [given]).find(f"package://{names[0]}") == home / names[0]
