"""`AlignmentService` without a network: emulated headsets in, entries for the authority out."""

from __future__ import annotations

import math
from itertools import pairwise

import msgspec
import pytest

from anchors.pose import PoseTuple, apply, compose, inverse, quat_from_yaw
from anchors.uncertainty import isotropic_covariance
from iris_session.alignment.estimator import LATE
from iris_session.protocol.client_messages import Observation, Sample
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import AlignmentAlarm, AlignmentProposal, CrossChecked, decode_entry, encode_entry
from iris_session.protocol.names import AlarmKind
from iris_session.protocol.server_messages import AlignmentRun, AnchorInfo, AnchorMoved, ParticipantInfo
from iris_session.protocol.status import AlignmentReport
from tests.alignment.emulated_headsets import ANCHORS, MS, SECOND, SHEET, Lab, Wearer, error_at_anchor, head_in_tracking
from tests.anchors.worlds import shifted


@pytest.mark.parametrize("seed", range(2))
def test_bump_of_5_cm_raises_a_jump_alarm_within_3_detections_and_restarts_alignment(seed: int) -> None:
    lab = Lab()
    ann = lab.wearer(seed=seed)
    ann.survey()
    view = ann.place(d=0.7)
    ann.report_observations(view, 20)
    assert ann.alarms() == []
    before = len(ann.entries())
    ann.bump(0.03, 0.03, 0.026)
    ann.report_observations(view, 3)
    (alarm,) = ann.alarms()
    assert (alarm.kind, alarm.anchor_id, alarm.tracking_epoch) == ("jump", "sheet", 1)
    assert alarm.size_m == pytest.approx(0.05, abs=0.01)
    ann.report_observations(view, 20)
    entries = ann.entries()[before:]
    at = [isinstance(e.message, AlignmentAlarm) for e in entries].index(True)
    later = [e for e in entries[at + 1 :] if isinstance(e.message, AlignmentProposal) and not e.message.refused]
    assert later
    for entry in later:
        assert entry.receive_ns > entries[at].receive_ns
        assert error_at_anchor(ann, entry.message) < 0.015, "only what was seen after the bump counts"
    assert all(e.receive_ns <= entries[at].receive_ns for e in entries[:at])


def test_moved_sheet_is_reported_without_restarting_alignment() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey(3, ("sheet", "other"))
    views = {name: ann.place(name, p_head_world=(0.6, 0.0, 1.3)) for name in ANCHORS}
    for i in range(50):
        if i == 25:
            lab.world["sheet"] = shifted(SHEET, (0.05, 0.0, 0.0))
        lab.now_ns += 100 * MS
        for name, view in views.items():
            ann.report_observation(view, name)
        lab.poll()
    assert [(a.kind, a.anchor_id, a.beside) for a in ann.alarms()] == [("changed", "sheet", ("other",))]
    assert ann.proposals()[-1].n_observations > 100, "what was seen before the sheet was moved still counts"
    ann.report_observations(ann.place("sheet", 0.5), 30)
    assert len(ann.alarms()) == 1, "the moved sheet was reported"
    there = ann.place("sheet", 0.5)
    ann.report_observations(there, 25)
    lab.world["sheet"] = shifted(SHEET, (0.08, 0.0, 0.0))
    ann.report_observations(there, 25)
    assert len(ann.alarms()) == 2, "without another sheet in sight it may be the headset: reported again"


@pytest.mark.parametrize("fields", [{"offset": True}, {"kind": "placed"}])
def test_placed_alignment_is_not_contradicted_by_a_sheet(fields: dict[str, object]) -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    got = ann.proposals()[-1]
    pose = Pose(*shifted((got.T_world_tracking.p, got.T_world_tracking.q), (0.3, 0.0, 0.0)))
    lab.service.process_event(AlignmentRun("p1", False, 1))  # no estimate supports it
    lab.confirm(ann, got, T_world_tracking=pose, **fields)
    ann.report_observations(ann.place(d=0.5), 40)
    assert ann.alarms() == []
    lab.confirm(ann, got, T_world_tracking=pose)
    ann.report_observations(ann.place(d=0.5), 40)
    assert [a.kind for a in ann.alarms()] == ["differs"], "had it been measured, it would be wrong"


