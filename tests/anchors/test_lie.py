"""Lie group operations on arrays: laws by hypothesis, cases against scipy and OpenCV, limits near zero and pi."""

from __future__ import annotations

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from anchors import lie
from anchors.lie import Array
from anchors.pose import quat_mul, quat_rotate, quat_to_rotvec

vectors = arrays(np.float64, 3, elements=st.floats(-3.0, 3.0))
axes = vectors.filter(lambda v: bool(np.linalg.norm(v) > 1e-3)).map(lambda v: v / np.linalg.norm(v))
#: Angles where series, square roots and signs change.
angles = st.one_of(
    st.floats(0.0, math.pi),
    st.sampled_from([0.0, 1e-300, 1e-12, 1e-8, 1e-7, 1e-4, math.pi - 1e-4, math.pi - 1e-8, math.pi]),
)


def _is_same_rotation(a: Array, b: Array) -> bool:
    return bool(abs(abs(float(a @ b)) - 1.0) < 1e-12)


@given(axes, angles)
def test_log_is_the_inverse_of_exp(axis: Array, angle: float) -> None:
    q = lie.quat_exp(axis * angle)
    assert math.isclose(float(np.linalg.norm(q)), 1.0, abs_tol=1e-12)
    back = lie.quat_log(q)
    assert np.linalg.norm(back) <= math.pi + 1e-12
    if angle < math.pi - 1e-7:
        assert np.allclose(back, axis * angle, rtol=1e-9, atol=1e-12)
    else:  # half a turn in either direction is the same rotation
        assert _is_same_rotation(lie.quat_exp(back), q)


@given(arrays(np.float64, (5, 3), elements=st.floats(-3.0, 3.0)))
def test_batches_agree_with_single_values_and_tuples(r: Array) -> None:
    q = lie.quat_exp(r)
    product = lie.quat_multiply(q, q[::-1])
    turned = lie.quat_to_matrix(q) @ np.array([1.0, -2.0, 0.5])
    for i in range(5):
        a, b = tuple(q[i].tolist()), tuple(q[4 - i].tolist())
        assert np.allclose(product[i], quat_mul(a, b), atol=1e-12)
        assert np.allclose(turned[i], quat_rotate(a, (1.0, -2.0, 0.5)), atol=1e-9)
        assert _is_same_rotation(lie.quat_exp(lie.quat_log(q[i])), lie.quat_exp(np.array(quat_to_rotvec(a))))


@given(vectors)
def test_matrix_round_trip(r: Array) -> None:
    q = lie.quat_exp(r)
    assert _is_same_rotation(lie.quat_from_matrix(lie.quat_to_matrix(q)), q)


@given(axes, st.floats(0.0, 3.0), axes)
def test_left_jacobian_is_the_derivative_of_exp(axis: Array, angle: float, way: Array) -> None:
    r, h = axis * angle, 1e-6
    ahead, behind = lie.quat_exp(r + h * way), lie.quat_exp(r - h * way)
    change = lie.quat_log(lie.quat_multiply(ahead, lie.quat_conjugate(behind))) / (2.0 * h)
    assert np.allclose(lie.left_jacobian(r) @ way, change, atol=1e-6)


@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_swing_removes_the_rotation_about_the_vertical(x: float, y: float, yaw: float) -> None:
    tilt = lie.quat_exp(np.array([x, y, 0.0]))
    q = lie.quat_multiply(tilt, lie.quat_exp(np.array([0.0, 0.0, yaw])))
    assert np.allclose(lie.swing(q), [x, y], atol=1e-9)
    assert np.allclose(lie.swing(-q), [x, y], atol=1e-9)
