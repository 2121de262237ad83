"""Four headsets at one table while one drifts, one is bumped and one recentres: what everybody sees, and what moves.

The emulator knows where its headsets truly are, so it can be said where each of them shows the hammer in the
true world.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import pytest

from anchors.pose import PoseTuple, distance
from iris_session.client import Client
from iris_session.control import ControlConfig
from iris_session.demo.scenes import n_arms_scene
from iris_session.emulator.headset import HeadsetModel
from iris_session.emulator.specs import HeadsetSpec
from iris_session.protocol.names import AlarmKind, HoldReason, RejectReason
from iris_session.protocol.server_messages import AlignmentAlarmed, HeadsetsCompared, Notice, SamplesRejected
from tests.e2e.conftest import DEADLINE_S, Hand, Server, Stage, here
from tests.e2e.crew import BEYOND_CHANCE, Emulated, agree, differences, views

pytestmark = pytest.mark.e2e

SECOND: Final = 1_000_000_000
ARMS: Final = 6
STEADY: Final = HeadsetModel(drift_m_per_min=0.0, drift_rad_per_min=0.0)
#: `ann` begins to drift on order, `bob` and `cay` work when they are disturbed, `dan` holds a robot and works somewhere
#: else than at the sheet.
PEOPLE: Final = (
    HeadsetSpec(name="ann", behaviour="wander", robot="arm1", seed=11, model=STEADY, drift_m_per_min=0.03),
    HeadsetSpec(name="bob", behaviour="wander", robot="arm2", seed=12, bump_m=(0.05, 0.0, 0.0)),
    HeadsetSpec(name="cay", behaviour="wander", robot="arm3", seed=13),
    HeadsetSpec(
        name="dan", behaviour="idle", robot="arm4", seed=14, gaze=(3.0, -0.9, 0.5), glance_every_s=3.0, glance_s=1.5
    ),
)
#: A robot that is let go decelerates for so long.
COME_TO_REST_NS: Final = SECOND
#: Also of one whose hand was bumped with the clutch closed: it may have been a fast hand.
FASTEST_TIP: Final = ControlConfig().tip_speed


class Moment(NamedTuple):
    """Where a tip was: session time, simulated time (a busy machine runs late and catches up), and who is at it."""

    session_ns: int
    sim_s: float
    tip: PoseTuple
    driven: bool


class Table:
    """The session, people with headsets, a director who watches; where every tip was, and whether it was driven."""

    def __init__(self, folder: Path, server: Server, people: Sequence[HeadsetSpec]) -> None:
        self.stage = Stage(server)
        self.watcher = self.stage.join("watcher", "director")
        self.crew = {spec.name: Emulated(folder, server.address, spec) for spec in people}
        self.tips: dict[str, list[Moment]] = {f"arm{i + 1}": [] for i in range(ARMS)}

    def run(self, condition: Callable[[], object], what: str, timeout_s: float = 2 * DEADLINE_S) -> None:
        def watched() -> bool:
            self._note_tips()
            for person in self.crew.values():
                assert not person.report.failed, person.report
            return bool(condition())

        self.stage.run(watched, what, timeout_s)

    @property
    def now_ns(self) -> int:
        return 0 if self.watcher.scene.state is None else self.watcher.scene.state.header.session_time

    def _note_tips(self) -> None:
        state = self.watcher.scene.state
        if state is None or (self.tips["arm1"][-1:] and self.tips["arm1"][-1][0] == state.header.session_time):
            return
        now = state.header.session_time
        driven = {a.robot for a in state.header.applied if now - a.step_ns < 100_000_000}
        for robot, seen in self.tips.items():
            tip = self.watcher.scene.tip_pose(robot)
            if tip is not None:
                seen.append(Moment(now, state.header.sim_time, tip, robot in driven))

    def driven(self, *robots: str) -> bool:
        return all(self.tips[robot] and self.tips[robot][-1].driven for robot in robots)

    def agreed(self) -> bool:
        """Whether everybody sees the hammer at the same place, within what they state."""
        hammer = self.watcher.scene.body_pose("object1")
        seen = None if hammer is None else views(list(self.crew.values()), self.watcher, hammer[0])
        return seen is not None and agree(differences(seen))

    def alarms(self, name: str, since_ns: int) -> list[tuple[str, int]]:
        """(kind, session time) of the alarms about somebody."""
        me = self.crew[name].report.participant
        bodies = [(e.body, e.session_time) for e in self.stage.events["watcher"]]
        return [
            (body.kind, at)
            for body, at in bodies
            if isinstance(body, AlignmentAlarmed) and body.participant == me and at >= since_ns
        ]

    def comparisons(self, since_ns: int) -> list[HeadsetsCompared]:
        events = self.stage.events["watcher"]
        return [e.body for e in events if isinstance(e.body, HeadsetsCompared) and e.session_time >= since_ns]

    def aligned_anew(self, name: str, since_version: int) -> bool:
        person = self.crew[name].report
        alignment = self.watcher.mirror.find_alignment(person.participant)
        return alignment is not None and alignment.version > since_version

    def close(self) -> None:
        for person in self.crew.values():
            person.close()
        self.stage.close()


@pytest.fixture
def seat(serve: Callable[..., Server], tmp_path: Path) -> Iterator[Callable[..., Table]]:
    """Makes a table with these people at it."""
    scene = tmp_path / "six.xml"
    spec = n_arms_scene(ARMS)
    spec.compile()
    scene.write_text(spec.to_xml())
    tables: list[Table] = []

    def make(*people: HeadsetSpec) -> Table:
        tables.append(Table(tmp_path, serve(str(scene)), people))
        return tables[-1]

    yield make
    for table in tables:
        table.close()


def test_four_headsets_stay_together(seat: Callable[..., Table]) -> None:
    table = seat(*PEOPLE)
    table.run(lambda: table.driven("arm1", "arm2", "arm3"), "three people drive")
    table.run(lambda: table.crew["dan"].report.phase == "work", "dan has a robot")
    table.run(table.agreed, "four headsets show the hammer at one place")
    _compared(table, 0)

    began_ns = table.now_ns
    table.crew["ann"].order("drift")
    _bumped(table)
    _recentred(table)
    _drifted(table)

    table.run(table.agreed, "after all that they show the hammer at one place again")
    _compared(table, table.now_ns)
    _no_robot_moved_by_itself(table)
    dans = [moment.tip[0] for moment in table.tips["arm4"] if moment.session_ns >= began_ns]
    assert max(distance(p, dans[0]) for p in dans) < 1e-3, "nobody drove it, whatever happened to the others"
    for person in table.crew.values():
        person.close()
    table.stage.server.finish()


def test_who_saw_no_sheet_is_told_and_moves_nothing(seat: Callable[..., Table]) -> None:
    """A policy and somebody at a desk need no sheet."""
    table = seat(PEOPLE[0])
    table.run(lambda: table.driven("arm1"), "ann drives")
    stage = table.stage
    eve = Client(
        stage.server.address,
        role="operator",
        name="eve",
        devices=("head", "controller/right"),
        alignment="measured",
        on_event=stage.events.setdefault("eve", []).append,
    )
    stage.clients.append(eve)
    eve.connect(DEADLINE_S)
    eve.acquire(["arm5"])
    before = eve.scene.tip_pose("arm5")
    assert before is not None
    hand = stage.hand(eve, "arm5")
    hand.velocity = (0.1, 0.0, 0.0)
    me = eve.participant_id

    def told(kind: type, **fields: str) -> bool:
        bodies = [e.body for e in stage.events["eve"] if isinstance(e.body, kind) and e.body.participant == me]
        return any(all(text in getattr(body, name) for name, text in fields.items()) for body in bodies)

    def refused() -> bool:
        hand.clutch = not hand.clutch  # as somebody who tries again and again
        feedback = eve.feedback.get("arm5")
        held = feedback is not None and feedback.hold_reason == HoldReason.UNALIGNED
        return held and told(SamplesRejected, reason=RejectReason.UNALIGNED)

    table.run(refused, "eve's samples do not count")
    table.run(lambda: told(Notice, text="look at"), "eve is told what to do")
    stage.seconds(1.0)
    after = eve.scene.tip_pose("arm5")
    assert after is not None
    assert distance(before[0], after[0]) < 5e-4
    hand.sending = False
    eve.release("arm5")
    for name, role in (("policy", "agent"), ("desk", "operator")):
        _moves(table, stage.join(name, role), "arm5")
    ann = table.crew["ann"].report
    for person in table.crew.values():
        person.close()
    stage.server.finish()
    _solved_again(stage.server.recording, ann.participant)


def _solved_again(recording: Path, participant: str) -> None:
    """`anchors solve` finds whose looks they were, and the alignment of then as it was."""
    code, out, errors = here("anchors", "solve", "--json", str(recording))
    assert code == 0, errors
    solved = json.loads(out)
    assert (solved["unowned"], solved["unreadable"], solved["damage"]) == (0, 0, [])
    (person,) = (one for one in solved["participants"] if one["id"] == participant)
    (frame,) = person["frames"]
    assert frame["looks"] >= 5
    assert not frame["refused"], frame
    assert frame["alignments"]
    assert all(one["solved_m"] is not None and one["off_m"] < 0.02 for one in frame["alignments"])


def _moves(table: Table, client: Client, robot: str) -> None:
    """Whoever this is moves the robot by 3 cm and lets go of it."""
    client.acquire([robot])
    hand: Hand = table.stage.hand(client, robot)
    table.stage.engage(hand)
    before = hand.tip
    hand.velocity = (0.0, 0.0, 0.1)
    table.run(lambda: hand.tip[0][2] - before[0][2] > 0.03, f"{robot} follows {client.name}")
    table.stage.hands.remove(hand)
    client.release(robot)


def _compared(table: Table, since_ns: int) -> None:
    """Every pair was measured against each other, and is as good as it states; status shows the same."""
    people = {person.report.participant for person in table.crew.values()}
    pairs = {frozenset(pair) for pair in itertools.combinations(people, 2)}

    def newest() -> dict[frozenset[str], HeadsetsCompared]:
        return {frozenset((c.a, c.b)): c for c in table.comparisons(since_ns)}

    def well() -> bool:
        got = newest()
        return pairs <= set(got) and all(got[p].error_m <= BEYOND_CHANCE * got[p].expected_p95_m for p in pairs)

    table.run(well, "all pairs of headsets were compared, and are as good as they state")
    assert all(c.n >= 5 and c.expected_p95_m > 0.0 for c in newest().values())
    status = table.watcher.status(DEADLINE_S)
    assert {frozenset((c.a, c.b)) for c in status.cross_checks} >= pairs
    assert [anchor.anchor_id for anchor in status.anchors] == ["table"]
    reports = {p.name: p.alignment_report for p in status.participants}
    for name in table.crew:
        report = reports[name]
        assert report is not None
        assert report.version > 0
        assert report.observations > 0
        assert 0.0 < report.error_at_anchor_m < report.error_at_robot_m + 1e-9


def _bumped(table: Table) -> None:
    """The alarm comes within two seconds, the robot holds until bob has looked again, and then he goes on."""
    bob = table.crew["bob"]
    version = bob.report.alignment_version
    table.run(lambda: table.driven("arm2"), "bob drives")
    bob.order("bump")
    table.run(lambda: bob.disturbed_ns("bump") > 0, "bob is bumped")
    at = bob.disturbed_ns("bump")
    table.run(lambda: table.alarms("bob", at), "an alarm about bob")
    kind, alarm_ns = table.alarms("bob", at)[0]
    assert kind == AlarmKind.JUMP
    assert alarm_ns - at < 2 * SECOND
    table.run(lambda: table.aligned_anew("bob", version), "bob has looked at the sheet again")
    table.run(lambda: table.driven("arm2"), "bob drives again")
    later = [moment.driven for moment in table.tips["arm2"] if moment.session_ns > alarm_ns + COME_TO_REST_NS]
    assert not later[0], "an alignment that is void moves no robot"


def _recentred(table: Table) -> None:
    cay = table.crew["cay"]
    version = cay.report.alignment_version
    table.run(lambda: table.driven("arm3"), "cay drives")
    cay.order("recentre")
    table.run(lambda: cay.disturbed_ns("recentre") > 0, "cay recentres")
    table.run(lambda: table.aligned_anew("cay", version), "cay has looked at the sheet again")
    table.run(lambda: table.driven("arm3"), "cay drives again")


def _drifted(table: Table) -> None:
    """Ann drifts ten times as fast as headsets should: that is told. When it is over she is measured anew."""
    ann = table.crew["ann"]
    since = ann.disturbed_ns("drift")
    assert since > 0
    table.run(lambda: table.alarms("ann", since), "an alarm about ann")
    assert {kind for kind, _ in table.alarms("ann", since)} <= {AlarmKind.DIFFERS, AlarmKind.CHANGED}
    ann.order("steady")
    table.run(lambda: ann.disturbed_ns("steady") > 0, "ann drifts no more")
    version = ann.report.alignment_version
    table.watcher.align("start", ann.report.participant)
    table.run(lambda: table.aligned_anew("ann", version), "ann has looked at the sheet again")
    table.run(lambda: table.driven("arm1"), "ann drives again")


def _no_robot_moved_by_itself(table: Table) -> None:
    """While nobody drove a robot its tip stayed within a millimetre, and no tip ever jumped."""
    for robot, seen in table.tips.items():
        for a, b in itertools.pairwise(seen):
            assert distance(a.tip[0], b.tip[0]) <= FASTEST_TIP * max(b.sim_s - a.sim_s, 0.017) + 1e-3, (robot, a, b)
        for driven, stretch in itertools.groupby(seen, key=lambda moment: moment.driven):
            held = list(stretch)
            rested_ns = held[0].session_ns + COME_TO_REST_NS
            resting = [] if driven else [moment.tip[0] for moment in held if moment.session_ns > rested_ns]
            assert all(distance(p, resting[0]) < 1e-3 for p in resting), robot
