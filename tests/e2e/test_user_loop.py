"""Sessions in a user's script: with `begin_tick`/`end_tick`, attached by one line, and with `Session.run`."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from anchors.pose import distance
from iris_session.client import DeniedError
from iris_session.protocol.names import CommandKind, DenialReason, HoldReason
from iris_session.protocol.server_messages import Gap, SceneChanged
from tests.e2e.scenario import Hand, Scenario
from tests.e2e.session_process import SessionProcess, assert_all_end, kill_all, list_descendants, run_verify
from tests.e2e.session_time import run_ticks, wait_for_new_state

pytestmark = pytest.mark.e2e

#: Beginning of every script: the handover scene with an actuated joint that belongs to no robot, and a file through
#: which the test commands the script.
HEAD = """
import sys, time
from pathlib import Path
import mujoco
from iris_session import OwnershipError, Session, SessionConfig
from iris_session.demo.scenes import scene_path

spec = mujoco.MjSpec.from_file(str(scene_path("handover")))
fan = spec.worldbody.add_body(name="fan", pos=[2, 2, 1])
fan.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.05, 0, 0])
fan.add_joint(name="fan", axis=[0, 0, 1], damping=1)
motor = spec.add_actuator(name="fan_motor", target="fan", trntype=mujoco.mjtTrn.mjTRN_JOINT)
model = spec.compile()
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, 0)
command = Path("command.txt")
config = SessionConfig(name="mine", control_port=0, state_port=0, record="session.rrd")

def print_address(session):
    print(f"session on {session.address}, recording to {session.recording}", flush=True)

def poll_commands():
    text = command.read_text() if command.exists() else ""
    if text:
        command.unlink()
    if text == "block":
        print("the loop blocks", flush=True)
        while not command.exists():
            time.sleep(0.01)
    elif text == "reset":
        mujoco.mj_resetDataKeyframe(model, data, 0)
        data.time = 0.0
    elif text == "diverge":
        data.qvel[:] = float("nan")
    return text != "end"

def paced(start):
    wait = start + data.time - time.monotonic()
    if wait > 0:
        time.sleep(wait)
"""

TICKS = """
with Session(model, data, config) as session:
    print_address(session)
    while poll_commands():
        data.ctrl[model.actuator("fan_motor").id] = 0.25
        session.begin_tick()
        assert data.ctrl[model.actuator("fan_motor").id] == 0.25
        mujoco.mj_step(model, data)
        session.end_tick()
        time.sleep(0.0015)
print("ended in order", flush=True)
"""

#: A suite's own policy: it writes `ctrl` of every robot, and resets when a director asks for it.
POLICY = """
home = model.key_ctrl[0].copy()
session = Session.attach(model, data, config)
print_address(session)
while poll_commands():
    for request in session.poll_requests():
        print(request.name, "asks for", request.kind, flush=True)
        mujoco.mj_resetDataKeyframe(model, data, 0)
    data.ctrl[:] = home
    data.ctrl[0] += 0.3 * min(1.0, data.time)
    mujoco.mj_step(model, data)
    time.sleep(0.0015)
session.close()
print("ended in order", flush=True)
"""

#: No `close()`: the session ends with the script.
LAST_LINE = """
session = Session.attach(model, data, config)
print_address(session)
while poll_commands():
    mujoco.mj_step(model, data)
    time.sleep(0.0015)
print("ended in order", flush=True)
"""

ATTACH = """
session = Session.attach(model, data, config)
print_address(session)
twin = mujoco.MjData(model)
while poll_commands():
    data.ctrl[model.actuator("fan_motor").id] = 0.25
    mujoco.mj_step(model, data)
    mujoco.mj_forward(model, twin)
    mujoco.mj_forward(model, data)
    time.sleep(0.0015)
assert mujoco.get_mjcb_control() is None
mujoco.MjModel.from_xml_string("<mujoco/>")
session.close()
assert data.ctrl[model.actuator("fan_motor").id] == 0.25
print("ended in order", flush=True)
"""


class Script(SessionProcess):
    """A user's script that obeys commands by a file."""

    def __init__(self, folder: Path, body: str) -> None:
        file = folder / "script.py"
        file.write_text(HEAD + body)
        super().__init__(folder, folder / "session.rrd", [sys.executable, str(file)])

    def command(self, text: str) -> None:
        file = self.folder / "command.new"
        file.write_text(text)
        file.rename(self.folder / "command.txt")


@pytest.fixture
def script(tmp_path: Path) -> Iterator[Callable[[str], Scenario]]:
    """Start a script with a session."""
    scenarios: list[Scenario] = []

    def start(body: str) -> Scenario:
        scenarios.append(Scenario(Script(tmp_path, body)))
        return scenarios[-1]

    yield start
    for scenario in scenarios:
        scenario.close()
    kill_all([scenario.server for scenario in scenarios])


def command_script(scenario: Scenario, text: str) -> None:
    assert isinstance(scenario.server, Script)
    scenario.server.command(text)


