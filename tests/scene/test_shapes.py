"""Triangles of shapes are on MuJoCo's surfaces, and a GLB of a scene equals that scene."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
import trimesh

from iris_session.cli.main import main
from iris_session.protocol.scene import Geometry, HeightField
from iris_session.scene import AssetStore
from iris_session.scene.glb import write_glb
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.scene.shapes import build_height_field, build_primitive
from tests.scene.models import every_shape

#: How far a face's centre lies below the round surface it stands for, and how far above it a ray begins [m].
SAG, ABOVE = 0.008, 0.02
GROUPS = np.array([1, 1, 1, 0, 0, 0], np.uint8)


def document(path: Path) -> dict[str, Any]:
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    found: dict[str, Any] = json.loads(data[20 : 20 + size])
    return found


def hit(model: mujoco.MjModel, data: mujoco.MjData, point: np.ndarray, direction: np.ndarray) -> float:
    geom = np.zeros(1, np.int32)
    return float(mujoco.mj_ray(model, data, point, direction, GROUPS, 1, -1, geom))


def test_faces_of_a_glb_are_on_mujoco_surfaces(tmp_path: Path) -> None:
    model = every_shape()
    store = AssetStore(tmp_path)
    path = tmp_path / "scene.glb"
    assert write_glb(parse_mujoco(model, store).spec, store, path) == path.stat().st_size
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    whole = trimesh.load(path).to_geometry()
    z_up = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])  # back from glTF
    rng = np.random.default_rng(0)
    large = np.where(whole.area_faces > 1e-6, whole.area_faces, 0.0)
    chosen = rng.choice(len(large), 600, replace=False, p=large / large.sum())
    centres, normals = whole.triangles_center[chosen] @ z_up.T, whole.face_normals[chosen] @ z_up.T
    gaps = np.array([hit(model, data, c + ABOVE * n, -n) for c, n in zip(centres, normals, strict=True)]) - ABOVE
    assert np.mean((gaps > -SAG) & (gaps < 1e-3)) > 0.98  # a ray may pass where two shapes' edges meet


@pytest.mark.parametrize("kind", ["sphere", "ellipsoid", "capsule", "cylinder", "box", "hfield"])
def test_shapes_are_closed_and_face_outwards(kind: str) -> None:
    if kind == "hfield":
        elevation = np.random.default_rng(0).uniform(0.1, 1, (5, 7)).astype(np.float32)
        mesh = build_height_field(HeightField("", 5, 7, (1.0, 2.0, 0.5, 0.1), "0" * 64, 0), elevation)
        cells = (elevation[:-1, :-1] + elevation[1:, :-1] + elevation[:-1, 1:] + elevation[1:, 1:]) / 4
        exact = 4 * 2 * (0.1 + 0.5 * float(cells.mean()))
    else:
        round_ = {"sphere": (0.3, 0.3, 0.3), "capsule": (0.2, 0.2, 0.5), "cylinder": (0.2, 0.2, 0.5)}
        size = round_.get(kind, (0.1, 0.2, 0.3))
        made = build_primitive(Geometry(kind, size))
        assert made is not None
        mesh, (x, y, z) = made, size
        ball, tube = 4 / 3 * np.pi * x * y * (x if kind == "capsule" else z), 2 * np.pi * x * x * z
        exact = {"capsule": ball + tube, "cylinder": tube, "box": 8 * x * y * z}.get(kind, ball)
    solid = trimesh.Trimesh(mesh.position.round(6), mesh.index)
    solid.merge_vertices(merge_norm=True, merge_tex=True)
    assert solid.is_watertight or kind == "hfield"  # its floor has no vertices at those of the walls
    assert solid.is_winding_consistent
    assert solid.volume == pytest.approx(exact, rel=0.03)
    across = np.cross(*(mesh.position[mesh.index[:, k]] - mesh.position[mesh.index[:, 0]] for k in (1, 2)))
    assert np.einsum("fkc,fc->fk", mesh.normal[mesh.index], across).min() > 0


def test_scene_is_exported_in_its_initial_state(tmp_path: Path) -> None:
    """In the keyframe `home`, where joints are not at zero."""
    model = tmp_path / "arm.xml"
    model.write_text(
        """<mujoco><worldbody><body name="upper" pos="0 0 1" euler="0 0 30"><joint name="a" axis="0 1 0"/>
        <geom size=".1"/><body name="lower" pos=".5 0 0"><joint name="b" axis="1 0 0"/><geom size=".1"/>
        <body name="tool" pos="0 .3 0" euler="40 0 0"><geom type="box" size=".1 .2 .3"/></body></body></body>
        </worldbody><keyframe><key name="zero" qpos="0 0"/><key name="home" qpos=".7 -1.1"/></keyframe></mujoco>"""
    )
    out = tmp_path / "arm.glb"
    assert main(["scene", "export", str(model), str(out), "--assets", str(tmp_path / "assets")]) == 0
    scene = trimesh.load_scene(out)
    compiled = mujoco.MjModel.from_xml_path(str(model))
    data = mujoco.MjData(compiled)
    mujoco.mj_resetDataKeyframe(compiled, data, 1)
    mujoco.mj_kinematics(compiled, data)
    y_up = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    for name in ("upper", "lower", "tool"):
        T_world_body = np.eye(4)
        T_world_body[:3, :3] = data.body(name).xmat.reshape(3, 3)
        T_world_body[:3, 3] = data.body(name).xpos
        np.testing.assert_allclose(scene.graph[name][0], y_up @ T_world_body, atol=1e-6)
