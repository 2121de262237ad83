"""Live alignment of headsets at one table while one is bumped, one recentres and one drifts.

The emulator knows the true poses of its headsets, so the tests know where each of them shows the hammer in the true
world.
"""

from __future__ import annotations

import itertools
from collections import Counter
from typing import Any, Final

import msgspec
import numpy as np
import pytest

from anchors.pose import PoseTuple, apply, distance
from anchors.uncertainty import covariance_at_point, length_p95
from iris_session.client import Client
from iris_session.client.core.state_stream import SceneState
from iris_session.control import ControlConfig
from iris_session.demo.scenes import n_arms_scene
from iris_session.emulator.headset import DEFAULT_T_WORLD_ANCHOR, HeadsetModel
from iris_session.emulator.operator import EmulatedOperator
from iris_session.protocol.names import AlarmKind, AlignmentDoubt, HoldReason
from iris_session.protocol.server_messages import AlignmentAlarmed, HeadsetsCompared, Notice
from tests.rig.session import Rig, is_driven

SECOND = 1_000_000_000
TICK = 0.02  # [s]
STEADY: Final = HeadsetModel(drift_m_per_min=0.0, drift_rad_per_min=0.0)
#: Where people look who do not look at the sheet [m].
AWAY: Final = (3.0, -0.9, 0.5)
#: A pair may differ by this multiple of its p95 by chance (`anchors.cross_check.Disagreement.as_expected`).
CHANCE_FACTOR: Final = 2.0
#: Bound of the speed of a tip [m/s], also of one whose hand was bumped with the clutch closed.
MAX_TIP_SPEED: Final = ControlConfig().tip_speed


class Tips:
    """The tip of a robot in every state that a client receives: no part of it may be faster than `MAX_TIP_SPEED`."""

    def __init__(self, client: Client, robot: str) -> None:
        self.client = client
        self.robot = robot
        self._seen: list[tuple[float, PoseTuple, bool]] = []
        before = client.on_state
        client.on_state = lambda state: (before and before(state), self._add(state))  # type: ignore[assignment]

    def _add(self, state: SceneState) -> None:
        tip = self.client.scene.tip_pose(self.robot)
        assert tip is not None
        self._seen.append((state.header.sim_time, tip, is_driven(self.client, self.robot)))

    def check_speed(self) -> None:
        assert len(self._seen) > 100
        for (t0, a, _), (t1, b, _) in itertools.pairwise(self._seen):
            assert distance(a[0], b[0]) <= MAX_TIP_SPEED * (t1 - t0) + 1e-4, (t0, t1)

    def check_rest(self, settle_s: float = 0.5) -> None:
        """Check that the tip rested from `settle_s` after driving ended until it began again."""
        rests = 0
        for driven, part in itertools.groupby(self._seen, lambda one: one[2]):
            seen = list(part)
            resting = [tip[0] for t, tip, _ in seen if t > seen[0][0] + settle_s]
            if not driven and resting:
                rests += 1
                assert max(distance(p, resting[0]) for p in resting) < 1e-3
        assert rests, "it never rested"


