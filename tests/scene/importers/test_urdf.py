"""URDF: links at the poses of MuJoCo, and named faults."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from iris_session.protocol.common import Pose
from iris_session.scene import AssetStore, SceneBuildError
from iris_session.scene.builder import SceneBuilder
from iris_session.scene.nodes import to_matrix
from iris_session.scene.result import ComposedScene
from tests.scene.arm import FREE, JOINTS, write_arm

FOLLOWS = {"finger_right": ("finger_left", 0.5, 0.01)}


def positions(seed: int) -> dict[str, float]:
    """Return random positions of the joints that can be set."""
    rng = np.random.default_rng(seed)
    return {name: rng.uniform(-3 if low is None else low, 3 if high is None else high) for name, _, low, high in JOINTS}


def with_followers(q: dict[str, float]) -> dict[str, float]:
    return {**q, **{name: q[source] * times + plus for name, (source, times, plus) in FOLLOWS.items()}}


def composed(urdf: Path, tmp_path: Path, **options: object) -> ComposedScene:
    scene = SceneBuilder("arm")
    scene.add_urdf(urdf, name="arm", **options)
    return scene.build(AssetStore(tmp_path / "store"))


def difference(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    return float(np.abs(a - b).max())


def test_links_agree_with_mujoco(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    arm = composed(urdf, tmp_path).articulations["arm"]
    model = mujoco.MjModel.from_xml_path(str(_beside_meshes(urdf)))
    data = mujoco.MjData(model)
    for seed in range(5):
        q = positions(seed)
        found = arm.compute_poses(q)
        everything = with_followers(q)
        for name, value in everything.items():
            data.qpos[model.joint(name).qposadr[0]] = value
        mujoco.mj_kinematics(model, data)
        for body, pose in found.items():
            link = body.removeprefix("arm/")
            T_world_link = np.eye(4)
            if link != "base":
                T_world_link[:3, :3] = data.body(link).xmat.reshape(3, 3)
                T_world_link[:3, 3] = data.body(link).xpos
            assert difference(to_matrix(pose), T_world_link) < 1e-9


def _beside_meshes(urdf: Path) -> Path:
    """Write the same file where MuJoCo finds its meshes: it strips paths, and searches below the model's own folder."""
    copy = urdf.parents[1] / "arm.urdf"
    copy.write_text(urdf.read_text())
    return copy


def test_joints_bodies_and_followers(tmp_path: Path) -> None:
    scene = composed(write_arm(tmp_path), tmp_path, position=(1, 2, 3))
    arm = scene.articulations["arm"]
    assert tuple(joint.name for joint in arm.joints) == FREE
    assert arm.mimics == {"finger_right": "finger_left"}
    by_name = {joint.name: joint for joint in arm.joints}
    assert (by_name["bend"].low, by_name["bend"].high, by_name["bend"].rest) == (0.3, 2.5, 0.3)
    assert by_name["twist"].high == float("inf")
    # sensor and hand are fixed: they have no body of their own
    assert arm.bodies == scene.moving
    assert arm.bodies[0] == "arm/base"
    assert {"arm/sensor", "arm/hand"}.isdisjoint(arm.bodies)
    assert len(arm.bodies) == 1 + 6 + 2
    assert scene.poses[0] == Pose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert arm.compute_poses({})["arm/base"].p == (0.0, 0.0, 0.0)
    colours = {visual.name: visual.rgba for visual in scene.spec.visuals}
    assert colours["link2"] == (0.9, 0.5, 0.1, 1.0)
    assert colours["finger_left"] == (0.5, 0.5, 0.5, 1.0)
    assert len(scene.spec.meshes) == 2  # the six links use one
    assert scene.skipped == ()


@pytest.mark.parametrize(
    ("before", "after", "named"),
    [
        ('type="continuous"', 'type="magic"', "twist of type 'magic'"),
        ('<child link="link2"/>', '<child link="link9"/>', "'link9'"),
        ('<child link="link2"/>', '<child link="link1"/>', "lift and twist"),
        ('<parent link="base"/>', '<parent link="link3"/>', "joints lift, twist, bend, turn make a loop"),
        ('<link name="base">', '<link name="stand"/><link name="base">', "(stand, base)"),
        ('joint="finger_left" mult', 'joint="flange" mult', "finger_right follows 'flange'"),
        ("package://arm_description/", "package://other/", "package_dirs"),
        ("package://arm_description/meshes/link.stl", "../../../../../../etc/passwd", "outside of"),
        ("package://arm_description/meshes/link.stl", "https://host/link.stl", "https://host/link.stl"),
        ('xyz="0.1 1.0 0.5"', 'xyz="0 0 0"', "axis of joint turn"),
        ('xyz="0.1 1.0 0.5"', 'xyz="a b c"', "line 1: <axis>: xyz is 'a b c'"),
        ('radius="0.1"', 'radius="-1"', "line 1: <cylinder>"),
        ("<robot", "<!DOCTYPE r [<!ENTITY a 'b'>]><robot", "DOCTYPE"),
        ("</link>", "</lynk>", "arm.urdf, line 1"),
        ('<link name="base">', "<link>", "arm.urdf, line 1: <link> has no name"),
        ('<parent link="base"/>', "", "<joint> turn has no <parent"),
        ('lower="-2.9"', 'lower="${-pi}"', "lower is '${-pi}'"),
        ('name="arm">', 'name="arm" xmlns:xacro="http://wiki.ros.org/xacro"><xacro:a/>', "xacro"),
        ("robot", "sdf", "<sdf>"),
    ],
)
def test_faults_are_named(tmp_path: Path, before: str, after: str, named: str) -> None:
    urdf = write_arm(tmp_path)
    assert before in urdf.read_text()
    urdf.write_text(urdf.read_text().replace(before, after))
    with pytest.raises(SceneBuildError, match=re.escape(named)) as raised:
        SceneBuilder().add_urdf(urdf)
    assert "\n" not in str(raised.value)


