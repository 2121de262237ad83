"""TypeScript tables of the protocol: fields with types, bounds and defaults, and sizes of messages, for a decoder.

Written to web_client/src/protocol/schema.g.ts. `web_client/src/core/codec.ts` interprets the tables, so that no message
is decoded by hand there.
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any, Final

import msgspec

from iris_session.protocol import assets, limits
from iris_session.protocol.codec import get_tag
from tools.codegen.schema import UNIONS, Field, Struct, Type, list_all_structs

_TEMPLATE: Final = Path(__file__).parent / "schema.ts"
#: Integers that a JavaScript number holds exactly; wider bounds are those of int64.
_EXACT: Final = 2**53 - 1


def render_schema() -> str:
    """Return the text of schema.g.ts."""
    structs = "\n".join(_render_struct(struct) for struct in list_all_structs())
    members = {name: ", ".join(json.dumps(kind.__name__) for kind in kinds) for name, kinds in UNIONS.items()}
    unions = "\n".join(f"  {name}: [{names}]," for name, names in members.items())
    _, _, head = _TEMPLATE.read_text(encoding="utf-8").partition("\n")
    return "\n".join(
        [
            head,
            "const EMPTY_BYTES = new Uint8Array();",
            "",
            f"export const STRUCTS: Readonly<Record<string, StructTable>> = {{\n{structs}\n}};",
            "",
            "/** Members of the closed unions, by the name of their struct. */",
            f"export const UNIONS: Readonly<Record<string, readonly string[]>> = {{\n{unions}\n}};",
            "",
            *_render_limits(),
            "",
        ]
    )


def _render_struct(struct: Struct) -> str:
    rows = "\n".join(f"      {_render_field(field)}," for field in struct.fields)
    tag = json.dumps([struct.tag_field, struct.tag]) if struct.tag else "null"
    fields = f"[\n{rows}\n    ]" if rows else "[]"
    parts = {"array": json.dumps(struct.array_like), "tag": tag, "fields": fields}
    return "\n".join([f"  {struct.name}: {{", *(f"    {key}: {value}," for key, value in parts.items()), "  },"])


def _render_field(field: Field) -> str:
    fallback = "[]" if field.required else f"[{_render_default(field.default)}]"
    return f"[{json.dumps(field.name)}, {_render_type(field.type)}, {fallback}]"


def _render_default(value: Any) -> str:
    if isinstance(value, bytes):
        if value:
            raise TypeError(f"default {base64.b64encode(value)!r}: only empty bytes have a form in TypeScript")
        return "EMPTY_BYTES"
    return json.dumps(msgspec.to_builtins(value))


def _render_type(kind: Type) -> str:
    if kind.optional:
        return f'["null", {_render_type(Type(**{**vars(kind), "optional": False}))}]'
    match kind.base:
        case "bool" | "float":
            return json.dumps([kind.base])
        case "int":
            return json.dumps(["int", _bound(kind.minimum), _bound(kind.maximum)])
        case "str":
            return json.dumps(["str", kind.max_length, kind.pattern])
        case "bytes":
            return json.dumps(["bytes", kind.max_length])
        case "struct" | "union":
            return json.dumps([kind.base, kind.name])
    assert kind.item is not None
    item = _render_type(kind.item)
    if kind.base == "map":
        return f'["map", {item}]'
    least = f", {kind.min_length}" if kind.min_length else ""
    return f'["array", {item}, {kind.length}, {kind.max_length}{least}]'


def _bound(value: int | None) -> int | None:
    return value if value is not None and abs(value) <= _EXACT else None


def _render_limits() -> list[str]:
    rows = []
    for name, doc, table in (
        ("CLIENT_LIMITS", "Most bytes of a whole envelope to the session, by tag.", limits.LIMITS),
        ("SERVER_LIMITS", "Most bytes of a whole envelope to a client, by tag.", limits.SERVER_LIMITS),
    ):
        sizes = "\n".join(f"  {get_tag(kind)}: {limit.max_bytes}," for kind, limit in table.items())
        rows += [f"/** {doc} */", f"export const {name}: Readonly<Record<string, number>> = {{\n{sizes}\n}};", ""]
    constants = {
        "MAX_CLIENT_BYTES": limits.MAX_CLIENT_BYTES,
        "MAX_SERVER_BYTES": limits.MAX_SERVER_BYTES,
        "MAX_STATE_HEADER_BYTES": limits.MAX_STATE_HEADER_BYTES,
        "MAX_PRESENCE_BYTES": limits.MAX_PRESENCE_BYTES,
        "MAX_ROBOT_STATES_BYTES": limits.MAX_ROBOT_STATES_BYTES,
        "MAX_MEDIA_HEADER_BYTES": limits.MAX_MEDIA_HEADER_BYTES,
        "MAX_MEDIA_FRAME_BYTES": limits.MAX_MEDIA_FRAME_BYTES,
        "MAX_ASSET_REQUEST_BYTES": limits.MAX_ASSET_REQUEST_BYTES,
        "MAX_ASSET_HEADER_BYTES": limits.MAX_ASSET_HEADER_BYTES,
        "MAX_BEACON_BYTES": limits.MAX_BEACON_BYTES,
        "MAX_ASSET_BYTES": assets.MAX_ASSET_BYTES,
        "MAX_ASSET_CHUNK_BYTES": assets.MAX_ASSET_CHUNK_BYTES,
        "MAX_ASSET_REQUESTS": assets.MAX_ASSET_REQUESTS,
        "MAX_ARRAY_HEADER_BYTES": assets.MAX_ARRAY_HEADER_BYTES,
        "MAX_ARRAY_BYTES": assets.MAX_ARRAY_BYTES,
    }
    return [*rows, *(f"export const {name} = {value};" for name, value in constants.items())]
