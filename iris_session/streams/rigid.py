"""Rigid-state stream: poses of all bodies as one small payload per frame, 12 bytes per moving body.

Error of every body of every delivered frame against the state at its tick: at most `MAX_POSITION_ERROR_M` (0.1 mm,
Euclidean) and `MAX_ROTATION_ERROR_RAD` (0.05 deg). How it is kept:

- A body is *anchored* at a pose. It is anchored anew when its pose has left the anchor by more than the drift
  allowance, so the error is at most allowance + quantisation error, also while it creeps.
- A frame holds every body that was anchored anew since frame `base_seq` (a window of frames), always with the code
  of its anchor. So a client that had any complete frame >= `base_seq` is complete again after any loss.
- Resting bodies cost their bit in the mask; a slow round robin repeats them, so that a client which was away longer
  becomes complete even without a snapshot.
- A body that cannot be quantised (not finite, far away from the others) escapes verbatim as float64.

Payload, little-endian (normative: docs/protocol.md): header, codes, mask, escapes. Codes are rows of 32-bit words, one
row per axis: 18 bits of position and 14 bits of rotation, so that every client decodes them with two operations.
"""

from __future__ import annotations

import math
import struct
from typing import Final, NamedTuple

import numpy as np
import numpy.typing as npt

from iris_session.streams.errors import StreamError
from iris_session.streams.quantise import (
    LATTICE_M,
    POSITION_QUANTUM_ERROR_M,
    ROTATION_QUANTUM_ERROR_RAD,
    Floats,
    Ints,
    rotation_levels,
    rotations,
)

MAX_POSITION_ERROR_M: Final = 1e-4
MAX_ROTATION_ERROR_RAD: Final = math.radians(0.05)
#: Drift of a pose from its anchor before it is sent again: the bound less the quantisation error, less a little for
#: rounding in float64. 46 um and 0.025 deg.
DRIFT_ALLOWANCE_M: Final = 0.995 * MAX_POSITION_ERROR_M - POSITION_QUANTUM_ERROR_M
DRIFT_ALLOWANCE_RAD: Final = 0.995 * MAX_ROTATION_ERROR_RAD - ROTATION_QUANTUM_ERROR_RAD

#: Age of `base_seq` in frames, half a second at 60 Hz: a client may lose one frame less in a row without a snapshot.
WINDOW: Final = 30
#: Frames of one round of repeats of resting bodies: ten seconds at 60 Hz.
REFRESH_FRAMES: Final = 600
MAX_BODIES: Final = 65535

FORMAT: Final = 2
#: Layouts of codes. Narrow: one word per axis, position (18 bits, a box of 16 m) below rotation (14 bits).
#: Wide: rows of 32-bit positions, then rows of 16-bit rotation levels.
NARROW: Final = 0
WIDE: Final = 1
POSITION_BITS: Final = 18
NARROW_BYTES: Final = 12
WIDE_BYTES: Final = 18
#: format u8, layout u8, n_bodies u16, n_quantised u16, n_escaped u16, origin 3 x i32.
_HEADER: Final = struct.Struct("<BBHHH3i")
_ESCAPE: Final = np.dtype([("body", "<u2"), ("pose", "<f8", (7,))])
_NO_ESCAPES: Final = np.empty(0, _ESCAPE)
_POSITION_MASK: Final = np.uint32(2**POSITION_BITS - 1)
_SHIFT: Final = np.uint32(POSITION_BITS)
_MAX_INDEX: Final = 2**31 - 1
#: Quaternions farther from unit length (squared) than this are no rotations: they escape.
_MAX_NORM_DEFECT: Final = 1e-3
_COS_ALLOWANCE: Final = math.cos(0.5 * DRIFT_ALLOWANCE_RAD)

Mask = npt.NDArray[np.bool_]


class EncodedFrame(NamedTuple):
    """One frame: its number, the oldest frame a client may hold to be complete after it, and the bytes."""

    state_seq: int
    base_seq: int
    payload: bytes


