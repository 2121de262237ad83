"""Golden vectors through another MessagePack library: it reads our wire, and we read what it writes.

`msgpack` shares no code with the encoder that made the vectors.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgpack  # type: ignore[import-untyped]
import msgspec
import pytest

from iris_session.protocol import codec
from iris_session.protocol.discovery import Beacon

GOLDEN = json.loads((Path(__file__).parents[2] / "docs" / "protocol" / "golden.json").read_text())
DECODERS: dict[str, Callable[[bytes], Any]] = {
    "client": codec.decode_client,
    "server": codec.decode_server,
    "state_header": codec.decode_state_header,
    "presence": codec.decode_presence,
    "robot_states": codec.decode_robot_states,
    "asset_request": codec.decode_asset_request,
    "asset_chunk": lambda data: codec.decode_asset_chunk(data, 0),
    "asset_refused": codec.decode_asset_refused,
    "beacon": lambda data: msgspec.msgpack.decode(data, type=Beacon),
}
VECTORS = [pytest.param(section, vector, id=vector["name"]) for section in DECODERS for vector in GOLDEN[section]]


def is_same_value(packed: Any, value: Any) -> bool:
    """Return whether a value of MessagePack equals the JSON value beside it exactly."""
    match packed:
        case dict():
            return (
                isinstance(value, dict)
                and list(packed) == list(value)
                and all(is_same_value(packed[key], value[key]) for key in packed)
            )
        case list():
            return isinstance(value, list) and len(packed) == len(value) and all(map(is_same_value, packed, value))
        case bytes():
            return isinstance(value, str) and base64.b64decode(value, validate=True) == packed
        case float() if not math.isfinite(packed):
            return value is None
        case float():  # by its bits: -0.0 is not 0.0
            return isinstance(value, float) and struct.pack(">d", packed) == struct.pack(">d", value)
        case _:
            return type(packed) is type(value) and bool(packed == value)


def unpack(data: bytes) -> Any:
    return msgpack.unpackb(data, raw=False, strict_map_key=True)


def reverse_keys(value: Any) -> Any:
    """Return the value with the keys of every map reversed: the tag comes last."""
    if isinstance(value, dict):
        return {key: reverse_keys(item) for key, item in reversed(value.items())}
    return [reverse_keys(item) for item in value] if isinstance(value, list) else value


@pytest.mark.parametrize(("section", "vector"), VECTORS)
def test_another_library_reads_every_vector_and_writes_the_same_bytes(section: str, vector: dict[str, Any]) -> None:
    """Shortest integers, floats of 64 bits, text apart from bytes: the default encoding of every library."""
    packed = unpack(bytes.fromhex(vector["hex"]))
    assert is_same_value(packed, vector["value"])
    assert msgpack.packb(packed, use_bin_type=True).hex() == vector["hex"]


@pytest.mark.parametrize(("section", "vector"), VECTORS)
def test_maps_of_another_library_are_read_in_any_key_order(section: str, vector: dict[str, Any]) -> None:
    data = bytes.fromhex(vector["hex"])
    other: bytes = msgpack.packb(reverse_keys(unpack(data)), use_bin_type=True)
    assert DECODERS[section](other) == DECODERS[section](data)


def test_vectors_of_other_encoders_are_messagepack() -> None:
    """Missing or unknown fields, wide integers, short floats: all readable elsewhere too."""
    assert GOLDEN["decode_only"]
    for vector in GOLDEN["decode_only"]:
        version, epoch, _, message = unpack(bytes.fromhex(vector["hex"]))[:4]
        assert [version, epoch, message["type"]] == [*vector["value"][:2], vector["value"][3]["type"]], vector["name"]


def test_comparison_detects_differences() -> None:
    pairs: list[tuple[Any, Any]] = [(1, 1.0), (0.0, -0.0), (True, 1), ("1", 1), ({"a": 1, "b": 2}, {"b": 2, "a": 1})]
    for packed, value in pairs:
        assert not is_same_value(packed, value)
        assert is_same_value(packed, packed)
    assert is_same_value(b"x", "eA==")
    assert not is_same_value(b"x", "eQ==")
    assert is_same_value(math.nan, None)
