"""Parsing of a model: tree, shapes, materials, names, lights, cameras, deformables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from iris_session.physics import World
from iris_session.protocol.scene import SceneSpec, decode_scene, encode_scene
from iris_session.scene import AssetStore, EncodeOptions, decode_arrays
from iris_session.scene.mujoco_scene import ParsedScene, parse_mujoco
from iris_session.scene.nodes import to_matrix
from tests.models import MENAGERIE
from tests.scene.models import every_shape, flexes


def parse(xml: str, folder: Path, **options: Any) -> ParsedScene:
    return parse_mujoco(mujoco.MjModel.from_xml_string(xml), AssetStore(folder), **options)


#: MuJoCo draws a geom in the frame of its body where no component of position and quaternion differs by 1e-6 or more:
#: m, and radians in a matrix (three parts of a quaternion, each of them half an angle).
TAKEN_FOR_ONE = 4e-6


def check_tree(model: mujoco.MjModel, spec: SceneSpec) -> None:
    """Assert that the specification agrees with the stream, and that its poses compose to MuJoCo's."""
    streamed = {info.id: info for info in World(model, (), ()).bodies}
    by_id = {body.id: body for body in spec.bodies}
    assert set(streamed) == set(by_id) - {0}
    assert all(by_id[i].moving == info.moving for i, info in streamed.items())
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for body in spec.bodies:
        assert body.T_world_body.p == pytest.approx(data.xpos[body.id])
        assert body.parent < body.id
    at, rotation, local = np.zeros(3), np.zeros(9), np.zeros(4)
    for visual in spec.visuals:
        pose, own = by_id[visual.body].T_world_body, visual.T_body_visual
        mujoco.mju_rotVecQuat(at, np.array(own.p), np.array(pose.q))
        off = TAKEN_FOR_ONE if model.geom_sameframe[visual.id] else 1e-9
        assert at + pose.p == pytest.approx(data.geom_xpos[visual.id], abs=off)
        mujoco.mju_mulQuat(local, np.array(pose.q), np.array(own.q))
        mujoco.mju_quat2Mat(rotation, local)
        assert rotation == pytest.approx(data.geom_xmat[visual.id], abs=off)


@pytest.mark.parametrize("name", ["shapes", "google_barkour_vb"])
def test_poses_colours_and_sizes_agree_with_mujoco(tmp_path: Path, name: str) -> None:
    model = every_shape() if name == "shapes" else mujoco.MjModel.from_xml_path(str(MENAGERIE / name / "scene.xml"))
    spec = parse_mujoco(model, AssetStore(tmp_path), options=EncodeOptions(levels=False)).spec
    assert decode_scene(encode_scene(spec)) == spec
    check_tree(model, spec)
    scene = mujoco.MjvScene(model, 500)
    option = mujoco.MjvOption()
    option.geomgroup[:] = 1
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mujoco.mjv_updateScene(model, data, option, None, mujoco.MjvCamera(), 7, scene)
    drawn = {geom.objid: geom for geom in scene.geoms[: scene.ngeom] if geom.objtype == int(mujoco.mjtObj.mjOBJ_GEOM)}
    assert {visual.id for visual in spec.visuals if visual.rgba[3] > 0} == set(drawn)
    for visual in spec.visuals:
        if visual.id in drawn and visual.geometry.kind not in ("mesh", "sdf", "hfield", "plane"):
            assert visual.rgba == pytest.approx(drawn[visual.id].rgba)
            assert visual.geometry.size == pytest.approx(drawn[visual.id].size)


def test_flexes_become_deformables_without_their_bodies(tmp_path: Path) -> None:
    store = AssetStore(tmp_path)
    model = flexes()
    spec = parse_mujoco(model, store).spec
    assert [(d.name, d.dim, d.vertices, d.stream) for d in spec.deformables] == [
        ("cloth", 2, 20, "flex-0"),
        ("rope", 1, 6, "flex-1"),
        ("soft", 3, 56, "flex-2"),
    ]
    assert [deformable.material for deformable in spec.deformables] == [0, -1, -1]
    assert {info.id for info in World(model, (), ()).bodies} | {0} == {body.id for body in spec.bodies}
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for index, deformable in enumerate(spec.deformables):
        arrays = decode_arrays(store.get(deformable.address), "deformable")
        first, count = int(model.flex_vertadr[index]), int(model.flex_vertnum[index])
        expected = data.flexvert_xpos[first : first + count][arrays.get("vertex", np.arange(count))]
        assert np.unique(arrays["elements"]).tolist() == list(range(deformable.vertices)), "nothing but what is drawn"
        assert arrays["position"] == pytest.approx(expected, abs=1e-6)
        assert arrays["elements"].shape == (deformable.elements, 2 if deformable.dim == 1 else 3)
        assert arrays["elements"].max() < deformable.vertices
    assert decode_arrays(store.get(spec.deformables[0].address), "deformable")["uv"].shape == (24, 3, 2)