def test_parts_that_are_not_drawn_are_reported(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    changed = urdf.read_text().replace('<sphere radius="0.02"/>', '<torus radius="0.02" length="1"/>', 1)
    changed = changed.replace('name="orange"/>', 'name="lost"/>')
    urdf.write_text(changed)
    skipped = composed(urdf, tmp_path).skipped
    assert any("finger_left: shape 'torus'" in line for line in skipped)
    assert any("material 'lost'" in line for line in skipped)


def test_capsules_are_drawn_with_their_length_between_the_caps(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    urdf.write_text(urdf.read_text().replace('<sphere radius="0.02"/>', '<capsule radius="0.02" length="1"/>', 1))
    drawn = [v.geometry for v in composed(urdf, tmp_path).spec.visuals if v.geometry.kind == "capsule"]
    assert [geometry.size for geometry in drawn] == [(0.02, 0.02, 0.5)]


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_floating_link_is_a_body_of_its_own(tmp_path: Path, kind: str) -> None:
    urdf = write_arm(tmp_path)
    before = composed(urdf, tmp_path)
    urdf.write_text(urdf.read_text().replace('type="continuous"', f'type="{kind}"'))
    after = composed(urdf, tmp_path)
    assert after.moving == before.moving
    assert after.poses == before.poses
    assert [(v.body, v.name) for v in after.spec.visuals] == [(v.body, v.name) for v in before.spec.visuals]
    assert len(after.articulations["arm"].joints) == len(before.articulations["arm"].joints) - 1
    assert after.articulations["arm"].loose == {"twist": "arm/link2"}
    assert after.skipped == before.skipped, "it is there, and set_pose moves it"


def test_undeclared_prefixes_are_left_out(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    before = composed(urdf, tmp_path)
    text = urdf.read_text().replace('effort="1"', 'effort="1" drake:acceleration="15"')
    urdf.write_text(
        text.replace("</robot>", '<drake:filter name="a"><drake:member link="base"/></drake:filter></robot>')
    )
    assert composed(urdf, tmp_path).scene_hash == before.scene_hash


def test_collision_shapes_on_request(tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    assert "leave out collisions=True" in composed(urdf, tmp_path, collisions=True).skipped[0]
    urdf.write_text(urdf.read_text().replace("<visual>", "<collision>").replace("</visual>", "</collision>"))
    assert composed(urdf, tmp_path).spec.visuals == ()
    assert "give collisions=True" in composed(urdf, tmp_path).skipped[0]
    assert len(composed(urdf, tmp_path, collisions=True).spec.visuals) == 11


def test_scaled_robot(tmp_path: Path) -> None:
    """Every position scales, joints keep their positions, the picture is the same."""
    urdf = write_arm(tmp_path)
    whole, half = composed(urdf, tmp_path), composed(urdf, tmp_path, scale=0.5, position=(1, 0, 0))
    one, other = whole.articulations["arm"], half.articulations["arm"]
    assert other.joints == one.joints
    q = positions(4)
    for (name, a), b in zip(one.compute_poses(q).items(), other.compute_poses(q).values(), strict=True):
        np.testing.assert_allclose(b.p, np.array(a.p) / 2, atol=1e-12, err_msg=name)
        assert b.q == a.q
    for wrong in (0.0, -1.0, float("nan"), "2", None):
        with pytest.raises(SceneBuildError, match="scale is"):
            composed(urdf, tmp_path, scale=wrong)


def test_invalid_arguments_are_rejected(tmp_path: Path) -> None:
    arm = composed(write_arm(tmp_path), tmp_path).articulations["arm"]
    with pytest.raises(SceneBuildError, match="follows 'finger_left'"):
        arm.compute_poses({"finger_right": 0.0})
    with pytest.raises(SceneBuildError, match="Joints: turn, lift"):
        arm.compute_poses({"elbow": 0.0})
    with pytest.raises(SceneBuildError, match="finite"):
        arm.compute_poses({"lift": float("nan")})
    with pytest.raises(SceneBuildError, match="number"):
        arm.compute_poses({"lift": "high"})  # type: ignore[dict-item]