class Afternoon:
    """People at one sheet, `table`, that all of them look at. `bump_sheet` moves it, as long as nobody looks."""

    def __init__(self, rig: Rig, watcher: Client) -> None:
        self.rig = rig
        self.watcher = watcher
        self.operators: list[EmulatedOperator] = []
        self.T_world_sheet = DEFAULT_T_WORLD_ANCHOR
        self._told = 0

    def seat(self, name: str, robot: str, **spec: Any) -> EmulatedOperator:
        """Let an operator join with a headset that sends little, by default with nothing to do."""
        fields = {field: spec.pop(field) for field in ("detection_hz", "near_share") if field in spec}
        model = HeadsetModel(rate_hz=12.0, **fields)
        looks = {"viewpoints": 2, "observations_per_viewpoint": 8}
        usual = {"behaviour": "idle", "seed": 11 + len(self.operators), "T_world_anchor": self.T_world_sheet, **looks}
        self.operators.append(self.rig.emulate(name=name, robot=robot, model=model, **{**usual, **spec}))
        return self.operators[-1]

    def bump_sheet(self, x: float) -> None:
        """Move the sheet by `x` [m]."""
        p, q = self.T_world_sheet
        self.T_world_sheet = ((p[0] + x, p[1], p[2]), q)
        for one in self.operators:
            msgspec.structs.force_setattr(one.spec, "T_world_anchor", self.T_world_sheet)

    def pass_time(self, seconds: float) -> None:
        """Let time pass in which the machine and everybody's programs stand still."""
        for client in self.rig.clients:
            self.rig.hang(client, seconds)
        self.rig.suspend_machine(seconds)
        self.rig.run(seconds + 1.0)

    def forget(self) -> None:
        """Count warnings from now on."""
        self._told = len(self.rig.list_events("watcher", Notice))

    def count_warnings(self) -> dict[str, int]:
        """Return the number of warnings by name of whom they concern; empty: everybody."""
        names = {one.client.participant_id: one.client.name for one in self.operators} | {"": ""}
        told = [b for _, b in self.rig.list_events("watcher", Notice)[self._told :] if b.level == "warning"]
        return dict(Counter(names[body.participant] for body in told))

    def list_doubts(self) -> dict[str, str]:
        """Return the doubts about alignments by name, of those who have any."""
        reports = {p.name: p.alignment_report for p in self.watcher.status().participants}
        return {name: r.doubt for name, r in reports.items() if r is not None and r.doubt}

    def list_unverified(self) -> set[tuple[str, str]]:
        """Return the names of the pairs that are unverified: who is to glance, because of whom."""
        status = self.watcher.status()
        names = {p.id: p.name for p in status.participants}
        return {(names[one.participant], names[one.other]) for one in status.unverified}

    def run_until_working(self, *operators: EmulatedOperator) -> None:
        """Wait until operators are aligned and have their robots."""
        self.rig.run_until(lambda: all(one.report.phase == "work" for one in operators), "they are aligned")

    def run_until_held(self, operator: EmulatedOperator) -> None:
        """Wait until the robot of an operator holds because its alignment is unconfirmed."""
        told, robot = operator.client.feedback, operator.spec.robot
        self.rig.run_until(lambda: told[robot].hold_reason == HoldReason.UNCONFIRMED, f"{robot} holds")

    def glance_until_confident(self) -> None:
        """Let those who are asked for it glance at the sheet, until nobody is in doubt and no correction waits."""
        for _ in range(3):
            doubts = self.list_doubts()
            for one in self.operators:
                if one.client.name in doubts:
                    one.glance()
            self.rig.run(0.5)
            self.run_until_working(*self.operators)
            for _ in range(5):
                self.rig.run(0.5)
                reports = [p.alignment_report for p in self.watcher.status().participants if p.alignment_report]
                if not any(r.doubt or r.pending_m for r in reports):
                    return
        pytest.fail(f"somebody is in doubt: {self.list_doubts()}")

    def check_errors(self) -> None:
        """Check that everybody shows the world where the sheet lies now, within the stated error at the sheet."""
        for one in self.operators:
            report, alignment = one.finish_report(), one.client.alignment.current
            assert report.T_true_shown is not None
            assert alignment is not None
            off_m = distance(apply(report.T_true_shown, DEFAULT_T_WORLD_ANCHOR[0]), self.T_world_sheet[0])
            assert off_m <= alignment.error_at_anchor_m, one.client.name


def emulate_driver(rig: Rig, name: str, robot: str, seed: int, **spec: object) -> EmulatedOperator:
    quick = {"viewpoints": 4, "observations_per_viewpoint": 4}
    return rig.emulate(name=name, behaviour="wander", robot=robot, seed=seed, **quick, **spec)


def run_until_driven(rig: Rig, watcher: Client, *robots: str) -> None:
    rig.run_until(lambda: all(is_driven(watcher, robot) for robot in robots), f"{robots} are driven")


def list_alarms(rig: Rig, operator: EmulatedOperator) -> list[tuple[int, str]]:
    """Return session time and kind of the alarms about a headset."""
    me = operator.client.participant_id
    return [(at, body.kind) for at, body in rig.list_events("watcher", AlignmentAlarmed) if body.participant == me]


def find_version(operator: EmulatedOperator) -> int:
    """Return the version of the alignment of a headset, 0 for none."""
    alignment = operator.client.alignment.current
    return 0 if alignment is None else alignment.version


def compute_pairs(operators: list[EmulatedOperator], point: tuple[float, float, float]) -> list[tuple[float, float]]:
    """Return for every pair of headsets how far apart they show a point, and the p95 of it as they state it [m]."""
    shown = []
    for one in operators:
        report, alignment = one.finish_report(), one.client.alignment.current
        assert report.T_true_shown is not None
        assert alignment is not None
        stated = covariance_at_point(alignment.covariance, one.spec.T_world_anchor[0], point)
        shown.append((apply(report.T_true_shown, point), np.asarray(stated)))
    return [(distance(p, q), length_p95(a + b)) for (p, a), (q, b) in itertools.combinations(shown, 2)]


