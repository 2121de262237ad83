"""`iris-session emulate`: emulated people with headsets join a session, as real network clients."""

from __future__ import annotations

import argparse
import os
import sys

from iris_session.cli.common import CommandError, add_address_options, check_session_reachable, parse_seconds


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "emulate",
        help="join with emulated headsets",
        description="Emulated people join a session: each has a tracking frame of its own, looks at the sheet until "
        "aligned, takes a robot and works. Ends when everyone with a task is done, or after --seconds.",
        epilog="examples:\n"
        "  iris-session emulate                                   one person who moves a robot about\n"
        "  iris-session emulate --behaviour observer --count 3    three people who only look\n"
        "  iris-session emulate 192.168.0.10 --code 7KQ2-M4XD-9PTR     the first time at a session in the lab\n"
        "  iris-session emulate --session lab-1                   later, by its name\n"
        "  iris-session emulate --headset name=ann,behaviour=giver,robot=left "
        "--headset name=bob,behaviour=receiver,robot=right\n"
        "  iris-session emulate --drift 30 --bump-at 20 --glance-every 5   a headset that loses its place",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_address_options(parser, code="join code of `iris-session pair`, the first time")
    parser.add_argument("--behaviour", default="wander", help="giver, receiver, wander, idle or observer")
    parser.add_argument("--robot", default="", help="robot to take (default: the policy of the session chooses)")
    parser.add_argument("--count", type=int, default=1, help="how many people with --behaviour")
    parser.add_argument("--seed", type=int, default=0, help="of everything random: frames, noise, motion")
    parser.add_argument("--drift", type=float, metavar="MM", help="drift of their tracking frames, mm per minute (1)")
    parser.add_argument(
        "--bump-at", type=float, action="append", default=[], metavar="S",
        help="after so many seconds their tracking frames jump by 50 mm, and the headsets do not notice",
    )  # fmt: skip
    parser.add_argument(
        "--glance-every", type=float, default=0.0, metavar="S", help="while working they go and look at the sheet"
    )
    parser.add_argument("--headset", action="append", default=[], metavar="KEY=VALUE,...", help="one person in detail")
    parser.add_argument("--seconds", type=parse_seconds, help="at most this long")
    parser.add_argument(
        "--join-timeout", type=float, default=15.0, metavar="S", help="give up when no session lets us in (%(default)s)"
    )
    parser.add_argument("--curve-server", default="", metavar="FILE", help="the session's public CURVE key (*.key)")
    parser.add_argument("--curve-key", default="", metavar="FILE", help="our own CURVE secret key (*.key_secret)")
    parser.add_argument(
        "--orders", action="store_true", help="lines on standard input: bump, recentre, drift or steady NAME"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Runs the people in this process; exit status 0 when nobody failed."""
    from iris_session.emulator.__main__ import main

    if arguments.headset and (arguments.drift is not None or arguments.bump_at or arguments.glance_every):
        raise CommandError(
            "--drift, --bump-at and --glance-every are for people without --headset; with it write, for example, "
            "--headset name=ann,model.drift_m_per_min=0.03,bump_at_s=20,glance_every_s=5"
        )
    headsets = arguments.headset or [
        f"name={arguments.behaviour}{i + 1}-{os.getpid()},behaviour={arguments.behaviour},robot={arguments.robot},"
        f"seed={arguments.seed + i}{_headset_options(arguments)}"
        for i in range(arguments.count)
    ]
    options = ["--address", arguments.address, "--session", arguments.session, "--code", arguments.code]
    options += ["--join-timeout", str(arguments.join_timeout)]
    options += ["--curve-server", arguments.curve_server, "--curve-key", arguments.curve_key]
    for headset in headsets:
        options += ["--headset", headset]
    if arguments.seconds is not None:
        options += ["--seconds", str(arguments.seconds)]
    options += [flag for flag, given in (("--json", arguments.json), ("--orders", arguments.orders)) if given]
    status = main(options, "iris-session")
    if status == 1:
        try:
            check_session_reachable(arguments)  # it may have begun while they waited: asked only now, to say more
        except CommandError as error:
            print(f"iris-session: {error}", file=sys.stderr)
    return status


def _headset_options(arguments: argparse.Namespace) -> str:
    """What all headsets of `--count` have in common, as fields of `--headset`."""
    text = f",glance_every_s={arguments.glance_every}"
    if arguments.bump_at:
        text += ",bump_at_s=" + "/".join(map(str, arguments.bump_at))
    if arguments.drift is not None:
        text += f",model.drift_m_per_min={arguments.drift / 1000.0}"
    return text
