"""`iris-session policy`: what fits, what is said, and what happens at an intervention and while a policy computes.

With LeRobot, where it is installed: a policy that it saved.
"""

from __future__ import annotations

import io
import sys
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from iris_session.cli import policy
from iris_session.cli.common import CommandError
from iris_session.cli.policy import LeRobotPolicy, RunLog, check_fit, drive, make_blank, name_inputs

CAMERA = gymnasium.spaces.Box(0, 255, (8, 16, 3), np.uint8)


class FakeEnv:
    """Steps that a test describes. `interventions`: steps in which a person drives; `n_steps`: then it is lost."""

    robots = ("left",)

    def __init__(self, n_steps: int = 6, interventions: tuple[int, ...] = ()) -> None:
        self.observation_space = gymnasium.spaces.Dict(
            {
                "agent_pos": gymnasium.spaces.Box(-9.0, 9.0, (3,)),
                "environment_state": gymnasium.spaces.Box(-9.0, 9.0, (7,)),
                "pixels": gymnasium.spaces.Dict({"top": CAMERA}),
            }
        )
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,))
        self.actions: list[float] = []
        self.stepped = threading.Event()
        self._n_steps, self._interventions = n_steps, interventions

    def reset(self) -> tuple[dict[str, Any], dict[str, Any]]:
        return {"n": 0}, self._inform()

    def step(self, action: NDArray[Any]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.actions.append(float(action[0]))
        if len(self.actions) == 2:
            self.stepped.set()
        return {"n": len(self.actions)}, 0.0, False, len(self.actions) >= self._n_steps, self._inform()

    def _inform(self) -> dict[str, Any]:
        person = len(self.actions) in self._interventions
        return {
            "ctrl": np.array([-1.0, 0.0]),
            "intervention": {"left": person},
            "driven": {"left": not person and bool(self.actions)},
            "hold_reason": {"left": "clutch_open"},
            "session_time_ns": 90_000_000,
            "capture_ns": {"top": 50_000_000},
        }


class FakePolicy:
    """Acts by the number of the observation; plans like one that has a queue of actions."""

    inputs: dict[str, tuple[int, ...]] = {"observation.state": (3,), "observation.images.top": (3, 8, 16)}  # noqa: RUF012
    n_actions = 2

    def __init__(self, blocked: threading.Event | None = None) -> None:
        self.resets: list[int] = []
        self.acted: list[int] = []
        self._blocked = blocked

    def reset(self) -> None:
        self.resets.append(len(self.acted))

    def act(self, observation: Any) -> NDArray[np.float32]:
        if self._blocked is not None:
            self._blocked.wait(60.0)
        self.acted.append(observation["n"])
        return np.array([observation["n"], 0.0], np.float32)


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy, "PATIENCE_S", 60.0)


def run_drive(env: FakeEnv, own: FakePolicy) -> tuple[bool, RunLog, str]:
    out = io.StringIO()
    log = RunLog(["left"], out)
    any_env: Any = env
    any_policy: Any = own
    lost = drive(any_env, any_policy, log, None)
    log.end()
    return lost, log, out.getvalue()


def test_each_observation_has_its_action_until_the_session_is_lost() -> None:
    env, own = FakeEnv(), FakePolicy()
    lost, log, text = run_drive(env, own)
    assert lost
    assert env.actions[0] == 0.0
    assert env.actions[2:] == [2.0, 3.0, 4.0, 5.0]
    assert log.summarise()["steps"] == 6
    assert "interventions" in text


def test_what_was_planned_before_an_intervention_is_forgotten_after_it() -> None:
    env, own = FakeEnv(9, interventions=(4, 5)), FakePolicy()
    _, log, text = run_drive(env, own)
    assert log.summarise()["interventions"] == {"left": 1}
    assert log.summarise()["shares"]["left"]["intervention"] == pytest.approx(2 / 9, abs=0.01)
    assert own.resets == [0, 1, 4, 6], "at the start, when it drives, when a person does, and when it drives again"
    assert "1 interventions" in text


def test_a_policy_that_computes_for_long_lets_the_command_before_stand(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy, "PATIENCE_S", 0.001)
    env = FakeEnv(40)
    own = FakePolicy(env.stepped)
    run_drive(env, own)
    assert env.actions[:2] == [-1.0, -1.0], "the robot is commanded where it is"
    assert max(env.actions) > 0.0


def test_robots_hold_while_a_policy_does_not_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    deciding, now_s = threading.Event(), 0.0

    def advance() -> float:
        nonlocal now_s
        now_s += 0.3
        if now_s > 20.0:
            deciding.set()
        return now_s

    monkeypatch.setattr(policy, "PATIENCE_S", 0.001)
    monkeypatch.setattr(policy, "time", SimpleNamespace(monotonic=advance))
    env = FakeEnv(40)
    run_drive(env, FakePolicy(deciding))
    before = next(i for i, action in enumerate(env.actions) if action >= 0.0)
    assert before <= 12, "of some sixty rounds, only those of the first second commanded the robot"