def test_four_headsets_show_the_hammer_at_one_place() -> None:
    """One of them looks away from the sheet most of the time. Every pair is compared, and is as good as it states."""
    with Rig(n_arms_scene(4), timestep=TICK) as rig:
        watcher = rig.join("watcher", "director")
        operators = [emulate_driver(rig, f"op{i}", f"arm{i + 1}", 11 + i) for i in range(3)]
        away = {"gaze": AWAY, "glance_every_s": 3.0, "glance_s": 1.5}
        operators.append(rig.emulate(name="dan", behaviour="idle", robot="arm4", seed=14, **away))
        run_until_driven(rig, watcher, "arm1", "arm2", "arm3")
        ids = {one.client.participant_id for one in operators}
        pairs = {frozenset(pair) for pair in itertools.combinations(ids, 2)}

        def get_newest() -> dict[frozenset[str], HeadsetsCompared]:
            return {frozenset((c.a, c.b)): c for _, c in rig.list_events("watcher", HeadsetsCompared)}

        rig.run_until(lambda: pairs <= set(get_newest()), "all pairs of headsets were compared")
        assert all(c.n >= 5 and c.error_m <= CHANCE_FACTOR * c.expected_p95_m for c in get_newest().values())
        hammer = watcher.scene.body_pose("object1")
        assert hammer is not None
        shown = compute_pairs(operators, hammer[0])
        assert all(apart <= CHANCE_FACTOR * p95 for apart, p95 in shown)
        assert 2 * sum(apart <= p95 for apart, p95 in shown) > len(shown)
        status = watcher.status()
        assert {frozenset((c.a, c.b)) for c in status.cross_checks} >= pairs
        for report in (p.alignment_report for p in status.participants if p.id in ids):
            assert report is not None
            assert report.observations > 0
            assert 0.0 < report.error_at_anchor_m < report.error_at_robot_m + 1e-9
        for one in operators[:2]:  # both put a fingertip on one point of the table
            T_tracking_finger = one.headset.track((hammer[0], (1.0, 0.0, 0.0, 0.0)), rig.simulation.now_ns)
            one.client.alignment.observe("cross", T_tracking_finger, kind="point", device="hand/right")
        rig.run(12.0)
        touched = [c for _, c in rig.list_events("watcher", HeadsetsCompared) if c.touched]
        assert len(touched) == 1, "the sheet is compared every five seconds, the touches once"
        assert {touched[0].a, touched[0].b} == {one.client.participant_id for one in operators[:2]}
        assert touched[0].error_m <= CHANCE_FACTOR * touched[0].expected_p95_m
        assert [c.error_m for c in watcher.status().cross_checks if c.touched] == [touched[0].error_m]


def test_bump_raises_an_alarm_and_the_robot_holds_until_aligned_again() -> None:
    with Rig(timestep=TICK) as rig:
        watcher = rig.join("watcher", "observer")
        tips = Tips(watcher, "left")
        bob = emulate_driver(rig, "bob", "left", 12, bump_m=(0.05, 0.0, 0.0))
        run_until_driven(rig, watcher, "left")
        rig.run(1.0)
        version, bumped_ns = find_version(bob), rig.session.clock()
        bob.disturb_tracking("bump", rig.simulation.now_ns)
        rig.run_until(lambda: list_alarms(rig, bob), "an alarm about bob", 3.0)
        at, kind = list_alarms(rig, bob)[0]
        assert kind == AlarmKind.JUMP
        assert at - bumped_ns < 2 * SECOND
        rig.run(0.15)
        assert bob.client.alignment.current is None, "it is void"
        assert not is_driven(watcher, "left"), "a void alignment must not move a robot"
        run_until_driven(rig, watcher, "left")
        assert find_version(bob) > version
        assert bob.finish_report().alignment_error_mm < 10.0
        tips.check_speed()
        tips.check_rest()


