"""Sources beyond C# 9 and .NET Standard 2.1 do not compile; a missing tool chain is an error of one line."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from tools.csharp import toolchain
from tools.csharp.project import RUNNER, Build
from tools.csharp.toolchain import (
    COMPILER,
    NUNIT,
    RUNTIMES,
    Assembly,
    Package,
    ToolchainError,
    prepare_toolchain,
    run_tool,
)

pytestmark = pytest.mark.e2e

GOOD = "using System;\npublic static class A { public static int Count(ReadOnlySpan<byte> span) => span.Length; }\n"
#: What is beyond the bounds -> a source, the libraries that refuse it, and what the compiler says.
BAD = {
    "language of C# 10": ("namespace Later; public static class A { }", RUNTIMES, "CS8773"),
    "warning": ("public static class A { static int unused; }", RUNTIMES, "CS0169"),
    "type of .NET Core": ("public class A { public System.Text.Json.JsonElement B; }", ("dotnet",), "JsonElement"),
    "type of Mono": ("public class A { public System.Runtime.Remoting.ObjRef B; }", ("dotnet",), "CS0234"),
    "member of .NET Core": (
        "public static class A { public static void B(System.Threading.Thread t) => t.UnsafeStart(); }",
        RUNTIMES,
        "CS1061",
    ),
    "feature of .NET 5": ("public class A { public int B { get; init; } }", RUNTIMES, "CS0518"),
}


def test_only_sources_within_the_bounds_compile(built: Build, tmp_path: Path) -> None:
    """Each in a compilation of its own, all in one process; the compiler names the files that it refused, and why."""
    jobs = []
    for number, (source, runtimes, _) in enumerate([(GOOD, RUNTIMES, ""), *BAD.values()]):
        path = tmp_path / f"Source{number}.cs"
        path.write_text(source)
        jobs += [(Assembly(path.stem, (path,)), runtime, tmp_path / runtime) for runtime in runtimes]
    with pytest.raises(ToolchainError) as caught:
        built.toolchain.compile(jobs)
    for number, (_, runtimes, words) in enumerate(BAD.values(), 1):
        said = [line for line in str(caught.value).splitlines() if f"Source{number}" in line and words in line]
        assert len(said) >= len(runtimes), number
    assert {path.name for path in tmp_path.rglob("*.dll")} == {"Source0.dll"}


SUITE = """
using NUnit.Framework;
namespace Small {
    [TestFixture] public class Tests {
        int count;
        [SetUp] public void Prepare() { count++; }
        [TearDown] public void Check() { Assert.AreEqual(1, count); }
        [Test] public void Passes() { }
        [Test] public void Fails() { Assert.AreEqual(1, 2); }
        [Test] public void LeavesSomething() { count++; }
        [Test] public void Throws() { throw new System.InvalidOperationException("why"); }
        [Test, Ignore("later")] public void IsIgnored() { }
        [Test, Category("Long")] public void TakesLong() { }
        [TestCase(1, ExpectedResult = 2L)] [TestCase(2, ExpectedResult = 5L)] public long Adds(long a) { return a + 1; }
        static readonly object[] Pairs = { new object[] { "a", 1 }, new object[] { "bc", 3 } };
        [TestCaseSource("Pairs")] public void Counts(string text, int n) { Assert.AreEqual(n, text.Length); }
    }
}
"""


@pytest.mark.parametrize("runtime", RUNTIMES)
def test_runner_says_what_passed_and_why_not(built: Build, tmp_path: Path, runtime: str) -> None:
    source, results = tmp_path / "Small.cs", tmp_path / "results"
    source.write_text(SUITE)
    built.toolchain.compile([(Assembly("Small.Tests", (source,), (NUNIT,)), runtime, tmp_path)])
    command = [*built.make_command(runtime, RUNNER), str(results), str(tmp_path / "Small.Tests.dll")]
    run_tool(command, "the runner")
    lines = [json.loads(line) for line in results.read_text().splitlines()]
    failed = {one["name"].removeprefix("Small.Tests."): one["failure"] for one in lines if one["failure"]}
    assert {*failed} == {"Fails", "LeavesSomething", "Throws", "Adds(2)", 'Counts("bc", 3)'}
    assert "InvalidOperationException: why" in failed["Throws"]
    assert re.search(r"Small\.cs:(line )?11\b", failed["Throws"])
    passed = {one["name"].removeprefix("Small.Tests.") for one in lines if not one["failure"] and not one["skipped"]}
    assert passed == {"Passes", "Adds(1)", 'Counts("a", 1)'}
    assert [one["skipped"] for one in lines if one["skipped"]] == ["later"]


@pytest.mark.usefixtures("built")
def test_another_archive_than_the_pinned_one_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def download(package: Package, folder: Path) -> Path:
        archive = folder / "other.tgz"
        archive.write_bytes(b"other")
        return archive

    monkeypatch.setattr(toolchain, "_download_npm", download)
    with pytest.raises(ToolchainError, match=COMPILER.sha256):
        prepare_toolchain(tmp_path)
    assert not any(path.is_dir() for path in tmp_path.iterdir())


def test_what_cannot_be_had_is_said_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(toolchain, "find_missing", lambda: ["chromium", "mono-mcs"])
    with pytest.raises(ToolchainError, match=r"apt-get install mono-mcs$"):
        prepare_toolchain(tmp_path)
    with pytest.raises(ToolchainError, match=r"^npm cannot get it: .*no-such-npm.*$"):
        run_tool(["no-such-npm"], "npm cannot get it")
