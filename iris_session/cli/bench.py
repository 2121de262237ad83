"""`iris-session bench NAME`: run one benchmark with separate client processes and compare it with its bars."""

from __future__ import annotations

import argparse
import importlib
import inspect
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import msgspec

from iris_session.cli.common import CommandError, add_command, add_json_option, parse_seconds, print_result

if TYPE_CHECKING:
    from iris_session.bench.report import BenchReport

Limits = dict[str, tuple[int, int]]


class _Benchmark(NamedTuple):
    """One benchmark: `run_NAME` in a module of `iris_session.bench`, whose parameters are the options that it takes.

    Attributes:
        limits: Lowest and highest values that a scene or a session can have.
        refused: Options that it does not take, and why. Other options are ignored.
    """

    limits: Limits
    refused: str = ""
    why: str = ""


_CLIENTS: Final[Limits] = {"clients": (1, 64)}
_BODIES: Final[Limits] = {"bodies": (1, 2000)}
_VERTICES: Final[Limits] = {"vertices": (16, 10_000)}
_BOTH: Final = "curve profile"
_BENCHMARKS: Final = {
    "state": _Benchmark(_CLIENTS | _BODIES),
    "input": _Benchmark({"robots": (1, 12), "observers": (0, 64)}),
    "slow-client": _Benchmark({"clients": (3, 64), **_BODIES}),
    "alignment": _Benchmark({"pairs": (10, 100_000), "headsets": (2, 100_000)}),
    "deformable": _Benchmark(_CLIENTS | _VERTICES),
    "cloud": _Benchmark({"points": (10_000, 20_000_000), "cameras": (1, 4)}, _BOTH, "it has no other clients"),
    "cloud-stream": _Benchmark(
        {"clients": (1, 16), "points": (1000, 1_000_000), "hz": (1, 120), "mbit": (0, 10_000)},
        "profile",
        "--mbit limits its links",
    ),
    "join": _Benchmark(
        {**_CLIENTS, "objects": (1, 2000), "assets_mb": (1, 2000)}, _BOTH, "its bars are for plain loopback"
    ),
    "share": _Benchmark({}, _BOTH, "its bars are for plain loopback"),
    "stop": _Benchmark({}, _BOTH, "it uses no network"),
    "hands": _Benchmark({}, _BOTH, "it uses no network"),
    "csharp": _Benchmark({**_BODIES, "points": (1000, 1_000_000)}, _BOTH, "it uses no network"),
    "record": _Benchmark({"kills": (1, 1000)}, _BOTH, "its bars are for loopback"),
    # A tab, one that is disturbed and one that is not; a gateway has three quarters of all connections.
    "web": _Benchmark({"clients": (3, 48), **_VERTICES}, "profile", "its bars are for loopback"),
}
#: What limits a number.
_NOTES: Final = {("input", "operators"): ", one robot each", ("slow-client", "clients"): ", two of which are slow"}


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command `bench`."""
    parser = add_command(
        commands,
        "bench",
        run,
        help="run a benchmark and compare it with its bars",
        description="Measure with separate client processes. With --check, exit status 1 if a bar is missed.",
        examples="""
            iris-session bench state --check
            iris-session bench state --curve --json
            iris-session bench input --operators 4 --robots 4 --seconds 10
            iris-session bench slow-client --check
            iris-session bench state --profile busy-wifi
            iris-session bench alignment --pairs 2000 --seed 1 --check
            iris-session bench alignment --worlds W1,mixes --headsets 100 --json
            iris-session bench deformable --check
            iris-session bench cloud --check
            iris-session bench cloud --beside --check
            iris-session bench cloud-stream --points 50000 --hz 60 --check
            iris-session bench join --check
            iris-session bench stop --check
            iris-session bench hands --check
            iris-session bench csharp --check
            iris-session bench record --check
            iris-session bench record --seconds 20 --kills 4
            iris-session bench web --clients 8 --curve --check
            iris-session bench web --seconds 300
        """,
    )
    parser.add_argument("bench", choices=tuple(_BENCHMARKS))
    for option, kind, default, text in (
        (
            "clients",
            int,
            None,
            "state, slow-client, deformable, cloud-stream, join, web: number of clients (default: 16; deformable, "
            "cloud-stream, join: 4; web: 8)",
        ),
        ("bodies", int, 300, "state, slow-client, csharp: moving bodies (default: %(default)s)"),
        ("operators", int, 8, "input: operators (default: %(default)s)"),
        ("robots", int, 8, "input: seven-joint arms (default: %(default)s)"),
        ("observers", int, 8, "input: observers (default: %(default)s)"),
        ("pairs", int, 2000, "alignment: pairs of headsets (default: %(default)s)"),
        ("headsets", int, 200, "alignment: headsets in every world (default: %(default)s)"),
        (
            "worlds",
            str,
            "none",
            "alignment: also these worlds, with commas between them: W1 to W12, lab_..., rows, mixes, all "
            "(default: %(default)s)",
        ),
        ("vertices", int, 10_000, "deformable, web: vertices of the cloth, a square number (default: %(default)s)"),
        (
            "points",
            int,
            None,
            "cloud: pixels of a cloud, shared by its cameras (default: 2000000); cloud-stream, csharp: points of a "
            "cloud (default: 50000; csharp: 10000)",
        ),
        ("cameras", int, 1, "cloud: number of cameras (default: %(default)s)"),
        ("hz", int, 60, "cloud-stream: clouds per second (default: %(default)s)"),
        (
            "mbit",
            float,
            0.0,
            "cloud-stream: bandwidth of every client's link from the middle of the measured part on [Mbit/s]",
        ),
        ("objects", int, 300, "join: bodies with meshes (default: %(default)s)"),
        ("assets-mb", float, 200.0, "join: size of the assets after compression (default: 200)"),
        (
            "seconds",
            parse_seconds,
            None,
            "measured part (default: 20; slow-client: 50; record: 60; web: 65; share: 100; stop: 1; "
            "hands: 300, simulated, of every device and rate)",
        ),
        ("kills", int, 21, "record: kills of recorder, authority and both (default: %(default)s)"),
        ("seed", int, 0, "random seed (default: %(default)s)"),
    ):
        parser.add_argument(f"--{option}", type=kind, default=default, help=text)
    parser.add_argument(
        "--beside", action="store_true", help="cloud: beside a session in which two arms are driven, 500 ticks a second"
    )
    parser.add_argument(
        "--no-tab", dest="tab", action="store_false", help="web: no real browser, even where one is installed"
    )
    parser.add_argument(
        "--profile",
        default="",
        metavar="NAME",
        help="link profile of every client (docs/evidence/links.md); bars do not apply then",
    )
    crypto = parser.add_mutually_exclusive_group()
    crypto.add_argument("--curve", action="store_true", help="encrypted and authenticated")
    crypto.add_argument("--plain", action="store_true", help="unencrypted loopback (default)")
    parser.add_argument("--check", action="store_true", help="exit status 1 if a bar is missed")
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run one benchmark and print its report."""
    from iris_session.bench.report import BenchError, measure_parallel_speed, read_stolen_time
    from iris_session.netsim.profiles import load_profile

    name = arguments.bench.replace("-", "_")
    function = getattr(importlib.import_module(f"iris_session.bench.{name}"), f"run_{name}")
    options = _select_options(arguments, inspect.signature(function).parameters)
    if arguments.profile:
        load_profile(arguments.profile)  # fails before anything is started

    def progress(text: str) -> None:
        print(f"bench {arguments.bench}: {text}", file=sys.stderr, flush=True)

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


def _select_options(arguments: argparse.Namespace, names: Iterable[str]) -> dict[str, Any]:
    """Return the options of the benchmark, of these names, that are given or have a default.

    Raises:
        CommandError: The benchmark does not take one of the others, or a scene or session cannot have a number.
    """
    one = _BENCHMARKS[arguments.bench]
    if any(getattr(arguments, name) for name in one.refused.split()):
        refused = " or ".join(f"--{name}" for name in one.refused.split())
        raise CommandError(f"bench {arguments.bench} cannot be combined with {refused}: {one.why}")
    options = {name: value for name in names if (value := getattr(arguments, name, None)) is not None}
    limits = dict(one.limits)
    if "operators" in options:
        limits["operators"] = (1, arguments.robots)
    for name, (low, high) in limits.items():
        if not low <= options.get(name, low) <= high:
            note = _NOTES.get((arguments.bench, name), "")
            raise CommandError(
                f"--{name.replace('_', '-')} {options[name]}: bench {arguments.bench} takes {low} to {high}{note}"
            )
    return options
