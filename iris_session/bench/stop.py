"""`bench stop`: an arm is pressed against a wall, a hold begins, the wall goes away.

Authority, control and physics of a session (`SessionCore`) without processes, for every kind of actuator and every
cause of a hold. Per case: `force_ratio`, the greatest joint torque without gravity from 200 ms after the hold began
until the wall goes, over the greatest one when it began; `lunge_rad`, the farthest that a joint moves afterwards.

Torque without gravity: that of the actuators (`qfrc_actuator`) less gravity and Coriolis torques (`qfrc_bias`). An arm
that carries its own weight and pushes nothing has none.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Final

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.authority import AuthorityConfig
from iris_session.bench.operator import OPENING_STEPS, ScriptedOperator
from iris_session.bench.report import BenchError, BenchReport, make_bar
from iris_session.control import ControlConfig
from iris_session.protocol.client_messages import Control, EStop, Release, Sample, TrackingEpoch
from iris_session.protocol.common import Pose, Target
from iris_session.protocol.entries import HOST, Entry, EntryMessage, Lost, SessionResumed
from iris_session.protocol.names import CommandKind
from iris_session.protocol.specs import RobotSpec
from iris_session.session.core import CoreConfig, SessionCore

TICK_NS: Final = 2_000_000
#: One sample in so many steps: 71 Hz.
SAMPLE_STEPS: Final = 7
FORCE_AFTER_S: Final = 0.2
WALL_AFTER_S: Final = 0.5
LUNGE_S: Final = 0.6
MAX_FORCE_RATIO: Final = 0.3
MAX_LUNGE_RAD: Final = 0.03
OPERATOR: Final = ScriptedOperator("controller/right", "arm")
_LIMITS: Final = 'forcelimited="true" forcerange="-60 60"'
#: One actuator by kind; `{0}` is the joint.
ACTUATORS: Final = {
    "position": f'<position name="{{0}}" joint="{{0}}" kp="600" kv="40" {_LIMITS}/>',
    "position_weak": f'<position name="{{0}}" joint="{{0}}" kp="120" kv="12" {_LIMITS}/>',
    "position_filtered": f'<position name="{{0}}" joint="{{0}}" kp="600" kv="40" timeconst="0.03" {_LIMITS}/>',
    "velocity": f'<velocity name="{{0}}" joint="{{0}}" kv="40" {_LIMITS}/>',
    "integrated_velocity": f'<intvelocity name="{{0}}" joint="{{0}}" kp="600" kv="40" actrange="-9 9" {_LIMITS}/>',
    "gravity_pd": f'<motor name="{{0}}" joint="{{0}}" {_LIMITS}/>',
}
KINDS: Final = tuple(ACTUATORS)
_SCENE: Final = """<mujoco model="wall"><compiler angle="radian"/><option timestep="0.002" integrator="implicitfast"/>
<default><geom type="capsule" size="0.03" contype="0" conaffinity="0"/><joint damping="0.5" armature="0.05"/></default>
<worldbody>
  <body name="base" pos="0 0 0.4">
    <body name="link1"><joint name="yaw" axis="0 0 1"/><geom fromto="0 0 0 0 0 0.1" mass="2"/>
      <body name="link2" pos="0 0 0.1"><joint name="shoulder" axis="0 1 0"/><geom fromto="0 0 0 0.3 0 0" mass="1.5"/>
        <body name="link3" pos="0.3 0 0"><joint name="elbow" axis="0 0 1"/><geom fromto="0 0 0 0.3 0 0" mass="1"/>
          <geom name="fist" type="sphere" pos="0.3 0 0" size="0.04" mass="0.1" contype="1" conaffinity="1"/>
          <site name="tip" pos="0.3 0 0"/>
          <body name="finger" pos="0.34 0 0"><joint name="finger" type="slide" axis="0 1 0" range="0 0.04"/>
            <geom type="box" size="0.02 0.005 0.01" mass="0.02"/></body>
        </body></body></body></body>
  <body name="wall" mocap="true" pos="0.5 0.18 0.5">
    <geom name="wall" type="box" size="0.5 0.05 0.4" contype="1" conaffinity="1"/></body>
