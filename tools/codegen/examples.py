"""Example values of every message, made from the schema, so that a new message has its golden vectors at once.

`full`: every field differs from its default. `least`: required fields only. `extreme`: the largest and oddest values
that the schema allows.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from typing import Any, Final

import msgspec

from tools.codegen.schema import UNIONS, Field, Struct, Type, list_all_structs, list_enums

_STRUCTS: Final[dict[str, Struct]] = {struct.name: struct for struct in list_all_structs()}
_ENUMS: Final = list_enums()
#: Finite floats at the edges of float64, and one that no short decimal represents.
_FLOATS: Final = (1.7976931348623157e308, 5e-324, -0.0, 0.1 + 0.2)
#: Characters of one to four bytes in UTF-8.
_TEXT: Final = 'Zoë 机器人 🤖 "\\'


def make_address(data: bytes) -> str:
    """Return the address of the asset that consists of `data`."""
    return hashlib.sha256(data).hexdigest()


def make_full(cls: type[msgspec.Struct]) -> Any:
    """Return an instance of `cls` with a different value in every field."""
    return cls(**{field.name: _make_value(field, n) for n, field in enumerate(_STRUCTS[cls.__name__].fields, start=1)})


def make_least(cls: type[msgspec.Struct]) -> Any:
    """Return an instance of `cls` from its required fields alone."""
    fields = _STRUCTS[cls.__name__].fields
    return cls(**{field.name: _make_value(field, n) for n, field in enumerate(fields, start=1) if field.required})


def make_extreme(cls: type[msgspec.Struct]) -> Any:
    """Return an instance of `cls` with values at the edges of the allowed range."""
    return cls(**{field.name: _make_extreme_value(field.type, field) for field in _STRUCTS[cls.__name__].fields})


def iterate_examples(
    cls: type[msgspec.Struct], kinds: Sequence[str] = ("full", "least", "extreme")
) -> Iterator[tuple[str, Any]]:
    """Yield instances of `cls` by the name of their kind."""
    makers = {"full": make_full, "least": make_least, "extreme": make_extreme}
    return ((kind, makers[kind](cls)) for kind in kinds)


def _make_value(field: Field, n: int) -> Any:
    if field.enum:
        values = list(_ENUMS[field.enum].values())
        return tuple(values[:2]) if field.type.base == "array" else values[1 if len(values) > 1 else 0]
    value = _make_ordinary_value(field.type, field.name, n)
    return (not value) if isinstance(value, bool) and value == field.default else value


def _make_ordinary_value(kind: Type, name: str, n: int) -> Any:
    match kind.base:
        case "bool":
            return True
        case "int":
            return 1_000 + n
        case "float":
            return n + 0.25
        case "str":
            return make_address(name.encode()) if kind.pattern else name
        case "bytes":
            return bytes(range(16))
        case "array":
            assert kind.item is not None
            if kind.length == 4:  # a quaternion
                return (0.5, -0.5, 0.5, -0.5)
            return tuple(_make_ordinary_value(kind.item, f"{name}{k}", n + k) for k in range(kind.length or 2))
        case "map":
            return {"stale": 3, "seq": 1}
        case "struct":
            return make_full(_STRUCTS[kind.name].cls)
        case _:
            return make_full(UNIONS[kind.name][0])


def _make_extreme_value(kind: Type, field: Field) -> Any:
    match kind.base:
        case "bool":
            return not field.default
        case "int":
            low = field.name.endswith("_ns") or field.name == "session_time"
            return kind.minimum if low and kind.minimum else kind.maximum or 2**63 - 1
        case "float":
            return _FLOATS[0]
        case "str":
            return make_address(field.name.encode()) if kind.pattern else (_TEXT * 40)[: kind.max_length]
        case "bytes":
            return bytes(range(192, 256))
        case "array":
            assert kind.item is not None
            count = kind.length or min(kind.max_length or 3, 40)
            if kind.item.base == "float":
                return tuple(_FLOATS[k % len(_FLOATS)] for k in range(count))
            return tuple(_make_extreme_value(kind.item, field) for _ in range(count))
        case "map":
            return {}
        case "struct":
            return make_extreme(_STRUCTS[kind.name].cls)
        case _:
            return make_extreme(UNIONS[kind.name][-1])
