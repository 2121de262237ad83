"""Alignments that age: their stated error, its publication, and the look that confirms them."""

from __future__ import annotations

import pytest

from anchors.ageing import AgeingLaw
from iris_session.authority import AuthorityConfig
from iris_session.protocol.client_messages import Heartbeat, MoveAnchor, PlaceAlignment
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import Join, Lost
from iris_session.protocol.names import AlignmentDoubt, HoldReason, RejectReason
from iris_session.protocol.server_messages import AlignmentChanged, Notice, SamplesRejected

from .table import SECOND, Person, Table, proposal
from .test_alignment import report

#: A step may be a minute long.
LONG = {"gap_ns": 3600 * SECOND, "heartbeat_timeout_ns": 36_000 * SECOND}
CONFIG = AuthorityConfig(anchors={"table": Pose((0.0, -0.5, 0.0), IDENTITY.q)}, **LONG)  # type: ignore[arg-type]


def warnings(t: Table, person: Person) -> list[str]:
    return [e.text for e in t.events if isinstance(e, Notice) and (e.level, e.participant) == ("warning", person.id)]


def pass_minutes(t: Table, minutes: int) -> None:
    for _ in range(6 * minutes):
        t.step(dt_ns=10 * SECOND)


def test_half_an_hour_without_a_look_is_stated_told_and_held_until_a_glance() -> None:
    t = Table(CONFIG)
    anna = t.operator("left")
    stated = [report(t, anna).error_at_robot_m]
    for _ in range(30):
        pass_minutes(t, 1)
        stated.append(report(t, anna).error_at_robot_m)
    assert stated == sorted(stated)
    assert stated[-1] > 0.09, "3 mm a minute"
    assert report(t, anna).doubt == AlignmentDoubt.AGED
    assert len(warnings(t, anna)) == 1
    assert "'table'" in warnings(t, anna)[0]
    told = [e.alignment for e in t.events if isinstance(e, AlignmentChanged)]
    assert {a.version for a in told} == {1}, "the same alignment, stated anew"
    errors = [a.error_at_robot_m for a in told]
    assert errors == sorted(errors)
    assert 5 < len(errors) < 40
    assert errors[-1] > 0.8 * stated[-1]
    anna.engage("left")
    assert t.hold() == HoldReason.UNCONFIRMED
    assert t.last(SamplesRejected).reason == RejectReason.UNCONFIRMED
    t.authority.restore(t.authority.snapshot())
    t.step(anna.says(proposal(T_world_tracking=Pose((1.09, 0.0, 0.0), IDENTITY.q))))  # in use: announced, then applied
    for _ in range(4):
        t.step(dt_ns=SECOND)
    assert report(t, anna).doubt == ""
    assert report(t, anna).error_at_robot_m < 0.001
    assert t.last(AlignmentChanged).alignment.T_world_tracking.p[0] == 1.09
    anna.alignment_version = report(t, anna).version
    anna.engage("left")
    assert t.command().kind == "pose"


def test_who_was_away_when_it_was_said_hears_it_again() -> None:
    t = Table(CONFIG)
    anna = t.join(capabilities=("run:1",))
    t.step(anna.says(proposal()))
    t.step(anna.says(Lost("closed")))
    again = Join("key1", "operator", "person1", capabilities=("run:1",), resume_of=anna.id)
    for _ in range(2):
        t.people += 1
        back = Person(t, t.people, "person1")
        t.step(back.says(again))
        pass_minutes(t, 20)
        t.step(back.says(Lost("closed")))
    assert len(warnings(t, anna)) == 2


def test_what_is_engaged_when_it_becomes_old_goes_on() -> None:
    t = Table(CONFIG)
    anna = t.operator("left")
    anna.engage("left")
    for _ in range(200):
        t.now_ns += 20 * SECOND
        anna.sends("left", clutch=True)
        if report(t, anna).doubt:
            break
    anna.sends("left", clutch=True)
    assert t.command().kind == "pose"