def test_every_second_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    now = iter(np.arange(0.0, 1e3, 0.3))
    monkeypatch.setattr(policy, "time", SimpleNamespace(monotonic=lambda: next(now)))
    out = io.StringIO()
    log, env = RunLog(["left"], out), FakeEnv(10, interventions=(8, 9))
    for _ in range(9):
        env.step(np.zeros(2))
        log.note(env._inform())
    first, second = out.getvalue().splitlines()
    assert "left: driven  (3.3 steps/s" in first
    assert "pictures 40 ms old" in first
    assert "left: intervention (clutch_open)" in second


def test_a_policy_of_other_robots_or_cameras_is_refused() -> None:
    env: Any = FakeEnv()
    own: Any = FakePolicy()
    check_fit(own, env)
    assert env.observation_space.contains(make_blank(env))
    assert set(name_inputs(make_blank(env))) == {
        "observation.state", "observation.environment_state", "observation.images.top"
    }  # fmt: skip
    own.inputs = {"observation.images.wrist": (3, 8, 16)}
    with pytest.raises(CommandError, match="give --camera wrist"):
        check_fit(own, env)
    own.inputs = {"observation.images.top": (3, 480, 640)}
    with pytest.raises(CommandError, match=r"\(3, 480, 640\), here it is \(3, 8, 16\): give the camera its size"):
        check_fit(own, env)
    own.inputs = {"observation.state": (14,)}
    with pytest.raises(CommandError, match=r"\(14,\), here it is \(3,\)"):
        check_fit(own, env)
    own.inputs, own.n_actions = {}, 14
    with pytest.raises(CommandError, match="actions of 14 numbers, robots left have"):
        check_fit(own, env)


def test_without_lerobot_one_line_says_how(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lerobot", None)
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(CommandError, match="pip install lerobot"):
        LeRobotPolicy("me/act")


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")
def test_a_policy_that_lerobot_saved(tmp_path: Path) -> None:
    pytest.importorskip("lerobot")
    import torch
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.act.configuration_act import ACTConfig
    from lerobot.policies.act.modeling_act import ACTPolicy
    from lerobot.policies.factory import make_pre_post_processors

    small = {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1, "n_vae_encoder_layers": 1}
    config = ACTConfig(
        device="cpu",
        push_to_hub=False,
        pretrained_backbone_weights=None,
        chunk_size=4,
        n_action_steps=4,
        input_features={
            "observation.state": PolicyFeature(FeatureType.STATE, (3,)),
            "observation.images.top": PolicyFeature(FeatureType.VISUAL, (3, 64, 96)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (2,))},
        **small,
    )
    torch.manual_seed(0)
    made = ACTPolicy(config)
    stats = {
        "observation.state": {"mean": torch.zeros(3), "std": torch.ones(3)},
        "observation.images.top": {"mean": torch.full((3, 1, 1), 0.5), "std": torch.full((3, 1, 1), 0.25)},
        "action": {"mean": torch.tensor([5.0, -5.0]), "std": torch.full((2,), 0.1)},
    }
    before, after = make_pre_post_processors(config, dataset_stats=stats)
    for part in (made, before, after):
        part.save_pretrained(tmp_path)
    loaded = LeRobotPolicy(str(tmp_path))
    assert loaded.inputs == {"observation.state": (3,), "observation.images.top": (3, 64, 96)}
    rng = np.random.default_rng(0)
    observation = {
        "agent_pos": rng.normal(size=3).astype(np.float32),
        "environment_state": np.zeros(7, np.float32),
        "pixels": {"top": rng.integers(0, 256, (64, 96, 3), np.uint8)},
    }
    action = loaded.act(observation)
    picture = torch.from_numpy(observation["pixels"]["top"]).permute(2, 0, 1)[None].float() / 255.0
    batch = before(
        {"observation.state": torch.from_numpy(observation["agent_pos"])[None], "observation.images.top": picture}
    )
    with torch.inference_mode():
        expected = after(made.eval().select_action(batch))[0].numpy()
    assert action == pytest.approx(expected, abs=1e-5)
    assert np.abs(action - [5.0, -5.0]).max() < 1.0, "in the units of the data set"
    with pytest.raises(CommandError, match="no such folder"):
        LeRobotPolicy(str(tmp_path / "nothing"))
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(CommandError, match="no policy that LeRobot can load"):
        LeRobotPolicy(str(tmp_path))
