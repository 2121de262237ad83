"""Number formats of the state stream: positions on a fixed world lattice, rotations as smallest three in 40 bits.

Both are normative (`docs/protocol.md`, "Quantisation") and carry their worst-case error as a constant beside them.
"""

from __future__ import annotations

import math
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from iris_session.streams.errors import StreamError

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Words = npt.NDArray[np.uint64]

#: Edge of the position lattice [m], 0.1068 mm. A binary fraction: `index * LATTICE_M` is exact in float64, and
#: 2**48 cells are 343 m^3, so that six bytes hold any position in a 10 x 10 x 3 m room.
LATTICE_M: Final = 7.0 / 65536.0
#: Farthest that a point can be from its lattice node: half the space diagonal of a cell [m], 0.0925 mm.
POSITION_QUANTUM_ERROR_M: Final = LATTICE_M * math.sqrt(3.0) / 2.0

#: Levels per component of a smallest-three quaternion. The largest odd number (so that 0 is a level, and the identity
#: is exact) with 4 * levels**3 <= 2**40.
ROTATION_LEVELS: Final = 6501
ROTATION_BYTES: Final = 5
_HALF: Final = (ROTATION_LEVELS - 1) // 2
_PER_UNIT: Final = _HALF * math.sqrt(2.0)
#: Largest angle between a rotation and its code [rad], 0.0432 deg: 2 |dq|, |dq| <= |d| / q_max, q_max >= 1/2 and
#: |d| <= sqrt(3) half steps (proof in docs/protocol.md; the factor covers the second-order term).
ROTATION_QUANTUM_ERROR_RAD: Final = 1.001 * 2.0 * 2.0 * math.sqrt(3.0) * 0.5 / _PER_UNIT
#: Sum of squares of the three sent components: at most 3/4 before rounding. Above this no encoder made the code.
_MAX_SQUARES: Final = 0.76

#: Components that are sent when component `i` is the largest.
_OTHERS: Final = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
#: Where `w, x, y, z` stand in (sent, sent, sent, largest) when component `i` is the largest.
_PLACES: Final = np.array([[3, 0, 1, 2], [0, 3, 1, 2], [0, 1, 3, 2], [0, 1, 2, 3]])
_LEVELS: Final = np.uint64(ROTATION_LEVELS)
#: By width in bytes: the bits of one word.
_MASKS: Final = tuple(np.uint64(2 ** (8 * width) - 1) for width in range(9))
#: Follows the last word, so that eight bytes can be read from where it begins.
PADDING: Final = bytes(7)
_TWO: Final = np.uint64(2)
_THREE: Final = np.uint64(3)


def rotation_codes(q: Floats) -> Words:
    """Codes (m,) of unit quaternions `q` (m, 4) `[w, x, y, z]`.

    code = largest + 4 * (a + 6501 * (b + 6501 * c)): the index of the component of largest magnitude, and the other
    three in their order, with the sign that makes the largest positive, rounded to steps of sqrt(2) / 6500.
    """
    flat = q.ravel()  # `take` from it costs half of indexing with two arrays
    rows = np.arange(0, 4 * len(q), 4)
    largest = np.abs(q).argmax(axis=1)
    scale = np.where(flat.take(rows + largest) < 0.0, -_PER_UNIT, _PER_UNIT)
    # No clipping: next to a component at least as large, none of a unit quaternion exceeds 1 / sqrt(2).
    sent = flat.take(rows[:, None] + _OTHERS.take(largest, axis=0))
    levels = np.rint(sent * scale[:, None]).astype(np.int64) + _HALF
    packed = levels[:, 0] + ROTATION_LEVELS * (levels[:, 1] + ROTATION_LEVELS * levels[:, 2])
    codes: Words = (largest + 4 * packed).astype(np.uint64)
    return codes


def rotations(codes: Words) -> Floats:
    """Unit quaternions (m, 4) of `codes` (m,). Raises `StreamError` for a code that stands for no rotation."""
    n = len(codes)
    rest = codes >> _TWO
    high = rest // _LEVELS  # division of unsigned integers by a constant is vectorised, divmod is not
    c = high // _LEVELS
    parts = np.empty((4, n))  # a component in a row: whole rows are several times faster than columns
    sent = parts[:3]
    parts[0] = rest - high * _LEVELS
    parts[1] = high - c * _LEVELS
    parts[2] = c
    sent -= _HALF
    sent *= 1.0 / _PER_UNIT
    squares = np.einsum("ij,ij->j", sent, sent)
    if n and not (squares.max() <= _MAX_SQUARES and c.max() < _LEVELS):
        raise StreamError("a rotation code stands for no unit quaternion")
    np.sqrt(1.0 - squares, out=parts[3])
    order = (n * _PLACES).take((codes & _THREE).view(np.int64), axis=0)
    order += np.arange(n)[:, None]
    q: Floats = parts.take(order)
    return q


def pack_words(words: npt.NDArray[Any], n_bytes: int) -> bytes:
    """The low `n_bytes` (1 to 8) of each non-negative integer, little-endian, one after the other."""
    return np.ascontiguousarray(words, dtype="<u8").view(np.uint8).reshape(-1, 8)[:, :n_bytes].tobytes()


def unpack_words(data: bytes | memoryview, n_bytes: int) -> Words:
    """Inverse of `pack_words`; `len(data)` must be a multiple of `n_bytes`."""
    return words_at(bytes(data) + PADDING, 0, len(data) // n_bytes, n_bytes)


def words_at(padded: bytes, offset: int, n: int, n_bytes: int) -> Words:
    """`n` words of `n_bytes` (1 to 8) from byte `offset` of `padded`, which has `PADDING` at its end."""
    # Eight bytes are read at every n_bytes: what follows each word is masked off, and the last one needs room.
    words: Words = np.ndarray((n,), "<u8", padded, offset, (n_bytes,)) & _MASKS[n_bytes]
    return words
