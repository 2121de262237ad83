"""`Session` without clients: errors, and inputs of its owner, in simulated time; its recorder, which ends early."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import mujoco
import pytest

from iris_session import ConfigError, OwnershipError, Session, SessionConfig
from iris_session.control import ControlConfig
from iris_session.demo.scenes import scene_path
from iris_session.journal.feed import FeedStats
from iris_session.protocol.client_messages import Control
from iris_session.protocol.scene import RemoveVisual, SetVisual, encode_scene
from iris_session.protocol.server_messages import EStopChanged, Gap, MarkerAdded, SceneChanged
from iris_session.protocol.status import StatusReport
from iris_session.rrd.file import scan_file
from iris_session.session import stepper
from iris_session.session.core import read_plant_state
from iris_session.session.stepper import MAX_HOST_ENTRIES
from iris_session.session.verification import verify_recording
from tests.e2e.session_process import wait_until
from tests.rig.owned import keep_journal
from tests.rig.simulation import Simulation

#: Enough for some seconds of the handover scene without participants.
BUDGET_BYTES = 2_400_000
QUIET = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False, web=False, realtime=False)


@pytest.fixture
def session(simulation: Simulation) -> Iterator[Session]:
    with Session(scene_path("handover"), config=QUIET) as session:
        yield session


def _bodies(session: Session) -> list[object]:
    return [event.body for event in session.recent_events()]


def _make_report(session: Session) -> StatusReport:
    """The authority's half of what the commands `status` and `clear-estop` read."""
    assert session._processes is not None
    return session._processes.make_report(session.stepper)


def test_invalid_messages_raise_and_an_estop_never_does(session: Session) -> None:
    session.marker("before")
    with pytest.raises(ValueError, match="Marker"):
        session.marker(3)  # type: ignore[arg-type]
    session.estop(None)  # type: ignore[arg-type]
    session.marker("after")
    session.run(until=lambda: len(_bodies(session)) >= 3, seconds=30.0)
    kinds = {type(body) for body in _bodies(session) if not isinstance(body, Gap)}
    assert kinds == {MarkerAdded, EStopChanged}, "what was refused costs nothing of what comes after it"
    assert session.status().estop
    with pytest.raises(ValueError, match="Marker"):
        session.marker(3)  # type: ignore[arg-type]
    session.estop("\ud800")


def test_estop_before_the_first_step_passes_a_full_queue(session: Session) -> None:
    for _ in range(MAX_HOST_ENTRIES):
        session.clear_estop()
    with pytest.raises(OwnershipError, match="queue"):
        session.clear_estop()
    session.estop("at once")
    session.run(until=lambda: session.status().estop, seconds=30.0)
    assert session.status().estop


def test_the_owner_clears_only_stops_that_it_can_have_seen(session: Session) -> None:
    session.estop("one")
    session.run(until=lambda: session.status().estop, seconds=30.0)
    session.estop("two")
    session.clear_estop()
    session.run(until=lambda: len(session.status().stops) > 0 and session.status().stops[0].stop_seq == 2, seconds=30.0)
    session.run(seconds=0.05)
    assert session.status().estop
    assert [(s.stop_seq, s.participant, s.reason) for s in session.status().stops] == [(2, "host", "two")]
    assert [stop.stop_seq for stop in _make_report(session).stops] == [2]
    session.clear_estop()
    session.run(until=lambda: not session.status().estop, seconds=30.0)
    assert session.status().stops == ()


def test_single_steps_while_paused_are_spread_over_steps(session: Session) -> None:
    """An e-stop among them waits for one step, not for all of them."""
    session.pause()
    session.run(until=lambda: session.status().paused)
    start, steps = session.status().tick, session.stepper.step_count
    session.post(Control(request_id=0, action="step", ticks=35))
    session.run(until=lambda: session.status().tick - start >= 35)
    assert session.status().tick - start == 35
    assert session.stepper.step_count - steps >= 5
    session.run(seconds=0.05)
    assert session.status().tick - start == 35


def test_run_ends_after_its_seconds_and_by_stop(session: Session, simulation: Simulation) -> None:
    session.run(seconds=0.05)
    assert session.status().tick == 25
    simulation.call_at(simulation.now_ns + 50_000_000, session.stop)
    session.run()
    assert session.stopping
    assert session.status().tick == pytest.approx(50, abs=1)


@pytest.mark.usefixtures("simulation")
def test_session_has_one_kind_of_loop(model: mujoco.MjModel) -> None:
    with Session(model, mujoco.MjData(model), QUIET) as session:
        session.begin_tick()
        with pytest.raises(OwnershipError, match="run"):
            session.run(seconds=0.1)
    with Session(model, mujoco.MjData(model), QUIET) as session:
        session.run(seconds=0.01)
        with pytest.raises(OwnershipError, match="run"):
            session.begin_tick()


@pytest.mark.usefixtures("simulation")
def test_targets_for_an_environment_with_its_own_controller(model: mujoco.MjModel) -> None:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    ctrl = data.ctrl.copy()
    with Session(model, data, replace(QUIET, control=ControlConfig(output="targets"))) as session:
        for _ in range(5):
            session.begin_tick()
            mujoco.mj_step(model, data)
            session.end_tick()
        targets = session.targets()
        assert set(targets) == {"left", "right"}
        site = data.site(session.robots[0].site)
        assert targets["left"].p == pytest.approx(tuple(site.xpos), abs=5e-3)
    assert (data.ctrl == ctrl).all(), "the environment's own controller writes ctrl"


def test_close_twice_and_use_after_close(session: Session) -> None:
    session.close()
    session.close()
    for call in (session.run, session.start, session.patch_scene, session.estop, lambda: session.address):
        with pytest.raises(OwnershipError, match="closed"):
            call()
    assert session.recording is None


