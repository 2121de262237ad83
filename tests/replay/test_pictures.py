"""Pictures of a recording are those that MuJoCo's own renderer makes of the same state, bit for bit."""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from iris_session.authority import AuthorityConfig
from iris_session.control import ControlConfig
from iris_session.demo.scenes import n_arms_scene, scene_path
from iris_session.physics import decode_model, find_objects, find_robots
from iris_session.physics.kinematic_model import KinematicModel
from iris_session.physics.load import compute_scene_hash, encode_model
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Entry, SceneLoaded, ScenePatched
from iris_session.protocol.scene import FIRST_SITE_VISUAL, AddVisual, Geometry, RemoveVisual, SetVisual, Visual
from iris_session.protocol.server_messages import PresenceItem
from iris_session.recording import OPEN, RecordedState, Recording
from iris_session.replay import pictures
from iris_session.replay.pictures import Image, PictureError, PictureOptions, RecordingPictures, Timeline, open_gl
from iris_session.session.core import CoreConfig, SessionCore
from tests.replay.support import Played, damaged, make_drawn_core, play, scene_model, step_ns
from tests.session.play import host

STEPS = 50
WIDTH, HEIGHT = 160, 120
SMALL = PictureOptions(WIDTH, HEIGHT, "operator")


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    made = play(tmp_path_factory.mktemp("played") / "session.rrd", STEPS, core=make_drawn_core())
    made.write()
    return made


def draw(path: Path, steps: Sequence[int], options: PictureOptions = SMALL) -> list[Image]:
    """Return the pictures of steps."""
    return draw_times(path, [step_ns(step) for step in steps], options)[0]


def draw_times(path: Path, times_ns: Sequence[int], options: PictureOptions = SMALL) -> tuple[list[Image], Any]:
    with (
        Recording.open(path, warn=False) as recording,
        RecordingPictures(recording, Timeline(recording), options) as made,
    ):
        return list(made.draw(times_ns)), made


Reference = Callable[..., Image]


@pytest.fixture
def reference(monkeypatch: pytest.MonkeyPatch) -> Reference:
    """Return a function that draws a model at `qpos` with `mujoco.Renderer`."""
    from mujoco.egl import GLContext

    module: Any = sys.modules[mujoco.Renderer.__module__]
    monkeypatch.setattr(module.gl_context, "GLContext", GLContext)
    open_gl(WIDTH, HEIGHT).free()

    def draw_reference(model: mujoco.MjModel, qpos: NDArray[np.float64], camera: Any = "operator") -> Image:
        model = copy.copy(model)
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_forward(model, data)
        renderer = mujoco.Renderer(model, HEIGHT, WIDTH)
        renderer.update_scene(data, camera)
        image: Image = renderer.render().copy()
        renderer.close()
        return image

    return draw_reference


