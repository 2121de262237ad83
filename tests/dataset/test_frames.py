"""Frames are what the session had at their time, bit for bit, and their actions give the episode again."""

from __future__ import annotations

from pathlib import Path

import msgspec
import mujoco
import numpy as np
import pytest

from iris_session.dataset.episodes import DatasetError, PlannedEpisode, PlanOptions, make_plan
from iris_session.dataset.frames import EpisodeLeftOutError, FrameReader, Schema, Table, make_schema
from iris_session.demo.scenes import scene_path
from iris_session.physics.load import load_model
from iris_session.physics.world import STATE
from iris_session.protocol.client_messages import Control
from iris_session.protocol.entries import Entry
from iris_session.recording import CLOSED, OPEN, Recording
from iris_session.replay.plant_reader import PlantReader
from tests.dataset.support import EPISODES, make_entries, record
from tests.replay.support import Played, damaged, make_drawn_core, play
from tests.session.play import host, make_core

ALL = PlanOptions(("success", "failure", "unknown"))


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Played:
    return record(tmp_path_factory.mktemp("played") / "session.rrd")


def read(played: Played, fps: int, **changes: object) -> tuple[Schema, list[tuple[PlannedEpisode, Table | str]]]:
    """Return the frames of all episodes, or why one has none."""
    plan = make_plan([played.path], ALL)
    schema = make_schema(make_drawn_core(), fps)
    found: list[tuple[PlannedEpisode, Table | str]] = []
    with Recording.open(played.path, warn=False) as recording:
        reader = FrameReader(recording, plan.recordings[0], schema)
        for planned in plan.episodes:
            episode = msgspec.structs.replace(planned, **changes)
            try:
                found.append((episode, reader.read(episode)))
            except EpisodeLeftOutError as error:
                found.append((episode, str(error)))
    return schema, found


def test_at_the_rate_of_ticks_frames_are_the_states_of_the_session(played: Played) -> None:
    _, found = read(played, 500)
    assert [(one.number, one.label) for one, _ in found] == [(1, "success"), (2, "failure"), (3, "success")]
    joints = played.columns()
    for (episode, table), (begin, end) in zip(found, ((20, 90), (100, 150), (160, 190)), strict=True):
        assert isinstance(table, Table)
        assert (episode.first_step, episode.end_step, table.n_frames) == (begin, end, end - begin)
        before = np.array(played.qpos[begin - 1 : end - 1])  # a tick begins with the state after the step before
        assert table.columns["robots.left.joint_positions"].tobytes() == before[:, joints].tobytes()
        ctrl = np.array(played.ctrl[begin:end])
        names = [*played.header.robots[0].actuators, played.header.robots[0].gripper_actuator]
        columns = [played.core.world.model.actuator(name).id for name in names]
        assert table.columns["robots.left.action"].tobytes() == ctrl[:, columns].tobytes()
        assert table.columns["session_time_ns"][:, 0].tolist() == played.session_time[begin:end]


def test_actions_applied_to_the_first_state_give_the_episode_again(played: Played) -> None:
    schema, found = read(played, 500)
    model = played.core.world.model
    for _, table in found:
        assert isinstance(table, Table)
        data = mujoco.MjData(model)
        mujoco.mj_setState(model, data, table.states[0].copy(), STATE)
        for frame in range(table.n_frames):
            for robot in schema.robots:
                joints = [int(model.joint(name).qposadr[0]) for name in robot.joints]
                had = table.columns[robot.make_key("joint_positions")][frame]
                assert data.qpos[joints].tobytes() == had.tobytes(), f"frame {frame}"
                for name, value in zip(robot.actuators, table.columns[robot.make_key("action")][frame], strict=True):
                    data.ctrl[model.actuator(name).id] = value
            mujoco.mj_step(model, data)
    assert np.ptp(found[0][1].columns["robots.left.joint_positions"], axis=0).max() > 1e-4  # type: ignore[union-attr]


def sum_contact_forces(model: mujoco.MjModel, data: mujoco.MjData, body: str) -> np.ndarray:
    """Return the contact force on a body and those below it, as docs/datasets.md defines it."""
    root, total = model.body(body).id, np.zeros(3)
    for row, contact in enumerate(data.contact):
        sides = [model.body_rootid[model.geom_bodyid[geom]] == root for geom in contact.geom]
        if sides[0] != sides[1]:
            force = np.zeros(6)
            mujoco.mj_contactForce(model, data, row, force)
            total += (1.0 if sides[1] else -1.0) * contact.frame.reshape(3, 3).T @ force[:3]
    return total


@pytest.mark.parametrize("recording_class", [CLOSED, OPEN])
def test_contact_forces_of_objects_are_those_of_the_state_before_its_action(
    recording_class: str, tmp_path: Path
) -> None:
    model = load_model(scene_path("handover"))
    at = model.jnt_qposadr[model.body("board").jntadr[0]]
    model.key_qpos[0, at : at + 7] = (-0.2, 0.0, 0.46, 1.0, 0.0, 0.0, 0.0)  # on the left arm
    core = make_core(model, user_owned_loop=recording_class == OPEN)
    made = record(tmp_path / "session.rrd", core=core, recording_class=recording_class)
    data = mujoco.MjData(model)
    for episode, table in read(made, 500)[1]:
        assert isinstance(table, Table)
        for frame, state in enumerate(table.states):
            mujoco.mj_setState(model, data, state.copy(), STATE)
            data.ctrl[:] = made.ctrl[episode.first_step + frame - 1]
            mujoco.mj_forward(model, data)
            for one in made.header.objects:
                force = table.columns[f"objects.{one.name}.contact_force"][frame]
                assert np.allclose(force, sum_contact_forces(model, data, one.body), rtol=0.0, atol=1e-9)
        carried = table.columns["objects.board.contact_force"].mean(axis=0)
        assert carried == pytest.approx([0.0, 0.0, 0.26 * 9.81], abs=0.5)


