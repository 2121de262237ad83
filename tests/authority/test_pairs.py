"""Pairs of headsets: who is to glance because another one has aligned by the same sheet since."""

from __future__ import annotations

import msgspec
import pytest

from iris_session.authority import AuthorityConfig
from iris_session.protocol.client_messages import Align, PlaceAlignment
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import AlignmentAlarm, AnchorLooks, FrontRestarted, Join, Lost, SessionResumed
from iris_session.protocol.names import AlarmKind, AlignmentDoubt, DenialReason, HoldReason, RejectReason
from iris_session.protocol.server_messages import AlignmentAlarmed, Notice, SamplesRejected

from .table import SECOND, Person, Table, proposal

SHEETS = {name: Pose((x, -0.5, 0.0), IDENTITY.q) for name, x in (("a", 0.0), ("b", 1.0))}
CONFIG = AuthorityConfig(anchors=SHEETS, heartbeat_timeout_ns=3600 * SECOND)
COVARIANCE = tuple(1e-6 if i % 7 == 0 else 0.0 for i in range(36))


def see(t: Table, person: Person, *names: str, seconds: float = 2.0, x: float = 1.0, **fields: object) -> None:
    """Let the front propose an alignment by looks at sheets in the last `seconds`."""
    looks = tuple(AnchorLooks(name, t.now_ns - round(seconds * SECOND), t.now_ns) for name in names)
    T = Pose((x, 0.0, 0.0), IDENTITY.q)
    t.step(person.says(proposal(T_world_tracking=T, covariance=COVARIANCE, looks=looks, **fields)))


def aligned(t: Table, name: str, *robots: str, by: tuple[str, ...] = ("a",), **fields: object) -> Person:
    person = t.join(name=name, **fields)
    see(t, person, *by)
    if robots:
        person.acquire(*robots)
    return person


def two(config: AuthorityConfig = CONFIG) -> tuple[Table, Person, Person]:
    """Ann has aligned by sheet a; later bob does."""
    t = Table(config)
    ann = aligned(t, "ann", "left")
    t.wait(10 * SECOND)
    return t, ann, aligned(t, "bob", "right")


def reconnect(t: Table, person: Person, run: str) -> Person:
    """Let the first one who joined come back with the same tracking frame."""
    t.people += 1
    back = t.persons[t.people] = Person(t, t.people, "ann")
    t.step(back.says(Join("key1", "operator", "ann", capabilities=(run,), resume_of=person.id)))
    back.id = person.id
    return back


def doubt(t: Table, person: Person) -> str:
    return t.authority.build_alignment_reports()[person.id].doubt


def pairs(t: Table) -> list[tuple[str, str, str]]:
    return [(one.participant, one.other, one.anchor_id) for one in t.authority.build_unverified_reports()]


def prompts(t: Table, person: Person) -> list[str]:
    return [e.text for e in t.events if isinstance(e, Notice) and (e.level, e.participant) == ("warning", person.id)]


def test_whoever_saw_the_sheet_last_before_is_asked_once_and_holds_until_a_glance() -> None:
    t, ann, bob = two()
    assert pairs(t) == [(ann.id, bob.id, "a")]
    assert (doubt(t, ann), doubt(t, bob)) == (AlignmentDoubt.UNVERIFIED, "")
    t.wait(20 * SECOND)
    assert len(prompts(t, ann)) == 1
    assert "'a'" in prompts(t, ann)[0]
    assert "bob" in prompts(t, ann)[0]
    assert prompts(t, bob) == []
    bob.engage("right")
    assert t.command("right").kind == "pose", "who has just looked drives"
    ann.engage("left")
    assert t.hold() == HoldReason.UNCONFIRMED
    assert t.last(SamplesRejected).reason == RejectReason.UNCONFIRMED
    t.authority.restore(t.authority.snapshot())
    assert pairs(t) == [(ann.id, bob.id, "a")]
    see(t, ann, "a")
    t.wait(SECOND)  # it slides in
    assert (doubt(t, ann), doubt(t, bob), pairs(t)) == ("", "", [])
    ann.alignment_version = t.authority.build_alignment_reports()[ann.id].version
    ann.engage("left")
    assert t.command().kind == "pose"
    t.wait(20 * SECOND)
    assert (len(prompts(t, ann)), prompts(t, bob)) == (1, [])


def test_a_look_that_disagrees_makes_everybody_glance() -> None:
    """Bob looks again and finds the sheet elsewhere: nobody knows whether it was bumped before ann's look or after."""
    t, ann, bob = two()
    see(t, ann, "a")
    t.wait(10 * SECOND)
    t.step(bob.says(AlignmentAlarm(AlarmKind.DIFFERS, 0, "a", 0.05)))
    assert doubt(t, ann) == ""
    see(t, bob, "a", x=1.05)
    assert doubt(t, ann) == AlignmentDoubt.UNVERIFIED
    t.wait(5 * SECOND)
    assert doubt(t, bob) == "", "the new alignment is in force"


