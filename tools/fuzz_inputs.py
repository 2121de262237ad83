"""Inputs for `fuzz.py`: values of any message type from its schema, right and wrong, and damage to encoded bytes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import cache
from random import Random
from typing import Any, Final

import msgspec
from msgspec import inspect

FLOATS: Final = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-3, 1e10, 1e308, -1e308, 5e-324, math.nan, math.inf, -math.inf)
INTS: Final = (
    0,
    1,
    2,
    7,
    127,
    128,
    255,
    65_535,
    2**31,
    2**32,
    2**53,
    2**63 - 1,
    2**63,
    2**64 - 1,
    -1,
    -(2**31),
    -(2**63),
)
WORDS: Final = (
    "", "x", "p1", "p2", "arm1", "arm2", "host", "robot", "object", "head", "controller/right", "pose", "joints",
    "operator", "director", "observer", "measured", "not_needed", "exclusive", "start",
    "left\n[red]", "ß" * 64, "\x00", "\U0001d518",
)  # fmt: skip
#: MessagePack markers: containers and texts that claim a length, extensions, numbers, what is never used.
MARKERS: Final = bytes((0xC1, 0xC0, 0xC2, 0xC4, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCF, 0xD3, 0xD4, 0xD9, 0xDB, 0xDC, 0xDD,
                        0xDE, 0xDF, 0x80, 0x8F, 0x90, 0x9F, 0xA0, 0xBF, 0xFF, 0x7F, 0x00))  # fmt: skip
#: Containers that claim more than there is, and depth.
LIES: Final = (
    b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xdb\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xff", b"\xdc\xff\xff",
    b"\xde\xff\xff", b"\x91" * 200, b"\x81\xa1x" * 200, b"\x91" * 5000, b"\xd9\xff", b"\xc9\xff\xff\xff\xff\x01",
)  # fmt: skip
#: One field in so many is of another type, too long, or missing.
WRONG: Final = 200


@cache
def schema(kind: Any) -> inspect.Type:
    return inspect.type_info(kind)


def encoded(rng: Random, kind: Any) -> bytes:
    """MessagePack of a value of `kind`, most often a right one."""
    return msgspec.msgpack.encode(value(rng, schema(kind)))


def encoded_json(rng: Random, kind: Any) -> bytes:
    return msgspec.json.encode(value(rng, schema(kind)))


def value(rng: Random, kind: inspect.Type) -> Any:
    """A value of plain types as `kind` describes it."""
    if not rng.randrange(WRONG):
        return wrong(rng)
    return _MAKERS[type(kind)](rng, kind)


def wrong(rng: Random) -> Any:
    """Anything."""
    nested: Any = 0
    for _ in range(rng.choice((1, 3, 40))):
        nested = [nested]
    return rng.choice(
        (None, True, rng.choice(INTS), rng.choice(FLOATS), "x" * 5000, b"\xff" * 300, [], {}, [0] * 300, nested)
    )


def _int(rng: Random, kind: Any) -> int:
    low = kind.ge if kind.ge is not None else -(2**63)
    high = kind.le if kind.le is not None else 2**63 - 1
    number = rng.choice(INTS) if rng.random() < 0.5 else rng.randrange(1000)
    return number if rng.random() < 0.05 else min(max(number, low), high)


def _text(rng: Random, kind: Any) -> str:
    text = rng.choice(WORDS)
    return text if kind.max_length is None or len(text) <= kind.max_length else text[: kind.max_length]


def _bytes(rng: Random, kind: Any) -> bytes:
    longest = kind.max_length if kind.max_length is not None else 64
    return rng.randbytes(rng.choice((0, 1, min(16, longest), min(64, longest))))


def _array(rng: Random, kind: Any) -> list[Any]:
    low = kind.min_length or 0
    high = kind.max_length if kind.max_length is not None else 8
    n = rng.choice((low, low, 1, 2, rng.randint(low, max(low, min(high, 12)))))
    if rng.random() < 0.02:
        n = high + rng.randrange(2)
    return [value(rng, kind.item_type) for _ in range(max(n, low))]


def _struct(rng: Random, kind: Any) -> Any:
    fields = []
    for field in kind.fields:
        if not field.required and rng.random() < 0.4 and not kind.array_like:
            continue
        if not rng.randrange(4 * WRONG):
            continue
        fields.append((field.encode_name, value(rng, field.type)))
    if kind.array_like:
        return [*([kind.tag] if kind.tag is not None else []), *(one for _, one in fields)]
    if not rng.randrange(WRONG):
        fields.append(("unheard_of", wrong(rng)))
    rng.shuffle(fields)
    tagged = [(kind.tag_field, kind.tag)] if kind.tag_field else []
    return dict((*tagged, *fields) if rng.random() < 0.9 else (*fields, *tagged))


def _dict(rng: Random, kind: Any) -> dict[Any, Any]:
    keys = [_MAKERS[type(kind.key_type)](rng, kind.key_type) for _ in range(rng.randrange(4))]
    return {key: value(rng, kind.value_type) for key in keys}


def _pick(rng: Random, kind: Any) -> Any:
    return value(rng, rng.choice(kind.types))


_MAKERS: Final[dict[type, Callable[[Random, Any], Any]]] = {
    inspect.IntType: _int,
    inspect.FloatType: lambda rng, kind: rng.choice(FLOATS) if rng.random() < 0.3 else rng.uniform(-2, 2),
    inspect.StrType: _text,
    inspect.BytesType: _bytes,
    inspect.BoolType: lambda rng, kind: rng.random() < 0.5,
    inspect.NoneType: lambda rng, kind: None,
    inspect.VarTupleType: _array,
    inspect.ListType: _array,
    inspect.TupleType: lambda rng, kind: [value(rng, one) for one in kind.item_types],
    inspect.DictType: _dict,
    inspect.StructType: _struct,
    inspect.UnionType: _pick,
    inspect.RawType: lambda rng, kind: 0,
    inspect.AnyType: lambda rng, kind: wrong(rng),
}


class Corpus:
    """Encoded values of some kinds, always fresh ones; `damaged` gives one of them, as it is or damaged."""

    SIZE: Final = 256

    def __init__(self, rng: Random, make: Sequence[Callable[[Random], bytes]]) -> None:
        self._rng = rng
        self._make = make
        self._kept = [make[i % len(make)](rng) for i in range(self.SIZE)]

    def damaged(self) -> bytes:
        rng = self._rng
        if rng.random() < 0.3:
            self._kept[rng.randrange(self.SIZE)] = rng.choice(self._make)(rng)
        data = rng.choice(self._kept)
        if rng.random() < 0.25:
            return data
        if rng.random() < 0.03:
            return rng.randbytes(rng.randrange(80))
        other = rng.choice(self._kept)
        return damage(rng, data, other)


def damage(rng: Random, data: bytes, other: bytes) -> bytes:
    """One to three changes to `data`; `other` is what may be spliced in."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        at = rng.randrange(len(changed) + 1)
        kind = rng.randrange(9)
        if kind == 0 and at < len(changed):
            changed[at] ^= 1 << rng.randrange(8)
        elif kind == 1 and at < len(changed):
            changed[at] = rng.choice(MARKERS)
        elif kind == 2:
            del changed[at:]
        elif kind == 3:
            del changed[at : at + rng.randrange(1, 9)]
        elif kind == 4:
            changed[at:at] = rng.randbytes(rng.randrange(1, 9))
        elif kind == 5:
            changed[at:at] = changed[rng.randrange(len(changed) + 1) :][: rng.randrange(1, 40)]
        elif kind == 6:
            changed[at:] = other[rng.randrange(len(other) + 1) :]
        elif kind == 7 and at < len(changed):
            changed[at] = rng.randrange(256)
        elif kind == 8 and not rng.randrange(4):
            changed[at : at + rng.randrange(2)] = rng.choice(LIES)
    return bytes(changed)
