"""Builds the assemblies of `unity_client`, their tests, and the programs of tools/csharp/programs.

An assembly is a folder with a `.asmdef`, as in Unity; a test assembly names `nunit.framework.dll` in it. One that does
not say `noEngineReferences` is compiled against stand-ins of the engine, tools/csharp/standins, as are its tests in
tests/csharp/unity. A program is a folder of tools/csharp/programs, named like it, and may use all assemblies.
Builds are kept in the user's cache by the hash of everything that goes into them.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Final

import zmq
from filelock import FileLock

from tools.csharp.deflate_vectors import render_deflate_vectors
from tools.csharp.pairing_vectors import render_pairing_vectors
from tools.csharp.scene_vectors import render_scene_vectors
from tools.csharp.toolchain import HERE, NUNIT, RUNTIMES, Assembly, Toolchain, prepare_toolchain, run_tool
from tools.csharp.unity_api import Member, read_members
from tools.csharp.unity_scenes import write_unity_scenes
from tools.csharp.vectors import render_message_vectors

ROOT: Final = HERE.parents[1]
PACKAGES: Final = ("unity_client", "hololens_client", "tools/csharp/standins", "tests/csharp/unity")
#: How names of assemblies of the engine's packages begin.
OF_OTHERS: Final = ("Unity", "Microsoft", "Oculus", "meta")
#: The assembly that stands for the engine and its packages.
STANDINS: Final = "UnityEngine"
RUNNER: Final = "runner"
FUZZ_LONG: Final = 300_000
#: Builds that are kept; the oldest are removed.
_KEPT: Final = 8


@dataclass(frozen=True)
class Project:
    """An assembly definition. `references`: names of other projects. `has_engine`: it stands for it, or uses it."""

    name: str
    folder: Path
    references: tuple[str, ...]
    is_test: bool
    has_engine: bool

    @cached_property
    def sources(self) -> tuple[Path, ...]:
        """The sources, without those of an assembly in a folder below."""
        others = [path.parent for path in self.folder.rglob("*.asmdef") if path.parent != self.folder]
        found = self.folder.rglob("*.cs")
        return tuple(sorted(path for path in found if not any(folder in path.parents for folder in others)))


@dataclass(frozen=True)
class Build:
    """Compiled projects. `folder` has a folder for each runtime. `with_engine`: names of stand-ins and layers."""

    toolchain: Toolchain
    folder: Path
    tests: tuple[str, ...]
    with_engine: tuple[str, ...] = ()

    def make_command(self, runtime: str, program: str) -> list[str]:
        """Return the command that runs a program of tools/csharp/programs on `dotnet` or `mono`."""
        return self.toolchain.make_command(runtime, self.folder / runtime / f"{program}.dll")

    def make_test_command(self, runtime: str, results: Path, *options: str) -> list[str]:
        """Return the command that runs the tests and writes a line of JSON for each into `results`."""
        assemblies = [str(self.folder / runtime / f"{name}.dll") for name in self.tests]
        return [*self.make_command(runtime, RUNNER), str(results), *options, *assemblies]

    def list_engine_members(self) -> dict[str, list[Member]]:
        """Return what each assembly with the engine declares and uses of it."""
        return {name: read_members(self.folder / RUNTIMES[0] / f"{name}.members") for name in self.with_engine}


def find_projects(root: Path = ROOT) -> list[Project]:
    """Return the assemblies that have sources, each after those that it refers to."""
    found: dict[str, Project] = {}
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.asmdef")):
            text = json.loads(path.read_text(encoding="utf-8"))
            has_engine = not text.get("noEngineReferences")
            named = tuple(name for name in text.get("references", ()) if not name.startswith(OF_OTHERS))
            references = (*named, *([STANDINS] if has_engine else []))
            is_test = NUNIT.name in text.get("precompiledReferences", ())
            project = Project(text["name"], path.parent, references, is_test, has_engine or text["name"] == STANDINS)
            if project.sources:
                found[project.name] = project
    ordered: dict[str, Project] = {}

    def add(project: Project) -> None:
        for name in project.references:
            if name in found and name not in ordered:
                add(found[name])
        ordered[project.name] = project

    for project in found.values():
        add(project)
    return list(ordered.values())


def find_programs() -> dict[str, tuple[Path, ...]]:
    """Return name and sources of the programs."""
    return {path.name: tuple(sorted(path.rglob("*.cs"))) for path in sorted((HERE / "programs").iterdir())}


def build(folder: Path | None = None) -> Build:
    """Compile everything for both runtimes, unless that was done already. Safe to call from several processes at once.

    Args:
        folder: Where tool chain and builds are kept; by default in the user's cache.

    Raises:
        ToolchainError: The tool chain cannot be had, or a source does not compile.
    """
    toolchain = prepare_toolchain(folder)
    builds = toolchain.compiler.parent / "builds"
    builds.mkdir(exist_ok=True)
    projects, programs = find_projects(), find_programs()
    key = _hash_inputs(toolchain, projects, programs)
    target = builds / key
    tests = tuple(project.name for project in projects if project.is_test)
    with FileLock(builds / ".lock"):
        if not target.exists():
            print("compiling the C# of this checkout ...", file=sys.stderr, flush=True)
            with tempfile.TemporaryDirectory(dir=builds) as temporary:
                built = Path(temporary, key)
                toolchain.compile(
                    (assembly, runtime, built / runtime)
                    for runtime in RUNTIMES
                    for assembly in _list_assemblies(projects, programs, built / runtime)
                )
                for runtime in RUNTIMES:
                    shutil.copy(NUNIT, built / runtime)
                    copy_libzmq(built / runtime)
                built.rename(target)
            _remove_old(builds)
        os.utime(target)
    with_engine = tuple(project.name for project in projects if project.has_engine and not project.is_test)
    return Build(toolchain, target, tests, with_engine)


def copy_libzmq(folder: Path) -> None:
    """Copy the libzmq of pyzmq's wheel, with what it needs, to where both runtimes look for native libraries."""
    for path in Path(zmq.__file__).parents[1].joinpath("pyzmq.libs").glob("*.so*"):
        shutil.copy(path, folder)
        if path.name.startswith("libzmq"):
            shutil.copy(path, folder / "libzmq.so")


