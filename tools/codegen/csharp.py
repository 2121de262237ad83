"""C# of the protocol: constants, and one class per struct with reader and writer.

Written to unity_client/Runtime/Protocol/Messages.g.cs. The MessagePack code that they need is in the template,
Messages.cs. Language version 7.2, no engine, no packages: compiles for Unity, Mono and .NET. The writer gives the same
bytes as the Python encoder.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import msgspec

from tools.codegen.schema import CONSTANTS, UNIONS, Field, Struct, Type, find_enum_doc, list_all_structs, list_enums

_TEMPLATE: Final = Path(__file__).parent / "Messages.cs"
_SCALARS: Final = {"bool": "bool", "int": "long", "float": "double", "str": "string", "bytes": "byte[]"}
#: Bases whose C# type has no null of its own.
_VALUES: Final = ("int", "float")
_READS: Final = {"bool": "ReadBool", "float": "ReadDouble"}


def render_csharp() -> str:
    """Return the text of Messages.g.cs."""
    bases = {member.__name__: name for name, members in UNIONS.items() for member in members}
    unions = [_render_union(name, members) for name, members in UNIONS.items()]
    structs = [_render_class(struct, bases.get(struct.name, "")) for struct in list_all_structs()]
    _, _, text = _TEMPLATE.read_text(encoding="utf-8").partition("\n")
    text = text.replace("    //@ constants, enumerations\n", _indent([_render_constants(), *_render_enums()]))
    return text.replace("    //@ unions, structs\n", _indent([*unions, *structs]))


def _indent(parts: list[str]) -> str:
    return "".join(f"    {line}".rstrip() + "\n" for line in "\n\n".join(parts).split("\n"))


def to_pascal_case(name: str, struct: str = "") -> str:
    """Return the C# name of a field: `request_id` -> `RequestId`. Transforms keep theirs, which names their frames."""
    if name.startswith("T_"):
        return name
    text = "".join(part[:1].upper() + part[1:] for part in name.lower().split("_"))
    return text + "Value" if text == struct else text  # a member may not be named like its class


def _render_constants() -> str:
    types = {int: "int", float: "double", str: "string"}
    rows = [
        f"    public const {types[type(value)]} {to_pascal_case(name.removeprefix('PROTOCOL_'))} = {json.dumps(value)};"
        for name, value in CONSTANTS.items()
    ]
    summary = "/// <summary>Numbers of the protocol that are no messages.</summary>"
    return "\n".join([summary, "public static class Wire", "{", *rows, "}"])


def _render_enums() -> Iterator[str]:
    for name, values in list_enums().items():
        rows = [
            f"    public const string {to_pascal_case(key)} = {json.dumps(value)};" for key, value in values.items()
        ]
        doc = find_enum_doc(name) or f"Values of an open enumeration: {name}."
        yield "\n".join([*_render_doc(doc), f"public static class {name}", "{", *rows, "}"])


