"""`iris-session bench NAME`: measures one thing with separate processes and prints it against its bars."""

from __future__ import annotations

import argparse
import sys

from iris_session.cli.common import add_json, positive_seconds, print_json


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "bench",
        help="measure against the bars",
        description="Measures with separate client processes. Exit status 1 with --check when a bar is missed.",
        epilog="examples:\n"
        "  iris-session bench state --check\n"
        "  iris-session bench state --curve --json\n"
        "  iris-session bench input --operators 4 --robots 4 --seconds 10",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("bench", choices=("state", "input"))
    parser.add_argument("--clients", type=int, default=16, help="state: how many (default: %(default)s)")
    parser.add_argument("--bodies", type=int, default=300, help="state: moving bodies (default: %(default)s)")
    parser.add_argument("--operators", type=int, default=8, help="input: people who drive (default: %(default)s)")
    parser.add_argument("--robots", type=int, default=8, help="input: seven-joint arms (default: %(default)s)")
    parser.add_argument("--observers", type=int, default=8, help="input: people who look (default: %(default)s)")
    parser.add_argument("--seconds", type=positive_seconds, default=20.0, help="measured part (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of everything random (default: %(default)s)")
    crypto = parser.add_mutually_exclusive_group()
    crypto.add_argument("--curve", action="store_true", help="encrypted and authenticated")
    crypto.add_argument("--plain", action="store_true", help="unencrypted loopback (default)")
    parser.add_argument("--check", action="store_true", help="exit status 1 when a bar is missed")
    add_json(parser)
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Runs one benchmark and prints its report."""

    def progress(text: str) -> None:
        print(f"bench {arguments.bench}: {text}", file=sys.stderr, flush=True)

    if arguments.bench == "state":
        from iris_session.bench.state import run_state

        report = run_state(
            arguments.clients, arguments.bodies, arguments.seconds, arguments.seed, arguments.curve, progress
        )
    else:
        from iris_session.bench.input import run_input

        report = run_input(
            arguments.operators,
            arguments.robots,
            arguments.observers,
            arguments.seconds,
            arguments.curve,
            progress,
        )
    if arguments.json:
        print_json(report.as_dict())
    else:
        print(report.lines())
    return 0 if report.ok or not arguments.check else 1