def _list_assemblies(
    projects: list[Project], programs: dict[str, tuple[Path, ...]], folder: Path
) -> Iterator[Assembly]:
    for project in projects:
        references = [folder / f"{name}.dll" for name in _list_references(project, projects)]
        libraries = (*references, *([NUNIT] if project.is_test else ()))
        listed = project.has_engine and not project.is_test
        yield Assembly(project.name, project.sources, libraries, lists_members=listed)
    libraries = tuple(folder / f"{project.name}.dll" for project in projects if not project.is_test)
    for name, sources in programs.items():
        yield Assembly(name, sources, (*libraries, NUNIT), is_program=True)


def _list_references(project: Project, projects: list[Project]) -> list[str]:
    """Return the names of the projects that have sources and are referred to, directly or not."""
    named = {each.name: each for each in projects}
    found: dict[str, None] = {}
    waiting = list(project.references)
    while waiting:
        name = waiting.pop()
        if name in named and name not in found:
            found[name] = None
            waiting += named[name].references
    return list(found)


def _hash_inputs(toolchain: Toolchain, projects: list[Project], programs: dict[str, tuple[Path, ...]]) -> str:
    digest = hashlib.sha256(f"{toolchain.compiler.name} {toolchain.surface.name}".encode())
    for name, sources in (*((p.name, p.sources) for p in projects), *programs.items()):
        for path in sources:
            digest.update(f"\0{name}\0{path}\0".encode())  # paths are in the symbols
            digest.update(path.read_bytes())
    for project in projects:
        digest.update(repr((project.name, project.references, project.is_test, project.has_engine)).encode())
    for path in (HERE / "project.py", HERE / "toolchain.py", HERE / "Compiler.cs", HERE / "Members.cs"):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _remove_old(builds: Path) -> None:
    """Remove all but the newest builds. Those of a process that still runs are younger than that."""
    found = sorted((path for path in builds.iterdir() if path.is_dir()), key=lambda path: path.stat().st_mtime)
    for path in found[:-_KEPT]:
        shutil.rmtree(path, ignore_errors=True)


def run_tests(build: Build, runtime: str, results: Path, *options: str) -> list[dict[str, object]]:
    """Run all tests in one process.

    Args:
        build: What `build` returned.
        runtime: `dotnet` or `mono`.
        results: File to write.
        options: `--long`: those of the category Long too, and `FUZZ_LONG` damaged inputs for each decoder, otherwise a
            few thousand. `--filter TEXT`: those whose full name has the text.

    Returns:
        For each test `name` (`Namespace.Fixture.Test(arguments)`), `fixture`, `seconds`, and `failure`, empty if it
        passed, or `skipped`, the reason.

    Raises:
        ToolchainError: The process died; the text is what it printed.
    """
    with tempfile.TemporaryDirectory() as folder:
        is_long = "--long" in options
        vectors = render_message_vectors(ROOT / "docs/protocol", 30_000 if is_long else 3_000)
        Path(folder, "messages.txt").write_text(vectors, encoding="utf-8")
        Path(folder, "pairing.txt").write_text(render_pairing_vectors(), encoding="utf-8")
        Path(folder, "scenes.txt").write_text(render_scene_vectors(), encoding="utf-8")
        Path(folder, "deflate.bin").write_bytes(render_deflate_vectors())
        write_unity_scenes(Path(folder, "unity"))
        data = {"IRIS_VECTORS": folder, "IRIS_REPO": str(ROOT), **({"IRIS_FUZZ": str(FUZZ_LONG)} if is_long else {})}
        command = build.make_test_command(runtime, results, *options)
        run_tool(command, f"the tests on {runtime}", data, timeout_s=3_600.0 if is_long else 300.0)
    return [json.loads(line) for line in results.read_text(encoding="utf-8").splitlines()]
