"""`iris-session emulate`: emulated people with headsets join a session, as real network clients."""

from __future__ import annotations

import argparse

from iris_session.cli.common import positive_seconds


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
        "--headset name=bob,behaviour=receiver,robot=right",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "address", nargs="?", default="", help="HOST:PORT, or the iris:// URI of a pairing code (default: this machine)"
    )
    parser.add_argument("--session", default="", metavar="NAME", help="find the session of that name on the network")
    parser.add_argument("--code", default="", metavar="CODE", help="join code of `iris-session pair`, the first time")
    parser.add_argument("--behaviour", default="wander", help="giver, receiver, wander, idle or observer")
    parser.add_argument("--robot", default="", help="robot to take (default: the policy of the session chooses)")
    parser.add_argument("--count", type=int, default=1, help="how many people with --behaviour")
    parser.add_argument("--seed", type=int, default=0, help="of everything random: frames, noise, motion")
    parser.add_argument("--headset", action="append", default=[], metavar="KEY=VALUE,...", help="one person in detail")
    parser.add_argument("--seconds", type=positive_seconds, help="at most this long")
    parser.add_argument(
        "--join-timeout", type=float, default=15.0, metavar="S", help="give up when no session lets us in (%(default)s)"
    )
    parser.add_argument("--curve-server", default="", metavar="FILE", help="the session's public CURVE key (*.key)")
    parser.add_argument("--curve-key", default="", metavar="FILE", help="our own CURVE secret key (*.key_secret)")
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Runs the people in this process; exit status 0 when nobody failed."""
    from iris_session.emulator.__main__ import main

    headsets = arguments.headset or [
        f"name={arguments.behaviour}{i + 1},behaviour={arguments.behaviour},robot={arguments.robot},"
        f"seed={arguments.seed + i}"
        for i in range(arguments.count)
    ]
    options = ["--address", arguments.address, "--session", arguments.session, "--code", arguments.code]
    options += ["--join-timeout", str(arguments.join_timeout)]
    options += ["--curve-server", arguments.curve_server, "--curve-key", arguments.curve_key]
    for headset in headsets:
        options += ["--headset", headset]
    if arguments.seconds is not None:
        options += ["--seconds", str(arguments.seconds)]
    return main(options + (["--json"] if arguments.json else []), "iris-session")
