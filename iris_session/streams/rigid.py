"""Rigid-state stream: poses of all bodies as one small payload per frame, 11 bytes per moving body.

Error of every body of every delivered frame against the state at its tick: at most `MAX_POSITION_ERROR_M` (0.1 mm,
Euclidean) and `MAX_ROTATION_ERROR_RAD` (0.05 deg). How it is kept:

- A body is *anchored* at a pose. It is anchored anew when its pose has left the anchor by more than the drift
  allowance, so the error is at most allowance + quantisation error, also while it creeps.
- A frame holds every body that was anchored anew since frame `base_seq` (a window of frames), always with the code
  of its anchor. So a client that had any complete frame >= `base_seq` is complete again, whatever it lost meanwhile.
- Resting bodies cost their bit in the mask; a slow round robin repeats them, so that a client which was away longer
  becomes complete even without a snapshot.
- A body that cannot be quantised (not finite, far away from the others) escapes verbatim as float64.

Payload, little-endian (normative: docs/protocol.md): header, mask, positions, rotations, escapes.
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
    PADDING,
    POSITION_QUANTUM_ERROR_M,
    ROTATION_BYTES,
    ROTATION_QUANTUM_ERROR_RAD,
    Floats,
    Ints,
    pack_words,
    rotation_codes,
    rotations,
    words_at,
)

MAX_POSITION_ERROR_M: Final = 1e-4
MAX_ROTATION_ERROR_RAD: Final = math.radians(0.05)
#: What a pose may drift from its anchor before it is sent again: the bound less the quantisation error, less a little
#: for rounding in float64. 7.0 um and 0.0065 deg.
DRIFT_ALLOWANCE_M: Final = 0.995 * MAX_POSITION_ERROR_M - POSITION_QUANTUM_ERROR_M
DRIFT_ALLOWANCE_RAD: Final = 0.995 * MAX_ROTATION_ERROR_RAD - ROTATION_QUANTUM_ERROR_RAD

#: Age of `base_seq` in frames, half a second at 60 Hz: a client may lose one frame less in a row without a snapshot.
WINDOW: Final = 30
#: Frames of one round of repeats of resting bodies: ten seconds at 60 Hz.
REFRESH_FRAMES: Final = 600
MAX_BODIES: Final = 65535

FORMAT: Final = 1
#: format u8, position_bytes u8, n_bodies u16, n_quantised u16, n_escaped u16, origin 3 x i32, nx u32, ny u32.
_HEADER: Final = struct.Struct("<BBHHH3iII")
_ESCAPE: Final = np.dtype([("body", "<u2"), ("pose", "<f8", (7,))])
_NO_ESCAPES: Final = np.empty(0, _ESCAPE)
_MAX_POSITION_BYTES: Final = 7
_MAX_INDEX: Final = 2**31 - 1
#: Quaternions farther from unit length (squared) than this are no rotations: they escape.
_MAX_NORM_DEFECT: Final = 1e-3
#: Below this many bytes per position an outlier is not looked for.
_USUAL_POSITION_BYTES: Final = 6
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
        self._anchor = np.full((n_bodies, 7), np.nan)
        self._anchored_seq = np.full(n_bodies, -1, np.int64)
        self._index = np.zeros((n_bodies, 3), np.int64)  # lattice node of the anchor
        self._rotation = np.zeros(n_bodies, np.uint64)
        self._escapes = np.zeros(n_bodies, np.bool_)  # anchor cannot be quantised
        self._refreshed = 0

    def encode(self, poses: Floats, scene_epoch: int) -> EncodedFrame:
        """Encodes one state.

        `poses`: (n_bodies, 7) float64, world frame, `x y z qw qx qy qz` [m, unit quaternion]; any value is taken,
        not finite ones are sent as they are. A new `scene_epoch` sends every body again.
        Raises `ValueError` for another shape.
        """
        if poses.shape != (self.n_bodies, 7):
            raise ValueError(f"poses have shape {poses.shape}, expected ({self.n_bodies}, 7): x y z qw qx qy qz")
        seq = self._next_seq
        self._next_seq += 1
        changed = self._changed(poses)
        if scene_epoch != self._scene_epoch:
            self._scene_epoch = scene_epoch
            changed[:] = True
        self._anchor_anew(poses, np.flatnonzero(changed), seq)
        base_seq = max(seq - WINDOW, 0)
        sent = self._anchored_seq > base_seq
        self._add_refresh(sent)
        # A frame that holds every body (as all do until `WINDOW` frames after the first) needs no frame before it.
        return EncodedFrame(seq, 0 if sent.all() else base_seq, self._pack(np.flatnonzero(sent)))

    def keyframe(self) -> tuple[int, Floats]:
        """`(state_seq, poses)` of the newest frame, for a snapshot: (n_bodies, 7), within the drift allowance."""
        return self._next_seq - 1, self._anchor.copy()

    def _changed(self, poses: Floats) -> Mask:
        """Bodies that left their anchor, and those that cannot be compared (not finite, no anchor yet)."""
        with np.errstate(invalid="ignore", over="ignore"):
            offset = poses[:, :3] - self._anchor[:, :3]
            near: Mask = np.einsum("ij,ij->i", offset, offset) <= DRIFT_ALLOWANCE_M**2
            q, anchor_q = poses[:, 3:], self._anchor[:, 3:]
            cosine = np.abs(np.einsum("ij,ij->i", q, anchor_q))
            squares = np.einsum("ij,ij->i", q, q)
            near &= (cosine >= _COS_ALLOWANCE * np.sqrt(squares)) & (np.abs(squares - 1.0) <= _MAX_NORM_DEFECT)
        return ~near

    def _anchor_anew(self, poses: Floats, bodies: Ints, seq: int) -> None:
        """Makes the present pose of `bodies` (ascending) their anchor and computes its code."""
        if not len(bodies):
            return
        anchor = poses.take(bodies, axis=0)
        q = anchor[:, 3:]
        with np.errstate(invalid="ignore", over="ignore"):
            squares = np.einsum("ij,ij->i", q, q)
            nodes = np.rint(anchor[:, :3] * (1.0 / LATTICE_M))
            fits = (np.abs(nodes) <= _MAX_INDEX).all(axis=1) & (np.abs(squares - 1.0) <= _MAX_NORM_DEFECT)
        at: Ints | slice = slice(None) if len(bodies) == self.n_bodies else bodies
        self._anchored_seq[at] = seq
        self._escapes[at] = ~fits
        if not fits.all():
            self._anchor[at] = anchor
            at = bodies[fits]
            anchor, squares, nodes = anchor[fits], squares[fits], nodes[fits]
            q = anchor[:, 3:]
        q /= np.sqrt(squares)[:, None]
        self._anchor[at] = anchor
        self._index[at] = nodes
        self._rotation[at] = rotation_codes(q)

    def _add_refresh(self, sent: Mask) -> None:
        """Marks the next bodies of the round robin in `sent`."""
        count = -(-self.n_bodies // REFRESH_FRAMES)
        for _ in range(count):
            sent[self._refreshed] = True
            self._refreshed = (self._refreshed + 1) % self.n_bodies

    def _pack(self, bodies: Ints) -> bytes:
        """Payload with the anchors of `bodies` (ascending)."""
        escapes = self._escapes[bodies]
        quantised, escaped = (bodies[~escapes], bodies[escapes]) if escapes.any() else (bodies, bodies[:0])
        index = self._index.take(quantised, axis=0)
        origin, levels = _box(index)
        position_bytes = _bytes_for(levels)
        if position_bytes > _USUAL_POSITION_BYTES:
            inside = _worth_quantising(index)
            escaped = np.sort(np.concatenate((escaped, quantised[~inside])))
            quantised, index = quantised[inside], index[inside]
            origin, levels = _box(index)
            position_bytes = _bytes_for(levels)
        nx, ny = int(levels[0]), int(levels[1])
        index -= origin
        positions = index[:, 0] + nx * (index[:, 1] + ny * index[:, 2])
        mask = np.zeros(self.n_bodies, np.bool_)
        mask[quantised] = True
        head = _HEADER.pack(
            FORMAT, position_bytes, self.n_bodies, len(quantised), len(escaped), *origin.tolist(), nx, ny
        )
        return b"".join(
            (
                head,
                np.packbits(mask, bitorder="little").tobytes(),
                pack_words(positions, position_bytes),
                pack_words(self._rotation.take(quantised), ROTATION_BYTES),
                self._verbatim(escaped),
            )
        )

    def _verbatim(self, bodies: Ints) -> bytes:
        """The anchors of `bodies` as escapes."""
        if not len(bodies):
            return b""
        escapes = np.empty(len(bodies), _ESCAPE)
        escapes["body"] = bodies
        escapes["pose"] = self._anchor[bodies]
        return escapes.tobytes()


def _box(index: Ints) -> tuple[Ints, Ints]:
    """Lowest node and number of nodes per axis of the box around lattice nodes `index` (m, 3)."""
    if not len(index):
        return np.zeros(3, np.int64), np.ones(3, np.int64)
    axes = np.ascontiguousarray(index.T)  # three times as fast as along the short axis
    origin = axes.min(axis=1)
    return origin, axes.max(axis=1) - origin + 1


def _bytes_for(levels: Ints) -> int:
    """Bytes of one position code in a box of `levels` nodes per axis."""
    nodes = int(levels[0]) * int(levels[1]) * int(levels[2])
    return max(1, ((nodes - 1).bit_length() + 7) // 8)


def _worth_quantising(index: Ints) -> Mask:
    """Which of the nodes `index` (m, 3) go into the box, so that box and escapes together take the fewest bytes.

    Considers the boxes around the k nodes nearest to the median, for every k.
    """
    order = np.argsort(np.abs(index - np.median(index, axis=0)).max(axis=1), kind="stable")
    nodes = index[order]
    extent = np.maximum.accumulate(nodes, axis=0) - np.minimum.accumulate(nodes, axis=0) + 1
    bits = np.log2(extent.astype(np.float64)).sum(axis=1)
    size = np.ceil(bits / 8.0 + 1e-9)  # the margin keeps rounding of log2 on the safe side
    count = np.arange(1, len(index) + 1)
    cost = count * size - count * (_ESCAPE.itemsize - ROTATION_BYTES)
    cost[size > _MAX_POSITION_BYTES] = np.inf
    inside = np.zeros(len(index), np.bool_)
    inside[order[: int(cost.argmin()) + 1]] = True
    return inside


class RigidDecoder:
    """Mirror of the poses of `n_bodies` bodies.

    `poses`: (n_bodies, 7) float64, world frame, `x y z qw qx qy qz`, NaN until first received. Every frame makes a new
    array, so an earlier one may be kept.
    `state_seq`: newest frame taken, 0 for none. `valid` (n_bodies,): which poses are within the bound at that frame.
    `stale_frames`: frames ignored because a newer one was taken before.
    """

    def __init__(self, n_bodies: int) -> None:
        self.n_bodies = n_bodies
        self._held = np.empty(n_bodies, np.int64)
        self.reset()

    def reset(self) -> None:
        """Forgets everything: for a new connection, whose frames may be numbered anew."""
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
        """Whether every body is within the bound at `state_seq`. False before the first frame."""
        return self.state_seq > 0 and bool((self._held >= self.state_seq).all())

    def apply(self, state_seq: int, base_seq: int, payload: bytes | memoryview) -> bool:
        """Takes one frame (`state_seq`, `base_seq` from its `StateHeader`). False: ask for a snapshot.

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
        if len(poses) == self.n_bodies:  # everything moves: the common case, and the one that must be fast
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
        """Takes the poses (n_bodies, 7) of a snapshot at `state_seq`; newer ones are kept. True: complete now.

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
        """What was within the bound at `base_seq` or later and is not in the newest frame has not changed since."""
        self._held[self._held >= max(self.base_seq, 1)] = self.state_seq


def _unpack(payload: bytes | memoryview, n_bodies: int) -> tuple[Mask, Floats, npt.NDArray[np.void]]:
    """Mask (n_bodies,) of the quantised bodies, their poses, and the escapes. Raises `StreamError`."""
    if len(payload) < _HEADER.size:
        raise StreamError(f"payload of {len(payload)} bytes, shorter than its header of {_HEADER.size}")
    form, position_bytes, bodies, n_quantised, n_escaped, ox, oy, oz, nx, ny = _HEADER.unpack_from(payload)
    if form != FORMAT or bodies != n_bodies:
        raise StreamError(
            f"payload of format {form} for {bodies} bodies, expected format {FORMAT} for {n_bodies}: "
            "take the bodies from a new snapshot"
        )
    if not (1 <= position_bytes <= _MAX_POSITION_BYTES and min(nx, ny) >= 1 and nx * ny <= 2**56):
        raise StreamError(
            f"box of {nx} x {ny} nodes in {position_bytes} bytes: 1 to {_MAX_POSITION_BYTES} are possible"
        )
    at_positions = _HEADER.size + (n_bodies + 7) // 8
    at_rotations = at_positions + n_quantised * position_bytes
    at_escapes = at_rotations + n_quantised * ROTATION_BYTES
    end = at_escapes + n_escaped * _ESCAPE.itemsize
    if len(payload) != end:
        raise StreamError(f"payload of {len(payload)} bytes, its header asks for {end}")
    padded = bytes(payload) + PADDING
    bits = np.frombuffer(padded, np.uint8, at_positions - _HEADER.size, _HEADER.size)
    mask = np.unpackbits(bits, bitorder="little").view(np.bool_)
    if np.count_nonzero(mask[:n_bodies]) != n_quantised or np.count_nonzero(mask) != n_quantised:
        raise StreamError(f"mask marks other than {n_quantised} of {n_bodies} bodies")
    mask = mask[:n_bodies]
    escapes = _NO_ESCAPES
    if n_escaped:
        escapes = np.frombuffer(padded, _ESCAPE, n_escaped, at_escapes)
        body = escapes["body"].astype(np.int64)
        if body[-1] >= n_bodies or (np.diff(body) <= 0).any() or mask[body].any():
            raise StreamError("escaped bodies are not ascending, in range and apart from the mask")
    codes = words_at(padded, at_positions, n_quantised, position_bytes)
    poses = np.empty((n_quantised, 7))
    ux, uy = np.uint64(nx), np.uint64(ny)
    rest = codes // ux
    z = rest // uy
    xyz = np.empty((3, n_quantised))
    xyz[0] = codes - rest * ux
    xyz[1] = rest - z * uy
    xyz[2] = z
    xyz += np.array([[ox], [oy], [oz]], np.float64)
    xyz *= LATTICE_M
    poses[:, :3] = xyz.T
    poses[:, 3:] = rotations(words_at(padded, at_rotations, n_quantised, ROTATION_BYTES))
    return mask, poses, escapes
