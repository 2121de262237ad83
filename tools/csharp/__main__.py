"""Build the C# of this checkout, run its tests, or run one of its programs.

python -m tools.csharp test [--runtime mono] [--filter TEXT] [--long]
python -m tools.csharp run [--runtime mono] PROGRAM [ARGUMENT ...]
python -m tools.csharp build
python -m tools.csharp unity-api          # unity_api.json again, of $IRIS_DATA/unity/api.json
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
from pathlib import Path

from tools.csharp.project import Build, build, find_programs, run_tests
from tools.csharp.toolchain import RUNTIMES, ToolchainError
from tools.csharp.unity_api import EXTRACT, find_problems, load_api, make_extract


def main(arguments: list[str] | None = None) -> int:
    """Run the command line. Return the exit status: 1 when something does not compile or a test fails."""
    parser = argparse.ArgumentParser(
        prog="python -m tools.csharp", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    commands = parser.add_subparsers(dest="command", required=True)
    commands.add_parser("build", help="compile, and print the folder")
    test = commands.add_parser("test", help="run the NUnit tests")
    test.add_argument("--runtime", choices=RUNTIMES, help="only on this one")
    test.add_argument("--filter", default="", help="only tests whose full name has this text")
    test.add_argument("--long", action="store_true", help="also those of the category Long")
    commands.add_parser("unity-api", help="check the members of the engine that are used, and write unity_api.json")
    run = commands.add_parser("run", help="run a program of tools/csharp/programs")
    run.add_argument("program", choices=find_programs())
    run.add_argument("--runtime", choices=RUNTIMES, default=RUNTIMES[0])
    run.add_argument("arguments", nargs=argparse.REMAINDER, help="of the program: they begin with its command")
    options = parser.parse_args(arguments)
    try:
        built = build()
        if options.command == "run":
            command = [*built.make_command(options.runtime, options.program), *options.arguments]
            os.execvp(command[0], command)
        if options.command == "build":
            print(built.folder)
            return 0
        if options.command == "unity-api":
            return _update_unity_api(built)
        failed = 0
        for runtime in (options.runtime,) if options.runtime else RUNTIMES:
            with tempfile.TemporaryDirectory() as folder:
                given = (*(["--long"] if options.long else []), "--filter", options.filter)
                results = run_tests(built, runtime, Path(folder, "results"), *given)
            failures = [one for one in results if one["failure"]]
            for one in failures:
                print(f"FAILED on {runtime}: {one['name']}\n{one['failure']}\n")
            skipped = sum(bool(one["skipped"]) for one in results)
            passed = len(results) - len(failures) - skipped
            print(f"{runtime}: {passed} passed, {len(failures)} failed, {skipped} skipped")
            failed += len(failures)
        return int(failed > 0)
    except ToolchainError as error:
        print(error, file=sys.stderr)
        return 1


def _update_unity_api(built: Build) -> int:
    source = Path(os.environ.get("IRIS_DATA", ""), "unity/api.json")
    if not source.is_file():
        raise ToolchainError("set IRIS_DATA to the folder that has unity/api.json")
    assemblies = built.list_engine_members()
    EXTRACT.write_text(make_extract(source, assemblies), encoding="utf-8")
    problems = find_problems(load_api(EXTRACT), assemblies)
    print(
        "\n".join(problems) if problems else f"{EXTRACT.name}: {sum(map(len, assemblies.values()))} members are right"
    )
    return int(bool(problems))


if __name__ == "__main__":
    sys.exit(main())
