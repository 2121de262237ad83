"""Payload of the rigid-state stream in plain Python, written from docs/protocol.md, one body at a time.

Slow and readable: the reference for `streams.rigid` (same bytes, tested) and for decoders in other languages. It
implements the format only; the encoder chooses the bodies of a frame.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from typing import Final

FORMAT: Final = 2
#: Edge of the position lattice [m].
LATTICE_M: Final = 2.0**-14
#: Bits of a position in a narrow word, below those of the rotation.
POSITION_BITS: Final = 18
#: Level of a rotation component that is 0.
ROTATION_CENTRE: Final = 8191
NARROW: Final = 0
WIDE: Final = 1
HEADER: Final = struct.Struct("<BBHHH3i")
ESCAPE: Final = struct.Struct("<H7d")

#: `x y z qw qx qy qz`.
PoseRow = Sequence[float]


def encode_rotation(q: Sequence[float]) -> list[int]:
    """Return the levels of a unit quaternion `[w, x, y, z]`."""
    norm = math.sqrt(sum(v * v for v in q))
    w = q[0] / norm
    scale = math.copysign(ROTATION_CENTRE / (1.0 + abs(w)), w)
    return [round(v / norm * scale) + ROTATION_CENTRE for v in q[1:]]


def decode_rotation(levels: Sequence[int]) -> tuple[float, ...]:
    """Return the unit quaternion `[w, x, y, z]` of three levels. Raises `ValueError` for levels of no rotation."""
    m = [(level - ROTATION_CENTRE) / ROTATION_CENTRE for level in levels]
    squares = sum(v * v for v in m)
    if squares > (1.0 + math.sqrt(3.0) / 2.0 / ROTATION_CENTRE) ** 2 + 1e-12:
        raise ValueError(f"{tuple(levels)} are the levels of no rotation")
    return (2.0 / (1.0 + squares) - 1.0, *(v * 2.0 / (1.0 + squares) for v in m))


def encode(n_bodies: int, quantised: Mapping[int, PoseRow], escaped: Mapping[int, PoseRow]) -> bytes:
    """Return the payload of a frame that holds the bodies `quantised` and `escaped` (by index), of `n_bodies`."""
    nodes = {body: [round(v / LATTICE_M) for v in pose[:3]] for body, pose in sorted(quantised.items())}
    levels = {body: encode_rotation(quantised[body][3:]) for body in nodes}
    origin = [min((node[axis] for node in nodes.values()), default=0) for axis in range(3)]
    extent = max((node[axis] - origin[axis] for node in nodes.values() for axis in range(3)), default=0)
    layout = NARROW if extent < 2**POSITION_BITS else WIDE
    payload = bytearray(HEADER.pack(FORMAT, layout, n_bodies, len(nodes), len(escaped), *origin))
    for axis in range(3):
        for body, node in nodes.items():
            rotation = levels[body][axis] << POSITION_BITS if layout == NARROW else 0
            payload += (node[axis] - origin[axis] | rotation).to_bytes(4, "little")
    if layout == WIDE:
        for axis in range(3):
            for body in nodes:
                payload += levels[body][axis].to_bytes(2, "little")
    if len(nodes) < n_bodies:
        payload += sum(1 << body for body in nodes).to_bytes(-(-n_bodies // 8), "little")
    for body, pose in sorted(escaped.items()):
        payload += ESCAPE.pack(body, *pose)
    return bytes(payload)


def decode(payload: bytes) -> dict[int, tuple[float, ...]]:
    """Return the poses of a valid payload, by body. docs/protocol.md lists the payloads that a port must reject."""
    _, layout, n_bodies, n, n_escaped, *origin = HEADER.unpack_from(payload)
    words = struct.unpack_from(f"<{3 * n}I", payload, HEADER.size)
    at = HEADER.size + 12 * n
    if layout == NARROW:
        levels = [word >> POSITION_BITS for word in words]
        words = tuple(word & 2**POSITION_BITS - 1 for word in words)
    else:
        levels = list(struct.unpack_from(f"<{3 * n}H", payload, at))
        at += 6 * n
    bodies = list(range(n_bodies))
    if n < n_bodies:
        mask = int.from_bytes(payload[at : at + -(-n_bodies // 8)], "little")
        bodies = [body for body in bodies if mask >> body & 1]
        at += -(-n_bodies // 8)
    poses: dict[int, tuple[float, ...]] = {}
    for k, body in enumerate(bodies):
        position = [(words[axis * n + k] + origin[axis]) * LATTICE_M for axis in range(3)]
        poses[body] = (*position, *decode_rotation([levels[axis * n + k] for axis in range(3)]))
    for k in range(n_escaped):
        body, *pose = ESCAPE.unpack_from(payload, at + k * ESCAPE.size)
        poses[body] = tuple(pose)
    return poses
