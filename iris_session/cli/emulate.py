"""`iris-session emulate`: emulated headsets join a session as real network clients."""

from __future__ import annotations

import argparse
import os

from iris_session.cli.common import (
    CommandError,
    Commands,
    add_address_options,
    add_command,
    check_session_reachable,
    parse_seconds,
    print_error,
)


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "emulate",
        run,
        has_json=False,
        help="join with emulated headsets",
        description="Emulated operators join a session: each has its own tracking frame, observes the sheet until it "
        "is aligned, acquires a robot and works. Ends when every operator with a task is done, or after --seconds.",
        examples="""
            iris-session emulate                                   one operator who moves a robot
            iris-session emulate --behaviour observer --count 3    three observers
            iris-session emulate 192.168.0.10 --code 7KQ2-M4XD-9PTR     the first time at a session in the lab
            iris-session emulate --session lab-1                   later, by its name
            iris-session emulate --headset name=ann,behaviour=giver,robot=left --headset name=bob,behaviour=receiver,robot=right
            iris-session emulate --drift 30 --bump-at 20 --glance-every 5   a headset that drifts and is bumped
        """,  # noqa: E501
    )
    add_address_options(parser, code="join code of `iris-session pair`, needed the first time")
    parser.add_argument("--behaviour", default="wander", help="giver, receiver, wander, idle or observer")
    parser.add_argument("--robot", default="", help="robot to acquire (default: the session assigns one)")
    parser.add_argument("--count", type=int, default=1, help="number of headsets with --behaviour")
    parser.add_argument("--seed", type=int, default=0, help="random seed of frames, noise and motion")
    parser.add_argument("--drift", type=float, metavar="MM", help="drift of the tracking frames, mm per minute (1)")
    text = "after this many seconds the tracking frames jump by 50 mm, unnoticed by the headsets; repeatable"
    parser.add_argument("--bump-at", type=float, action="append", default=[], metavar="S", help=text)
    text = "observe the sheet again every S seconds while working"
    parser.add_argument("--glance-every", type=float, default=0.0, metavar="S", help=text)
    parser.add_argument("--headset", action="append", default=[], metavar="KEY=VALUE,...", help="one headset in detail")
    parser.add_argument("--seconds", type=parse_seconds, help="stop after this many seconds")
    text = "stop if no session admits us within this time (%(default)s)"
    parser.add_argument("--join-timeout", type=float, default=15.0, metavar="S", help=text)
    parser.add_argument("--curve-server", default="", metavar="FILE", help="the session's public CURVE key (*.key)")
    parser.add_argument("--curve-key", default="", metavar="FILE", help="CURVE secret key of the client (*.key_secret)")
    parser.add_argument("--orders", action="store_true", help="read lines: bump, recentre, drift or steady NAME")
    parser.add_argument("--json", action="store_true", help="one JSON object per line")
    parser.set_defaults(specs="")


def run(arguments: argparse.Namespace) -> int:
    """Run the emulated headsets in this process. Exit status 0 if none failed."""
    from iris_session.emulator.__main__ import run as run_headsets

    if arguments.headset and (arguments.drift is not None or arguments.bump_at or arguments.glance_every):
        raise CommandError(
            "--drift, --bump-at and --glance-every cannot be combined with --headset; use its fields, for example "
            "--headset name=ann,model.drift_m_per_min=0.03,bump_at_s=20,glance_every_s=5"
        )
    common = f",glance_every_s={arguments.glance_every}"  # fields of all headsets of `--count`
    if arguments.bump_at:
        common += ",bump_at_s=" + "/".join(map(str, arguments.bump_at))
    if arguments.drift is not None:
        common += f",model.drift_m_per_min={arguments.drift / 1000.0}"
    arguments.headset = arguments.headset or [
        f"name={arguments.behaviour}{i + 1}-{os.getpid()},behaviour={arguments.behaviour},robot={arguments.robot},"
        f"seed={arguments.seed + i}{common}"
        for i in range(arguments.count)
    ]
    status = run_headsets(arguments, "iris-session")
    if status == 1:
        try:  # only now, for a better message: the session may have started meanwhile
            check_session_reachable(arguments)
        except CommandError as error:
            print_error(str(error))
    return status
