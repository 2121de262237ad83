"""Parsing of a model: tree, shapes, materials, names, lights, cameras, deformables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from iris_session.physics import World
from iris_session.protocol.scene import FIRST_SITE_VISUAL, SceneSpec, decode_scene, encode_scene
from iris_session.scene import AssetStore, EncodeOptions, decode_arrays
from iris_session.scene.mujoco_deformables import read_drawn_meshes
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
        kind, index = ("geom", visual.id) if visual.id < FIRST_SITE_VISUAL else ("site", visual.id - FIRST_SITE_VISUAL)
        pose, own = by_id[visual.body].T_world_body, visual.T_body_visual
        mujoco.mju_rotVecQuat(at, np.array(own.p), np.array(pose.q))
        off = TAKEN_FOR_ONE if getattr(model, f"{kind}_sameframe")[index] else 1e-9
        assert at + pose.p == pytest.approx(getattr(data, f"{kind}_xpos")[index], abs=off)
        mujoco.mju_mulQuat(local, np.array(pose.q), np.array(own.q))
        mujoco.mju_quat2Mat(rotation, local)
        assert rotation == pytest.approx(getattr(data, f"{kind}_xmat")[index], abs=off)


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
    first = {int(mujoco.mjtObj.mjOBJ_GEOM): 0, int(mujoco.mjtObj.mjOBJ_SITE): FIRST_SITE_VISUAL}
    drawn = {first[one.objtype] + one.objid: one for one in scene.geoms[: scene.ngeom] if one.objtype in first}
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


MARKED = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" group="2"/>
  <body name="arm"><joint/><geom name="link" size=".1" group="1"/><site name="grip" size=".01" group="3"/></body>
  <site name="goal" pos="1 0 0" type="box" size=".01 .02 .03" group="0" rgba="0 1 0 .5"/></worldbody></mujoco>"""


def list_shown(parsed: ParsedScene) -> set[str]:
    return {one.name for one in parsed.spec.visuals if one.group in parsed.spec.groups_shown}


@pytest.mark.parametrize(
    ("options", "shown"),
    [
        ({}, {"floor", "link", "goal"}),
        ({"groups": [2]}, {"floor", "goal"}),
        ({"groups": (1, 4), "sites": [3]}, {"link", "grip"}),
        ({"sites": True}, {"floor", "link", "goal", "grip"}),
        ({"sites": False}, {"floor", "link"}),
    ],
)
def test_groups_of_geoms_and_sites_are_chosen(tmp_path: Path, options: dict[str, Any], shown: set[str]) -> None:
    parsed = parse(MARKED, tmp_path, **options)
    assert list_shown(parsed) == shown
    assert decode_scene(encode_scene(parsed.spec)) == parsed.spec
    assert {"floor", "link"} <= {one.name for one in parsed.spec.visuals}, "clients can show every geom"


@pytest.mark.parametrize(
    "options",
    [{"groups": []}, {"groups": "012"}, {"sites": [True]}, {"groups": [0.5]}, {"groups": [0, 6]}, {"sites": [-1]}],
)
def test_other_groups_than_numbers_are_refused(tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"groups|sites"):
        parse(MARKED, tmp_path, **options)


