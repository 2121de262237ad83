"""Pictures of a data set are MuJoCo's own of the state, bit for bit; looks change what is seen and nothing else."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from msgspec.structs import replace

from iris_session.cameras.drawing import encode_jpeg
from iris_session.dataset.cameras import (
    CameraSet,
    CameraSpec,
    PictureSpec,
    RecordedCamera,
    find_streams,
    make_view,
    parse_cameras,
)
from iris_session.dataset.episodes import DatasetError
from iris_session.dataset.frames import EpisodeLeftOutError
from iris_session.recording import RecordedImage, Recording
from iris_session.replay.pictures import NO_BODY, Image, open_gl
from iris_session.session.core import SessionCore
from tests.dataset.support import record
from tests.replay.support import make_drawn_core
from tests.session.play import make_core

WIDTH, HEIGHT = 128, 96
TOP = "top=0.4,-0.3,2.4->0,0.01,0.7:50"

Draw = Callable[[SessionCore, Any, float], Image]


@pytest.fixture
def reference(monkeypatch: pytest.MonkeyPatch) -> Draw:
    """Return a function that draws a state with `mujoco.Renderer`."""
    from mujoco.egl import GLContext

    module: Any = sys.modules[mujoco.Renderer.__module__]
    monkeypatch.setattr(module.gl_context, "GLContext", GLContext)
    open_gl(WIDTH, HEIGHT).free()

    def draw(core: SessionCore, camera: Any, fovy: float) -> Image:
        model = copy.copy(core.world.model)
        model.vis.global_.fovy = fovy or model.vis.global_.fovy
        renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        renderer.update_scene(core.world.data, camera)
        image: Image = renderer.render().copy()
        renderer.close()
        return image

    return draw


def draw_all(core: SessionCore, spec: PictureSpec, path: Path) -> dict[tuple[int, str], Image]:
    """Return the pictures of a state, which is drawn twice: they are the same."""
    with Recording.open(path, warn=False) as recording, CameraSet(spec) as cameras:
        first, second = (
            {(look, name): image for look, name, image in cameras.draw(core, recording)} for _ in ("first", "second")
        )
        assert all(np.array_equal(first[key], second[key]) for key in first)
        return first


def test_pictures_are_those_of_mujoco(tmp_path: Path, reference: Draw) -> None:
    made = record(tmp_path / "session.rrd", {}, steps=60)
    core = made.core
    spec = PictureSpec(parse_cameras(f"operator,{TOP}"), WIDTH, HEIGHT)
    found = draw_all(core, spec, made.path)
    top = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(core.world.model, top)
    way = np.array([-0.4, 0.31, -1.7])
    top.lookat, top.distance = (0.0, 0.01, 0.7), np.linalg.norm(way)
    top.azimuth, top.elevation = np.degrees(np.arctan2(way[1], way[0])), np.degrees(np.arcsin(way[2] / top.distance))
    for name, camera, fovy in (("operator", "operator", 0.0), ("top", top, 50.0)):
        assert found[0, name].std() > 5.0, "the picture is not empty"
        assert found[0, name].tobytes() == reference(core, camera, fovy).tobytes()


def test_depth_and_masks_are_those_of_mujoco(tmp_path: Path, reference: Draw) -> None:
    made = record(tmp_path / "session.rrd", {}, steps=60)
    model = made.core.world.model
    spec = PictureSpec((CameraSpec("operator", "operator"),), WIDTH, HEIGHT, depth=True, masks=True)
    found = draw_all(made.core, spec, made.path)
    renderer = mujoco.Renderer(copy.copy(model), HEIGHT, WIDTH)
    renderer.update_scene(made.core.world.data, "operator")
    renderer.enable_segmentation_rendering()
    ids, kinds = renderer.render().copy().transpose(2, 0, 1)
    bodies = np.where(kinds == int(mujoco.mjtObj.mjOBJ_GEOM), model.geom_bodyid[ids], NO_BODY)
    renderer.enable_depth_rendering()
    depth = renderer.render().copy()
    renderer.close()
    mask = found[0, "operator_mask"]
    assert len(np.unique(mask)) > 5
    assert np.array_equal(mask, bodies)
    seen = np.isfinite(found[0, "operator_depth"])
    assert np.array_equal(seen, mask != NO_BODY)
    assert np.allclose(found[0, "operator_depth"][seen], depth[seen], rtol=1e-4)
    assert (
        found[0, "operator"].tobytes()
        == draw_all(made.core, replace(spec, depth=False), made.path)[0, "operator"].tobytes()
    )


def test_looks_follow_from_the_seed_and_change_nothing_that_moves(tmp_path: Path) -> None:
    made = record(tmp_path / "session.rrd", {}, steps=3)
    before = made.core.world.encode_model(), made.core.world.save_state()
    spec = PictureSpec(parse_cameras(f"operator,{TOP}"), WIDTH, HEIGHT, looks=2, seed=4)
    one, other = draw_all(made.core, spec, made.path), draw_all(made.core, spec, made.path)
    changed = draw_all(made.core, PictureSpec(spec.cameras, WIDTH, HEIGHT, 1, 5), made.path)
    assert list(one) == [(look, camera) for look in range(3) for camera in ("operator", "top")]
    alone = draw_all(made.core, replace(spec, looks=0), made.path)
    assert all(np.array_equal(one[key], alone[key]) for key in alone)
    assert [image.tobytes() for image in one.values()] == [image.tobytes() for image in other.values()]
    pictures = {image.tobytes() for image in (*one.values(), changed[1, "operator"])}
    assert len(pictures) == 7
    assert changed[0, "operator"].tobytes() == one[0, "operator"].tobytes()
    assert (made.core.world.encode_model(), made.core.world.save_state()) == before


def test_plain_pictures_have_no_shadows_and_reflections(tmp_path: Path) -> None:
    made = record(tmp_path / "session.rrd", {}, steps=3)
    cameras = (CameraSpec("operator", "operator"),)
    full = draw_all(made.core, PictureSpec(cameras, WIDTH, HEIGHT), made.path)[0, "operator"]
    plain = draw_all(made.core, PictureSpec(cameras, WIDTH, HEIGHT, plain=True), made.path)[0, "operator"]
    model = copy.copy(made.core.world.model)
    model.light_castshadow[:], model.mat_reflectance[:] = 0, 0.0
    core = make_core(model)
    core.world.restore_state(made.core.world.save_state())
    without = draw_all(core, PictureSpec(cameras, WIDTH, HEIGHT), made.path)[0, "operator"]
    assert plain.tobytes() == without.tobytes() != full.tobytes()


def test_cameras_are_parsed() -> None:
    assert parse_cameras("") == ()
    assert parse_cameras("wrist, a/b=side") == (CameraSpec("wrist", "wrist"), CameraSpec("a_b", "side"))
    assert parse_cameras(f"{TOP},left/wrist") == (
        CameraSpec("top", "", (0.4, -0.3, 2.4), (0.0, 0.01, 0.7), 50.0),
        CameraSpec("left_wrist", "left/wrist"),
    )


@pytest.mark.parametrize(
    "text", ["=x", "a=", "top=1,2->3", "top=1,2,3->1,2,3", "top=0,0,1->0,0,0:190", "a b", "top=0,0,1->0,0,nan"]
)
def test_what_is_no_camera_is_refused(text: str) -> None:
    with pytest.raises(
        DatasetError, match=r"is no camera: give a name of the model, NAME=CAMERA, or in quotes|looks at where"
    ):
        parse_cameras(text)


def test_unknown_and_doubled_cameras_are_refused() -> None:
    model = make_drawn_core().world.model
    with pytest.raises(DatasetError, match=r"no camera 'nope' in the scene: give one of its own \(operator, side\)"):
        make_view(model, CameraSpec("nope", "nope"))
    with pytest.raises(DatasetError, match="two cameras have the name 'a'"):
        parse_cameras("a=side,a=operator")


def read_recorded(pictures: list[RecordedImage], *episodes: list[int]) -> list[list[tuple[int, int]]]:
    """Return grey and capture of the picture at each frame of episodes, by their session times."""
    recording: Any = SimpleNamespace(pictures=lambda stream: iter(pictures))
    camera = RecordedCamera(recording, CameraSpec("front", stream="room", size=(4, 2)))
    return [[(int(image.mean()), at_ns) for image, at_ns in camera.read(times)] for times in episodes]


def take_picture(capture_ns: int, received_ns: int, grey: int, width: int = 4) -> RecordedImage:
    image = np.full((2, width, 3), grey, np.uint8)
    return RecordedImage("room", capture_ns, capture_ns, received_ns, encode_jpeg(image))


def test_recorded_pictures_are_those_that_were_there() -> None:
    times = (10, 12), (30, 31), (20, 35), (90, 50)
    pictures = [take_picture(*one, 40 * i) for i, one in enumerate(times, 1)]
    assert read_recorded(pictures, [10, 29, 30, 49], [50, 51]) == [
        [(40, 10), (40, 10), (80, 30), (80, 30)],
        [(160, 50), (160, 50)],
    ], "none is shown before a newer one, and none is of a time after its receipt"
    one, billion = take_picture(10, 10, 40), 1_000_000_000
    for wrong, times, why in (
        ([], [5], "the recording has no picture of 'room'"),
        ([one], [10 - billion], "the first picture of 'room' is 1.00 s after its first frame: trim it"),
        ([one], [11, 20], "no picture of 'room' was taken in it"),
        ([one._replace(jpeg=one.jpeg[:-20])], [10], "a picture of 'room' cannot be read: damaged jpeg"),
        ([take_picture(10, 10, 40, width=6)], [10], "a picture of 'room' is 6x2, not 4x2"),
    ):
        with pytest.raises(EpisodeLeftOutError, match=why):
            read_recorded(wrong, times)


def test_recorded_pictures_of_odd_size_fit_into_no_video() -> None:
    recording: Any = SimpleNamespace(pictures=lambda stream: iter([take_picture(1, 1, 40, width=3)]))
    with pytest.raises(DatasetError, match="pictures of 'room' are 3x2: a video needs even numbers"):
        find_streams(PictureSpec(parse_cameras("room")), make_drawn_core().world.model, recording)


def test_closing_one_set_of_cameras_leaves_the_pictures_of_another(tmp_path: Path) -> None:
    made = record(tmp_path / "session.rrd", {}, steps=3)
    spec = PictureSpec((CameraSpec("operator", "operator"),), WIDTH, HEIGHT)
    with Recording.open(made.path, warn=False) as recording, CameraSet(spec) as first:
        before = [image.tobytes() for _, _, image in first.draw(made.core, recording)]
        with CameraSet(spec) as second:
            list(second.draw(made.core, recording))
            first.close()
            assert [image.tobytes() for _, _, image in second.draw(made.core, recording)] == before
