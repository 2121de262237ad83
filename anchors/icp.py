"""Refine the pose of a camera by its points: point-to-plane ICP against a reference cloud.

Both clouds are in the world, by the present calibration. Points of the reference get normals by the plane through the
points around them; points of the camera are paired with the nearest of them, and a small motion of the camera brings
them onto those planes, over and over, with ever shorter reach and robust weights (Chen and Medioni 1992; weights of
Tukey). A result that is no better than the calibration is refused, and so is one that the scene does not determine: a
wall fits as well wherever it slides along itself.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Reason = Literal["overlap", "slides", "worse", "far"]

#: Points of the camera that are used at most: more cost time and tell nothing new.
_MAX_POINTS: Final = 20_000
#: Nearest points that make a plane; noise of depth averages out over them.
_AROUND: Final = 24
#: Pairs further apart than this are not made: at first, and in the end [m].
_REACH_M: Final = 0.10
_LAST_REACH_M: Final = 0.03
_ITERATIONS: Final = 60
_SETTLED: Final = 2e-5  # [m] and [rad]
#: Residuals are never weighted as if depth were better than this [m].
_MIN_SCALE_M: Final = 0.002
_MIN_PAIRS: Final = 500
#: Largest correction in the middle of the overlap, and the largest rotation: a calibration is never off by more.
_MAX_SHIFT_M: Final = 0.08
_MAX_TURN_RAD: Final = math.radians(4.0)
_MIN_OVERLAP: Final = 0.25
#: Least eigenvalue of the normal equations per pair, rotations times the size of the overlap: about the share of the
#: pairs that hold this direction. Planes have 0, and up to 0.003 by the noise of their normals; rooms 0.03 and more.
_MIN_EIGENVALUE: Final = 0.006
#: Keeps a free direction where it is until the verdict.
_DAMPING: Final = 0.002


@dataclass(frozen=True)
class Refinement:
    """A refined pose.

    Attributes:
        T_world_world: (4, 4) correction: `T_world_world @ T_world_camera` is the refined pose.
        rmse_before_m: Root mean square distance of the paired points from the planes of the reference, before.
        rmse_after_m: The same afterwards, of the same points.
        overlap: Share of the camera's points that have a pair, 0 to 1.
        shift_m: How far the centre of the overlap moved.
        turn_rad: By how much it turned.
        condition: Largest over least eigenvalue of the normal equations, rotations times the size of the overlap.
    """

    T_world_world: Floats
    rmse_before_m: float
    rmse_after_m: float
    overlap: float
    shift_m: float
    turn_rad: float
    condition: float


class RefinementRefusedError(Exception):
    """The clouds do not determine a better pose.

    Attributes:
        reason: `overlap`: too few points see the same surfaces; `slides`: the surfaces leave a direction free;
            `worse`: the calibration fits at least as well; `far`: the result is further off than ICP can be trusted.
    """

    def __init__(self, reason: Reason, text: str) -> None:
        super().__init__(text)
        self.reason: Reason = reason


class _Reference(NamedTuple):
    """Points with a normal each, and a tree of them."""

    points: Floats
    normals: Floats
    tree: Any


class _Pairs(NamedTuple):
    """Rows of the camera's points that have a pair, normals of their planes, and distances from these [m]."""

    rows: npt.NDArray[np.int64]
    normals: Floats
    residuals: Floats


def refine_pose(points: npt.NDArray[Any], reference: npt.NDArray[Any]) -> Refinement:
    """Refine the pose of a camera.

    Args:
        points: (n, 3) [m], points of the camera in the world by its present calibration, voxels rather than pixels.
        reference: (m, 3) [m], points of other cameras or of a scan.

    Returns:
        The correction, which fits better than the calibration.

    Raises:
        RefinementRefusedError: It is not determined, no better, or larger than allowed; `reason` says which.
    """
    source = np.asarray(points, np.float64)
    source = source[:: max(1, math.ceil(len(source) / _MAX_POINTS))]
    target = _make_reference(np.asarray(reference, np.float64))
    first = _find_pairs(source, target, _REACH_M)
    _check_overlap(first, source, _REACH_M)
    moved, T, reach = source, np.eye(4), _REACH_M
    for _ in range(_ITERATIONS):
        pairs = _find_pairs(moved, target, reach)
        _check_overlap(pairs, source, reach)
        information, gradient, center, size = _make_normal_equations(moved, pairs)
        values, vectors = np.linalg.eigh(information)
        step = -vectors @ ((vectors.T @ gradient) / (values + _DAMPING))
        T = _make_motion(step[:3], step[3:] / size, center) @ T
        moved = source @ T[:3, :3].T + T[:3, 3]
        if reach == _LAST_REACH_M and np.abs(step).max() < _SETTLED:
            break
        reach = max(_LAST_REACH_M, 0.85 * reach)
    before, after = (_measure_rmse(one[first.rows], target) for one in (source, moved))
    result = Refinement(
        T,
        before,
        after,
        len(pairs.rows) / len(source),
        float(np.linalg.norm(T[:3, :3] @ center + T[:3, 3] - center)),
        measure_turn(T[:3, :3]),
        float(values[-1] / max(values[0], 1e-12)),
    )
    _check_result(result, values[0], vectors[:, 0])
    return result