def _render_doc(text: str) -> list[str]:
    if not text:
        return []
    escaped = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;").replace("`", "")
    lines = [f"/// {line}".rstrip() for line in escaped.split("\n")]
    return ["/// <summary>", *lines, "/// </summary>"]


def _render_union(name: str, members: tuple[type[msgspec.Struct], ...]) -> str:
    field = members[0].__struct_config__.tag_field
    cases = "\n".join(
        f"            case {each.__name__}.TagName: return {each.__name__}.Read(reader);" for each in members
    )
    return f"""/// <summary>One of {len(members)} messages, distinguished by the field "{field}".</summary>
public abstract class {name} : WireValue
{{
    public abstract string Tag {{ get; }}

    public static {name} ReadAny(WireReader reader)
    {{
        string tag = reader.PeekTag("{field}");
        switch (tag)
        {{
{cases}
        }}
        throw new WireException("unknown {field} " + tag);
    }}
}}"""


def _render_class(struct: Struct, base: str) -> str:
    fields = [_render_member(field, struct) for field in struct.fields]
    tag = []
    if base:
        tag = [
            f'    public const string TagName = "{struct.tag}";',
            "    public override string Tag { get { return TagName; } }",
        ]
    return "\n".join(
        [
            *_render_doc(struct.doc),
            f"public sealed class {struct.name} : {base or 'WireValue'}",
            "{",
            *tag,
            *fields,
            "",
            *(f"    {line}".rstrip() for line in [*_render_read(struct), "", *_render_write(struct)]),
            "}",
        ]
    )


def _render_member(field: Field, struct: Struct) -> str:
    name = to_pascal_case(field.name, struct.name)
    return f"    public {_render_type(field.type)} {name} = {_render_initial_value(field)};"


def _render_type(kind: Type) -> str:
    if kind.base in _SCALARS:
        return _SCALARS[kind.base] + ("?" if kind.optional and kind.base in _VALUES else "")
    if kind.base == "array":
        assert kind.item is not None
        return _render_type(kind.item) + "[]"
    return "Dictionary<string, long>" if kind.base == "map" else kind.name


def _render_initial_value(field: Field) -> str:
    kind, default = field.type, field.default
    if kind.optional or kind.base == "union":
        return "null"
    if kind.base in ("struct", "map"):
        return f"new {_render_type(kind)}()"
    if kind.base == "bytes":
        return "new byte[0]"
    if kind.base == "array":
        assert kind.item is not None
        values = "" if field.required else ", ".join(_render_literal(value) for value in default)
        return (
            f"new {_render_type(kind.item)}[] {{ {values} }}"
            if values
            else f"new {_render_type(kind.item)}[{kind.length}]"
        )
    zero = {"bool": False, "int": 0, "float": 0.0, "str": ""}[kind.base]
    return _render_literal(zero if field.required else default)


def _render_literal(value: Any) -> str:
    return json.dumps(value)


def _render_read_value(kind: Type) -> str:
    match kind.base:
        case "int":
            return f"reader.ReadLong({_render_range(kind)})"
        case "str":
            return "reader.ReadAddress()" if kind.pattern else f"reader.ReadString({kind.max_length})"
        case "bytes":
            return f"reader.ReadBytes({kind.max_length})"
        case "bool" | "float":
            return f"reader.{_READS[kind.base]}()"
        case "map":
            return "reader.ReadCounts()"
        case "union":
            return f"{kind.name}.ReadAny(reader)"
        case "struct":
            return f"{kind.name}.Read(reader)"
    return _render_read_items(kind)


def _render_read_items(kind: Type) -> str:
    assert kind.item is not None
    item, most = kind.item, kind.max_length
    match item.base:
        case "float":
            return f"reader.ReadDoubles({kind.length}, {most})"
        case "int":
            return f"reader.ReadLongs({kind.length}, {most}, {_render_range(item)})"
        case "str":
            return f"reader.ReadStrings({most}, {item.max_length})"
    return f"reader.ReadArray(Protocol.{item.name}.Read, {most})"  # qualified: a field may be named like its type


def _render_range(kind: Type) -> str:
    """Return least and largest value, as C# writes them."""
    low = "long.MinValue" if kind.minimum in (None, -(2**63)) else str(kind.minimum)
    return f"{low}, {'long.MaxValue' if kind.maximum in (None, 2**63 - 1) else kind.maximum}"


def _render_assignment(field: Field, struct: Struct) -> str:
    target = f"value.{to_pascal_case(field.name, struct.name)}"
    if field.type.optional:
        null = f"({_render_type(field.type)})null" if field.type.base in _VALUES else "null"
        return f"{target} = reader.TryReadNil() ? {null} : {_render_read_value(field.type)};"
    return f"{target} = {_render_read_value(field.type)};"


def _render_read(struct: Struct) -> list[str]:
    return [
        f"public static {struct.name} Read(WireReader reader)",
        "{",
        f"    {struct.name} value = new {struct.name}();",
        *(_render_read_array(struct) if struct.array_like else _render_read_map(struct)),
        "    return value;",
        "}",
    ]


def _render_read_array(struct: Struct) -> list[str]:
    required = sum(field.required for field in struct.fields)
    lines = [
        "    int n = reader.ReadArrayHeader();",
        f'    if (n < {required}) throw new WireException("{struct.name} of " + n + " elements, expected {required}");',
    ]
    for k, field in enumerate(struct.fields):
        condition = "" if field.required else f"if (n > {k}) "
        lines.append(f"    {condition}{_render_assignment(field, struct)}")
    return [*lines, f"    for (int i = {len(struct.fields)}; i < n; i++) reader.Skip();"]


def _render_read_map(struct: Struct) -> list[str]:
    wanted = sum(1 << k for k, field in enumerate(struct.fields) if field.required)
    lines = [
        *(["    uint seen = 0;"] if wanted else []),
        "    for (int n = reader.ReadMapHeader(); n > 0; n--)",
        "    {",
        "        switch (reader.ReadString())",
        "        {",
    ]
    for k, field in enumerate(struct.fields):
        mark = f" seen |= {1 << k}u;" if field.required else ""
        lines.append(f'            case "{field.name}": {_render_assignment(field, struct)}{mark} break;')
    lines += [
        "            default: reader.Skip(); break;",
        "        }",
        "    }",
    ]
    if wanted:
        lines.append(
            f'    if ((seen & {wanted}u) != {wanted}u) throw new WireException("missing field of {struct.name}");'
        )
    return lines


def _render_write(struct: Struct) -> list[str]:
    count = len(struct.fields)
    lines = ["public override void WriteTo(WireWriter writer)", "{"]
    if struct.array_like:
        lines.append(f"    writer.WriteArrayHeader({count});")
    else:
        lines.append(f"    writer.WriteMapHeader({count + bool(struct.tag)});")
        if struct.tag:
            lines.append(f'    writer.Write("{struct.tag_field}");')
            lines.append("    writer.Write(TagName);")
    for field in struct.fields:
        if not struct.array_like:
            lines.append(f'    writer.Write("{field.name}");')
        lines.append(f"    writer.Write({to_pascal_case(field.name, struct.name)});")
    return [*lines, "}"]
