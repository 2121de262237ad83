"""`bench hands`: tracking that is disturbed while a hand drives an arm, and people who only move fast.

Authority, control and physics of a session (`SessionCore`) in simulated time, without processes, for every device that
measures, at 30 to 90 Hz.

- `worst_tip_motion_mm`: farthest that the tip gets from the way that it has gone by then without the disturbance.
- `false_holds_per_hour`: holds of undisturbed people who move as fast as they can (`hand_motion`), by the authority.
- `reclutch_joint_rad`: farthest that a joint gets in twenty re-clutches with a still hand.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from iris_session.authority import Authority, AuthorityConfig
from iris_session.bench.hand_motion import PEAK_SPEED, PEOPLE, make_fast_motion, move_minimum_jerk, report_pose
from iris_session.bench.operator import OPENING_STEPS, ScriptedOperator
from iris_session.bench.report import BenchError, BenchReport, make_bar
from iris_session.control import ControlConfig
from iris_session.demo.scenes.generators import n_arms_scene
from iris_session.physics.robots import find_robots
from iris_session.protocol.client_messages import Sample
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.names import CommandKind
from iris_session.protocol.server_messages import EngagementChanged
from iris_session.protocol.steps import Decision, FixedView
from iris_session.session.core import CoreConfig, SessionCore

MS: Final = 1_000_000
STEP_NS: Final = 2 * MS
RATES_HZ: Final = (30, 60, 72, 90)
#: Length and peak speed of the strokes, to and fro, in which a disturbance comes [m], [m/s].
MOTIONS: Final = {"still": (0.0, 0.0), "half_a_metre_per_second": (0.2, 0.5), "a_metre_per_second": (0.3, 1.0)}
JUMPS_M: Final = (0.03, 0.06, 0.15, 0.3, 1.0)
HITCHES_S: Final = (0.02, 0.05, 0.1, 0.14, 0.5)
#: Longest time for which a disturbance is watched [s].
WATCHED_S: Final = 1.2
#: Where the hand is in its tracking frame [m].
AT: Final = np.array([0.3, -0.2, 1.1])
#: Seconds in which the session begins, the clutch closes, and the motion begins.
CLUTCH_S: Final = 0.1
MOTION_S: Final = 0.3
MAX_TIP_MOTION_MM: Final = 20.0
#: Seconds since it began, and the sample that would be sent -> that which is sent.
Change = Callable[[float, Sample], Sample]


class Disturbance(NamedTuple):
    """Nothing is sent for `silence_s`, then what `change` makes of samples for `change_s` [s]."""

    kind: str
    silence_s: float
    change_s: float = 0.0
    change: Change = lambda _, sample: sample

    def apply(self, s: float, sample: Sample) -> Sample | None:
        """Return what is sent instead of a sample, `s` seconds after the disturbance began."""
        if s < self.silence_s:
            return None
        return self.change(s, sample) if s < self.silence_s + self.change_s else sample


def _shift(x: float, y: float = 0.0) -> Change:
    def change(_: float, sample: Sample) -> Sample:
        assert sample.pose is not None
        p = sample.pose.p
        return msgspec.structs.replace(sample, pose=Pose((p[0] + x, p[1] + y, p[2]), sample.pose.q))

    return change


def _freeze() -> Change:
    frozen: list[Pose | None] = []

    def change(_: float, sample: Sample) -> Sample:
        frozen.append(frozen[0] if frozen else sample.pose)
        return msgspec.structs.replace(sample, pose=frozen[0])

    return change


def _emulate(s: float, sample: Sample) -> Sample:
    """Return a sample by dead reckoning, which goes astray with 1 m/s."""
    return msgspec.structs.replace(_shift(s)(s, sample), emulated=True)


def list_disturbances(rate_hz: int) -> dict[str, Disturbance]:
    """Return every disturbance by name."""
    out = {
        "zero_pose": Disturbance(
            "zero_pose", 0.0, 0.2, lambda _, sample: msgspec.structs.replace(sample, pose=IDENTITY)
        ),
        "emulated": Disturbance("emulated", 0.0, 0.3, _emulate),
    }
    for seconds in (0.2, 0.8):
        out[f"freeze_{1e3 * seconds:.0f}_ms"] = Disturbance("freeze", 0.0, seconds, _freeze())
    for seconds in HITCHES_S:
        out[f"hitch_{1e3 * seconds:.0f}_ms"] = Disturbance("hitch", seconds)
    for size in JUMPS_M:
        mm = f"{1e3 * size:.0f}_mm"
        for name, change in (("along", _shift(0.0, size)), ("across", _shift(size)), ("back", _shift(0.0, -size))):
            out[f"jump_{mm}_{name}"] = Disturbance("jump", 0.0, math.inf, change)
        for silence_s in (0.05, 0.1):
            name = f"hitch_{1e3 * silence_s:.0f}_ms_jump_{mm}"
            out[name] = Disturbance("hitch_and_jump", silence_s, math.inf, _shift(size))
        out[f"outlier_{mm}"] = Disturbance("outlier", 0.0, 0.9 / rate_hz, _shift(size))
    return out


class HandScenario:
    """A session of one operator whose hand drives an arm. `disturbance` acts from `disturbed_ns` on."""

    def __init__(self, device: str, rate_hz: int, motion: str, seed: int) -> None:
        model = n_arms_scene(1, 0).compile()
        robots = find_robots(model).robots
        self.core = SessionCore(model, CoreConfig(AuthorityConfig(), ControlConfig(), robots, ()))
        self.robot = robots[0].name
        self.device, self.rate_hz = device, rate_hz
        self.length, self.speed = MOTIONS[motion]
        self.operator = ScriptedOperator(device, self.robot)
        self.step_number = 0
        self.clutch = True
        self.disturbance = Disturbance("", 0.0)
        stroke_s = self.stroke_s
        self.disturbed_ns = int((MOTION_S + 2.5 * stroke_s) * 1e9) if stroke_s else int(0.8e9)
        self._noise = np.random.default_rng(seed).standard_normal((4096, 6))
        self.decision = Decision(())

    @property
    def stroke_s(self) -> float:
        """Duration of a stroke [s], 0 without motion."""
        return PEAK_SPEED * self.length / self.speed if self.speed else 0.0

    @property
    def now_ns(self) -> int:
        return (self.step_number + 1) * STEP_NS

    def make_pose(self, capture_ns: int) -> Pose:
        """Return the pose that the device measures: a still hand trembles by a micrometre."""
        p = AT.copy()
        index = capture_ns * self.rate_hz // 1_000_000_000
        strokes = max(0.0, capture_ns * 1e-9 - MOTION_S) / self.stroke_s if self.stroke_s else 0.0
        whole, part = divmod(strokes, 1.0)
        done = float(move_minimum_jerk(np.array(part)))
        p[1] += self.length * (1.0 - done if int(whole) % 2 else done)
        noise = PEOPLE[self.device].noise_m if self.stroke_s else 1e-6
        x, y, z = (p + noise * self._noise[index % len(self._noise), :3]).tolist()
        return Pose((x, y, z), (1.0, 0.0, 0.0, 0.0))

    def step(self) -> None:
        """Take one step, with the sample that is due."""
        now_ns = self.now_ns
        entries = self.operator.make_opening(self.step_number, now_ns)
        count, before = now_ns * self.rate_hz // 10**9, (now_ns - STEP_NS) * self.rate_hz // 10**9
        if count > before and self.step_number > OPENING_STEPS:
            capture_ns = count * 10**9 // self.rate_hz
            clutch = self.clutch and capture_ns >= CLUTCH_S * 1e9
            sample = self.operator.make_sample(self.make_pose(capture_ns), capture_ns, clutch)
            sent: Sample | None = sample
            if capture_ns >= self.disturbed_ns:
                sent = self.disturbance.apply((capture_ns - self.disturbed_ns) * 1e-9, sample)
            if sent is not None:
                entries.append(self.operator.make_entry(sent, now_ns))
        self.decision = self.core.step(now_ns, entries, 1, digest=False).decision
        self.step_number += 1

    def run_until(self, end_ns: int) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Step until `end_ns`; returns the positions of the tip [m], shape (n, 3)."""
        tips = []
        while self.now_ns <= end_ns:
            self.step()
            tips.append(self.core.world.view().tip_pose(self.robot).p)
        return np.array(tips).reshape(-1, 3)

    def is_driven(self) -> bool:
        return self.decision.commands[0].kind != CommandKind.HOLD


