"""`RobotEnv`: a policy of Gymnasium in a live session, beside people."""

from __future__ import annotations

import io
from typing import Any

import mujoco
import numpy as np
import pytest
from gymnasium.wrappers import PassiveEnvChecker
from PIL import Image

from iris_session.client import Client, ClientError, DeniedError, robot_env
from iris_session.client.cameras import CameraFeed
from iris_session.client.media import MediaFeed, MediaFrame
from iris_session.client.robot_env import RobotEnv
from iris_session.protocol.client_messages import Control, RemoveParticipant
from iris_session.protocol.media import MediaHeader
from iris_session.protocol.names import ControlAction, LeaseMode
from tests.rig.session import Rig

MS = 1_000_000
AGE_NS = 500 * MS


@pytest.fixture
def rig(monkeypatch: pytest.MonkeyPatch) -> Any:
    with Rig(timestep=0.01) as rig:
        monkeypatch.setattr(
            robot_env, "Client", lambda _address, name, role, **options: rig.open(name, role, **options)
        )
        monkeypatch.setattr(Client, "start", lambda self: self)  # the rig polls
        yield rig


def test_actions_are_ctrl_and_observations_are_what_is_exported(rig: Rig) -> None:
    env = RobotEnv("", ["left", "right"], hz=20)
    observation, info = env.reset(seed=1)
    assert env.observation_space.contains(observation)
    assert not any(info["intervention"].values())
    specs, data = rig.session.stepper.core.scene.robots, rig.session.stepper.core.world.data
    names = [name for one in specs for name in (*one.actuators, *(g.actuator for g in one.gripper_actuators))]
    assert env.action_space.shape == (len(names),)
    action = np.array(info["ctrl"])
    n = len(names) // 2
    action[0] += 0.1  # [rad]
    action[n - 1] = env.action_space.high[n - 1]  # the gripper of `left`
    for _ in range(40):
        observation, reward, terminated, truncated, info = env.step(action)
        assert env.observation_space.contains(observation)
    assert (reward, terminated, truncated) == (0.0, False, False)
    assert all(info["driven"].values())
    reached = [data.actuator(name).ctrl[0] for name in names]
    assert np.abs(np.array(reached) - action).max() < 0.02
    joints = [data.joint(joint).qpos[0] for joint in specs[0].joints]
    assert np.abs(observation["agent_pos"][: len(joints)] - joints).max() < 1e-3
    assert observation["agent_pos"][len(joints)] == pytest.approx(1.0, abs=0.05) or specs[0].gripper_open > 0
    assert observation["environment_state"][:3] == pytest.approx(data.body(env.objects[0]).xpos, abs=1e-3)
    with pytest.raises(ValueError, match="shape"):
        env.step(action[1:])
    with pytest.raises(ValueError, match="not finite"):
        env.step(np.full_like(action, np.nan))
    env.close()
    rig.run(0.5)
    assert all(lease.holder == "" for lease in rig.join("eve", "observer").mirror.leases.values())


def test_people_preempt_the_policy_and_it_goes_on_when_they_stand_by(rig: Rig) -> None:
    director = rig.join("dora", "director")
    director.set_mode("left", LeaseMode.PRIORITY)
    env = RobotEnv("", ["left"], hz=20, resets=True)
    _, info = env.reset()
    action = np.array(info["ctrl"])
    for _ in range(10):
        *_, info = env.step(action)
    assert info["driven"]["left"]
    hand = rig.drive("ann", "left", velocity=(0.0, 0.02, 0.0))
    for _ in range(10):
        *_, info = env.step(action)
    assert info["intervention"]["left"]
    assert not info["driven"]["left"]
    assert np.abs(info["ctrl"] - action).max() > 1e-3, "the command in force is that of the person"
    hand.clutch, hand.velocity = False, (0.0, 0.0, 0.0)
    for _ in range(100):
        *_, info = env.step(action)
    assert not info["intervention"]["left"]
    assert info["driven"]["left"]
    assert np.abs(info["ctrl"] - action).max() < 0.02, "it is back where the policy wants it"
    epoch = director.mirror.scene_epoch
    env.reset()
    assert director.mirror.scene_epoch > epoch
    env.close()


def test_what_cannot_be_driven_is_an_error(rig: Rig) -> None:
    with pytest.raises(ClientError, match="left, right"):
        RobotEnv("", ["middle"])
    with pytest.raises(ClientError, match="at least one"):
        RobotEnv("")
    with pytest.raises(ClientError, match="1 to 240"):
        RobotEnv("", ["left"], hz=0)
    rig.run(0.1)
    assert all(client.connection.phase.name == "CLOSED" for client in rig.clients)