def drive_left_robot(scenario: Scenario) -> None:
    """Ann acquires the left robot and moves it by 3 cm."""
    hand = scenario.drive("ann", "left")
    before = hand.tip
    scenario.move_until(
        hand, (0.0, 0.1, 0.0), lambda: hand.tip[0][1] - before[0][1] > 0.03, "the robot in the user's loop follows"
    )


def end_script(scenario: Scenario) -> None:
    """End the script in order; its recording of class `open` must verify."""
    command_script(scenario, "end")
    scenario.run_until(lambda: scenario.server.process.poll() is not None, "the script ends")
    assert scenario.server.process.wait() == 0, scenario.server.output
    assert "ended in order" in scenario.server.output
    report = run_verify(scenario.server.recording)
    assert report["recording_class"] == "open"
    assert report["steps"] > 10


@pytest.mark.long
def test_script_that_calls_begin_and_end_tick(script: Callable[[str], Scenario]) -> None:
    scenario = script(TICKS)
    drive_left_robot(scenario)
    director = scenario.join("director", "director")
    for action in ("pause", "reset"):
        with pytest.raises(DeniedError) as denied:
            director.control(action)
        assert denied.value.denial.reason == DenialReason.USER_OWNED
    end_script(scenario)


def test_attached_script(script: Callable[[str], Scenario]) -> None:
    """`mj_forward` on the same or on other data is not a tick."""
    scenario = script(ATTACH)
    drive_left_robot(scenario)
    director = scenario.join("director", "director")
    scenario.run_until(lambda: director.scene.state is not None, "a first state")
    state = director.scene.state
    assert state is not None
    assert state.header.tick == round(state.header.sim_time / 0.002)
    end_script(scenario)


def test_policy_drives_until_a_participant_engages_and_after_the_release(script: Callable[[str], Scenario]) -> None:
    """A director's request to reset reaches the script, too."""
    scenario = script(POLICY)
    watcher = scenario.join("watcher", "director")
    scenario.run_until(
        lambda: watcher.scene.state is not None and watcher.scene.state.header.sim_time > 1.5, "the policy acts"
    )
    alone = watcher.scene.tip_pose("left")
    assert alone is not None
    drive_left_robot(scenario)
    (hand,) = scenario.hands
    hand.sending = False
    hand.client.release("left")
    scenario.run_until(lambda: has_come_to_rest(scenario, hand), "the policy has its robot again")
    assert distance(alone[0], hand.tip[0]) < 2e-3
    epoch = watcher.mirror.scene_epoch
    watcher.control("reset")
    scenario.run_until(lambda: watcher.mirror.scene_epoch == epoch + 1, "the script resets")
    assert "watcher asks for reset" in scenario.server.output
    end_script(scenario)


@pytest.mark.long
def test_attached_script_without_close_ends_in_order(script: Callable[[str], Scenario]) -> None:
    scenario = script(LAST_LINE)
    drive_left_robot(scenario)
    children = list_descendants(scenario.server.process.pid)
    end_script(scenario)
    assert_all_end(children)
    assert run_verify(scenario.server.recording)["finished"]
    ann = scenario.clients[0]
    scenario.run_until(
        lambda: "session_ended" in ann.connection.counters.faults, "ann is notified that the session ended"
    )


@pytest.mark.long
@pytest.mark.parametrize("body", [TICKS, ATTACH], ids=["ticks", "attach"])
def test_loop_that_blocks_for_five_seconds(script: Callable[[str], Scenario], body: str) -> None:
    """Leases, heartbeats and the e-stop work meanwhile; afterwards the robot holds until the clutch was opened."""
    scenario = script(body)
    drive_left_robot(scenario)
    (hand,) = scenario.hands
    ann, director = hand.client, scenario.join("director", "director")
    hand.velocity = (0.0, 0.0, 0.0)
    scenario.run_until(lambda: has_come_to_rest(scenario, hand), "the robot is at rest")
    command_script(scenario, "block")
    scenario.run_until(lambda: "the loop blocks" in scenario.server.output, "the loop blocks")
    wait_for_new_state(scenario, director)
    before, tick = hand.tip, director.scene.state.header.tick  # type: ignore[union-attr]
    director.acquire(["right"])
    assert ann.lease_version("right") is None
    ann.estop("test")
    scenario.run_until(lambda: director.mirror.estop, "the e-stop is known")
    director.clear_estop()
    hand.velocity = (0.0, 0.2, 0.0)  # the hand moves on with its clutch closed

    def stays_connected() -> bool:
        """Tried again: on a busy machine this process or the front stands still for longer, too."""
        reconnects = ann.connection.counters.reconnects
        scenario.run_for(5.0)  # longer than the heartbeat timeout
        wait_for_new_state(scenario, ann)
        return ann.connection.counters.reconnects == reconnects

    assert any(stays_connected() for _ in range(3))
    assert director.scene.state is not None
    assert director.scene.state.header.tick == tick, "the loop still blocks"
    command_script(scenario, "continue")
    scenario.run_until(
        lambda: director.scene.state is not None and director.scene.state.header.tick > tick + 100, "the loop continues"
    )
    assert distance(before[0], hand.tip[0]) < 2e-3
    scenario.run_until(lambda: "left" in ann.feedback, "feedback")
    feedback = ann.feedback["left"]
    assert feedback.state == CommandKind.HOLD
    assert feedback.hold_reason in (HoldReason.GAP, HoldReason.ESTOP)
    assert any(isinstance(event.body, Gap) for event in scenario.events["ann"])
    assert ann.lease_version("left") is not None
    hand.velocity = (0.0, 0.0, 0.0)
    scenario.engage(hand)
    assert distance(before[0], hand.tip[0]) < 4e-3
    end_script(scenario)


