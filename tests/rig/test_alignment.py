"""Live alignment of headsets at one table while one is bumped, one recentres and one drifts.

The emulator knows the true poses of its headsets, so the tests know where each of them shows the hammer in the true
world.
"""

from __future__ import annotations

import itertools
from typing import Final

import numpy as np

from anchors.ageing import AgeingLaw
from anchors.pose import PoseTuple, apply, distance
from anchors.uncertainty import covariance_at_point, length_p95
from iris_session.authority import AuthorityConfig
from iris_session.client import Client
from iris_session.control import ControlConfig
from iris_session.demo.scenes import n_arms_scene
from iris_session.emulator.headset import HeadsetModel
from iris_session.emulator.operator import EmulatedOperator
from iris_session.protocol.names import AlarmKind, HoldReason, RejectReason
from iris_session.protocol.server_messages import AlignmentAlarmed, HeadsetsCompared, Notice, SamplesRejected
from tests.rig.session import Rig, is_driven

SECOND = 1_000_000_000
TICK = 0.02  # [s]
STEADY: Final = HeadsetModel(drift_m_per_min=0.0, drift_rad_per_min=0.0)
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
        client.on_state = lambda state: self._seen.append(
            (state.header.sim_time, client.scene.tip_pose(robot), is_driven(client, robot))  # type: ignore[arg-type]
        )

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
        away = {"gaze": (3.0, -0.9, 0.5), "glance_every_s": 3.0, "glance_s": 1.5}
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


def test_half_an_hour_without_a_look_holds_until_a_glance() -> None:
    """With drift and law sixty times as fast: 1 mm a minute, and a minute is a second."""
    usual = AgeingLaw()
    law = AgeingLaw(60.0 * usual.drift_m_per_min, 60.0 * usual.yaw_rad_per_min)
    with Rig(timestep=TICK, authority=AuthorityConfig(ageing=law, age_check_ns=SECOND // 60)) as rig:
        watcher = rig.join("watcher", "director")
        ann = emulate_driver(rig, "ann", "left", 11, model=STEADY, drift_m_per_min=0.06)
        run_until_driven(rig, watcher, "left")
        watcher.alignment.stop_run(ann.client.participant_id)
        ann.disturb_tracking("drift", rig.simulation.now_ns)
        hold = lambda: ann.client.feedback["left"].hold_reason  # noqa: E731
        rig.run_until(lambda: hold() == HoldReason.UNCONFIRMED, "ann is to glance")
        rig.run(20.0)
        assert not is_driven(watcher, "left")
        told = [b for _, b in rig.list_events("watcher", Notice) if b.level == "warning" and "glance" in b.text]
        assert [body.participant for body in told] == [ann.client.participant_id]
        ann.disturb_tracking("steady", rig.simulation.now_ns)
        version = find_version(ann)
        watcher.alignment.start_run(ann.client.participant_id)
        rig.run_until(lambda: find_version(ann) > version, "ann has glanced")
        run_until_driven(rig, watcher, "left")
        rig.run(1.0)
        alignment = ann.client.alignment.current
        assert alignment is not None
        assert ann.finish_report().alignment_error_mm < 1e3 * alignment.error_at_anchor_m


def test_unaligned_headset_gets_a_notice_and_moves_nothing() -> None:
    """A policy and an operator at a screen need no alignment."""
    with Rig(timestep=TICK) as rig:
        eve = rig.join("eve", devices=("head", "controller/right"), alignment="measured")
        hand = rig.add_hand(eve, "left", "controller/right")
        eve.acquire(["left"])
        before, me = hand.tip, eve.participant_id
        hand.velocity = (0.1, 0.0, 0.0)
        for _ in range(5):  # like an operator that tries again and again
            hand.clutch = not hand.clutch
            rig.run(0.2)
        assert eve.feedback["left"].hold_reason == HoldReason.UNALIGNED
        assert {(b.participant, b.reason) for _, b in rig.list_events("eve", SamplesRejected)} == {
            (me, RejectReason.UNALIGNED)
        }
        assert me in {body.participant for _, body in rig.list_events("eve", Notice)}
        assert distance(before[0], hand.tip[0]) < 1e-4
        hand.sending = False
        eve.release("left")
        for name, role in (("policy", "agent"), ("desktop", "operator")):
            client = rig.join(name, role)
            other = rig.add_hand(client, "left")
            client.acquire(["left"])
            rig.engage(other)
            start, other.velocity = other.tip, (0.0, 0.0, 0.1)
            rig.run(0.5)
            assert 0.03 < other.tip[0][2] - start[0][2] < 0.05
            other.sending = False
            client.release("left")