@pytest.mark.parametrize("fps", [30, 37, 499])
def test_a_frame_is_the_newest_state_that_is_not_later(played: Played, fps: int) -> None:
    _, exact = read(played, 500)
    _, found = read(played, fps)
    for (_, all_ticks), (_, table) in zip(exact, found, strict=True):
        assert isinstance(table, Table)
        assert isinstance(all_ticks, Table)
        times = table.columns["sim_time_s"][:, 0] - table.columns["sim_time_s"][0, 0]
        late = np.arange(table.n_frames) / fps - times
        assert (late > -1e-9).all()
        assert (late < 0.002 + 1e-9).all()
        ticks = np.round(times / 0.002).astype(int)
        assert len(set(ticks)) == table.n_frames, "no frame is doubled"
        assert table.n_frames == len({k * 500 // fps for k in range(1000)} & set(range(all_ticks.n_frames)))
        for key, values in all_ticks.columns.items():
            assert table.columns[key].tobytes() == values[ticks].tobytes(), key


def test_who_commands_is_in_every_frame(played: Played) -> None:
    _, found = read(played, 500)
    table = found[0][1]
    assert isinstance(table, Table)
    engaged = table.columns["robots.left.engaged"][:, 0]
    operator = table.columns["robots.left.operator"][:, 0]
    pose = table.columns["robots.left.operator_pose"]
    assert not engaged[:30].any()
    assert engaged[-1]
    assert set(operator[engaged]) == {0}
    assert set(operator[~engaged]) == {-1}
    assert (np.linalg.norm(pose[engaged][:, 3:], axis=1) > 0.99).all()
    assert not pose[~engaged].any()
    assert not table.columns["robots.right.engaged"].any()
    assert (table.columns["robots.left.gripper"] < 0.1).all(), "0 is open"


def test_class_open_is_read(tmp_path: Path) -> None:
    made = record(tmp_path / "session.rrd", recording_class=OPEN)
    _, found = read(made, 500)
    (_, table), joints = found[0], made.columns(1)
    assert isinstance(table, Table)
    before = np.array(made.qpos[20:90])  # in this class, of the beginning of the step
    assert table.columns["robots.right.joint_positions"].tobytes() == before[:, joints].tobytes()
    _, found = read(made, 100)
    assert isinstance(found[0][1], Table)
    assert found[0][1].columns["robots.right.joint_positions"].tobytes() == before[::5, joints].tobytes()


def test_a_trim_keeps_the_frames_within(played: Played) -> None:
    _, found = read(played, 500)
    _, trimmed = read(played, 500, trim=(0.02, 0.05))
    one, other = found[0][1], trimmed[0][1]
    assert isinstance(one, Table)
    assert isinstance(other, Table)
    assert other.n_frames == 16
    for key, values in one.columns.items():
        assert other.columns[key].tobytes() == values[10:26].tobytes(), key


def test_episodes_without_exact_frames_are_named(tmp_path: Path) -> None:
    def with_reset(step: int) -> list[Entry]:
        return [*make_entries()(step), *([host(0, Control(0, "reset"))] if step == 60 else [])]

    made = play(tmp_path / "session.rrd", 200, make_entries=with_reset, core=make_drawn_core())
    made.batch.rows[120] = damaged(made.batch.rows[120])
    made.write()
    (_, ended), (_, damage), (_, after) = read(made, 100)[1]
    assert isinstance(ended, Table), "a reset ends an episode"
    assert ended.n_frames == 8
    assert "step 120 is missing or damaged" in str(damage)
    assert isinstance(after, Table), "others are not concerned"
    within = read(made, 100, first_step=20, end_step=90)[1][0][1]
    assert "reset or loaded 0.08 s after its beginning" in str(within)
    begun = read(made, 100, first_step=60, end_step=90)[1][0][1]
    assert isinstance(begun, Table), "a reset may begin an episode"
    data = made.core.world.make_initial_data()
    mujoco.mj_forward(made.core.world.model, data)
    force = sum_contact_forces(made.core.world.model, data, "board")
    assert begun.columns["objects.board.contact_force"][0] == pytest.approx(force, abs=1e-9)


def test_lateness_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.replay.support.step_ns", lambda step: step * 2_000_000 + (step > 60) * 80_000_000 + 1)
    made = record(tmp_path / "session.rrd", EPISODES)
    (_, table), (_, other), _ = read(made, 100)[1]
    assert isinstance(table, Table)
    assert isinstance(other, Table)
    assert "the loop was late or paused, 0.08 s" in table.notes[0]
    assert not other.notes
    assert np.allclose(np.diff(table.columns["sim_time_s"][:, 0]), 0.01)


def test_rates_above_that_of_the_ticks_are_refused() -> None:
    with pytest.raises(DatasetError, match="--fps 501 is more than the 500 ticks a second of the recording"):
        make_schema(make_drawn_core(), 501)


def test_the_reader_agrees_with_that_of_recordings(played: Played) -> None:
    reader = PlantReader(played.core)
    assert set(reader.robots) == {"left", "right"}
