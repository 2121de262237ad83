"""Numbers of robots and objects, commands, samples and events, through the public `Recording`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import msgspec
import mujoco
import numpy as np
import pytest

from iris_session import Recording, RecordingError
from iris_session.authority import AuthorityConfig
from iris_session.control import ControlConfig
from iris_session.demo.scenes import n_arms_scene
from iris_session.physics import UnknownNameError, decode_model, find_objects, find_robots
from iris_session.physics.kinematic_model import KinematicModel
from iris_session.physics.load import compute_scene_hash, encode_model
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Entry, SceneLoaded
from iris_session.recording import OPEN
from iris_session.replay.recorded_session import CommandSeries
from iris_session.session.core import CoreConfig, SessionCore
from tests.physics.models import arm
from tests.physics.models import model as compile_model
from tests.replay.support import Played, play, scene_model, step_ns
from tests.session.play import TICK_NS, entries, host, make_core

STEPS = 200


@pytest.fixture(scope="module")
def closed(tmp_path_factory: pytest.TempPathFactory) -> Played:
    played = play(tmp_path_factory.mktemp("closed") / "session.rrd", STEPS)
    played.write()
    return played


@pytest.fixture(scope="module")
def opened(tmp_path_factory: pytest.TempPathFactory) -> Played:
    played = play(tmp_path_factory.mktemp("open") / "session.rrd", STEPS, recording_class=OPEN)
    played.write()
    return played


@pytest.mark.parametrize(("recording_class", "robot"), [("closed", "left"), ("open", "right")])
def test_joints_at_the_rate_of_the_session_are_qpos_bit_for_bit(
    recording_class: str, robot: str, closed: Played, opened: Played
) -> None:
    played = closed if recording_class == "closed" else opened
    with Recording.open(played.path) as recording:
        joints = recording.robot(robot).joints(hz=500)
    columns = played.columns(["left", "right"].index(robot))
    expected = np.array(played.qpos)[:, columns]
    assert joints.values.tobytes() == expected.tobytes()
    assert joints.names == tuple(f"{robot}/joint{i}" for i in range(1, 8))
    assert joints.steps.tolist() == list(range(STEPS))
    assert joints.session_time_ns.tolist() == played.session_time
    assert np.allclose(joints.times_s, np.array(played.session_time) * 1e-9)
    first = 0.0 if recording_class == "open" else 0.002
    assert np.allclose(joints.sim_time_s, first + np.arange(STEPS) * 0.002)
    assert len(np.unique(joints.values[:, 0])) > STEPS / 2, f"{robot} moves"


def test_a_lower_rate_has_some_of_the_rows_as_they_are(closed: Played) -> None:
    with Recording.open(closed.path) as recording:
        joints = recording.robot("left").joints(hz=100)
    assert len(joints.steps) == STEPS / 5
    assert joints.values.tobytes() == np.array(closed.qpos)[:, closed.columns()][joints.steps].tobytes()
    assert joints.session_time_ns.tolist() == [closed.session_time[step] for step in joints.steps]
    columns = joints.to_dict()
    assert list(columns) == ["step", "session_time_ns", "sim_time_s", *joints.names]
    assert np.array_equal(columns["left/joint3"], joints.values[:, 2])


def test_poses_and_speeds_are_those_of_mujoco(closed: Played) -> None:
    model = closed.core.world.model
    data = mujoco.MjData(model)
    with Recording.open(closed.path) as recording:
        left, hammer = recording.robot("left"), recording.object("hammer")
        tip, speed, velocities, poses = left.end_effector(), left.tip_speed(), left.velocities(), hammer.poses()
    assert tip.values[:, :3].tobytes() == np.array(closed.tips).tobytes()
    assert poses.values.tobytes() == np.array(closed.bodies)[:, model.body("hammer").id].tobytes()
    dofs = [int(model.joint(name).dofadr[0]) for name in velocities.names]
    assert velocities.values.tobytes() == np.array(closed.qvel)[:, dofs].tobytes()
    assert tip.names == poses.names == ("x", "y", "z", "qw", "qx", "qy", "qz")
    site, linear, angular, quat = model.site(closed.header.robots[0].site).id, *np.zeros((2, 3, model.nv)), np.zeros(4)
    for step in (0, 90, 119):
        data.qpos[:], data.qvel[:] = closed.qpos[step], closed.qvel[step]
        mujoco.mj_forward(model, data)
        mujoco.mj_jacSite(model, data, linear, angular, site)
        expected = [np.linalg.norm(linear @ data.qvel), np.linalg.norm(angular @ data.qvel)]
        assert speed.values[step] == pytest.approx(expected, rel=1e-9)
        mujoco.mju_mat2Quat(quat, data.site_xmat[site])
        assert tip.values[step, 3:] == pytest.approx(quat, abs=1e-12)
    assert speed.values[119, 0] == pytest.approx(0.2, rel=0.2), "as fast as the hand"


def close_gripper(step: int) -> list[Entry]:
    """Return ann's entries with a gripper that closes from step 60 on."""
    taken = entries(step)
    if step < 60 or not taken:
        return taken
    (entry,) = taken
    return [msgspec.structs.replace(entry, message=msgspec.structs.replace(entry.message, gripper=1.0))]