</worldbody>
<actuator>{actuators}<position name="grip" joint="finger" kp="500" kv="10" ctrlrange="0 0.04"/></actuator>
<keyframe><key name="home" qpos="-0.6 0.1 1.2 0.02" ctrl="{ctrl} 0.02"/></keyframe></mujoco>"""
JOINTS: Final = ("yaw", "shoulder", "elbow")
_HOME: Final = "-0.6 0.1 1.2"


def make_wall_model(kind: str) -> mujoco.MjModel:
    """Return a three-joint arm with a gripper beside a wall that can be moved away, `home` a keyframe."""
    actuators = "".join(ACTUATORS[kind].format(joint) for joint in JOINTS)
    ctrl = _HOME if kind.startswith("position") else "0 0 0"
    return mujoco.MjModel.from_xml_string(_SCENE.format(actuators=actuators, ctrl=ctrl))


def make_wall_robot(kind: str) -> RobotSpec:
    """Return the specification of that arm."""
    hold = "gravity_pd" if kind == "gravity_pd" else ""
    return RobotSpec("arm", JOINTS, JOINTS, "tip", "base", gripper_actuator="grip", gripper_open=0.04, hold=hold)


def remove_wall(data: mujoco.MjData) -> None:
    """Move the wall out of reach."""
    data.mocap_pos[0] = (9.0, 9.0, 0.5)


def measure_push(data: mujoco.MjData) -> NDArray[np.float64]:
    """Return what the actuators of the arm's joints give beyond gravity [N m], shape (3,)."""
    push: NDArray[np.float64] = data.qfrc_actuator[:3] - data.qfrc_bias[:3] + data.qfrc_gravcomp[:3]
    return push


class Case(msgspec.Struct, frozen=True):
    """Results of one kind of actuators and one cause of a hold: see the module."""

    force_ratio: float
    lunge_rad: float
    force_nm: float
    top_speed_rad_s: float
    grip_kept: bool


