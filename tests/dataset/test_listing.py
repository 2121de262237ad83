"""Numbers of episodes: those of a session whose path, times and counts are known; recordings that do not fit."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import msgspec
import mujoco
import numpy as np
import pytest

from iris_session.dataset.cameras import CameraSpec, parse_camera
from iris_session.dataset.curation import write_curation
from iris_session.dataset.episodes import Curation, DatasetError, EpisodeCuration, list_files, make_plan
from iris_session.dataset.film_strip import HEIGHT, N_PICTURES, WIDTH, draw_strips
from iris_session.dataset.listing import ListedEpisode, ListedRecording, ListOptions, attach_edits, list_recordings
from iris_session.dataset.posed_scene import PosedScene, Projection
from iris_session.demo.scenes import scene_path
from iris_session.physics import load_model
from iris_session.protocol.server_messages import EngagementChanged, Event, Handover, Intervention, SamplesRejected
from iris_session.recording import Recording
from iris_session.replay.pictures import Renderer, open_gl
from iris_session.session.core import SessionCore
from tests.dataset.support import NAME, STATE_STEPS, record
from tests.replay.support import Played, make_drawn_core, step_ns
from tests.session.play import make_core

CAMERAS = (parse_camera("operator"), parse_camera("away=0,0,5->0,0,9:50"))


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return record(tmp_path_factory.mktemp("played") / "session.rrd")


def read(path: Path, **options: object) -> ListedRecording:
    (listed,) = list_recordings([path], ListOptions(**options))  # type: ignore[arg-type]
    return listed


def test_engagement_is_counted(played: Played) -> None:
    first, second, third = read(played.path).episodes
    # The clutch closes with the first sample after step 50, that of step 56, and stays closed.
    idle = (step_ns(56) - step_ns(20)) / (step_ns(90) - step_ns(20))
    assert (first.clutches, first.idle_share, first.people) == (1, pytest.approx(idle, abs=1e-4), (NAME,))
    assert (second.clutches, second.idle_share, second.people) == (0, 0.0, (NAME,))
    assert [one.final_verdict for one in (first, second, third)] == ["success", "failure", "success"]
    assert second.duration_s == pytest.approx(0.1, abs=0.002)


def test_paths_distances_and_views_are_those_of_the_states(tmp_path: Path) -> None:
    """The left arm moves towards the right one, by 1 mm a state; late in the third episode it is far away."""
    played = record(tmp_path / "session.rrd", {22: "start", 90: "success", 100: "start", 150: "failure", 160: "start"})
    data, model = played.core.world.make_initial_data(), played.core.world.model
    left, right = (np.array(data.site(f"{name}/tcp").xpos) for name in ("left", "right"))
    distance_m = float(np.linalg.norm(right - left))
    base = int(model.body("left/base").id)
    moves = [int(model.body_rootid[body.id]) == base for body in played.header.bodies]
    start = np.frombuffer(played.batch.states[0].poses).reshape(-1, 7)
    for i, state in enumerate(played.batch.states):
        poses = start.copy()
        poses[moves, :3] += (right - left) / distance_m * 1e-3 * i + (100.0 if state.step >= 175 else 0.0)
        played.batch.states[i] = msgspec.structs.replace(state, poses=poses.tobytes())
    played.path.unlink()
    played.write()
    beside = CameraSpec("beside", eye=tuple(left - (0.0, 1.0, 0.0)), target=tuple(left), fovy=20.0)
    first, second, third = read(played.path, cameras=(*CAMERAS, beside)).episodes
    assert first.robots == ("left",), "the right one is not looked for"
    assert first.path_m == {"left": pytest.approx(68 / STATE_STEPS * 1e-3, abs=1e-4), "right": 0.0}
    assert second.path_m["left"] == pytest.approx(50 / STATE_STEPS * 1e-3, abs=1e-4)
    assert first.closest_m == pytest.approx(distance_m - 90 / STATE_STEPS * 1e-3, abs=2e-4)
    assert (first.outside, second.outside) == ({"operator": 0.0, "away": 1.0, "beside": 0.0},) * 2
    gone = pytest.approx((200 - 175) / (200 - 160), abs=0.02)
    assert third.outside == {"operator": gone, "away": 1.0, "beside": gone}
    assert first.simulated_s == pytest.approx(68 * 0.002, abs=1e-3)


def add_events(played: Played, more: dict[int, Any]) -> None:
    """Write a recording again with more events, by their steps."""
    events = [*played.batch.events, *(Event(0, step, step_ns(step), body) for step, body in more.items())]
    events.sort(key=lambda event: event.session_time)
    played.batch.events[:] = [msgspec.structs.replace(event, event_seq=i + 1) for i, event in enumerate(events)]
    played.path.unlink()
    played.write()


def test_time_in_which_two_are_engaged_counts_once(tmp_path: Path) -> None:
    played = record(tmp_path / "session.rrd", {10: "start", 50: "success"}, steps=52)
    robots = {5: ("left", True), 15: ("left", False), 20: ("left", True), 22: ("right", True), 25: ("right", False)}
    robots |= {26: ("right", True), 30: ("left", False), 40: ("right", False)}
    add_events(
        played, {step: EngagementChanged(name, f"on {name}", engaged) for step, (name, engaged) in robots.items()}
    )
    (episode,) = read(played.path).episodes
    engaged = step_ns(15) - step_ns(10) + step_ns(40) - step_ns(20)
    idle = pytest.approx(1.0 - engaged / (step_ns(50) - step_ns(10)), abs=1e-4)
    assert (episode.idle_share, episode.clutches, episode.people) == (idle, 3, ("on left", "on right"))


def test_events_within_an_episode_are_counted(tmp_path: Path) -> None:
    played = record(tmp_path / "session.rrd")

    def reject(count: int) -> SamplesRejected:
        return SamplesRejected("p1", "desktop", "stale", count)

    more = {
        10: reject(4),
        30: reject(5),
        40: Handover("hammer", "left", "right", "p1", "p2", 1),
        60: reject(9),
        110: Intervention("left", "p1", "p2", active=True),
        120: Intervention("left", "p1", "p2", active=False),
        130: reject(2),  # it has joined again
    }
    add_events(played, more)
    listed = read(played.path)
    found = [(one.rejected, one.handovers, one.interventions) for one in listed.episodes]
    assert (found, listed.problems) == ([(5, 1, 0), (2, 0, 1), (0, 0, 0)], ())


def test_recorded_poses_give_the_scene_that_was_simulated(played: Played) -> None:
    with Recording.open(played.path) as recording:
        scene = PosedScene(recording)
        *_, last = recording.states()
    scene.show(last.poses)
    core = make_drawn_core()
    core.world.data.qpos[:] = played.qpos[last.step]
    mujoco.mj_forward(core.world.model, core.world.data)
    for name in ("xpos", "geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "light_xpos"):
        np.testing.assert_allclose(getattr(scene.data, name), getattr(core.world.data, name), atol=1e-4, err_msg=name)
    tip = scene.make_tips(played.header.robots)["left"].read_position(scene.data)
    np.testing.assert_allclose(tip, played.tips[last.step], atol=1e-6)


@pytest.mark.parametrize("text", ["operator", "top=0.4,-0.3,2.4->0,0,0.7:35"])
def test_a_camera_sees_what_is_in_its_frustum(played: Played, text: str) -> None:
    with Recording.open(played.path) as recording:
        scene = PosedScene(recording)
    spec, aspect = parse_camera(text), 1.5
    if spec.camera:
        camera = scene.model.camera("operator").id
        eye, R = scene.data.cam_xpos[camera], scene.data.cam_xmat[camera].reshape(3, 3)
        fovy = float(scene.model.cam_fovy[camera])
    else:
        eye, fovy = np.array(spec.eye), spec.fovy
        back = (eye - np.array(spec.target)) / np.linalg.norm(eye - np.array(spec.target))
        right = np.cross((0.0, 0.0, 1.0), back) / np.linalg.norm(np.cross((0.0, 0.0, 1.0), back))
        R = np.array([right, np.cross(back, right), back]).T
    projection, slope, seen = Projection(scene, spec, aspect), np.tan(np.radians(fovy) / 2.0), []
    for point in np.random.default_rng(1).uniform(-3.0, 3.0, (400, 3)):
        x, y, z = R.T @ (point - eye)
        is_seen = z < -0.05 and abs(x) < -z * slope * aspect and abs(y) < -z * slope
        assert projection.sees(point) == is_seen, point
        seen.append(is_seen)
    assert 20 < sum(seen) < 380


def test_a_film_strip_shows_the_states(played: Played) -> None:
    spans = [one.span_ns for one in read(played.path).episodes]
    strips = {(i, camera): strip for i, camera, strip in draw_strips(played.path, spans, CAMERAS[:1])}
    assert {key: strip.shape for key, strip in strips.items()} == {
        (i, 0): (HEIGHT, N_PICTURES * WIDTH, 3) for i in range(3)
    }
    due_ns = (spans[2][0] * 0.5 + spans[2][1] * 6.5) / N_PICTURES
    last = [state for state in played.batch.states if state.session_time <= due_ns][-1]
    core = make_drawn_core()
    core.world.data.qpos[:] = played.qpos[last.step]
    mujoco.mj_forward(core.world.model, core.world.data)
    gl = open_gl(WIDTH, HEIGHT)
    renderer = Renderer(core.world.model, WIDTH, HEIGHT, [], plain=True)
    camera = mujoco.MjvCamera()
    camera.type, camera.fixedcamid = int(mujoco.mjtCamera.mjCAMERA_FIXED), 0
    expected = renderer.draw(core.world.data, camera)
    renderer.close()
    gl.free()
    first, latest = strips[0, 0][:, :WIDTH].astype(int), strips[2, 0][:, -WIDTH:].astype(int)
    assert np.abs(latest - expected).mean() < 0.01
    assert np.abs(latest - first).mean() > 0.1, "the arm has moved"


def test_a_folder_with_recordings_that_do_not_fit_is_listed_and_not_exported(tmp_path: Path, played: Played) -> None:
    shutil.copyfile(played.path, tmp_path / "a.rrd")
    panda = make_core(load_model(scene_path("handover")))
    robots = (panda.scene.robots[0], msgspec.structs.replace(panda.scene.robots[1], name="gripper"))
    core = SessionCore(panda.world.model, msgspec.structs.replace(panda.config, robots=robots))
    record(tmp_path / "b.rrd", {3: "start", 9: "success"}, steps=12, core=core)
    (tmp_path / "c.rrd").write_bytes(played.path.read_bytes()[:100])
    data = bytearray(played.path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 40] = bytes(40)
    (tmp_path / "d.rrd").write_bytes(data)
    write_curation(tmp_path / "a.rrd", Curation("00", {1: EpisodeCuration(drop=True)}))
    files = list_files([tmp_path])
    a, b, c, d = (attach_edits(one) for one in list_recordings(files))
    assert [len(one.episodes) for one in (a, b, c, d)] == [3, 1, 0, 3]
    assert "is the curation of another recording" in a.problems[0]
    assert b.problems == (f"does not fit {files[0]} in one data set: robots left, gripper, not left, right",)
    assert c.problems
    assert d.problems
    assert "is damaged" in d.problems[0]
    (tmp_path / "a.rrd.episodes.json").unlink()
    (tmp_path / "c.rrd").unlink()
    with pytest.raises(DatasetError, match=r"d.rrd is damaged"):
        make_plan(list_files([tmp_path]))
    (tmp_path / "d.rrd").unlink()
    with pytest.raises(DatasetError, match=r"b.rrd does not fit .*a.rrd in one data set: robots left, gripper, not"):
        make_plan(list_files([tmp_path]))


def test_a_recording_that_does_not_verify_is_marked(tmp_path: Path) -> None:
    played = record(tmp_path / "session.rrd", {3: "start", 9: "success"}, steps=12)
    assert read(played.path, verify=True).problems == ()
    row = played.batch.rows[5]
    played.batch.rows[5] = msgspec.structs.replace(row, digest=bytes(16))
    played.path.unlink()
    played.write()
    assert read(played.path, verify=True).problems[0].startswith("does not verify: FAILED at step 5")


def test_a_recording_without_episodes_is_one(tmp_path: Path) -> None:
    (whole,) = read(record(tmp_path / "session.rrd", {}, steps=20).path).episodes
    assert isinstance(whole, ListedEpisode)
    assert (whole.number, whole.verdict, whole.duration_s) == (0, "unknown", pytest.approx(0.038, abs=1e-3))
