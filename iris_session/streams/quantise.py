"""Number formats of the state stream: positions on a fixed world lattice, rotations as modified Rodrigues parameters.

Both are normative (`docs/protocol.md`, "Quantisation") and carry their worst-case error as a constant beside them.
Arrays hold one axis per row: whole rows are several times faster than columns.
"""

from __future__ import annotations

import math
from typing import Final

import numpy as np
import numpy.typing as npt

from iris_session.streams.errors import StreamError

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

#: Edge of the position lattice [m], 0.061 mm. A power of two: `index * LATTICE_M` is exact.
LATTICE_M: Final = 2.0**-14
#: Farthest that a point can be from its lattice node: half the space diagonal of a cell [m], 0.0529 mm.
POSITION_QUANTUM_ERROR_M: Final = LATTICE_M * math.sqrt(3.0) / 2.0

#: Level of a component that is 0. Levels are 0 to twice that, for components of -1 to 1: 14 bits.
ROTATION_CENTRE: Final = 8191
ROTATION_BITS: Final = 14
#: Largest angle between a rotation and its code [rad], 0.0242 deg. A step `dm` of the parameters turns by
#: 4 |dm| / (1 + |m|^2) <= 4 |dm|, and |dm| <= sqrt(3) half steps.
ROTATION_QUANTUM_ERROR_RAD: Final = 4.0 * math.sqrt(3.0) * 0.5 / ROTATION_CENTRE
#: Squared length of parameters: at most 1 before rounding. No encoder makes levels above this.
MAX_SQUARES: Final = (1.0 + math.sqrt(3.0) * 0.5 / ROTATION_CENTRE) ** 2 + 1e-12
_STEP: Final = 1.0 / ROTATION_CENTRE


def rotation_levels(q: Floats) -> Ints:
    """Return levels (3, m) of unit quaternions `q` (4, m), rows `w x y z`.

    Modified Rodrigues parameters: m = (x, y, z) / (1 + w) of the quaternion with w >= 0, so |m| = tan(angle / 4) <= 1.
    """
    scale = ROTATION_CENTRE / (1.0 + np.abs(q[0]))
    np.copysign(scale, q[0], out=scale)
    levels: Ints = np.rint(q[1:] * scale).astype(np.int64)
    levels += ROTATION_CENTRE
    return levels


def rotations(levels: npt.NDArray[np.int32], w: Floats, xyz: Floats) -> None:
    """Write the unit quaternions of `levels` (3, m), which is overwritten, to `w` (m,) and `xyz` (3, m).

    w = 2 / (1 + |m|^2) - 1 and (x, y, z) = m * 2 / (1 + |m|^2). Raises `StreamError` for levels of no rotation.
    """
    levels -= ROTATION_CENTRE
    np.multiply(levels, _STEP, out=xyz)
    np.einsum("ij,ij->j", xyz, xyz, out=w)
    if w.size and w.max() > MAX_SQUARES:
        raise StreamError("rotation levels do not encode a rotation: their parameters are longer than 1")
    w += 1.0
    np.divide(2.0, w, out=w)
    xyz *= w
    w -= 1.0
