"""Pose arithmetic on tuples against scipy, and the group laws."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from anchors import pose as ps

finite = st.floats(-3.0, 3.0)
vectors = st.tuples(finite, finite, finite)
poses = st.builds(lambda p, r: (p, ps.quat_from_rotvec(r)), vectors, vectors)


def _rotation(q: ps.Quat) -> Rotation:
    return Rotation.from_quat([q[1], q[2], q[3], q[0]])


@given(poses, poses, vectors)
def test_compose_applies_the_right_factor_first(a: ps.PoseTuple, b: ps.PoseTuple, v: ps.Vec3) -> None:
    assert np.allclose(ps.apply(ps.compose(a, b), v), ps.apply(a, ps.apply(b, v)), atol=1e-9)


@given(poses)
def test_inverse(a: ps.PoseTuple) -> None:
    p, q = ps.compose(a, ps.inverse(a))
    assert np.allclose(p, 0.0, atol=1e-9)
    assert ps.quat_angle(q, ps.IDENTITY_QUAT) < 1e-9


@given(vectors, vectors)
def test_rotation_agrees_with_scipy(r: ps.Vec3, v: ps.Vec3) -> None:
    q = ps.quat_from_rotvec(r)
    assert np.allclose(ps.quat_rotate(q, v), Rotation.from_rotvec(r).apply(v), atol=1e-9)
    assert np.allclose(ps.quat_to_rotvec(q), _rotation(q).as_rotvec(), atol=1e-6)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-7, 1e-3, 1.0, math.pi - 1e-7, math.pi])
def test_exp_log_near_zero_and_pi(angle: float) -> None:
    back = ps.quat_to_rotvec(ps.quat_from_rotvec((0.0, angle, 0.0)))
    assert back[1] == pytest.approx(angle, abs=1e-9)


def test_normalize_rejects_zero_and_non_finite() -> None:
    for bad in [(0.0, 0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0, 0.0)]:
        with pytest.raises(ValueError, match="cannot be normalised"):
            ps.quat_normalize(bad)


def test_pivot_moves_on_a_straight_line() -> None:
    old: ps.PoseTuple = ((0.0, 0.0, 0.0), ps.quat_from_yaw(0.3))
    new: ps.PoseTuple = ((0.02, -0.01, 0.0), ps.quat_from_rotvec((0.01, 0.0, 0.33)))
    pivot = ps.apply(ps.inverse(new), (0.5, 2.0, 0.7))
    a, b = np.array(ps.apply(old, pivot)), np.array(ps.apply(new, pivot))
    for share in (0.0, 0.25, 0.5, 1.0):
        moved = ps.apply(ps.interpolate_about_pivot(old, new, pivot, share), pivot)
        assert np.allclose(moved, a + share * (b - a), atol=1e-12)
