"""Unity's public API as facts, and a check that our C# uses nothing else of it.

`Members.cs` lists what the stand-ins declare of the engine and what the layers use of it. Each of these members must be
in `unity_api.json` with the same signature, in the versions that the layer is for, and not obsolete there. That file is
an extract of a larger one, `unity/api.json` of the data folder (`IRIS_DATA`), with the types and members that are used
and no others: names and signatures, read from public sources. What that one lacks is listed in `unity_manual.json` with
the page of the manual that it was read from.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Final, NamedTuple

from tools.csharp.toolchain import HERE

EXTRACT: Final = HERE / "unity_api.json"
MANUAL: Final = HERE / "unity_manual.json"
#: Layer -> package -> versions in which a member must be there; of packages that are not listed, the primary one.
TARGETS: Final[Mapping[str, Mapping[str, tuple[str, ...]]]] = {
    "unity": {"engine": ("2022.3.76f1", "6000.0.78f1", "6000.3.19f1")},
    "hololens": {
        "engine": ("2022.3.76f1",),
        "editor": ("2022.3.76f1",),
        "com.unity.xr.arfoundation": ("5.1.6",),
        "com.unity.xr.openxr": ("1.13.0",),
    },
    "editor": {
        "engine": ("2022.3.76f1", "6000.0.78f1", "6000.3.19f1"),
        "editor": ("2022.3.76f1", "6000.0.78f1", "6000.3.19f1"),
        "com.unity.xr.openxr": ("1.13.0", "1.17.1"),
    },
    "editor.quest": {
        "engine": ("6000.0.78f1", "6000.3.19f1"),
        "editor": ("6000.0.78f1", "6000.3.19f1"),
    },
}
_ALIASES: Final = {
    "Boolean": "bool", "Byte": "byte", "SByte": "sbyte", "Int16": "short", "UInt16": "ushort", "Int32": "int",
    "UInt32": "uint", "Int64": "long", "UInt64": "ulong", "Single": "float", "Double": "double", "String": "string",
}  # fmt: skip
#: Modifiers that change nothing for those who call a member.
_IGNORED: Final = re.compile(r"\b(?:virtual|override|abstract|sealed|readonly|const|extern|unsafe|new|partial) ")
_TAG: Final = re.compile(r"@(in|obsolete|if)\b(?::([01WE-]+))?")


class Member(NamedTuple):
    """A line of `Members.cs`. `verb`: `declares`, `uses` or `calls`."""

    verb: str
    type: str
    section: str
    name: str
    signature: str
    place: str

    def __str__(self) -> str:
        return f"{self.place}: {'.'.join(filter(None, (self.type, self.name)))} {self.signature}"


def read_members(path: Path) -> list[Member]:
    """Read the members of an assembly."""
    return [Member(*line.split("\t")) for line in path.read_text(encoding="utf-8").splitlines()]


def write_plainly(section: str, signature: str) -> str:
    """Return a signature as the compiler's and that of the file are compared: what a caller depends on."""
    text = re.split(r" @|//", signature)[0]
    if section == "values":
        return text.strip()
    text = _IGNORED.sub("", f" {text}".replace("this ", "this_"))
    text = re.sub(r"(?:\w+\.)+(?=\w)", "", text)  # namespaces, outer types
    text = re.sub(r"\w+", lambda word: _ALIASES.get(word[0], word[0]), text)
    if section == "fields":
        return " ".join(text.split("=")[0].split())
    return re.sub(r"\s*([(),<>\[\]{}:=?;])\s*", r"\1", " ".join(_drop_defaults(text).split()))


def _drop_defaults(text: str) -> str:
    """Replace the values of optional parameters by nothing: `int a = 3` is `int a =`."""
    out, depth, skips = [], 0, False
    for letter in text:
        depth += letter in "([<"
        depth -= letter in ")]>"
        if skips and (letter == "," or depth == 0):
            skips = False
        if not skips:
            out.append(letter)
        if letter == "=" and depth:
            skips = True
    return "".join(out)