def run_disturbances(device: str, rate_hz: int, motion: str, seed: int) -> dict[str, tuple[str, float]]:
    """Return kind of every disturbance, and the motion of the tip that it causes [mm], by name."""
    run = HandScenario(device, rate_hz, motion, seed)
    before = run.run_until(run.disturbed_ns - STEP_NS)
    if not run.is_driven():
        raise BenchError(f"{device} at {rate_hz} Hz does not drive: {run.decision.commands[0].hold_reason}")
    end_ns = run.disturbed_ns + int(WATCHED_S * 1e9)
    state, step_number = run.core.snapshot(), run.step_number
    undisturbed = np.concatenate([before, run.run_until(end_ns)])
    out: dict[str, tuple[str, float]] = {}
    for name, disturbance in list_disturbances(rate_hz).items():
        length_s = disturbance.silence_s + (disturbance.change_s if disturbance.change_s < math.inf else 0.0)
        run.core.restore(state)
        run.step_number, run.disturbance = step_number, disturbance
        is_held, worst, k = False, 0.0, len(before)
        until_ns = min(end_ns, run.disturbed_ns + int((length_s + 0.25) * 1e9))
        while run.now_ns <= until_ns:
            run.step()
            k += 1
            if not is_held and not run.is_driven():
                is_held = True
                until_ns = min(until_ns, run.now_ns + 150 * MS)
            tip = run.core.world.view().tip_pose(run.robot).p
            worst = max(worst, float(np.linalg.norm(undisturbed[:k] - tip, axis=1).min()))
        out[name] = (disturbance.kind, round(1e3 * worst, 2))
    return out


