"""Scenes by name: every one that the help lists can be served, and its sheet lies in it."""

from __future__ import annotations

import mujoco
import pytest

from iris_session.cloud.camera_file import load_camera_file
from iris_session.demo.named_scenes import SCENES, NamedScene, scene_by_name
from iris_session.demo.scene_names import SCENE_NAMES
from iris_session.emulator.headset import DEFAULT_ANCHOR_ID, DEFAULT_SHEET_M
from iris_session.physics import find_robots
from iris_session.session.errors import ConfigError


def test_names_in_the_help_are_available() -> None:
    assert list(SCENES) == list(SCENE_NAMES)


@pytest.mark.parametrize(
    ("name", "robots"),
    [("handover", 2), ("arm", 1), ("arms", 8), ("arms3", 3), ("panda", 2), ("panda1", 1), ("aloha", 4), ("bodies", 0)],
)
def test_scene_has_its_robots_and_a_sheet_of_known_size(name: str, robots: int) -> None:
    scene = scene_by_name(name)
    assert len(find_robots(scene.model).robots) == robots
    assert scene.anchor_sizes == {DEFAULT_ANCHOR_ID: DEFAULT_SHEET_M}
    if name not in ("handover", "arm", "bodies"):
        drawn = scene.model.body("sheet").pos
        assert tuple(scene.anchors[DEFAULT_ANCHOR_ID][0]) == pytest.approx(tuple(drawn))


def test_cameras_of_the_cloud_draw_every_body_of_the_session_and_more() -> None:
    scene = scene_by_name("cloud")
    assert scene_by_name("handover").cameras == ()
    (path,) = scene.cameras
    cameras = load_camera_file(path).cameras
    assert len({one.camera for one in cameras}) == 2
    drawn = mujoco.MjModel.from_xml_path(cameras[0].model)
    assert {one.model for one in cameras} == {cameras[0].model}
    assert {one.camera for one in cameras} <= {drawn.camera(k).name for k in range(drawn.ncam)}
    bodies = [scene.model.body(k).name for k in range(scene.model.nbody)]
    assert bodies == [drawn.body(k).name for k in range(drawn.nbody)]  # what is more is fixed to the world
    assert drawn.ngeom > scene.model.ngeom


def test_a_scene_for_a_newer_mujoco_is_an_error_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def make() -> NamedScene:
        mujoco.MjSpec.from_string("<mujoco>\n<option integrator='newest'/></mujoco>")
        raise AssertionError

    monkeypatch.setitem(SCENES, "cloth", make)
    with pytest.raises(ConfigError, match=mujoco.__version__) as caught:
        scene_by_name("cloth")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("alohas", "handover, arm, arms, panda, aloha, cloth, soft, cloud, bodies"),
        ("handover2", "one of handover"),
        ("arms0", "scene 'arms0': .* 1 to 12"),
        ("panda9", "1 to 8"),
    ],
)
def test_unknown_name_lists_the_known(name: str, text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        scene_by_name(name)
