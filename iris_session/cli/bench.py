"""`iris-session bench NAME`: run one benchmark with separate client processes and compare it with its bars."""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from iris_session.cli.common import (
    CommandError,
    Commands,
    add_actions,
    add_command,
    make_number_type,
    parse_seconds,
    print_result,
)

if TYPE_CHECKING:
    from iris_session.bench.report import BenchReport


class Range(NamedTuple):
    """A number of an option: its default, and what a scene or a session can have."""

    default: int | float
    low: int
    high: int


Options = dict[str, Range | float | str]
#: Options of most benchmarks, and of those with a session and clients.
_RUN: Final[Options] = {"seconds": 20.0, "seed": 0}
_SESSION: Final[Options] = {**_RUN, "curve": False, "profile": ""}
_BODIES: Final = Range(300, 1, 2000)
_VERTICES: Final = Range(10_000, 16, 10_000)
#: Benchmark, `run_NAME` in a module of `iris_session.bench`: what it measures, and its parameters with their defaults.
BENCHMARKS: Final[dict[str, tuple[str, Options]]] = {
    "state": (
        "age, size and error of the state that clients receive",
        {"clients": Range(16, 1, 64), "bodies": _BODIES, **_SESSION},
    ),
    "input": (
        "time from the receipt of a sample to the first frame that shows it applied",
        {"operators": Range(8, 1, 12), "robots": Range(8, 1, 12), "observers": Range(8, 0, 64), **_SESSION},
    ),
    "slow-client": (
        "two clients that stall in turn: their recovery, and the effect on the others",
        {"clients": Range(16, 3, 64), "bodies": _BODIES, **_SESSION, "seconds": 50.0},
    ),
    "alignment": (
        "distance at which two headsets place the same point",
        {"pairs": Range(2000, 10, 100_000), "headsets": Range(200, 2, 100_000), "worlds": "none", "seed": 0},
    ),
    "deformable": (
        "a cloth in motion, encoded by the session and decoded by clients",
        {"vertices": _VERTICES, "clients": Range(4, 1, 64), **_SESSION},
    ),
    "cloud": (
        "depth pictures become clouds that are sent to a session",
        {"points": Range(2_000_000, 10_000, 20_000_000), "cameras": Range(1, 1, 4), **_RUN, "beside": False},
    ),
    "cloud-stream": (
        "clouds from a process of their own to clients in others",
        {
            "clients": Range(4, 1, 16),
            "points": Range(50_000, 1000, 1_000_000),
            "hz": Range(60, 1, 120),
            "mbit": Range(0.0, 0, 10_000),
            **_RUN,
            "curve": False,
        },
    ),
    "join": (
        "a scene with large assets is prepared, fetched, verified and decoded",
        {"objects": Range(300, 1, 2000), "assets_mb": Range(200.0, 1, 2000), "clients": Range(4, 1, 64), **_RUN},
    ),
    "share": ("what sharing adds to the steps of an environment", {"seconds": 100.0}),
    "stop": ("how far an arm presses on after a hold", {"seconds": 1.0}),
    "hands": ("how far faults of tracking move an arm", {"seconds": 300.0, "seed": 0}),
    "csharp": (
        "the C# core of headset apps, on .NET and Mono",
        {"bodies": _BODIES, "points": Range(10_000, 1000, 1_000_000), **_RUN},
    ),
    "record": (
        "processor time and size of a recording, and what is left after kills",
        {"seconds": 60.0, "kills": Range(21, 1, 1000), "seed": 0},
    ),
    "export": (
        "a data set is made of a recording with episodes, pictures drawn and encoded",
        {"episodes": Range(20, 3, 10_000), "seconds": 20.0, "shadows": False, "jobs": Range(1, 1, 1024), "python": ""},
    ),
    # A tab, one that is disturbed and one that is not; a gateway has three quarters of all connections.
    "web": (
        "browsers behind the web gateway, one of them a real tab",
        {"clients": Range(8, 3, 48), "vertices": _VERTICES, "seconds": 65.0, "seed": 0, "curve": False, "tab": True},
    ),
}
_TEXTS: Final = {
    "clients": "number of clients",
    "bodies": "moving bodies",
    "operators": "operators, one robot each",
    "robots": "seven-joint arms",
    "observers": "observers",
    "pairs": "pairs of headsets",
    "headsets": "headsets in every world",
    "worlds": "also these worlds, with commas between them: W1 to W12, lab_..., rows, mixes, all",
    "vertices": "vertices of the cloth, a square number",
    "points": "points of a cloud, for `cloud` pixels of its cameras",
    "cameras": "number of cameras",
    "hz": "clouds per second",
    "mbit": "bandwidth of every client's link from the middle of the measured part on [Mbit/s]; 0: not limited",
    "objects": "bodies with meshes",
    "assets_mb": "size of the assets after compression [MB]",
    "seconds": "measured part [s]; for `export` the length of an episode",
    "episodes": "episodes of the recording",
    "shadows": "draw pictures in full; without a graphics card this takes most of an hour",
    "jobs": "processes, an episode each",
    "python": "a Python with LeRobot, whose own writer is measured beside ours",
    "kills": "kills of recorder, authority and both",
    "seed": "random seed",
    "beside": "beside a session in which two arms are driven, 500 ticks a second",
    "curve": "encrypted and authenticated",
    "profile": "link profile of every client (docs/evidence/links.md); bars do not apply then",
}