def test_head_jump_alarms_are_immediate_and_limited_to_one_per_second() -> None:
    lab = Lab()
    ann = lab.wearer()
    for i in range(200):  # 2 s with a jump between every two samples
        lab.now_ns += 10 * MS
        ann.report_head(((0.5 * (i % 2), 0.0, 1.6), (1.0, 0.0, 0.0, 0.0)))
    assert {a.kind for a in ann.alarms()} == {"jump"}
    assert 1 <= len(ann.alarms()) <= 3
    assert lab.drops.by_reason["alarms_repeated"] > 50


def test_observations_from_before_a_jump_are_ignored_after_it() -> None:
    """A detection is tenths of a second old when it arrives; the head shows the jump within a frame."""
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    view = ann.place(d=0.6)
    ann.report_observations(view, 5)
    seen_at_ns, old_frame, before = lab.now_ns, ann.frame, len(ann.entries())
    lab.now_ns += 10 * MS
    ann.bump(0.5)
    ann.report_head(head_in_tracking(ann.frame, view))
    assert [a.kind for a in ann.alarms()] == ["jump"]
    for i in range(10):
        lab.now_ns += 30 * MS
        p, q = view.observe(old_frame, lab.world["sheet"])
        ann.observe(Observation("sheet", "qr", Pose(p, q), seen_at_ns + i * MS, ann.epoch, ann.viewpoint))
        lab.poll()
    assert lab.drops.by_reason["observation_before_jump"] == 10
    assert not [e for e in ann.entries()[before:] if isinstance(e.message, AlignmentProposal)]
    ann.report_observations(view, 15)
    assert error_at_anchor(ann, ann.proposals()[-1]) < 0.015


def test_stopped_run_is_monitored_without_proposals_and_a_new_run_starts_empty() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    lab.service.process_event(AlignmentRun("p1", False, 1))
    view, before = ann.place(d=0.6), len(ann.proposals())
    ann.report_observations(view, 20)
    assert len(ann.proposals()) == before
    ann.bump(0.05, 0.05)
    ann.report_observations(view, 5)
    assert [a.kind for a in ann.alarms()] == ["jump"]
    lab.service.process_event(AlignmentRun("p1", True, 2))
    ann.report_observations(view, 3)
    assert len(ann.proposals()) == before, "too few observations in the new run"
    ann.report_observations(view, 10)
    assert ann.proposals()[-1].n_observations <= 13
    assert error_at_anchor(ann, ann.proposals()[-1]) < 0.015


def test_moved_anchor_is_proposed_at_its_new_pose_without_a_new_observation() -> None:
    lab = Lab({"sheet": SHEET})
    ann = lab.wearer()
    ann.survey()
    lab.poll(500)
    before = ann.proposals()[-1]
    moved: PoseTuple = ((1.2, 0.4, 0.9), quat_from_yaw(2.5))
    lab.service.process_event(AnchorMoved("sheet", Pose(*moved)))
    lab.poll(500)
    after = ann.proposals()[-1]
    expected = compose(compose(moved, inverse(SHEET)), (before.T_world_tracking.p, before.T_world_tracking.q))
    assert math.dist(after.T_world_tracking.p, expected[0]) < 1e-3
    lab.world["sheet"] = moved
    ann.frame = (after.T_world_tracking.p, after.T_world_tracking.q)
    ann.report_observations(ann.place(d=0.5), 20)  # the old alignment is still in force: nothing to report
    assert ann.alarms() == []


def test_controller_in_its_holder_is_an_anchor() -> None:
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
                lab.poll()
        stated[kind] = ann.proposals()[-1].error_at_anchor_m
        assert error_at_anchor(ann, ann.proposals()[-1]) < 0.003
    assert stated["controller"] < 0.6 * stated["qr"], (
        "1.5 mm per axis and a bias of 2 mm, not the 5 mm of a sheet seen from nowhere"
    )


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
    exact = tuple(isotropic_covariance(0.0015, 0.01).ravel().tolist())
    ann.observe(Observation(point, "touch", pose, ann.lab.now_ns, ann.epoch, covariance=exact))
    ann.lab.poll()