def test_recentring_in_motion_does_not_move_the_robot() -> None:
    """The tracking frame jumps by metres while the clutch is closed: hold, realign, clutch again; never a jump."""
    with Rig(timestep=TICK) as rig:
        watcher = rig.join("watcher", "observer")
        tips = Tips(watcher, "left")
        ann = emulate_driver(rig, "ann", "left", 13)
        run_until_driven(rig, watcher, "left")
        rig.run(1.0)
        before = ann.client.alignment.current
        assert before is not None
        ann.disturb_tracking("recentre", rig.simulation.now_ns)
        rig.run(0.05)
        assert ann.client.alignment.current is None
        rig.run(0.15)
        assert not is_driven(watcher, "left")
        run_until_driven(rig, watcher, "left")
        after = ann.client.alignment.current
        assert after is not None
        assert after.tracking_epoch == before.tracking_epoch + 1
        assert distance(after.T_world_tracking.p, before.T_world_tracking.p) > 0.2
        assert ann.finish_report().alignment_error_mm < 10.0
        tips.check_speed()
        tips.check_rest()


def test_drift_raises_an_alarm_until_it_is_measured_again() -> None:
    """More than 5 mm in the five seconds between reference and present is an alarm; slower drifts are followed."""
    with Rig(timestep=TICK) as rig:
        watcher = rig.join("watcher", "director")
        ann = emulate_driver(rig, "ann", "left", 11, model=STEADY, drift_m_per_min=0.08)
        run_until_driven(rig, watcher, "left")
        rig.run(6.0)
        assert list_alarms(rig, ann) == [], "without drift"
        began_ns = rig.session.clock()
        ann.disturb_tracking("drift", rig.simulation.now_ns)
        rig.run_until(lambda: list_alarms(rig, ann), "an alarm about ann")
        at, kind = list_alarms(rig, ann)[0]
        assert kind == AlarmKind.CHANGED
        assert 3.75 < (at - began_ns) / SECOND < 7.5, "it has drifted by 5 to 10 mm"
        ann.disturb_tracking("steady", rig.simulation.now_ns)
        version = find_version(ann)
        watcher.alignment.start_run(ann.client.participant_id)
        rig.run_until(lambda: find_version(ann) > version, "ann is aligned again")
        run_until_driven(rig, watcher, "left")
        rig.run(1.0)
        assert ann.finish_report().alignment_error_mm < 10.0


def test_an_afternoon_at_one_table() -> None:
    """The sheet is bumped between alignments, one headset has a slow source, one sees a wrong print, and then half an
    hour passes. Everybody is told, nothing moves by itself, and a glance mends it.
    """
    with Rig(n_arms_scene(4, 0), timestep=TICK, state_hz=10) as rig:
        watcher = rig.join("watcher", "director")
        tips = [Tips(watcher, f"arm{i}") for i in range(1, 5)]
        table = Afternoon(rig, watcher)
        ann = table.seat("ann", "arm1", gaze=AWAY, behaviour="wander")
        cid = table.seat("cid", "arm2", gaze=AWAY, detection_hz=1.0, viewpoints=1, observations_per_viewpoint=6)
        table.run_until_working(ann, cid)
        run_until_driven(rig, watcher, "arm1")
        table.forget()

        table.bump_sheet(0.05)
        bob, eve = table.seat("bob", "arm3"), table.seat("eve", "arm4", near_share=0.02, viewpoints=3)
        table.run_until_working(bob, eve)
        told = table.count_warnings()
        assert told["eve"] > 0, "two percent"
        assert told["ann"] == told["cid"] == 1
        assert table.list_doubts() == {"ann": AlignmentDoubt.UNVERIFIED, "cid": AlignmentDoubt.UNVERIFIED}
        assert {who for who, _ in table.list_unverified()} == {"ann", "cid"}
        table.run_until_held(ann)
        eve.headset.model = msgspec.structs.replace(eve.headset.model, near_share=0.0)  # she prints it again
        eve.glance()
        table.glance_until_confident()
        (seen,) = [b for _, b in rig.list_events("watcher", AlignmentAlarmed) if b.witnesses]
        assert (seen.participant, seen.witnesses) == (cid.client.participant_id, (ann.client.participant_id,))
        assert table.count_warnings()[""] == 1, "the sheet was moved, not they"
        table.check_errors()
        run_until_driven(rig, watcher, "arm1")
        table.forget()

        table.pass_time(1800.0)
        table.run_until_held(ann)
        assert table.list_doubts() == dict.fromkeys(("ann", "bob", "cid", "eve"), AlignmentDoubt.AGED)
        rig.run_until(lambda: len(table.count_warnings()) == 4, "all are told, after a reconnection too", 5.0)
        table.glance_until_confident()
        table.check_errors()
        run_until_driven(rig, watcher, "arm1")
        for one in tips:
            one.check_rest()
