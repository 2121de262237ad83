"""`SimulatorSession` over a simulation of three lines, in simulated time: steps, targets, faults, replay."""

from __future__ import annotations

import atexit
import os
from collections.abc import Callable, Iterator, Mapping

import numpy as np
import pytest

import iris_session
from iris_session import Client, ConfigError, OwnershipError, SceneBuilder, SessionConfig
from iris_session.protocol.client_messages import Acquire
from iris_session.protocol.names import Role
from iris_session.session import share as share_module
from iris_session.session.simulator_session import SimulatorSession
from iris_session.simulators.adapter import Adapter, SimulationState, TipTarget, make_robot
from iris_session.simulators.wrapping import wrap_method
from tests.rig.owned import keep_journal, simulate_sessions
from tests.rig.simulation import Simulation

CONFIG = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False, web=False)
DT = 0.02
UNIT = (1.0, 0.0, 0.0, 0.0)
CLOTH = np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0)])


class Gantry:
    """A simulator: a gripper that goes to its goal at a limited speed [m/s], and a cloth that falls."""

    def __init__(self, speed: float = 100.0) -> None:
        self.speed = speed
        self.time = 0.0
        self.tip = np.array([0.0, 0.0, 0.5])
        self.goal = self.tip.copy()
        self.gripper = 0.0
        self.height = 1.0
        self.breaks = False

    def step(self, substeps: int = 1) -> int:
        if self.breaks:
            self.tip[:] = np.nan
        self.time += DT
        away = self.goal - self.tip
        self.tip = self.tip + min(0.5, self.speed * DT / max(1e-9, float(np.linalg.norm(away)))) * away
        self.height -= 0.001
        return substeps


class GantryAdapter(Adapter):
    drives = True
    name = "gantry"

    def __init__(self, gantry: Gantry) -> None:
        self.gantry = gantry
        self.reads = 0
        self.applied: list[TipTarget] = []

    def build(self, scene: SceneBuilder) -> None:
        scene.add_box("base", half_size=(0.1, 0.1, 0.1), movable=True)
        scene.add_box("tip", half_size=(0.02, 0.02, 0.02), movable=True, position=self.gantry.tip.tolist())
        scene.add_deformable("cloth", CLOTH, [(0, 1, 2)])
        self.bodies = ["base", "tip"]
        self.robots = (make_robot("gantry", self.bodies, (1, ())),)
        self.notes = ("a liquid is not shown",)

    def read_state(self) -> SimulationState:
        self.reads += 1
        cloth = CLOTH - (0.0, 0.0, 1.0 - self.gantry.height)
        return SimulationState(
            self.gantry.time, np.stack([np.zeros(3), self.gantry.tip]), np.array([UNIT, UNIT]), {"cloth": cloth}
        )

    def apply_targets(self, targets: Mapping[str, TipTarget]) -> None:
        self.applied.append(targets["gantry"])
        self.gantry.goal[:] = targets["gantry"].pose.p
        self.gantry.gripper = targets["gantry"].gripper or 0.0

    def wrap_step(self, before: Callable[[], None], after: Callable[[], None]) -> Callable[[], None]:
        return wrap_method(self.gantry, "step", lambda *_, **__: before(), lambda *_, **__: after())


@pytest.fixture
def simulation() -> Iterator[Simulation]:
    with simulate_sessions() as simulation:
        yield simulation


def run(session: SimulatorSession, gantry: Gantry, seconds: float, each: Callable[[], object] = lambda: None) -> None:
    """Step as a program does in real time."""
    for _ in range(round(seconds / DT)):
        gantry.step()
        each()
        session.run(seconds=DT)


def connect(session: SimulatorSession, name: str = "policy") -> Client:
    return Client(session.address, role=Role.AGENT, name=name, devices=("target",)).connect()


def acquire(session: SimulatorSession, gantry: Gantry, client: Client) -> None:
    run(session, gantry, 0.2, lambda: client.poll(0.0))
    request = client.submit(Acquire(request_id=0, robots=("gantry",)))
    run(session, gantry, 0.2, lambda: client.poll(0.0))
    answer = client.answer(request)
    assert answer is not None
    assert answer.denial is None


def drive(session: SimulatorSession, gantry: Gantry, client: Client, gripper: float | None = None) -> None:
    """Drive for half a second towards a goal that is far away."""
    acquire(session, gantry, client)
    sent = iter(range(1000))

    def send() -> None:
        goal = ((0.5, 0.0, 0.5), UNIT)
        client.send_sample("target", goal, robots=["gantry"], clutch=next(sent) > 2, gripper=gripper)
        client.poll(0.0)

    run(session, gantry, 0.5, send)
    assert session.driven_robots() == ("gantry",)