class PictureSource:
    """Pictures of two cameras, drawn every 50 ms, half a second old: grey values count them."""

    def __init__(self, rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
        self._rig = rig
        self._feeds: list[MediaFeed] = []
        monkeypatch.setattr(Client, "camera", lambda client, name, _: self._open(client, name))
        self._draw()

    def _open(self, client: Client, name: str) -> CameraFeed:
        if name not in ("top", "left/wrist"):
            raise ClientError(f"no camera {name}")
        feed = MediaFeed(name.replace("/", "_"))
        self._feeds.append(feed)
        return CameraFeed(name, feed, client.media, client.wait_for, client.session_now_ns)

    def _draw(self) -> None:
        simulation = self._rig.simulation
        simulation.call_at(simulation.now_ns + 50 * MS, self._draw)
        for feed in self._feeds:
            feed.received += 1
            file = io.BytesIO()
            Image.new("RGB", (16, 8), (feed.received,) * 3).save(file, "JPEG", quality=95)
            capture_ns = self._rig.session.clock() - AGE_NS
            header = MediaHeader(feed.stream, "full", 1, feed.received, capture_ns, capture_ns, "jpeg")
            feed.newest = MediaFrame(header, file.getvalue(), 0)


def test_pictures_of_cameras_are_observed(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    PictureSource(rig, monkeypatch)
    env = RobotEnv("", ["left"], hz=20, cameras=("top", "left/wrist"), resets=True)
    spaces = env.observation_space["pixels"]
    assert {name: spaces[name].shape for name in spaces} == {"top": (8, 16, 3), "left_wrist": (8, 16, 3)}
    asked_ns = rig.session.clock()
    observation, info = env.reset()
    assert env.observation_space.contains(observation)
    assert min(info["capture_ns"].values()) > asked_ns, "it shows what is after the reset"
    seen = [int(observation["pixels"]["top"][0, 0, 0])]
    for _ in range(5):
        observation, *_, info = env.step(info["ctrl"])
        assert env.observation_space.contains(observation)
        seen.append(int(observation["pixels"]["top"][0, 0, 0]))
        assert set(info["capture_ns"]) == {"top", "left_wrist"}
        assert 0 < info["session_time_ns"] - info["capture_ns"]["left_wrist"] - AGE_NS + 50 * MS < 100 * MS
    assert sorted(set(seen)) == seen, "each step has a newer one"
    env.close()
    with pytest.raises(ClientError, match="no camera side"):
        RobotEnv("", ["left"], cameras="side")


@pytest.mark.filterwarnings("ignore:.*Box observation space")
def test_it_passes_the_checks_of_gymnasium(rig: Rig) -> None:
    env = PassiveEnvChecker(RobotEnv("", ["right"], hz=20))
    _, info = env.reset(seed=1)
    env.step(info["ctrl"])
    env.close()


def test_it_goes_on_when_people_reset_the_scene_and_ends_with_another_one(rig: Rig) -> None:
    director = rig.join("dora", "director")
    env = RobotEnv("", ["left"], hz=173)  # steps end at all places between two states
    _, info = env.reset()
    for i in range(100):
        if i % 20 == 0:
            director.submit(Control(0, ControlAction.RESET))
        observation, *_, info = env.step(info["ctrl"])
        assert np.isfinite(observation["environment_state"]).all()
    assert director.mirror.scene_epoch >= 6
    scene = "<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
    rig.session.load_scene(mujoco.MjModel.from_xml_string(scene)).result(60.0)
    rig.run(0.2)
    with pytest.raises(ClientError, match="another scene"):
        env.step(info["ctrl"])
    with pytest.raises(ClientError, match="another scene"):
        env.reset()
    env.close()
    env.close()


def test_of_two_robots_it_takes_both_or_none(rig: Rig) -> None:
    director = rig.join("dora", "director")
    hand = rig.drive("ann", "right")
    env = RobotEnv("", ["left", "right"], hz=20)
    with pytest.raises(DeniedError, match="ann"):
        env.reset()
    rig.run(0.2)
    assert director.mirror.leases["left"].holder == ""
    hand.client.release("right")
    _, info = env.reset()
    assert not env.step(info["ctrl"])[3]
    director.request(RemoveParticipant(0, env._clients["right"].participant_id))
    rig.run(0.2)
    assert env.step(info["ctrl"])[3], "a robot without its client is the end"


def test_an_intervention_that_ends_while_the_policy_is_disconnected_is_over(rig: Rig) -> None:
    director = rig.join("dora", "director")
    director.set_mode("left", LeaseMode.PRIORITY)
    env = RobotEnv("", ["left"], hz=20)
    _, info = env.reset()
    hand = rig.drive("ann", "left", velocity=(0.0, 0.02, 0.0))
    for _ in range(10):
        *_, info = env.step(info["ctrl"])
    assert info["intervention"]["left"]
    rig.cut(env._clients["left"])
    hand.client.release("left")
    for _ in range(100):
        *_, info = env.step(info["ctrl"])
    assert not info["intervention"]["left"]
    assert info["driven"]["left"]
