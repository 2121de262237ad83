"""Golden vectors of point cloud frames, for tests of this and every other decoder.

docs/protocol/cloud.json, written by `python -m tools.codegen cloud`: frames with the points that they decode to.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import numpy.typing as npt

from iris_session.streams.cloud import SHARES, decode_cloud, encode_cloud
from tools.codegen.vectors import render_vectors, scatter_numbers, to_json_numbers

Floats = npt.NDArray[np.float64]
Colors = npt.NDArray[np.uint8]
#: Name, extent [m], centre [m], points, voxel [m], stated error [m].
_CLOUDS: Final = (
    ("on a table", 0.6, (0.4, -0.2, 0.8), 24, 0.01, 0.008),
    ("a room", 9.0, (-3.0, 2.0, 1.2), 24, 0.05, 0.02),
    ("a street, far from the origin, no error stated", 3000.0, (120_000.0, -80_000.0, 30.0), 12, 0.0, float("inf")),
    ("one point", 0.0, (0.1, -0.2, 0.3), 1, 0.01, 0.005),
    ("no point", 0.0, (0.0, 0.0, 0.0), 0, 0.01, 0.005),
)


def make_cloud(n: int, extent_m: float, centre: tuple[float, float, float]) -> tuple[Floats, Colors]:
    """Return `n` scattered points (n, 3) [m] and their colours, the same on every machine."""
    positions = (scatter_numbers(3 * n).reshape(n, 3) - 0.5) * extent_m + np.array(centre)
    colors = (np.arange(3 * n) * 37 % 256).astype(np.uint8).reshape(n, 3)
    return positions, colors


def build_golden() -> dict[str, Any]:
    """Return the content of the file. Coordinates are numbers with the value of the float32."""
    rows = []
    for name, extent_m, centre, n, voxel_m, error_m in _CLOUDS:
        frames = encode_cloud(*make_cloud(n, extent_m, centre), voxel_m=voxel_m, error_m=error_m, classes=tuple(SHARES))
        for budget_class, payload in frames.items():
            decoded = decode_cloud(payload)
            rows.append(
                {
                    "name": f"{name}/{budget_class}",
                    "hex": payload.hex(),
                    "error_m": decoded.error_m if np.isfinite(decoded.error_m) else None,
                    "voxel_m": decoded.voxel_m,
                    "positions": to_json_numbers(decoded.positions),
                    "colors": decoded.colors[:, :3].tolist(),
                }
            )
    return {"format": 1, "frames": rows}


def render_golden() -> str:
    """Return the text of the file."""
    return render_vectors(build_golden())
