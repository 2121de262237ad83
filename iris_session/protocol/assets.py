"""Assets: the channel that serves them, version 1, and the container of those that are arrays.

An asset is a byte string known by its SHA-256. A client asks for it chunk by chunk: each of its messages is one
`AssetRequest`, answered by one `AssetChunk` with a frame of bytes behind it, or by one `AssetRefused` alone. The asset
whose address is `Snapshot.scene_hash` describes the scene and names all others.

Meshes, raw images, height fields and topologies are containers of arrays (docs/scene.md): eight bytes `IRA1` and the
length of the header (uint32, little-endian), the header (MessagePack `ArrayHeader`), then the compressed arrays one
after the other, in the header's order. `scene.arrays` writes and reads them.
"""

from __future__ import annotations

import re
from typing import Annotated, Final

import msgspec

from iris_session.protocol.common import Count, Name, Text
from iris_session.protocol.names import ArrayCodec, ArrayFilter

#: Bytes of one chunk at most. Smaller ones share a link more fairly, larger ones cost less per byte.
MAX_ASSET_CHUNK_BYTES: Final = 1 << 20
#: Bytes of one asset at most: the largest array and its header. Clients fetch nothing of an asset listed as larger.
MAX_ASSET_BYTES: Final = (1 << 30) + (1 << 20)
#: Requests, and requested bytes, that one connection to the channel may have pending.
MAX_ASSET_REQUESTS: Final = 64
MAX_ASSET_WINDOW_BYTES: Final = 8 << 20
_ADDRESS: Final = re.compile(r"[0-9a-f]{64}")


class AssetRequest(msgspec.Struct, frozen=True, array_like=True):
    """Request for `length` bytes of an asset from `offset` on; the answer is shorter when the asset ends before.

    `connection_epoch`: of the sender's `Welcome`. `request_id`: any number; repeated in the answer. `address`: SHA-256
    of the asset, 64 hexadecimal digits.
    """

    version: Count
    connection_epoch: Count
    request_id: Count
    address: Name
    offset: Count
    length: Count


class AssetChunk(msgspec.Struct, frozen=True, array_like=True):
    """First of two frames; the second holds bytes `offset` and following of an asset that has `total` bytes."""

    version: Count
    request_id: Count
    address: Name
    offset: Count
    total: Count


class AssetRefused(msgspec.Struct, frozen=True, array_like=True):
    """The only frame of an answer: no bytes come for this request. `request_id` 0: it could not be read."""

    version: Count
    request_id: Count
    address: Name
    reason: Name
    advice: Text = ""


def is_address(text: str) -> bool:
    """Return true when the text can be the address of an asset: 64 digits `0-9a-f`."""
    return _ADDRESS.fullmatch(text) is not None


# --- container of arrays ---

ARRAYS_MAGIC: Final = b"IRA1"
MAX_ARRAY_HEADER_BYTES: Final = 16_384
#: Largest array after decompression that a reader accepts by default: a texture of 16,384 x 16,384 RGBA.
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
    """The header of a container. `kind` of `ArrayKind`; `max_error`: stated bound on the values, in their unit, 0:
    exact.
    """

    kind: Name
    arrays: Annotated[tuple[ArrayInfo, ...], msgspec.Meta(max_length=MAX_ARRAYS)]
    max_error: float = 0.0