def test_steps_of_the_simulation_are_published_and_its_method_comes_back(simulation: Simulation) -> None:
    gantry = Gantry()
    with SimulatorSession(GantryAdapter(gantry), CONFIG) as session:
        client = Client(session.address, role=Role.OBSERVER, name="ann").connect()
        gantry.goal[:] = (0.2, 0.1, 0.4)
        run(session, gantry, 0.5, lambda: client.poll(0.0))
        assert gantry.step(substeps=7) == 7, "arguments and results pass through"
        state = client.scene.state
        assert state is not None
        assert state.header.sim_time == pytest.approx(gantry.time, abs=3 * DT)
        assert np.abs(state.poses[1, :3] - gantry.tip).max() < 2e-4
        assert session._loop is not None
        assert session._loop._vertices.newest["cloth"][0, 2] == pytest.approx(gantry.height, abs=4e-3)
        assert "a liquid is not shown" in session.notes
    assert "step" not in vars(gantry)
    gantry.step()


def test_states_are_read_at_the_rate_of_the_state(simulation: Simulation) -> None:
    gantry = Gantry()
    adapter = GantryAdapter(gantry)
    with SimulatorSession(adapter, CONFIG):
        before = adapter.reads
        for _ in range(1000):  # a millisecond each
            gantry.step()
            simulation.sleep(0.001)
        assert 40 <= adapter.reads - before <= 75


def test_a_participant_drives_the_robot_and_the_journal_verifies(simulation: Simulation) -> None:
    gantry = Gantry()
    session = SimulatorSession(GantryAdapter(gantry), CONFIG)
    with session:
        assert session._stepper is not None
        journal = keep_journal(session._stepper)
        client = connect(session)
        acquire(session, gantry, client)
        goal, steps = ((0.1, 0.05, 0.4), UNIT), []

        def send() -> None:
            client.send_sample("target", goal, robots=["gantry"], clutch=len(steps) > 2, gripper=0.75)
            client.poll(0.0)
            steps.append(gantry.tip.copy())

        run(session, gantry, 2.0, send)
        assert session.driven_robots() == ("gantry",)
        assert session.targets()["gantry"].p == pytest.approx(goal[0], abs=1e-6)
        assert gantry.tip == pytest.approx(goal[0], abs=1e-3)
        assert gantry.gripper == session.grippers()["gantry"] == 0.75
        speeds = np.linalg.norm(np.diff(steps, axis=0), axis=1) / DT
        assert speeds.max() < 1.6, "targets move at bounded speed"
        client.release("gantry")
        run(session, gantry, 0.3, lambda: client.poll(0.0))
        assert session.driven_robots() == ()
        gantry.goal[:] = (0.0, 0.0, 0.5)
        run(session, gantry, 0.5)
        assert gantry.tip == pytest.approx((0.0, 0.0, 0.5), abs=1e-3), "the program has its robot again"
        client.close()
    journal.verify()


def test_a_robot_stands_still_after_its_release(simulation: Simulation) -> None:
    gantry = Gantry(speed=0.25)
    with SimulatorSession(GantryAdapter(gantry), CONFIG) as session:
        client = connect(session)
        drive(session, gantry, client)
        assert np.linalg.norm(gantry.goal - gantry.tip) > 0.04, "the target leads"
        client.release("gantry")
        while session.driven_robots():
            run(session, gantry, DT, lambda: client.poll(0.0))
        gantry.step()
        assert gantry.goal == pytest.approx(gantry.tip, abs=0.25 * DT)
        gantry.goal[:] = (0.0, 0.0, 0.5)
        run(session, gantry, 2.0, lambda: client.poll(0.0))
        assert gantry.tip == pytest.approx((0.0, 0.0, 0.5), abs=1e-3), "targets of the program count again"
        client.close()


@pytest.mark.parametrize("ends", ["close", "stop", "error"])
def test_a_driven_robot_stands_still_when_the_session_ends(simulation: Simulation, ends: str) -> None:
    gantry = Gantry(speed=0.25)
    with SimulatorSession(GantryAdapter(gantry), CONFIG) as session:
        drive(session, gantry, connect(session))
        assert np.linalg.norm(gantry.goal - gantry.tip) > 0.04
        if ends == "close":
            session.close()
        elif ends == "stop":
            session.stop()
        else:
            assert session._stepper is not None
            session._stepper.end(RuntimeError("internal"))
        before = gantry.tip.copy()
        for _ in range(50):
            gantry.step()
        assert gantry.tip == pytest.approx(before, abs=1e-9)


def test_the_next_participant_does_not_command_the_gripper_of_the_one_before(simulation: Simulation) -> None:
    gantry = Gantry(speed=0.25)
    adapter = GantryAdapter(gantry)
    with SimulatorSession(adapter, CONFIG) as session:
        for name, gripper in (("ann", 0.9), ("bob", None)):
            client = connect(session, name)
            drive(session, gantry, client, gripper)
            client.release("gantry")
            run(session, gantry, 0.3, lambda client=client: client.poll(0.0))  # type: ignore[misc]
            client.close()
            assert session.grippers() == {}
            given = {target.gripper for target in adapter.applied}
            assert given == {None, gripper}
            adapter.applied.clear()