class RigidEncoder:
    """Encoder of the poses of `n_bodies` bodies, in the order of `Snapshot.bodies`.

    `first_seq`: number of the first frame, to go on counting after an encoder that it replaces.
    Deterministic: the same calls give the same bytes.
    """

    def __init__(self, n_bodies: int, first_seq: int = 1) -> None:
        if not 0 <= n_bodies <= MAX_BODIES:
            raise ValueError(f"n_bodies is {n_bodies}: a state stream holds 0 to {MAX_BODIES} bodies")
        if first_seq < 1:
            raise ValueError(f"first_seq is {first_seq}: frames are numbered from 1")
        self.n_bodies = n_bodies
        self._next_seq = first_seq
        self._scene_epoch: int | None = None
        self._anchor = np.full((7, n_bodies), np.nan)
        self._anchored_seq = np.full(n_bodies, -1, np.int64)
        self._index = np.zeros((3, n_bodies), np.int64)  # lattice node of the anchor
        self._levels = np.zeros((3, n_bodies), np.int64)
        self._escapes = np.zeros(n_bodies, np.bool_)  # anchor cannot be quantised
        self._refreshed = 0

    def encode(self, poses: Floats, scene_epoch: int) -> EncodedFrame:
        """Encode one state.

        `poses`: (n_bodies, 7) float64, world frame, `x y z qw qx qy qz` [m, unit quaternion]; any value is accepted,
        non-finite ones are sent as they are. A new `scene_epoch` sends every body again.
        Raises `ValueError` for another shape.
        """
        if poses.shape != (self.n_bodies, 7):
            raise ValueError(f"poses have shape {poses.shape}, expected ({self.n_bodies}, 7): x y z qw qx qy qz")
        seq = self._next_seq
        self._next_seq += 1
        rows = np.ascontiguousarray(poses.T)
        with np.errstate(invalid="ignore", over="ignore"):
            squares = np.einsum("ij,ij->j", rows[3:], rows[3:])
            changed = self._find_changed(rows, squares)
            if scene_epoch != self._scene_epoch:
                self._scene_epoch = scene_epoch
                changed[:] = True
            self._update_anchors(rows, squares, changed, seq)
        base_seq = max(seq - WINDOW, 0)
        sent = self._anchored_seq > base_seq
        self._add_refresh(sent)
        # A frame that holds every body (as all do until `WINDOW` frames after the first) needs no frame before it.
        return EncodedFrame(seq, 0 if sent.all() else base_seq, self._pack(sent))

    def keyframe(self) -> tuple[int, Floats]:
        """`(state_seq, poses)` of the newest frame, for a snapshot: (n_bodies, 7), within the drift allowance."""
        return self._next_seq - 1, np.ascontiguousarray(self._anchor.T)

    def _find_changed(self, rows: Floats, squares: Floats) -> Mask:
        """Return the bodies that left their anchor, and those that cannot be compared (not finite, no anchor yet).

        `rows`: (7, n) poses. `squares`: of the length of their quaternions.
        """
        offset = rows[:3] - self._anchor[:3]
        near: Mask = np.einsum("ij,ij->j", offset, offset) <= DRIFT_ALLOWANCE_M**2
        cosine = np.abs(np.einsum("ij,ij->j", rows[3:], self._anchor[3:]))
        near &= (cosine >= _COS_ALLOWANCE * np.sqrt(squares)) & (np.abs(squares - 1.0) <= _MAX_NORM_DEFECT)
        return ~near

    def _update_anchors(self, rows: Floats, squares: Floats, changed: Mask, seq: int) -> None:
        """Make the present pose of the `changed` bodies their anchor and compute its code."""
        at: Ints | slice = slice(None)
        if not changed.all():
            at = np.flatnonzero(changed)
            if not len(at):
                return
            rows, squares = rows[:, at], squares[at]
        nodes = np.rint(rows[:3] * (1.0 / LATTICE_M))
        fits = (np.abs(nodes) <= _MAX_INDEX).all(axis=0) & (np.abs(squares - 1.0) <= _MAX_NORM_DEFECT)
        self._anchored_seq[at] = seq
        self._escapes[at] = ~fits
        if not fits.all():
            self._anchor[:, at] = rows
            at = (np.arange(self.n_bodies) if isinstance(at, slice) else at)[fits]
            rows, squares, nodes = rows[:, fits], squares[fits], nodes[:, fits]
        q = rows[3:] / np.sqrt(squares)
        self._anchor[:3, at] = rows[:3]
        self._anchor[3:, at] = q
        self._index[:, at] = nodes
        self._levels[:, at] = rotation_levels(q)

    def _add_refresh(self, sent: Mask) -> None:
        """Mark the next bodies of the round robin in `sent`."""
        count = -(-self.n_bodies // REFRESH_FRAMES)
        for _ in range(count):
            sent[self._refreshed] = True
            self._refreshed = (self._refreshed + 1) % self.n_bodies

    def _pack(self, sent: Mask) -> bytes:
        """Return the payload with the anchors of the bodies `sent`."""
        quantised = sent & ~self._escapes
        index, levels = self._index, self._levels
        if not quantised.all():
            index, levels = index[:, quantised], levels[:, quantised]
        origin, top = (index.min(axis=1), index.max(axis=1)) if index.size else (np.zeros(3, np.int64),) * 2
        layout = NARROW
        if (top - origin).max() >= 2**POSITION_BITS:
            inside = _in_narrow_box(index)
            if NARROW_BYTES * inside.sum() + _ESCAPE.itemsize * (~inside).sum() < WIDE_BYTES * len(inside):
                quantised[np.flatnonzero(quantised)[~inside]] = False
                index, levels = index[:, inside], levels[:, inside]
                origin = index.min(axis=1)
            else:
                layout = WIDE
        escaped = np.flatnonzero(sent & ~quantised)
        n_quantised = index.shape[1]
        index = index - origin[:, None]
        if layout == NARROW:
            codes = ((levels << POSITION_BITS) | index).astype("<u4").tobytes()
        else:
            codes = index.astype("<u4").tobytes() + levels.astype("<u2").tobytes()
        head = _HEADER.pack(FORMAT, layout, self.n_bodies, n_quantised, len(escaped), *origin.tolist())
        mask = b"" if n_quantised == self.n_bodies else np.packbits(quantised, bitorder="little").tobytes()
        return b"".join((head, codes, mask, self._encode_escapes(escaped)))

    def _encode_escapes(self, bodies: Ints) -> bytes:
        """Encode the anchors of `bodies` as escapes."""
        if not len(bodies):
            return b""
        escapes = np.empty(len(bodies), _ESCAPE)
        escapes["body"] = bodies
        escapes["pose"] = self._anchor[:, bodies].T
        return escapes.tobytes()


def _in_narrow_box(index: Ints) -> Mask:
    """Return which nodes `index` (3, m) lie in the narrow box around their median: at least half of them per axis."""
    middle = np.median(index, axis=1)[:, None]
    inside: Mask = (np.abs(index - middle) < 2 ** (POSITION_BITS - 1) - 1).all(axis=0)
    return inside


class RigidDecoder:
    """Mirror of the poses of `n_bodies` bodies.

    `poses`: (n_bodies, 7) float64, world frame, `x y z qw qx qy qz`, NaN until first received. Every frame makes a new
    array, so an earlier one may be kept.
    `state_seq`: newest frame applied, 0 for none. `valid` (n_bodies,): True for poses within the bound at that frame.
    `stale_frames`: frames ignored because a newer one had been applied.
    """

    def __init__(self, n_bodies: int) -> None:
        self.n_bodies = n_bodies
        self._held = np.empty(n_bodies, np.int64)
        self.reset()

    def reset(self) -> None:
        """Clear all state: for a new connection, whose frames may be numbered from 1 again."""
        self.poses: Floats = np.full((self.n_bodies, 7), np.nan)
        self._held.fill(-1)  # newest frame at which the pose was known to be within the bound
        self.state_seq = 0
        self.base_seq = 0
        self.stale_frames = 0

    @property
    def valid(self) -> Mask:
        return self._held >= self.state_seq

    @property
    def complete(self) -> bool:
        """True if every body is within the bound at `state_seq`; false before the first frame."""
        return self.state_seq > 0 and bool((self._held >= self.state_seq).all())

    def apply(self, state_seq: int, base_seq: int, payload: bytes | memoryview) -> bool:
        """Apply one frame (`state_seq`, `base_seq` from its `StateHeader`). False: ask for a snapshot.

        Bodies in the frame are up to date even then. An older frame than the newest is ignored and counted.
        Raises `StreamError` for bytes that are no payload for `n_bodies` bodies; nothing has changed then.
        """
        if not 0 <= base_seq <= state_seq < 2**63:
            raise StreamError(f"base_seq {base_seq} and state_seq {state_seq} are not 0 <= base <= state < 2**63")
        if state_seq <= self.state_seq:
            self.stale_frames += 1
            return self.complete
        mask, poses, escapes = _unpack(payload, self.n_bodies)
        self.state_seq, self.base_seq = state_seq, base_seq
        if mask is None:  # everything moves: the common case, and the one that must be fast
            self.poses = poses
            self._held.fill(state_seq)
            return self.complete
        self.poses = self.poses.copy()
        self.poses[mask] = poses
        self._held[mask] = state_seq
        if len(escapes):
            self.poses[escapes["body"]] = escapes["pose"]
            self._held[escapes["body"]] = state_seq
        self._carry_over()
        return self.complete

    def load_keyframe(self, state_seq: int, poses: Floats) -> bool:
        """Load the poses (n_bodies, 7) of a snapshot at `state_seq`; newer poses are kept. Return True when complete.

        Raises `StreamError` for another shape.
        """
        if not 0 <= state_seq < 2**63:
            raise StreamError(f"keyframe at state_seq {state_seq}, expected 0 to 2**63 - 1")
        if poses.shape != (self.n_bodies, 7):
            raise StreamError(f"keyframe has shape {poses.shape}, expected ({self.n_bodies}, 7)")
        older = self._held < state_seq
        self.poses = self.poses.copy()
        self.poses[older] = poses[older]
        self._held[older] = state_seq
        if state_seq > self.state_seq:
            self.state_seq, self.base_seq = state_seq, state_seq
        self._carry_over()
        return self.complete

    def _carry_over(self) -> None:
        """Mark as current the bodies known at `base_seq` or later: those not in the newest frame have not changed."""
        self._held[self._held >= max(self.base_seq, 1)] = self.state_seq


def _unpack(payload: bytes | memoryview, n_bodies: int) -> tuple[Mask | None, Floats, npt.NDArray[np.void]]:
    """Return the mask (n_bodies,) of the quantised bodies (None: all of them), their poses (n, 7), and the escapes.

    The poses are stored one coordinate after the other, as they are decoded. Raises `StreamError`.
    """
    if len(payload) < _HEADER.size:
        raise StreamError(f"payload of {len(payload)} bytes, shorter than its header of {_HEADER.size}")
    form, layout, bodies, n, n_escaped, ox, oy, oz = _HEADER.unpack_from(payload)
    if form != FORMAT or bodies != n_bodies:
        raise StreamError(
            f"payload of format {form} for {bodies} bodies, expected format {FORMAT} for {n_bodies}: "
            "take the bodies from a new snapshot"
        )
    if layout not in (NARROW, WIDE) or n > n_bodies:
        raise StreamError(f"layout {layout} of {n} bodies: layouts {NARROW} and {WIDE} of up to {n_bodies} are known")
    at_mask = _HEADER.size + n * (NARROW_BYTES if layout == NARROW else WIDE_BYTES)
    at_escapes = at_mask + (0 if n == n_bodies else (n_bodies + 7) // 8)
    end = at_escapes + n_escaped * _ESCAPE.itemsize
    if len(payload) != end:
        raise StreamError(f"payload of {len(payload)} bytes, its header asks for {end}")
    mask = None if n == n_bodies else _read_mask(payload, at_mask, n, n_bodies)
    escapes = _NO_ESCAPES if not n_escaped else _read_escapes(payload, at_escapes, n_escaped, n_bodies, mask)
    words = np.ndarray((3, n), "<u4", payload, _HEADER.size)
    if layout == NARROW:
        levels = (words >> _SHIFT).view(np.int32)
        words = words & _POSITION_MASK
    else:
        levels = np.ndarray((3, n), "<u2", payload, _HEADER.size + 12 * n).astype(np.int32)
    rows = np.empty((7, n))
    rotations(levels, rows[3], rows[4:])
    positions = rows[:3]
    np.multiply(words, LATTICE_M, out=positions)
    positions += np.array(((ox,), (oy,), (oz,)), np.float64) * LATTICE_M  # exact: multiples of a power of two
    return mask, rows.T, escapes


def _read_mask(payload: bytes | memoryview, at: int, n_quantised: int, n_bodies: int) -> Mask:
    mask = np.unpackbits(np.frombuffer(payload, np.uint8, (n_bodies + 7) // 8, at), bitorder="little").view(np.bool_)
    if np.count_nonzero(mask[:n_bodies]) != n_quantised or mask[n_bodies:].any():
        raise StreamError(f"mask marks other than {n_quantised} of {n_bodies} bodies")
    return mask[:n_bodies]


def _read_escapes(
    payload: bytes | memoryview, at: int, n_escaped: int, n_bodies: int, mask: Mask | None
) -> npt.NDArray[np.void]:
    escapes = np.frombuffer(payload, _ESCAPE, n_escaped, at)
    body = escapes["body"].astype(np.int64)
    if mask is None or body[-1] >= n_bodies or (np.diff(body) <= 0).any() or mask[body].any():
        raise StreamError("escaped bodies are not ascending, in range and apart from the mask")
    return escapes