def test_a_look_that_says_less_than_what_is_known_confirms_nothing() -> None:
    t = Table(CONFIG)
    anna = t.operator("left")
    pass_minutes(t, 1)
    age_ns = report(t, anna).confirmed_ns
    coarse = tuple(1e-4 if i % 7 == 0 else 0.0 for i in range(36))
    t.step(anna.says(proposal(covariance=coarse)))
    assert report(t, anna).confirmed_ns > age_ns


def walk(t: Table, anna: Person, metres: float, stride_m: float) -> None:
    for i in range(round(metres / stride_m)):
        t.now_ns += SECOND
        anna.sends(device="head", p=(0.0, stride_m * (i % 2), 1.6))


@pytest.mark.parametrize(("stride_m", "grows"), [(0.5, True), (0.01, False)])
def test_walking_ages_and_standing_does_not(stride_m: float, grows: bool) -> None:
    """A head at rest is measured with noise, which is no way."""
    t = Table(AuthorityConfig(ageing=AgeingLaw(drift_m_per_min=0.0, yaw_rad_per_min=0.0), **LONG))  # type: ignore[arg-type]
    anna = t.operator("left")
    before = report(t, anna).error_at_robot_m
    walk(t, anna, 20.0 if grows else 2.0, stride_m)
    assert (report(t, anna).error_at_robot_m > before + 0.002) is grows


def test_a_placement_is_said_to_be_old_and_never_holds_its_wearer() -> None:
    t = Table(CONFIG)
    boss, anna = t.join("director", alignment="not_needed"), t.operator("left")
    assert boss.asks(PlaceAlignment(1, anna.id, IDENTITY)).ok
    anna.alignment_version = report(t, anna).version
    pass_minutes(t, 20)
    assert len(warnings(t, anna)) == 1
    assert not warnings(t, boss), "who needs no alignment has none that ages"
    anna.engage("left")
    assert t.command().kind == "pose"


def test_an_offset_ages_as_the_measurement_below_it() -> None:
    t = Table(CONFIG)
    boss, anna = t.join("director", alignment="not_needed"), t.operator("left")
    assert boss.asks(PlaceAlignment(1, anna.id, IDENTITY, offset=True)).ok
    pass_minutes(t, 20)
    assert report(t, anna).error_at_robot_m == 0.0, "no stated error"
    assert report(t, anna).doubt == AlignmentDoubt.AGED
    t.step(anna.says(proposal()))
    assert report(t, anna).doubt == ""


def test_without_the_law_nothing_ages() -> None:
    t = Table(AuthorityConfig(ageing=None, **LONG))  # type: ignore[arg-type]
    anna = t.operator("left")
    before = report(t, anna).error_at_robot_m
    pass_minutes(t, 30)
    t.step(anna.says(Heartbeat()))
    assert report(t, anna).error_at_robot_m == before
    anna.engage("left")
    assert t.command().kind == "pose"


@pytest.mark.parametrize("moved", [False, True])
def test_an_estimate_without_a_new_look_ends_neither_age_nor_doubt(moved: bool) -> None:
    """A front estimates again what it saw half an hour ago: an anchor was moved, or a sheet of a wrong size refused."""
    t = Table(CONFIG)
    boss = t.join("director", alignment="not_needed")
    anna = t.operator("left")
    looked_ns = t.now_ns
    t.step(anna.says(proposal(looked_ns=looked_ns)))
    pass_minutes(t, 30)
    before = report(t, anna)
    assert before.doubt == AlignmentDoubt.AGED
    if moved:
        boss.asks(MoveAnchor(1, "table", Pose((0.0, -0.55, 0.0), IDENTITY.q)))
        t.step()
    t.step(anna.says(proposal(T_world_tracking=Pose((1.05, 0.0, 0.0), IDENTITY.q), looked_ns=looked_ns)))
    t.wait(5 * SECOND)
    after = report(t, anna)
    assert after.doubt == AlignmentDoubt.AGED
    assert after.confirmed_ns > before.confirmed_ns
    assert after.error_at_robot_m >= before.error_at_robot_m
    assert after.version == before.version + moved, "the same looks at the new place of the anchor"
    t.step(anna.says(proposal(looked_ns=t.now_ns + SECOND)))
    t.wait(5 * SECOND)
    assert report(t, anna).doubt == ""
    assert 0 <= report(t, anna).confirmed_ns <= 6 * SECOND