def measure_reclutches(device: str, rate_hz: int, seed: int) -> float:
    """Return the farthest that a joint gets in twenty re-clutches with a still hand [rad]."""
    run = HandScenario(device, rate_hz, "still", seed)
    run.run_until(run.disturbed_ns)
    q0 = np.array(run.core.world.view().joints(run.robot))
    worst = 0.0
    for _ in range(20):
        for clutch in (False, True):
            run.clutch = clutch
            run.run_until(run.now_ns + 100 * MS)
            worst = max(worst, float(np.abs(np.array(run.core.world.view().joints(run.robot)) - q0).max()))
        if not run.is_driven():
            raise BenchError(f"the clutch of {device} does not close again: {run.decision.commands[0].hold_reason}")
    return worst


def count_false_holds(device: str, rate_hz: int, seconds: float, seed: int) -> int:
    """Return the holds of a person who drives by fast motion; after a hold the clutch is opened and closed."""
    rng = np.random.default_rng(seed)
    person, robots = PEOPLE[device], find_robots(n_arms_scene(1, 0).compile()).robots
    robot = robots[0]
    view = FixedView(tips={robot.name: IDENTITY}, q={robot.name: (0.0,) * len(robot.joints)})
    authority = Authority(AuthorityConfig(), robots, ())
    operator, holds, clutch = ScriptedOperator(device, robot.name), 0, False
    for step in range(OPENING_STEPS):
        authority.step((step + 1) * MS, operator.make_opening(step, (step + 1) * MS), 1, view, ())
    for index, numbers in enumerate(make_fast_motion(person, rate_hz, seconds, rng)):
        now_ns = 10 * MS + index * 10**9 // rate_hz
        pose = report_pose(numbers + np.append(AT, np.zeros(3)), person, rng)
        sample = operator.make_entry(operator.make_sample(pose, now_ns, clutch), now_ns)
        decision = authority.step(now_ns, [sample], 1, view, ())
        clutch = True
        for event in decision.events:
            if isinstance(event.body, EngagementChanged) and not event.body.engaged:
                holds, clutch = holds + 1, False
    return holds


def run_hands(seconds: float = 300.0, seed: int = 0, progress: Callable[[str], None] = lambda _: None) -> BenchReport:
    """Disturb every device at every rate, and count the holds of people who only move fast."""
    cases: dict[str, Any] = {}
    missed: dict[str, float] = {}
    for device in PEOPLE:
        for rate_hz in RATES_HZ:
            progress(f"{device} at {rate_hz} Hz")
            name = f"{device} {rate_hz} Hz"
            worst: dict[str, float] = {}
            for motion in MOTIONS:
                for label, (kind, mm) in run_disturbances(device, rate_hz, motion, seed).items():
                    worst[kind] = max(worst.get(kind, 0.0), mm)
                    if mm > MAX_TIP_MOTION_MM:
                        missed[f"{name} {motion} {label}"] = mm
            cases[name] = {
                "tip_motion_mm": worst,
                "false_holds": count_false_holds(device, rate_hz, seconds, seed),
                "reclutch_joint_rad": round(measure_reclutches(device, rate_hz, seed), 6),
            }
    hours = len(cases) * seconds / 3600.0
    kinds = next(iter(cases.values()))["tip_motion_mm"]
    worst_by_kind = {kind: max(case["tip_motion_mm"][kind] for case in cases.values()) for kind in kinds}
    results: dict[str, Any] = {
        "worst_tip_motion_mm": max(worst_by_kind.values()),
        "false_holds_per_hour": round(sum(case["false_holds"] for case in cases.values()) / hours, 3),
        "reclutch_joint_rad": max(case["reclutch_joint_rad"] for case in cases.values()),
        "fast_hours": round(hours, 3),
        "tip_motion_mm": worst_by_kind,
        "over_the_bar": missed,
        "cases": cases,
    }
    bars = (
        make_bar(results, "worst_tip_motion_mm", "<=", MAX_TIP_MOTION_MM),
        make_bar(results, "false_holds_per_hour", "<=", 1.0),
        make_bar(results, "reclutch_joint_rad", "<=", 0.001),
    )
    return BenchReport(results, bars)
