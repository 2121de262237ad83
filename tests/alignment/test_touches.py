"""Tips, marks, fingertips and kept anchors: what a client reports becomes proposals of the right kind, with advice."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchors.lie import Array, quat_exp, quat_to_matrix
from anchors.pose import PoseTuple, Vec3, apply, compose, distance, inverse, quat_from_rotvec
from anchors.sheet import compute_marks
from anchors.uncertainty import isotropic_covariance
from iris_session.alignment.service import MAX_WAITING_TIPS, TIP_PERIOD_NS
from iris_session.alignment.touches import FINGERTIP_SIGMA_M, MAX_POINTS, TouchEstimator
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import AlignmentProposal, Entry, TipSolved, decode_entry, encode_entry
from iris_session.protocol.server_messages import ParticipantLeft, TipCalibrated
from tests.alignment.emulated_headsets import ANCHORS, SECOND, SHEET, Lab, Wearer

MARKS = {"sheet": compute_marks(0.14)}
RIGHT = "controller/right"
TIP: Vec3 = (0.01, -0.02, -0.12)
ROBOT: Vec3 = (0.4, 0.0, 0.9)
EARLIER = tuple(isotropic_covariance(0.001, math.radians(0.2)).ravel().tolist())


def _lab() -> tuple[Lab, Wearer]:
    lab = Lab(marks=MARKS)
    return lab, lab.wearer()


def _mark(name: str) -> Vec3:
    return apply(SHEET, MARKS["sheet"][name])


def _turning_poses(n: int = 60, range_rad: float = 0.6, sigma_m: float = 0.001, seed: int = 3) -> tuple[Pose, ...]:
    """Return poses of a controller that is turned while its tip stays in place."""
    rng = np.random.default_rng(seed)
    q = quat_exp(rng.uniform(-range_rad, range_rad, (n, 3)))
    p = np.array([0.3, 0.1, -0.4]) - quat_to_matrix(q) @ np.array(TIP) + rng.normal(0.0, sigma_m, (n, 3))
    return tuple(_to_pose(at, turn) for at, turn in zip(p, q, strict=True))


def _to_pose(p: Array, q: Array) -> Pose:
    (x, y, z), (qw, qx, qy, qz) = p.tolist(), q.tolist()
    return Pose((x, y, z), (qw, qx, qy, qz))


def _report_tip(ann: Wearer, poses: tuple[Pose, ...], device: str = RIGHT) -> None:
    ann.observe(Observation("", "tip", IDENTITY, ann.lab.now_ns, ann.epoch, device=device, grip_poses=poses))
    ann.lab.poll()


def _solved(ann: Wearer) -> list[TipSolved]:
    return [e.message for e in ann.entries() if isinstance(e.message, TipSolved)]


def _calibrate(ann: Wearer, device: str = RIGHT) -> None:
    """Calibrate the tip of a device and return the event of the authority to the service."""
    ann.lab.now_ns += TIP_PERIOD_NS
    _report_tip(ann, _turning_poses(), device)
    found = _solved(ann)[-1]
    assert not found.refused
    ann.lab.service.process_event(
        TipCalibrated(ann.connection.participant_id, device, found.p_grip_tip, found.covariance)
    )


def _position_covariance(sigma_m: float) -> tuple[float, ...]:
    """Return a covariance of a position alone: nothing is stated about the rotation."""
    return tuple(np.diag([sigma_m**2] * 3 + [0.0] * 3).ravel().tolist())


def _touch(ann: Wearer, mark: str, device: str = RIGHT, covariance: tuple[float, ...] = (), off_m: float = 0.0) -> None:
    ann.lab.now_ns += SECOND
    x, y, z = apply(inverse(ann.frame), _mark(mark))
    pose = Pose((x + off_m, y, z), IDENTITY.q)
    seen = Observation(
        "sheet", "touch", pose, ann.lab.now_ns, ann.epoch, device=device, covariance=covariance, mark=mark
    )
    ann.observe(seen)
    ann.lab.poll()


def _keep(ann: Wearer, off_m: float = 0.0) -> None:
    """Report where the sheet lies by an anchor that the device kept."""
    (x, y, z), q = compose(inverse(ann.frame), SHEET)
    pose = Pose((x + off_m, y, z), q)
    ann.observe(Observation("sheet", "persistent", pose, ann.lab.now_ns, ann.epoch, covariance=EARLIER))
    ann.lab.poll()


def _error_at(ann: Wearer, got: AlignmentProposal, point: Vec3) -> float:
    T: PoseTuple = (got.T_world_tracking.p, got.T_world_tracking.q)
    return distance(apply(T, apply(inverse(ann.frame), point)), point)


def _advice(ann: Wearer) -> str:
    refused = [e.message for e in ann.entries() if isinstance(e.message, AlignmentProposal) and e.message.refused]
    return refused[-1].advice


# --- tips ---


def test_tip_is_calibrated_with_its_error() -> None:
    _, ann = _lab()
    _report_tip(ann, _turning_poses())
    (found,) = _solved(ann)
    assert not found.refused
    assert (found.device, len(found.covariance)) == (RIGHT, 9)
    assert 40 <= found.n_poses <= 60
    assert distance(found.p_grip_tip, TIP) < found.error_m < 0.003


def test_a_flood_of_tips_is_bounded_and_counted() -> None:
    lab, ann = _lab()
    for n in range(50):
        ann.observe(Observation("", "tip", IDENTITY, n, 1, device=f"controller/{n % 10}", grip_poses=_turning_poses()))
    assert len(lab.service._states[1].tips) == MAX_WAITING_TIPS
    for _ in range(20):
        lab.poll(3)
    assert len(_solved(ann)) == 1, "one in half a second"
    lab.now_ns += TIP_PERIOD_NS
    lab.poll(2)
    assert len(_solved(ann)) == 2
    ann.observe(Observation("", "tip", IDENTITY, 1, 1, device=_solved(ann)[0].device))
    ann.observe(Observation("", "tip", IDENTITY, 2, 1, device=_solved(ann)[0].device))
    assert lab.drops.by_reason["tip_superseded"] == 1
    assert lab.drops.by_reason["tip_waiting"] == 46


NUMBER = st.floats() | st.sampled_from([1e308, -1e308, 1e-308, 0.0, 1.0])
POSE = st.builds(
    Pose, st.tuples(NUMBER, NUMBER, NUMBER), st.tuples(NUMBER, NUMBER, NUMBER, NUMBER) | st.just(IDENTITY.q)
)


@pytest.mark.filterwarnings("ignore::RuntimeWarning")
@settings(max_examples=30, deadline=None)
@given(st.lists(POSE, max_size=40), st.lists(st.tuples(st.sampled_from("1239"), POSE, NUMBER), max_size=8), POSE)
def test_nothing_that_is_reported_raises(poses: list[Pose], touches: list[tuple[str, Pose, float]], kept: Pose) -> None:
    lab, ann = _lab()
    _report_tip(ann, (*poses, *_turning_poses(25)))
    ann.observe(Observation("sheet", "persistent", kept, 1, 1, covariance=(kept.p[0],) * 36))
    for mark, pose, number in touches:
        device = RIGHT if number > 0.0 else "hand/left"
        ann.observe(Observation("sheet", "touch", pose, 1, 1, device=device, covariance=(number,) * 36, mark=mark))
        lab.poll()
        lab.now_ns += SECOND
    for entry in lab.entries:
        assert isinstance(decode_entry(encode_entry(entry)), Entry)


# --- touches of marks ---


@pytest.mark.parametrize("device", ["hand/right", RIGHT, "Controller/right"])
def test_fingertips_and_tips_that_are_not_calibrated_make_an_alignment_to_look_with(device: str) -> None:
    _, ann = _lab()
    for mark in "1234":
        _touch(ann, mark, device)
    got = ann.proposals()[-1]
    assert got.kind == "fingertip"
    assert 0.008 < got.error_at_anchor_m < 0.03


def test_no_client_can_state_that_its_finger_is_exact() -> None:
    _, ann = _lab()
    exact = tuple(isotropic_covariance(1e-5, 1e-3).ravel().tolist())
    for mark in "123":
        _touch(ann, mark, "hand/left", exact)
    assert ann.proposals()[-1].kind == "fingertip"
    _, bob = _lab()
    for mark in "123":
        _touch(bob, mark, RIGHT, exact)
    assert bob.proposals()[-1].kind == "measured", "a tip that was calibrated before, with its covariance"
    assert bob.proposals()[-1].error_at_anchor_m > 0.0005


@pytest.mark.parametrize(("sigma_m", "kind"), [(0.02, "fingertip"), (0.001, "measured")])
def test_covariance_of_a_touch_counts_when_it_states_a_position_alone(sigma_m: float, kind: str) -> None:
    _, ann = _lab()
    _calibrate(ann)
    for mark in "1234":
        _touch(ann, mark, covariance=_position_covariance(sigma_m))
    got = ann.proposals()[-1]
    assert got.kind == kind
    assert got.error_at_anchor_m > sigma_m


@pytest.mark.parametrize("wrong", [(0.001,) * 9, (math.nan,) * 36, _position_covariance(0.0), (-1e-6,) * 36])
def test_touch_with_an_invalid_covariance_is_refused_with_advice(wrong: tuple[float, ...]) -> None:
    lab, ann = _lab()
    _calibrate(ann)
    for mark in "123":
        _touch(ann, mark, covariance=wrong)
    assert ann.proposals() == []
    assert _advice(ann).startswith("the covariance of the touch of 'sheet/3' is not 36 values with a finite")
    assert lab.drops.by_reason["observation_unusable"] == 3


def test_another_calibration_discards_the_touches_with_the_old_tip() -> None:
    _, ann = _lab()
    for mark in "123":
        _touch(ann, mark)
    assert ann.proposals()[-1].kind == "fingertip"
    _calibrate(ann)
    n = len(ann.proposals())
    for mark in "12":
        _touch(ann, mark)
    assert len(ann.proposals()) == n
    _touch(ann, "3")
    assert ann.proposals()[-1].kind == "measured"


def test_tip_is_remembered_over_a_reconnect_until_its_participant_leaves() -> None:
    lab, ann = _lab()
    _calibrate(ann)
    lab.service.remove_connection(1)
    for mark in "123":
        _touch(ann, mark)
    assert ann.proposals()[-1].kind == "measured"
    lab.service.remove_connection(1)
    lab.service.process_event(ParticipantLeft(ann.connection.participant_id, "left", False))
    for mark in "123":
        _touch(ann, mark)
    assert ann.proposals()[-1].kind == "fingertip"


def test_status_says_which_mark_to_touch_next() -> None:
    lab, ann = _lab()
    for mark, following in (("1", "3"), ("3", "4")):
        _touch(ann, mark)
        report = lab.service.complete_report(1, None, lab.now_ns)
        assert report is not None
        assert report.advice.endswith(f"touch 'sheet/{following}' next")


def test_unknown_mark_is_refused_with_those_that_are_known() -> None:
    lab, ann = _lab()
    ann.observe(Observation("sheet", "touch", Pose((0.0, 0.0, 0.1), IDENTITY.q), lab.now_ns, 1, device=RIGHT, mark="9"))
    lab.poll()
    assert _advice(ann).startswith("anchor 'sheet' has no mark '9'; known: 1, 2, 3, 4")
    assert lab.drops.by_reason["observation_unusable"] == 1


def test_touches_are_bounded() -> None:
    many = {"sheet": {str(n): (0.01 * n, 0.03 * (n % 3), 0.0) for n in range(16)}}
    touches = TouchEstimator(ANCHORS, many, {})
    for n in range(200):
        assert touches.add_touch(Observation("sheet", "touch", IDENTITY, n, 1, device=RIGHT, mark=str(n % 16)), n)
    assert len(touches._touches) == MAX_POINTS
    assert max(len(kept) for kept in touches._touches.values()) <= 5
    assert touches._touches[next(iter(touches._touches))][0].sigma_m == FINGERTIP_SIGMA_M


# --- kept anchors ---


def test_kept_anchor_is_for_looking_until_a_mark_is_touched() -> None:
    _, ann = _lab()
    _keep(ann)
    got = ann.proposals()[-1]
    assert got.kind == "persistent"
    assert _error_at(ann, got, SHEET[0]) < 0.005
    assert got.error_at_anchor_m > 0.02, "inflated"
    _calibrate(ann)
    _touch(ann, "1")
    confirmed = ann.proposals()[-1]
    assert confirmed.kind == "measured"
    assert confirmed.error_at_anchor_m < 0.5 * got.error_at_anchor_m


def test_kept_anchor_that_stays_is_proposed_once() -> None:
    lab, ann = _lab()
    for n in range(30):
        lab.now_ns += SECOND // 10
        _keep(ann, off_m=0.0001 * (n % 3))
    assert len(ann.proposals()) == 1
    _keep(ann, off_m=0.01)
    lab.now_ns += SECOND
    lab.poll()
    assert len(ann.proposals()) == 2


def test_fingertips_that_contradict_a_kept_anchor_are_believed_from_three_on() -> None:
    _, ann = _lab()
    _keep(ann, off_m=1.0)
    for mark in "12":
        _touch(ann, mark, "hand/left")
        assert "from where the kept anchor says: touch it again, or touch three marks" in _advice(ann)
    assert [got.kind for got in ann.proposals()] == ["persistent"]
    _touch(ann, "3", "hand/left")
    got = ann.proposals()[-1]
    assert got.kind == "fingertip"
    assert _error_at(ann, got, _mark("4")) < 0.01
    assert "contradict the kept anchor: it is not used" in got.advice


def test_kept_anchor_that_a_mark_contradicts_is_refused_and_three_marks_align_without_it() -> None:
    _, ann = _lab()
    _calibrate(ann)
    _keep(ann, off_m=0.12)
    _touch(ann, "1")
    assert "from where the kept anchor says: touch it again, or touch three marks" in _advice(ann)
    assert ann.proposals()[-1].kind == "persistent"
    for mark in "34":
        _touch(ann, mark)
    assert "from where the kept anchor says" in _advice(ann)
    _touch(ann, "1")
    got = ann.proposals()[-1]
    assert got.kind == "measured"
    assert _error_at(ann, got, ROBOT) < 0.01


def test_kept_anchor_of_an_old_tracking_frame_or_on_a_wall_is_not_used() -> None:
    lab, ann = _lab()
    ann.epoch = 2
    _touch(ann, "1")
    ann.epoch = 1
    _keep(ann)
    ann.epoch = 2
    on_a_wall = Pose((0.0, 0.0, 0.0), quat_from_rotvec((1.4, 0.0, 0.0)))
    ann.observe(Observation("sheet", "persistent", on_a_wall, lab.now_ns, 2))
    lab.poll()
    assert ann.proposals() == []
    assert lab.drops.by_reason["observation_unusable"] == 2


def test_old_touches_do_not_outvote_a_new_one() -> None:
    lab, ann = _lab()
    _calibrate(ann)
    for mark in "1234":
        _touch(ann, mark)
    known = len(ann.proposals())
    assert known
    lab.now_ns += 1800 * SECOND
    ann.bump(0.05)
    for mark in "12":
        _touch(ann, mark)
    assert len(ann.proposals()) == known
    _touch(ann, "4")
    got = ann.proposals()[-1]
    assert len(ann.proposals()) == known + 1
    assert _error_at(ann, got, ROBOT) < 0.012


def test_touch_that_is_sent_once_more_is_no_news() -> None:
    lab, ann = _lab()
    _calibrate(ann)
    for mark in "1234":
        _touch(ann, mark)
    before = len(ann.proposals())
    lab.now_ns += 30 * SECOND
    _touch(ann, "4")
    lab.now_ns += SECOND
    lab.poll()
    assert len(ann.proposals()) == before