@pytest.fixture
def cameras(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The cameras that are made from now on."""
    made: list[Any] = []
    choose = RecordingPictures._choose_camera

    def keep(self: Any, *given: Any, **options: Any) -> Any:
        made.append(choose(self, *given, **options))
        return made[-1]

    monkeypatch.setattr(RecordingPictures, "_choose_camera", keep)
    return made


def assert_same(found: Sequence[Image], expected: Sequence[Image]) -> None:
    for image in expected:
        assert image.std() > 5.0, "the picture is not empty"
    assert [image.tobytes() for image in found] == [image.tobytes() for image in expected]


@pytest.mark.parametrize("recording_class", ["closed", OPEN])
def test_pictures_are_those_of_mujoco(recording_class: str, tmp_path: Path, reference: Reference) -> None:
    core = make_drawn_core(user_owned_loop=recording_class == OPEN)
    played = play(tmp_path / "session.rrd", STEPS, recording_class=recording_class, core=core)
    steps = [0, STEPS - 1]
    found = draw(played.write(), steps)
    assert_same(found, [reference(played.core.world.model, played.qpos[step]) for step in steps])
    assert len({image.tobytes() for image in found}) == len(steps), "something moves"


def test_deformables_are_those_of_mujoco(tmp_path: Path, reference: Reference) -> None:
    core = make_drawn_core("cloth")
    played = play(tmp_path / "session.rrd", 25, core=core, make_entries=lambda step: [])
    steps = [0, 24]
    found = draw(played.write(), steps)
    assert_same(found, [reference(core.world.model, played.qpos[step]) for step in steps])
    hidden = copy.copy(core.world.model)
    hidden.flex_rgba[:, 3] = 0.0
    assert found[0].tobytes() != reference(hidden, played.qpos[0]).tobytes(), "the cloth is seen"


def test_scene_that_was_loaded_later_is_drawn(tmp_path: Path, reference: Reference, cameras: list[Any]) -> None:
    at = 25
    arms = n_arms_scene(1, objects=1).compile()
    arms.vis.quality.shadowsize, arms.vis.quality.offsamples = 64, 0
    scene = SceneLoaded(compute_scene_hash(encode_model(arms)), find_robots(arms).robots, find_objects(arms))
    first = make_drawn_core()
    core = SessionCore(first.world.model, first.config, lambda _: decode_model(bytes(encode_model(arms))))

    def change(step: int) -> Sequence[Entry]:
        return [host(step_ns(step), scene)] if step == at else []

    played = play(tmp_path / "session.rrd", at + 1, core=core, make_entries=change)
    played.batch.scenes = [scene_model(arms, scene.model_hash, at - 1, core)]
    found, made = draw_times(played.write(), [step_ns(at - 1), step_ns(at)])
    expected = [reference(first.world.model, played.qpos[at - 1]), reference(arms, played.qpos[at], cameras[-1])]
    assert_same(found, expected)
    assert made.notes == [
        "in a scene that was loaded later there is no camera 'operator' in the scene, there are none: leave --camera "
        "out: the view of all that moves is drawn"
    ]


def patched(tmp_path: Path, *ops: Any) -> Played:
    patch = ScenePatched(ops, "0" * 64)

    def make_entries(step: int) -> Sequence[Entry]:
        return [host(step_ns(step), patch)] if step == 10 else []

    made = play(tmp_path / "session.rrd", 30, core=make_drawn_core(), make_entries=make_entries)
    made.write()
    return made


def ball(number: int, kind: str = "sphere", mesh: int = -1, group: int = 0) -> Visual:
    pose = Pose((0.0, -0.2, 0.2), (1.0, 0.0, 0.0, 0.0))
    geometry = Geometry(kind, (0.1, 0.1, 0.1), mesh)
    return Visual(number, 0, "ball", pose, group, geometry, -1, (1.0, 0.0, 0.0, 1.0))


def test_patched_visuals_are_drawn(tmp_path: Path, reference: Reference) -> None:
    model = copy.copy(make_drawn_core().world.model)
    grip, board, table = (model.geom(name).id for name in ("hammer_grip", "board", "table_top"))
    goal = 0  # a site
    moved = Pose((0.0, 0.0, 0.1), (0.0, 1.0, 0.0, 0.0))
    played = patched(
        tmp_path,
        SetVisual(grip, rgba=(0.0, 0.0, 1.0, 1.0)),
        SetVisual(board, T_body_visual=moved),
        RemoveVisual(table),
        SetVisual(FIRST_SITE_VISUAL + goal, rgba=(1.0, 0.0, 1.0, 1.0), group=0, T_body_visual=moved),
    )
    found = draw(played.path, [9, 29])
    assert_same(found[:1], [reference(model, played.qpos[9])])
    model.geom_rgba[grip] = (0.0, 0.0, 1.0, 1.0)
    model.geom_pos[board], model.geom_quat[board] = moved.p, moved.q
    model.geom_sameframe[board] = 0  # MuJoCo takes the pose of the body for it otherwise
    model.geom_group[table] = 5
    model.site_rgba[goal], model.site_group[goal] = (1.0, 0.0, 1.0, 1.0), 0
    model.site_pos[goal], model.site_quat[goal], model.site_sameframe[goal] = moved.p, moved.q, 0
    assert_same(found[1:], [reference(model, played.qpos[29])])


def test_added_visuals_are_drawn_and_those_with_meshes_of_their_own_are_noted(
    tmp_path: Path, reference: Reference
) -> None:
    spec = mujoco.MjSpec.from_file(str(scene_path("handover")))
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(0.1, 0.1, 0.1), pos=(0.0, -0.2, 0.2), rgba=(1.0, 0.0, 0.0, 1.0)
    )
    with_ball = spec.compile()
    with_ball.vis.quality.shadowsize, with_ball.vis.quality.offsamples = 64, 0
    n = with_ball.ngeom - 1
    played = patched(tmp_path, AddVisual(ball(n)), AddVisual(ball(n + 1, "mesh", 7)), AddVisual(ball(n + 2, group=4)))
    found, made = draw_times(played.path, [step_ns(29)])
    assert_same(found, [reference(with_ball, played.qpos[29])])
    assert made.notes == ["shapes that a patch brought along are not drawn: `iris-session view` shows them"]


def test_a_picture_shows_the_newest_step_at_its_time(played: Played) -> None:
    at = [step_ns(30), step_ns(30) + 1, step_ns(31) - 1, step_ns(31), step_ns(STEPS - 1) + 10**9]
    found, _ = draw_times(played.path, at)
    expected = draw(played.path, [30, 30, 30, 31, STEPS - 1])
    assert_same(found, expected)


def test_the_last_picture_stays_where_steps_are_left_out(tmp_path: Path) -> None:
    gap = play(tmp_path / "session.rrd", STEPS, core=make_drawn_core())
    intact = draw(gap.write(), [24, 45])
    gap.path.unlink()
    gap.batch.rows[25] = damaged(gap.batch.rows[25])
    found, made = draw_times(gap.write(), [step_ns(step) for step in (24, 26, 35, 45)])
    assert_same(found, [intact[0]] * 3 + [intact[1]])
    assert made.left_out == [(25, 39)]


@pytest.mark.parametrize(("width", "height"), [(60, 200), (300, 50)])
def test_default_view_shows_all_bodies_that_move(played: Played, cameras: list[Any], width: int, height: int) -> None:
    images = draw(played.path, [0, STEPS - 1], PictureOptions(width, height))
    assert all(image.shape == (height, width, 3) for image in images)
    moving = [body.id for body in played.core.world.bodies if body.moving]
    positions = np.array(played.bodies)[:, moving, :3].reshape(-1, 3)
    x, y = project(cameras[0], played.core.world.model, positions, width / height)
    assert max(np.abs(x).max(), np.abs(y).max()) < 0.9
    assert max(np.abs(x).max(), np.abs(y).max()) > 0.5, "they fill it"


def project(camera: Any, model: Any, positions: NDArray[np.float64], aspect: float) -> tuple[Any, Any]:
    """Return where positions are in a picture: -1 to 1 from left to right, and from the lower edge to the upper."""
    azimuth, elevation = np.radians(camera.azimuth), np.radians(camera.elevation)
    forward = np.array([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)])
    right = np.array([np.sin(azimuth), -np.cos(azimuth), 0.0])
    at = positions - (camera.lookat - camera.distance * forward)
    depth = at @ forward * np.tan(np.radians(model.vis.global_.fovy) / 2.0)
    assert depth.min() > 0.0
    return at @ right / depth / aspect, at @ np.cross(right, forward) / depth


def test_the_default_view_of_one_moment_has_the_people_in_it(played: Played, monkeypatch: pytest.MonkeyPatch) -> None:
    """A picture is mostly of a moment between two recorded states."""
    head = PresenceItem("p1", "head", Pose((2.0, -2.0, 1.6), (1.0, 0.0, 0.0, 0.0)), step_ns(10))
    state = RecordedState(10, 10, 0.02, step_ns(10), np.zeros((0, 7)), (head,), ())
    monkeypatch.setattr(Recording, "states", lambda self: iter([state]))
    whole = SMALL._replace(camera="")
    found, _ = draw_times(played.path, [step_ns(10) + 1], whole._replace(people=True))
    without, _ = draw_times(played.path, [step_ns(10) + 1], whole)
    assert (found[0] != without[0]).any()
    blue = found[0].astype(int)[..., 2] - found[0].astype(int)[..., 0] > 60
    assert blue.sum() > 20, "the head is in sight"


def test_published_worlds_are_refused(tmp_path: Path) -> None:
    kinematic = KinematicModel(["box"], [Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))])
    core = SessionCore(kinematic.model, CoreConfig(AuthorityConfig(user_owned_loop=True), ControlConfig(), (), ()))
    plant = kinematic.encode_state(0.0, np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]))
    path = play(
        tmp_path / "session.rrd", 3, core=core, make_plant=lambda step: plant, make_entries=lambda step: []
    ).write()
    with pytest.raises(PictureError, match=r"of a published world, .* `iris-session view` shows it"):
        draw(path, [0], SMALL._replace(camera=""))


def test_people_are_drawn_while_they_are_tracked(played: Played, monkeypatch: pytest.MonkeyPatch) -> None:
    head = PresenceItem("p1", "head", Pose((0.0, -0.4, 0.3), (1.0, 0.0, 0.0, 0.0)), step_ns(10))
    state = RecordedState(10, 10, 0.02, step_ns(10), np.zeros((0, 7)), (head,), ())
    monkeypatch.setattr(Recording, "states", lambda self: iter([state]))
    times = [step_ns(9), step_ns(10), step_ns(10) + pictures.PRESENCE_NS - 1, step_ns(10) + pictures.PRESENCE_NS]
    found, _ = draw_times(played.path, times, SMALL._replace(people=True))
    without, _ = draw_times(played.path, times)
    assert [bool((a != b).any()) for a, b in zip(found, without, strict=True)] == [False, True, True, False]
    blue = (found[1].astype(int)[..., 2] - found[1].astype(int)[..., 0] > 60) & (found[1] != without[1]).any(axis=2)
    assert blue.sum() > 100, "in the colour of the first participant"
