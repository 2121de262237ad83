"""How corrections come into force: at once before use, sliding when small, told when large, never while engaged."""

from __future__ import annotations

import itertools
import math
from typing import Any

import msgspec
import pytest

from anchors.pose import quat_angle, quat_from_yaw
from iris_session.authority.alignment import compute_position_p95, widen_covariance
from iris_session.protocol.client_messages import Grasp, Heartbeat, PlaceAlignment, TrackingEpoch
from iris_session.protocol.common import Alignment, Pose
from iris_session.protocol.server_messages import AlignmentChanged, Notice
from iris_session.protocol.status import AlignmentReport

from .table import MS, SECOND, SMALL, Person, Table, proposal


def at(x: float, yaw: float = 0.0) -> Any:
    """The tracking frame seen at (x, 0, 0), turned by `yaw` about the anchor."""
    c, s = math.cos(yaw), math.sin(yaw)
    p = (x * c - 0.5 * s, -0.5 + x * s + 0.5 * c, 0.0)
    return proposal(T_world_tracking=Pose(p, quat_from_yaw(yaw)))


def settled(*robots: str) -> tuple[Table, Person]:
    """Somebody who has used its alignment, and lets go."""
    t = Table()
    anna = t.operator(*robots or ("left",))
    anna.engage("left")
    anna.sends("left")
    return t, anna


def rest(t: Table, *people: Person, seconds: float = 1.0) -> list[tuple[int, Alignment]]:
    """Alignments that come into force while people only wait, with their times."""
    came = []
    for _ in range(round(seconds * 50)):
        t.step(*(p.says(Heartbeat()) for p in people), dt_ns=20 * MS)
        came += [(t.now_ns, e.alignment) for e in t.since(AlignmentChanged)]
    return came


def notices(t: Table) -> list[str]:
    return [e.text for e in t.events if isinstance(e, Notice)]


def report(t: Table, person: Person) -> AlignmentReport:
    return t.authority.build_alignment_reports()[person.id]


def test_before_use_every_better_measurement_is_in_force_at_once() -> None:
    t = Table()
    anna = t.operator()
    for x in (1.005, 1.2, 3.0):
        t.step(anna.says(at(x)))
        assert [e.alignment.T_world_tracking.p[0] for e in t.since(AlignmentChanged)] == [x]
    assert notices(t) == []


def test_after_a_while_an_alignment_is_in_use_though_nobody_engaged() -> None:
    t = Table()
    anna = t.operator()
    rest(t, anna, seconds=14.9)
    t.step(anna.says(at(1.2)))
    assert len(t.since(AlignmentChanged)) == 1
    rest(t, anna, seconds=0.2)
    t.step(anna.says(at(1.4)))
    assert t.since(AlignmentChanged) == []


def test_a_small_correction_slides_in_and_says_what_is_still_away() -> None:
    t, anna = settled()
    t.step(anna.says(at(1.006)))
    assert report(t, anna).pending_m == pytest.approx(0.006)
    came = rest(t, anna, seconds=3.0)
    assert [a.T_world_tracking.p[0] for _, a in came] == pytest.approx([1.002, 1.004, 1.006])
    assert [round((b[0] - a[0]) / MS) for a, b in itertools.pairwise(came)] == [500, 500]
    assert [a.error_at_anchor_m for _, a in came] == pytest.approx([0.006, 0.004, 0.002])
    assert came[0][1].error_at_robot_m > came[1][1].error_at_robot_m > came[2][1].error_at_robot_m
    assert came[0][1].error_at_robot_m > 0.004
    assert came[2][1].covariance == SMALL
    assert (report(t, anna).pending_m, notices(t)) == (0.0, [])


def test_a_small_turn_slides_about_the_anchor() -> None:
    t, anna = settled()
    t.step(anna.says(at(1.0, math.radians(1.0))))
    came = rest(t, anna, seconds=5.0)
    turns = [quat_angle(quat_from_yaw(0.0), a.T_world_tracking.q) for _, a in came]
    assert turns == pytest.approx([math.radians(0.15 * i) for i in range(1, 7)] + [math.radians(1.0)], rel=2e-3)