def test_a_gripper_opens_from_0_to_1(tmp_path: Path) -> None:
    played = play(tmp_path / "session.rrd", 250, make_entries=close_gripper)
    with Recording.open(played.write()) as recording:
        opening = recording.robot("left").gripper(hz=500)
        commands = recording.robot("left").commands(hz=500)
    assert opening.names == ("opening",)
    assert opening.values[:60, 0] == pytest.approx(1.0, abs=0.01)
    assert opening.values[-1, 0] == pytest.approx(0.0, abs=0.05)
    # The actuator drives both fingers: 0.04 m open, 0 closed.
    fingers = np.array(played.qpos)[:, 7:9].mean(axis=1)
    assert opening.values[:, 0] == pytest.approx(fingers / 0.04, abs=1e-9)
    assert np.isnan(commands.gripper[:60]).all()
    assert commands.gripper[-1] == 1.0


def test_contact_forces_carry_what_lies_on_the_table(closed: Played) -> None:
    with Recording.open(closed.path) as recording:
        board = recording.object("board").contact_force(hz=50)
        hand = recording.robot("left").contact_force(hz=50)
    assert board.names == hand.names == ("normal_n",)
    assert board.values[-1, 0] == pytest.approx(0.26 * 9.81, rel=0.02), "it has come to rest"
    assert not hand.values.any(), "the hand is in the air"


def test_commands_name_who_drives_and_what_the_actuators_got(closed: Played) -> None:
    with Recording.open(closed.path) as recording:
        left, right = (recording.robot(name).commands(hz=500) for name in ("left", "right"))
    assert isinstance(left, CommandSeries)
    assert left.names == (*closed.header.robots[0].actuators, closed.header.robots[0].gripper_actuator)
    actuators = [closed.core.world.model.actuator(name).id for name in left.names]
    assert left.values.tobytes() == np.array(closed.ctrl)[:, actuators].tobytes()
    assert set(left.kinds[56:]) == {"pose"}
    columns = left.to_dict()
    assert {len(column) for column in columns.values()} == {len(left.steps)}
    assert {"step", "kind", "gripper", *(f"ctrl/{name}" for name in left.names)} <= columns.keys()
    assert set(left.kinds[:50]) == {"hold"}
    assert list(dict.fromkeys(left.hold_reasons[:56])) == ["no_lease", "no_sample", "clutch_open"]
    assert set(left.participants[56:]) == {"p1"}
    assert set(left.devices[56:]) == {"desktop"}
    assert set(right.kinds) == {"hold"}
    assert set(right.participants) == {""}
    assert left.scale.tolist() == [1.0] * STEPS
    assert left.times_s[0] == closed.session_time[0] * 1e-9


def test_commands_of_open_sessions_run_control_again(opened: Played) -> None:
    with Recording.open(opened.path) as recording:
        left = recording.robot("left").commands()
    actuators = [opened.core.world.model.actuator(name).id for name in left.names]
    assert left.values.tobytes() == np.array(opened.ctrl)[:, actuators].tobytes()
    assert set(left.kinds[56:]) == {"pose"}


# --- names and damage -------------------------------------------------------------------------------------------------


