"""Golden vectors of messages in a form that C# tests read without a parser of JSON.

Beside those of docs/protocol: values at and beyond every bound of the schema, and mutations, for which the decoder of
the session says what is expected. A line is `expectation`, `type`, `bytes`, `canonical bytes` and `name`, with tabs
between; bytes in hexadecimal. `reads`: the bytes are read as a value of this type, which is written as the canonical
bytes. `refuses`: they are not read.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from random import Random
from typing import Any, Final

import msgpack
import msgspec

from iris_session.protocol.client_messages import ClientEnvelope
from iris_session.protocol.media import MediaHeader
from iris_session.protocol.server_messages import ServerEnvelope
from tools.codegen.csharp import LEFT_OUT, list_structs
from tools.codegen.examples import make_full, make_least
from tools.codegen.schema import Type, list_all_structs

#: Section of golden.json -> type of its vectors.
_TYPES: Final = {
    "client": "ClientEnvelope",
    "server": "ServerEnvelope",
    "state_header": "StateHeader",
    "presence": "Presence",
    "media_header": "MediaHeader",
    "asset_request": "AssetRequest",
    "asset_chunk": "AssetChunk",
    "asset_refused": "AssetRefused",
    "beacon": "Beacon",
}
_EARLIER: Final[dict[str, type[msgspec.Struct]]] = {
    "decode_only": ClientEnvelope,
    "decode_only_server": ServerEnvelope,
    "decode_only_media_header": MediaHeader,
}
_CLASSES: Final = {struct.name: struct.cls for struct in list_structs()}
#: Values that no type or few types take; large and small integers at the edges of those that do.
_PROBES: Final[tuple[object, ...]] = (
    None, True, 0, -1, -2, 2**31 - 1, 2**31, -(2**31), -(2**31) - 1, 2**63 - 1, 2**63, -(2**63), 1.5, "", "x",
    b"", b"x", [], [0], [0.5], ["x"], [[]], {}, {"x": 1}, {"x": "y"},
)  # fmt: skip
#: Longest array that is tried [elements]; above, only the bound itself is checked, by refused vectors of docs/protocol.
_LONGEST_PROBE: Final = 300
#: First bytes of MessagePack values.
_CODES: Final = (0x00, 0x7F, 0x80, 0x8F, 0x90, 0x9F, 0xA0, 0xBF, *range(0xC0, 0x100))


@cache
def render_message_vectors(docs: Path, mutations: int = 3_000) -> str:
    """Return the lines.

    Args:
        docs: Folder of golden.json and scene.json.
        mutations: Number of vectors that are made from others by a few changed bytes.
    """
    lines = [*_iterate_golden(json.loads((docs / "golden.json").read_text()))]
    lines += _iterate_scene(json.loads((docs / "scene.json").read_text()))
    lines += _iterate_mutations([line for line in lines if line[1] in _CLASSES], mutations)
    lines += _iterate_bounds()
    for struct in list_structs():
        if not any(field.required for field in struct.fields):
            data = msgspec.msgpack.encode(struct.cls()).hex()
            lines.append(("reads", struct.name, data, data, "defaults"))
    return "".join("\t".join(line) + "\n" for line in lines)


def _iterate_golden(golden: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    left_out = {struct.tag for struct in list_all_structs() if struct.name in LEFT_OUT}
    for section, kind in _TYPES.items():
        for row in golden[section]:
            message = row["value"][-1] if kind.endswith("Envelope") else None
            if message and message["type"] in left_out:
                yield "refuses", kind, row["hex"], "", row["name"]
            else:
                yield from _vary(kind, row["hex"], row["name"])
    for section, struct in _EARLIER.items():
        for row in golden[section]:
            value = msgspec.convert(row["value"], struct)
            canonical = msgspec.msgpack.encode(value).hex()
            known = getattr(value, "message", None).__class__.__name__ not in LEFT_OUT
            yield "reads" if known else "refuses", struct.__name__, row["hex"], canonical, f"{section}: {row['name']}"
    for row in golden["malformed"]:
        if row["code"] == "malformed":
            yield "refuses", "ClientEnvelope", row["hex"], "", f"malformed: {row['name']}"


def _iterate_scene(scene: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    for row in (*scene["structs"], *({**row, "type": "SceneSpec"} for row in scene["scenes"])):
        data = bytes.fromhex(row["hex"])
        canonical = msgspec.msgpack.encode(msgspec.msgpack.decode(data, type=_CLASSES[row["type"]])).hex()
        if canonical == row["hex"]:
            yield from _vary(row["type"], row["hex"], f"scene: {row['name']}")
        else:
            yield "reads", row["type"], row["hex"], canonical, f"scene: {row['name']}"
    for row in scene["patches"]:
        yield from _vary("PatchOp[]", row["hex"], f"patch: {row['name']}")
    for row in scene["malformed"]:
        if not row["checked"]:  # by types and bounds; what is checked are references, by other code
            yield "refuses", "SceneSpec", row["hex"], "", f"malformed scene: {row['name']}"


def _vary(kind: str, data: str, name: str) -> Iterator[tuple[str, ...]]:
    """Yield a vector as it is, and with the entries of every map reversed, an unknown entry before each."""
    yield "reads", kind, data, data, name
    value = msgpack.unpackb(bytes.fromhex(data), raw=False)
    if (other := msgpack.packb(_reorder(value))) != bytes.fromhex(data):
        yield "reads", kind, other.hex(), data, f"{name}, in another order"


def _reorder(value: Any) -> Any:
    if isinstance(value, list):
        return [_reorder(item) for item in value]
    # Maps with free keys (counts) would keep what is added.
    if not isinstance(value, dict) or (value and all(type(item) is int for item in value.values())):
        return value
    reordered: dict[str, Any] = {}
    for number, (key, item) in enumerate(reversed(value.items())):
        reordered[f"unknown{number}"] = [{"deep": None}]
        reordered[key] = _reorder(item)
    return reordered


def _expect(kind: str, data: bytes, name: str) -> Iterator[tuple[str, ...]]:
    """Yield a vector as the decoder of the session takes it."""
    try:
        value = msgspec.msgpack.decode(data, type=_CLASSES[kind])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError, OverflowError):
        yield "refuses", kind, data.hex(), "", name
    else:
        if type(getattr(value, "message", None)).__name__ not in LEFT_OUT:
            canonical = msgspec.msgpack.encode(value)
            # Where the schema has no bound, msgspec takes integers above int64, which the codec of the session refuses.
            expected = "refuses" if _has_large_integer(msgpack.unpackb(canonical)) else "reads"
            yield expected, kind, data.hex(), canonical.hex(), name


def _has_large_integer(value: Any) -> bool:
    if isinstance(value, dict):
        value = list(value.values())
    return any(map(_has_large_integer, value)) if isinstance(value, list) else type(value) is int and value >= 2**63


def _iterate_bounds() -> Iterator[tuple[str, ...]]:
    """Yield, for each field of each struct, messages without it and with every kind of value in it."""
    for struct in list_structs():
        make = make_full if struct.array_like else make_least
        whole = msgspec.msgpack.decode(msgspec.msgpack.encode(make(struct.cls)))
        for number, field in enumerate(struct.fields):
            key = number if struct.array_like else field.name
            less = whole[:number] if struct.array_like else {k: v for k, v in whole.items() if k != key}
            yield from _expect(struct.name, msgpack.packb(less), f"{field.name} missing")
            for probe in (*_PROBES, *_probe_lengths(field.type)):
                other = whole[:] if struct.array_like else {**whole}
                other[key] = probe
                yield from _expect(struct.name, msgpack.packb(other), f"{field.name} = {str(probe)[:20]}")


def _probe_lengths(kind: Type) -> Iterator[object]:
    """Yield strings, bytes and arrays as long as a type allows, and longer by one."""
    if kind.pattern:
        yield from ("a" * 63, "a" * 64, "a" * 65, "A" * 64, "g" * 64)
    for count in (kind.max_length or kind.length, (kind.max_length or kind.length) + 1):
        if kind.base == "str":
            yield from ("x" * count, "\N{ROBOT FACE}" * count)
        elif kind.base == "bytes":
            yield b"x" * count
        elif kind.item and count < _LONGEST_PROBE:
            example = {"int": 1, "float": 0.5, "str": "x"}.get(kind.item.base)
            if kind.item.base == "struct":
                example = msgspec.msgpack.decode(msgspec.msgpack.encode(make_least(_CLASSES[kind.item.name])))
            yield [example] * count


def _iterate_mutations(lines: list[tuple[str, ...]], count: int) -> Iterator[tuple[str, ...]]:
    random = Random(34)
    for number in range(count):
        _, kind, digits, _, name = random.choice(lines)
        data = bytearray.fromhex(digits)
        for _ in range(random.choice((1, 1, 2, 4))):
            at = random.randrange(len(data) + 1)
            match random.randrange(4):
                case 0:
                    data[at : at + 1] = bytes([random.randrange(256)])
                case 1:
                    data[at : at + 1] = b""
                case 2:
                    data[at:at] = bytes([random.choice(_CODES)])
                case _:
                    data[at : at + 1] = bytes([data[at] ^ 1 << random.randrange(8)]) if at < len(data) else b"\x00"
        yield from _expect(kind, bytes(data), f"{name}, mutation {number}")
