"""Alignments in doubt: what begins no engagement, what goes on, and what ends the doubt."""

from __future__ import annotations

import pytest

from iris_session.authority import AuthorityConfig
from iris_session.protocol.client_messages import Grasp, PlaceAlignment
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import AlignmentAlarm
from iris_session.protocol.names import AlarmKind, AlignmentDoubt, HoldReason, RejectReason
from iris_session.protocol.server_messages import AlignmentAlarmed, Notice, SamplesRejected

from .table import SECOND, Person, Table, proposal
from .test_alignment import report


def doubted(t: Table) -> Person:
    anna = t.operator("left")
    t.step(anna.says(AlignmentAlarm(AlarmKind.CHANGED, 0, "table", 0.03)))
    return anna


@pytest.mark.parametrize("kind", [AlarmKind.CHANGED, AlarmKind.DIFFERS])
def test_a_contradiction_lets_nothing_begin_until_a_look_agrees(kind: str) -> None:
    t = Table()
    anna = t.operator("left")
    anna.engage("left")
    t.step(anna.says(AlignmentAlarm(kind, 0, "table", 0.03)))
    told = [(n.level, n.participant) for n in t.since(Notice)]
    assert t.since(AlignmentAlarmed) == [AlignmentAlarmed(anna.id, kind, "table", 0.03)]
    t.step(anna.says(AlignmentAlarm(kind, 0, "table", 0.03)))
    assert (len(t.since(AlignmentAlarmed)), t.since(Notice)) == (1, []), "the wearer is not told again and again"
    anna.sends("left", clutch=True)
    assert t.command().kind == "pose", "what is engaged goes on"
    r = report(t, anna)
    assert (r.doubt, r.alarm, r.alarm_size_m, r.alarm_ns > 0) == (AlignmentDoubt.CONTRADICTED, kind, 0.03, True)
    assert told == [("warning", anna.id)]
    anna.engage("left")
    assert t.hold() == HoldReason.UNCONFIRMED
    assert t.last(SamplesRejected).reason == RejectReason.UNCONFIRMED
    t.authority.restore(t.authority.snapshot())
    anna.engage("left")
    assert t.hold() == HoldReason.UNCONFIRMED
    t.step(anna.says(proposal()))
    t.wait(SECOND)
    assert (report(t, anna).doubt, report(t, anna).alarm) == ("", "")
    anna.alignment_version = report(t, anna).version
    anna.sends("left", clutch=True)
    assert t.hold() == HoldReason.REARM, "the squeeze is still held"
    anna.engage("left")
    assert t.command().kind == "pose"


def test_objects_and_twists_wait_too_and_joints_do_not() -> None:
    t = Table()
    anna = doubted(t)
    assert anna.asks(Grasp(1, "hammer", "controller/right")).ok
    anna.engage("hammer")
    assert t.last(SamplesRejected).reason == RejectReason.UNCONFIRMED
    anna.sends("left")
    anna.sends("left", clutch=True, kind="twist", pose=None, twist=(0.1,) + (0.0,) * 5)
    assert t.hold() == HoldReason.UNCONFIRMED
    for clutch in (False, True):
        anna.sends("left", clutch=clutch, device="joints", kind="joints", pose=None, q=(0.0,) * 7)
    assert t.command().kind == "joints"


def test_a_directors_word_ends_a_doubt_and_is_not_doubted_for_what_it_differs_from() -> None:
    t = Table()
    boss, anna = t.join("director", alignment="not_needed"), doubted(t)
    assert boss.asks(PlaceAlignment(1, anna.id, IDENTITY)).ok
    assert report(t, anna).doubt == ""
    t.step(anna.says(AlignmentAlarm(AlarmKind.DIFFERS, 0, "table", 0.03)))
    assert report(t, anna).doubt == ""


def test_a_look_that_agrees_with_a_pending_correction_confirms_nothing() -> None:
    t = Table()
    anna = t.operator("left")
    anna.engage("left")
    away = proposal(T_world_tracking=Pose((1.05, 0.0, 0.0), IDENTITY.q))
    t.step(anna.says(away))
    for _ in range(5):
        anna.sends("left", clutch=True)
    before = report(t, anna).confirmed_ns
    t.step(anna.says(away))
    assert report(t, anna).pending_m > 0.04
    assert report(t, anna).confirmed_ns > before


def test_what_contradicts_a_pending_correction_ends_it() -> None:
    t = Table()
    anna = t.operator("left")
    anna.engage("left")
    t.step(anna.says(proposal(T_world_tracking=Pose((1.05, 0.0, 0.0), IDENTITY.q))))
    anna.sends("left", clutch=True)
    t.step(anna.says(AlignmentAlarm(AlarmKind.DIFFERS, 0, "table", 0.05)))
    assert report(t, anna).doubt == AlignmentDoubt.CONTRADICTED
    assert report(t, anna).pending_m == 0.0
    anna.sends("left", clutch=False)
    t.wait(2 * SECOND)
    anna.engage("left")
    assert t.hold() == HoldReason.UNCONFIRMED


def test_where_nothing_is_doubted_an_engagement_begins() -> None:
    """As in recordings of earlier versions."""
    t = Table(AuthorityConfig(doubts=False))
    anna = doubted(t)
    assert report(t, anna).doubt == ""
    anna.engage("left")
    assert t.command().kind == "pose"
