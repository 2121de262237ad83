"""Colours, sizes and goals that a program changes in its model while it runs: clients follow, and nothing else does."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest

from iris_session.client import Client
from iris_session.protocol.common import Pose
from iris_session.protocol.scene import RemoveVisual, SceneSpec, Visual, decode_scene
from iris_session.scene import AssetStore
from iris_session.session.model_follower import BURST
from tests.rig.session import Rig

TASK = """<mujoco><option timestep="0.01"/><asset><material name="paint" rgba=".2 .2 .2 1"/></asset><worldbody>
  <geom name="floor" type="plane" size="2 2 1"/><body name="table" pos="0 0 .5" euler="0 0 90">
    <geom name="top" type="box" size=".4 .4 .02" material="paint"/><site name="goal" size=".02" rgba="0 1 0 1"/>
    <site name="target0" size=".02"/><site name="spare" group="4"/></body>
  <body name="puck" pos="0 0 1"><freejoint/><geom name="puck" type="cylinder" size=".05 .02"/></body>
  </worldbody></mujoco>"""


class Task:
    """A program that simulates `TASK`, with a client that watches."""

    def __init__(self, rig: Rig, folder: Path) -> None:
        self.rig, self.model = rig, rig.session.model
        self.store = AssetStore(folder)
        self.client: Client = rig.join("watcher", "observer")
        assert rig.session.data is not None
        self.data = rig.session.data
        rig.run(0.3)

    @property
    def spec(self) -> SceneSpec:
        """The scene specification of the client."""
        return decode_scene(self.store.get(self.client.mirror.scene_hash))

    def see(self, name: str) -> Visual:
        """Return what the client draws under that name."""
        return next(visual for visual in self.spec.visuals if visual.name == name)

    def wait(self, revision: int, seconds: float = 0.2) -> None:
        self.rig.run_until(lambda: self.client.mirror.scene_revision >= revision, f"patch {revision}", seconds)


@pytest.fixture(params=["own loop", "user loop"])
def task(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Task]:
    spec = mujoco.MjSpec.from_string(TASK)
    with Rig(spec, user_loop=request.param == "user loop", assets=tmp_path) as rig:
        yield Task(rig, tmp_path)


@pytest.fixture
def program(tmp_path: Path) -> Iterator[Task]:
    with Rig(mujoco.MjSpec.from_string(TASK), user_loop=True, assets=tmp_path) as rig:
        yield Task(rig, tmp_path)


def test_nothing_is_patched_while_looks_stay(task: Task) -> None:
    before = task.client.mirror.scene_hash
    task.rig.run(3.0)
    assert task.client.mirror.scene_revision == 0
    assert task.client.mirror.scene_hash == before


def test_colours_sizes_places_and_groups_are_followed(task: Task) -> None:
    model = task.model
    assert task.see("top").rgba == pytest.approx((0.2, 0.2, 0.2, 1.0))
    model.site("goal").rgba[:] = (1.0, 0.0, 2.0, 0.5)
    model.site("goal").pos[:] = (0.1, 0.2, 0.3)
    model.site("goal").quat[:] = (2.0, 0.0, 0.0, 0.0)
    model.site("goal").size[:] = 0.1
    model.site("spare").group[:] = 0
    model.mat("paint").rgba[:] = (0.0, 0.0, 1.0, 1.0)
    model.geom("floor").group[:] = 5
    model.geom("floor").rgba[:] = (1.0, 1.0, 0.0, 1.0)
    task.wait(1)
    goal = task.see("goal")
    assert goal.rgba == (1.0, 0.0, 1.0, 0.5)
    assert goal.T_body_visual == Pose((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))
    assert goal.geometry.size == (0.1, 0.1, 0.1)
    assert task.see("top").rgba == (0.0, 0.0, 1.0, 1.0)
    assert (task.see("floor").group, task.see("floor").rgba) == (5, (1.0, 1.0, 0.0, 1.0))
    assert task.see("spare").group == 0
    model.site("spare").group[:] = 4
    model.site("goal").size[:] = 0.2
    task.wait(2)
    assert task.see("goal").geometry.size == (0.2, 0.2, 0.2)
    assert "spare" not in {visual.name for visual in task.spec.visuals}
    late = task.rig.join("late", "observer")
    assert late.mirror.scene_hash == task.client.mirror.scene_hash


def test_goal_of_a_reset_is_seen_with_its_first_states(program: Task) -> None:
    def reset(data: mujoco.MjData) -> None:
        if not done:
            mujoco.mj_resetData(program.model, data)
            program.model.site("goal").pos[:] = (0.3, 0.0, 0.1)
            done.append(program.rig.now_s)

    done: list[float] = []
    program.rig.policy = reset
    program.wait(1, 0.06)
    assert program.see("goal").T_body_visual.p == (0.3, 0.0, 0.1)


def test_looks_that_never_rest_are_followed_once_a_second(program: Task) -> None:
    def blink(data: mujoco.MjData) -> None:
        program.model.site("goal").rgba[0] = data.time % 1.0

    program.rig.policy = blink
    program.rig.run(5.0)
    assert BURST <= program.client.mirror.scene_revision <= BURST + 6
    program.rig.policy = lambda data: None
    program.rig.run(1.5)
    assert program.see("goal").rgba[0] == pytest.approx(program.model.site("goal").rgba[0])


def test_changes_of_every_geom_fit_several_patches(tmp_path: Path) -> None:
    spec = mujoco.MjSpec.from_string(TASK)
    for k in range(150):
        spec.worldbody.add_geom(size=[0.01] * 3, pos=[0.03 * k, 1.0, 0.0])
    with Rig(spec, user_loop=True, assets=tmp_path) as rig:
        task = Task(rig, tmp_path)
        task.model.geom_rgba[3:] = (1.0, 0.0, 0.0, 1.0)
        task.wait(3)
        assert sum(visual.rgba == (1.0, 0.0, 0.0, 1.0) for visual in task.spec.visuals) == 150


def test_changes_that_clients_cannot_follow_are_said_once(program: Task, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(AssetStore, "_write", full)
        program.model.site("goal").rgba[:] = (1.0, 0.0, 0.0, 1.0)
        program.rig.run(0.5)
    program.model.site("goal").rgba[:] = (0.0, 0.0, 1.0, 1.0)
    program.rig.run(0.5)
    assert program.client.mirror.scene_revision == 0
    assert ["No space left" in note for note in program.rig.session.notes if "colours, sizes" in note] == [True]


def test_what_is_not_finite_is_left_out(program: Task) -> None:
    program.model.site("goal").pos[:] = np.nan
    program.model.geom("puck").rgba[:] = (1.0, 0.0, 0.0, 1.0)
    program.wait(1)
    assert program.see("goal").T_body_visual.p == (0.0, 0.0, 0.0)
    assert program.see("puck").rgba == (1.0, 0.0, 0.0, 1.0)
    program.rig.run(1.0)
    assert program.client.mirror.scene_revision == 1


def test_owner_removes_a_visual_for_good(program: Task) -> None:
    program.rig.session.patch_scene(RemoveVisual(program.see("goal").id))
    program.wait(1)
    program.model.site("goal").rgba[:] = (1.0, 0.0, 0.0, 1.0)
    program.rig.run(0.5)
    assert "goal" not in {visual.name for visual in program.spec.visuals}


def test_equal_model_that_a_reset_builds_is_followed(program: Task) -> None:
    program.model.site("goal").rgba[:] = (1.0, 0.0, 0.0, 1.0)
    program.wait(1)
    model = mujoco.MjSpec.from_string(TASK).compile()
    program.rig.session._change_model(model, mujoco.MjData(model))
    program.wait(2)
    assert program.see("goal").rgba == (0.0, 1.0, 0.0, 1.0)
    model.site("goal").rgba[:] = (0.0, 0.0, 1.0, 1.0)
    program.wait(3)
    assert program.see("goal").rgba == (0.0, 0.0, 1.0, 1.0)


def test_scene_that_is_loaded_is_followed(tmp_path: Path) -> None:
    with Rig(mujoco.MjSpec.from_string(TASK), assets=tmp_path) as rig:
        task = Task(rig, tmp_path)
        model = mujoco.MjSpec.from_string(TASK.replace('pos="0 0 1"', 'pos="0 0 2"')).compile()
        rig.session.load_scene(model, groups=[0, 3], sites=[4]).result(60.0)
        rig.run_until(lambda: task.client.mirror.scene_epoch == 2, "the scene is there", 1.0)
        task.model.site("spare").rgba[:] = (0.0, 0.0, 1.0, 1.0)  # of the scene before
        rig.run(0.3)
        assert (task.client.mirror.scene_revision, task.spec.groups_shown) == (0, (0, 3))
        assert {visual.name for visual in task.spec.visuals} == {"floor", "top", "puck", "spare"}
        rig.session.model.site("spare").rgba[:] = (1.0, 0.0, 0.0, 1.0)
        task.wait(1)
        assert task.see("spare").rgba == (1.0, 0.0, 0.0, 1.0)


# --- environments -----------------------------------------------------------------------------------------------------


class Environment:
    """An environment that is stepped by the program's loop, with what an author writes after the simulation."""

    def __init__(self, task: Task) -> None:
        self.session, self.after = task.rig.session, lambda: None
        self.session._attachment = SimpleNamespace(environment=self, close=lambda: None)  # type: ignore[assignment]

    def step(self) -> None:
        self.after()
        self.session._look_at_goals(is_reset=False)

    def reset(self) -> None:
        self.session._look_at_goals(is_reset=True)


