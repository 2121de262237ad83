"""The asset of a deformable: what is joined to what, the vertices at rest, and the plan of its stream."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.names import ArrayFilter, ArrayKind, ArrayName
from iris_session.scene.arrays import Stored, encode_arrays
from iris_session.streams.deformable_topology import DeformableTopology

#: Below this many vertices their numbers fit 16 bits.
_SHORT: Final = 1 << 16


def encode_deformable(
    elements: NDArray[np.uint32],
    uv: NDArray[np.float32] | None,
    rest: NDArray[np.float32],
    topology: DeformableTopology,
    numbers: NDArray[Any] | None = None,
) -> bytes:
    """`elements`: edges (m, 2) or triangles (m, 3); `uv` (m, corners, 2). `rest`: vertices (n, 3) [m], world frame.

    `topology`: bare, its triangles are `elements`. `numbers`: of the vertices in the simulator, if some are left out.
    """
    narrow = elements.astype(np.uint16) if len(rest) <= _SHORT else elements
    arrays = [
        Stored(ArrayName.ELEMENTS, narrow, ArrayFilter.DELTA),
        Stored(ArrayName.POSITION, rest, ArrayFilter.SHUFFLE),
        Stored(ArrayName.PLAN, np.frombuffer(topology.to_bytes(), np.uint8)),
    ]
    if numbers is not None:
        arrays.append(Stored(ArrayName.VERTEX, numbers.astype(np.uint32), ArrayFilter.DELTA))
    if uv is not None:
        arrays.append(Stored(ArrayName.UV, uv, ArrayFilter.SHUFFLE))
    return encode_arrays(ArrayKind.DEFORMABLE, arrays)
