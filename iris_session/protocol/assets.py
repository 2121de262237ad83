"""The assets channel, version 1: byte strings by their SHA-256, in chunks that the client asks for one by one.

One message of a client is one `AssetRequest`; its answer is one `AssetChunk` with a frame of bytes behind it, or one
`AssetRefused` alone. What an asset holds is not said here: the one whose address is `Snapshot.scene_hash` describes the
scene and names all others.
"""

from __future__ import annotations

import re
from typing import Final

import msgspec

from iris_session.protocol.common import Count, Name, Text

#: Bytes of one chunk at most. Smaller ones share a link more fairly, larger ones cost less per byte.
MAX_ASSET_CHUNK_BYTES: Final = 1 << 20
#: Bytes of one asset at most, the largest array and its header: whoever is told of more fetches nothing of it.
MAX_ASSET_BYTES: Final = (1 << 30) + (1 << 20)
#: What a client may have asked for and not been sent yet, at most, by one connection to the channel.
MAX_ASSET_REQUESTS: Final = 64
MAX_ASSET_WINDOW_BYTES: Final = 8 << 20
_ADDRESS: Final = re.compile(r"[0-9a-f]{64}")


class AssetRequest(msgspec.Struct, frozen=True, array_like=True):
    """Asks for `length` bytes of an asset from `offset` on; fewer come when it ends before.

    `connection_epoch`: of the sender's `Welcome`. `request_id`: any number; it comes back with the answer. `address`:
    SHA-256 of the asset, 64 hexadecimal digits.
    """

    version: Count
    connection_epoch: Count
    request_id: Count
    address: Name
    offset: Count
    length: Count


class AssetChunk(msgspec.Struct, frozen=True, array_like=True):
    """First of two frames; the other holds bytes `offset` and following of an asset that has `total` bytes."""

    version: Count
    request_id: Count
    address: Name
    offset: Count
    total: Count


class AssetRefused(msgspec.Struct, frozen=True, array_like=True):
    """The only frame of an answer: nothing comes for this request. `request_id` 0: it could not be read."""

    version: Count
    request_id: Count
    address: Name
    reason: Name
    advice: Text = ""


def is_address(text: str) -> bool:
    """Whether this can be the address of an asset: 64 digits `0-9a-f`."""
    return _ADDRESS.fullmatch(text) is not None
