"""Entry point of the command `iris-session`: parse, dispatch, and turn expected errors into one line."""

from __future__ import annotations

import logging
import os
import signal
import sys
from importlib.metadata import version

from iris_session.cli import (
    INTERRUPTED,
    anchors,
    bench,
    cloud,
    control,
    demo,
    doctor,
    emulate,
    keys,
    pair,
    policy,
    recording,
    recording_export,
    scene,
    serve,
    status,
    view,
    web,
)
from iris_session.cli.common import CommandError, CommandParser, describe_error, print_error
from iris_session.protocol.errors import IrisError
from iris_session.system.extras import describe_import_error
from iris_session.system.log import LEVEL_VARIABLE, configure_logging

#: In the order of `--help`.
_MODULES = (
    demo, serve, pair, web, keys, status, control, doctor, view, recording, recording_export, emulate, policy, scene,
    anchors, cloud, bench,
)  # fmt: skip


#: Of the whole command line.
_EXAMPLES = """\
iris-session demo handover                 two emulated operators hand over a hammer
iris-session serve scene.xml               share a MuJoCo scene on this machine
iris-session pair                          a join code and a QR code for one new device
iris-session pair --web                    a link and a QR code for one browser
iris-session web 192.168.0.10              a page here for a session on another machine
iris-session keys list                     the keys that may join
iris-session sessions                      the sessions on this network
iris-session robots scene.xml              the robots found in a model, as TOML to edit
iris-session scene inspect scene.xml       what clients receive of a scene, and what is heavy
iris-session anchors print --size 150mm    a sheet for headsets and cameras, as PDF
iris-session cloud example                 a file for depth cameras; inspect it, or run it in a session
iris-session emulate --behaviour wander    one emulated headset joins the session on this machine
iris-session policy --repo PATH --robot left    a trained policy of LeRobot drives a robot, beside people
iris-session status --watch                participants, robots, ages, late ticks, recorder of a session
iris-session estop                         stop every robot of the session; clear-estop, pause, assign, ... as well
iris-session doctor 192.168.1.20           what is wrong, why, and what to do
iris-session view                          the newest recording in Rerun's viewer
iris-session verify sessions/*/session.rrd re-simulate a recording and compare it bit for bit
iris-session recording inspect sessions    what recordings hold: who, what, how long, damage
iris-session export sessions --to lerobot --out set    a data set for training, of all successful episodes
iris-session recording export session.rrd --to csv -o tables
iris-session recording render session.rrd -o session.mp4
iris-session bench state --check           measure the state stream and compare it with its bars"""


def build_parser() -> CommandParser:
    """Return the parser of the whole command line."""
    parser = CommandParser(
        prog="iris-session",
        description="Share one robot scene between several people in XR headsets.",
    )
    parser.examples = _EXAMPLES.split("\n")
    parser.add_argument("--version", action="version", version=f"iris-session {version('iris-session')}")
    commands = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    for module in _MODULES:
        module.register(commands)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run one command. Return the exit status."""
    try:
        return _run_command(argv)
    except KeyboardInterrupt:
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second Ctrl-C must not interrupt the interpreter's shutdown
        return INTERRUPTED


def _run_command(argv: list[str] | None) -> int:
    session_log = logging.getLogger("iris_session.session")
    try:
        configure_logging()
        arguments = build_parser().parse_args(argv)
        os.environ.setdefault("MUJOCO_GL", "disable")  # MuJoCo need not load OpenGL: what draws loads it by itself
        if LEVEL_VARIABLE not in os.environ:
            # `serve` and `demo` show restarts, gaps and overruns as events. The log would repeat them, from the thread
            # that takes steps, which must not wait for a terminal.
            session_log.setLevel(logging.ERROR)
        status: int = arguments.run(arguments)
        sys.stdout.flush()  # a closed pipe is noticed here, not when the interpreter ends
    except BrokenPipeError:  # the reader of the pipe has closed it (`| head`)
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left has nowhere to go
        return 1
    except ImportError as error:
        text = describe_import_error(error)
        if not text:
            raise
        print_error(text)
        return 2
    except IrisError as error:
        in_use = str(error).startswith("port ") and "is in use" in str(error)
        # The library does not name options that help: a script has none.
        hint = " (here: --port-base 7730, or --control-port 0 --state-port 0)" if in_use else ""
        for line in f"{describe_error(error)}{hint}".split("\n"):
            print_error(line)
        return error.status if isinstance(error, CommandError) else 2
    finally:
        session_log.setLevel(logging.NOTSET)
    return status


if __name__ == "__main__":
    sys.exit(main())
