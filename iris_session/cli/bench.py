"""`iris-session bench NAME`: run one benchmark with separate client processes and compare it with its bars."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from iris_session.cli.common import CommandError, add_json_option, parse_seconds, print_json

if TYPE_CHECKING:
    from iris_session.bench.report import BenchReport


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command `bench`."""
    parser = commands.add_parser(
        "bench",
        help="run a benchmark and compare it with its bars",
        description="Measure with separate client processes. With --check, exit status 1 if a bar is missed.",
        epilog="examples:\n"
        "  iris-session bench state --check\n"
        "  iris-session bench state --curve --json\n"
        "  iris-session bench input --operators 4 --robots 4 --seconds 10\n"
        "  iris-session bench slow-client --check\n"
        "  iris-session bench state --profile busy-wifi\n"
        "  iris-session bench alignment --pairs 2000 --seed 1 --check\n"
        "  iris-session bench deformable --check\n"
        "  iris-session bench cloud --check\n"
        "  iris-session bench cloud --beside --check\n"
        "  iris-session bench cloud-stream --points 50000 --hz 60 --check\n"
        "  iris-session bench join --check\n"
        "  iris-session bench stop --check\n"
        "  iris-session bench record --check\n"
        "  iris-session bench record --seconds 20 --kills 4\n"
        "  iris-session bench web --clients 8 --curve --check\n"
        "  iris-session bench web --seconds 300",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "bench",
        choices=(
            "state",
            "input",
            "slow-client",
            "alignment",
            "deformable",
            "cloud",
            "cloud-stream",
            "join",
            "stop",
            "record",
            "web",
        ),
    )
    parser.add_argument(
        "--clients",
        type=int,
        help="state, slow-client, deformable, cloud-stream, join, web: number of clients (default: 16; deformable, "
        "cloud-stream, join: 4; web: 8)",
    )
    parser.add_argument(
        "--bodies", type=int, default=300, help="state, slow-client: moving bodies (default: %(default)s)"
    )
    parser.add_argument("--operators", type=int, default=8, help="input: operators (default: %(default)s)")
    parser.add_argument("--robots", type=int, default=8, help="input: seven-joint arms (default: %(default)s)")
    parser.add_argument("--observers", type=int, default=8, help="input: observers (default: %(default)s)")
    parser.add_argument("--pairs", type=int, default=2000, help="alignment: pairs of headsets (default: %(default)s)")
    parser.add_argument(
        "--vertices",
        type=int,
        default=10_000,
        help="deformable, web: vertices of the cloth, a square number (default: %(default)s)",
    )
    parser.add_argument(
        "--points",
        type=int,
        help="cloud: pixels of a cloud, shared by its cameras (default: 2000000); cloud-stream: points of a cloud "
        "(default: 50000)",
    )
    parser.add_argument("--cameras", type=int, default=1, help="cloud: number of cameras (default: %(default)s)")
    parser.add_argument(
        "--beside", action="store_true", help="cloud: beside a session in which two arms are driven, 500 ticks a second"
    )
    parser.add_argument("--hz", type=int, default=60, help="cloud-stream: clouds per second (default: %(default)s)")
    parser.add_argument(
        "--mbit",
        type=float,
        default=0.0,
        help="cloud-stream: bandwidth of every client's link from the middle of the measured part on [Mbit/s]",
    )
    parser.add_argument("--objects", type=int, default=300, help="join: bodies with meshes (default: %(default)s)")
    parser.add_argument(
        "--assets-mb", type=float, default=200.0, help="join: size of the assets after compression (default: 200)"
    )
    parser.add_argument("--no-tab", action="store_true", help="web: no real browser, even where one is installed")
    parser.add_argument(
        "--seconds",
        type=parse_seconds,
        help="measured part (default: 20; slow-client: 50; record: 60; web: 65; stop: 1)",
    )
    parser.add_argument(
        "--kills", type=int, default=21, help="record: kills of recorder, authority and both (default: %(default)s)"
    )
    parser.add_argument(
        "--profile",
        default="",
        metavar="NAME",
        help="link profile of every client (docs/evidence/links.md); bars do not apply then",
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed (default: %(default)s)")
    crypto = parser.add_mutually_exclusive_group()
    crypto.add_argument("--curve", action="store_true", help="encrypted and authenticated")
    crypto.add_argument("--plain", action="store_true", help="unencrypted loopback (default)")
    parser.add_argument("--check", action="store_true", help="exit status 1 if a bar is missed")
    add_json_option(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Run one benchmark and print its report."""

    from iris_session.netsim.profiles import load_profile

    def progress(text: str) -> None:
        print(f"bench {arguments.bench}: {text}", file=sys.stderr, flush=True)

    from iris_session.bench.report import BenchError, measure_parallel_speed, read_stolen_time

    if arguments.clients is None:
        arguments.clients = {"deformable": 4, "cloud-stream": 4, "join": 4, "web": 8}.get(arguments.bench, 16)
    if arguments.points is None:
        arguments.points = 2_000_000 if arguments.bench == "cloud" else 50_000
    _check_sizes(arguments)
    if arguments.bench == "slow-client" and arguments.clients < 3:
        raise CommandError(f"--clients {arguments.clients}: bench slow-client needs 3 or more, two of which are slow")
    if arguments.profile:
        load_profile(arguments.profile)  # fails before anything is started
    speed = measure_parallel_speed()
    stolen_s, all_s = read_stolen_time()
    try:
        report = _run_benchmark(arguments, progress)
    except BenchError as error:
        raise CommandError(str(error), 1) from error
    stolen_after_s, all_after_s = read_stolen_time()
    share = (stolen_after_s - stolen_s) / max(all_after_s - all_s, 1e-9)
    speed = min(speed, measure_parallel_speed())
    report = msgspec.structs.replace(report, stolen_share=share, parallel_speed=speed)
    if arguments.json:
        print_json(report.as_dict())
    else:
        print(report.format())
    return 0 if report.ok or not arguments.check else 1


def _check_sizes(arguments: argparse.Namespace) -> None:
    """Raise `CommandError` for numbers that a scene or a session cannot have."""
    limits = {"clients": (1, 64), "bodies": (1, 2000)}
    if arguments.bench == "input":
        limits = {"robots": (1, 12), "operators": (1, arguments.robots), "observers": (0, 64)}
    elif arguments.bench == "alignment":
        limits = {"pairs": (10, 100_000)}
    elif arguments.bench == "deformable":
        limits = {"clients": (1, 64), "vertices": (16, 10_000)}
    elif arguments.bench == "cloud":
        limits = {"points": (10_000, 20_000_000), "cameras": (1, 4)}
        if arguments.curve or arguments.profile:
            raise CommandError("bench cloud cannot be combined with --curve or --profile: it has no other clients")
    elif arguments.bench == "cloud-stream":
        limits = {"clients": (1, 16), "points": (1000, 1_000_000), "hz": (1, 120), "mbit": (0, 10_000)}
        if arguments.profile:
            raise CommandError("bench cloud-stream cannot be combined with --profile: --mbit limits its links")
    elif arguments.bench == "stop":
        limits = {}
        if arguments.curve or arguments.profile:
            raise CommandError("bench stop cannot be combined with --curve or --profile: it uses no network")
    elif arguments.bench == "record":
        limits = {"kills": (1, 1000)}
        if arguments.curve or arguments.profile:
            raise CommandError("bench record cannot be combined with --curve or --profile: its bars are for loopback")
    elif arguments.bench == "web":
        # A tab, one that is disturbed and one that is not; a gateway has three quarters of all connections.
        limits = {"clients": (3, 48), "vertices": (16, 10_000)}
        if arguments.profile:
            raise CommandError("bench web cannot be combined with --profile: its bars are for loopback")
    elif arguments.bench == "join":
        limits = {"clients": (1, 64), "objects": (1, 2000), "assets_mb": (1, 2000)}
        if arguments.curve or arguments.profile:
            raise CommandError(
                "bench join cannot be combined with --curve or --profile: its bars are for plain loopback"
            )
    for name, (low, high) in limits.items():
        if not low <= (value := getattr(arguments, name)) <= high:
            per = ", one robot each" if name == "operators" else ""
            raise CommandError(
                f"--{name.replace('_', '-')} {value}: bench {arguments.bench} takes {low} to {high}{per}"
            )


def _run_benchmark(arguments: argparse.Namespace, progress: Callable[[str], None]) -> BenchReport:
    if arguments.bench == "alignment":
        from iris_session.bench.alignment import run_alignment

        return run_alignment(arguments.pairs, arguments.seed, progress)
    if arguments.bench == "stop":
        from iris_session.bench.stop import run_stop

        return run_stop(min(arguments.seconds or 1.0, 60.0), progress)
    if arguments.bench == "record":
        from iris_session.bench.record import run_record

        return run_record(arguments.seconds or 60.0, arguments.kills, arguments.seed, progress)
    if arguments.bench == "join":
        from iris_session.bench.join import run_join

        sizes = (arguments.objects, arguments.assets_mb, arguments.clients)
        return run_join(*sizes, arguments.seconds or 20.0, arguments.seed, progress)
    if arguments.bench == "web":
        from iris_session.bench.web import run_web

        sizes = (arguments.clients, arguments.vertices, arguments.seconds or 65.0)
        return run_web(*sizes, arguments.seed, arguments.curve, not arguments.no_tab, progress)
    if arguments.bench == "cloud":
        from iris_session.bench.cloud import run_cloud

        sizes = (arguments.points, arguments.cameras, arguments.seconds or 20.0)
        return run_cloud(*sizes, arguments.seed, arguments.beside, progress)
    if arguments.bench == "cloud-stream":
        from iris_session.bench.cloud_stream import run_cloud_stream

        counts = (arguments.points, arguments.hz, arguments.clients)
        return run_cloud_stream(
            *counts, arguments.seconds or 20.0, arguments.mbit, arguments.seed, arguments.curve, progress
        )
    common = {"curve": arguments.curve, "profile": arguments.profile, "seed": arguments.seed, "progress": progress}
    if arguments.bench == "state":
        from iris_session.bench.state import run_state

        return run_state(arguments.clients, arguments.bodies, arguments.seconds or 20.0, **common)
    if arguments.bench == "slow-client":
        from iris_session.bench.slow_client import run_slow_client

        return run_slow_client(arguments.clients, arguments.bodies, arguments.seconds or 50.0, **common)
    if arguments.bench == "deformable":
        from iris_session.bench.deformable import run_deformable

        return run_deformable(arguments.vertices, arguments.clients, arguments.seconds or 20.0, **common)
    from iris_session.bench.input import run_input

    people = (arguments.operators, arguments.robots, arguments.observers)
    return run_input(*people, arguments.seconds or 20.0, **common)