def test_sites_and_tendons_are_optional(tmp_path: Path) -> None:
    xml = """<mujoco><worldbody><body><joint/><geom size=".1"/><site name="a" size=".01"/></body>
    <site name="b" pos="1 0 0" type="box" size=".01 .02 .03"/><site name="c"/></worldbody>
    <tendon><spatial name="t" width=".02" rgba="1 0 0 1"><site site="a"/><site site="b"/></spatial></tendon></mujoco>"""
    left_out = parse(xml, tmp_path)
    assert [text.partition(":")[0] for text in left_out.skipped] == ["3 sites", "1 tendons"]
    tendons, both = (parse(xml, tmp_path, sites=sites, tendons=True).spec for sites in (False, True))
    plain = left_out.spec
    assert (plain.sites, plain.tendons) == ((), ())
    assert [site.name for site in tendons.sites] == ["b", "a"]
    assert [site.name for site in both.sites] == ["b", "c", "a"]
    assert (tendons.tendons[0].width, len(tendons.tendons[0].sites)) == (0.02, 2)


WATCHED_CLOTH = """<mujoco><worldbody>
    <body name="hand" mocap="true"><geom size=".1"/><body name="ring" pos="0 0 .2"><geom size=".05"/></body></body>
    <body name="table"><geom size=".1"/></body>
    <body name="swing"><joint/><geom size=".1"/><body name="seat"><geom size=".1"/></body></body>
    <flexcomp name="cloth" type="grid" count="3 3 1" spacing=".1 .1 .1" pos="0 0 1" radius=".01" dim="2">
      <edge equality="true"/></flexcomp>
    <camera name="watch" pos="0 -1 1" mode="targetbody" target="cloth_4"/>
    <light mode="targetbody" target="cloth_7" pos="0 0 3"/>
  </worldbody></mujoco>"""


@pytest.mark.parametrize("older", [False, True], ids=["as it is", "as before MuJoCo 3.4"])
def test_bodies_agree_with_the_state_stream(tmp_path: Path, older: bool) -> None:
    """A body that one side leaves out and the other moves would never move for clients."""
    parts = mujoco.MjSpec.from_string(WATCHED_CLOTH)
    parts.body("cloth_1").add_site(name="tip")
    model = parts.compile()
    if older:
        model.body_weldid[1:3] = 0  # of a mocap body and its fixed children
    spec = parse_mujoco(model, AssetStore(tmp_path)).spec
    streamed = [(info.id, info.moving) for info in World(model, (), ()).bodies]
    assert [(body.id, body.moving) for body in spec.bodies] == [(0, False), *streamed]
    named = {body.name: body.moving for body in spec.bodies}
    assert named == {
        "world": False,
        "hand": True,
        "ring": True,
        "table": False,
        "swing": True,
        "seat": True,
        "cloth_1": True,
        "cloth_4": True,
        "cloth_7": True,
    }
    targets = {spec.cameras[0].target, spec.lights[0].target}
    assert targets == {body.id for body in spec.bodies if body.name in ("cloth_4", "cloth_7")}
    assert decode_scene(encode_scene(spec)) == spec


def test_skins_and_flexes_beyond_the_streams_are_reported(tmp_path: Path) -> None:
    ropes = "".join(
        f'<flexcomp name="{k}" type="grid" dim="1" count="2 1 1" spacing=".1 .1 .1" pos="0 {k} 1" radius=".01">'
        '<edge equality="true"/></flexcomp>'
        for k in range(18)
    )
    xml = f"""<mujoco><deformable><skin name="s" vertex="0 0 0 1 0 0 0 1 0" face="0 1 2">
    <bone body="b" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin></deformable>
    <worldbody><body name="b"><geom size=".1"/></body>{ropes}</worldbody></mujoco>"""
    skins, flexes = parse(xml, tmp_path).skipped
    assert "1 skins" in skins
    assert "2 of 18 flexes" in flexes


def test_tracking_cameras_have_their_initial_pose(tmp_path: Path) -> None:
    """They do not rotate with their body, so their pose in the body's frame depends on the initial state."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="t" pos="1 2 3" euler="10 20 30"><freejoint/><geom size=".1"/>
        <geom size=".1" pos="1 0 0"/>
        <camera mode="track" pos="0 -3 0" xyaxes="1 0 0 0 0 1"/><camera mode="trackcom" pos="0 -3 0" euler="0 50 0"/>
        <camera pos="1 2 3"/><light mode="trackcom" pos="0 0 2" dir="1 0 -1"/><light mode="track" pos="0 0 2"/></body>
        </worldbody></mujoco>"""
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    plain = parse_mujoco(model, AssetStore(tmp_path))
    assert parse_mujoco(model, AssetStore(tmp_path), data=data).scene_hash == plain.scene_hash
    data.qpos[:] = (0, 0, 1, 0.5, 0.5, 0.5, 0.5)
    mujoco.mj_kinematics(model, data)
    spec = parse_mujoco(model, AssetStore(tmp_path), data=data).spec
    mujoco.mj_forward(model, data)
    T_world = {body.id: to_matrix(body.T_world_body) for body in spec.bodies}
    for k, camera in enumerate(spec.cameras):
        T = T_world[camera.body] @ to_matrix(camera.T_body_camera)
        np.testing.assert_allclose(T[:3, 3], data.cam_xpos[k], atol=1e-9)
        np.testing.assert_allclose(T[:3, :3], data.cam_xmat[k].reshape(3, 3), atol=1e-9)
    for k, light in enumerate(spec.lights):
        T = T_world[light.body]
        np.testing.assert_allclose((T @ [*light.p_body, 1.0])[:3], data.light_xpos[k], atol=1e-9)
        np.testing.assert_allclose(T[:3, :3] @ light.direction_body, data.light_xdir[k], atol=1e-9)