def test_names_that_are_none_are_listed_before_anything_is_simulated(
    closed: Played, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(SessionCore, "step")
    with Recording.open(closed.path) as recording:
        with pytest.raises(UnknownNameError, match=r"robot 'lift' does not exist .* left, right"):
            recording.robot("lift")
        with pytest.raises(UnknownNameError, match=r"object 'left' does not exist .* hammer, board"):
            recording.object("left")
        with pytest.raises(ValueError, match="give a rate above 0"):
            recording.robot("left").joints(hz=0)


def test_a_part_that_a_robot_does_not_have_is_an_error(tmp_path: Path) -> None:
    body, actuators = arm("bare")
    xml = f"<mujoco><worldbody>{body}</worldbody><actuator>{actuators}</actuator></mujoco>"
    played = play(tmp_path / "session.rrd", 3, core=make_core(compile_model(xml)), make_entries=lambda step: [])
    with Recording.open(played.write()) as recording:
        assert recording.robot("bare").joints().names == ("bare/j0", "bare/j1", "bare/j2", "bare/j3")
        with pytest.raises(RecordingError, match="robot 'bare' has no gripper: it has joints, velocities, "):
            recording.robot("bare").gripper()


def test_steps_that_are_left_out_are_a_warning(tmp_path: Path) -> None:
    played = play(tmp_path / "session.rrd", 50)
    del played.batch.rows[25]
    with Recording.open(played.write()) as recording, pytest.warns(UserWarning, match=r"15 steps are .*: 25 to 39$"):
        joints = recording.robot("left").joints()
    assert joints.steps.tolist() == [*range(25), *range(40, 50)]
    assert joints.values.tobytes() == np.array(played.qpos)[:, played.columns()][joints.steps].tobytes()


# --- another scene ----------------------------------------------------------------------------------------------------

AT = 60


@pytest.fixture(scope="module")
def changed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Played, SceneLoaded]:
    """Return a session in which another scene, with other robots and objects, is loaded at step `AT`."""
    arms = n_arms_scene(3, objects=3).compile()
    scene = SceneLoaded(compute_scene_hash(encode_model(arms)), find_robots(arms).robots, find_objects(arms))
    first = make_core()
    core = SessionCore(first.world.model, first.config, lambda _: decode_model(bytes(encode_model(arms))))

    def change(step: int) -> Sequence[Entry]:
        return [host(step_ns(step), scene)] if step == AT else entries(step) if step < AT else []

    played = play(tmp_path_factory.mktemp("changed") / "session.rrd", 100, core=core, make_entries=change)
    played.batch.scenes = [scene_model(arms, scene.model_hash, AT - 1, core)]
    played.write()
    return played, scene


def test_robots_and_objects_have_the_rows_of_their_scenes(changed: tuple[Played, SceneLoaded]) -> None:
    played, scene = changed
    new = scene.robots[0].name
    with Recording.open(played.path) as recording:
        joints = recording.robot("left").joints()
        other = recording.robot(new).joints()
        cup = recording.object(scene.objects[0].name).poses()
        with pytest.raises(UnknownNameError, match="Available robots: left, right, arm1, arm2, arm3"):
            recording.robot("lift").joints()
    assert joints.steps.tolist() == list(range(AT))
    assert other.steps.tolist() == cup.steps.tolist() == list(range(AT, 100))
    columns = [int(played.core.world.model.joint(name).qposadr[0]) for name in scene.robots[0].joints]
    assert other.values.tobytes() == np.array(played.qpos[AT:])[:, columns].tobytes()
    assert other.sim_time_s[0] == pytest.approx(TICK_NS * 1e-9)


# --- samples and events -----------------------------------------------------------------------------------------------


def test_bodies_of_a_published_world_have_poses(tmp_path: Path) -> None:
    """A kinematic model, moved by frames of a publisher; the rows between them have no plant."""
    kinematic = KinematicModel(("crate", "drum"), (Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)),) * 2)
    core = SessionCore(kinematic.model, CoreConfig(AuthorityConfig(user_owned_loop=True), ControlConfig(), (), ()))
    frames = {3: 0.25, 6: 0.5}

    def make_plant(step: int) -> bytes:
        if step not in frames:
            return b""
        return kinematic.encode_state(frames[step], np.array([(frames[step], 0, 1, 1, 0, 0, 0), (0, 0, 1, 1, 0, 0, 0)]))

    played = play(tmp_path / "session.rrd", 9, core=core, make_entries=lambda _: [], make_plant=make_plant)
    with Recording.open(played.write()) as recording:
        crate = recording.object("crate").poses()
        with pytest.raises(RecordingError, match="object 'crate' has no contact_force: it has pose"):
            recording.object("crate").contact_force()
        with pytest.raises(UnknownNameError, match="Available objects: crate, drum"):
            recording.object("cup")
    assert crate.values[:, 0].tolist() == [0.0] * 3 + [0.25] * 3 + [0.5] * 3
    assert crate.values[0].tolist() == [0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0]
    assert crate.sim_time_s[-1] == 0.5