#: Like robosuite's: shapes that collide in group 0, what is drawn in group 1, a floor that is both.
LIKE_ROBOSUITE = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1" group="1"/>
  <body name="link"><geom name="hull" size=".1" group="0" rgba="0 .5 0 1"/>
    <geom name="skin" size=".09" group="1" contype="0" conaffinity="0"/></body>
  <body name="tip"><geom name="pad" size=".05" group="0"/></body></worldbody></mujoco>"""


def test_collision_shapes_beside_visuals_are_hidden_as_in_robosuite(tmp_path: Path) -> None:
    parsed = parse(LIKE_ROBOSUITE, tmp_path)
    assert list_shown(parsed) == {"floor", "skin"}
    assert ["2 collision shapes" in text for text in parsed.skipped] == [True]
    assert list_shown(parse(LIKE_ROBOSUITE, tmp_path, groups=(0, 1, 2))) == {"floor", "skin", "hull", "pad"}


@pytest.mark.parametrize(
    "change",
    [
        ('size=".09" group="1" contype="0" conaffinity="0"', 'size=".09" group="1"'),  # all collides
        ('<geom name="pad" size=".05" group="0"/>', '<geom size=".05" group="0" contype="0" conaffinity="0"/>'),
        ('group="1" contype', 'group="3" contype'),  # the visuals are in a group that is not shown
        ('<body name="tip">', '<geom size=".1"/><body name="tip">'),  # most bodies have no visual
    ],
)
def test_group_0_is_shown_in_any_other_model(tmp_path: Path, change: tuple[str, str]) -> None:
    assert change[0] in LIKE_ROBOSUITE
    assert parse(LIKE_ROBOSUITE.replace(*change), tmp_path).spec.groups_shown == (0, 1, 2)


def test_hull_of_a_model_like_those_of_menagerie_is_hidden_by_its_group(tmp_path: Path) -> None:
    xml = LIKE_ROBOSUITE.replace('group="1"', 'group="2"').replace('group="0"', 'group="3"')
    assert list_shown(parse(xml, tmp_path)) == {"floor", "skin"}


#: Two tendons that look the same, one around a ball that it touches while the hook is low; a hidden one.
CABLES = """<mujoco><worldbody><geom name="ball" size=".1" pos="0 0 1"/><site name="a" pos="-1 0 1.05"/>
  <site name="b" pos="-1 0 0"/><site name="c" pos="-2 0 0"/><site name="over" pos="0 0 1.3"/>
  <body name="hook" pos="1 0 1.05"><joint type="slide" axis="0 0 1"/><geom size=".05"/><site name="end"/></body>
  </worldbody><tendon><spatial name="wrapped" width=".02" rgba="1 0 0 1"><site site="a"/>
  <geom geom="ball" sidesite="over"/><site site="end"/><pulley divisor="2"/><site site="b"/><site site="c"/></spatial>
  <spatial name="straight" width=".02" rgba="1 0 0 1"><site site="b"/><site site="end"/></spatial>
  <spatial name="hidden" width=".02" group="4"><site site="b"/><site site="end"/></spatial></tendon></mujoco>"""


def test_tendons_run_around_shapes_as_mujoco_draws_them(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(CABLES)
    part, mesh = parse(CABLES, tmp_path).spec.deformables[0], read_drawn_meshes(model)[0]
    assert (part.stream, part.dim, part.radius, part.rgba) == ("tendon-0", 1, pytest.approx(0.02), (1.0, 0.0, 0.0, 1.0))
    assert len(read_drawn_meshes(model)) == 1
    data, scene, option = mujoco.MjData(model), mujoco.MjvScene(model, 100), mujoco.MjvOption()
    for height, pieces in ((-0.5, 9), (1.0, 3)):
        data.qpos[:] = height
        mujoco.mj_forward(model, data)
        mujoco.mjv_updateScene(model, data, option, None, mujoco.MjvCamera(), 7, scene)
        kind = int(mujoco.mjtObj.mjOBJ_TENDON)
        drawn = [np.array(one.pos) for one in scene.geoms[: scene.ngeom] if one.objtype == kind]
        ends = mesh.read_vertices(data)[mesh.elements]
        middles = [pair.mean(axis=0) for pair in ends if np.linalg.norm(pair[0] - pair[1]) > 1e-9]
        assert len(middles) == len(drawn) == pieces
        assert np.sort(np.array(middles), axis=0) == pytest.approx(np.sort(np.array(drawn), axis=0), abs=5e-4)


SKIN = """<mujoco><asset><material name="fur" rgba=".5 .3 .1 1"/></asset><deformable><skin name="s" material="fur"
  vertex="0 0 0  1 0 0  0 1 0  1 1 0" texcoord="0 0 1 0 0 1 1 1" face="0 1 2  1 3 2">
  <bone body="a" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 .5 1"/>
  <bone body="b" bindpos="1 0 0" bindquat=".70710678 0 0 .70710678" vertid="1 3" vertweight=".5 1"/></skin></deformable>
  <worldbody><body name="a"><freejoint/><geom size=".1"/></body>
  <body name="b" pos="1 0 0"><freejoint/><geom size=".1"/></body></worldbody></mujoco>"""


def test_skins_follow_their_bones_as_in_mujoco(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(SKIN)
    store = AssetStore(tmp_path)
    (part,) = parse_mujoco(model, store).spec.deformables
    assert (part.stream, part.dim, part.vertices, part.rgba) == ("skin-0", 2, 4, pytest.approx((0.5, 0.3, 0.1, 1.0)))
    assert decode_arrays(store.get(part.address), "deformable")["uv"].shape == (2, 3, 2)
    data = mujoco.MjData(model)
    data.qpos[:] = (0.1, 0.2, 0.3, 0.5, 0.5, 0.5, 0.5, 1.0, 0.5, 0.0, 0.6, 0.0, 0.8, 0.0)
    mujoco.mj_kinematics(model, data)
    scene = mujoco.MjvScene(model, 10)
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, mujoco.MjvCamera(), 7, scene)
    found = read_drawn_meshes(model)[0].read_vertices(data)
    assert found == pytest.approx(np.reshape(scene.skinvert, (-1, 3)), abs=1e-6)


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


def test_deformables_beyond_the_streams_are_reported(tmp_path: Path) -> None:
    ropes = "".join(
        f'<flexcomp name="{k}" type="grid" dim="1" count="2 1 1" spacing=".1 .1 .1" pos="0 {k} 1" radius=".01">'
        '<edge equality="true"/></flexcomp>'
        for k in range(18)
    )
    xml = f"""<mujoco><deformable><skin name="s" vertex="0 0 0 1 0 0 0 1 0" face="0 1 2">
    <bone body="b" bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin></deformable>
    <worldbody><body name="b"><geom size=".1"/></body>{ropes}</worldbody></mujoco>"""
    (text,) = parse(xml, tmp_path).skipped
    assert "3 of 19 flexes" in text


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
