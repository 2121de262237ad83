"""Run the stages of `make test`, or of `make test-long`, and print a table of them.

    python tools/run_tests.py           # all that decides
    python tools/run_tests.py --long    # the rest: what takes long
    python tools/run_tests.py --only unit,processes

A stage is a command; all run, whatever the one before found. Those that take one core each run two at a time, and show
what they print when they end. Markers of tests: none: in one process; `e2e`: starts processes; `browser`: one that
opens pages; `long`: not in `make test`. The last line is like that of pytest; exit status 0 if no stage failed.
"""

from __future__ import annotations

import argparse
import itertools
import os
import subprocess
import sys
import tempfile
import time
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

ROOT: Final = Path(__file__).resolve().parents[1]
BIN: Final = Path(sys.executable).parent
#: Rooms that decide, and their tests, which start no process: their coverage has a bound of its own.
CORE: Final = ("authority", "protocol", "control")
CORE_PERCENT: Final = 95
#: Bound of the coverage of everything else by tests in one process, and by the processes that they start.
PERCENT: Final = 90
#: Tests at once. Tests of processes mostly wait, and those in real time need what they leave of two cores.
UNIT_JOBS: Final = 3
PROCESS_JOBS: Final = 2


@dataclass(frozen=True)
class Stage:
    """A command. `is_pytest`: its tests are counted; `takes_one_core`: it may run beside another of these."""

    name: str
    command: tuple[str, ...]
    is_pytest: bool = False
    takes_one_core: bool = False


@dataclass
class Result:
    """Result of a stage. `not_run`: number of skipped tests by reason; `tests`: those that passed or failed.

    `seconds`: how long it took; `processor_s`: time of all its processes on processors.
    """

    name: str
    ok: bool
    seconds: float
    processor_s: float
    tests: int = 0
    failed: int = 0
    not_run: Counter[str] = field(default_factory=Counter)


def make_pytest(name: str, markers: str, *options: str, takes_one_core: bool = False) -> Stage:
    """Return a stage of tests, selected by markers."""
    command = (sys.executable, "-m", "pytest", "-q", "-m", markers, *options)
    return Stage(name, command, is_pytest=True, takes_one_core=takes_one_core)


def make_stages() -> tuple[Stage, ...]:
    """Return what decides."""
    core_tests = tuple(f"tests/{room}" for room in CORE)
    covered = tuple(f"--cov=iris_session/{room}" for room in CORE)
    return (
        Stage("lint", (str(BIN / "ruff"), "check", "."), takes_one_core=True),
        Stage("format", (str(BIN / "ruff"), "format", "--check", "."), takes_one_core=True),
        # They wait for frames and for each other: beside another stage they take no longer.
        make_pytest("browsers", "e2e and not long and browser", "-p", "no:xdist", "tests/e2e", takes_one_core=True),
        make_pytest(
            "core",
            "not e2e and not long",
            *("-p", "no:xdist", *covered, "--cov-report=term:skip-covered", f"--cov-fail-under={CORE_PERCENT}"),
            *core_tests,
            takes_one_core=True,
        ),
        Stage("types", (str(BIN / "mypy"),), takes_one_core=True),
        Stage("web client", ("make", "--no-print-directory", "test-web"), takes_one_core=True),
        # Compiles the tests once; the workers of the next stage would each do it, at the same time.
        make_pytest("collection", "not long", "-p", "no:xdist", "--collect-only", "-qq", "tests", takes_one_core=True),
        make_pytest(
            "unit",
            "not e2e and not long",
            *("-n", str(UNIT_JOBS), "--dist", "worksteal", *(f"--ignore={folder}" for folder in core_tests), "tests"),
        ),
        # A file stays on one worker: its tests share sessions. The longest begin first (tests/e2e/conftest.py).
        make_pytest(
            "processes",
            "e2e and not long and not browser",
            *("-n", str(PROCESS_JOBS), "--dist", "loadfile", "--no-loadscope-reorder", "tests"),
        ),
    )


def make_long_stages() -> tuple[Stage, ...]:
    """Return what takes long. Demos, drawn pictures and benchmarks need the machine for themselves: one at a time."""
    core = ",".join(f"iris_session/{room}/*" for room in CORE)
    return (
        make_pytest(
            "all units",
            "not e2e",
            *("-n", str(UNIT_JOBS), "--dist", "worksteal", "--cov", "--cov-report=", "tests"),
        ),
        Stage(
            "coverage",
            (sys.executable, "-m", "coverage", "report", f"--omit={core}", f"--fail-under={PERCENT}", "--skip-covered"),
        ),
        make_pytest("long", "e2e and long", "-p", "no:xdist", "tests"),
        Stage("fuzz", (sys.executable, "tools/fuzz.py", "--target", "all", "--inputs", "100000", "--seed", "1")),
        # Damaged messages, frames and assets for each decoder: 100,000 in the page, 300,000 in C# on both runtimes.
        Stage("web client", ("env", "IRIS_FUZZ=100000", "make", "--no-print-directory", "test-web")),
        Stage("C#", (sys.executable, "-m", "tools.csharp", "test", "--long")),
        Stage("hostile", (sys.executable, "tools/hostile.py", "--quick")),
        Stage("soak", (sys.executable, "tools/soak.py", "--seconds", "120", "--operators", "3", "--observers", "1")),
    )