def test_a_reconnection_with_the_alignment_kept_costs_nothing() -> None:
    t = Table(CONFIG)
    ann, bob = aligned(t, "ann", capabilities=("run:1",)), aligned(t, "bob")
    t.step(bob.says(Lost("closed")))
    t.step(ann.says(Lost("closed")))
    t.wait(10 * SECOND)
    see(t, reconnect(t, ann, "run:1"), "a")
    assert pairs(t) == []


def test_who_was_away_is_asked_when_back() -> None:
    t = Table(CONFIG)
    ann = aligned(t, "ann", capabilities=("run:1",))
    t.step(ann.says(Lost("closed")))
    t.wait(5 * SECOND)
    bob = aligned(t, "bob")
    assert prompts(t, ann) == []
    reconnect(t, ann, "run:1")
    t.wait(2 * SECOND)
    assert len(prompts(t, ann)) == 1
    t.step(bob.says(Lost("closed")))
    t.wait(t.config.grace_ns + 2 * SECOND)
    assert doubt(t, ann) == "", "nobody is left to differ from"


@pytest.mark.parametrize("other", [{"role": "observer"}, {"by": ("b",)}])
def test_visitors_and_people_at_another_sheet_hold_nobody(other: dict[str, object]) -> None:
    t = Table(CONFIG)
    ann = aligned(t, "ann")
    t.wait(10 * SECOND)
    aligned(t, "eve", **other)  # type: ignore[arg-type]
    t.wait(2 * SECOND)
    assert doubt(t, ann) == ""
    assert len(pairs(t)) == ("role" in other), "status says it all the same"


def test_a_glance_at_another_sheet_does_not_verify() -> None:
    t = Table(CONFIG)
    ann = aligned(t, "ann", by=("a", "b"))
    t.wait(10 * SECOND)
    aligned(t, "bob")
    see(t, ann, "b")
    assert doubt(t, ann) == AlignmentDoubt.UNVERIFIED
    see(t, ann, "a")
    assert doubt(t, ann) == ""


def test_a_moved_sheet_is_no_ground_for_those_who_have_no_other() -> None:
    """Ann sees sheet a elsewhere, beside sheet b. Bob has aligned by a alone since: he cannot know."""
    t = Table(CONFIG)
    ann, eve = aligned(t, "ann", by=("a", "b")), aligned(t, "eve")
    t.wait(10 * SECOND)
    bob = aligned(t, "bob")
    see(t, eve, "a")
    t.step(ann.says(AlignmentAlarm(AlarmKind.DIFFERS, 0, "a", 0.05, 0, ("b",))))
    t.wait(2 * SECOND)
    assert doubt(t, bob) == AlignmentDoubt.CONTRADICTED
    assert "'b'" in prompts(t, bob)[-1]
    assert (doubt(t, ann), doubt(t, eve)) == ("", ""), "eve has aligned while ann saw it in place"


def test_a_directors_word_ends_it_and_without_the_law_nothing_happens() -> None:
    t, ann, _ = two()
    boss = t.join("director", alignment="not_needed")
    assert boss.asks(PlaceAlignment(1, ann.id, IDENTITY)).ok
    assert doubt(t, ann) == ""
    t, ann, _ = two(msgspec.structs.replace(CONFIG, verify_pairs=False))
    t.wait(2 * SECOND)
    assert (doubt(t, ann), pairs(t)) == ("", [])


def test_a_stopped_run_is_to_be_started_before_the_glance() -> None:
    t = Table(CONFIG)
    ann = aligned(t, "ann")
    ann.asks(Align(1, "stop"))
    t.wait(10 * SECOND)
    aligned(t, "bob")
    assert "start" in prompts(t, ann)[0]


# --- votes ---


def shift(kind: str = AlarmKind.DIFFERS, x: float = 0.05) -> AlignmentAlarm:
    return AlignmentAlarm(kind, 0, "a", abs(x), 0, (), (x, 0.0, 0.0))


def both() -> tuple[Table, Person, Person]:
    t = Table(msgspec.structs.replace(CONFIG, anchors={"a": SHEETS["a"]}))
    return t, aligned(t, "ann"), aligned(t, "bob")


