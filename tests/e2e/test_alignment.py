"""Live alignment of four headsets at one table while one drifts, one is bumped and one recentres.

The emulator knows the true poses of its headsets, so the tests know where each of them shows the hammer in the true
world.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import pytest

from anchors.pose import PoseTuple, distance
from iris_session.client import Client
from iris_session.control import ControlConfig
from iris_session.demo.scenes import n_arms_scene
from iris_session.emulator.headset import HeadsetModel
from iris_session.emulator.specs import HeadsetSpec
from iris_session.protocol.names import AlarmKind, HoldReason, RejectReason
from iris_session.protocol.server_messages import AlignmentAlarmed, HeadsetsCompared, Notice, SamplesRejected
from tests.e2e.emulated_headsets import (
    CHANCE_FACTOR,
    EmulatedHeadset,
    are_consistent,
    compute_differences,
    compute_shown_points,
)
from tests.e2e.scenario import Hand, Scenario
from tests.e2e.session_process import DEADLINE_S, SessionProcess, run_in_process

pytestmark = pytest.mark.e2e

SECOND: Final = 1_000_000_000
ARMS: Final = 6
STEADY: Final = HeadsetModel(drift_m_per_min=0.0, drift_rad_per_min=0.0)
#: `ann` drifts on command, `bob` and `cay` drive when they are disturbed, `dan` holds a robot without driving and looks
#: away from the sheet.
HEADSETS: Final = (
    HeadsetSpec(name="ann", behaviour="wander", robot="arm1", seed=11, model=STEADY, drift_m_per_min=0.08),
    HeadsetSpec(name="bob", behaviour="wander", robot="arm2", seed=12, bump_m=(0.05, 0.0, 0.0)),
    HeadsetSpec(name="cay", behaviour="wander", robot="arm3", seed=13),
    HeadsetSpec(
        name="dan", behaviour="idle", robot="arm4", seed=14, gaze=(3.0, -0.9, 0.5), glance_every_s=3.0, glance_s=1.5
    ),
)
#: A released robot decelerates for so long.
STOPPING_NS: Final = SECOND
#: A state tells of the samples applied so shortly before it.
DRIVEN_NS: Final = 100_000_000
#: Bound of the speed of a tip [m/s], also of one whose hand was bumped with the clutch closed.
MAX_TIP_SPEED: Final = ControlConfig().tip_speed


class TipSample(NamedTuple):
    """A tip at a session time and simulated time (a busy machine runs late and catches up); `driven`: by samples."""

    session_ns: int
    sim_s: float
    tip: PoseTuple
    driven: bool


class AlignmentScenario:
    """A session with emulated headsets and a director that records every tip, and whether it was driven."""

    def __init__(self, folder: Path, server: SessionProcess, specs: Sequence[HeadsetSpec]) -> None:
        self.scenario = Scenario(server)
        self.watcher = self.scenario.join("watcher", "director")
        self.headsets = {spec.name: EmulatedHeadset(folder, server.address, spec) for spec in specs}
        self.tips: dict[str, list[TipSample]] = {f"arm{i + 1}": [] for i in range(ARMS)}

    def run_until(self, condition: Callable[[], object], what: str, timeout_s: float = 2 * DEADLINE_S) -> None:
        def record_and_check() -> bool:
            self._record_tips()
            for headset in self.headsets.values():
                assert not headset.report.failed, headset.report
            return bool(condition())

        self.scenario.run_until(record_and_check, what, timeout_s)

    @property
    def now_ns(self) -> int:
        return 0 if self.watcher.scene.state is None else self.watcher.scene.state.header.session_time

    def _record_tips(self) -> None:
        state = self.watcher.scene.state
        if state is None or (self.tips["arm1"][-1:] and self.tips["arm1"][-1][0] == state.header.session_time):
            return
        now = state.header.session_time
        driven = {a.robot for a in state.header.applied if now - a.step_ns < DRIVEN_NS}
        for robot, seen in self.tips.items():
            tip = self.watcher.scene.tip_pose(robot)
            if tip is not None:
                seen.append(TipSample(now, state.header.sim_time, tip, robot in driven))

    def measure_pauses_ns(self, begin_ns: int, end_ns: int) -> int:
        """Return how long no state came between two session times: a busy machine stands still now and then."""
        times = [begin_ns, *(s.session_ns for s in self.tips["arm1"] if begin_ns < s.session_ns < end_ns), end_ns]
        return sum(b - a for a, b in itertools.pairwise(times) if b - a > DRIVEN_NS)

    def are_driven(self, *robots: str) -> bool:
        return all(self.tips[robot] and self.tips[robot][-1].driven for robot in robots)

    def has_consensus(self) -> bool:
        """Return whether all headsets show the hammer at the same place, within their stated errors."""
        hammer = self.watcher.scene.body_pose("object1")
        points = None if hammer is None else compute_shown_points([*self.headsets.values()], self.watcher, hammer[0])
        return points is not None and are_consistent(compute_differences(points))

    def list_alarms(self, name: str, since_ns: int) -> list[tuple[str, int]]:
        """Return (kind, session time) of the alarms about a headset."""
        me = self.headsets[name].report.participant
        bodies = [(e.body, e.session_time) for e in self.scenario.events["watcher"]]
        return [
            (body.kind, at)
            for body, at in bodies
            if isinstance(body, AlignmentAlarmed) and body.participant == me and at >= since_ns
        ]

    def list_cross_checks(self, since_ns: int) -> list[HeadsetsCompared]:
        events = self.scenario.events["watcher"]
        return [e.body for e in events if isinstance(e.body, HeadsetsCompared) and e.session_time >= since_ns]

    def has_realigned(self, name: str, since_version: int) -> bool:
        alignment = self.watcher.mirror.find_alignment(self.headsets[name].report.participant)
        return alignment is not None and alignment.version > since_version

    def close_headsets(self) -> None:
        for headset in self.headsets.values():
            headset.close()

    def close(self) -> None:
        self.close_headsets()
        self.scenario.close()


@pytest.fixture
def start_table(serve: Callable[..., SessionProcess], tmp_path: Path) -> Iterator[Callable[..., AlignmentScenario]]:
    """Start a session of six arms with some headsets."""
    scene = tmp_path / "six.xml"
    spec = n_arms_scene(ARMS)
    spec.compile()
    scene.write_text(spec.to_xml())
    tables: list[AlignmentScenario] = []

    def make(*headsets: HeadsetSpec) -> AlignmentScenario:
        tables.append(AlignmentScenario(tmp_path, serve(str(scene)), headsets))
        return tables[-1]

    yield make
    for table in tables:
        table.close()


@pytest.mark.long
def test_four_headsets_stay_aligned_through_bump_recentring_and_drift(
    start_table: Callable[..., AlignmentScenario],
) -> None:
    table = start_table(*HEADSETS)
    table.run_until(lambda: table.are_driven("arm1", "arm2", "arm3"), "three operators drive")
    table.run_until(lambda: table.headsets["dan"].report.phase == "work", "dan holds a robot")
    table.run_until(table.has_consensus, "four headsets show the hammer at one place")
    check_cross_checks(table, 0)

    began_ns = table.now_ns
    table.headsets["ann"].disturb("drift")
    check_bump(table)
    check_recentring(table)
    check_drift(table)

    table.run_until(table.has_consensus, "they show the hammer at one place again")
    check_cross_checks(table, table.now_ns)
    check_undriven_robots_rest(table)
    tips = [sample.tip[0] for sample in table.tips["arm4"] if sample.session_ns >= began_ns]
    assert max(distance(p, tips[0]) for p in tips) < 1e-3, "dan did not drive"
    table.close_headsets()
    table.scenario.server.finish()


@pytest.mark.long
def test_unaligned_headset_gets_a_notice_and_moves_nothing(start_table: Callable[..., AlignmentScenario]) -> None:
    """A policy and a desktop operator need no alignment."""
    table = start_table(HEADSETS[0])
    table.run_until(lambda: table.are_driven("arm1"), "ann drives")
    scenario = table.scenario
    eve = Client(
        scenario.server.address,
        role="operator",
        name="eve",
        devices=("head", "controller/right"),
        alignment="measured",
        on_event=scenario.events.setdefault("eve", []).append,
    )
    scenario.clients.append(eve)
    eve.connect(DEADLINE_S)
    eve.acquire(["arm5"])
    scenario.run_until(lambda: eve.scene.tip_pose("arm5") is not None, "eve sees arm5")
    before = eve.scene.tip_pose("arm5")
    assert before is not None
    hand = scenario.add_hand(eve, "arm5")
    hand.device = "controller/right"
    hand.velocity = (0.1, 0.0, 0.0)
    me = eve.participant_id

    def list_own(kind: type) -> list[Any]:
        return [e.body for e in scenario.events["eve"] if isinstance(e.body, kind) and e.body.participant == me]

    def is_rejected() -> bool:
        hand.clutch = not hand.clutch  # like an operator that tries again and again
        feedback = eve.feedback.get("arm5")
        held = feedback is not None and feedback.hold_reason == HoldReason.UNALIGNED
        return held and any(b.reason == RejectReason.UNALIGNED for b in list_own(SamplesRejected))

    table.run_until(is_rejected, "eve's samples are rejected")
    table.run_until(lambda: list_own(Notice), "eve gets a notice")
    scenario.run_for(1.0)
    after = eve.scene.tip_pose("arm5")
    assert after is not None
    assert distance(before[0], after[0]) < 5e-4
    hand.sending = False
    eve.release("arm5")
    for name, role in (("policy", "agent"), ("desktop", "operator")):
        check_moving(table, scenario.join(name, role), "arm5")
    ann = table.headsets["ann"].report
    table.close_headsets()
    scenario.server.finish()
    check_offline_solution(scenario.server.recording, ann.participant)


def check_offline_solution(recording: Path, participant: str) -> None:
    """Check that `anchors solve` finds the owners of observations, and solves the same alignment again."""
    code, out, errors = run_in_process("anchors", "solve", "--json", str(recording))
    assert code == 0, errors
    solved = json.loads(out)
    assert (solved["unowned"], solved["unreadable"], solved["damage"]) == (0, 0, [])
    (frame,) = next(p for p in solved["participants"] if p["id"] == participant)["frames"]
    assert frame["looks"] >= 5
    assert not frame["refused"], frame
    assert frame["alignments"]
    assert all(a["solved_m"] is not None and a["off_m"] < 0.02 for a in frame["alignments"])


def check_moving(table: AlignmentScenario, client: Client, robot: str) -> None:
    """Move a robot by 3 cm and release it."""
    client.acquire([robot])
    hand: Hand = table.scenario.add_hand(client, robot)
    table.scenario.engage(hand)
    before = hand.tip

    def has_moved() -> bool:
        table.scenario.keep_engaged(hand)
        hand.velocity = (0.0, 0.0, 0.1)
        return hand.tip[0][2] - before[0][2] > 0.03

    table.run_until(has_moved, f"{robot} follows {client.name}")
    table.scenario.hands.remove(hand)
    client.release(robot)


def check_cross_checks(table: AlignmentScenario, since_ns: int) -> None:
    """Wait until every pair was compared and is as good as it states; the status must show the same."""
    ids = {headset.report.participant for headset in table.headsets.values()}
    pairs = {frozenset(pair) for pair in itertools.combinations(ids, 2)}

    def get_newest() -> dict[frozenset[str], HeadsetsCompared]:
        return {frozenset((c.a, c.b)): c for c in table.list_cross_checks(since_ns)}

    def are_as_stated() -> bool:
        got = get_newest()
        return pairs <= set(got) and all(got[p].error_m <= CHANCE_FACTOR * got[p].expected_p95_m for p in pairs)

    table.run_until(are_as_stated, "all pairs of headsets were compared, and are as good as they state")
    assert all(c.n >= 5 and c.expected_p95_m > 0.0 for c in get_newest().values())
    status = table.watcher.status(DEADLINE_S)
    assert {frozenset((c.a, c.b)) for c in status.cross_checks} >= pairs
    assert [anchor.anchor_id for anchor in status.anchors] == ["table"]
    reports = {p.name: p.alignment_report for p in status.participants}
    for name in table.headsets:
        report = reports[name]
        assert report is not None
        assert report.version > 0
        assert report.observations > 0
        assert 0.0 < report.error_at_anchor_m < report.error_at_robot_m + 1e-9


def check_bump(table: AlignmentScenario) -> None:
    """A bump raises an alarm within two seconds; the robot holds until bob has observed the sheet again."""
    bob = table.headsets["bob"]
    version = bob.report.alignment_version
    table.run_until(lambda: table.are_driven("arm2"), "bob drives")
    bob.disturb("bump")
    table.run_until(lambda: bob.get_disturbed_ns("bump") > 0, "bob is bumped")
    at = bob.get_disturbed_ns("bump")
    table.run_until(lambda: table.list_alarms("bob", at), "an alarm about bob")
    kind, alarm_ns = table.list_alarms("bob", at)[0]
    assert kind == AlarmKind.JUMP
    assert alarm_ns - at - table.measure_pauses_ns(at, alarm_ns) < 2 * SECOND
    table.run_until(lambda: table.has_realigned("bob", version), "bob is aligned again")
    table.run_until(lambda: table.are_driven("arm2"), "bob drives again")
    later = [sample.driven for sample in table.tips["arm2"] if sample.session_ns > alarm_ns + STOPPING_NS]
    assert not later[0], "a void alignment must not move a robot"


def check_recentring(table: AlignmentScenario) -> None:
    cay = table.headsets["cay"]
    version = cay.report.alignment_version
    table.run_until(lambda: table.are_driven("arm3"), "cay drives")
    cay.disturb("recentre")
    table.run_until(lambda: cay.get_disturbed_ns("recentre") > 0, "cay recentres")
    table.run_until(lambda: table.has_realigned("cay", version), "cay is aligned again")
    table.run_until(lambda: table.are_driven("arm3"), "cay drives again")


def check_drift(table: AlignmentScenario) -> None:
    """A drift of more than 5 mm in the five seconds between reference and present raises an alarm; slower ones are
    followed. After it the headset is measured again."""
    ann = table.headsets["ann"]
    since = ann.get_disturbed_ns("drift")
    assert since > 0
    table.run_until(lambda: table.list_alarms("ann", since), "an alarm about ann")
    assert {kind for kind, _ in table.list_alarms("ann", since)} <= {AlarmKind.DIFFERS, AlarmKind.CHANGED}
    ann.disturb("steady")
    table.run_until(lambda: ann.get_disturbed_ns("steady") > 0, "the drift of ann ends")
    version = ann.report.alignment_version
    table.watcher.alignment.start_run(ann.report.participant)
    table.run_until(lambda: table.has_realigned("ann", version), "ann is aligned again")
    table.run_until(lambda: table.are_driven("arm1"), "ann drives again")


def split_by_driven(samples: Sequence[TipSample]) -> list[tuple[bool, list[TipSample]]]:
    """Return the parts in which a robot was driven, or was not. Whether it was is not known of a time without state."""
    parts: list[tuple[bool, list[TipSample]]] = []
    before_ns = 0
    for sample in samples:
        if not parts or parts[-1][0] != sample.driven or sample.session_ns - before_ns > DRIVEN_NS:
            parts.append((sample.driven, []))
        parts[-1][1].append(sample)
        before_ns = sample.session_ns
    return parts


def check_undriven_robots_rest(table: AlignmentScenario) -> None:
    """Check that tips of robots that were not driven stayed within a millimetre, and that no tip ever jumped."""
    for robot, samples in table.tips.items():
        for a, b in itertools.pairwise(samples):
            assert distance(a.tip[0], b.tip[0]) <= MAX_TIP_SPEED * max(b.sim_s - a.sim_s, 0.017) + 1e-3, (robot, a, b)
        for driven, held in split_by_driven(samples):
            rested_ns = held[0].session_ns + STOPPING_NS
            resting = [] if driven else [sample.tip[0] for sample in held if sample.session_ns > rested_ns]
            assert all(distance(p, resting[0]) < 1e-3 for p in resting), robot