def _failures(ann: Wearer) -> list[str]:
    messages = [e.message for e in ann.entries()]
    return [m.advice for m in messages if isinstance(m, AlignmentProposal) and m.refused]


def test_swapped_points_are_named_and_can_be_touched_again() -> None:
    lab = Lab(MARKS)
    ann = lab.wearer()
    for point, at in zip("abcd", "bacd", strict=True):
        _touch(ann, point, at)
    assert ann.proposals() == []
    assert "touched at 'b'" in _failures(ann)[-1]
    for point in "ab":
        _touch(ann, point)
    assert error_at_anchor(ann, ann.proposals()[-1], "d") < 0.004, "what was touched wrongly is replaced"


def test_touched_alignment_is_not_replaced_by_a_less_accurate_one() -> None:
    lab = Lab(MARKS)
    ann = lab.wearer()
    for point in "abcd":
        _touch(ann, point)
    touched = ann.proposals()
    ann.report_observations(ann.place("a", 1.2), 20, "a")
    assert ann.proposals() == touched
    ann.epoch = 2
    ann.report_observations(ann.place("a", 0.6), 20, "a")
    assert len(ann.proposals()) > len(touched)


# --- two headsets ----------------------------------------------------------------------------------------------------


def _pair(lab: Lab, off: float) -> tuple[Wearer, Wearer]:
    """Two aligned headsets, the second wrong by `off` [m]."""
    ann, bob = lab.wearer(1), lab.wearer(2)
    for one in (ann, bob):
        one.survey(4)
    got = bob.proposals()[-1]
    pose = Pose(*shifted((got.T_world_tracking.p, got.T_world_tracking.q), (off, 0.0, 0.0)))
    lab.confirm(bob, got, T_world_tracking=pose, offset=True)
    return ann, bob


def test_cross_check_measures_a_planted_difference_of_20_mm() -> None:
    lab = Lab()
    ann, bob = _pair(lab, 0.02)
    lab.entries.clear()
    views = ann.place(d=0.5), bob.place(d=0.5)
    since_ns = lab.now_ns
    while lab.now_ns < since_ns + 21 * SECOND:
        lab.now_ns += 100 * MS
        for one, view in zip((ann, bob), views, strict=True):
            one.report_observation(view)
        lab.poll(20)
    found = lab.cross_checks()
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
        lab.poll(20)
    assert len(lab.cross_checks()) <= before + 1, "nobody looked any more"


def test_shared_controller_is_compared_at_equal_times() -> None:
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
    lab.poll(1500)
    (entry,) = lab.cross_checks()
    assert isinstance(entry.message, CrossChecked)
    assert entry.message.error_m == pytest.approx(0.02, abs=0.012)
    assert not [m for m in (e.message for e in lab.entries) if isinstance(m, AlignmentProposal) and m.refused], (
        "no anchor, and none is missed"
    )


def test_a_point_that_both_wearers_touch_measures_their_pair_once_per_touch() -> None:
    lab = Lab()
    ann, bob = _pair(lab, 0.02)
    lab.entries.clear()
    for one, device in ((ann, "hand/right"), (bob, "controller/right")):
        p = apply(inverse(one.frame), (1.2, 0.1, 0.7))
        one.observe(Observation("cross", "point", Pose(p, IDENTITY.q), lab.now_ns, 1, device=device))
        lab.now_ns += SECOND
    view = ann.place(d=0.5), bob.place(d=0.5)
    for _ in range(20):
        lab.now_ns += SECOND
        for one, at in zip((ann, bob), view, strict=True):
            one.report_observation(at)
        lab.poll(20)
    found = [m for m in (entry.message for entry in lab.cross_checks()) if isinstance(m, CrossChecked)]
    assert len(found) > 2, "looks at the sheet are compared meanwhile"
    (message,) = [one for one in found if one.touched]
    assert (message.anchor_id, message.n) == ("cross", 1)
    assert message.error_m == pytest.approx(0.02, abs=0.012)
    assert message.expected_p95_m > 0.02, "two fingertips"
    assert lab.drops.by_reason.get("observation_unusable", 0) == 0
    eve = lab.wearer(3)
    eve.observe(Observation("cross", "point", IDENTITY, lab.now_ns, 1, device="hand/right"))
    eve.observe(Observation("cross", "point", Pose((1.0, 0.0, 0.0), IDENTITY.q), lab.now_ns, 1, device="hand/right"))
    assert lab.drops.by_reason["observation_unusable"] == 2, "a zero pose, and one that is not aligned"