def _make_reference(points: Floats) -> _Reference:
    """Compute the normals of a cloud."""
    from scipy.spatial import cKDTree

    if len(points) < _MIN_PAIRS:
        raise RefinementRefusedError("overlap", f"the reference has {len(points)} points: at least {_MIN_PAIRS}")
    tree = cKDTree(points)
    around = points[tree.query(points, _AROUND)[1]]
    away = around - around.mean(axis=1, keepdims=True)
    _, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", away, away))
    # The plane goes through the mean of the points around, not through the point with its own noise.
    return _Reference(around.mean(axis=1), vectors[:, :, 0], tree)


def _find_pairs(points: Floats, target: _Reference, reach_m: float) -> _Pairs:
    """Pair points (n, 3) with the nearest ones of a reference within `reach_m` [m]."""
    distance, at = target.tree.query(points, distance_upper_bound=reach_m)
    rows = np.flatnonzero(np.isfinite(distance))
    normals = target.normals[at[rows]]
    return _Pairs(rows, normals, np.einsum("ij,ij->i", points[rows] - target.points[at[rows]], normals))


def _make_normal_equations(points: Floats, pairs: _Pairs) -> tuple[Floats, Floats, Floats, float]:
    """Return matrix (6, 6) and gradient (6,) per pair, centre and size of the overlap [m]. Rotations are in units of
    its size, so that all six are lengths."""
    scale = max(_MIN_SCALE_M, 1.4826 * float(np.median(np.abs(pairs.residuals))))
    weights = np.maximum(0.0, 1.0 - (pairs.residuals / (4.685 * scale)) ** 2) ** 2
    weights /= weights.sum()
    matched = points[pairs.rows]
    center = weights @ matched
    arms = matched - center
    size = math.sqrt(float(weights @ np.einsum("ij,ij->i", arms, arms)))
    J = np.concatenate([pairs.normals, np.cross(arms, pairs.normals) / size], axis=1)
    return (J * weights[:, None]).T @ J, J.T @ (weights * pairs.residuals), center, size


def _check_overlap(pairs: _Pairs, source: Floats, reach_m: float) -> None:
    n, share = len(pairs.rows), len(pairs.rows) / max(1, len(source))
    if n < _MIN_PAIRS or share < _MIN_OVERLAP:
        raise RefinementRefusedError(
            "overlap",
            f"{n} points ({100.0 * share:.0f} %) lie within {100.0 * reach_m:.0f} cm of the reference: at least "
            f"{_MIN_PAIRS} and {100.0 * _MIN_OVERLAP:.0f} %; let both see the same surfaces, or calibrate again",
        )


def _check_result(result: Refinement, least: float, free: Floats) -> None:
    if least < _MIN_EIGENVALUE:
        turns = np.linalg.norm(free[3:]) > np.linalg.norm(free[:3])
        way = free[3:] if turns else free[:3]
        axis = ", ".join(f"{v:.1f}" for v in way / np.linalg.norm(way))
        raise RefinementRefusedError(
            "slides",
            f"what both see can {'turn about' if turns else 'slide along'} ({axis}) without a difference: let them see "
            "surfaces in three directions, as a table with things on it before a wall",
        )
    if result.shift_m > _MAX_SHIFT_M or result.turn_rad > _MAX_TURN_RAD:
        raise RefinementRefusedError(
            "far",
            f"the clouds fit {1e3 * result.shift_m:.0f} mm and {math.degrees(result.turn_rad):.1f} deg away, more than "
            f"{1e3 * _MAX_SHIFT_M:.0f} mm and {math.degrees(_MAX_TURN_RAD):.1f} deg: calibrate the camera again",
        )
    if result.rmse_after_m > 1.01 * result.rmse_before_m:
        raise RefinementRefusedError(
            "worse",
            f"the clouds are {1e3 * result.rmse_before_m:.1f} mm apart now, and would be "
            f"{1e3 * result.rmse_after_m:.1f} mm: the calibration stays",
        )


def _measure_rmse(points: Floats, target: _Reference) -> float:
    """Return the rms distance from the planes [m]; what is further away than the last reach counts with that."""
    pairs = _find_pairs(points, target, _LAST_REACH_M)
    squares = np.full(len(points), _LAST_REACH_M**2)
    squares[pairs.rows] = pairs.residuals**2
    return math.sqrt(float(squares.mean()))


def _make_motion(shift: Floats, turn: Floats, center: Floats) -> Floats:
    """Return the motion (4, 4) that turns by a rotation vector about `center`, and shifts."""
    from scipy.spatial.transform import Rotation

    move = np.eye(4)
    move[:3, :3] = Rotation.from_rotvec(turn).as_matrix()
    move[:3, 3] = center + shift - move[:3, :3] @ center
    return move


def measure_turn(R: Floats) -> float:
    """Return the angle of a rotation matrix (3, 3) [rad]."""
    return math.acos(min(1.0, max(-1.0, 0.5 * (float(np.trace(R)) - 1.0))))
