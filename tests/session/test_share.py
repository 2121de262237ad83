"""`share`: a session of whatever a researcher has at hand."""

from __future__ import annotations

import dataclasses
import importlib.util
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

import iris_session
from iris_session import ConfigError, OwnershipError, PublishError, Session, StartError
from iris_session.demo.scenes import scene_path
from iris_session.physics import ModelInvalidError, ModelNotFoundError
from iris_session.session.share import _complete_config
from iris_session.session.simulation import find_simulation
from tests.session.test_session import QUIET

Space = types.SimpleNamespace
UNCLEAR_ARM = """<mujoco><worldbody><body name="arm"><joint name="a"/><geom size=".1"/><body name="b" pos=".3 0 0">
<joint name="b" axis="0 1 0"/><geom size=".1"/><body name="c" pos=".3 0 0"><joint name="c" axis="0 1 0"/>
<geom size=".1"/></body></body></body></worldbody><actuator><general joint="a" biastype="user"/>
<general joint="b" biastype="user"/><general joint="c" biastype="user"/></actuator></mujoco>"""


@pytest.fixture
def shared() -> Iterator[list[Session]]:
    sessions: list[Session] = []
    yield sessions
    for session in sessions:
        session.close()


class Wrapper:
    """As Gymnasium's: shows what it wraps by `unwrapped`, and fails for attributes of the inner one."""

    def __init__(self, inner: Any) -> None:
        self.unwrapped = inner

    @property
    def model(self) -> Any:
        raise RuntimeError("deprecated")


def list_shapes(model: Any, data: Any) -> list[Any]:
    """Returns objects that show the simulation as the suites do that we know."""
    robosuite = Space(model=Space(_model=model), data=Space(_data=data))
    dm_control = Space(model=Space(ptr=model), data=Space(ptr=data))
    return [
        Space(model=model, data=data),
        Wrapper(Space(model=model, data=data)),
        Space(sim=robosuite),
        Space(env=Space(sim=robosuite)),  # LIBERO
        Wrapper(Space(_env=Space(env=Space(sim=robosuite)))),  # LeRobot
        Space(physics=dm_control),
        dm_control,
        Wrapper(Space(_env=Space(physics=dm_control))),  # gym-aloha
        Space(_environment=Space(_env=Space(physics=dm_control))),
        Space(mjModel=model, mjData=data),  # gym-quadruped
        Space(_model=model, _data=data),
        Space(sys=Space(mj_model=model), mj_data=data, env=Space(model=model, data=data)),
    ]


@pytest.mark.parametrize("index", range(12))
def test_the_simulation_of_every_known_suite_is_found(model: mujoco.MjModel, index: int) -> None:
    data = mujoco.MjData(model)
    assert find_simulation(list_shapes(model, data)[index]) == (model, data)


def test_what_has_no_simulation(model: mujoco.MjModel) -> None:
    assert find_simulation(Space(model=1, data=2)) is None
    assert find_simulation(None) is None
    loop = Space()
    loop.env = loop
    assert find_simulation(loop) is None
    found = find_simulation(Space(mj_model=model))
    assert found is not None
    assert (found.model, found.data) == (model, None)


# --- sessions ---------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("simulation")
def test_a_file_and_a_model_run_in_our_loop(shared: list[Session], model: mujoco.MjModel) -> None:
    for x in (str(scene_path("handover")), scene_path("handover"), model):
        shared.append(iris_session.share(x, config=QUIET))
        with shared[-1] as session:
            session.run(seconds=0.05)
            assert [robot.name for robot in session.robots] == ["left", "right"]


