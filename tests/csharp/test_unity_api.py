"""The stand-ins of the engine have its signatures, and the layers use nothing else of it."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import pytest

from tests.e2e.session_process import skip_unless_ci
from tests.models import DATA
from tools.csharp.project import STANDINS, Build
from tools.csharp.toolchain import Assembly
from tools.csharp.unity_api import EXTRACT, Api, find_problems, load_api, make_extract, read_members

pytestmark = pytest.mark.e2e

SOURCE = Path(DATA, "unity/api.json")


def test_every_member_has_the_signature_that_is_listed(built: Build) -> None:
    assemblies = built.list_engine_members()
    assert not find_problems(load_api(EXTRACT), assemblies)
    declared = {member[1:5] for member in assemblies[STANDINS]}
    for name in {*assemblies} - {STANDINS}:
        used = [member for member in assemblies[name] if member.verb == "uses" and member.section != "props"]
        assert used, name
        assert {member[1:5] for member in used} <= declared, name


def test_extract_is_that_of_the_whole_list(built: Build) -> None:
    if not (DATA and SOURCE.is_file()):
        reason = f"needs unity/api.json in IRIS_DATA={DATA}"
        if not DATA:
            pytest.skip(reason)
        skip_unless_ci(reason)
    assert EXTRACT.read_text(encoding="utf-8") == make_extract(SOURCE, built.list_engine_members())


#: Some types of an engine. `in`, `obsolete`: in which of two versions.
API = Api(
    types={
        "UnityEngine.Object": {"pkg": "engine", "kind": "class"},
        "UnityEngine.MonoBehaviour": {"pkg": "engine", "kind": "class", "base": ["Object"], "ctors": ["()"]},
        "UnityEngine.Mode": {"pkg": "engine", "kind": "enum", "values": {"Off": 0, "On": 2}},
        "UnityEngine.Thing": {
            "pkg": "engine",
            "kind": "sealed class",
            "base": ["UnityEngine.Object"],
            "ctors": ["(int size)"],
            "props": {"mode": "UnityEngine.Mode {get}", "late": "int {get} @in:01", "old": "int {get} @obsolete:-W"},
            "methods": {
                "Place": ["void (Single x, int y = 3)", "static void <T>(in T one) where T : struct"],
                "Later": "void ()",
            },
        },
        "UnityEngine.LateThing": {"pkg": "engine", "kind": "class", "in": "01"},
    },
    packages={"engine": {"versions": ["6000.0.78f1", "6000.3.19f1"], "primary": "6000.3.19f1"}},
    messages=("void Awake()",),
)
GOOD = """
namespace UnityEngine {
    public class Object { }
    public class MonoBehaviour : Object { public MonoBehaviour() { } }
    public enum Mode { Off = 0, On = 2 }
    public sealed class Thing : Object {
        public Thing(int size) { }
        public Mode mode { get; internal set; }
        public void Place(float x, int y = 5) { }
        public static void Place<T>(in T one) where T : struct { }
        internal void Anything() { }
        /*wrong*/
    }
    /*beside*/
}
"""
#: Changes of the source above, each a member that is not that of the engine.
WRONG = {
    "parameter": ("float x, int y", "double x, int y"),
    "name of a parameter": ("float x, int y", "float z, int y"),
    "default": ("int y = 5", "int y"),
    "way of a parameter": ("in T one", "T one"),
    "constraint": ("<T>(in T one) where T : struct", "<T>(in T one)"),
    "type": ("public Mode mode { get; internal set; }", "public int mode { get; internal set; }"),
    "setter": ("public Mode mode { get; internal set; }", "public Mode mode { get; set; }"),
    "static": ("public void Place", "public static void Place"),
    "constructor": ("Thing(int size)", "Thing()"),
    "value": ("On = 2", "On = 1"),
    "kind": ("sealed class Thing", "class Thing"),
    "base": ("sealed class Thing : Object", "sealed class Thing : MonoBehaviour"),
    "method that is not there": ("/*wrong*/", "public void Absent() { }"),
    "type that is not there": ("/*beside*/", "public struct Absent { }"),
    "of a later version": ("/*wrong*/", "public int late { get; }"),
    "type of a later version": ("/*beside*/", "public class LateThing { }"),
    "obsolete": ("/*wrong*/", "public int old { get; }"),
}
#: Layers, with the number of their faults: members that a stand-in must not have, a message whose name is wrong.
LAYER = """
using UnityEngine;
sealed class Layer : MonoBehaviour {
    void Awake() { Help(new Thing(3)); }
    void Help(Thing thing) { thing.Place(1f); Thing.Place(thing.mode); /*wrong*/ }
    /*beside*/
}
"""
WRONG_LAYERS = {
    "member": ("/*wrong*/", "thing.Unlisted();"),
    "operator": ("/*wrong*/", "Thing other = -thing;"),
    "message": ("/*beside*/", "void Awoke() { }"),
    "signature of a message": ("void Awake()", "void Awake(int x)"),
}
STANDIN_BEYOND = GOOD.replace(
    "/*wrong*/", "public void Unlisted() { } public static Thing operator -(Thing a) => a; public void Later() { }"
)


def test_a_member_that_is_not_in_the_list_or_differs_is_found(built: Build, tmp_path: Path) -> None:
    jobs = []
    sources = {name: GOOD.replace(*change) for name, change in {"right": ("", ""), **WRONG}.items()}
    for number, source in enumerate(sources.values()):
        path = tmp_path / f"Standin{number}.cs"
        path.write_text(source)
        jobs.append((Assembly(path.stem, (path,), lists_members=True), "dotnet", tmp_path))
    path = tmp_path / "Beyond.cs"
    path.write_text(STANDIN_BEYOND)
    jobs.append((Assembly("Beyond", (path,)), "dotnet", tmp_path))
    layers = {name: LAYER.replace(*change) for name, change in {"right layer": ("", ""), **WRONG_LAYERS}.items()}
    for number, source in enumerate(layers.values()):
        path = tmp_path / f"Layer{number}.cs"
        path.write_text(source)
        jobs.append((Assembly(path.stem, (path,), (tmp_path / "Beyond.dll",), lists_members=True), "dotnet", tmp_path))
    built.toolchain.compile(jobs)
    names = {f"Standin{i}": name for i, name in enumerate(sources)} | {
        f"Layer{i}": name for i, name in enumerate(layers)
    }
    faults = Counter()
    for stem, name in names.items():
        members = read_members(tmp_path / f"{stem}.members")
        assert members, name
        faults[name] = len(find_problems(API, {f"Some.Editor.Quest.{stem}": members}))  # of both versions
    assert {name for name, count in faults.items() if not count} == {"right", "right layer"}, faults
