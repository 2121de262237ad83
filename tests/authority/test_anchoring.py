"""Alignment runs, moved anchors, alarms of the front's watch, comparisons of headsets, and the report of all that."""

from __future__ import annotations

import math
from typing import Any

import pytest

from iris_session.authority import AuthorityConfig
from iris_session.protocol.client_messages import Align, Bye, Heartbeat, MoveAnchor, PlaceAlignment, TrackingEpoch
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import AlignmentAlarm, CrossChecked, Lost, SessionResumed
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentChanged,
    AlignmentRun,
    AnchorMoved,
    HeadsetsCompared,
    Notice,
    ParticipantChanged,
)

from .table import MS, SECOND, Table, proposal
from .test_alignment import report

TABLE = Pose((0.0, -0.45, 0.0), (1.0, 0.0, 0.0, 0.0))
DOOR = Pose((2.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
CONFIG = AuthorityConfig(anchors={"table": TABLE, "door": DOOR})


def shifted(x: float, **fields: Any) -> Any:
    return proposal(T_world_tracking=Pose((x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)), **fields)


def compared(other: int, **fields: Any) -> CrossChecked:
    plain: dict[str, Any] = {"error_m": 0.004, "error_rad": 0.01, "expected_p95_m": 0.006, "p_world": (0.0, 1.0, 0.0)}
    return CrossChecked(other, "table", n=12, **{**plain, **fields})


# --- runs -------------------------------------------------------------------------------------------------------------


def test_who_may_align_whom() -> None:
    t = Table(CONFIG)
    boss, anna, bert = t.join("director", alignment="not_needed"), t.join(name="anna"), t.join(name="bert")
    assert anna.asks(Align(1, "start")).ok
    assert t.since(AlignmentRun) == [AlignmentRun(anna.id, True, 1, anna.id)]
    assert anna.asks(Align(1, "stop", "anna")).ok
    assert anna.denied(Align(1, "start", bert.id)) == "role"
    assert anna.denied(Align(1, "start", "nobody")) == "role"
    assert boss.asks(Align(1, "start", bert.id)).ok
    assert t.since(AlignmentRun) == [AlignmentRun(bert.id, True, 1, boss.id)]
    assert boss.denied(Align(1, "start", "nobody")) == "unknown_participant"
    assert boss.denied(Align(1, "start")) == "invalid"
    assert boss.denied(Align(1, "dance", bert.id)) == "unknown_value"
    t.step(t.host(Align(1, "stop", bert.id)))
    assert t.since(AlignmentRun) == [AlignmentRun(bert.id, False, 1, "host")]
    t.step(t.host(Align(1, "stop", bert.id)))
    assert (t.since(AlignmentRun), t.decision.outgoing[0].message.ok) == ([], True)


def test_a_new_run_keeps_what_is_in_force_and_lets_the_next_in_at_once() -> None:
    t = Table(CONFIG)
    anna = t.operator("left")
    anna.engage("left")
    anna.sends("left")
    t.step(anna.says(shifted(1.5)))
    late = anna.says(shifted(1.9))
    assert anna.asks(Align(1, "start")).ok
    assert t.since(AlignmentChanged) == []
    assert report(t, anna).version == 1
    t.step(late)
    t.step(anna.says(Heartbeat()), dt_ns=3 * SECOND)
    assert t.since(AlignmentChanged) == [], "what the run before has made counts no more, and what waited is dropped"
    t.step(anna.says(shifted(1.5)))
    assert [e.alignment.T_world_tracking.p[0] for e in t.since(AlignmentChanged)] == [1.5]


# --- anchors ----------------------------------------------------------------------------------------------------------


def test_only_a_director_moves_anchors_and_only_to_poses() -> None:
    t = Table(CONFIG)
    boss, anna = t.join("director", alignment="not_needed"), t.join()
    there = Pose((1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    assert anna.denied(MoveAnchor(1, "table", there)) == "role"
    assert boss.denied(MoveAnchor(1, "moon", there)) == "unknown_target"
    for p, q in (
        ((math.nan, 0, 0), IDENTITY.q),
        ((0, 0, 2e3), IDENTITY.q),
        ((0, 0, 0), (0.0,) * 4),
        ((0, 0, 0), (2, 0, 0, 0)),
    ):
        assert boss.denied(MoveAnchor(1, "table", Pose(p, q))) == "invalid"  # type: ignore[arg-type]
    assert t.authority.anchors == {"table": TABLE, "door": DOOR}
    assert boss.asks(MoveAnchor(1, "table", there)).ok
    assert t.since(AnchorMoved) == [AnchorMoved("table", there, boss.id)]
    assert t.authority.anchors == {"table": there, "door": DOOR}
    assert boss.asks(MoveAnchor(1, "table", there)).ok
    assert t.since(AnchorMoved) == []


def test_an_anchor_moves_far_only_where_that_is_said_to_be_meant() -> None:
    t = Table(CONFIG)
    boss = t.join("director", alignment="not_needed")
    near, far = Pose((0.0, 4.5, 0.0), IDENTITY.q), Pose((0.0, -450.45, 0.0), IDENTITY.q)
    denial = boss.asks(MoveAnchor(1, "table", far)).denial
    assert denial is not None
    assert (denial.reason, denial.target) == ("too_far", "table")
    assert denial.message == "anchor table would be moved by 450.0 m; more than 5 m needs --force (`force`)"
    assert denial.advice == "poses are in metres"
    assert boss.asks(MoveAnchor(1, "table", near)).ok, "4.95 m"
    assert boss.denied(MoveAnchor(1, "table", Pose((0.0, -1.0, 0.0), IDENTITY.q))) == "too_far", "from where it is now"
    assert boss.asks(MoveAnchor(1, "table", far, force=True)).ok
    assert t.authority.anchors["table"] == far
    wide = Table(AuthorityConfig(anchors={"table": TABLE}, max_anchor_move_m=500.0))
    wide.step(wide.host(MoveAnchor(1, "table", far)))
    assert wide.authority.anchors["table"] == far


def test_what_was_measured_to_the_old_place_counts_no_more() -> None:
    t = Table(CONFIG)
    anna = t.operator("left")
    anna.engage("left")
    anna.sends("left")
    t.step(anna.says(shifted(1.004)))
    in_flight = anna.says(shifted(1.008))
    t.step(t.host(MoveAnchor(1, "table", DOOR)))
    t.step(in_flight)
    assert report(t, anna).pending_m == 0.0
    t.step(anna.says(shifted(3.0)))
    assert report(t, anna).pending_m == pytest.approx(2.0)
    assert "2000 mm" in t.since(Notice)[0].text


def test_anchors_survive_a_snapshot_and_are_given_anew_to_a_session_that_goes_on() -> None:
    t = Table(CONFIG)
    t.step(t.host(MoveAnchor(1, "table", DOOR)))
    again = Table(CONFIG)
    again.authority.restore(t.authority.snapshot())
    assert again.authority.anchors["table"] == DOOR
    again.now_ns = t.now_ns
    again.step(again.host(SessionResumed(SECOND)))
    assert again.since(AnchorMoved) == []
    again.step(again.host(SessionResumed(SECOND, {"wall": TABLE, "door": DOOR})))
    assert again.since(AnchorMoved) == [AnchorMoved("wall", TABLE, "host")]
    assert again.authority.anchors == {"wall": TABLE, "door": DOOR}


# --- alarms -----------------------------------------------------------------------------------------------------------


def test_a_jump_voids_the_alignment_at_once_and_the_robot_holds() -> None:
    t = Table(CONFIG)
    anna = t.operator("left")
    anna.engage("left")
    before = anna.says(shifted(1.2))
    t.step(anna.says(AlignmentAlarm("jump", 0, "table", 0.12)))
    assert t.hold() == "rearm"
    assert t.since(AlignmentAlarmed) == [AlignmentAlarmed(anna.id, "jump", "table", 0.12)]
    assert [e.participant.alignment for e in t.since(ParticipantChanged)] == [None]
    assert "jumped by 120 mm" in t.since(Notice)[0].text
    t.step(before)
    assert t.since(AlignmentChanged) == [], "it was made before the jump"
    assert report(t, anna).alarm == "jump"
    t.step(anna.says(shifted(1.2)))
    assert len(t.since(AlignmentChanged)) == 1
    assert report(t, anna).alarm == ""
    anna.alignment_version = 2
    anna.engage("left", p=(3.0, 0.0, 0.0))  # as far away in its frame as the jump has put it
    assert t.command().kind == "pose"


def test_a_moved_sheet_is_not_answered_by_a_new_alignment_but_by_a_new_place() -> None:
    t = Table(CONFIG)
    anna = t.operator()
    t.step(anna.says(AlignmentAlarm("changed", 0, "table", 0.03, 0, ("door",))))
    assert "was the sheet moved?" in t.since(Notice)[0].text
    assert t.since(AlignmentAlarmed)[0].beside == ("door",)
    t.step(anna.says(shifted(1.2)))
    assert report(t, anna).alarm == "changed"
    t.step(t.host(MoveAnchor(1, "door", TABLE)))
    assert report(t, anna).alarm == "changed"
    t.step(t.host(MoveAnchor(1, "table", DOOR)))
    assert report(t, anna).alarm == ""


@pytest.mark.parametrize(
    "alarm",
    [
        AlignmentAlarm("boom", 0, "table", 0.2),
        AlignmentAlarm("jump", 0, "table", 0.2),
    ],
)
def test_alarms_of_unknown_kinds_and_old_frames_change_nothing(alarm: AlignmentAlarm) -> None:
    t = Table(CONFIG)
    anna, agent = t.operator(), t.join("agent", alignment="not_needed")
    anna.does(TrackingEpoch(1))
    t.step(anna.says(alarm), agent.says(AlignmentAlarm("jump", 0)), t.host(AlignmentAlarm("jump", 0)))
    assert t.decision.events == ()


@pytest.mark.parametrize("size_m", [math.nan, math.inf, -1.0, 1e300])
def test_odd_sizes_are_bounded(size_m: float) -> None:
    t = Table(CONFIG)
    anna = t.operator()
    t.step(anna.says(AlignmentAlarm("jump", 1, "", size_m)))
    assert 0.0 <= t.since(AlignmentAlarmed)[0].size_m <= CONFIG.reach_m
    assert report(t, anna).version == 0


# --- comparisons ------------------------------------------------------------------------------------------------------


def test_two_headsets_are_compared_and_the_newest_is_kept_per_pair() -> None:
    t = Table(CONFIG)
    anna, bert, carl = t.operator(), t.operator(), t.operator()
    t.step(anna.says(compared(bert.connection)), bert.says(compared(carl.connection, error_m=0.1)))
    assert t.since(HeadsetsCompared)[0] == HeadsetsCompared(
        anna.id, bert.id, "table", 0.004, 0.01, 0.006, (0.0, 1.0, 0.0), 12
    )
    t.step(bert.says(compared(anna.connection, error_m=0.02)), dt_ns=SECOND)
    t.step(dt_ns=100 * MS)
    t.step(bert.says(compared(anna.connection, error_m=0.008, touched=True)), dt_ns=0)
    touched, newest, older = t.authority.build_cross_check_reports()
    assert (touched.touched, touched.error_m) == (True, 0.008)
    assert ({newest.a, newest.b}, newest.error_m, newest.age_ns) == ({anna.id, bert.id}, 0.02, 100 * MS)
    assert ({older.a, older.b}, older.error_m) == ({bert.id, carl.id}, 0.1)
    t.step(anna.says(Lost()))
    assert len(t.authority.build_cross_check_reports()) == 3
    carl.does(Bye())
    assert [{c.a, c.b} for c in t.authority.build_cross_check_reports()] == [{anna.id, bert.id}] * 2


def test_a_comparison_is_outdated_once_one_of_the_two_is_aligned_elsewhere() -> None:
    t = Table(CONFIG)
    anna, bert = t.operator(), t.operator()
    t.step(anna.says(compared(bert.connection, touched=True)))
    assert [c.outdated for c in t.authority.build_cross_check_reports()] == [False]
    now = t.last(AlignmentChanged).alignment
    (x, y, z), q = now.T_world_tracking.p, now.T_world_tracking.q
    for shift_m, outdated in ((0.002, False), (0.05, True)):
        t.step(t.host(PlaceAlignment(0, bert.id, Pose((x + shift_m, y, z), q))))
        assert [c.outdated for c in t.authority.build_cross_check_reports()] == [outdated]


@pytest.mark.parametrize(
    "fields",
    [{"error_m": math.nan}, {"error_rad": -1.0}, {"expected_p95_m": math.inf}, {"p_world": (0.0, math.nan, 0.0)}],
)
def test_comparisons_that_are_no_numbers_are_ignored(fields: dict[str, Any]) -> None:
    t = Table(CONFIG)
    anna, bert = t.operator(), t.operator()
    t.step(anna.says(compared(bert.connection, **fields)))
    assert (t.decision.events, t.authority.build_cross_check_reports()) == ((), ())