@dataclass(frozen=True)
class Api:
    """Facts: types by name, packages by name. `messages`: those of MonoBehaviour."""

    types: Mapping[str, Any]
    packages: Mapping[str, Any]
    messages: tuple[str, ...]

    @cached_property
    def message_names(self) -> set[str]:
        return {re.split(r"[ (]", message)[1] for message in self.messages}

    def find_entries(self, kind: str, section: str, name: str) -> Iterable[tuple[str, str]]:
        """Yield the types in which a member is declared, from the type itself to its bases, and what it is there."""
        found = self.types.get(kind)
        if found is None:
            return
        entries = found.get(section, ()) if section == "ctors" else found.get(section, {}).get(name, ())
        if section == "ctors" and "ctors" not in found and "class" in found["kind"] and "static" not in found["kind"]:
            entries = ["protected ()" if "abstract" in found["kind"] else "()"]  # the compiler makes it
        yield from ((kind, str(entry)) for entry in ([entries] if isinstance(entries, str | int) else entries))
        if section not in ("ctors", "values"):
            for base in found.get("base", ()):
                if (full := self._find_base(kind, base)) is not None:
                    yield from self.find_entries(full, section, name)

    def find_problem(self, member: Member, target: str) -> str:
        """Return why a member must not be used by the layer `target`; empty when it may."""
        found = self.types.get(member.type)
        if member.verb == "calls":
            good = member.signature in self.messages
            return "" if good else f"{member}: a private method that nothing calls is no message of MonoBehaviour"
        if found is None:
            return f"{member}: the type is not listed"
        missing = self._find_missing_versions(found["pkg"], [f"@in:{found['in']}" if "in" in found else ""], target)
        if missing:
            return f"{member}: the type is not in {missing}"
        if member.section == "types":
            return self._compare_types(member, found)
        entries = list(self.find_entries(member.type, member.section, member.name))
        same = [(home, entry) for home, entry in entries if _is_same(member, entry)]
        if not same:
            listed = "; ".join(entry for _, entry in entries) or "nothing of this name"
            return f"{member}: the list has {listed}"
        if any("unverified" in entry for _, entry in same):
            return f"{member}: the list says that it is not verified"
        if missing := self._find_missing_versions(self.types[same[0][0]]["pkg"], [entry for _, entry in same], target):
            return f"{member}: it is not in {missing}, or obsolete there"
        return ""

    def _find_base(self, kind: str, base: str) -> str | None:
        name = base.split("<", maxsplit=1)[0] + (f"`{base.count(',') + 1}" if "<" in base else "")
        spaces = [kind[:at] for at in range(len(kind) - 1, 0, -1) if kind[at] == "."]
        candidates = [name, *(f"{space}.{name}" for space in spaces), f"UnityEngine.{name}"]
        return next((one for one in candidates if one in self.types and one != kind), None)

    def _find_missing_versions(self, package: str, entries: list[str], target: str) -> str:
        """Return the versions of a target in which none of the entries is there without being obsolete."""
        versions: list[str] = self.packages[package]["versions"]
        wanted = TARGETS[target].get(package, (self.packages[package]["primary"],))
        good: set[str] = set()
        for entry in entries:
            there = set(versions)
            for tag, mask in _TAG.findall(entry):
                # Of an unknown condition, or obsolete without a mask: nowhere.
                wanted_bit = {"in": "1", "obsolete": "-"}.get(tag)
                there &= {version for version, bit in zip(versions, mask, strict=bool(mask)) if bit == wanted_bit}
            good |= there
        return ", ".join(version for version in wanted if version not in good)

    def _compare_types(self, member: Member, found: Mapping[str, Any]) -> str:
        kind, _, bases = member.signature.partition(" : ")
        if kind.startswith("delegate"):
            kind = "delegate"
        if kind != found["kind"].removeprefix("readonly "):
            return f"{member}: it is a {found['kind']}"
        known = {write_plainly("types", base) for base in found.get("base", ())}
        others = [
            base for base in re.split(r", (?![^<]*>)", bases) if base and write_plainly("types", base) not in known
        ]
        return f"{member}: it is no {', '.join(others)}" if others else ""