def test_a_reset_forgets_grippers(simulation: Simulation) -> None:
    gantry = Gantry()
    with SimulatorSession(GantryAdapter(gantry), CONFIG) as session:
        drive(session, gantry, connect(session), 0.9)
        run(session, gantry, DT)
        assert session.grippers() == {"gantry": 0.9}
        gantry.time = 0.0
        run(session, gantry, DT)
        assert session.grippers() == {}


def test_a_simulation_has_one_session(simulation: Simulation) -> None:
    gantry, other = Gantry(), Gantry()
    with SimulatorSession(GantryAdapter(gantry), CONFIG) as session:
        with pytest.raises(OwnershipError, match="close it first"):
            SimulatorSession(GantryAdapter(gantry), CONFIG).start()
        gantry.step()
        assert not session._list_faults()
        with SimulatorSession(GantryAdapter(other), CONFIG):
            pass
    with SimulatorSession(GantryAdapter(gantry), CONFIG):
        pass


def test_a_forked_process_leaves_the_session_alone(simulation: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    gantry = Gantry()
    adapter = GantryAdapter(gantry)
    with SimulatorSession(adapter, CONFIG) as session:
        run(session, gantry, 0.1)
        reads, parent = adapter.reads, os.getpid()
        with monkeypatch.context() as child:
            child.setattr(os, "getpid", lambda: parent + 1)
            for _ in range(20):
                assert gantry.step(3) == 3
                simulation.sleep(DT)
            assert adapter.reads == reads
            assert session.close()
        assert not session.stopping
        run(session, gantry, 0.1)
        assert adapter.reads > reads


def test_a_program_that_drives_by_itself_gets_the_targets(simulation: Simulation) -> None:
    gantry = Gantry()
    with SimulatorSession(GantryAdapter(gantry), CONFIG, drives=False) as session:
        run(session, gantry, 0.1)
        assert session.targets()["gantry"].p == pytest.approx((0.0, 0.0, 0.5))
        assert session.driven_robots() == ()
        assert gantry.goal.tolist() == [0.0, 0.0, 0.5]


def test_a_simulation_that_cannot_be_read_goes_on_and_the_status_says_so(
    simulation: Simulation, caplog: pytest.LogCaptureFixture
) -> None:
    gantry = Gantry()
    with SimulatorSession(GantryAdapter(gantry), CONFIG) as session:
        gantry.breaks = True
        run(session, gantry, 0.2)
        assert gantry.time == pytest.approx(0.2)
        assert session._list_faults()
        assert len([record for record in caplog.records if "not followed" in record.message]) == 1


def test_robots_are_chosen_by_name(simulation: Simulation) -> None:
    for choice, names in (("none", ()), ("gantry", ("gantry",)), (["gantry"], ("gantry",)), ("auto", ("gantry",))):
        chosen = SimulatorSession(GantryAdapter(Gantry()), CONFIG, robots=choice)
        assert tuple(robot.name for robot in chosen.robots) == names
    with pytest.raises(ConfigError, match="gantry"):
        SimulatorSession(GantryAdapter(Gantry()), CONFIG, robots="panda")


def test_share_takes_a_simulation_and_gives_its_step_back(
    simulation: Simulation, monkeypatch: pytest.MonkeyPatch
) -> None:
    gantry = Gantry()
    monkeypatch.setattr(share_module, "find_adapter", lambda x: GantryAdapter(x) if isinstance(x, Gantry) else None)
    with iris_session.share(gantry, config=CONFIG) as session:
        gantry.step()
        assert isinstance(session, SimulatorSession)
        assert [robot.name for robot in session.robots] == ["gantry"]
    assert "step" not in vars(gantry)
    for wrong in ({"data": object()}, {"objects": ()}):
        with pytest.raises(ConfigError, match="MuJoCo"):
            iris_session.share(gantry, config=CONFIG, **wrong)  # type: ignore[arg-type]


def test_a_closed_session_is_not_kept(simulation: Simulation, monkeypatch: pytest.MonkeyPatch) -> None:
    callbacks: list[Callable[[], object]] = []
    monkeypatch.setattr(atexit, "register", callbacks.append)
    monkeypatch.setattr(atexit, "unregister", lambda one: callbacks.remove(one) if one in callbacks else None)
    monkeypatch.setattr(share_module, "find_adapter", GantryAdapter)
    with iris_session.share(Gantry(), config=CONFIG) as session:
        assert session.close in callbacks
    assert not callbacks


def test_what_is_no_simulation_is_refused_in_one_line() -> None:
    with pytest.raises(ConfigError, match="Genesis") as caught:
        iris_session.share(object())
    assert "\n" not in str(caught.value)
