"""Sessions inside a user's own script: with `begin_tick`/`end_tick`, attached by one line, and the one-line loop."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from anchors.pose import distance
from iris_session.client import DeniedError
from iris_session.protocol.names import CommandKind, DenialReason, HoldReason
from iris_session.protocol.server_messages import Gap, MarkerAdded, SceneChanged
from tests.e2e.conftest import Hand, Server, Stage, end_all, none_left, relatives, verify

pytestmark = pytest.mark.e2e

#: What every script begins with: the demo scene with one more actuated joint that belongs to no robot, and a file
#: whose text the test changes to make the script do something.
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
order = Path("order.txt")
config = SessionConfig(name="mine", control_port=0, state_port=0, record="session.rrd")

def say(session):
    print(f"session on {session.address}, recording to {session.recording}", flush=True)

def obey():
    text = order.read_text() if order.exists() else ""
    if text:
        order.unlink()
    if text == "block":
        time.sleep(5.0)
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
    say(session)
    while obey():
        data.ctrl[model.actuator("fan_motor").id] = 0.25
        session.begin_tick()
        assert data.ctrl[model.actuator("fan_motor").id] == 0.25
        mujoco.mj_step(model, data)
        session.end_tick()
        time.sleep(0.0015)
print("ended in order", flush=True)
"""

#: No `close()`: the session ends with the script.
LAST_LINE = """
session = Session.attach(model, data, config)
say(session)
while obey():
    mujoco.mj_step(model, data)
    time.sleep(0.0015)
print("ended in order", flush=True)
"""

ATTACH = """
session = Session.attach(model, data, config)
say(session)
twin = mujoco.MjData(model)
while obey():
    data.ctrl[model.actuator("fan_motor").id] = 0.25
    mujoco.mj_step(model, data)
    mujoco.mj_forward(model, twin)
    mujoco.mj_forward(model, data)
    time.sleep(0.0015)
session.close()
assert mujoco.get_mjcb_control() is None
assert data.ctrl[model.actuator("fan_motor").id] == 0.25
print("ended in order", flush=True)
"""


class Script(Server):
    """A user's script; `order` makes it do something once."""

    def __init__(self, folder: Path, body: str) -> None:
        file = folder / "script.py"
        file.write_text(HEAD + body)
        super().__init__(folder, folder / "session.rrd", [sys.executable, str(file)])

    def order(self, text: str) -> None:
        file = self.folder / "order.new"
        file.write_text(text)
        file.rename(self.folder / "order.txt")


@pytest.fixture
def script(tmp_path: Path) -> Iterator[Callable[[str], Stage]]:
    """Starts a script and opens a stage for the people who join it."""
    stages: list[Stage] = []

    def start(body: str) -> Stage:
        stages.append(Stage(Script(tmp_path, body)))
        return stages[-1]

    yield start
    for stage in stages:
        stage.close()
    end_all([stage.server for stage in stages])


def _order(stage: Stage, text: str) -> None:
    assert isinstance(stage.server, Script)
    stage.server.order(text)


def _drive(stage: Stage) -> None:
    """Ann takes the left robot and moves it by 3 cm."""
    hand = stage.hand(stage.join("ann"), "left")
    hand.client.acquire(["left"])
    stage.engage(hand)
    before = hand.tip
    hand.velocity = (0.0, 0.1, 0.0)
    stage.run(lambda: hand.tip[0][1] - before[0][1] > 0.03, "the robot in the user's loop follows")


def _end(stage: Stage) -> None:
    """The script ends in order, and its recording of class `open` verifies."""
    _order(stage, "end")
    stage.run(lambda: stage.server.process.poll() is not None, "the script ends")
    assert stage.server.process.wait() == 0, stage.server.output
    assert "ended in order" in stage.server.output
    report = verify(stage.server.recording)
    assert report["recording_class"] == "open"
    assert report["steps"] > 10


def test_a_script_that_calls_begin_and_end_tick(script: Callable[[str], Stage]) -> None:
    stage = script(TICKS)
    _drive(stage)
    director = stage.join("director", "director")
    for action in ("pause", "reset"):
        with pytest.raises(DeniedError) as denied:
            director.control(action)
        assert denied.value.denial.reason == DenialReason.USER_OWNED
    _end(stage)


def test_an_attached_script(script: Callable[[str], Stage]) -> None:
    """One line; `mj_forward` on the same or on other data is no tick."""
    stage = script(ATTACH)
    _drive(stage)
    director = stage.join("director", "director")
    stage.run(lambda: director.scene.state is not None, "a first picture")
    state = director.scene.state
    assert state is not None
    assert state.header.tick == round(state.header.sim_time / 0.002)
    _end(stage)


def test_an_attached_script_that_simply_ends(script: Callable[[str], Stage]) -> None:
    stage = script(LAST_LINE)
    _drive(stage)
    children = relatives(stage.server.process.pid)
    _end(stage)
    none_left(children)
    assert verify(stage.server.recording)["finished"]
    ann = stage.clients[0]
    stage.run(lambda: "session_ended" in ann.connection.counters.faults, "everyone is told that it ended")


