"""Scenes from shapes, arrays and files: body numbers, rejected arguments, the same hash in every process."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.media import MAX_STREAMS
from iris_session.protocol.scene import Environment, decode_scene
from iris_session.scene import AssetStore, SceneBuildError, decode_arrays, decode_mesh
from iris_session.scene.builder import SceneBuilder, check_mesh
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.streams.deformable import DeformableEncoder
from tests.scene.arm import write_arm
from tests.scene.importers.test_files import write_obj
from tests.scene.importers.test_gltf import furniture
from tests.scene.models import every_shape, flexes

TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])
SQUARE = np.array([[0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]], np.float64)


def full_scene(folder: Path) -> SceneBuilder:
    """Add something of everything."""
    scene = SceneBuilder("Lab")
    scene.add_plane(half_size=(2, 2), texture=np.arange(48, dtype=np.uint8).reshape(4, 4, 3), repeat=(3, 3))
    scene.add_box("shelf", half_size=(0.1, 0.2, 0.3), rgba=(1, 0, 0))
    scene.add_sphere("ball", radius=0.1, movable=True, position=(1, 2, 3), metallic=0.5, roughness=0.25)
    scene.add_capsule(radius=0.1, half_length=0.2, on="ball")
    scene.add_file(furniture(folder / "furniture.glb"), position=(0, 1, 0))
    scene.add_file(write_obj(folder), name="part", movable=True, scale=0.5)
    scene.add_urdf(write_arm(folder), name="arm", position=(0, 0, 0.8))
    scene.add_mesh("sheet", vertices=SQUARE, triangles=TRIANGLES, colors=np.uint8([[9, 8, 7]] * 3 + [[1, 2, 3]]))
    scene.add_deformable("cloth", SQUARE, TRIANGLES, rgba=(0, 1, 0, 1), uvs=SQUARE[:, :2])
    scene.add_deformable("rope", SQUARE, edges=TRIANGLES[:, :2], radius=0.01)
    scene.add_light("sun", direction=(0, 1, -1))
    scene.add_camera("eye", on="arm/link5", position=(0, 0, 0.1))
    scene.set_skybox(np.zeros((12, 2, 3), np.uint8))
    return scene


def test_moving_bodies_come_first_and_are_numbered_in_order(tmp_path: Path, store: AssetStore) -> None:
    made = full_scene(tmp_path).build(store)
    spec = made.spec
    assert decode_scene(store.get(made.scene_hash)) == spec
    assert made.moving == ("ball", "part", *made.articulations["arm"].bodies)
    moving = spec.bodies[1 : len(made.moving) + 1]
    assert [body.id for body in spec.bodies] == list(range(len(spec.bodies)))
    assert tuple(body.name for body in moving) == made.moving
    assert all(body.moving and body.parent == 0 for body in moving)
    assert made.poses == tuple(body.T_world_body for body in moving)
    assert made.poses[0] == Pose((1.0, 2.0, 3.0), IDENTITY.q)
    assert made.poses[2] == Pose((0.0, 0.0, 0.8), IDENTITY.q)
    assert not any(body.moving for body in spec.bodies[len(moving) + 1 :])
    assert [visual.id for visual in spec.visuals] == list(range(len(spec.visuals)))
    on_ball = [visual.geometry.kind for visual in spec.visuals if visual.body == 1]
    assert on_ball == ["sphere", "capsule"]
    assert spec.bodies[spec.cameras[0].body].name == "arm/link5"
    assert all(store.get(address) for address in made.addresses)
    assert spec.textures[spec.environment.skybox].kind == "skybox"
    assert spec.textures[spec.environment.skybox].height == 2


def test_a_scene_without_lights_is_legible(store: AssetStore) -> None:
    """A white surface that faces both lights is white; one that faces neither is not dark."""
    scene = SceneBuilder("part")
    scene.add_box(half_size=(1, 1, 1))
    spec = scene.build(store).spec
    headlight, (light,) = spec.environment.headlight, spec.lights
    assert headlight.active
    assert light.castshadow
    assert min(headlight.ambient) >= 0.3
    assert sum(max(part) for part in (headlight.ambient, headlight.diffuse, light.diffuse)) == pytest.approx(1.0)
    scene.add_light("sun")
    lit = scene.build(store).spec
    assert [light.name for light in lit.lights] == ["sun"]
    assert lit.environment.headlight == Environment().headlight
    dark = SceneBuilder("dark")
    dark.environment = Environment()
    assert dark.build(store).spec.lights == ()


@pytest.mark.long
def test_every_process_builds_the_same_scenes(tmp_path: Path) -> None:
    """With another number of threads, another order of sets, and a cold store; a warm one builds nothing."""
    code = (
        "import sys; from pathlib import Path; from tests.scene.test_builder import build_scenes; "
        "folder = Path(sys.argv[1]); folder.mkdir(); print(*build_scenes(folder, threads=3))"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "12345", "PYTHONPATH": str(Path(__file__).parents[2])}
    command = [sys.executable, "-c", code, str(tmp_path / "other")]
    other = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    (tmp_path / "here").mkdir()
    assert other.stdout.split() == build_scenes(tmp_path / "here", threads=1)
    (tmp_path / "here" / "arm_description").rename(tmp_path / "before")
    again = full_scene(tmp_path / "here").build(AssetStore(tmp_path / "here" / "store"))
    assert again.built == 0 < again.recalled


def build_scenes(folder: Path, threads: int) -> list[str]:
    """Return the hashes of scenes with everything, composed and of MuJoCo models."""
    store = AssetStore(folder / "store")
    composed = full_scene(folder).build(store, threads=threads)
    models = (every_shape(), flexes())
    return [
        composed.scene_hash,
        *(parse_mujoco(model, store, threads=threads, sites=True).scene_hash for model in models),
    ]


def test_looks(store: AssetStore) -> None:
    scene = SceneBuilder()
    scene.add_sphere(radius=1, rgba=(1, 1, 0))
    scene.add_sphere(radius=1, metallic=1.0, roughness=0.25)
    scene.add_sphere(radius=1, metallic=1.0, roughness=0.25)
    picture = np.zeros((2, 2, 4), np.uint8)
    scene.add_box(half_size=(1, 1, 1), texture=picture, repeat=(2, 3), uniform=True)
    scene.add_box(half_size=(1, 1, 1), texture=picture.copy(), rgba=(1, 0, 0))
    spec = scene.build(store).spec
    assert spec.visuals[0].material == -1
    assert spec.visuals[1].material == spec.visuals[2].material
    material = spec.materials[spec.visuals[1].material]
    assert (material.metallic, material.roughness, material.shininess) == (1.0, 0.25, 0.75)
    assert len(spec.textures) == 1
    first, second = (spec.materials[visual.material] for visual in spec.visuals[3:])
    assert (first.repeat, first.uniform, first.rgba) == ((2.0, 3.0), True, (1.0, 1.0, 1.0, 1.0))
    assert second.find_texture("rgba") == 0
    assert second.rgba == (1.0, 0.0, 0.0, 1.0)


def test_meshes_given_as_arrays(store: AssetStore) -> None:
    scene = SceneBuilder()
    picture = np.zeros((2, 2, 3), np.uint8)
    colors = np.uint8([[1, 2, 3], [4, 5, 6], [7, 8, 9], [10, 11, 12]])
    uvs = SQUARE[:, :2]
    scene.add_mesh(vertices=SQUARE, triangles=TRIANGLES, uvs=uvs, texture=picture)
    scene.add_mesh(vertices=SQUARE, triangles=TRIANGLES, uvs=uvs)
    scene.add_mesh(vertices=SQUARE, triangles=TRIANGLES, colors=colors, normals=np.tile([0, 0, -2.0], (4, 1)))
    spec = scene.build(store).spec
    painted, plain, colored = (decode_mesh(store.get(mesh.levels[0].address)) for mesh in spec.meshes)
    assert painted.uv is not None
    np.testing.assert_array_equal(painted.uv, painted.position[:, :2])
    np.testing.assert_array_equal(painted.normal, np.tile(np.float32([0, 0, 1]), (4, 1)))
    assert plain.uv is None  # without a texture they are unused
    assert colored.color is not None
    assert colored.color.tolist() == [[*color, 255] for color in colors.tolist()]
    np.testing.assert_array_equal(colored.normal, np.tile(np.float32([0, 0, -1]), (4, 1)))
    assert spec.visuals[2].rgba == (1.0, 1.0, 1.0, 1.0)
    assert spec.visuals[1].rgba == (0.5, 0.5, 0.5, 1.0)


def test_deformables_fit_their_stream(store: AssetStore) -> None:
    scene = SceneBuilder()
    scene.add_deformable("cloth", SQUARE, TRIANGLES, rgba=(0, 1, 0, 1), radius=0.002)
    scene.add_deformable("rope", SQUARE, edges=[[0, 1], [1, 2]])
    made = scene.build(store)
    for name, entry in zip(("cloth", "rope"), made.spec.deformables, strict=True):
        source = made.deformables[name]
        assert (entry.name, entry.stream) == (name, source.stream)
        arrays = decode_arrays(store.get(entry.address), "deformable")
        assert bytes(arrays["plan"]) == source.topology.to_bytes()
        np.testing.assert_array_equal(arrays["position"], source.vertices)
        assert DeformableEncoder(source.topology, 0.0005).encode(source.vertices.astype(np.float64)) is not None
        assert not source.vertices.flags.writeable
    assert [entry.dim for entry in made.spec.deformables] == [2, 1]
    assert made.spec.deformables[0].rgba == (0.0, 1.0, 0.0, 1.0)
    assert made.spec.environment.center == (0.5, 0.5, 1.0)


def test_surroundings(store: AssetStore) -> None:
    scene = SceneBuilder()
    assert scene.build(store).spec.environment == Environment()
    scene.add_box(half_size=(30, 40, 1), position=(1, 2, 3))
    found = scene.build(store).spec.environment
    assert found.center == (1.0, 2.0, 3.0)
    assert found.extent == pytest.approx(np.linalg.norm([30, 40, 1]))
    assert found.zfar == pytest.approx(10 * found.extent)
    scene.environment = Environment(extent=2.0)
    assert scene.build(store).spec.environment == Environment(extent=2.0)


BOX = {"half_size": (1, 1, 1)}


@pytest.mark.parametrize(
    ("method", "arguments", "named"),
    [
        ("add_box", {**BOX, "name": "cup", "movable": True}, "'cup'"),
        ("add_box", {**BOX, "name": "world", "movable": True}, "name is 'world'"),
        ("add_box", {**BOX, "name": None}, "name is None"),
        ("add_box", {**BOX, "name": "x" * 65, "movable": True}, "64"),
        ("add_box", {**BOX, "name": "b", "movable": True, "on": "cup"}, "'cup'"),
        ("add_box", {**BOX, "on": "cap"}, "on='cap'"),
        ("add_box", {"half_size": (1, 1, 0)}, "half_size is (1, 1, 0)"),
        ("add_box", {"half_size": ("1", "1", "1")}, "half_size is ('1', '1', '1')"),
        ("add_box", {**BOX, "position": (0, 0)}, "position is (0, 0)"),
        ("add_box", {**BOX, "quaternion": (0, 0, 0, 0)}, "quaternion is (0, 0, 0, 0)"),
        ("add_box", {**BOX, "rgba": (2, 0, 0, 1)}, "rgba is (2, 0, 0, 1)"),
        ("add_box", {**BOX, "texture": np.zeros((2, 2, 3))}, "float64"),
        ("add_box", {**BOX, "texture": "/tmp"}, "texture is '/tmp'"),
        ("add_sphere", {"radius": float("inf")}, "radius is inf"),
        ("add_sphere", {"radius": 1, "roughness": 5}, "roughness is 5"),
        ("add_plane", {"half_size": (-1, 0)}, "half_size"),
        ("add_mesh", {"name": "x", "vertices": SQUARE, "triangles": [[0, 1, 4]]}, "triangles of mesh 'x': vertex 4"),
        ("add_mesh", {"name": "x", "vertices": SQUARE * np.nan, "triangles": TRIANGLES}, "vertices of mesh 'x'"),
        ("add_mesh", {"vertices": SQUARE, "triangles": TRIANGLES, "uvs": SQUARE[:2, :2]}, "uvs of mesh"),
        ("add_mesh", {"vertices": SQUARE, "triangles": TRIANGLES, "colors": SQUARE}, "colors of mesh"),
        ("add_deformable", {"name": "d", "vertices": SQUARE}, "'d'"),
        ("add_deformable", {"name": "d", "vertices": SQUARE, "triangles": TRIANGLES, "radius": 0}, "radius is 0"),
        ("add_deformable", {"name": "d", "vertices": SQUARE, "edges": TRIANGLES}, "edges of deformable 'd'"),
        ("add_light", {"kind": "laser"}, "kind is 'laser'"),
        ("add_light", {"direction": (0, 0, 0)}, "direction"),
        ("add_camera", {"fovy": 180}, "fovy is 180"),
        ("set_skybox", {"pixels": np.zeros((5, 2, 3), np.uint8)}, "skybox"),
        ("add_file", {"path": "/lost.glb"}, "/lost.glb"),
        ("add_file", {"path": "https://x/a.glb"}, "a.glb"),
        ("add_urdf", {"path": "/lost.urdf", "name": "cup"}, "'cup'"),
    ],
)
def test_invalid_arguments_are_named_and_add_nothing(
    store: AssetStore, method: str, arguments: dict[str, object], named: str
) -> None:
    scene = SceneBuilder()
    scene.add_box("cup", half_size=(1, 1, 1), movable=True)
    before = scene.build(store).scene_hash
    with pytest.raises(SceneBuildError, match=re.escape(named)):
        getattr(scene, method)(**arguments)
    with pytest.raises(TypeError, match="'colour'"):
        scene.add_box(half_size=(1, 1, 1), colour=(1, 0, 0))
    assert scene.build(store).scene_hash == before


def test_scenes_that_clients_would_reject_are_rejected(store: AssetStore, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(scene: SceneBuilder, text: str) -> None:
        with pytest.raises(SceneBuildError, match=text):
            scene.build(store)

    scene = SceneBuilder()
    scene.add_camera(resolution="big")  # type: ignore[arg-type]
    refused(scene, "cannot be drawn: Expected `array`.*resolution")
    scene = SceneBuilder()
    scene.environment = Environment(fog_end=float("inf"))
    refused(scene, "cannot be drawn: Expected `float`.*fog_end")
    scene.environment = Environment(skybox=7)
    refused(scene, "texture 7")
    scene = SceneBuilder()
    scene.add_mesh(vertices=SQUARE * 2e6, triangles=TRIANGLES)
    refused(scene, "scale it to metres")
    scene = SceneBuilder()
    scene.add_box(half_size=(1, 1, 1))
    monkeypatch.setattr("iris_session.protocol.scene.MAX_SCENE_BYTES", 100)
    refused(scene, "1 visuals, 1 bodies.*join what stands still")


def test_number_of_deformables_is_bounded_by_the_streams(store: AssetStore) -> None:
    scene = SceneBuilder()
    for k in range(MAX_STREAMS):
        scene.add_deformable(f"cloth {k}", SQUARE, TRIANGLES)
    with pytest.raises(SceneBuildError, match="16 are streamed"):
        scene.add_deformable("one more", SQUARE, TRIANGLES)
    assert len(scene.build(store).deformables) == MAX_STREAMS


def test_a_mesh_that_is_added_often_is_sent_once_per_scale(tmp_path: Path) -> None:
    scene = SceneBuilder()
    scene.add_body("part", position=(1, 0, 0))
    mesh = check_mesh("square", SQUARE, TRIANGLES, None, None, None)
    scene.add_mesh_arrays("a", mesh, on="part")
    scene.add_mesh_arrays("b", mesh, transform=np.diag([1.0, 1.0, 1.0, 1.0]), position=(0, 0, 2), rgba=(1, 0, 0))
    scene.add_mesh_arrays("c", mesh, transform=np.diag([2.0, 1.0, 1.0, 1.0]))
    made = scene.build(AssetStore(tmp_path))
    assert made.moving == ("part",)
    assert len(made.spec.meshes) == 2
    assert [visual.rgba[:3] for visual in made.spec.visuals] == [(0.5, 0.5, 0.5), (1.0, 0.0, 0.0), (0.5, 0.5, 0.5)]
    with pytest.raises(SceneBuildError, match="scaled to nothing"):
        scene.add_mesh_arrays("flat", mesh, transform=np.diag([1.0, 1.0, 0.0, 1.0]))
    with pytest.raises(SceneBuildError, match="another name"):
        scene.add_body("part")