@pytest.mark.parametrize("kind", [AlarmKind.DIFFERS, AlarmKind.JUMP])
@pytest.mark.parametrize("apart_ns", [SECOND // 10, 20 * SECOND])
def test_two_headsets_that_see_one_shift_outvote_the_sheet(kind: str, apart_ns: int) -> None:
    t, ann, bob = both()
    if apart_ns > SECOND:
        t.wait(5 * SECOND)  # nobody else is looking: ann is told at once
    t.step(ann.says(shift(kind)))
    t.wait(apart_ns)
    t.step(bob.says(shift(kind, 0.053)))
    t.wait(5 * SECOND)
    told = [e for e in t.events if isinstance(e, Notice) and e.level == "warning"]
    assert len([e for e in told if not e.participant]) == 1, "once, to everybody"
    assert [e for e in told if e.participant == bob.id] == []
    assert len([e for e in told if e.participant == ann.id]) == (apart_ns > SECOND)
    last = t.last(AlignmentAlarmed)
    assert (last.participant, last.witnesses) == (bob.id, (ann.id,))
    assert last.kind != AlarmKind.JUMP, "the tracking frame did not"
    assert doubt(t, bob) == AlignmentDoubt.CONTRADICTED


def test_one_headset_alone_is_doubted_itself_and_told_a_little_later_while_others_look() -> None:
    t, ann, bob = both()
    t.step(ann.says(shift()))
    assert (doubt(t, ann), prompts(t, ann)) == (AlignmentDoubt.CONTRADICTED, [])
    t.authority.restore(t.authority.snapshot())
    t.wait(t.config.vote_ns)
    assert len(prompts(t, ann)) == 1
    assert (doubt(t, bob), prompts(t, bob)) == ("", [])
    assert t.last(AlignmentAlarmed).witnesses == ()


@pytest.mark.parametrize("case", ["another shift", "seen there since", "aligned since"])
def test_what_is_not_the_same_shift_is_no_vote(case: str) -> None:
    t, ann, bob = both()
    t.step(ann.says(shift()))
    t.wait(10 * SECOND)
    if case == "seen there since":
        see(t, bob, "a")
    elif case == "aligned since":
        bob = aligned(t, "bert")
    t.wait(2 * SECOND)
    t.step(bob.says(shift(x=-0.05 if case == "another shift" else 0.05)))
    assert t.last(AlignmentAlarmed).witnesses == ()


def test_two_prints_of_one_id_hold_everybody_who_knows_no_other_sheet() -> None:
    t = Table(CONFIG)
    ann, bob = aligned(t, "ann"), aligned(t, "bob", by=("a", "b"))
    t.step(ann.says(AlignmentAlarm(AlarmKind.TWO_PLACES, 0, "a", 0.8)))
    assert (doubt(t, ann), doubt(t, bob)) == (AlignmentDoubt.CONTRADICTED, "")
    assert [e.participant for e in t.events if isinstance(e, Notice) and e.level == "warning"] == [""]


def test_bad_numbers_of_a_front_change_nothing() -> None:
    t, ann, bob = both()
    for bad in ((float("nan"), 0.0, 0.0), (0.05, 0.0), (1e300, 0.0, 0.0)):
        t.step(ann.says(AlignmentAlarm(AlarmKind.DIFFERS, 0, "a", 0.05, 0, (), bad)))
        t.step(bob.says(shift()))
        assert t.last(AlignmentAlarmed).witnesses == ()
    t.step(bob.says(proposal(looks=(AnchorLooks("a", 10**18, 10**18), AnchorLooks("no anchor", 0, 0)))))
    t.wait(10 * SECOND)
    eve = aligned(t, "eve")
    assert (doubt(t, bob), doubt(t, eve)) == (AlignmentDoubt.UNVERIFIED, ""), "a look is never in the future"


# --- what a front has forgotten ---------------------------------------------------------------------------------------


def test_one_sheet_that_contradicts_others_takes_over_only_with_one_of_them() -> None:
    t = Table(CONFIG)
    ann = aligned(t, "ann", by=("a", "b"), capabilities=("run:1",))
    t.step(ann.says(AlignmentAlarm(AlarmKind.DIFFERS, 0, "a", 0.05)))
    t.step(t.host(FrontRestarted()))
    ann = reconnect(t, ann, "run:1")
    version = t.authority.build_alignment_reports()[ann.id].version
    see(t, ann, "a", x=1.05)
    t.wait(3 * SECOND)
    assert t.authority.build_alignment_reports()[ann.id].version == version
    assert doubt(t, ann) == AlignmentDoubt.CONTRADICTED
    see(t, ann, "a", x=1.05)
    assert [n.reason for n in t.events if isinstance(n, Notice)].count(DenialReason.ALIGNMENT_REFUSED) == 1
    see(t, ann, "a", "b", x=1.05)
    t.wait(3 * SECOND)
    assert t.authority.build_alignment_reports()[ann.id].version > version
    assert doubt(t, ann) == ""


def test_one_sheet_that_contradicts_looks_of_long_ago_replaces_them() -> None:
    t = Table(CONFIG)
    ann = aligned(t, "ann", "left", by=("a", "b"))
    t.wait(601 * SECOND)
    version = t.authority.build_alignment_reports()[ann.id].version
    t.step(ann.says(AlignmentAlarm(AlarmKind.DIFFERS, 0, "a", 0.05)))
    see(t, ann, "a", x=1.05)
    t.wait(3 * SECOND)
    assert t.authority.build_alignment_reports()[ann.id].version > version


@pytest.mark.parametrize("is_gap_known", [True, False])
def test_after_a_reboot_of_the_host_alignments_wait_for_a_glance(is_gap_known: bool) -> None:
    t = Table(CONFIG)
    ann = aligned(t, "ann", capabilities=("run:1",))
    t.step(t.host(SessionResumed(0, {}, is_gap_known)))
    ann = reconnect(t, ann, "run:1")
    assert doubt(t, ann) == ("" if is_gap_known else AlignmentDoubt.AGED)
    t.wait(12 * SECOND)
    assert len(prompts(t, ann)) == (0 if is_gap_known else 2), "while it was away, and once it is back"
    see(t, ann, "a")
    assert doubt(t, ann) == ""
