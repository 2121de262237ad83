"""Sources that repeat poses, report the origin, number viewpoints badly or are late: through `AlignmentService`."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import count

import msgspec
import numpy as np
import pytest

from anchors.pose import PoseTuple, compose, interpolate_about_pivot, inverse, quat_from_yaw
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.status import AlignmentReport
from tests.alignment.emulated_headsets import MS, SECOND, SHEET, Lab, Wearer, error_at_anchor, head_in_tracking
from tests.anchors.worlds import Viewpoint, shifted, viewpoint_around


def _report(lab: Lab, ann: Wearer) -> AlignmentReport:
    report = lab.service.complete_report(ann.connection.number, None, lab.now_ns)
    assert report is not None
    return report


def _look(ann: Wearer, view: Viewpoint, repeats: int = 0, **fields: object) -> None:
    """Report one new pose, and the same again `repeats` times."""
    lab = ann.lab
    p, q = view.observe(ann.frame)
    for _ in range(1 + repeats):
        lab.now_ns += 100 * MS
        ann.report_head(head_in_tracking(ann.frame, view))
        seen = Observation("sheet", "qr", Pose(p, q), lab.now_ns, ann.epoch, ann.viewpoint)
        ann.observe(msgspec.structs.replace(seen, **fields))
        lab.poll()


@pytest.mark.parametrize("seed", range(3))
def test_repeats_never_change_the_estimate(seed: int) -> None:
    """Each pose up to five times, as often as chance wants, or once: the proposal is the same to the last bit."""
    solved = []
    for repeats in (5, 0):
        lab = Lab()
        ann, chance = lab.wearer(seed=seed), np.random.default_rng(seed)
        for _ in range(3):
            view = ann.place()
            for _ in range(8):
                end_ns = lab.now_ns + SECOND
                _look(ann, view, int(chance.integers(0, repeats + 1)))
                lab.now_ns = end_ns
                lab.poll()
        newest = ann.proposals()[-1]
        solved.append((newest.T_world_tracking, newest.covariance, newest.n_observations))
        assert ann.alarms() == []
        assert (_report(lab, ann).unusable > 0) == (repeats > 0)
    assert solved[0] == solved[1]


def test_frozen_source_confirms_nothing_and_does_not_outvote_real_looks() -> None:
    lab = Lab()
    ann = lab.wearer()
    ann.survey()
    view = ann.place(d=0.6)
    _look(ann, view, repeats=300)
    assert _report(lab, ann).unusable == 300
    assert "repeat" in _report(lab, ann).advice
    assert [e for e in ann.entries() if getattr(e.message, "refused", False)], "the wearer is told"
    ann.bump(0.02)
    for _ in range(12):
        _look(ann, view)
    assert error_at_anchor(ann, ann.proposals()[-1]) < 0.008


@pytest.mark.parametrize("q", [IDENTITY.q, (-1.0, 0.0, 0.0, 0.0)])
def test_poses_at_the_origin_never_align(q: tuple[float, float, float, float]) -> None:
    lab = Lab()
    ann = lab.wearer()
    for i in range(12):
        lab.now_ns += 100 * MS
        ann.report_head(((0.3, 0.0, 0.4 + 1e-4 * i), IDENTITY.q))
        ann.observe(Observation("sheet", "qr", Pose((0.0, 0.0, 0.0), q), lab.now_ns, ann.epoch, 1))
        ann.observe(Observation("sheet", "persistent", Pose((0.0, 0.0, 0.0), q), lab.now_ns, ann.epoch, 1))
        lab.poll()
    assert ann.proposals() == []
    assert _report(lab, ann).unusable == 24
    assert "origin" in _report(lab, ann).advice
    ann.survey()
    assert error_at_anchor(ann, ann.proposals()[-1]) < 0.01


@pytest.mark.parametrize("number", [next, lambda n: 0], ids=["each", "zero"])
@pytest.mark.parametrize("seed", [1])
def test_numbers_of_viewpoints_change_nothing(number: Callable[[count[int]], int], seed: int) -> None:
    solved = []
    for way in (lambda n: -1, number):
        lab, numbers = Lab(), count(1)
        ann = lab.wearer(seed=seed)
        for _ in range(3):
            view = ann.place()
            for _ in range(8):
                n = way(numbers)
                _look(ann, view, **({"viewpoint_id": n} if n >= 0 else {}))
        newest = ann.proposals()[-1]
        solved.append((newest.T_world_tracking, newest.covariance))
        assert ann.alarms() == []
    assert solved[0] == solved[1]


def test_new_number_at_every_look_without_head_poses_claims_no_independence() -> None:
    stated = {}
    for step in (1, 30):
        lab = Lab()
        ann = lab.wearer()
        for i in range(90):
            if i % 30 == 0:
                view = ann.place()
            lab.now_ns += 100 * MS
            p, q = view.observe(ann.frame)
            ann.observe(Observation("sheet", "qr", Pose(p, q), lab.now_ns, ann.epoch, 1 + i // step))
            lab.poll()
        stated[step] = ann.proposals()[-1].error_at_anchor_m
    assert stated[1] > stated[30]


def test_looks_while_walking_are_not_used_and_standing_still_mends_it() -> None:
    lab = Lab()
    ann = lab.wearer()
    p = np.array(SHEET[0])
    for i in range(200):  # round the sheet at 0.5 m/s, pictures 60 ms late
        lab.now_ns += 33 * MS
        at, before = ((0.8 * np.cos(0.6 * s), 0.8 * np.sin(0.6 * s), 0.6) for s in (0.033 * i, 0.033 * i - 0.06))
        turn = 0.6 * 0.033 * i
        T: PoseTuple = ((float(p[0] + at[0]), float(p[1] + at[1]), float(p[2] + at[2])), quat_from_yaw(turn))
        ann.report_head(_in_tracking(ann.frame, T))
        view = Viewpoint(ann.rng, SHEET, (float(p[0] + before[0]), float(p[1] + before[1]), float(p[2] + before[2])))
        seen = Pose(*view.observe(ann.frame))
        if i >= 5:
            ann.observe(Observation("sheet", "qr", seen, lab.now_ns, ann.epoch, i))
        lab.poll(1)
    assert ann.proposals() == []
    assert ann.alarms() == []
    assert "still" in _report(lab, ann).advice
    ann.survey()
    assert error_at_anchor(ann, ann.proposals()[-1]) < 0.01


def _in_tracking(frame: PoseTuple, T_world_head: PoseTuple) -> PoseTuple:
    return compose(inverse(frame), T_world_head)


@pytest.mark.parametrize("hz", [1.0, 5.0])
@pytest.mark.parametrize("seed", range(3))
def test_silent_jump_of_5_cm_is_reported_by_a_slow_source(hz: float, seed: int) -> None:
    lab = Lab()
    ann = lab.wearer(seed=seed)

    def look(view: Viewpoint, n: int) -> None:
        for _ in range(n):
            lab.now_ns += round(SECOND / hz) - 100 * MS
            _look(ann, view)

    for _ in range(3):
        look(ann.place(), 6)
    ann.accept()
    assert ann.alarms() == []
    turn = ann.rng.uniform(-math.pi, math.pi)
    ann.bump(0.05 * math.cos(turn), 0.05 * math.sin(turn))
    look(ann.place(), 6)
    assert [a.kind for a in ann.alarms()][:1] in (["jump"], ["changed"], ["differs"])
    look(ann.place(), 8)
    assert error_at_anchor(ann, ann.proposals()[-1]) < 0.015


@pytest.mark.parametrize(("hz", "weight"), [(1.0, 1.0), (3.0, 0.2)])
def test_slow_source_raises_no_false_alarm_in_half_an_hour(hz: float, weight: float) -> None:
    """`weight`: of a new pose; a wrong detection is smeared over those that follow."""
    lab = Lab()
    ann = lab.wearer(seed=7)
    drift = np.array([0.6, -0.5, 0.6]) * 0.003 / 60.0
    last: PoseTuple | None = None
    for minute in range(30):
        view = Viewpoint(ann.rng, SHEET, viewpoint_around(ann.rng, SHEET[0], ann.rng.uniform(0.4, 1.2)))
        for _ in range(8):
            lab.now_ns += round(SECOND / hz)
            ann.frame = shifted(ann.frame, (float(drift[0]), float(drift[1]), float(drift[2])))
            ann.report_head(head_in_tracking(ann.frame, view))
            p, q = view.observe(ann.frame)
            if ann.rng.random() < 0.05:
                p = (p[0] + ann.rng.normal(0.0, 0.25), p[1] + ann.rng.normal(0.0, 0.25), p[2])
            last = (p, q) if last is None else interpolate_about_pivot(last, (p, q), (0.0, 0.0, 0.0), weight)
            ann.observe(Observation("sheet", "qr", Pose(*last), lab.now_ns, ann.epoch, minute))
            lab.poll(1)
        ann.accept()
    assert ann.alarms() == []
