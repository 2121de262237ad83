"""Point cloud frames: a header, then points of 8 bytes that a graphics card takes as they are.

Coordinates lie on a lattice fixed in the world, whose step is a power of two: three uint16 beyond the origin of the
frame, and a colour of 16 bits. Points are in an order in which every beginning of a frame is a fair sample of the
whole, so that a coarser class is the frame cut short, and a client draws as many points as it can.

Payload, little-endian (normative: docs/clouds.md): header, points.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from iris_session.protocol.names import BudgetClass
from iris_session.streams.errors import StreamError

FORMAT: Final = 1
#: Share of the points of `full` that the classes have.
SHARES: Final = {BudgetClass.FULL: 1.0, BudgetClass.HALF: 0.5, BudgetClass.QUARTER: 0.25}
#: Points of a frame: 16 MiB.
MAX_POINTS: Final = 2**21
#: Exponents of the step: 0.06 mm, over 4 m, to 62 mm, over 4 km.
MIN_EXPONENT: Final = -14
MAX_EXPONENT: Final = -4
#: Farthest origin, in nodes: with 65,535 beyond it, every coordinate is exact in float32.
MAX_ORIGIN: Final = 2**23
#: Edges of a cell that a point may stand for [m].
MAX_VOXEL_M: Final = 10.0
#: Least error that can be stated; from `MAX_ERROR_M` on it is not known [m].
MIN_ERROR_M: Final = 1e-6
MAX_ERROR_M: Final = 1e6
_LAST_NODE: Final = 0xFFFF
#: Numbers that are decoded at once, four of each point.
_BLOCK: Final = 1024
#: format u8, flags u8, exponent i8, reserved u8, points u32, origin 3 x i32, error and voxel f32 [m], reserved u32.
_HEADER: Final = struct.Struct("<BBbBI3iffI")
HEADER_BYTES: Final = _HEADER.size
POINT: Final = np.dtype([("node", "<u2", (3,)), ("color", "<u2")])
#: Odd numbers with bits everywhere, for the order of points: from the generator of SplitMix64, cut to 32 bits.
_MIXERS: Final = (np.uint32(0x9E3779B1), np.uint32(0xBF58476D), np.uint32(0x94D049BB))

Floats = npt.NDArray[np.float32]
Bytes = npt.NDArray[np.uint8]


class CloudHeader(NamedTuple):
    """Header of a frame.

    Attributes:
        exponent: The step of the lattice is 2 ** `exponent` [m].
        n_points: Number of points.
        origin: Lattice node to which those of the points are added.
        error_m: Where a point is stated to be within, 95 % of the time, with the calibration of its camera [m];
            infinite where that is not known.
        voxel_m: Edge of the cell that a point stands for, in a coarser class a larger one; 0 where it stands for
            itself [m].
    """

    exponent: int
    n_points: int
    origin: tuple[int, int, int]
    error_m: float
    voxel_m: float

    @property
    def quantum_error_m(self) -> float:
        """Farthest that the lattice puts a point from where its source saw it [m]."""
        return 2.0**self.exponent * math.sqrt(3.0) / 2.0


class CloudFrame(NamedTuple):
    """A decoded frame.

    Attributes:
        positions: (n, 3) [m], world frame.
        colors: (n, 4) red, green, blue, and 255.
        error_m: As in `CloudHeader`.
        voxel_m: As in `CloudHeader`.
    """

    positions: Floats
    colors: Bytes
    error_m: float
    voxel_m: float


def encode_cloud(
    positions: npt.NDArray[np.floating],
    colors: Bytes,
    *,
    voxel_m: float = 0.0,
    error_m: float = math.inf,
    classes: Sequence[str] = (BudgetClass.FULL,),
) -> dict[str, bytes]:
    """Encode points. Deterministic: the same points give the same bytes.

    Args:
        positions: (n, 3) [m], world frame. Points that are not finite are left out.
        colors: (n, 3) uint8, red, green, blue.
        voxel_m: Edge of the cells that the points stand for [m]; it also decides which points a beginning has, so that
            a point at rest stays in a coarser class from frame to frame. 0: points stand for themselves.
        error_m: Bound of the error that their source states, 95 % [m].
        classes: Classes to make.

    Returns:
        Payloads by class, for `Session.publish_media` and `Client.publish_media`.

    Raises:
        ValueError: Shapes that do not fit, an unknown class, an extent of more than 4 km.
    """
    if positions.ndim != 2 or positions.shape[1] != 3 or colors.shape != positions.shape or colors.dtype != np.uint8:
        raise ValueError(
            f"positions of shape {positions.shape} and colours of shape {colors.shape}, {colors.dtype}: expected "
            "(n, 3), and (n, 3) of uint8"
        )
    if unknown := [name for name in classes if name not in SHARES]:
        raise ValueError(f"{unknown[0]!r} is no class of a point cloud: expected {', '.join(SHARES)}")
    if not 0.0 <= voxel_m <= MAX_VOXEL_M or not error_m >= MIN_ERROR_M:
        raise ValueError(
            f"voxel_m is {voxel_m}, error_m {error_m}: 0 to {MAX_VOXEL_M:g} m, and {MIN_ERROR_M:g} m or more"
        )
    error_m = error_m if error_m < MAX_ERROR_M else math.inf
    rows = np.array(positions.T, order="C")  # whole rows are several times faster than columns
    if not np.isfinite(rows).all():
        finite = np.isfinite(rows).all(axis=0)
        rows, colors = rows[:, finite], colors[finite]
    if rows.shape[1] > MAX_POINTS:
        raise ValueError(f"{rows.shape[1]} points: a frame has at most {MAX_POINTS}")
    exponent, nodes, origin = _place_on_lattice(rows)
    points = np.empty(rows.shape[1], POINT)
    points["node"] = nodes.T
    points["color"] = pack_colors(colors)
    points = points[order_points(rows, voxel_m or 2.0**exponent)]
    frames = {}
    for name in classes:
        n = math.ceil(SHARES[name] * len(points))
        edge_m = min(
            voxel_m / math.sqrt(SHARES[name]), MAX_VOXEL_M
        )  # of surfaces, a point of `half` has twice the area
        head = _HEADER.pack(FORMAT, 0, exponent, 0, n, *origin, error_m, edge_m, 0)
        frames[name] = head + points[:n].tobytes()
    return frames


def decode_cloud(payload: bytes | memoryview) -> CloudFrame:
    """Decode a frame.

    Args:
        payload: Payload of any class, as `encode_cloud` makes it.

    Returns:
        Points in the world frame, and what their source states of them.

    Raises:
        StreamError: The bytes are no frame.
    """
    header = read_header(payload)
    n = 4 * header.n_points
    # Whole points at once, colours too: a row of numbers is several times faster than a column. All sums are exact.
    values = np.empty(-(-n // _BLOCK) * _BLOCK, np.float32)
    values[:n], values[n:] = np.frombuffer(payload, "<u2", n, HEADER_BYTES), 0.0
    blocks = values.reshape(-1, _BLOCK)
    blocks += np.tile(np.array([*header.origin, 0], np.float32), _BLOCK // 4)
    blocks *= np.float32(2.0**header.exponent)
    packed = (np.frombuffer(payload, "<u8", header.n_points, HEADER_BYTES) >> np.uint64(48)).view(np.int64)
    positions = values[:n].reshape(-1, 4)[:, :3]
    return CloudFrame(positions, unpack_colors(packed), header.error_m, header.voxel_m)


def read_header(payload: bytes | memoryview) -> CloudHeader:
    """Return the header of a frame whose points are all there. Raises `StreamError`."""
    if len(payload) < HEADER_BYTES:
        raise StreamError(f"frame of {len(payload)} bytes, shorter than its header of {HEADER_BYTES}")
    form, flags, exponent, reserved, n, x, y, z, error_m, voxel_m, also_reserved = _HEADER.unpack_from(payload)
    if form != FORMAT or flags or reserved or also_reserved:
        raise StreamError(f"frame of format {form}, flags {flags}: format {FORMAT} without flags is known")
    if not MIN_EXPONENT <= exponent <= MAX_EXPONENT or max(abs(x), abs(y), abs(z)) > MAX_ORIGIN:
        raise StreamError(f"frame with a lattice of 2^{exponent} m from node {(x, y, z)}")
    if not error_m > 0.0 or not 0.0 <= voxel_m <= MAX_VOXEL_M:
        raise StreamError(f"frame with an error of {error_m} m and voxels of {voxel_m} m")
    if n > MAX_POINTS or len(payload) != HEADER_BYTES + n * POINT.itemsize:
        raise StreamError(f"{n} points do not make a frame of {len(payload)} bytes")
    return CloudHeader(exponent, n, (x, y, z), error_m, voxel_m)


def order_points(rows: npt.NDArray[np.floating], cell_m: float) -> npt.NDArray[np.intp]:
    """Return the order in which every beginning is a fair sample: by a number that hides where the cell of a point is.

    Args:
        rows: (3, n), x, y and z [m], world frame, finite, within 4 km.
        cell_m: Edge of the cells [m]. Points of one cell keep their order.
    """
    number = np.zeros(rows.shape[1], np.uint32)
    for row, mixer in zip(rows, _MIXERS, strict=True):
        number ^= np.floor(row * (1.0 / cell_m)).astype(np.int64).astype(np.uint32)
        number *= mixer
        number ^= number >> np.uint32(15)
    return np.argsort((number >> np.uint32(16)).astype(np.uint16), kind="stable")


def pack_colors(colors: Bytes) -> npt.NDArray[np.uint16]:
    """Return colours (n, 3) as 16 bits: 5 of red, the highest, 6 of green, 5 of blue; to the nearest level."""
    red, green, blue = (_LEVELS[axis][colors[:, axis]] for axis in range(3))
    return np.asarray(red | green | blue, np.uint16)


def unpack_colors(packed: npt.NDArray[np.integer]) -> Bytes:
    """Return colours (n, 4) of 16 bits: red, green, blue, 255."""
    return _RGBA.take(packed, mode="clip").view(np.uint8).reshape(-1, 4)


def _make_color_tables() -> tuple[tuple[npt.NDArray[np.uint16], ...], npt.NDArray[np.uint32]]:
    """Return the bits of each part of a colour, and the colour of each number of 16 bits."""
    levels = []
    for bits, shift in ((5, 11), (6, 5), (5, 0)):
        share = np.arange(256) * (2**bits - 1) / 255.0
        levels.append((np.rint(share).astype(np.uint16) << shift).astype(np.uint16))
    numbers = np.arange(2**16, dtype=np.uint32)
    rgba = np.full((2**16, 4), 255, np.uint8)
    for part, (bits, shift) in enumerate(((5, 11), (6, 5), (5, 0))):
        level = (numbers >> np.uint32(shift)) & np.uint32(2**bits - 1)
        rgba[:, part] = np.rint(level * 255.0 / (2**bits - 1))
    return tuple(levels), rgba.view(np.uint32)[:, 0]


_LEVELS, _RGBA = _make_color_tables()


def _place_on_lattice(
    rows: npt.NDArray[np.floating],
) -> tuple[int, npt.NDArray[np.uint16], tuple[int, int, int]]:
    """Return the exponent of the finest step with room for all points (3, n), their nodes (3, n), and the origin."""
    if not rows.size:
        return MIN_EXPONENT, np.empty((3, 0), np.uint16), (0, 0, 0)
    low, high = rows.min(axis=1).astype(np.float64), rows.max(axis=1).astype(np.float64)
    for exponent in range(MIN_EXPONENT, MAX_EXPONENT + 1):
        step = 2.0**exponent
        origin = np.floor(low / step)
        if (np.ceil(high / step) - origin).max() <= _LAST_NODE and np.abs(origin).max() <= MAX_ORIGIN:
            break
    else:
        raise ValueError(f"points from {low.round(1)} to {high.round(1)} m: a frame has room for 4 km")
    nodes = rows * rows.dtype.type(1.0 / step)
    nodes -= origin.astype(nodes.dtype)[:, None]
    np.rint(nodes, out=nodes)
    first, second, third = (int(x) for x in origin)
    return exponent, nodes.astype(np.uint16), (first, second, third)
