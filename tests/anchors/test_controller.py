"""Controller tip by pivoting: accurate, robust, and advice where the motion does not determine it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from anchors.controller import TipCalibration, calibrate_tip
from anchors.lie import Array, quat_exp, quat_multiply, quat_to_matrix
from anchors.pose import PoseTuple, apply

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
    assert _tip_error(got) < got.error_m < 0.003
    assert got.residual_m == pytest.approx(0.001 * math.sqrt(3.0), rel=0.2)
    pose = _poses(_cone_rotations(), sigma_m=0.0)[7]
    assert math.dist(apply(pose, got.p_controller_tip), PIVOT) < 0.001


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
        (_poses(_cone_rotations(25), sigma_m=0.0034), "the tip is known to"),
    ],
)
def test_insufficient_motion_fails_with_advice(poses: list[PoseTuple], word: str) -> None:
    got = calibrate_tip(poses)
    assert got.refused
    assert word in got.advice


def test_invalid_poses_are_excluded() -> None:
    poses = _poses(_cone_rotations())
    lost: list[PoseTuple] = [((math.nan, 0.0, 0.0), poses[0][1]), (poses[0][0], (0.0, 0.0, 0.0, 0.0))]
    assert calibrate_tip([*lost, *poses]) == calibrate_tip(poses)
    assert calibrate_tip(lost * 20).refused


def _smooth_rotations(rng: np.random.Generator) -> Array:
    """Return 100 rotations of ten seconds of turning back and forth about three axes."""
    angle = np.linspace(0.0, 10.0, 100)[:, None] * np.array([1.4, 1.1, 0.6]) + rng.uniform(0.0, 6.28, 3)
    return np.array([0.6, 0.6, 0.3]) * np.sin(angle)


def _smooth_noise(rng: np.random.Generator, seconds: float) -> Array:
    """Return noise (100, 3) of unit variance, at 10 Hz, which is forgotten in `seconds`."""
    kept = math.exp(-0.1 / seconds)
    noise = rng.normal(0.0, 1.0, (100, 3))
    for i in range(1, 100):
        noise[i] = kept * noise[i - 1] + math.sqrt(1.0 - kept**2) * noise[i]
    return noise


@pytest.mark.parametrize("noise", ["repeated", 0.2, 0.5])
def test_stated_error_of_the_tip_holds_for_readings_that_share_their_errors(noise: str | float) -> None:
    rng = np.random.default_rng(2)
    inside = n = 0
    for _ in range(150):
        if isinstance(noise, str):
            turns = np.tile(rng.uniform(-0.6, 0.6, (20, 3)), (5, 1))
            off = np.tile(rng.normal(0.0, 0.0005, (20, 3)), (5, 1))
        else:
            turns, off = _smooth_rotations(rng), 0.0005 * _smooth_noise(rng, noise)
        exact = np.array([p for p, _ in _poses(turns, 0.0)])
        got = calibrate_tip([(tuple(p), q) for p, (_, q) in zip((exact + off).tolist(), _poses(turns), strict=True)])
        n += not got.refused
        inside += _tip_error(got) <= got.error_m < 0.003
    assert n >= 120
    assert inside / n >= 0.93


def test_readings_in_a_few_places_are_refused_however_many() -> None:
    got = calibrate_tip(_poses(np.tile(0.6 * np.eye(3), (30, 1)), 0.0))
    assert got.refused
    assert "about 3 different" in got.advice
