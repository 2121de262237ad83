"""glTF: agreement with other readers, round trips, corners of the format, damaged files."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from PIL import Image

from iris_session.protocol.common import Pose
from iris_session.protocol.scene import SceneSpec
from iris_session.scene import AssetStore, SceneBuildError, decode_image, decode_mesh
from iris_session.scene.builder import SceneBuilder
from iris_session.scene.glb import write_glb
from iris_session.scene.nodes import to_matrix
from tests.scene.documents import SQUARE, SQUARE_UV, Document

RNG = np.random.default_rng(3)
PIXELS = RNG.integers(0, 255, (8, 16, 3), dtype=np.uint8)


def build(path: Path, store: AssetStore, **options: object) -> SceneSpec:
    scene = SceneBuilder("test")
    scene.add_file(path, **options)
    return scene.build(store).spec


def triangles_of(spec: SceneSpec, store: AssetStore) -> trimesh.Trimesh:
    """Return all meshes of a specification in the world, from bytes."""
    bodies = {body.id: to_matrix(body.T_world_body) for body in spec.bodies}
    found = []
    for visual in spec.visuals:
        mesh = decode_mesh(store.get(spec.meshes[visual.geometry.mesh].levels[0].address))
        one = trimesh.Trimesh(mesh.position, mesh.index, process=False)
        found.append(one.apply_transform(bodies[visual.body] @ to_matrix(visual.T_body_visual)))
    return trimesh.util.concatenate(found)


def distance(a: trimesh.Trimesh, b: trimesh.Trimesh) -> float:
    """Return the largest distance from the centre of a triangle of one mesh to the nearest of the other."""
    between = np.linalg.norm(a.triangles_center[:, None] - b.triangles_center[None], axis=2)
    return float(max(between.min(axis=0).max(), between.min(axis=1).max()))


def furniture(path: Path) -> Path:
    """Write, with another library, a tree of rotated, stretched and mirrored nodes; one material has a texture."""
    scene = trimesh.Scene()
    painted = trimesh.creation.cylinder(0.3, 0.8, sections=12)
    painted.visual = trimesh.visual.TextureVisuals(
        np.random.default_rng(4).random((len(painted.vertices), 2)),
        trimesh.visual.material.PBRMaterial("painted", baseColorTexture=Image.fromarray(PIXELS), metallicFactor=0.25),
    )
    plain = trimesh.creation.icosphere(subdivisions=1, radius=0.5)
    plain.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(
            "plain", baseColorFactor=[128, 64, 0, 255], metallicFactor=0.5, roughnessFactor=0.25
        )
    )
    turn = trimesh.transformations.euler_matrix
    shear = np.eye(4)
    shear[:3, :3] = [[1.2, 0.3, 0], [0, 0.8, 0], [0, 0.1, -1.1]]
    scene.graph.update("hall", matrix=turn(0.1, 0.2, 0.3))
    scene.graph.update("table", "hall", matrix=trimesh.transformations.translation_matrix([0.5, 1, -0.5]))
    scene.add_geometry(painted, "leg", geom_name="painted", parent_node_name="table", transform=turn(0.5, 0, 1))
    scene.add_geometry(plain, "top", geom_name="plain", parent_node_name="table", transform=shear)
    scene.add_geometry(plain, "ball", geom_name="plain", parent_node_name="hall", transform=turn(1, 1, 1) * 1.0)
    path.write_bytes(scene.export(file_type="glb"))
    return path


def test_another_reader_sees_the_same_triangles(tmp_path: Path, store: AssetStore) -> None:
    path = furniture(tmp_path / "furniture.glb")
    spec = build(path, store)
    theirs = trimesh.load_scene(path).to_mesh()
    theirs.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [1, 0, 0]))  # y up to z up
    ours = triangles_of(spec, store)
    assert len(ours.faces) == len(theirs.faces) > 100
    assert distance(ours, theirs) < 1e-5
    assert ours.volume == pytest.approx(theirs.volume, rel=1e-5)  # flipped, it would be negative


def test_hierarchy_and_materials_are_read(tmp_path: Path, store: AssetStore) -> None:
    spec = build(furniture(tmp_path / "furniture.glb"), store)
    parents = {body.name: spec.bodies[body.parent].name for body in spec.bodies[1:]}
    assert (parents["leg"], parents["top"], parents["table"], parents["ball"]) == ("table", "table", "hall", "hall")
    assert not any(body.moving for body in spec.bodies)
    for body in spec.bodies[1:]:
        above = to_matrix(spec.bodies[body.parent].T_world_body)
        np.testing.assert_allclose(above @ to_matrix(body.T_parent_body), to_matrix(body.T_world_body), atol=1e-9)
    materials = {material.name: material for material in spec.materials}
    assert materials["plain"].metallic == 0.5
    assert materials["plain"].roughness == 0.25
    linear = np.array([128, 64, 0]) / 255
    seen = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(materials["plain"].rgba[:3], seen, atol=1e-6)
    assert materials["painted"].metallic == 0.25
    level = spec.textures[materials["painted"].find_texture()].levels[0]
    np.testing.assert_array_equal(decode_image(store.get(level.address), level.encoding), PIXELS)
    # used twice, once stretched: two meshes, since a pose has no scale
    assert len(spec.meshes) == 3


def test_vertex_colours_round_trip(tmp_path: Path, store: AssetStore) -> None:
    document = Document()
    colors = RNG.integers(0, 65_535, (4, 4), dtype=np.uint16)
    document.json["materials"] = [{"alphaMode": "BLEND"}]
    document.square(0, COLOR_0=document.accessor(colors, normalized=True))
    first = build(document.write(tmp_path / "a.glb"), store)
    mesh = decode_mesh(store.get(first.meshes[0].levels[0].address))
    assert mesh.color is not None
    linear = colors[:, :3] / 65_535
    seen = np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)
    for position, color in zip(mesh.position, mesh.color, strict=True):
        corner = int(np.flatnonzero((position == SQUARE).all(axis=1))[0])
        np.testing.assert_allclose(color[:3], 255 * seen[corner], atol=0.5)
        assert color[3] == round(255 * int(colors[corner, 3]) / 65_535)
    write_glb(first, store, tmp_path / "b.glb")
    second = build(tmp_path / "b.glb", store)
    assert first.meshes[0].levels == second.meshes[0].levels
    document.json["materials"] = [{}]  # opaque: the alpha of its vertices is ignored
    opaque = build(document.write(tmp_path / "c.glb"), store)
    mesh = decode_mesh(store.get(opaque.meshes[0].levels[0].address))
    assert mesh.color is not None
    assert (mesh.color[:, 3] == 255).all()


def test_sparse_quantised_strips_and_strides_are_read(tmp_path: Path, store: AssetStore) -> None:
    document = Document()
    places, values = document.view(np.uint16([2]).tobytes()), document.view(np.float32([5, 6, 7]).tobytes())
    sparse = {
        "count": 1,
        "indices": {"bufferView": places, "componentType": 5123},
        "values": {"bufferView": values},
    }
    square = document.square()
    document.json["accessors"][document.json["meshes"][square]["primitives"][0]["attributes"]["POSITION"]]["sparse"] = (
        sparse
    )
    quantised = document.accessor(np.int16([[-32768, 0, 0], [32767, 0, 0], [0, 32767, 0], [0, 0, 32767]]))
    document.json["accessors"][quantised]["normalized"] = True
    document.json["meshes"].append({"primitives": [{"attributes": {"POSITION": quantised}, "mode": 5}]})
    wide = np.zeros((3, 5), np.float32)
    wide[:, :3] = SQUARE[:3]
    strided = document.accessor(np.ascontiguousarray(wide[:, :3]))
    document.json["accessors"][strided]["bufferView"] = view = document.view(wide.tobytes())
    document.json["bufferViews"][view]["byteStride"] = 20
    document.json["meshes"].append({"primitives": [{"attributes": {"POSITION": strided}}]})
    spec = build(document.write(tmp_path / "a.glb"), store, up="z")
    meshes = [decode_mesh(store.get(mesh.levels[0].address)) for mesh in spec.meshes]
    assert [5, 6, 7] in meshes[0].position.tolist()
    assert meshes[1].triangles == 2
    assert meshes[1].position.min() == -1.0
    np.testing.assert_array_equal(meshes[2].position[meshes[2].index[0]], SQUARE[:3])
    corners = meshes[1].position[meshes[1].index]  # every second triangle of a strip is flipped
    np.testing.assert_array_equal(corners[1].tolist(), [[1, 0, 0], [0, 0, 1], [0, 1, 0]])


def test_textures_of_the_material_are_read(tmp_path: Path, store: AssetStore) -> None:
    alpha = np.dstack([PIXELS, np.tile(np.uint8([10, 51]), (8, 8))])
    document = Document()
    texture = document.image(alpha)
    turn = {"offset": [0.25, 0.5], "scale": [2.0, 3.0], "rotation": math.pi / 2}
    base = {"index": texture, "extensions": {"KHR_texture_transform": turn}}
    document.json["materials"] = [
        {"pbrMetallicRoughness": {"baseColorTexture": {"index": texture}}, "alphaMode": mode, "alphaCutoff": 0.2}
        for mode in ("OPAQUE", "MASK", "BLEND")
    ] + [{"pbrMetallicRoughness": {"baseColorTexture": base, "metallicRoughnessTexture": {"index": texture}}}]
    uv = document.accessor(SQUARE_UV)
    for material in range(4):
        document.square(material, TEXCOORD_0=uv)
    spec = build(document.write(tmp_path / "a.glb"), store)

    def pixels(material: int, *roles: str) -> NDArray[np.uint8]:
        level = spec.textures[spec.materials[material].find_texture(*roles)].levels[0]
        return decode_image(store.get(level.address), level.encoding)

    np.testing.assert_array_equal(pixels(0), PIXELS)
    np.testing.assert_array_equal(pixels(1)[:, :, 3], np.tile([0, 255], (8, 8)), "0.2 is 51 of 255, and not cut")
    np.testing.assert_array_equal(pixels(2), alpha)
    packed = pixels(3, "orm")
    assert (packed[:, :, 0] == 255).all()  # the red channel does not occlude here
    np.testing.assert_array_equal(packed[:, :, 1:], PIXELS[:, :, 1:])
    worn = decode_mesh(store.get(spec.meshes[spec.visuals[3].geometry.mesh].levels[0].address))
    assert worn.uv is not None
    corner = {tuple(p): uv for p, uv in zip(worn.position.round(3).tolist(), worn.uv, strict=True)}
    for (x, y, z), (u, v) in zip(SQUARE.tolist(), SQUARE_UV.tolist(), strict=True):  # scaled, then rotated, then moved
        np.testing.assert_allclose(corner[x, y, z], [3 * v + 0.25, -2 * u + 0.5], atol=1e-6)
    again = build(_import_and_export(tmp_path / "a.glb", tmp_path / "b.glb", store), store)
    assert [t.channels for t in again.textures] == [t.channels for t in spec.textures], "alpha comes back"


def test_open_meshes_are_drawn_from_both_sides(tmp_path: Path, store: AssetStore) -> None:
    document = Document()
    document.json["materials"] = [{"doubleSided": True}, {}]
    document.square(0)
    document.square(1)
    box = trimesh.creation.box()
    index = document.accessor(box.faces.astype(np.uint16).reshape(-1))
    corners = document.accessor(box.vertices.astype(np.float32))
    document.json["meshes"].append(
        {"primitives": [{"attributes": {"POSITION": corners}, "indices": index, "material": 0}]}
    )
    spec = build(document.write(tmp_path / "a.glb"), store)
    assert [spec.meshes[v.geometry.mesh].levels[0].triangles for v in spec.visuals] == [4, 2, 12]


@pytest.mark.parametrize(("scale", "movable"), [((-1, 1, 1), True), ((1, 2, -3), False)])
def test_lights_and_cameras_are_placed(
    tmp_path: Path, store: AssetStore, scale: tuple[float, ...], movable: bool
) -> None:
    """Also below mirrored nodes, and after an export."""
    document = Document()
    document.square()
    turned = [0.5, -0.5, 0.5, 0.5]
    lamp = {"type": "spot", "color": [1, 0, 0], "intensity": 30, "range": 9, "spot": {}}
    document.json |= {
        "extensionsUsed": ["KHR_lights_punctual"],
        "extensions": {"KHR_lights_punctual": {"lights": [lamp]}},
        "cameras": [{"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}],
        "nodes": [
            {"mesh": 0, "scale": list(scale), "children": [1]},
            {"rotation": turned, "translation": [1, 2, 3], "camera": 0, "children": [2]},
            {"extensions": {"KHR_lights_punctual": {"light": 0}}},
        ],
    }
    x, y, z, w = turned
    R = to_matrix(Pose((0.0, 0.0, 0.0), (w, x, y, z)))[:3, :3]
    forward, up = np.diag(scale) @ R @ [0, 0, -1], np.diag(scale) @ R @ [0, 1, 0]
    spec = build(document.write(tmp_path / "a.glb"), store, up="z", name="lamp", movable=movable)
    write_glb(spec, store, tmp_path / "b.glb")
    for found in (spec, build(tmp_path / "b.glb", store)):
        bodies = {body.id: to_matrix(body.T_world_body) for body in found.bodies}
        (light,), (camera,) = found.lights, found.cameras
        assert (light.kind, light.diffuse, light.intensity, light.range) == ("spot", (1.0, 0.0, 0.0), 30.0, 9.0)
        assert camera.fovy == pytest.approx(math.degrees(1.0))
        T = bodies[camera.body] @ to_matrix(camera.T_body_camera)
        for along in (bodies[light.body][:3, :3] @ light.direction_body, -T[:3, 2]):
            np.testing.assert_allclose(along, forward / np.linalg.norm(forward), atol=1e-9)
        np.testing.assert_allclose(T[:3, 1], up / np.linalg.norm(up), atol=1e-9)
        assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
        for p in ((bodies[light.body] @ [*light.p_body, 1])[:3], T[:3, 3]):
            np.testing.assert_allclose(p, np.array(scale) * [1, 2, 3], atol=1e-9)


def _import_and_export(path: Path, out: Path, store: AssetStore) -> Path:
    write_glb(build(path, store), store, out)
    return out


def test_parts_that_are_not_drawn_are_reported(tmp_path: Path, store: AssetStore) -> None:
    document = Document()
    document.square()
    document.json["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 1})
    document.json["meshes"][0]["primitives"][0]["targets"] = [{}]
    document.json["nodes"] = [{"mesh": 0}, {"mesh": 0, "name": "flat", "scale": [1, 0, 1]}]
    document.json |= {"skins": [{}], "animations": [{}, {}], "extensionsUsed": ["KHR_materials_clearcoat"]}
    scene = SceneBuilder()
    scene.add_file(document.write(tmp_path / "a.glb"))
    text = "\n".join(scene.build(store).skipped)
    for word in ("1 skins", "2 animations", "KHR_materials_clearcoat", "points and lines", "morph targets", "'flat'"):
        assert word in text


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"asset": {"version": "1.0"}}, "'1.0'"),
        ({"extensionsRequired": ["KHR_draco_mesh_compression"]}, "KHR_draco_mesh_compression"),
        ({"nodes": [{"mesh": 7}]}, "meshes 7"),
        ({"nodes": [{"mesh": 0, "children": [0]}]}, "nothing that can be drawn|node 0"),
        ({"nodes": [{"children": [1]}, {"children": [0]}], "scenes": [{"nodes": [0]}]}, "node 0"),
        ({"meshes": [{"primitives": [{}]}]}, "mesh_0"),
        ({"meshes": [{"primitives": 5}], "nodes": [{"mesh": 0}]}, "damaged"),
        (
            {"accessors": [{"bufferView": 0, "componentType": 5126, "count": 10**9, "type": "VEC3"}]},
            "1000000000 entries",
        ),
        ({"images": [{"uri": "../../../etc/passwd"}], "textures": [{"source": 0}]}, "etc/passwd, outside"),
        ({"images": [{"uri": "data:image/png;base64,AAAA"}], "textures": [{"source": 0}]}, "image 0 of a.glb"),
    ],
)
def test_damaged_documents_are_rejected(tmp_path: Path, change: dict[str, object], text: str) -> None:
    document = Document()
    document.json["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
    document.square(0 if "images" in change else None)
    document.json.update(change)
    with pytest.raises(SceneBuildError, match=text):
        SceneBuilder().add_file(document.write(tmp_path / "a.glb"))


def test_random_bytes_raise_scene_errors_only(tmp_path: Path) -> None:
    whole = bytearray(furniture(tmp_path / "whole.glb").read_bytes())
    end = 20 + int.from_bytes(whole[12:16], "little")
    rng = np.random.default_rng(11)
    path = tmp_path / "noise.glb"
    for _ in range(150):
        noisy = whole.copy()
        for _ in range(3):
            noisy[int(rng.integers(20, end))] = int(rng.choice(list(b'0123456789-{}[]",.e')))
        path.write_bytes(noisy)
        try:
            SceneBuilder().add_file(path)
        except SceneBuildError:
            continue