@pytest.mark.usefixtures("simulation")
def test_data_and_environments_go_on_in_the_loop_of_the_program(shared: list[Session], model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    bindings = Space(ptr=model), Space(ptr=data)
    environment = Space(sim=Space(model=Space(_model=model), data=Space(_data=data)))
    environment.advance = lambda: mujoco.mj_step(model, data)
    for begin in (
        lambda: iris_session.share(model, data, QUIET),
        lambda: iris_session.share(*bindings, QUIET),
        lambda: iris_session.share(environment, config=QUIET, step="advance", drive="action", robots="left"),
    ):
        session = begin()
        shared.append(session)
        environment.advance()
        assert session.status().sim_time == data.time
        with pytest.raises(OwnershipError, match="close it first"):
            iris_session.share(model, data, QUIET)
        session.close()
    assert session.config.control.output == "targets"
    assert [robot.name for robot in session.robots] == ["left"]


@pytest.mark.usefixtures("simulation")
def test_a_robot_never_keeps_a_scene_from_being_shown(shared: list[Session], tmp_path: Path) -> None:
    shared.append(iris_session.share(mujoco.MjModel.from_xml_string(UNCLEAR_ARM), config=QUIET))
    assert shared[0].robots == ()
    assert any("arm" in note for note in shared[0].notes)
    lines = shared[0].describe_robots()
    file = tmp_path / "robots.toml"
    file.write_text(lines, encoding="utf-8")
    with iris_session.share(shared[0].model, config=QUIET, robots=file) as session:
        assert session.robots == (), "the lines are accepted as they are printed"


@pytest.mark.usefixtures("simulation")
def test_what_steps_elsewhere_is_synced(shared: list[Session], model: mujoco.MjModel) -> None:
    """As MuJoCo Playground: the environment has a model, and its states hold arrays."""
    plant = mujoco.MjData(model)
    shared.append(iris_session.share(Space(mj_model=model), config=QUIET))
    session = shared[0]
    session.stepper.is_state_due = lambda end_ns: True  # type: ignore[method-assign]
    for _ in range(3):
        mujoco.mj_step(model, plant)
        state = Space(data=Space(qpos=plant.qpos.tolist(), qvel=plant.qvel.copy(), time=np.float32(plant.time)))
        session.sync(state)
        assert session.status().sim_time == pytest.approx(plant.time)
        assert np.array_equal(session.data.qpos, plant.qpos)
    before = session.data.qpos.copy()
    for wrong in (Space(qpos=np.zeros((4, model.nq))), Space(qpos=np.zeros(3)), Space(), None):
        with pytest.raises(PublishError):
            session.sync(wrong)
    assert np.array_equal(session.data.qpos, before)


@pytest.mark.usefixtures("simulation")
def test_what_steps_elsewhere_has_one_session(shared: list[Session], model: mujoco.MjModel) -> None:
    environment = Space(mj_model=model)
    shared.append(iris_session.share(environment, config=QUIET))
    for again in (environment, Wrapper(environment)):
        with pytest.raises(OwnershipError, match="close it first"):
            iris_session.share(again, config=QUIET)
    shared.append(iris_session.share(Space(mj_model=model), config=QUIET))
    shared[0].close()
    shared.append(iris_session.share(environment, config=QUIET))


@pytest.mark.usefixtures("simulation")
def test_without_rerun_a_program_is_shared_all_the_same(
    shared: list[Session], model: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in the base install, beside a suite. A recording that is asked for by its path is an error."""
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *more: None if name == "rerun" else find(name, *more))
    default = dataclasses.replace(QUIET, record=True)
    shared.append(iris_session.share(model, mujoco.MjData(model), default))
    assert shared[0].recording is None
    assert any("iris-session[recording]" in note for note in shared[0].notes)
    with pytest.raises(StartError, match="recording"):
        iris_session.share(model, config=dataclasses.replace(QUIET, record="here.rrd"))


@pytest.mark.usefixtures("simulation")
def test_a_specification_is_compiled_and_a_scene_without_robots_is_a_note(shared: list[Session]) -> None:
    shared.append(iris_session.share(mujoco.MjSpec.from_string("<mujoco><worldbody/></mujoco>"), config=QUIET))
    assert any("no robots found" in note for note in shared[0].notes)


def test_a_second_program_on_a_machine_takes_other_ports(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("iris_session.session.resume.is_port_free", lambda host, port: port != 7722)
    config, notes = _complete_config(None, "ctrl")
    assert (config.control_port, config.state_port) == (0, 0)
    assert any("session.address" in note for note in notes)
    assert _complete_config(QUIET, QUIET.control.output) == (QUIET, [])


# --- errors -----------------------------------------------------------------------------------------------------------


def test_what_cannot_be_shared_is_one_line(model: mujoco.MjModel, tmp_path: Path) -> None:
    broken = tmp_path / "broken.xml"
    broken.write_text("<mujoco><asset><mesh name='m' file='gone.stl'/></asset></mujoco>", encoding="utf-8")
    vector = type("SyncVectorEnv", (), {"envs": [Space(model=model, data=mujoco.MjData(model))]})()
    remote = type("AsyncVectorEnv", (), {"__module__": "gymnasium.vector.async_vector_env"})()
    for x, error, text in (
        (tmp_path / "none.xml", ModelNotFoundError, "none.xml"),
        (broken, ModelInvalidError, "gone.stl"),
        (vector, ConfigError, r"share\(env\.envs\[0\]\)"),
        (remote, ConfigError, "several environments"),
        (Space(), ConfigError, "no MuJoCo model in SimpleNamespace"),
        (None, ConfigError, "NoneType"),
    ):
        with pytest.raises(error, match=text) as caught:
            iris_session.share(x, config=QUIET)
        assert "\n" not in str(caught.value)
    with pytest.raises(OwnershipError, match="not started"):
        Session(model, config=QUIET).action([0.0])
    with pytest.raises(TypeError, match="SessionConfig"):
        iris_session.share(model, config={"name": "lab"})  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="'ctrl', 'action'"):
        iris_session.share(model, config=QUIET, drive="joints")
    with pytest.raises(ConfigError, match="share\\(model, data\\)"):
        iris_session.share(Space(model=model), mujoco.MjData(model), QUIET)


@pytest.mark.usefixtures("simulation")
def test_groups_sites_and_goals_of_an_environment_are_shown(shared: list[Session], tmp_path: Path) -> None:
    """Which goals: `tests/rig/test_looks.py`."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><site name="target0" group="4"/><body><freejoint/><geom size=".1" group="3"/></body>
        </worldbody></mujoco>"""
    )
    environment = Space(model=model, data=mujoco.MjData(model), goal=np.zeros(3), _render_callback=lambda: None)
    environment.step = step = lambda: mujoco.mj_step(model, environment.data)
    environment.reset = lambda: environment.goal.__iadd__(0.25)
    config = dataclasses.replace(QUIET, assets=tmp_path)
    session = iris_session.share(environment, config=config, groups=[3], sites=True)
    shared.append(session)
    assert session.scene is not None
    assert session.scene.groups_shown == (3,)
    environment.step()
    environment.reset()
    assert [one.T_body_visual.p for one in session.scene.visuals if one.name == "target0"] == [(0.25, 0.25, 0.25)]
    session.close()
    assert environment.step is step
