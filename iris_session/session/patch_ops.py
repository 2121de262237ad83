"""Operations of a patch as an owner gives them: checked, so that the journal and every client can read them.

Whether they fit the scene is decided where it is known (`shared_scene`).
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Sequence
from typing import Final

import msgspec
import numpy as np

from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import MAX_OPS, AddVisual, PatchOp, SceneError, SetVisual

#: How far a quaternion may be from unit length: it was rounded.
UNIT: Final = 1e-3
KINDS: Final = "SetVisual, AddVisual, RemoveVisual, AddMesh or AddMaterial of iris_session.protocol.scene"


def _plain(value: object) -> object:
    """What somebody computes with, as it is sent."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} where a number, a text or a tuple is expected")


_encode_op: Final = msgspec.msgpack.Encoder(enc_hook=_plain).encode
_decode_op: Final = msgspec.msgpack.Decoder(PatchOp).decode


def checked_ops(ops: Sequence[object]) -> tuple[PatchOp, ...]:
    """As they are journaled: lists are tuples, numbers of numpy plain ones. Raises `SceneError`."""
    if not ops:
        raise SceneError(f"nothing to change: give operations, {KINDS}")
    if len(ops) == 1 and isinstance(ops[0], list | tuple):
        raise SceneError(f"operations in a {type(ops[0]).__name__}: give them one by one, patch_scene(*operations)")
    if len(ops) > MAX_OPS:
        raise SceneError(f"{len(ops)} operations at once, at most {MAX_OPS}: give the others with further calls")
    taken = []
    for number, op in enumerate(ops, start=1):
        if not isinstance(op, PatchOp):
            raise SceneError(f"operation {number} is {reprlib.repr(op)}: {KINDS} is expected")
        try:
            taken.append(_checked(op))
        except (TypeError, ValueError, OverflowError) as error:
            raise SceneError(f"operation {number}, {type(op).__name__}: {error}") from error
    return tuple(taken)


def _checked(op: PatchOp) -> PatchOp:
    taken: PatchOp = _decode_op(_encode_op(op))
    try:
        msgspec.json.decode(msgspec.json.encode(taken), type=PatchOp)  # where what is not finite is null
    except msgspec.ValidationError as error:
        where = str(error).rpartition("$.")[2].rstrip("`")
        raise ValueError(f"numbers of {where} must be finite") from error
    shown = taken if isinstance(taken, SetVisual) else taken.visual if isinstance(taken, AddVisual) else None
    if shown is not None and shown.rgba is not None and not all(0.0 <= v <= 1.0 for v in shown.rgba):
        raise ValueError(f"rgba is {shown.rgba}: each from 0 to 1 is expected")
    if isinstance(taken, AddVisual) and taken.visual.geometry.kind not in GeometryKind.ALL:
        there_are = ", ".join(sorted(GeometryKind.ALL))
        raise ValueError(f"a geometry of kind {reprlib.repr(taken.visual.geometry.kind)}: there are {there_are}")
    if shown is not None and shown.T_body_visual is not None:
        length = math.hypot(*shown.T_body_visual.q)
        if abs(length - 1.0) > UNIT:
            raise ValueError(f"the quaternion has length {length:g}: (w, x, y, z) of length 1 is expected")
    return taken
