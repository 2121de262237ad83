"""The container of assets that are arrays: meshes, raw images, height fields, topologies. Layout in docs/scene.md.

Eight bytes `IRA1` and the length of the header (uint32, little-endian), the header (MessagePack), then the compressed
arrays one after the other, in the header's order. `scene.arrays` writes and reads it.
"""

from __future__ import annotations

from typing import Annotated, Final

import msgspec

from iris_session.protocol.common import Count, Name
from iris_session.protocol.scene_names import ArrayCodec, ArrayFilter

MAGIC: Final = b"IRA1"
MAX_HEADER_BYTES: Final = 16_384
#: Largest array after decompression that a reader accepts unless told otherwise: a texture of 16,384 x 16,384 RGBA.
MAX_ARRAY_BYTES: Final = 1 << 30
MAX_ARRAYS: Final = 16


class ArrayInfo(msgspec.Struct, frozen=True):
    """One array. `dtype`: `u1`, `i1`, `u2`, `u4`, `f4`, little-endian. `shape`: C order.

    `bytes`: of its compressed form. Values are `offset + scale * stored`, per entry of the last axis, where `scale`
    is not empty.
    """

    name: Name
    dtype: Name
    shape: Annotated[tuple[Count, ...], msgspec.Meta(min_length=1, max_length=4)]
    bytes: Count
    filter: Name = ArrayFilter.NONE
    codec: Name = ArrayCodec.NONE
    scale: Annotated[tuple[float, ...], msgspec.Meta(max_length=4)] = ()
    offset: Annotated[tuple[float, ...], msgspec.Meta(max_length=4)] = ()


class ArrayHeader(msgspec.Struct, frozen=True):
    """The header. `kind` of `ArrayKind`; `max_error`: stated bound on the values, in their unit, 0: exact."""

    kind: Name
    arrays: Annotated[tuple[ArrayInfo, ...], msgspec.Meta(max_length=MAX_ARRAYS)]
    max_error: float = 0.0