def run_stages(stages: Sequence[Stage], folder: Path) -> list[Result]:
    """Run stages in their order, those that take one core two at a time."""
    results = []
    for one_core, some in itertools.groupby(stages, key=lambda stage: stage.takes_one_core):
        with ThreadPoolExecutor(2 if one_core else 1) as pool:
            results += pool.map(lambda stage: run_stage(stage, folder), some)
    return results


def run_stage(stage: Stage, folder: Path) -> Result:
    """Run a stage; what it prints is shown, at its end if others may run beside it."""
    report, output = folder / f"{stage.name}.xml", folder / f"{stage.name}.txt"
    command = [*stage.command, f"--junitxml={report}"] if stage.is_pytest else list(stage.command)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    # Some environments forbid compiled files: then each process that a test starts compiles all our modules anew.
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    begin = time.monotonic()
    with output.open("w") if stage.takes_one_core else nullcontext() as file:
        if file is None:
            print(f"\n--- {stage.name}", flush=True)
        process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=file, stderr=file)
        _, status, usage = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    if stage.takes_one_core:
        print(f"\n--- {stage.name}\n{output.read_text(errors='replace')}", end="", flush=True)
    result = Result(
        stage.name, process.returncode == 0, time.monotonic() - begin, processor_s=usage.ru_utime + usage.ru_stime
    )
    if report.is_file():
        count_tests(ET.parse(report).getroot(), result)
    return result


def count_tests(report: ET.Element, result: Result) -> None:
    """Add the tests of a report of pytest (JUnit's form) to a result."""
    for case in report.iter("testcase"):
        skipped = case.find("skipped")
        if skipped is not None:
            result.not_run[skipped.get("message", "")] += 1
            continue
        result.tests += 1
        result.failed += case.find("failure") is not None or case.find("error") is not None


def format_summary(results: list[Result], seconds: float) -> str:
    """Return the table of stages, the tests that were not run, and the line of counts and of the time of all."""
    lines = ["", f"{'stage':<20} {'':<6} {'passed':>7} {'failed':>7} {'minutes':>8} {'processor':>10}"]
    for one in results:
        counts = (one.tests - one.failed, one.failed) if one.tests else ("", "")
        times = f"{one.seconds / 60:>8.1f} {one.processor_s / 60:>10.1f}"
        lines.append(f"{one.name:<20} {'ok' if one.ok else 'FAILED':<6} {counts[0]:>7} {counts[1]:>7} {times}")
    not_run = sum((one.not_run for one in results), Counter[str]())
    lines += [f"not run: {count} tests: {reason}" for reason, count in not_run.most_common()]
    broken = [one.name for one in results if not one.ok]
    lines += [f"failed: {', '.join(broken)}"] if broken else []
    failed = sum(one.failed for one in results)
    failed += sum(not one.ok and not one.failed for one in results)  # a stage that failed without a failed test
    counts_of_all = [
        *([f"{failed} failed"] if failed else []),
        f"{sum(one.tests - one.failed for one in results)} passed",
        *([f"{not_run.total()} skipped"] if not_run else []),
    ]
    lines.append(f"===== {', '.join(counts_of_all)} in {seconds:.2f}s ({seconds / 60:.1f} minutes) =====")
    return "\n".join(lines)


def main(arguments: list[str] | None = None) -> int:
    """Run the stages. Return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--long", action="store_true", help="the stages of make test-long")
    parser.add_argument("--only", help="names of stages, with commas between")
    args = parser.parse_args(arguments)
    stages = make_long_stages() if args.long else make_stages()
    if args.only:
        names = args.only.split(",")
        if unknown := set(names) - {stage.name for stage in stages}:
            parser.error(f"--only {', '.join(unknown)}: the stages are {', '.join(stage.name for stage in stages)}")
        stages = tuple(stage for stage in stages if stage.name in names)
    with tempfile.TemporaryDirectory() as folder:
        begin = time.monotonic()
        results = run_stages(stages, Path(folder))
    print(format_summary(results, time.monotonic() - begin), flush=True)
    return int(not all(result.ok for result in results))


if __name__ == "__main__":
    sys.exit(main())
