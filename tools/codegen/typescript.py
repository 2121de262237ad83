"""TypeScript of the protocol: types as a MessagePack library gives them, unions, constants, defaults.

Written to web_client/src/protocol/messages.g.ts. Maps are interfaces, arrays labelled tuples; 64-bit integers are
numbers, exact up to 2**53 (session times of 104 days).
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any, Final

import msgspec

from tools.codegen.schema import CONSTANTS, UNIONS, Field, Struct, Type, find_enum_doc, list_all_structs, list_enums

HEAD: Final = """\
// Messages of the iris-session protocol. Written by `python -m tools.codegen typescript`: do not edit.
//
// Fields with a `?` may be missing in what is received: their value is then that of `DEFAULTS`. Values of open
// enumerations may be others than those listed.
// Some types are called like those of three.js and of browsers: `import type * as wire` keeps them apart.
"""

_SCALARS: Final = {"bool": "boolean", "int": "number", "float": "number", "str": "string", "bytes": "Uint8Array"}


def render_typescript() -> str:
    """Return the text of messages.g.ts."""
    parts = [HEAD.rstrip("\n"), _render_constants(), *_render_enums()]
    parts.extend(
        _render_tuple(struct) if struct.array_like else _render_interface(struct) for struct in list_all_structs()
    )
    parts.extend(_render_union(name, members) for name, members in UNIONS.items())
    parts += [_render_defaults(), _render_value_defaults()]
    return "\n\n".join(parts) + "\n"


def _render_constants() -> str:
    rows = [f"export const {name} = {json.dumps(value)};" for name, value in CONSTANTS.items()]
    rows.insert(list(CONSTANTS).index("RIGID_LATTICE_M"), "/** Edge of the position lattice [m]. */")
    return "\n".join(rows)


def _render_enums() -> Iterator[str]:
    for name, values in list_enums().items():
        rows = [f"  {key}: {json.dumps(value)}," for key, value in values.items()]
        known = f"(typeof {name})[keyof typeof {name}]"
        doc = _render_doc(find_enum_doc(name))
        # `string & {}` keeps the known values in the editor's completion.
        yield "\n".join(
            [
                *doc,
                f"export const {name} = {{",
                *rows,
                "} as const;",
                f"export type {name} = {known} | (string & {{}});",
            ]
        )


def _render_doc(text: str) -> list[str]:
    if not text:
        return []
    lines = text.replace("*/", "* /").split("\n")
    if len(lines) == 1:
        return [f"/** {lines[0]} */"]
    return ["/**", *(f" * {line}".rstrip() for line in lines), " */"]


def _render_interface(struct: Struct) -> str:
    rows = []
    if struct.tag:
        rows.append(f"  {struct.tag_field}: {json.dumps(struct.tag)};")
    for field in struct.fields:
        rows.append(f"  {field.name}{'' if field.required else '?'}: {_render_field_type(field)};")
    return "\n".join([*_render_doc(struct.doc), f"export interface {struct.name} {{", *rows, "}"])


def _render_tuple(struct: Struct) -> str:
    rows = [f"  {field.name}{'' if field.required else '?'}: {_render_field_type(field)}," for field in struct.fields]
    return "\n".join([*_render_doc(struct.doc), f"export type {struct.name} = [", *rows, "];"])


def _render_field_type(field: Field) -> str:
    if field.enum and field.type.base == "str":
        return field.enum
    if field.enum:
        return f"{field.enum}[]"
    return _render_type(field.type) + (" | null" if field.type.optional else "")


def _render_type(kind: Type) -> str:
    if kind.base in _SCALARS:
        return _SCALARS[kind.base]
    if kind.base in ("struct", "union"):
        return kind.name
    assert kind.item is not None
    item = _render_type(kind.item)
    if kind.base == "map":
        return f"Record<string, {item}>"
    return f"[{', '.join([item] * kind.length)}]" if kind.length else f"{item}[]"


def _render_union(name: str, members: tuple[type[msgspec.Struct], ...]) -> str:
    rows = "\n".join(f"  | {member.__name__}" for member in members)
    return f"export type {name} =\n{rows};"


def _render_defaults() -> str:
    """Return the defaults of the optional fields of every message, event and operation, by tag."""
    rows = []
    for struct in list_all_structs():
        if struct.tag:
            values = {field.name: field.default for field in struct.fields if not field.required}
            inner = ", ".join(f"{name}: {_render_value(value)}" for name, value in values.items())
            rows.append(f"  {struct.tag}: {{ {inner} }}," if inner else f"  {struct.tag}: {{}},")
    doc = _render_doc("Values of the fields that a message, event or operation may leave out, by its tag.")
    return "\n".join([*doc, "export const DEFAULTS = {", *rows, "} as const;"])


def _render_value_defaults() -> str:
    """Return the defaults of the optional fields of maps without a tag, by name."""
    rows = []
    for struct in list_all_structs():
        values = {field.name: field.default for field in struct.fields if not field.required}
        if values and not struct.tag and not struct.array_like:
            rows.append(f"  {struct.name}: {{")
            rows.extend(f"    {name}: {_render_value(value)}," for name, value in values.items())
            rows.append("  },")
    doc = _render_doc("Values of the fields that other maps may leave out, by the name of their type.")
    return "\n".join([*doc, "export const VALUE_DEFAULTS = {", *rows, "} as const;"])


def _render_value(value: Any) -> str:
    if isinstance(value, bytes):
        return "new Uint8Array()"
    return json.dumps(msgspec.to_builtins(value))
