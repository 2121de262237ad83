"""Deformable stream: the vertices of a deformable mesh, each frame decodable by itself.

Coordinates lie on a lattice fixed in the world, whose step is a power of two, so a vertex at rest does not flicker and
`index * step` is exact in every language. Each index is predicted from others of the same frame in the order of the
`DeformableTopology`; what remains is small, is split into planes of bytes, and is deflated. A vertex off the
lattice (not finite, kilometres away) escapes as float32.

Payload, little-endian (normative: docs/deformables.md): header, escapes, planes.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from iris_session.protocol.names import BudgetClass
from iris_session.streams.deformable_topology import DeformableTopology
from iris_session.streams.errors import StreamError

FORMAT: Final = 2
#: Bounds [m] of the classes are those of `full` times this.
COARSER: Final = {BudgetClass.FULL: 1.0, BudgetClass.HALF: 2.0, BudgetClass.QUARTER: 4.0}
MIN_BOUND_M: Final = 1e-5
MAX_BOUND_M: Final = 1.0
#: Calls after which a mesh at rest is sent again: a second at 60 Hz.
REPEAT_AFTER: Final = 60
#: Share of the bound for the error of the lattice. A vertex may drift by the rest before the mesh is sent again.
_LATTICE_SHARE: Final = 0.9
#: Farthest node from the world's origin: float32 has room for another bit. 4 km at a bound of 0.5 mm.
MAX_NODE: Final = 2**23
#: Flag: the planes are one stream of raw deflate.
_PACKED: Final = 1
#: format u8, flags u8, planes u8, exponent i8, bound f32 [m], vertices u32, identity u32, escaped u32, origin 3 x i32.
_HEADER: Final = struct.Struct("<BBBbfIII3i")
_ESCAPE: Final = np.dtype([("vertex", "<u4"), ("position", "<f4", (3,))])

Floats = npt.NDArray[np.float64]
Positions = npt.NDArray[np.float32]
Nodes = npt.NDArray[np.int32]


class FrameHeader(NamedTuple):
    """Header of a frame. `bound_m`: farthest that a vertex is from where it was, step = 2 ** `exponent`."""

    planes: int
    packed: bool
    exponent: int
    bound_m: float
    n_vertices: int
    identity: int
    n_escaped: int
    origin: tuple[int, int, int]


def exponent_for(bound_m: float) -> int:
    """Return the exponent of the lattice step for a bound [m].

    The largest power of two that keeps half the diagonal of a cell within the lattice's share of the bound.
    """
    return math.floor(math.log2(_LATTICE_SHARE * bound_m * 2.0 / math.sqrt(3.0)))


class DeformableEncoder:
    """Encoder of one mesh. Deterministic: the same calls give the same bytes (with one version of zlib).

    Args:
        topology: Triangles and lines of the mesh.
        bound_m: Every vertex of every frame is at most so far from where it is (Euclidean) [m], also while nothing is
            sent.
        repeat_after: Calls after which what rests is sent again, for those who joined meanwhile.

    Raises:
        ValueError: A bound or interval that cannot work.
    """

    def __init__(self, topology: DeformableTopology, bound_m: float = 0.0005, repeat_after: int = REPEAT_AFTER) -> None:
        if not MIN_BOUND_M <= bound_m <= MAX_BOUND_M:
            raise ValueError(f"bound_m is {bound_m}: {MIN_BOUND_M:g} to {MAX_BOUND_M:g} m are possible")
        if repeat_after < 1:
            raise ValueError(f"repeat_after is {repeat_after}: at least 1 call")
        self.topology = topology
        self.bound_m = bound_m
        #: Distance that a vertex may move before the mesh is sent again: the bound less the error of the lattice.
        self.drift_m = 0.995 * bound_m - 2.0 ** exponent_for(bound_m) * math.sqrt(3.0) / 2.0
        self._repeat_after = repeat_after
        self._sent: Floats | None = None
        self._rested = 0
        self._scaled = np.empty((3, topology.n_vertices))

    def reset(self) -> None:
        """Send the next frame even if nothing moved: for a new scene epoch."""
        self._sent = None

    def encode(
        self, vertices: npt.NDArray[np.floating], classes: Sequence[str] = (BudgetClass.FULL,)
    ) -> dict[str, bytes] | None:
        """Encode the vertices if they have moved.

        Args:
            vertices: (n, 3) [m], world frame; any value is accepted.
            classes: Classes to make. The bound of `half` is twice that of `full`, of `quarter` four times.

        Returns:
            Payloads by class, for `Session.publish_media`; None while nothing has moved.

        Raises:
            ValueError: Another shape, or an unknown class.
        """
        if vertices.shape != (self.topology.n_vertices, 3):
            raise ValueError(f"vertices have shape {vertices.shape}, expected ({self.topology.n_vertices}, 3)")
        if unknown := [name for name in classes if name not in COARSER]:
            raise ValueError(f"{unknown[0]!r} is no class of a deformable stream: expected {', '.join(COARSER)}")
        self._rested += 1
        if self._is_at_rest(vertices) and self._rested < self._repeat_after:
            return None
        self._rested = 0
        self._sent = np.array(vertices, np.float64)
        return {name: self._encode_frame(self._sent, self.bound_m * COARSER[name]) for name in classes}

    def _is_at_rest(self, vertices: npt.NDArray[np.floating]) -> bool:
        if self._sent is None:
            return False
        with np.errstate(invalid="ignore", over="ignore"):
            moved = vertices - self._sent
            squares = np.einsum("ij,ij->i", moved, moved)
            return bool(squares.max() <= self.drift_m**2)  # false for what is not finite

    def _encode_frame(self, vertices: Floats, bound_m: float) -> bytes:
        exponent = exponent_for(bound_m)
        nodes, escaped = self._to_nodes(vertices, exponent)
        origin = nodes[:, :1].copy()
        residuals = _predict_residuals(self.topology, nodes - origin)
        coded = ((residuals << 1) ^ (residuals >> 31)).view(np.uint32)  # small numbers of either sign become small
        n_planes = (int(coded.max()).bit_length() + 7) // 8
        planes = _split_planes(coded, n_planes)
        packed = _deflate(planes)
        flags = _PACKED if len(packed) < len(planes) else 0
        head = _HEADER.pack(
            FORMAT,
            flags,
            n_planes,
            exponent,
            bound_m,
            self.topology.n_vertices,
            self.topology.identity,
            len(escaped),
            *origin[:, 0].tolist(),
        )
        return b"".join((head, _encode_escapes(vertices, escaped), packed if flags else planes))

    def _to_nodes(self, vertices: Floats, exponent: int) -> tuple[Nodes, npt.NDArray[np.int64]]:
        """Return lattice nodes (3, n) in the order of the topology, and the vertices that have none."""
        scaled = self._scaled
        with np.errstate(invalid="ignore", over="ignore"):
            np.multiply(vertices.T, 2.0**-exponent, out=scaled)
            np.rint(scaled, out=scaled)
            fits = scaled.min() >= -MAX_NODE and scaled.max() <= MAX_NODE
        escaped = np.empty(0, np.int64)
        if not fits:
            inside = np.asarray((np.abs(scaled) <= MAX_NODE).all(axis=0))
            escaped = np.flatnonzero(~inside)
            # A node that costs few bytes: that of any vertex which has one.
            scaled[:, escaped] = scaled[:, [int(np.argmax(inside))]] if inside.any() else 0.0
        nodes = scaled.astype(np.int32)
        return (nodes if self.topology.order is None else nodes[:, self.topology.order]), escaped


class DeformableDecoder:
    """Decoder of one mesh; it keeps nothing between frames. `bound_m`: that of the newest frame, 0 before the first."""

    def __init__(self, topology: DeformableTopology) -> None:
        self.topology = topology
        self.bound_m = 0.0

    def decode(self, payload: bytes | memoryview) -> Positions:
        """Decode a frame.

        Args:
            payload: Payload of any class, as `DeformableEncoder.encode` makes it.

        Returns:
            Vertices (n, 3) [m], world frame, in a new array.

        Raises:
            StreamError: The bytes are no frame of this mesh.
        """
        header = read_header(payload)
        topology = self.topology
        if header.n_vertices != topology.n_vertices or header.identity != topology.identity:
            raise StreamError(
                f"frame of a mesh of {header.n_vertices} vertices, identity {header.identity:08x}, expected "
                f"{topology.n_vertices} and {topology.identity:08x}: take the topology of the present scene"
            )
        at = _HEADER.size + header.n_escaped * _ESCAPE.itemsize
        if header.n_escaped > topology.n_vertices or len(payload) < at:
            raise StreamError(f"{header.n_escaped} escapes do not fit {len(payload)} bytes")
        escapes = np.frombuffer(payload, _ESCAPE, header.n_escaped, _HEADER.size)
        vertex = escapes["vertex"].astype(np.int64)
        if len(vertex) and (vertex[-1] >= topology.n_vertices or (np.diff(vertex) <= 0).any()):
            raise StreamError("escaped vertices are not ascending and in range")
        coded = self._unpack_planes(memoryview(payload)[at:], header)
        residuals = (coded >> np.uint32(1)).view(np.int32) ^ -(coded & np.uint32(1)).view(np.int32)
        nodes = _undo_prediction(topology, residuals)
        nodes += np.array(header.origin, np.int32)[:, None]
        positions = np.empty((topology.n_vertices, 3), np.float32)
        scaled = nodes.astype(np.float32)
        scaled *= np.float32(2.0**header.exponent)
        positions[slice(None) if topology.order is None else topology.order] = scaled.T
        positions[vertex] = escapes["position"]
        self.bound_m = header.bound_m
        return positions

    def _unpack_planes(self, packed: memoryview, header: FrameHeader) -> npt.NDArray[np.uint32]:
        """Return the numbers (3, n) whose bytes the planes hold."""
        size = 3 * self.topology.n_vertices * header.planes
        planes: bytes | memoryview = packed
        if header.packed:
            inflater = zlib.decompressobj(-zlib.MAX_WBITS)
            try:
                planes = inflater.decompress(packed, size + 1)  # room to see that there is more than was asked for
            except zlib.error as error:
                raise StreamError(f"packed planes are damaged: {error}") from None
            if len(planes) != size or not inflater.eof or inflater.unused_data:
                raise StreamError(f"packed planes are not one stream of {size} bytes")
        if len(planes) != size:
            raise StreamError(f"planes of {len(planes)} bytes, their header asks for {size}")
        coded = np.zeros((3, self.topology.n_vertices), "<u4")
        if header.planes:
            coded.view(np.uint8).reshape(-1, 4)[:, : header.planes] = (
                np.frombuffer(planes, np.uint8).reshape(header.planes, -1).T
            )
        return coded.astype(np.uint32, copy=False)


def read_header(payload: bytes | memoryview) -> FrameHeader:
    """Return the header of a frame. Raises `StreamError`."""
    if len(payload) < _HEADER.size:
        raise StreamError(f"frame of {len(payload)} bytes, shorter than its header of {_HEADER.size}")
    form, flags, planes, exponent, bound_m, n, identity, n_escaped, x, y, z = _HEADER.unpack_from(payload)
    if form != FORMAT or flags & ~_PACKED or planes > 4:
        raise StreamError(f"frame of format {form}, flags {flags}, {planes} planes: format {FORMAT} is known")
    if not exponent_for(MIN_BOUND_M) <= exponent <= exponent_for(MAX_BOUND_M * 4.0) or not 0.0 < bound_m < math.inf:
        raise StreamError(f"frame with a lattice of 2^{exponent} m and a bound of {bound_m} m")
    return FrameHeader(planes, bool(flags), exponent, bound_m, n, identity, n_escaped, (x, y, z))


def interpolate(a: Positions, b: Positions, t: float) -> Positions:
    """Interpolate between two decoded frames, `t` = 0 at `a` and 1 at `b`; not beyond them. (n, 3)."""
    t = min(max(t, 0.0), 1.0)
    return a + (b - a) * np.float32(t)


# --- inside ---------------------------------------------------------------------------------------------------------


def _predict_residuals(topology: DeformableTopology, nodes: Nodes) -> Nodes:
    """Return the residuals of `nodes` (3, n) after prediction; int32, which wraps."""
    if topology.parents is not None:
        a, b, c = topology.parents
        residuals: Nodes = nodes - np.take(nodes, a, axis=1) - np.take(nodes, b, axis=1)
        residuals += np.take(nodes, c, axis=1)
        residuals[:, 0] = nodes[:, 0]
        return residuals
    grid = nodes.reshape(3, topology.rows, topology.cols)
    along = grid.copy()
    along[:, :, 1:] -= grid[:, :, :-1]
    both = along.copy()
    both[:, 1:] -= along[:, :-1]
    return both.reshape(3, -1)


def _undo_prediction(topology: DeformableTopology, residuals: Nodes) -> Nodes:
    """Undo `_predict_residuals`; may overwrite the argument."""
    if topology.parents is not None:
        a, b, c = topology.parents
        for begin, end in topology.levels:
            level = residuals[:, begin:end]
            level += residuals[:, a[begin:end]]
            level += residuals[:, b[begin:end]]
            level -= residuals[:, c[begin:end]]
        return residuals
    grid = residuals.reshape(3, topology.rows, topology.cols)
    np.cumsum(grid, axis=1, dtype=np.int32, out=grid)
    np.cumsum(grid, axis=2, dtype=np.int32, out=grid)
    return residuals


def _split_planes(coded: npt.NDArray[np.uint32], n_planes: int) -> bytes:
    """Return the lowest bytes of all numbers, then the next ones."""
    if n_planes == 1:
        return coded.astype(np.uint8).tobytes()
    return coded.astype("<u4", copy=False).view(np.uint8).reshape(-1, 4)[:, :n_planes].T.tobytes()


def _deflate(planes: bytes) -> bytes:
    """Compress planes. Residuals repeat nothing but single bytes: to look for runs alone is smaller and faster."""
    compressor = zlib.compressobj(wbits=-zlib.MAX_WBITS, strategy=zlib.Z_RLE)
    return compressor.compress(planes) + compressor.flush()


def _encode_escapes(vertices: Floats, escaped: npt.NDArray[np.int64]) -> bytes:
    escapes = np.empty(len(escaped), _ESCAPE)
    escapes["vertex"] = escaped
    with np.errstate(over="ignore"):
        escapes["position"] = vertices[escaped]
    return escapes.tobytes()
