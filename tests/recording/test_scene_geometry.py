"""Geometry for the viewer: every visible shape is placed as in MuJoCo, in its frame, by the specification."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from anchors.pose import apply, compose
from iris_session.journal.messages import SceneAssets
from iris_session.protocol.scene import SceneSpec
from iris_session.protocol.server_messages import BodyInfo
from iris_session.recording import pack_model
from iris_session.scene import AssetMissingError, AssetStore
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.viewer import scene_geometry as scene
from tests.models import PANDA
from tests.recording.support import XML, make_header
from tests.scene.models import LOOKS, SHAPES, every_shape


def infos(model: mujoco.MjModel) -> list[BodyInfo]:
    return [
        BodyInfo(i, mujoco.mj_id2name(model, 1, i) or f"body{i}", int(model.body_weldid[i]) != 0)
        for i in range(1, model.nbody)
    ]


def test_nested_fixed_bodies_move_with_their_root(tmp_path: Path) -> None:
    """Both are rotated, so that their order matters."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="arm" pos="0 0 1" euler="20 30 0"><freejoint/><geom size=".1"/>
        <body name="wrist" pos=".1 .2 0" euler="90 0 20"><body name="hand" pos="0 .3 .1" euler="0 40 0">
        <geom size=".1" pos=".1 0 0"/></body></body></body></worldbody></mujoco>"""
    )
    store = AssetStore(tmp_path)
    spec = parse_mujoco(model, store).spec
    reader = scene.SceneReader(spec, store, [body for body in infos(model) if body.name == "arm"])
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    frame, T_arm_visual = reader.place_visual(spec.visuals[1])
    assert frame == "arm"
    T_world_arm = (tuple(data.xpos[1].tolist()), tuple(data.xquat[1].tolist()))
    assert apply(T_world_arm, T_arm_visual[0]) == pytest.approx(tuple(data.geom_xpos[1]))


def test_every_geom_of_a_real_robot_is_placed_as_in_mujoco(tmp_path: Path) -> None:
    """In another configuration than that of the specification."""
    model, store = mujoco.MjModel.from_xml_path(str(PANDA)), AssetStore(tmp_path)
    spec = parse_mujoco(model, store).spec
    reader = scene.SceneReader(spec, store, infos(model))
    data = mujoco.MjData(model)
    data.qpos[:] += np.linspace(-0.3, 0.3, model.nq)
    mujoco.mj_kinematics(model, data)
    visible = [visual for visual in spec.visuals if reader.is_shown(visual)]
    assert len(visible) > 10
    bodies = {body.name: body.id for body in infos(model)}
    for visual in visible:
        frame, T_frame_visual = reader.place_visual(visual)
        body = bodies.get(frame, 0)
        T_world_visual = compose((tuple(data.xpos[body]), tuple(data.xquat[body])), T_frame_visual)
        R = data.geom_xmat[visual.id].reshape(3, 3)
        point = R @ (0.1, 0.2, 0.3) + data.geom_xpos[visual.id]
        assert apply(T_world_visual, (0.1, 0.2, 0.3)) == pytest.approx(point, abs=1e-9)


def test_every_shape_has_its_texture(tmp_path: Path) -> None:
    model, store = every_shape(), AssetStore(tmp_path)
    spec = parse_mujoco(model, store).spec
    reader = scene.SceneReader(spec, store, infos(model))
    looks = set()
    for visual in spec.visuals:
        look = spec.materials[visual.material].name if visual.material >= 0 else ""
        looks.add((visual.geometry.kind, visual.geometry.mesh, look))
        form = reader.read_shape(visual)
        coordinates = visual.geometry.mesh >= 0 and spec.meshes[visual.geometry.mesh].textured
        worn = look in ("image", "uniform") or ("cube" in look and not coordinates)
        assert form.tint == (1.0, 1.0, 1.0)
        if worn:
            assert form.kind == scene.MESH
            assert form.texture is not None
            assert form.texture.shape[2] in (3, 4)
            assert max(form.texture.shape) <= scene.TEXTURE_SIDE
            assert form.mesh is not None
            assert form.uv is not None
            assert form.uv.shape == (form.mesh.vertices, 2)
            assert np.ptp(form.uv, axis=0).min() > 0
        else:
            assert (form.texture, form.uv) == (None, None)
        is_mesh = visual.geometry.mesh >= 0 or visual.geometry.hfield >= 0
        is_large = visual.geometry.kind in ("plane", "cylinder")
        assert (form.kind == scene.MESH) == (is_mesh or worn or is_large)
    assert len(looks) >= len(SHAPES) * len(LOOKS)


def test_specification_is_read_or_made_from_the_model(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(XML)
    store = AssetStore(tmp_path)
    parsed = parse_mujoco(model, store, name="shared")
    with scene.open_scene(SceneAssets(0, 0, str(tmp_path), parsed.scene_hash), b"") as (spec, _):
        assert spec.name == "shared"
    with scene.open_scene(SceneAssets(), make_header().model) as (spec, private):
        assert [visual.T_body_visual for visual in spec.visuals] == [v.T_body_visual for v in parsed.spec.visuals]
        assert isinstance(spec, SceneSpec)
        folder = private.root
        assert folder.exists()
    assert not folder.exists(), "nothing stays behind"


@pytest.mark.parametrize(
    ("assets", "model", "error"),
    [
        (True, b"", AssetMissingError),
        (False, pack_model(b"no model"), ValueError),
    ],
)
def test_unreadable_specification_is_reported(
    tmp_path: Path, assets: bool, model: bytes, error: type[Exception]
) -> None:
    missing = SceneAssets(0, 0, str(tmp_path), "0" * 64) if assets else SceneAssets()
    with pytest.raises(error), scene.open_scene(missing, model):
        pass