def test_restarted_front_restores_alignment_in_force_from_a_snapshot() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    got = ann.proposals()[-1]
    fresh = Lab()
    bob = fresh.wearer()
    bob.frame = ann.frame
    alignment = lab.service._in_force["p1"]
    fresh.service.process_snapshot([ParticipantInfo("p1", "Ann", "operator", True, alignment=alignment)], ())
    bob.report_observations(bob.place(), 1)
    in_force = fresh.service._states[1].monitor.in_force
    assert in_force is not None
    assert in_force.T_world_tracking[0] == got.T_world_tracking.p


def test_anchor_that_was_moved_while_the_front_was_replaced_is_taken_from_the_first_snapshot() -> None:
    lab = Lab()
    name, (p, q) = next(iter(lab.service.anchors.items()))
    lab.service.process_snapshot((), [AnchorInfo(name, Pose((p[0] + 1.0, p[1], p[2]), q))])
    assert lab.service.anchors[name] == ((p[0] + 1.0, p[1], p[2]), q)
    # Later ones may be older than an event that has come.
    lab.service.process_snapshot((), [AnchorInfo(name, Pose(p, q))])
    assert lab.service.anchors[name] == ((p[0] + 1.0, p[1], p[2]), q)


# --- bounds and hostile input ----------------------------------------------------------------------------------------


def test_memory_is_bounded() -> None:
    lab = Lab()
    ann = lab.wearer()
    view = ann.place()
    for i in range(3000):
        lab.now_ns += 5 * MS
        ann.report_observation(view)
        ann.observe(Observation(f"thing{i}", "controller", IDENTITY, lab.now_ns, 1))
        ann.observe(Observation(f"sheet{i}", "qr", IDENTITY, lab.now_ns, 1))
    person = lab.service._states[1]
    assert len(person.monitor.heads) <= 128
    assert len(lab.service._cross_check._check.list_targets("1")) <= 5
    assert len(lab.service._cross_check._check._observations) <= 5
    assert all(len(views) <= 100 for views in lab.service._cross_check._check._observations.values())
    assert set(person.estimator._observed) == {"sheet"}
    assert len(person.estimator._estimator._memory) <= 600
    for n in range(2000):
        lab.service.process_event(AlignmentRun(f"q{n}", False, 1))
    assert len(lab.service._stopped) <= 4 * 64


BAD = (math.nan, math.inf, 1e308, 0.0)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@pytest.mark.parametrize("bad", BAD)
def test_invalid_input_never_raises_and_entries_can_be_encoded(bad: float) -> None:
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
                    for kind in ("qr", "board", "controller", "touch", "persistent", "nonsense"):
                        for anchor in ("sheet", "other", "nothing"):
                            seen = Observation(anchor, kind, pose, ns, epoch, covariance=(bad,) * 36, quality=bad)
                            one.observe(seen)
                            one.observe(msgspec.structs.replace(seen, T_tracking_anchor=IDENTITY, size_m=bad))
                    one.observe(Observation("", "tip", pose, ns, epoch, device="hand/left", grip_poses=(pose,) * 30))
                lab.now_ns += 300 * MS
                lab.poll(50)
    for one in (ann, bob):
        one.epoch = 2
        one.survey(2)
    assert error_at_anchor(ann, ann.proposals()[-1]) < 0.02
    for entry in lab.entries:
        decode_entry(encode_entry(entry))


def test_report_combines_front_and_authority() -> None:
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


