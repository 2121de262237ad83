"""Alignment by touched points: exact, honest, and failures that name the wrong points."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest

from anchors.alignment import AlignmentConfig
from anchors.controller import TipCalibration, calibrate_tip
from anchors.lie import quat_exp, quat_to_matrix, to_quat, to_vec3
from anchors.pose import PoseTuple, Vec3, apply, distance, inverse, quat_angle, quat_from_rotvec, quat_from_yaw
from anchors.sheet import compute_marks
from anchors.touch import TOUCH_SIGMA_M, Touch, register_touches, suggest_point

MARKS: dict[str, Vec3] = {
    "a": (0.0, 0.0, 0.0),
    "b": (0.62, 0.03, 0.0),
    "c": (0.55, 0.45, 0.0),
    "d": (-0.05, 0.37, 0.0),
}
T_WORLD_TRACKING: PoseTuple = ((1.0, -2.0, 0.4), quat_from_yaw(2.2))


def _touches(
    names: str, noise: float = 0.0, seed: int = 0, marks: dict[str, Vec3] = MARKS, T: PoseTuple = T_WORLD_TRACKING
) -> list[Touch]:
    rng = np.random.default_rng(seed)
    out = []
    for name in names:
        p = np.array(apply(inverse(T), marks[name])) + rng.normal(0.0, noise, 3)
        out.append(Touch(name, to_vec3(p)))
    return out


@pytest.mark.parametrize("dof", [4, 6])
@pytest.mark.parametrize("names", ["abc", "abcd", "dbcaabcd"])
def test_exact_without_noise(names: str, dof: int) -> None:
    T = T_WORLD_TRACKING if dof == 4 else ((0.3, 1.0, 2.0), quat_from_rotvec((0.9, -1.2, 0.4)))
    got = register_touches(MARKS, _touches(names, T=T), tracking_epoch=3, config=AlignmentConfig(dof=dof))
    assert not got.estimate.refused
    assert got.estimate.tracking_epoch == 3
    assert distance(got.estimate.T_world_tracking[0], T[0]) < 1e-8
    assert quat_angle(got.estimate.T_world_tracking[1], T[1]) < 1e-8
    assert max(got.residuals_m.values()) < 1e-8


def test_too_few_points_lists_the_rest() -> None:
    got = register_touches(MARKS, _touches("ab"))
    assert got.estimate.refused
    assert got.estimate.advice.endswith(": c, d")


def test_collinear_points_are_refused() -> None:
    marks = {"a": (0.0, 0.0, 0.0), "b": (0.3, 0.004, 0.0), "c": (0.6, 0.0, 0.0)}
    got = register_touches(marks, _touches("abc", marks=marks))
    assert got.estimate.refused
    assert got.estimate.advice.startswith("points a, b, c lie on one line ('b' is 3 mm beside it)")
    assert got.suspects == ("a", "b", "c")


def test_swapped_points_are_named() -> None:
    touches = _touches("abcd", 0.001)
    swapped = [Touch({"b": "c", "c": "b"}.get(t.point, t.point), t.p_tracking_tip) for t in touches]
    got = register_touches(MARKS, swapped)
    assert got.estimate.refused
    assert got.suspects == ("b", "c")
    assert got.estimate.advice.startswith("points are mixed up: 'b' was touched at 'c', 'c' was touched at 'b'")


def test_point_touched_elsewhere_is_named_with_its_error() -> None:
    touches = _touches("abcd", 0.0005)
    x, y, z = touches[2].p_tracking_tip
    touches[2] = Touch("c", (x, y, z + 0.03))
    got = register_touches(MARKS, touches)
    assert got.suspects == ("c",)
    assert "'c' is 30 mm" in got.estimate.advice


def test_point_with_two_wrong_distances_of_three_is_named() -> None:
    touches = _touches("abc")
    x, y, z = touches[0].p_tracking_tip
    touches[0] = Touch("a", (x + 0.05, y + 0.03, z))
    got = register_touches(MARKS, touches)
    assert got.estimate.refused
    assert "'a'" in got.estimate.advice


def test_point_touched_at_two_places_is_named() -> None:
    touches = _touches("abcd")
    x, y, z = touches[1].p_tracking_tip
    got = register_touches(MARKS, [*touches, Touch("b", (x + 0.04, y, z))])
    assert got.suspects == ("b",)


def test_unknown_and_untouched_points_are_refused() -> None:
    assert "'x'" in register_touches(MARKS, [*_touches("abc"), Touch("x", (0.0, 0.0, 0.0))]).estimate.advice
    assert register_touches(MARKS, [*_touches("abc"), Touch("d", (math.nan, 0.0, 0.0))]).estimate.refused


def test_rotationally_ambiguous_points_produce_a_warning() -> None:
    square: dict[str, Vec3] = {"a": (0.0, 0.0, 0.0), "b": (0.5, 0.0, 0.0), "c": (0.5, 0.5, 0.0), "d": (0.0, 0.5, 0.0)}
    got = register_touches(square, _touches("abcd", marks=square))
    assert not got.estimate.refused
    assert "another order" in got.estimate.advice
    assert register_touches(MARKS, _touches("abcd")).estimate.advice == ""


@pytest.mark.parametrize("value", [math.nan, math.inf, 1e308])
def test_invalid_touch_is_ignored(value: float) -> None:
    marks = {"a": (0.0, 0.0, 0.0), "b": (1.0, 0.0, 0.0), "c": (0.0, 1.0, 0.0)}
    got = register_touches(marks, [Touch(name, (value, 0.0, 0.0)) for name in marks])
    assert got.estimate.refused
    assert "was not read" in got.estimate.advice


# --- tips, printed marks ---

TIP = np.array([0.01, -0.02, -0.12])
PRINTED = compute_marks(0.14)


def _calibrate(rng: np.random.Generator, sigma_m: float) -> TipCalibration:
    """Turn a controller in a hole: 40 poses, by up to 34 degrees to each side."""
    turns = quat_exp(rng.uniform(-0.6, 0.6, (40, 3)))
    p = np.array([0.2, 0.1, 0.0]) - quat_to_matrix(turns) @ TIP + rng.normal(0.0, sigma_m, (40, 3))
    return calibrate_tip([(to_vec3(at), to_quat(q)) for at, q in zip(p, turns, strict=True)])


@pytest.mark.parametrize("turning", [0.0, 0.8])
def test_stated_error_includes_that_of_the_tip(turning: float) -> None:
    """Monte Carlo: a tip calibrated with noise, then marks touched with it, held alike or turned every time."""
    rng = np.random.default_rng(3)
    far: Vec3 = (0.3, 0.4, 0.2)
    inside = {"sheet": 0, "robot": 0}
    errors, stated = [], []
    n = 200
    for _ in range(n):
        tip = _calibrate(rng, 0.0015)
        held = rng.uniform(-1.0, 1.0, 3)
        touches = []
        for name in "123":
            q = quat_exp(held + turning * rng.uniform(-1.0, 1.0, 3))
            grip = np.array(apply(inverse(T_WORLD_TRACKING), PRINTED[name])) - quat_to_matrix(q) @ TIP
            at = grip + quat_to_matrix(q) @ np.array(tip.p_controller_tip) + rng.normal(0.0, TOUCH_SIGMA_M, 3)
            touches.append(Touch(name, to_vec3(at), TOUCH_SIGMA_M, "right", to_quat(q)))
        got = register_touches(PRINTED, touches, tips={"right": tip.covariance}).estimate
        for where, point in (("sheet", got.pivot_world), ("robot", far)):
            at_world = apply(got.T_world_tracking, apply(inverse(T_WORLD_TRACKING), point))
            errors.append(distance(at_world, point))
            stated.append(got.error_at(point))
            inside[where] += errors[-1] <= stated[-1]
    # The readings are independent, more than the calibration assumes: the stated error may be too large.
    assert all(count / n >= 0.93 for count in inside.values()), inside
    assert float(np.median(errors)) > 0.25 * float(np.median(stated))


def test_common_error_of_a_tip_does_not_average_out() -> None:
    """With 3 mm that all touches share, four touches are not twice as exact as one."""
    shared = tuple((0.003**2 * np.eye(3)).ravel().tolist())
    touches = [replace(t, tip="right") for t in _touches("abcd")]
    with_tip = register_touches(MARKS, touches, tips={"right": shared}).estimate
    alone = register_touches(MARKS, touches).estimate
    assert with_tip.error_at_anchor_m > 0.003 * 2.7 > 3.0 * alone.error_at_anchor_m


def test_printed_marks_look_the_same_in_no_other_order() -> None:
    touches = _touches("1234", 0.0005, marks=PRINTED)
    assert register_touches(PRINTED, touches).estimate.advice == ""
    for order in itertools.permutations("1234"):
        if order != tuple("1234"):
            mixed = [replace(t, point=name) for t, name in zip(touches, order, strict=True)]
            assert register_touches(PRINTED, mixed).estimate.refused, order


@pytest.mark.parametrize(
    ("touched", "named"), [("", "1"), ("1", "3"), ("14", "3"), ("12", "4"), ("234", "1"), ("1234", "")]
)
def test_next_mark_spreads_the_set(touched: str, named: str) -> None:
    assert suggest_point(PRINTED, touched) == named


def test_degenerate_sets_name_the_mark_to_touch_next() -> None:
    line = {"a": (0.0, 0.0, 0.0), "b": (0.3, 0.0, 0.0), "c": (0.6, 0.0, 0.0), "d": (0.3, 0.2, 0.0)}
    got = register_touches(line, _touches("abc", marks=line)).estimate
    assert got.refused
    assert "touch 'd' next" in got.advice
    close = {"a": (0.0, 0.0, 0.0), "b": (0.06, 0.0, 0.0), "c": (0.0, 0.06, 0.0), "d": (0.4, 0.3, 0.0)}
    got = register_touches(close, _touches("abc", marks=close)).estimate
    assert got.refused
    assert got.advice == "points a, b, c lie within 85 mm, too close to tell a rotation: touch 'd' next"