def has_come_to_rest(scenario: Scenario, hand: Hand) -> bool:
    """Return whether the tip does not move for 0.3 s."""
    before = hand.tip
    run_ticks(scenario, hand.client, 0.3)
    return distance(before[0], hand.tip[0]) < 1e-4


@pytest.mark.long
def test_reset_by_the_script_begins_a_scene_epoch(script: Callable[[str], Scenario]) -> None:
    """The robot holds where the reset put it; old samples are rejected; the clutch must be opened and closed."""
    scenario = script(TICKS)
    watcher = scenario.join("watcher", "observer")
    scenario.run_until(lambda: watcher.scene.tip_pose("left") is not None, "a first state")
    start = watcher.scene.tip_pose("left")
    assert start is not None
    drive_left_robot(scenario)
    (hand,) = scenario.hands
    epoch = watcher.mirror.scene_epoch
    hand.sending = False
    command_script(scenario, "reset")
    scenario.run_until(lambda: watcher.mirror.scene_epoch == epoch + 1, "a new scene epoch")
    causes = [e.body.cause for e in scenario.events["watcher"] if isinstance(e.body, SceneChanged)]
    assert causes == ["external"]
    scenario.run_until(
        lambda: watcher.scene.state is not None and watcher.scene.state.header.scene_epoch == epoch + 1,
        "state of the new epoch",
    )
    run_ticks(scenario, watcher, 1.0)
    assert distance(start[0], hand.tip[0]) < 2e-3, "the robot holds where the reset put it"
    hand.sending, hand.velocity = True, (0.0, 0.0, 0.0)
    scenario.engage(hand)
    assert distance(start[0], hand.tip[0]) < 4e-3
    end_script(scenario)


def test_diverged_simulation_does_not_end_the_session(script: Callable[[str], Scenario]) -> None:
    """Clients are notified; MuJoCo's own reset in `mj_step` begins a scene epoch."""
    scenario = script(TICKS)
    watcher = scenario.join("watcher", "observer")
    command_script(scenario, "diverge")

    scenario.run_until(lambda: "MarkerAdded" in scenario.list_event_kinds("watcher"), "a marker of the divergence")
    scenario.run_until(lambda: watcher.mirror.scene_epoch == 2, "the epoch of MuJoCo's reset")
    assert "Gap" in scenario.list_event_kinds("watcher")
    command_script(scenario, "reset")  # MuJoCo's reset leaves the arms stretched, where they cannot follow
    scenario.run_until(lambda: watcher.mirror.scene_epoch == 3, "the epoch of the script's reset")
    drive_left_robot(scenario)
    end_script(scenario)


def test_session_run_in_a_script(script: Callable[[str], Scenario]) -> None:
    """The session owns the loop, so the recording is of class `closed`."""
    scenario = script(
        """
with Session(model, data, config) as session:
    print_address(session)
    session.run(until=lambda: not poll_commands())
print("ended in order", flush=True)
"""
    )
    drive_left_robot(scenario)
    command_script(scenario, "end")
    scenario.run_until(lambda: scenario.server.process.poll() is not None, "the script ends")
    assert "ended in order" in scenario.server.output
    assert run_verify(scenario.server.recording)["recording_class"] == "closed"


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("Session.attach(config=config)", "give model and data"),
        ("mujoco.set_mjcb_control(lambda m, d: None)\nSession.attach(model, data, config)", "mjcb_control"),
        ("Session(model, data, config).begin_tick()", "with Session"),
        ("Session(model, None, config).start()\nSession(model, None, config).end_tick()", "Session(model, data)"),
        ('model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP\nSession(model, data, config).start()', "sleep"),
    ],
)  # fmt: skip
def test_unsupported_use_is_refused_in_one_line(tmp_path: Path, body: str, expected: str) -> None:
    file = tmp_path / "script.py"
    file.write_text(HEAD + body)
    done = subprocess.run(
        [sys.executable, str(file)], capture_output=True, text=True, check=False, cwd=tmp_path, timeout=60.0
    )
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert "Error: " in last
    assert expected in last
