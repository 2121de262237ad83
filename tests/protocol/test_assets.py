"""The assets channel at its trust boundary: rejected bytes and their errors. Golden vectors cover the rest."""

from __future__ import annotations

import hashlib

import msgspec
import pytest

from iris_session.protocol import codec
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES, AssetChunk, AssetRefused, AssetRequest, is_address
from iris_session.protocol.errors import MalformedError, ProtocolVersionError, TooLargeError
from iris_session.protocol.names import AssetRefusal

ADDRESS = hashlib.sha256(b"").hexdigest()


def test_other_version_is_distinguished_from_malformed_bytes() -> None:
    request = AssetRequest(2, 1, 1, ADDRESS, 0, 1)
    with pytest.raises(ProtocolVersionError) as caught:
        codec.decode_asset_request(codec.encode_asset_request(request))
    assert caught.value.version == 2
    with pytest.raises(ProtocolVersionError):
        codec.decode_asset_request(msgspec.msgpack.encode([2, "of another schema"]))
    for bad in (b"", b"\xc1", msgspec.msgpack.encode([1, 0]), msgspec.msgpack.encode([1, 0, 0, ADDRESS, -1, 5])):
        with pytest.raises(MalformedError):
            codec.decode_asset_request(bad)
    with pytest.raises(TooLargeError):
        codec.decode_asset_request(bytes(513))


def test_chunk_longer_than_its_asset_is_malformed() -> None:
    head = codec.encode_asset_header(AssetChunk(1, 7, ADDRESS, 10, 30))
    assert codec.decode_asset_chunk(head, 20) == AssetChunk(1, 7, ADDRESS, 10, 30)
    with pytest.raises(MalformedError, match=r"21 bytes from 10 .*30"):
        codec.decode_asset_chunk(head, 21)
    large = codec.encode_asset_header(AssetChunk(1, 7, ADDRESS, 0, 2**40))
    with pytest.raises(TooLargeError):
        codec.decode_asset_chunk(large, MAX_ASSET_CHUNK_BYTES + 1)


def test_refusal_with_unknown_fields_decodes() -> None:
    grown = msgspec.msgpack.encode([1, 3, ADDRESS, "on_strike", "ask the union", {"new": 1}])
    assert codec.decode_asset_refused(grown) == AssetRefused(1, 3, ADDRESS, "on_strike", "ask the union")
    assert AssetRefusal.BUSY in AssetRefusal.PASSING
    assert AssetRefusal.UNKNOWN not in AssetRefusal.PASSING


def test_address_syntax() -> None:
    assert is_address(ADDRESS)
    for bad in ("", ADDRESS[1:], ADDRESS + "0", ADDRESS.upper(), ADDRESS[1:] + "\n", "../" + ADDRESS[3:]):
        assert not is_address(bad)