@pytest.mark.usefixtures("simulation")
def test_scene_can_be_patched_before_the_first_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = replace(QUIET, assets=tmp_path)
    with pytest.raises(OwnershipError):
        Session(scene_path("handover"), config=config).patch_scene(RemoveVisual(0))
    with Session(scene_path("handover"), config=config) as session:
        monkeypatch.setattr(stepper, "MAX_PENDING_SCENES", 2)
        assert session.scene is not None
        seen = session.scene.visuals[0]
        for green in (0.5, 1.0):
            session.patch_scene(SetVisual(seen.id, rgba=(0.0, green, 0.0, 1.0)))
        with pytest.raises(ConfigError, match="queue"):
            session.patch_scene(RemoveVisual(seen.id))
        assert session.scene.visuals[0].rgba == (0.0, 1.0, 0.0, 1.0)
        told = session.scene
        journal = keep_journal(session.stepper)

        def changes() -> list[SceneChanged]:
            return [body for body in _bodies(session) if isinstance(body, SceneChanged)]

        session.run(until=lambda: len(changes()) == 2, seconds=30.0)
        assert changes()[1].scene_hash == hashlib.sha256(encode_scene(told)).hexdigest()
    assert journal.verify() >= 2


def test_loaded_scene_begins_with_its_given_data(session: Session, model: mujoco.MjModel) -> None:
    path = scene_path("handover")
    data = mujoco.MjData(model)
    data.qpos[0] = 0.3
    begun = read_plant_state(model, data)
    session.run(seconds=0.05)
    change = session.load_scene(path, data)
    data.qpos[0] = 0.9  # whose it is goes on with it
    session.run(until=change.done)
    change.result()
    session.run(until=lambda: session.stepper.core.current_config().initial_state == begun, seconds=30.0)
    assert session.stepper.core.current_config().initial_state == begun
    other = session.load_scene(path, mujoco.MjData(mujoco.MjModel.from_xml_string("<mujoco/>")))
    with pytest.raises(ConfigError, match="data"):
        other.result(60.0)


class Gone:
    """A recorder that was killed, and its feed, which accepts rows as long as it lives."""

    alive, failure, starts, path, restarts = False, "it was ended by SIGKILL", 1, "", 0
    stats = FeedStats(recorders=1)

    def stop_restarts(self) -> None: ...

    def close(self, wait_s: float, is_alive: Callable[[], bool] = lambda: True, *_: object) -> bool:
        return is_alive()


def test_incomplete_recording_is_reported(session: Session) -> None:
    session.run(seconds=0.1)
    session.processes.recorder = session.processes.feed = Gone()  # type: ignore[assignment]
    assert not session.close()
    assert session.recording_fault == "the end of the recording is missing: it was ended by SIGKILL"


@pytest.mark.usefixtures("simulation")
def test_dropped_contacts_are_reported_once_and_counted() -> None:
    """MuJoCo without memory for contacts continues silently: objects penetrate each other."""
    boxes = "".join(
        f'<body pos="0 0 {0.09 + 0.02 * i}"><freejoint/><geom type="box" size=".1 .1 .1"/></body>' for i in range(20)
    )
    xml = f'<mujoco><size memory="300K"/><worldbody><geom type="plane" size="1 1 1"/>{boxes}</worldbody></mujoco>'
    with Session(mujoco.MjModel.from_xml_string(xml), config=QUIET) as session:
        session.run(until=lambda: any("MuJoCo:" in str(body) for body in _bodies(session)))
        before = sum(count for reason, count in session.status().drops.items() if "dropped" in reason)
        assert before > 0
        session.reset()
        session.run(seconds=0.3)
        assert sum(count for reason, count in session.status().drops.items() if "dropped" in reason) >= before
        texts = [body.text for body in _bodies(session) if isinstance(body, MarkerAdded)]
        assert len([text for text in texts if "MuJoCo:" in text]) == len({t for t in texts if "MuJoCo:" in t})


@pytest.mark.parametrize("command", ["reset", "resume"])
def test_one_command_mends_a_diverged_session(session: Session, command: str) -> None:
    session.run(seconds=0.05)
    session.data.qpos[0] = float("nan")
    session.run(until=lambda: session.status().paused, seconds=30.0)
    assert "NaN" in session.status().pause_reason
    assert "NaN" in _make_report(session).pause_reason
    assert _make_report(session).paused_by == "the session"
    getattr(session, command)()
    session.run(until=lambda: not session.status().paused and session.status().tick > 5, seconds=30.0)
    assert (session.status().paused, session.status().pause_reason) == (False, "")
    assert _make_report(session).paused_by == ""


@pytest.mark.e2e
@pytest.mark.long
def test_session_goes_on_after_the_budget_of_its_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("iris_session.session.config.MIN_BUDGET_BYTES", 1)
    path = tmp_path / "session.rrd"
    config = SessionConfig(
        control_port=0, state_port=0, record=path, realtime=False, record_budget_bytes=BUDGET_BYTES, name="small"
    )
    with Session(scene_path("handover"), config=config) as session:
        processes = session._processes
        assert processes is not None
        session.run(until=lambda: processes.make_report(session.stepper).recorder.state == "ended")
        steps = session.stepper.step_count
        session.run(seconds=1.0)  # a restart would be within it
        assert session.stepper.step_count > steps
        assert session.status().restarts == {"front": 0, "recorder": 0}
    assert session.recording_fault == ""
    verified = verify_recording(path)
    assert verified.ok, verified.line()
    assert verified.finished
    assert 0 < verified.steps < steps
    wait_until(lambda: scan_file(path).indexed, "the file has its index")
    assert path.stat().st_size <= BUDGET_BYTES
