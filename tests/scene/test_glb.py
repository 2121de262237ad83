"""GLB files: written completely or not at all, parts without a form in glTF, nothing hidden."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import pytest
import trimesh

from iris_session.protocol.scene import SceneSpec
from iris_session.scene import AssetStore, SceneBuildError
from iris_session.scene.builder import SceneBuilder
from iris_session.scene.glb import write_glb
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.scene.report import list_glb_differences
from tests.scene.test_shapes import document


def box(store: AssetStore) -> SceneSpec:
    scene = SceneBuilder("box")
    scene.add_box(half_size=(0.5, 0.5, 0.5))
    return scene.build(store).spec


def exported(spec: SceneSpec, store: AssetStore, tmp_path: Path) -> dict[str, Any]:
    write_glb(spec, store, tmp_path / "a.glb")
    return document(tmp_path / "a.glb")


def test_oversized_files_are_rejected(tmp_path: Path, store: AssetStore, monkeypatch: pytest.MonkeyPatch) -> None:
    spec = box(store)
    monkeypatch.setattr("iris_session.scene.glb._MAX_BYTES", 1000)
    with pytest.raises(SceneBuildError):
        write_glb(spec, store, tmp_path / "b.glb")
    assert not (tmp_path / "b.glb").exists()


def test_ropes_are_lines_and_hidden_parts_are_missing(tmp_path: Path, store: AssetStore) -> None:
    scene = SceneBuilder()
    scene.add_deformable("rope", [[0, 0, 1], [0.5, 0, 1], [1, 0, 1]], edges=[[0, 1], [1, 2]], rgba=(1, 0, 0, 1))
    corners, faces = [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]]
    scene.add_deformable("hidden", corners, faces, rgba=(1, 0, 0, 0))
    spec = scene.build(store).spec
    found = exported(spec, store, tmp_path)
    assert [node["name"] for node in found["nodes"] if "mesh" in node] == ["rope"]
    (rope,) = found["meshes"][0]["primitives"]
    assert rope["mode"] == 1
    assert found["accessors"][rope["indices"]]["count"] == 4
    assert any(difference.startswith("ropes") for difference in list_glb_differences(spec))
    (path,) = (one for one in trimesh.load_scene(tmp_path / "a.glb").geometry.values())
    assert path.length == pytest.approx(1.0)


def test_position_accessors_have_bounds_also_when_shared_with_normals(tmp_path: Path, store: AssetStore) -> None:
    scene = SceneBuilder()
    for name, radius in (("large", 2.0), ("unit", 1.0)):
        scene.add_sphere(name, radius=radius)
    found = exported(scene.build(store).spec, store, tmp_path)
    for mesh in found["meshes"]:
        assert {"min", "max"} <= found["accessors"][mesh["primitives"][0]["attributes"]["POSITION"]].keys()
    assert len(found["accessors"]) == 4, "the normals of both are one, and so are the triangles"


def test_dark_lights_are_left_out_and_orthographic_height_is_kept(tmp_path: Path, store: AssetStore) -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><light name="on" active="true"/><light name="off" active="false"/>'
        '<camera projection="orthographic" fovy="9" resolution="200 100"/></worldbody></mujoco>'
    )
    found = exported(parse_mujoco(model, store).spec, store, tmp_path)
    assert {"on", "off"} & {node["name"] for node in found["nodes"]} == {"on"}
    (lamp,) = found["extensions"]["KHR_lights_punctual"]["lights"]
    assert lamp["intensity"] == 1.0, "where the scene does not say"
    (camera,) = found["cameras"]
    assert (camera["orthographic"]["ymag"], camera["orthographic"]["xmag"]) == (4.5, 9.0), "half of 9 m, twice as wide"