def register(commands: Commands) -> None:
    names = add_actions(
        commands,
        "bench",
        metavar="NAME",
        help="run a benchmark and compare it with its bars",
        description="Measure with separate client processes. With --check, exit status 1 if a bar is missed. "
        "`iris-session bench NAME --help` has the options of one.",
        examples="""
            iris-session bench state --check
            iris-session bench state --curve --json
            iris-session bench input --operators 4 --robots 4 --seconds 10
            iris-session bench state --profile busy-wifi
            iris-session bench alignment --worlds W1,mixes --headsets 100 --json
            iris-session bench cloud --beside --check
            iris-session bench cloud-stream --points 50000 --hz 60 --check
            iris-session bench record --seconds 20 --kills 4
            iris-session bench web --clients 8 --curve --check
        """,
    )
    for name, (text, options) in BENCHMARKS.items():
        parser = add_command(
            names,
            name,
            run,
            help=text,
            description=f"Measure: {text}.",
            examples=f"iris-session bench {name} --check",
        )
        for option, default in options.items():
            _add_option(parser, option, default)
        parser.add_argument("--check", action="store_true", help="exit status 1 if a bar is missed")


def _add_option(parser: argparse.ArgumentParser, name: str, given: Range | float | str) -> None:
    flag = f"--{name.replace('_', '-')}"
    default = given.default if isinstance(given, Range) else given
    if name == "tab":
        parser.add_argument("--no-tab", dest="tab", action="store_false", help="no real browser, even if there is")
        return
    if isinstance(default, bool):
        parser.add_argument(flag, action="store_true", help=_TEXTS[name])
        return
    parse: Callable[[str], Any] = parse_seconds if name == "seconds" else type(default)
    if isinstance(given, Range):
        wanted = f"a number that can be measured: give {given.low} to {given.high}"
        parse = make_number_type(parse, wanted, given.low, given.high)
    text = _TEXTS[name] + (" (default: %(default)s)" if default != "" else "")
    parser.add_argument(flag, type=parse, default=default, help=text)


def run(arguments: argparse.Namespace) -> int:
    """Run one benchmark and print its report."""
    from iris_session.bench.report import BenchError, measure_parallel_speed, read_stolen_time
    from iris_session.netsim.profiles import load_profile

    name = arguments.action.replace("-", "_")
    function = getattr(importlib.import_module(f"iris_session.bench.{name}"), f"run_{name}")
    options = {option: getattr(arguments, option) for option in BENCHMARKS[arguments.action][1]}
    if options.get("operators", 0) > options.get("robots", 0):
        raise CommandError(f"--operators {arguments.operators}: each drives a robot, there are {arguments.robots}")
    if options.get("profile"):
        load_profile(options["profile"])  # fails before anything is started

    def progress(text: str) -> None:
        print(f"bench {arguments.action}: {text}", file=sys.stderr, flush=True)

    speed = measure_parallel_speed()
    stolen_s, all_s = read_stolen_time()
    try:
        report: BenchReport = function(**options, progress=progress)
    except BenchError as error:
        raise CommandError(str(error), 1) from error
    stolen_after_s, all_after_s = read_stolen_time()
    share = (stolen_after_s - stolen_s) / max(all_after_s - all_s, 1e-9)
    report = report.complete(arguments.action, options, share, min(speed, measure_parallel_speed()))
    print_result(arguments, report.as_dict(), report.format().split("\n"))
    return 0 if report.ok or not arguments.check else 1
