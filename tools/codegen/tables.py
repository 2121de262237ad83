"""Markdown tables of the protocol document, one text per section between its markers."""

from __future__ import annotations

import json
from typing import Any

import msgspec

from iris_session.protocol import assets, limits
from tools.codegen.schema import GROUPS, Field, Struct, Type, find_enum_doc, list_enums, list_structs


def render_sections() -> dict[str, str]:
    """Return Markdown by section name, for `<!-- generated:NAME -->` ... `<!-- end:NAME -->` in docs/protocol.md."""
    return {**{group: _render_group(group) for group in GROUPS}, "names": _render_names(), "limits": _render_limits()}


def _render_group(group: str) -> str:
    return "\n\n".join(_render_struct(struct) for struct in list_structs(group))


def _render_struct(struct: Struct) -> str:
    form = "array" if struct.array_like else "map"
    tag = f', `{struct.tag_field}` = `"{struct.tag}"`' if struct.tag else ""
    lines = [f"#### {struct.name}", "", f"MessagePack {form}{tag}."]
    if struct.doc:
        lines[-1] += f" {struct.doc}"
    index = "| # " if struct.array_like else ""
    lines += ["", f"{index}| field | type | default |", "|" + "---|" * (3 + struct.array_like)]
    for k, field in enumerate(struct.fields):
        index = f"| {k} " if struct.array_like else ""
        lines.append(f"{index}| `{field.name}` | {_render_field_type(field)} | {_render_default(field)} |")
    return "\n".join(lines)


def _render_field_type(field: Field) -> str:
    text = _render_type(field.type)
    if field.enum:
        text += f" of [{field.enum}](#{field.enum.lower()})"
    return text + (" or null" if field.type.optional else "")


def _render_type(kind: Type) -> str:
    match kind.base:
        case "int":
            return _render_integer(kind)
        case "str" if kind.pattern:
            return f"string `{kind.pattern}`"
        case "str" | "bytes":
            unit = "bytes" if kind.base == "bytes" else "characters"
            name = "bytes" if kind.base == "bytes" else "string"
            return f"{name}, at most {kind.max_length} {unit}" if kind.max_length else name
        case "array":
            assert kind.item is not None
            item = _render_type(kind.item)
            if kind.length:
                return f"array of {kind.length} {item}"
            limit = f", at most {kind.max_length}" if kind.max_length else ""
            limit = f", at least {kind.min_length}{limit}" if kind.min_length else limit
            return f"array of ({item}){limit}"
        case "map":
            return "map of string to int"
        case "struct":
            return f"[{kind.name}](#{kind.name.lower()})"
        case "union":
            return f"one of {kind.name}"
    return "float64" if kind.base == "float" else kind.base


def _render_integer(kind: Type) -> str:
    match kind.minimum, kind.maximum:
        case (0, None) | (0, 0x7FFF_FFFF_FFFF_FFFF):
            return "uint63"
        case (None, None) | (-0x8000_0000_0000_0000, 0x7FFF_FFFF_FFFF_FFFF):
            return "int64"
        case (-0x8000_0000, 0x7FFF_FFFF):
            return "int32"
        case low, high:
            return f"int, {low} to {high}"


def _render_default(field: Field) -> str:
    if field.required:
        return "required"
    if isinstance(field.default, msgspec.Struct) and field.default == type(field.default)():
        return "`{}`"  # its own defaults
    return f"`{_render_json(field.default)}`"


def _render_json(value: Any) -> str:
    return json.dumps(msgspec.to_builtins(value))


def _render_names() -> str:
    blocks = []
    for name, values in list_enums().items():
        listed = ", ".join(f"`{value}`" for value in values.values())
        doc = find_enum_doc(name)
        blocks.append(f"#### {name}\n\n{doc + ' ' if doc else ''}{listed}")
    return "\n\n".join(blocks)


def _render_limits() -> str:
    lines = ["| message | to | bytes | per second | burst |", "|---|---|---|---|---|"]
    for table, to in ((limits.LIMITS, "session"), (limits.SERVER_LIMITS, "client")):
        for kind, limit in table.items():
            rate = f"{limit.per_second:g} | {limit.burst}" if limit.burst else "- | -"
            lines.append(f"| `{kind.__struct_config__.tag}` | {to} | {limit.max_bytes:,} | {rate} |")
    lines.append(f"| media push | session | {limits.MAX_MEDIA_PUSH_BYTES:,} | - | - |")
    for name, size in (
        ("state header", limits.MAX_STATE_HEADER_BYTES),
        ("presence", limits.MAX_PRESENCE_BYTES),
        ("robot states", limits.MAX_ROBOT_STATES_BYTES),
        ("media header", limits.MAX_MEDIA_HEADER_BYTES),
        ("media frame", limits.MAX_MEDIA_FRAME_BYTES),
        ("asset header", limits.MAX_ASSET_HEADER_BYTES),
        ("asset chunk", assets.MAX_ASSET_CHUNK_BYTES),
        ("beacon", limits.MAX_BEACON_BYTES),
    ):
        lines.append(f"| {name} | client | {size:,} | - | - |")
    return "\n".join(lines)
