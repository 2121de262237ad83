"""Number formats: worst-case errors are those of the constants and are nearly reached."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from iris_session.streams.errors import StreamError
from iris_session.streams.quantise import (
    LATTICE_M,
    POSITION_QUANTUM_ERROR_M,
    ROTATION_CENTRE,
    ROTATION_QUANTUM_ERROR_RAD,
    Floats,
    Ints,
    rotation_levels,
    rotations,
)
from tests.streams.poses import random_poses, rotation_errors


def round_trip(q: Floats) -> Floats:
    """Unit quaternions (m, 4) after encoding and decoding."""
    return decoded(rotation_levels(np.ascontiguousarray(q.T))).T


def decoded(levels: Ints) -> Floats:
    """Unit quaternions (4, m) of `levels` (3, m)."""
    rows = np.empty((4, levels.shape[1]))
    rotations(levels.astype(np.int32), rows[0], rows[1:])
    return rows


def test_lattice_points_are_exact_and_the_bound_is_half_a_cell() -> None:
    assert pytest.approx(5.29e-5, rel=1e-3) == POSITION_QUANTUM_ERROR_M
    index = np.array([2**31 - 1, -(2**31), 12_345_678])
    np.testing.assert_array_equal(index * LATTICE_M / LATTICE_M, index)


def test_rotation_error_is_bounded_everywhere() -> None:
    q = random_poses(np.random.default_rng(1), 50_000)[:, 3:]
    assert rotation_errors(q, round_trip(q)).max() <= ROTATION_QUANTUM_ERROR_RAD


def test_rotation_error_bound_is_reached_next_to_the_identity() -> None:
    """Half a rounding step on all three parameters, where they are small."""
    rng = np.random.default_rng(2)
    m = (rng.integers(-30, 30, (20_000, 3)) + rng.uniform(0.49, 0.51, (20_000, 3))) / ROTATION_CENTRE
    squares = np.einsum("ij,ij->i", m, m)[:, None]
    q = np.hstack(((1.0 - squares) / (1.0 + squares), 2.0 * m / (1.0 + squares)))
    errors = rotation_errors(q, round_trip(q))
    assert errors.max() <= ROTATION_QUANTUM_ERROR_RAD
    assert errors.max() >= 0.98 * ROTATION_QUANTUM_ERROR_RAD


def test_axes_and_half_turns_are_exact_or_bounded() -> None:
    q = np.array([v for v in itertools.product((-1.0, -0.0, 0.0, 1.0), repeat=4) if any(v)])
    q /= np.linalg.norm(q, axis=1)[:, None]
    assert rotation_errors(q, round_trip(q)).max() <= ROTATION_QUANTUM_ERROR_RAD
    one = np.eye(4)
    np.testing.assert_array_equal(np.abs(round_trip(one)), one)
    np.testing.assert_array_equal(round_trip(-one[:1]), one[:1])


@pytest.mark.parametrize("levels", [(2 * ROTATION_CENTRE + 1, 8191, 8191), (0, 0, 0), (2**16 - 1,) * 3])
def test_levels_outside_the_unit_ball_are_rejected(levels: tuple[int, ...]) -> None:
    with pytest.raises(StreamError, match="rotation levels"):
        decoded(np.array([levels]).T)


def test_codes_round_trip() -> None:
    """levels -> rotation -> levels is the identity away from half turns, where m and -m are the same rotation."""
    q = random_poses(np.random.default_rng(3), 50_000)[:, 3:]
    levels = rotation_levels(np.ascontiguousarray(q[np.abs(q[:, 0]) > math.sin(1e-3)].T))
    np.testing.assert_array_equal(rotation_levels(decoded(levels)), levels)
