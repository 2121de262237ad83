"""The number formats: worst-case errors are what the constants say, and are nearly reached."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from iris_session.streams.errors import StreamError
from iris_session.streams.quantise import (
    LATTICE_M,
    POSITION_QUANTUM_ERROR_M,
    ROTATION_LEVELS,
    ROTATION_QUANTUM_ERROR_RAD,
    pack_words,
    rotation_codes,
    rotations,
    unpack_words,
)
from tests.streams.poses import random_poses, rotation_errors


def test_six_bytes_hold_the_room() -> None:
    assert np.prod(np.floor(np.array([10.0, 10.0, 3.0]) / LATTICE_M) + 2) <= 2**48
    assert pytest.approx(9.25e-5, rel=1e-3) == POSITION_QUANTUM_ERROR_M


def test_levels_fit_five_bytes() -> None:
    assert 4 * ROTATION_LEVELS**3 <= 2**40 < 4 * (ROTATION_LEVELS + 2) ** 3


def test_rotation_error_is_bounded_everywhere() -> None:
    q = random_poses(np.random.default_rng(1), 200_000)[:, 3:]
    assert rotation_errors(q, rotations(rotation_codes(q))).max() <= ROTATION_QUANTUM_ERROR_RAD


def test_rotation_error_is_bounded_and_reached_at_the_worst_place() -> None:
    """Around (1, 1, 1, 1) / 2 with half a step of rounding on all three components, of the same sign."""
    rng = np.random.default_rng(2)
    half = 0.5 * math.sqrt(2.0) / (ROTATION_LEVELS - 1)
    signs = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    grid = np.rint(0.5 / (2 * half)) * 2 * half
    rest = signs[rng.integers(8, size=20_000)] * (grid + half * rng.uniform(-9.0, 9.0, (20_000, 1)))
    rest = rest[np.einsum("ij,ij->i", rest, rest) < 0.7499]
    q = np.hstack((np.sqrt(1.0 - np.einsum("ij,ij->i", rest, rest))[:, None], rest))
    errors = rotation_errors(q, rotations(rotation_codes(q)))
    assert errors.max() <= ROTATION_QUANTUM_ERROR_RAD
    assert errors.max() >= 0.98 * ROTATION_QUANTUM_ERROR_RAD


def test_axes_and_ties_are_exact_or_bounded() -> None:
    q = np.array([v for v in itertools.product((-1.0, 0.0, 1.0), repeat=4) if any(v)])
    q /= np.linalg.norm(q, axis=1)[:, None]
    assert rotation_errors(q, rotations(rotation_codes(q))).max() <= ROTATION_QUANTUM_ERROR_RAD
    one = np.eye(4)
    np.testing.assert_array_equal(rotations(rotation_codes(one)), one)
    np.testing.assert_array_equal(rotations(rotation_codes(-one)), one)


@pytest.mark.parametrize("code", [4 * ROTATION_LEVELS**3, 2**40 - 1, 0])
def test_codes_of_no_rotation_are_refused(code: int) -> None:
    with pytest.raises(StreamError, match="no unit quaternion"):
        rotations(np.array([code], np.uint64))


def test_every_second_code_is_reproduced() -> None:
    """code -> rotation -> code is the identity away from ties of the largest component."""
    q = random_poses(np.random.default_rng(3), 50_000)[:, 3:]
    ordered = np.sort(np.abs(q), axis=1)
    codes = rotation_codes(q[ordered[:, 3] - ordered[:, 2] > 1e-3])
    np.testing.assert_array_equal(rotation_codes(rotations(codes)), codes)


@pytest.mark.parametrize("n_bytes", range(1, 9))
def test_words_round_trip(n_bytes: int) -> None:
    top = 256**n_bytes - 1
    words = np.array([0, 1, top // 3, top], np.uint64)
    data = pack_words(words, n_bytes)
    assert len(data) == 4 * n_bytes
    assert data[n_bytes : 2 * n_bytes] == (1).to_bytes(n_bytes, "little")
    np.testing.assert_array_equal(unpack_words(data, n_bytes), words)
