"""Looks: new poses of resting heads, at places of their own."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.looks import MAX_CLAIMED, PLACE_RADIUS_M, HeadMotion, LookFilter, is_zero_pose
from anchors.pose import IDENTITY_POSE, IDENTITY_QUAT, PoseTuple, Vec3, quat_from_yaw
from anchors.viewpoints import LATE_SIGMA_S, compute_lateness

QR = ("sheet", "qr", "head")


def _pose(x: float) -> PoseTuple:
    return (x, 0.3, -0.2), quat_from_yaw(0.4)


def test_repeated_pose_is_not_new_until_it_changes() -> None:
    looks = LookFilter()
    (p, q), next_up = _pose(1.0), math.nextafter(1.0, 2.0)
    assert [looks.is_new(QR, _pose(x)) for x in (1.0, 1.0, next_up, 1.0)] == [True, False, True, False]
    assert not looks.is_new(QR, (p, (-q[0], -q[1], -q[2], -q[3]))), "the same rotation"
    assert looks.is_new(("other", "qr", "head"), _pose(1.0))


def test_memory_is_bounded() -> None:
    looks = LookFilter()
    for i in range(2000):
        looks.is_new((f"sheet {i}", "qr", "head"), _pose(float(i)))
        looks.number_viewpoint((float(i), 0.0, 0.0), i)
        looks.number_viewpoint(None, i)
    assert max(len(looks._poses), len(looks._places), len(looks._claimed)) <= 256


@pytest.mark.parametrize(
    ("pose", "expected"),
    [
        (IDENTITY_POSE, True),
        (((0.0, -1e-12, 0.0), (-1.0, 0.0, 0.0, 1e-12)), True),
        (((0.0, 0.0, 1e-6), IDENTITY_QUAT), False),
        (((0.0, 0.0, 0.0), quat_from_yaw(1e-3)), False),
        (((math.nan, 0.0, 0.0), IDENTITY_QUAT), False),
    ],
)
def test_zero_pose_is_the_exact_origin_with_identity(pose: PoseTuple, expected: bool) -> None:
    assert is_zero_pose(pose) is expected


def test_viewpoints_are_places_of_the_head_whatever_their_number() -> None:
    rng = np.random.default_rng(1)
    looks, numbers = LookFilter(), []
    for place in range(4):
        for i in range(50):
            x, y, z = rng.normal(0.0, 0.01, 3).tolist()
            numbers.append((place, looks.number_viewpoint((x + 0.3 * place, y, z + 1.6), 0 if place % 2 else i)))
    assert len(set(numbers)) == len({number for _, number in numbers}) == 4
    assert looks.number_viewpoint((0.0, 0.0, 1.6), 9) == numbers[0][1], "back at the first place"


def test_head_that_sways_about_the_edge_of_a_place_stays_in_it() -> None:
    looks = LookFilter()
    first = looks.number_viewpoint((0.0, 0.0, 0.0), 0)
    assert {looks.number_viewpoint((f * PLACE_RADIUS_M, 0.0, 0.0), 0) for f in (0.95, 1.05, 0.95, 1.2)} == {first}
    there = looks.number_viewpoint((1.3 * PLACE_RADIUS_M, 0.0, 0.0), 0)
    assert {looks.number_viewpoint((f * PLACE_RADIUS_M, 0.0, 0.0), 0) for f in (1.2, 0.9, 1.1)} == {there} != {first}


def test_without_head_poses_a_client_can_claim_few_viewpoints() -> None:
    looks = LookFilter()
    honest = [looks.number_viewpoint(None, i // 20) for i in range(20 * MAX_CLAIMED)]
    assert len(set(honest)) == MAX_CLAIMED
    looks.forget_viewpoints()
    assert len({looks.number_viewpoint(None, i) for i in range(500)}) == MAX_CLAIMED


def test_shift_is_what_a_late_picture_displaces() -> None:
    """A sheet that rests in the room, seen a moment before the head pose that it is combined with."""
    late_s, p_sheet, p_head = 1e-4, np.array([0.6, -0.2, 0.1]), np.array([0.1, 0.2, 1.5])
    v, w = np.array([0.05, -0.02, 0.03]), np.array([0.1, 0.2, -0.15])
    # To first order the head moves by v and turns by w: so does what is fixed to it.
    moved = v * late_s + np.cross(w * late_s, p_sheet - p_head)
    motion = HeadMotion(((0.1, 0.2, 1.5), IDENTITY_QUAT), _vec(v), _vec(w))
    assert np.allclose(np.array(motion.compute_shift(_vec(p_sheet))) * late_s, [*moved, *(w * late_s)], atol=1e-12)
    assert not HeadMotion(IDENTITY_POSE, (0.03, 0.0, 0.0), (0.05, 0.0, 0.0)).is_fast, "a standing person sways"
    assert HeadMotion(IDENTITY_POSE, (0.3, 0.0, 0.0), (0.0, 0.0, 0.0)).is_fast
    assert HeadMotion(IDENTITY_POSE, (0.0, 0.0, 0.0), (0.0, 0.0, 0.4)).is_fast


def test_lateness_is_common_for_steady_motion_and_new_for_sway() -> None:
    steady = (0.1, 0.0, 0.0, 0.0, 0.0, 0.2)
    common, each = compute_lateness([steady] * 5)
    assert (common[0, 0], common[5, 5]) == pytest.approx(((0.1 * LATE_SIGMA_S) ** 2, (0.2 * LATE_SIGMA_S) ** 2))
    assert np.allclose(each, 0.0)
    common, each = compute_lateness([steady, (-0.1, 0.0, 0.0, 0.0, 0.0, -0.2)])
    assert np.allclose(common, 0.0)
    assert each[0, 0] == pytest.approx((0.1 * LATE_SIGMA_S) ** 2)


def _vec(v: np.ndarray) -> Vec3:
    return float(v[0]), float(v[1]), float(v[2])