@pytest.mark.parametrize("body", [TICKS, ATTACH], ids=["ticks", "attach"])
def test_a_loop_that_blocks_for_five_seconds(script: Callable[[str], Stage], body: str) -> None:
    """Leases, heartbeats and the e-stop go on; the robot neither moves nor jumps afterwards, until clutched again."""
    stage = script(body)
    _drive(stage)
    (hand,) = stage.hands
    ann, director = hand.client, stage.join("director", "director")
    hand.velocity = (0.0, 0.0, 0.0)
    stage.run(lambda: _resting(stage, hand), "the robot has come to rest")
    _order(stage, "block")
    stage.run(lambda: _standing(stage, director), "the loop stands still")
    before, tick = hand.tip, director.scene.state.header.tick  # type: ignore[union-attr]
    director.acquire(["right"])
    assert ann.lease_version("right") is None
    ann.estop("while the script sleeps")
    stage.run(lambda: director.mirror.estop, "the e-stop is known")
    director.clear_estop()
    hand.velocity = (0.0, 0.2, 0.0)  # the hand goes on, clutch closed
    assert director.scene.state is not None
    assert director.scene.state.header.tick == tick, "the loop still stands"
    stage.run(
        lambda: director.scene.state is not None and director.scene.state.header.tick > tick + 100, "the loop goes on"
    )
    assert distance(before[0], hand.tip[0]) < 2e-3
    feedback = ann.feedback["left"]
    assert feedback.state == CommandKind.HOLD
    assert feedback.hold_reason in (HoldReason.GAP, HoldReason.ESTOP)
    assert any(isinstance(event.body, Gap) for event in stage.events["ann"])
    assert ann.lease_version("left") is not None
    assert ann.connection.counters.reconnects == 0
    hand.velocity = (0.0, 0.0, 0.0)
    stage.engage(hand)
    assert distance(before[0], hand.tip[0]) < 4e-3
    _end(stage)


def _resting(stage: Stage, hand: Hand) -> bool:
    """True once the tip has not moved for 0.3 s."""
    before = hand.tip
    stage.seconds(0.3)
    return distance(before[0], hand.tip[0]) < 1e-4


def _standing(stage: Stage, client: object) -> bool:
    """True once the tick has not changed for 0.3 s."""
    from iris_session.client import Client

    assert isinstance(client, Client)
    tick = client.scene.state.header.tick if client.scene.state is not None else -1
    stage.seconds(0.3)
    return client.scene.state is not None and client.scene.state.header.tick == tick


def test_a_reset_by_the_script_is_a_new_epoch(script: Callable[[str], Stage]) -> None:
    """The robot holds where the reset put it; old samples do not count; clutching again drives."""
    stage = script(TICKS)
    watcher = stage.join("watcher", "observer")
    stage.run(lambda: watcher.scene.tip_pose("left") is not None, "a first picture")
    start = watcher.scene.tip_pose("left")
    assert start is not None
    _drive(stage)
    (hand,) = stage.hands
    epoch = watcher.mirror.scene_epoch
    hand.sending = False
    _order(stage, "reset")
    stage.run(lambda: watcher.mirror.scene_epoch == epoch + 1, "a new scene epoch")
    causes = [e.body.cause for e in stage.events["watcher"] if isinstance(e.body, SceneChanged)]
    assert causes == ["external"]
    stage.run(
        lambda: watcher.scene.state is not None and watcher.scene.state.header.scene_epoch == epoch + 1,
        "its first picture",
    )
    stage.seconds(1.0)
    assert distance(start[0], hand.tip[0]) < 2e-3, "the robot must stay where the reset put it"
    hand.sending, hand.velocity = True, (0.0, 0.0, 0.0)
    stage.engage(hand)
    assert distance(start[0], hand.tip[0]) < 4e-3
    _end(stage)


def test_a_simulation_that_diverges_does_not_end_the_session(script: Callable[[str], Stage]) -> None:
    """Numbers that are not finite: everyone is told; MuJoCo's own reset in `mj_step` is a new epoch."""
    stage = script(TICKS)
    watcher = stage.join("watcher", "observer")
    _order(stage, "diverge")

    def told() -> bool:
        texts = [e.body.text for e in stage.events["watcher"] if isinstance(e.body, MarkerAdded)]
        return any("not finite" in text for text in texts)

    stage.run(told, "everyone is told")
    stage.run(lambda: watcher.mirror.scene_epoch == 2, "MuJoCo's reset is a new epoch")
    assert "Gap" in stage.bodies("watcher")
    _order(stage, "reset")  # MuJoCo's reset leaves the arms stretched out, where they cannot follow
    stage.run(lambda: watcher.mirror.scene_epoch == 3, "the script's reset is another")
    _drive(stage)
    _end(stage)


def test_the_one_liner(script: Callable[[str], Stage]) -> None:
    """`Session(model, data).run()` inside `with`: our loop, a closed recording."""
    stage = script(
        """
with Session(model, data, config) as session:
    say(session)
    session.run(until=lambda: not obey())
print("ended in order", flush=True)
"""
    )
    _drive(stage)
    _order(stage, "end")
    stage.run(lambda: stage.server.process.poll() is not None, "the script ends")
    assert "ended in order" in stage.server.output
    assert verify(stage.server.recording)["recording_class"] == "closed"


@pytest.mark.parametrize(
    ("body", "expected"),
    [
        ("model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4\nSession.attach(model, data, config)", "RK4"),
        ("mujoco.set_mjcb_control(lambda m, d: None)\nSession.attach(model, data, config)", "begin_tick"),
        ("Session(model, data, config).begin_tick()", "with Session"),
        ("Session(model, None, config).start()\nSession(model, None, config).end_tick()", "Session(model, data)"),
        ('model.opt.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP\nSession(model, data, config).start()', "sleep"),
    ],
)  # fmt: skip
def test_what_cannot_work_is_refused_in_one_line(tmp_path: Path, body: str, expected: str) -> None:
    file = tmp_path / "script.py"
    file.write_text(HEAD + body)
    done = subprocess.run(
        [sys.executable, str(file)], capture_output=True, text=True, check=False, cwd=tmp_path, timeout=60.0
    )
    assert done.returncode == 1
    last = done.stderr.strip().splitlines()[-1]
    assert "Error: " in last
    assert expected in last