def test_a_proposal_says_what_was_looked_at_and_an_alarm_where_the_sheet_is_now() -> None:
    lab = Lab()
    ann = lab.wearer()
    began_ns = lab.now_ns
    ann.survey(2, ("sheet", "other"))
    looks = {one.anchor_id: one for one in ann.proposals()[-1].looks}
    assert looks.keys() == {"sheet", "other"}
    assert began_ns < looks["sheet"].first_ns < looks["other"].first_ns
    assert lab.now_ns - SECOND < looks["other"].last_ns <= lab.now_ns
    lab = Lab({"sheet": SHEET})
    ann = lab.wearer()
    ann.survey()
    lab.now_ns += 60 * SECOND
    lab.world["sheet"] = shifted(SHEET, (0.04, -0.03, 0.0))
    bumped_ns = lab.now_ns
    ann.report_observations(ann.place(d=0.5), 15)
    (alarm,) = ann.alarms()
    assert alarm.shift_m == pytest.approx((0.04, -0.03, 0.0), abs=0.012)
    (look,) = ann.proposals()[-1].looks
    assert look.first_ns > bumped_ns, "earlier looks are discarded"


def test_two_prints_of_one_id_are_refused_by_name() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    for i in range(8):
        lab.world["sheet"] = shifted(SHEET, (0.6 * (i % 2), 0.0, 0.0))
        ann.report_observations(ann.place(d=0.6), 8)
        lab.now_ns += 2 * SECOND
        lab.poll()
    alarm = ann.alarms()[-1]
    assert (alarm.kind, alarm.anchor_id) == (AlarmKind.TWO_PLACES, "sheet")
    assert alarm.size_m == pytest.approx(0.6, abs=0.03)
    assert [a.kind for a in ann.alarms()].count(AlarmKind.TWO_PLACES) == 1
    refused = [e.message for e in ann.entries() if isinstance(e.message, AlignmentProposal)][-1]
    assert refused.refused
    assert "'sheet'" in refused.advice
    known = len(ann.proposals())
    ann.report_observations(ann.place(d=0.6), 20)
    assert len(ann.proposals()) == known, "nobody knows which one is meant"
    ann.report_observations(ann.place("other", d=0.6), 20, "other")
    assert {one.anchor_id for one in ann.proposals()[-1].looks} == {"other"}
    lab.now_ns += 130 * SECOND
    lab.world["sheet"] = SHEET  # the second print was thrown away
    ann.report_observations(ann.place(d=0.6), 20)
    assert "sheet" in {one.anchor_id for one in ann.proposals()[-1].looks}


def test_estimate_without_a_new_look_says_when_its_newest_look_was() -> None:
    lab = Lab(sizes={"sheet": 0.16})
    ann = lab.wearer()
    ann.survey()
    looked_ns = ann.proposals()[-1].looked_ns
    assert lab.now_ns - SECOND < looked_ns <= lab.now_ns
    lab.now_ns += 60 * SECOND
    x, y, z = ANCHORS["other"][0]
    lab.service.process_event(AnchorMoved("other", Pose((x, y, z + 0.001), ANCHORS["other"][1]), "boss"))
    lab.poll(300)
    p, q = ann.place().observe(ann.frame)
    ann.observe(Observation("sheet", "qr", Pose(p, q), lab.now_ns, ann.epoch, size_m=0.2))
    lab.poll(300)
    assert "200 mm" in ann.proposals()[-1].advice
    assert ann.proposals()[-1].looked_ns == looked_ns
    began_ns = lab.now_ns
    ann.report_observations(ann.place(), 10)
    assert began_ns < ann.proposals()[-1].looked_ns <= lab.now_ns


@pytest.mark.parametrize("kind", ["qr", "touch", "persistent", "controller"])
@pytest.mark.parametrize("late_ns", [6 * SECOND, -6 * SECOND])
def test_what_was_not_captured_just_now_is_refused(kind: str, late_ns: int) -> None:
    lab = Lab()
    ann = lab.wearer()
    view = ann.place()
    for i in range(10):
        lab.now_ns += 10 * SECOND
        p, q = view.observe(ann.frame)
        ann.observe(Observation("sheet", kind, Pose(p, q), lab.now_ns - late_ns, ann.epoch, device="controller/right"))
        lab.poll()
        assert lab.drops.by_reason["observation_unusable"] == i + 1
    assert ann.proposals() == []
    report = lab.service.complete_report(1, None, lab.now_ns)
    assert report is not None
    assert (report.observations, report.unusable) == (0, 10)
    assert LATE in report.advice
    told = [e.message for e in ann.entries() if isinstance(e.message, AlignmentProposal) and LATE in e.message.advice]
    assert len(told) == (kind in ("touch", "persistent")), "at once, to who waits for an answer"
