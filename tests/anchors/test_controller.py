"""Controller tip by pivoting: accurate, robust, and advice where the motion does not determine it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.controller import TipCalibration, calibrate_tip, controller_covariance, holder_anchor, tip_position
from anchors.lie import Array, quat_exp, quat_multiply, quat_to_matrix
from anchors.pose import PoseTuple, compose, inverse, quat_from_rotvec

TIP = np.array([0.01, -0.02, -0.12])
PIVOT = np.array([0.4, 1.1, -0.3])


def _poses(turns: Array, sigma_m: float = 0.001, seed: int = 1) -> list[PoseTuple]:
    rng = np.random.default_rng(seed)
    q = quat_multiply(quat_exp(turns), quat_exp(np.array([0.3, 0.2, 2.0])))
    t = PIVOT - quat_to_matrix(q) @ TIP + rng.normal(0.0, sigma_m, (len(turns), 3))
    return [(tuple(p), tuple(r)) for p, r in zip(t.tolist(), q.tolist(), strict=True)]


def _cone_rotations(n: int = 150, angle: float = 0.6) -> Array:
    phi = np.linspace(0.0, 4.0 * math.pi, n)
    return np.stack([angle * np.cos(phi), angle * np.sin(phi), 0.2 * np.sin(3.0 * phi)], axis=1)


def _tip_error(got: TipCalibration) -> float:
    return math.dist(got.p_controller_tip, TIP)


def test_tip_is_accurate() -> None:
    got = calibrate_tip(_poses(_cone_rotations()))
    assert not got.refused
    assert got.advice == ""
    assert _tip_error(got) < 4.0 * got.sigma_m < 0.002
    assert math.dist(got.p_tracking_pivot, PIVOT) < 0.001
    assert got.residual_m == pytest.approx(0.001 * math.sqrt(3.0), rel=0.2)
    pose = _poses(_cone_rotations(), sigma_m=0.0)[7]
    assert math.dist(tip_position(pose, got.p_controller_tip), PIVOT) < 0.001


def test_wrong_readings_are_excluded() -> None:
    poses = _poses(_cone_rotations())
    for i in range(0, 150, 10):
        poses[i] = ((poses[i][0][0] + 0.3, poses[i][0][1], poses[i][0][2]), poses[i][1])
    got = calibrate_tip(poses)
    assert not got.refused
    assert got.n_used <= 135
    assert _tip_error(got) < 0.001


@pytest.mark.parametrize(
    ("poses", "word"),
    [
        (_poses(_cone_rotations(10)), "10 poses"),
        (_poses(_cone_rotations() * 0.1), "least used direction"),
        (_poses(_cone_rotations() * np.array([1.0, 0.0, 0.0])), "to the front"),
        (_poses(_cone_rotations(), sigma_m=0.01), "the tip slipped"),
        (_poses(_cone_rotations(25), sigma_m=0.0034), "known to 1."),
    ],
)
def test_insufficient_motion_fails_with_advice(poses: list[PoseTuple], word: str) -> None:
    got = calibrate_tip(poses)
    assert got.refused
    assert word in got.advice


def test_holder_becomes_an_anchor() -> None:
    T_world_holder: PoseTuple = ((1.0, 2.0, 0.8), quat_from_rotvec((0.0, 0.0, 0.5)))
    T_holder_controller: PoseTuple = ((0.0, 0.0, 0.05), quat_from_rotvec((0.4, 0.0, 0.0)))
    T = holder_anchor(T_world_holder, T_holder_controller)
    assert np.allclose(compose(inverse(T_world_holder), T)[0], T_holder_controller[0])
    assert len(controller_covariance()) == 36


def test_invalid_poses_are_excluded() -> None:
    poses = _poses(_cone_rotations())
    lost: list[PoseTuple] = [((math.nan, 0.0, 0.0), poses[0][1]), (poses[0][0], (0.0, 0.0, 0.0, 0.0))]
    assert calibrate_tip([*lost, *poses]) == calibrate_tip(poses)
    assert calibrate_tip(lost * 20).refused
