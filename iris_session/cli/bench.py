"""`iris-session bench NAME`: run one benchmark with separate client processes and compare it with its bars."""

from __future__ import annotations

import argparse
import importlib
import sys
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from iris_session.cli.common import CommandError, Commands, add_actions, add_command, parse_seconds, print_result

if TYPE_CHECKING:
    from iris_session.bench.report import BenchReport


class _Benchmark(NamedTuple):
    """One benchmark: `run_NAME` in a module of `iris_session.bench`.

    Attributes:
        text: What it measures, for its help.
        options: Its options, as the parameters of `run_NAME`, and their defaults.
        limits: Lowest and highest values that a scene or a session can have.
    """

    text: str
    options: dict[str, int | float | str]
    limits: dict[str, tuple[int, int]]


_CLIENTS: Final = {"clients": (1, 64)}
_BODIES: Final = {"bodies": (1, 2000)}
_VERTICES: Final = {"vertices": (16, 10_000)}
_BENCHMARKS: Final = {
    "state": _Benchmark(
        "age, size and error of the state that clients receive",
        {"clients": 16, "bodies": 300, "seconds": 20.0, "seed": 0, "curve": False, "profile": ""},
        _CLIENTS | _BODIES,
    ),
    "input": _Benchmark(
        "time from the receipt of a sample to the first frame that shows it applied",
        {"operators": 8, "robots": 8, "observers": 8, "seconds": 20.0, "seed": 0, "curve": False, "profile": ""},
        {"robots": (1, 12), "observers": (0, 64)},
    ),
    "slow-client": _Benchmark(
        "two clients that stall in turn: their recovery, and the effect on the others",
        {"clients": 16, "bodies": 300, "seconds": 50.0, "seed": 0, "curve": False, "profile": ""},
        {"clients": (3, 64), **_BODIES},
    ),
    "alignment": _Benchmark(
        "distance at which two headsets place the same point",
        {"pairs": 2000, "headsets": 200, "worlds": "none", "seed": 0},
        {"pairs": (10, 100_000), "headsets": (2, 100_000)},
    ),
    "deformable": _Benchmark(
        "a cloth in motion, encoded by the session and decoded by clients",
        {"vertices": 10_000, "clients": 4, "seconds": 20.0, "seed": 0, "curve": False, "profile": ""},
        _CLIENTS | _VERTICES,
    ),
    "cloud": _Benchmark(
        "depth pictures become clouds that are sent to a session",
        {"points": 2_000_000, "cameras": 1, "seconds": 20.0, "seed": 0, "beside": False},
        {"points": (10_000, 20_000_000), "cameras": (1, 4)},
    ),
    "cloud-stream": _Benchmark(
        "clouds from a process of their own to clients in others",
        {"clients": 4, "points": 50_000, "hz": 60, "mbit": 0.0, "seconds": 20.0, "seed": 0, "curve": False},
        {"clients": (1, 16), "points": (1000, 1_000_000), "hz": (1, 120), "mbit": (0, 10_000)},
    ),
    "join": _Benchmark(
        "a scene with large assets is prepared, fetched, verified and decoded",
        {"objects": 300, "assets_mb": 200.0, "clients": 4, "seconds": 20.0, "seed": 0},
        {**_CLIENTS, "objects": (1, 2000), "assets_mb": (1, 2000)},
    ),
    "share": _Benchmark("what sharing adds to the steps of an environment", {"seconds": 100.0}, {}),
    "stop": _Benchmark("how far an arm presses on after a hold", {"seconds": 1.0}, {}),
    "hands": _Benchmark("how far faults of tracking move an arm", {"seconds": 300.0, "seed": 0}, {}),
    "csharp": _Benchmark(
        "the C# core of headset apps, on .NET and Mono",
        {"bodies": 300, "points": 10_000, "seconds": 20.0, "seed": 0},
        {**_BODIES, "points": (1000, 1_000_000)},
    ),
    "record": _Benchmark(
        "processor time and size of a recording, and what is left after kills",
        {"seconds": 60.0, "kills": 21, "seed": 0},
        {"kills": (1, 1000)},
    ),
    "export": _Benchmark(
        "a data set is made of a recording with episodes, pictures drawn and encoded",
        {"episodes": 20, "seconds": 20.0, "shadows": False, "jobs": 1, "python": ""},
        {"episodes": (2, 10_000), "jobs": (1, 1024)},
    ),
    # A tab, one that is disturbed and one that is not; a gateway has three quarters of all connections.
    "web": _Benchmark(
        "browsers behind the web gateway, one of them a real tab",
        {"clients": 8, "vertices": 10_000, "seconds": 65.0, "seed": 0, "curve": False, "tab": True},
        {"clients": (3, 48), **_VERTICES},
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
#: What limits a number.
_NOTES: Final = {("input", "operators"): ", one robot each", ("slow-client", "clients"): ", two of which are slow"}


def register(commands: Commands) -> None:
    """Add the command `bench`."""
    names = add_actions(
        commands,
        "bench",
        metavar="NAME",
        help="run a benchmark and compare it with its bars",
        description="Measure with separate client processes. With --check, exit status 1 if a bar is missed. "
        "`iris-session bench NAME --help` has the options of one.",
    )
    for name, one in _BENCHMARKS.items():
        _register_benchmark(names, name, one)


def _register_benchmark(names: Commands, name: str, one: _Benchmark) -> None:
    example = f"iris-session bench {name} --check"
    parser = add_command(names, name, run, help=one.text, description=f"Measure: {one.text}.", examples=example)
    for option, default in one.options.items():
        flag = f"--{option.replace('_', '-')}"
        if option == "tab":
            parser.add_argument("--no-tab", dest="tab", action="store_false", help="no real browser, even if there is")
        elif isinstance(default, bool):
            parser.add_argument(flag, action="store_true", help=_TEXTS[option])
        else:
            kind = parse_seconds if option == "seconds" else type(default)
            text = _TEXTS[option] + (" (default: %(default)s)" if default != "" else "")
            parser.add_argument(flag, type=kind, default=default, help=text)
    parser.add_argument("--check", action="store_true", help="exit status 1 if a bar is missed")


def run(arguments: argparse.Namespace) -> int:
    """Run one benchmark and print its report."""
    from iris_session.bench.report import BenchError, measure_parallel_speed, read_stolen_time
    from iris_session.netsim.profiles import load_profile

    name = arguments.action.replace("-", "_")
    function = getattr(importlib.import_module(f"iris_session.bench.{name}"), f"run_{name}")
    options = _check_options(arguments)
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
    speed = min(speed, measure_parallel_speed())
    report = msgspec.structs.replace(report, stolen_share=share, parallel_speed=speed)
    print_result(arguments, report.as_dict(), report.format().split("\n"))
    return 0 if report.ok or not arguments.check else 1


def _check_options(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the options of the benchmark. Raises `CommandError` for a number that a scene or session cannot have."""
    one = _BENCHMARKS[arguments.action]
    options = {name: getattr(arguments, name) for name in one.options}
    limits = dict(one.limits)
    if "operators" in options:
        limits["operators"] = (1, arguments.robots)
    for name, (low, high) in limits.items():
        if not low <= options[name] <= high:
            note = _NOTES.get((arguments.action, name), "")
            raise CommandError(
                f"--{name.replace('_', '-')} {options[name]}: bench {arguments.action} takes {low} to {high}{note}"
            )
    return options