def _is_same(member: Member, entry: str) -> bool:
    if member.section != "props":
        return write_plainly(member.section, member.signature) == write_plainly(member.section, entry)
    (ours, accessors), (theirs, listed) = (
        write_plainly("props", text).split("{") for text in (member.signature, entry.split(" @", maxsplit=1)[0])
    )
    return ours == theirs and set(re.findall(r"[gs]et", accessors)) <= set(re.findall(r"[gs]et", listed))


def load_api(path: Path, manual: Path = MANUAL) -> Api:
    """Load a file of facts, with what the manual has beyond it."""
    content = json.loads(path.read_text(encoding="utf-8"))
    types = content["types"]
    for one in json.loads(manual.read_text(encoding="utf-8")):
        made = {"pkg": one["package"], "kind": one["kind"], "src": one["page"], "base": one.get("base", [])}
        home = types.setdefault(one["type"], made)
        if one.get("section"):
            home.setdefault(one["section"], {}).setdefault(one["name"], []).append(one["signature"])
    return Api(types, content["packages"], tuple(content["messages"]["list"]))


def find_problems(api: Api, assemblies: Mapping[str, list[Member]]) -> list[str]:
    """Return what is wrong with the members of assemblies, by their names."""
    found = []
    for name, members in assemblies.items():
        named = max((target for target in TARGETS if f".{target}" in name.lower()), key=len, default="")
        for member in members:
            problems = [api.find_problem(member, target) for target in ([named] if named else TARGETS)]
            if all(problems):  # stand-ins are for any layer
                found.append(next(filter(None, problems)))
    return found


def make_extract(source: Path, assemblies: Mapping[str, list[Member]]) -> str:
    """Return the text of the extract: what the assemblies declare and use of the file `source`."""
    content = json.loads(source.read_text(encoding="utf-8"))
    api = Api(content["types"], content["packages"], tuple(content["messages"]["list"]))
    types: dict[str, dict[str, Any]] = {}

    def add_type(kind: str) -> dict[str, Any]:
        if kind not in types:
            full = content["types"][kind]
            types[kind] = {key: full[key] for key in ("pkg", "kind", "base", "src", "in", "tparams") if key in full}
            types[kind].update({"ctors": []} if "ctors" in full else {})  # it has some, whether or not they are used
        return types[kind]

    for member in (member for members in assemblies.values() for member in members):
        if member.verb == "calls" or member.type not in content["types"]:
            continue
        add_type(member.type)
        for home, entry in api.find_entries(member.type, member.section, member.name):
            is_made = member.section == "ctors" and "ctors" not in content["types"][home]
            if member.section == "types" or is_made or not _is_same(member, entry):
                continue
            section = add_type(home).setdefault(member.section, [] if member.section == "ctors" else {})
            kept = section if member.section == "ctors" else section.setdefault(member.name, [])
            if entry not in kept:
                kept.append(entry)
    for kind in types.values():
        for section, names in list(kind.items()):
            if section == "ctors":
                kind[section] = sorted(names)
            elif isinstance(names, dict):
                kind[section] = {name: sorted(names[name]) for name in sorted(names)}
    packages = {kind["pkg"] for kind in types.values()}
    return _render(
        {
            "about": "Names and signatures of Unity's public API that unity_client uses; facts only. Made by "
            "`python -m tools.csharp unity-api`, which says where they come from.",
            "packages": {name: content["packages"][name] for name in sorted(packages)},
            "messages": content["messages"],
            "types": {kind: types[kind] for kind in sorted(types)},
        }
    )


def _render(content: Mapping[str, Any]) -> str:
    """Return JSON with a line for each type."""
    lines = []
    for key, value in content.items():
        if key in ("types", "packages"):
            inner = ",\n".join(f"    {json.dumps(name)}: {json.dumps(one)}" for name, one in value.items())
            lines.append(f"  {json.dumps(key)}: {{\n{inner}\n  }}")
        else:
            lines.append(f"  {json.dumps(key)}: {json.dumps(value)}")
    return "{\n" + ",\n".join(lines) + "\n}\n"
