"""Payload of the rigid-state stream in plain Python, written from docs/protocol.md, one body at a time.

Slow and readable: the measure for `streams.rigid` (same bytes, tested) and for decoders in other languages. It knows
the format only; which bodies a frame must hold is the business of the encoder.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import Final

FORMAT: Final = 1
#: Edge of the position lattice [m].
LATTICE_M: Final = 7.0 / 65536.0
#: Levels per sent component of a quaternion, and bytes of its code.
ROTATION_LEVELS: Final = 6501
ROTATION_BYTES: Final = 5
HEADER: Final = struct.Struct("<BBHHH3iII")
ESCAPE: Final = struct.Struct("<H7d")

_HALF: Final = (ROTATION_LEVELS - 1) // 2
_PER_UNIT: Final = _HALF * math.sqrt(2.0)
_OTHERS: Final = ((1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2))

#: `x y z qw qx qy qz`.
PoseRow = Sequence[float]


def encode_rotation(q: Sequence[float]) -> int:
    """Code of a unit quaternion `[w, x, y, z]`."""
    norm = math.sqrt(sum(v * v for v in q))
    largest = max(range(4), key=lambda i: (abs(q[i]), -i))
    sign = -1.0 if q[largest] < 0.0 else 1.0
    a, b, c = (round(q[i] / norm * sign * _PER_UNIT) + _HALF for i in _OTHERS[largest])
    return largest + 4 * (a + ROTATION_LEVELS * (b + ROTATION_LEVELS * c))


def decode_rotation(code: int) -> tuple[float, ...]:
    """Unit quaternion `[w, x, y, z]` of a code. Raises `ValueError` for a code of no rotation."""
    largest, rest = code & 3, code >> 2
    levels = (rest % ROTATION_LEVELS, rest // ROTATION_LEVELS % ROTATION_LEVELS, rest // ROTATION_LEVELS**2)
    others = [(level - _HALF) / _PER_UNIT for level in levels]
    squares = sum(v * v for v in others)
    if levels[2] >= ROTATION_LEVELS or squares > 0.76:
        raise ValueError(f"{code} is the code of no rotation")
    others.insert(largest, math.sqrt(1.0 - squares))
    return tuple(others)


def encode(n_bodies: int, quantised: Mapping[int, PoseRow], escaped: Mapping[int, PoseRow]) -> bytes:
    """Payload of a frame that holds the bodies `quantised` and `escaped` (by index), of `n_bodies`."""
    nodes = {body: [round(v / LATTICE_M) for v in pose[:3]] for body, pose in sorted(quantised.items())}
    origin = [min((node[axis] for node in nodes.values()), default=0) for axis in range(3)]
    top = [max((node[axis] for node in nodes.values()), default=0) for axis in range(3)]
    nx, ny, nz = (high - low + 1 for low, high in zip(origin, top, strict=True))
    position_bytes = max(1, -(-(nx * ny * nz - 1).bit_length() // 8))
    payload = bytearray(HEADER.pack(FORMAT, position_bytes, n_bodies, len(nodes), len(escaped), *origin, nx, ny))
    payload += sum(1 << body for body in nodes).to_bytes(-(-n_bodies // 8), "little")
    for x, y, z in nodes.values():
        code = (x - origin[0]) + nx * ((y - origin[1]) + ny * (z - origin[2]))
        payload += code.to_bytes(position_bytes, "little")
    for body in nodes:
        payload += encode_rotation(quantised[body][3:]).to_bytes(ROTATION_BYTES, "little")
    for body, pose in sorted(escaped.items()):
        payload += ESCAPE.pack(body, *pose)
    return bytes(payload)


def decode(payload: bytes) -> dict[int, tuple[float, ...]]:
    """Poses in a payload, by body. For valid payloads: what a port must refuse is told in docs/protocol.md."""
    _, position_bytes, n_bodies, n_quantised, n_escaped, ox, oy, oz, nx, ny = HEADER.unpack_from(payload)
    at = HEADER.size + -(-n_bodies // 8)
    mask = int.from_bytes(payload[HEADER.size : at], "little")
    bodies = [body for body in range(n_bodies) if mask >> body & 1]
    rotations_at = at + n_quantised * position_bytes
    escapes_at = rotations_at + n_quantised * ROTATION_BYTES
    poses: dict[int, tuple[float, ...]] = {}
    for k, body in enumerate(bodies):
        start = at + k * position_bytes
        code = int.from_bytes(payload[start : start + position_bytes], "little")
        node = (code % nx + ox, code // nx % ny + oy, code // nx // ny + oz)
        start = rotations_at + k * ROTATION_BYTES
        rotation = decode_rotation(int.from_bytes(payload[start : start + ROTATION_BYTES], "little"))
        poses[body] = (*(v * LATTICE_M for v in node), *rotation)
    for k in range(n_escaped):
        body, *pose = ESCAPE.unpack_from(payload, escapes_at + k * ESCAPE.size)
        poses[body] = tuple(pose)
    return poses