class StopScenario:
    """A session of one operator who presses the arm against the wall with a hand that goes on for `press_s`."""

    def __init__(self, kind: str, press_s: float) -> None:
        self.core = self.make_core(kind)
        self.kind = kind
        self.step_number = 0
        self.sends = True
        self.changes: dict[str, Any] = {}
        self.push = 0.0  # greatest joint torque without gravity after the last step that was no hold [N m]
        # Clutch seen open, then closed; the gripper closes half.
        self.run(0.05)
        self.changes["clutch"] = True
        self.begin_step = self.step_number
        self.run(0.5 + press_s)
        if not self._is_pressing():
            raise BenchError(f"the arm with {kind} actuators does not reach the wall")

    @staticmethod
    def make_core(kind: str) -> SessionCore:
        """Return a new session of the scene."""
        config = CoreConfig(AuthorityConfig(), ControlConfig(), (make_wall_robot(kind),), ())
        return SessionCore(make_wall_model(kind), config)

    @property
    def now_ns(self) -> int:
        return (self.step_number + 1) * TICK_NS

    def submit(self, message: EntryMessage) -> Entry:
        return OPERATOR.make_entry(message, self.now_ns)

    def control(self, message: EntryMessage) -> Entry:
        """Return a message of the program that runs the session."""
        return Entry(HOST, HOST, self.now_ns, message)

    def run(self, seconds: float, entries: Sequence[Entry] = (), n_ticks: int = 1) -> None:
        """Take steps for `seconds`; `entries` come with the first."""
        for _ in range(round(seconds * 1e9) // TICK_NS):
            self.step(entries, n_ticks)
            entries = ()

    def step(self, entries: Sequence[Entry] = (), n_ticks: int = 1) -> None:
        entries_now = [*entries, *OPERATOR.make_opening(self.step_number, self.now_ns)]
        if self.sends and self.step_number > OPENING_STEPS and self.step_number % SAMPLE_STEPS == 0:
            entries_now.append(self.submit(self._make_sample()))
        self.outcome = self.core.step(self.now_ns, entries_now, n_ticks, digest=False)
        self.step_number += 1
        if n_ticks and self.outcome.decision.commands[0].kind != CommandKind.HOLD:
            self.push = float(np.abs(measure_push(self.core.world.data)).max())

    def save(self) -> Callable[[], None]:
        """Return a function that puts the session back to where it is now."""
        state, kept = self.core.snapshot(), (self.step_number, self.outcome, self.push, self.sends, dict(self.changes))

        def restore() -> None:
            self.core.restore(state)
            self.step_number, self.outcome, self.push, self.sends, changes = kept
            self.changes = dict(changes)

        return restore

    def _make_sample(self) -> Sample:
        pressed_s = (self.step_number - self.begin_step) * TICK_NS * 1e-9 if "clutch" in self.changes else 0.0
        at = Pose((0.0, 0.6 * min(1.0, pressed_s), 1.0 + 1e-9 * self.step_number), (1.0, 0.0, 0.0, 0.0))
        sample = OPERATOR.make_sample(at, self.now_ns, clutch=False)
        return msgspec.structs.replace(sample, gripper=0.5, **self.changes)

    def _is_pressing(self) -> bool:
        command = self.outcome.decision.commands[0]
        return command.kind != CommandKind.HOLD and self.core.world.data.ncon > 0


def _pause(run: StopScenario) -> None:
    run.step([run.control(Control(0, "pause"))], 0)
    run.sends = False
    run.run(0.2, n_ticks=0)
    run.step([run.control(Control(0, "resume"))])


def _resume(run: StopScenario) -> None:
    state = run.core.snapshot()
    run.core = run.make_core(run.kind)
    run.core.restore(state)
    run.sends = False
    run.step([run.control(SessionResumed(1_000_000_000))])


def _disconnect(run: StopScenario) -> None:
    run.sends = False
    run.step([run.submit(Lost("timeout"))])


def _stop_sending(run: StopScenario, steps: int = 0) -> None:
    """Send no samples any more. `steps`: for which the loop stands still first."""
    run.step_number += steps
    run.sends = False


#: What makes a hold begin, by cause.
CAUSES: Final[dict[str, Callable[[StopScenario], None]]] = {
    "clutch_open": lambda run: run.changes.update(clutch=False),
    "stale": _stop_sending,
    "estop": lambda run: run.step([run.submit(EStop())]),
    "disconnected": _disconnect,
    "untracked": lambda run: run.changes.update(tracked=False),
    "not_worn": lambda run: run.changes.update(worn=False),
    "released": lambda run: run.step([run.submit(Release(0, (Target("arm", 1),)))]),
    "tracking_epoch": lambda run: run.step([run.submit(TrackingEpoch(1))]),
    "rejected": lambda run: run.changes.update(capture_ns=0),
    "paused": _pause,
    "gap": lambda run: _stop_sending(run, 500),
    "resumed": _resume,
}


def run_case(run: StopScenario, cause: str) -> Case:
    """Let a hold begin by `cause`, take the wall away after `WALL_AFTER_S`, and measure."""
    grip = float(run.core.world.data.ctrl[3])
    CAUSES[cause](run)
    for _ in range(200):
        if run.outcome.decision.commands[0].kind == CommandKind.HOLD:
            break
        run.step()
    else:
        raise BenchError(f"no hold began by {cause}")
    run.run(FORCE_AFTER_S)
    after, data = 0.0, run.core.world.data
    for _ in range(round((WALL_AFTER_S - FORCE_AFTER_S) * 1e9) // TICK_NS):
        after = max(after, float(np.abs(measure_push(data)).max()))
        run.step()
    remove_wall(data)
    q0, lunge, speed = data.qpos[:3].copy(), 0.0, 0.0
    for _ in range(round(LUNGE_S * 1e9) // TICK_NS):
        run.step()
        lunge = max(lunge, float(np.abs(data.qpos[:3] - q0).max()))
        speed = max(speed, float(np.abs(data.qvel[:3]).max()))
    kept = float(data.ctrl[3]) == grip
    return Case(round(after / run.push, 4), round(lunge, 5), round(run.push, 2), round(speed, 3), kept)


def run_stop(seconds: float = 1.0, progress: Callable[[str], None] = lambda _: None) -> BenchReport:
    """Measure every kind of actuator and every cause of a hold."""
    seconds = min(seconds, 60.0)
    cases: dict[str, dict[str, Case]] = {}
    for kind in KINDS:
        progress(kind)
        run = StopScenario(kind, seconds)
        restore = run.save()
        for cause in CAUSES:
            restore()
            cases.setdefault(kind, {})[cause] = run_case(run, cause)
    every = [case for by_cause in cases.values() for case in by_cause.values()]
    results: dict[str, Any] = {
        "worst_force_ratio_after_200ms": max(case.force_ratio for case in every),
        "worst_lunge_rad": max(case.lunge_rad for case in every),
        "grips_kept": sum(case.grip_kept for case in every),
        "cases": {kind: {name: msgspec.structs.asdict(c) for name, c in by.items()} for kind, by in cases.items()},
    }
    bars = (
        make_bar(results, "worst_force_ratio_after_200ms", "<=", MAX_FORCE_RATIO),
        make_bar(results, "worst_lunge_rad", "<=", MAX_LUNGE_RAD),
        make_bar(results, "grips_kept", ">=", len(every)),
    )
    return BenchReport(results, bars, params={"seconds": seconds})