def test_what_is_still_away_widens_the_stated_error_at_any_lever_arm() -> None:
    away = (0.003, -0.002, 0.0, 0.0, 0.0, 0.02)
    for point in ((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (-1.0, 3.0, 0.5)):
        moved = math.hypot(away[0] - away[5] * point[1], away[1] + away[5] * point[0])
        assert compute_position_p95(widen_covariance(SMALL, away), (0.0, 0.0, 0.0), point) > moved


def test_a_large_correction_is_announced_and_comes_in_one_go() -> None:
    t, anna = settled()
    t.step(anna.says(at(1.05)))
    assert [(e.level, e.participant) for e in t.since(Notice)] == [("info", anna.id)]
    assert "off by 50 mm: the scene moves" in t.since(Notice)[0].text
    told_ns = t.now_ns
    ((when, alignment),) = rest(t, anna, seconds=3.0)
    assert 2 * SECOND <= when - told_ns <= 2 * SECOND + 20 * MS
    assert alignment.T_world_tracking.p[0] == 1.05
    assert len(notices(t)) == 1


def test_a_large_turn_is_large() -> None:
    t, anna = settled()
    t.step(anna.says(at(1.0, math.radians(2.1))))
    assert ["off by 2.1 degrees: the scene moves" in e.text for e in t.since(Notice)] == [True]


def test_what_was_told_is_what_comes() -> None:
    """The measurement goes on changing: a little is let through, a lot is told anew."""
    t, anna = settled()
    t.step(anna.says(at(1.05)))
    rest(t, anna, seconds=1.0)
    t.step(anna.says(at(1.055)))
    assert [a.T_world_tracking.p[0] for _, a in rest(t, anna, seconds=1.1)] == [1.055]
    t.step(anna.says(at(1.2)))
    rest(t, anna, seconds=1.0)
    t.step(anna.says(at(0.8)))
    assert rest(t, anna, seconds=2.9) == []
    assert [a.T_world_tracking.p[0] for _, a in rest(t, anna, seconds=0.2)] == [0.8]
    assert len(notices(t)) == 3


def test_wild_measurements_are_told_at_most_every_two_seconds() -> None:
    t, anna = settled()
    for i in range(50):  # 10 s at 5 Hz
        t.step(anna.says(Heartbeat()), anna.says(at(1.5 + 0.3 * (i % 2))), dt_ns=200 * MS)
    assert 1 <= len(notices(t)) <= 5


def test_while_engaged_a_correction_waits_and_is_told_once() -> None:
    t, anna = settled()
    anna.engage("left")
    for x in (1.05, 1.051, 1.054):
        t.step(anna.says(at(x)))
    for _ in range(150):
        t.step(anna.says(anna.sample("left", clutch=True)), dt_ns=20 * MS)
        assert t.since(AlignmentChanged) == []
        assert t.command().sources[0].pose_world == Pose((1.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
    assert len(notices(t)) == 1
    assert "waits until you let go" in notices(t)[0]
    assert report(t, anna).pending_m == pytest.approx(0.054)
    anna.sends("left")
    assert [e.alignment.T_world_tracking.p[0] for e in t.since(AlignmentChanged)] == [1.054]


def test_a_small_correction_that_waits_is_not_worth_a_word() -> None:
    """It slides in unseen when the clutch opens; one that says the same, but better, is off by nothing at all."""
    t, anna = settled()
    anna.engage("left")
    better = tuple(0.1 * c for c in SMALL)
    for x in (1.0, 1.006):
        t.step(anna.says(msgspec.structs.replace(at(x), covariance=better)))
        for _ in range(20):
            t.step(anna.says(anna.sample("left", clutch=True)), dt_ns=20 * MS)
    assert report(t, anna).pending_m == pytest.approx(0.006)
    assert notices(t) == []
    anna.sends("left")
    assert rest(t, anna, seconds=3.0)[-1][1].T_world_tracking.p[0] == pytest.approx(1.006)
    assert notices(t) == []


def test_letting_go_at_once_after_it_was_told_does_not_bring_it_at_once() -> None:
    t, anna = settled()
    anna.engage("left")
    t.step(anna.says(at(1.05)))
    anna.sends("left")
    assert len(rest(t, anna, seconds=1.9)) == 0
    assert len(rest(t, anna, seconds=0.2)) == 1


def test_a_hand_on_an_object_is_a_use_too() -> None:
    t = Table()
    anna = t.operator()
    anna.asks(Grasp(1, "hammer", "controller/right"))
    anna.engage("hammer")
    t.step(anna.says(at(1.005)))
    rest_of_it = [t.step(anna.says(anna.sample("hammer", clutch=True)), dt_ns=20 * MS) for _ in range(40)]
    assert not any(isinstance(e.body, AlignmentChanged) for d in rest_of_it for e in d.events)


def test_others_do_not_wait_for_those_who_are_engaged() -> None:
    t, anna = settled()
    bert = t.operator("right")
    anna.engage("left")
    t.step(bert.says(at(1.3)))
    assert [e.participant for e in t.since(AlignmentChanged)] == [bert.id]


def test_after_a_pause_it_goes_on_sliding_and_does_not_leap() -> None:
    t, anna = settled()
    t.step(anna.says(at(1.008)))
    t.step(dt_ns=100 * SECOND)
    assert [e.alignment.T_world_tracking.p[0] for e in t.since(AlignmentChanged)] == pytest.approx([1.002])


def test_a_correction_of_somebody_with_an_offset_slides_below_the_offset() -> None:
    t, anna = settled()
    t.step(t.host(PlaceAlignment(1, anna.id, Pose((0.0, 0.0, 1.0), quat_from_yaw(math.pi / 2)), offset=True)))
    t.step(anna.says(at(1.003)))
    came = [a for _, a in rest(t, anna, seconds=2.0)]
    assert [a.T_world_tracking.p for a in came] == [pytest.approx((0.0, y, 1.0), abs=1e-12) for y in (1.002, 1.003)]
    assert all(a.offset and not a.covariance and a.error_at_anchor_m == 0.0 for a in came)


def test_a_directors_word_waits_for_the_clutch() -> None:
    t, anna = settled()
    anna.engage("left")
    t.step(anna.says(at(1.05)))
    where = Pose((2.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    t.step(t.host(PlaceAlignment(1, anna.id, where)))
    assert (t.since(AlignmentChanged), t.decision.outgoing[0].message.ok) == ([], True)
    anna.sends("left", clutch=True)
    assert t.command().sources[0].pose_world.p == (1.0, 0.0, 1.0)
    assert report(t, anna).pending_m == pytest.approx(1.0)
    anna.sends("left")
    assert [(e.alignment.kind, e.alignment.T_world_tracking) for e in t.since(AlignmentChanged)] == [("placed", where)]
    assert rest(t, anna, seconds=3.0) == [], "it has replaced the correction that waited"


def test_a_new_frame_forgets_what_waited() -> None:
    t, anna = settled()
    anna.engage("left")
    t.step(anna.says(at(1.05)), t.host(PlaceAlignment(1, anna.id, Pose((2.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))))
    anna.does(TrackingEpoch(1))
    assert rest(t, anna, seconds=3.0) == []
    assert report(t, anna) == AlignmentReport()
    t.step(anna.says(proposal(tracking_epoch=1)))
    assert len(t.since(AlignmentChanged)) == 1, "nobody has used the new one yet"


def test_restore_in_the_middle_of_a_correction_is_invisible() -> None:
    t, anna = settled()
    t.step(anna.says(at(1.008)))
    rest(t, anna, seconds=0.6)
    again = Table()
    again.authority.restore(t.authority.snapshot())
    for _ in range(100):
        t.now_ns += 20 * MS
        decisions = [one.authority.step(t.now_ns, (), 0, t.view) for one in (t, again)]
        assert decisions[0] == decisions[1]
    assert report(t, anna).pending_m == 0.0
