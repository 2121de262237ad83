"""Live anchors in the front, without a network: synthetic headsets in, entries for the authority out."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import pytest

from anchors.pose import PoseTuple, apply, compose, distance, inverse, quat_from_yaw
from iris_session.protocol.client_messages import Observation, Sample
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import AlignmentAlarm, AlignmentProposal, CrossChecked, decode_entry, encode_entry
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentRun,
    AnchorMoved,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantLeft,
)
from iris_session.protocol.status import AlignmentReport
from tests.alignment.emulated_headsets import ANCHORS, MS, SECOND, SHEET, Lab, Wearer, inverse_head, misplaced_m
from tests.anchors.worlds import shifted


def test_heads_make_the_noise_model_known() -> None:
    """The same looks with and without head samples: what is known of the noise makes the stated error smaller."""
    errors = []
    for head in (True, False):
        lab = Lab()
        ann = lab.wearer()
        for _ in range(3):
            look = ann.place(d=0.5)
            for _ in range(15):
                lab.now_ns += 100 * MS
                ann.see(look, head=head)
                lab.turn()
        errors.append(ann.proposals()[-1].error_at_anchor_m)
        assert misplaced_m(ann, ann.proposals()[-1]) < 0.01
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.parametrize("seed", range(4))
def test_a_bump_of_5_cm_is_a_jump_within_3_detections_and_starts_anew(seed: int) -> None:
    lab = Lab()
    ann = lab.wearer(seed=seed)
    ann.survey()
    look = ann.place(d=0.7)
    ann.watch(look, 20)
    assert ann.alarms() == []
    told = len(ann.entries())
    ann.bump(0.03, 0.03, 0.026)
    ann.watch(look, 3)
    (alarm,) = ann.alarms()
    assert (alarm.kind, alarm.anchor_id, alarm.tracking_epoch) == ("jump", "sheet", 1)
    assert alarm.size_m == pytest.approx(0.05, abs=0.01)
    ann.watch(look, 20)
    entries = ann.entries()[told:]
    at = [isinstance(e.message, AlignmentAlarm) for e in entries].index(True)
    later = [e for e in entries[at + 1 :] if isinstance(e.message, AlignmentProposal) and not e.message.refused]
    assert later
    for entry in later:
        assert entry.receive_ns > entries[at].receive_ns
        assert misplaced_m(ann, entry.message) < 0.015, "only what was seen after the bump counts"
    assert all(e.receive_ns <= entries[at].receive_ns for e in entries[:at])


@pytest.mark.parametrize("seed", range(4))
def test_a_change_of_10_mm_is_told_within_2_s(seed: int) -> None:
    lab = Lab()
    ann = lab.wearer(seed=seed)
    ann.survey()
    look = ann.place(d=0.7)
    ann.watch(look, 25)
    since_ns = lab.now_ns
    way = ann.rng.normal(size=3)
    ann.bump(*(0.010 * way / math.sqrt(float(way @ way))).tolist())
    ann.watch(look, 25)
    alarms = ann.alarms()
    assert [(a.kind, a.beside) for a in alarms] == [("changed", ())]
    assert alarms[0].capture_ns - since_ns <= 2 * SECOND
    assert misplaced_m(ann, ann.proposals()[-1]) < 0.01


def test_a_sheet_that_was_moved_beside_another_is_told_and_nothing_starts_anew() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey(3, ("sheet", "other"))
    looks = {name: ann.place(name, p_head_world=(0.6, 0.0, 1.3)) for name in ANCHORS}
    for i in range(50):
        if i == 25:
            lab.world["sheet"] = shifted(SHEET, (0.05, 0.0, 0.0))
        lab.now_ns += 100 * MS
        for name, look in looks.items():
            ann.see(look, name)
        lab.turn()
    assert [(a.kind, a.anchor_id, a.beside) for a in ann.alarms()] == [("changed", "sheet", ("other",))]
    assert ann.proposals()[-1].n_observations > 100, "what was seen before the sheet was moved still counts"
    ann.watch(ann.place("sheet", 0.5), 30)
    assert len(ann.alarms()) == 1, "that it is elsewhere was told"
    there = ann.place("sheet", 0.5)
    ann.watch(there, 25)
    lab.world["sheet"] = shifted(SHEET, (0.08, 0.0, 0.0))
    ann.watch(there, 25)
    assert len(ann.alarms()) == 2, "without another in sight it may be the headset: told again"


def test_what_was_seen_out_of_sight_differs_from_what_is_in_force_and_is_told_once() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    lab.now_ns += 60 * SECOND
    ann.bump(0.03)
    ann.watch(ann.place(d=0.5), 40)
    assert [a.kind for a in ann.alarms()] == ["differs"], "the correction waits: that is nothing new to tell"
    assert misplaced_m(ann, ann.proposals()[-1]) < 0.01


@pytest.mark.parametrize("fields", [{"offset": True}, {"kind": "placed"}])
def test_what_a_director_placed_is_contradicted_by_no_sheet(fields: dict[str, object]) -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    got = ann.proposals()[-1]
    pose = Pose(*shifted((got.T_world_tracking.p, got.T_world_tracking.q), (0.3, 0.0, 0.0)))
    lab.service.process_event(AlignmentRun("p1", False, 1))  # no estimate speaks for it
    lab.put_in_force(ann, got, T_world_tracking=pose, **fields)
    ann.watch(ann.place(d=0.5), 40)
    assert ann.alarms() == []
    lab.put_in_force(ann, got, T_world_tracking=pose)
    ann.watch(ann.place(d=0.5), 40)
    assert [a.kind for a in ann.alarms()] == ["differs"], "had it been measured, it would be wrong"


def test_a_head_that_jumps_is_told_at_once_and_no_more_than_once_a_second() -> None:
    lab = Lab()
    ann = lab.wearer()
    for i in range(200):  # 2 s, and a jump between any two
        lab.now_ns += 10 * MS
        ann.head(((0.5 * (i % 2), 0.0, 1.6), (1.0, 0.0, 0.0, 0.0)))
    assert {a.kind for a in ann.alarms()} == {"jump"}
    assert 1 <= len(ann.alarms()) <= 3
    assert lab.drops.by_reason["alarms_repeated"] > 50


def test_a_second_jump_is_told_at_once_when_something_came_into_force_between() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    ann.head(((0.0, 0.0, 1.6), (1.0, 0.0, 0.0, 0.0)))
    for x in (1.0, 2.0):
        lab.now_ns += 10 * MS
        ann.head(((x, 0.0, 1.6), (1.0, 0.0, 0.0, 0.0)))
        lab.now_ns += 10 * MS
        ann.head(((x, 0.0, 1.6), (1.0, 0.0, 0.0, 0.0)))
        ann.accept()
    assert [a.kind for a in ann.alarms()][-2:] == ["jump", "jump"]


def test_looks_from_before_a_jump_that_come_after_it_do_not_count() -> None:
    """A sheet is found in a picture tenths of a second old; the head shows the jump within a frame."""
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    look = ann.place(d=0.6)
    ann.watch(look, 5)
    seen_at_ns, old_frame, told = lab.now_ns, ann.frame, len(ann.entries())
    lab.now_ns += 10 * MS
    ann.bump(0.5)
    ann.head(inverse_head(ann.frame, look))
    assert [a.kind for a in ann.alarms()] == ["jump"]
    for i in range(10):
        lab.now_ns += 30 * MS
        p, q = look.new(old_frame, lab.world["sheet"])
        ann.observe(Observation("sheet", "qr", Pose(p, q), seen_at_ns + i * MS, ann.epoch, ann.viewpoint))
        lab.turn()
    assert lab.drops.by_reason["observation_before_jump"] == 10
    assert not [e for e in ann.entries()[told:] if isinstance(e.message, AlignmentProposal)]
    ann.watch(look, 15)
    assert misplaced_m(ann, ann.proposals()[-1]) < 0.015


def test_who_has_no_alignment_any_more_has_none_in_force_here() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    info = ParticipantInfo("p1", "Ann", "operator", True)
    assert lab.service._states[1].monitor.in_force is not None
    lab.service.process_event(ParticipantChanged(info))
    assert lab.service._states[1].monitor.in_force is None


def test_a_stopped_run_proposes_nothing_but_is_watched_and_a_new_one_forgets() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    lab.service.process_event(AlignmentRun("p1", False, 1))
    look, before = ann.place(d=0.6), len(ann.proposals())
    ann.watch(look, 20)
    assert len(ann.proposals()) == before
    ann.bump(0.05, 0.05)
    ann.watch(look, 5)
    assert [a.kind for a in ann.alarms()] == ["jump"]
    lab.service.process_event(AlignmentRun("p1", True, 2))
    ann.watch(look, 3)
    assert len(ann.proposals()) == before, "too few observations in the new run"
    ann.watch(look, 10)
    assert ann.proposals()[-1].n_observations <= 13
    assert misplaced_m(ann, ann.proposals()[-1]) < 0.015


def test_a_stopped_run_stays_stopped_over_a_reconnect_until_its_owner_leaves() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    before = len(ann.proposals())
    lab.service.process_event(AlignmentRun("p1", False, 1))
    lab.service.remove_connection(1)
    ann.watch(ann.place(), 20)
    assert len(ann.proposals()) == before
    lab.service.process_event(ParticipantLeft("p1", "bye", False))
    lab.service.remove_connection(1)
    ann.watch(ann.place(), 20)
    assert len(ann.proposals()) > before


def test_an_anchor_that_a_director_moved_is_proposed_at_its_new_place_without_a_new_look() -> None:
    lab = Lab({"sheet": SHEET})
    ann = lab.wearer()
    ann.survey()
    lab.turn(500)
    before = ann.proposals()[-1]
    moved: PoseTuple = ((1.2, 0.4, 0.9), quat_from_yaw(2.5))
    lab.service.process_event(AnchorMoved("sheet", Pose(*moved)))
    lab.turn(500)
    after = ann.proposals()[-1]
    expected = compose(compose(moved, inverse(SHEET)), (before.T_world_tracking.p, before.T_world_tracking.q))
    assert math.dist(after.T_world_tracking.p, expected[0]) < 1e-3
    lab.world["sheet"] = moved
    ann.frame = (after.T_world_tracking.p, after.T_world_tracking.q)
    ann.watch(ann.place(d=0.5), 20)  # the old alignment is still in force: known, and nothing to tell
    assert ann.alarms() == []


def test_who_measures_no_more_is_not_alarmed_by_an_anchor_that_a_director_moved() -> None:
    lab = Lab({"sheet": SHEET})
    ann = lab.wearer()
    ann.survey()
    lab.service.process_event(AlignmentRun("p1", False, 1))
    ann.accept()
    lab.service.process_event(AnchorMoved("sheet", Pose(*shifted(SHEET, (0.5, 0.0, 0.0)))))
    ann.watch(ann.place(d=0.5), 40)
    assert ann.alarms() == []


def test_a_controller_in_its_holder_is_an_anchor() -> None:
    stated = {}
    for kind in ("controller", "qr"):
        lab = Lab()
        ann = lab.wearer()
        T_tracking_anchor = compose(inverse(ann.frame), SHEET)
        for viewpoint in range(3):
            for _ in range(10):
                lab.now_ns += 100 * MS
                p = (ann.rng.normal(0.0, 0.001, 3) + T_tracking_anchor[0]).tolist()
                pose = Pose((p[0], p[1], p[2]), T_tracking_anchor[1])
                ann.observe(Observation("sheet", kind, pose, lab.now_ns, 1, viewpoint))
                lab.turn()
        stated[kind] = ann.proposals()[-1].error_at_anchor_m
        assert misplaced_m(ann, ann.proposals()[-1]) < 0.003
    assert stated["controller"] < 0.4 * stated["qr"], "1.5 mm per axis, not the 5 mm of a sheet seen from nowhere"


MARKS: dict[str, PoseTuple] = {
    "a": ((0.0, 0.0, 0.0), IDENTITY.q),
    "b": ((0.62, 0.03, 0.0), IDENTITY.q),
    "c": ((0.55, 0.45, 0.0), IDENTITY.q),
    "d": ((-0.05, 0.37, 0.0), IDENTITY.q),
}


def _touch(ann: Wearer, point: str, at: str = "", off: float = 0.0) -> None:
    ann.lab.now_ns += SECOND
    x, y, z = apply(inverse(ann.frame), MARKS[at or point][0])
    pose = Pose((x + off, y, z), IDENTITY.q)
    ann.observe(Observation(point, "touch", pose, ann.lab.now_ns, ann.epoch))
    ann.lab.turn()


def _refusals(ann: Wearer) -> list[str]:
    messages = [e.message for e in ann.entries()]
    return [m.advice for m in messages if isinstance(m, AlignmentProposal) and m.refused]


def test_three_touched_marks_align() -> None:
    lab = Lab(MARKS)
    ann = lab.wearer()
    for point in "ab":
        _touch(ann, point)
    assert ann.entries() == []
    report = lab.service.complete_report(1, None, lab.now_ns)
    assert report is not None
    assert "2 points touched, 3 are needed" in report.advice
    _touch(ann, "c")
    (got,) = ann.proposals()
    assert misplaced_m(ann, got, "d") < 0.004  # the frame is tilted by 0.2 deg
    assert "'a'" in got.advice


def test_mixed_up_marks_are_refused_by_name_and_may_be_touched_again() -> None:
    lab = Lab(MARKS)
    ann = lab.wearer()
    for point, at in zip("abcd", "bacd", strict=True):
        _touch(ann, point, at)
    assert ann.proposals() == []
    assert "'a' was touched at 'b'" in _refusals(ann)[-1]
    for point in "ab":
        _touch(ann, point)
    assert misplaced_m(ann, ann.proposals()[-1], "d") < 0.004, "what was touched wrongly is replaced"


def test_touches_of_an_old_tracking_frame_are_forgotten() -> None:
    lab = Lab(MARKS)
    ann = lab.wearer()
    for point in "ab":
        _touch(ann, point)
    ann.epoch = 2
    _touch(ann, "c")
    _touch(ann, "d")
    assert ann.proposals() == []
    _touch(ann, "a")
    assert len(ann.proposals()) == 1


def test_a_touched_alignment_is_not_replaced_by_a_worse_look() -> None:
    lab = Lab(MARKS)
    ann = lab.wearer()
    for point in "abcd":
        _touch(ann, point)
    touched = ann.proposals()
    ann.watch(ann.place("a", 1.2), 20, "a")
    assert ann.proposals() == touched
    ann.epoch = 2
    ann.watch(ann.place("a", 0.6), 20, "a")
    assert len(ann.proposals()) > len(touched)


# --- two headsets ----------------------------------------------------------------------------------------------------


def _pair(lab: Lab, off: float) -> tuple[Wearer, Wearer]:
    """Two that are aligned, the second by so much wrongly."""
    ann, bob = lab.wearer(1), lab.wearer(2)
    for one in (ann, bob):
        one.survey(4)
    got = bob.proposals()[-1]
    pose = Pose(*shifted((got.T_world_tracking.p, got.T_world_tracking.q), (off, 0.0, 0.0)))
    lab.put_in_force(bob, got, T_world_tracking=pose, offset=True)
    return ann, bob


def test_two_headsets_are_compared_and_a_planted_20_mm_are_found() -> None:
    lab = Lab()
    ann, bob = _pair(lab, 0.02)
    lab.entries.clear()
    looks = ann.place(d=0.5), bob.place(d=0.5)
    since_ns = lab.now_ns
    while lab.now_ns < since_ns + 21 * SECOND:
        lab.now_ns += 100 * MS
        for one, look in zip((ann, bob), looks, strict=True):
            one.see(look)
        lab.turn(20)
    found = lab.compared()
    assert 3 <= len(found) <= 5, "every five seconds"
    for entry in found:
        message = entry.message
        assert isinstance(message, CrossChecked)
        assert (entry.connection, message.other, message.anchor_id) == (1, 2, "sheet")
        assert message.error_m == pytest.approx(0.02, abs=0.007)
        assert 0.0 < message.expected_p95_m < 0.02
        assert decode_entry(encode_entry(entry)) == entry
    assert all(b.receive_ns - a.receive_ns >= 5 * SECOND for a, b in pairwise(found))
    before = len(found)
    for _ in range(10):
        lab.now_ns += SECOND
        lab.turn(20)
    assert len(lab.compared()) <= before + 1, "nobody looked any more"


def test_who_left_or_was_bumped_is_not_compared_by_what_it_saw_before() -> None:
    lab = Lab()
    ann, bob = _pair(lab, 0.0)
    lab.turn(2000)
    lab.entries.clear()
    bob.head(((0.0, 0.0, 1.6), IDENTITY.q))
    lab.now_ns += 10 * MS
    bob.head(((1.0, 0.0, 1.6), IDENTITY.q))
    ann.watch(ann.place(), 10)
    lab.now_ns += 6 * SECOND
    lab.turn(2000)
    assert lab.compared() == []
    lab.service.process_event(AlignmentAlarmed("p2", "jump", "", 1.0))
    lab.service.remove_connection(1)
    lab.service.remove_connection(2)
    assert len(lab.service) == 0


def test_a_controller_that_both_see_moves_and_is_compared_at_the_same_instants() -> None:
    lab = Lab()
    ann, bob = _pair(lab, 0.02)
    lab.entries.clear()
    for i in range(60):
        lab.now_ns += 30 * MS
        T: PoseTuple = ((0.3 * math.sin(0.2 * i), -0.4 + 0.01 * i, 1.0), quat_from_yaw(0.1 * i))
        for one in (ann, bob) if i < 40 else (ann,):
            pose = Pose(*compose(inverse(one.frame), T))
            one.observe(Observation("anns-left", "controller", pose, lab.now_ns, 1))
    lab.now_ns += 6 * SECOND
    lab.turn(1500)
    (entry,) = lab.compared()
    assert isinstance(entry.message, CrossChecked)
    assert entry.message.error_m == pytest.approx(0.02, abs=0.012)
    assert not [m for m in (e.message for e in lab.entries) if isinstance(m, AlignmentProposal) and m.refused], (
        "no anchor, and none is missed"
    )


def test_controllers_of_an_earlier_tracking_epoch_take_no_room() -> None:
    """A headset may have four things that move; after it has recentred they may have other names."""
    lab = Lab()
    ann, _ = _pair(lab, 0.0)
    for epoch in (1, 2, 3):
        ann.epoch = epoch
        lab.now_ns += 100 * MS
        for i in range(5):
            pose = Pose(*compose(inverse(ann.frame), ((0.1 * i, -0.4, 1.0), IDENTITY.q)))
            ann.observe(Observation(f"thing {epoch} {i}", "controller", pose, lab.now_ns, epoch))
        assert lab.drops.by_reason["observation_unusable"] == epoch, "one in every epoch is one too many"


def test_the_covariance_in_force_is_stated_where_it_was_proposed() -> None:
    """Though looks at another sheet have moved the pivot of what is proposed meanwhile."""
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    accepted = ann.proposals()[-1]
    for _ in range(3):
        ann.watch(ann.place("other"), 15, "other")
    newest = ann.proposals()[-1]
    assert distance(newest.pivot_world, accepted.pivot_world) > 0.2
    lab.put_in_force(ann, accepted)
    in_force = lab.service._states[1].monitor.in_force
    assert in_force is not None
    assert in_force.pivot_world == accepted.pivot_world
    assert in_force.error_at(SHEET[0]) == pytest.approx(accepted.error_at_anchor_m)
    lab.put_in_force(ann, newest, covariance=tuple(2.0 * c for c in newest.covariance))
    sliding = lab.service._states[1].monitor.in_force
    assert sliding is not None
    assert sliding.pivot_world == newest.pivot_world


def test_a_front_that_was_started_anew_learns_from_a_snapshot_what_is_in_force() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    got = ann.proposals()[-1]
    fresh = Lab()
    bob = fresh.wearer()
    bob.frame = ann.frame
    alignment = lab.service._in_force["p1"]
    fresh.service.process_snapshot([ParticipantInfo("p1", "Ann", "operator", True, alignment=alignment)])
    bob.watch(bob.place(), 1)
    in_force = fresh.service._states[1].monitor.in_force
    assert in_force is not None
    assert in_force.T_world_tracking[0] == got.T_world_tracking.p


# --- bounds and strangers --------------------------------------------------------------------------------------------


def test_memory_is_bounded() -> None:
    lab = Lab()
    ann = lab.wearer()
    look = ann.place()
    for i in range(3000):
        lab.now_ns += 5 * MS
        ann.see(look)
        ann.observe(Observation(f"thing{i}", "controller", IDENTITY, lab.now_ns, 1))
        ann.observe(Observation(f"sheet{i}", "qr", IDENTITY, lab.now_ns, 1))
    person = lab.service._states[1]
    assert len(person.monitor.heads) <= 128
    assert len(lab.service._cross_check._moving[1]) <= 4
    assert len(lab.service._cross_check._check._observations) <= 5
    assert all(len(looks) <= 100 for looks in lab.service._cross_check._check._observations.values())
    assert set(person.estimator._observed) == {"sheet"}
    assert len(person.estimator._estimator._memory) <= 600
    for n in range(2000):
        lab.service.process_event(AlignmentRun(f"q{n}", False, 1))
    assert len(lab.service._stopped) <= 4 * 64


BAD = (math.nan, math.inf, -math.inf, 1e308, 1e-308, 0.0)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("bad", BAD)
def test_garbage_raises_nothing_and_makes_entries_that_can_be_sent(bad: float) -> None:
    lab = Lab()
    ann, bob = lab.wearer(1), lab.wearer(2)
    for one in (ann, bob):
        one.survey(2)
    poses = [
        Pose((bad, 0.0, 0.0), IDENTITY.q),
        Pose((0.0, 0.0, 1.0), (bad, 0.0, 0.0, 0.0)),
        Pose((bad,) * 3, (bad,) * 4),
    ]
    times = [-(2**63), 2**63 - 1, 0, lab.now_ns]
    for pose in poses:
        for ns in times:
            for epoch in (0, 1):
                for one in (ann, bob):
                    sample = Sample("head", "pose", 1, ns, 1, epoch, 0, pose=pose)
                    lab.service.process_sample(one.connection, sample, lab.now_ns)
                    for kind in ("qr", "board", "controller", "touch", "nonsense"):
                        for anchor in ("sheet", "other", "nothing"):
                            seen = Observation(anchor, kind, pose, ns, epoch, covariance=(bad,) * 36, quality=bad)
                            one.observe(seen)
                            one.observe(msgspec.structs.replace(seen, T_tracking_anchor=IDENTITY, size_m=bad))
                lab.now_ns += 300 * MS
                lab.turn(50)
    for one in (ann, bob):
        one.epoch = 2
        one.survey(2)
    assert misplaced_m(ann, ann.proposals()[-1]) < 0.02
    for entry in lab.entries:
        decode_entry(encode_entry(entry))


def test_the_report_of_both_halves() -> None:
    lab = Lab()
    ann = lab.wearer()
    half = AlignmentReport(version=7, pending_m=0.1)
    assert lab.service.complete_report(1, half, 0) is half
    ann.survey(2)
    ann.observe(Observation("sheet", "qr", Pose((math.nan, 0.0, 0.0), IDENTITY.q), lab.now_ns, 1))
    lab.now_ns += SECOND
    report = lab.service.complete_report(1, half, lab.now_ns)
    assert report is not None
    assert (report.version, report.pending_m) == (7, 0.1)
    assert (report.observations, report.unusable) == (30, 1)
    assert report.viewpoints == 2
    assert [(s.anchor_id, s.observations) for s in report.seen] == [("sheet", 30)]
    assert report.seen[0].age_ns >= SECOND
    assert "1 no poses" in report.advice
    alone = lab.service.complete_report(1, None, lab.now_ns)
    assert alone is not None
    assert alone.observations == 30


def test_a_proposal_of_the_same_instant_as_an_alarm_is_later() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    lab.now_ns += SECOND
    for x in (0.0, 1.0):
        lab.now_ns += 10 * MS
        ann.head(((x, 0.0, 1.6), IDENTITY.q))
    ann.observe(Observation("sheet", "qr", IDENTITY, lab.now_ns, 1))
    lab.service.tick(lab.now_ns)
    alarm, refusal = ann.entries()[-2:]
    assert isinstance(alarm.message, AlignmentAlarm)
    assert isinstance(refusal.message, AlignmentProposal)
    assert refusal.receive_ns > alarm.receive_ns


def test_looks_at_a_sheet_before_it_was_moved_blame_no_headset() -> None:
    lab = Lab()
    ann, bob = _pair(lab, 0.0)
    for one in (ann, bob):
        one.survey(3, ("sheet", "other"))
    looks = {name: ann.place(name, p_head_world=(0.6, 0.0, 1.3)) for name in ANCHORS}
    for i in range(50):
        if i == 25:
            lab.world["sheet"] = shifted(SHEET, (0.05, 0.0, 0.0))
        lab.now_ns += 100 * MS
        for name, look in looks.items():
            ann.see(look, name)
        lab.turn()
    assert [a.beside for a in ann.alarms()] == [("other",)]
    lab.entries.clear()
    lab.now_ns += 6 * SECOND
    ann.watch(ann.place("sheet", 0.5), 10)
    lab.turn(3000)
    assert [e.message.anchor_id for e in lab.compared() if isinstance(e.message, CrossChecked)] in ([], ["other"])