def test_sites_that_an_environment_moves_in_its_data_are_followed(program: Task) -> None:
    """As in Meta-World: until the next kinematics a renderer draws them there."""
    environment: Any = Environment(program)
    data = program.data

    def put_goal() -> None:
        data.site("goal").xpos[:] = (0.5, 0.1, 0.6)

    environment.after = put_goal
    program.rig.policy = lambda data: environment.step()
    program.wait(1)
    program.rig.run(1.0)
    assert program.client.mirror.scene_revision == 1, "states between two steps have it elsewhere"
    assert program.see("goal").T_body_visual.p == pytest.approx((0.1, -0.5, 0.1)), "the table is turned by 90 degrees"


def test_goals_that_only_a_render_puts_into_the_model_are_followed(program: Task) -> None:
    """As in Gymnasium-Robotics' Fetch."""
    environment: Any = Environment(program)
    owner = SimpleNamespace(goal=np.array((0.5, 0.1, 0.6)), _render_callback=lambda: None)
    environment.unwrapped = owner
    before = program.model.site_pos.copy()
    program.rig.run(0.2)
    assert program.client.mirror.scene_revision == 0
    environment.reset()
    program.wait(1)
    assert program.see("target0").T_body_visual.p == pytest.approx((0.1, -0.5, 0.1))
    assert np.array_equal(before, program.model.site_pos), "the program's model is not touched"
