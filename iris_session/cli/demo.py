"""`iris-session demo NAME`: a whole session on this machine, with emulated people, recorded and verified."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING

from iris_session.cli.common import add_json, add_session_options, positive_seconds, print_json

if TYPE_CHECKING:
    from iris_session.runtime.demo import DemoResult
    from iris_session.runtime.session import Session


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "demo",
        help="two emulated operators hand a hammer over",
        description="Runs a whole session with emulated people in other processes. Exit status 0 only if the object "
        "really changed hands by contact alone and the recording verifies bit for bit.",
        epilog="examples:\n  iris-session demo handover\n  iris-session demo handover --seed 7 --json",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("demo", choices=("handover",))
    parser.add_argument("--seed", type=int, default=0, help="of everything random in the emulated people")
    parser.add_argument(
        "--timeout", type=positive_seconds, default=90.0, metavar="S", help="give up after this many seconds"
    )
    add_session_options(parser)
    add_json(parser)
    parser.set_defaults(run=run, control_port=0, state_port=0)


def run(arguments: argparse.Namespace) -> int:
    """Runs one demo and prints its summary."""
    import msgspec

    from iris_session.cli.live import LiveView
    from iris_session.cli.serve import session_config
    from iris_session.runtime.demo import run_handover

    config = session_config(arguments, arguments.demo)
    out = sys.stderr if arguments.json else sys.stdout

    def show(session: Session) -> AbstractContextManager[Callable[[], None]]:
        return LiveView(session, out, f"demo {arguments.demo} on {session.address}").open()

    result = run_handover(config, arguments.seed, arguments.timeout, show)
    if arguments.json:
        print_json(msgspec.to_builtins(result))
    else:
        print(summary(result))
    return 130 if result.interrupted else 0 if result.ok else 1


def summary(result: DemoResult) -> str:
    """The result as a few lines of text."""
    outcome = "ok" if result.ok else "interrupted" if result.interrupted else "FAILED"
    lines = [f"demo {result.demo}: {outcome} after {result.seconds:.1f} s"]
    lines += [
        f"  handover of {h.object}: {h.giver} -> {h.receiver} at {h.at_s:.1f} s, both held it for {h.duration_s:.2f} s"
        for h in result.handovers
    ]
    lines += [
        f"  alignment of {name}: stated {a['stated_p95']:.1f} mm (95 %), true {a['at_sheet']:.1f} mm at the sheet"
        for name, a in result.alignment_mm.items()
    ]
    lines.append(f"  late ticks {result.late_tick_share * 100:.3f} %, lateness p99 {result.lateness_ms_p99:.2f} ms")
    lines += [f"  state age p99 at {name}: {age:.1f} ms" for name, age in result.state_age_ms_p99.items()]
    lines.append(f"  recording {result.recording}: {result.verification}" if result.recording else "  not recorded")
    lines += [f"  problem: {problem}" for problem in result.problems]
    return "\n".join(lines)
