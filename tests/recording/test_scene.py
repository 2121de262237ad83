"""Geometry for the viewer: every visible geom stands where MuJoCo has it, in its frame."""

from __future__ import annotations

import os
from pathlib import Path

import mujoco
import numpy as np
import pytest

from anchors.pose import apply, compose
from iris_session.protocol.server_messages import BodyInfo
from iris_session.recording import scene, unpack_model
from tests.recording.support import XML, make_header

DATA = Path(os.environ.get("IRIS_DATA", Path(__file__).parents[3] / "shared"))


def infos(model: mujoco.MjModel) -> list[BodyInfo]:
    return [
        BodyInfo(i, mujoco.mj_id2name(model, 1, i) or f"body{i}", int(model.body_weldid[i]) != 0)
        for i in range(1, model.nbody)
    ]


def test_the_small_scene() -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    shapes = {shape.name: shape for shape in scene.shapes(model, infos(model))}
    assert set(shapes) == {"floor", "g/ball", "geom2", "geom3", "geom4", "geom5"}, "group 3 is not visible"
    assert (shapes["floor"].frame, shapes["floor"].kind, shapes["floor"].size[:2]) == ("world", scene.BOX, (10.0, 10.0))
    assert shapes["floor"].rgba == (204, 204, 204, 255)
    assert shapes["g/ball"].frame == "ball"
    assert (shapes["geom2"].kind, shapes["geom2"].frame) == (scene.CAPSULE, "arm/link 1")
    assert shapes["geom4"].frame == "tip"


def test_a_body_that_is_not_streamed_is_drawn_in_its_parents_frame() -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    bodies = [body for body in infos(model) if body.name != "tip"]
    tip = next(shape for shape in scene.shapes(model, bodies) if shape.name == "geom4")
    assert tip.frame == "arm/link 1"
    assert tip.p == pytest.approx((0.4, 0.0, 0.0))


@pytest.mark.parametrize("path", ["aloha/scene.xml", "kuka_iiwa_14/scene.xml"])
def test_every_geom_of_real_robots_is_where_mujoco_has_it(path: str) -> None:
    """In another configuration than the one that the shapes were made in; meshes vertex by vertex."""
    model = mujoco.MjModel.from_xml_path(str(DATA / "models" / path))
    shapes = scene.shapes(model, infos(model))
    data = mujoco.MjData(model)
    data.qpos[:] += np.linspace(-0.3, 0.3, model.nq)
    mujoco.mj_kinematics(model, data)
    visible = [
        g
        for g in range(model.ngeom)
        if model.geom_group[g] < 3 and scene._rgba(model, g)[3] and int(model.geom_type[g]) in scene._PRIMITIVES
    ]
    assert len(visible) == len(shapes) > 10
    for geom, shape in zip(visible, shapes, strict=True):
        body = 0 if shape.frame == "world" else mujoco.mj_name2id(model, 1, shape.frame)
        body = int(shape.frame.removeprefix("body")) if body < 0 else body
        T_world_frame = (tuple(data.xpos[body]), tuple(data.xquat[body]))
        T_world_geom = compose(T_world_frame, (shape.p, shape.q))
        assert T_world_geom[0] == pytest.approx(data.geom_xpos[geom], abs=1e-9)
        R = data.geom_xmat[geom].reshape(3, 3)
        point = R @ (0.1, 0.2, 0.3) + data.geom_xpos[geom]
        assert apply(T_world_geom, (0.1, 0.2, 0.3)) == pytest.approx(point, abs=1e-9)
        if shape.kind == scene.MESH:
            assert shape.vertices.shape == shape.normals.shape
            assert shape.faces.min() == 0
            assert shape.faces.max() == len(shape.vertices) - 1


def test_mesh_corners_keep_position_and_winding() -> None:
    model = mujoco.MjModel.from_xml_path(str(DATA / "models/kuka_iiwa_14/scene.xml"))
    shape = next(s for s in scene.shapes(model, infos(model)) if s.kind == scene.MESH)
    triangles = shape.vertices[shape.faces]
    geometric = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    mean = shape.normals[shape.faces].mean(axis=1)
    agree = (geometric * mean).sum(axis=1)
    assert (agree > 0).mean() > 0.98, "normals point out of the counter-clockwise side"


def test_a_model_survives_the_header() -> None:
    model = scene.load_model(unpack_model(make_header().model))
    assert model.nbody == mujoco.MjModel.from_xml_string(XML).nbody
    with pytest.raises(ValueError):
        scene.load_model(b"no model")
