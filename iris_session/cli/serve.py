"""`iris-session serve`: shares any MuJoCo scene until Ctrl-C."""

from __future__ import annotations

import argparse
import re
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from iris_session.cli.common import (
    CommandError,
    add_json,
    add_session_options,
    no_robots,
    positive_seconds,
    print_json,
    scene_file,
)
from iris_session.protocol.names import AssignmentPolicy

if TYPE_CHECKING:
    from iris_session.runtime.config import SessionConfig


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "serve",
        help="share a MuJoCo scene",
        description="Shares a MuJoCo scene in real time until Ctrl-C. Robots are found in the model, or named.",
        epilog="examples:\n"
        "  iris-session serve scene.xml\n"
        "  iris-session serve scene.xml --robots robots.toml --assignment nearest --mode request\n"
        "  iris-session serve handover --assign ann=left --assign bob=right\n"
        "  iris-session serve handover --seconds 30     (a scene that comes with the package)",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", help="MJCF or MJB file, or the name of a packaged scene")
    parser.add_argument("--robots", type=Path, metavar="TOML", help="robots by name; see `iris-session robots`")
    parser.add_argument(
        "--assign",
        action="append",
        default=[],
        metavar="NAME=ROBOT[,ROBOT]",
        help="robots of a participant, repeatable; implies --assignment config",
    )
    parser.add_argument("--seconds", type=positive_seconds, help="stop after this many seconds")
    add_session_options(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def session_config(arguments: argparse.Namespace, name: str) -> SessionConfig:
    """`SessionConfig` from the options of `add_session_options`."""
    import msgspec

    from iris_session.authority import AuthorityConfig
    from iris_session.runtime.config import SessionConfig

    defaults = SessionConfig()
    assigned = assignments(getattr(arguments, "assign", []))
    policy = arguments.assignment or (AssignmentPolicy.CONFIG if assigned else None)
    if assigned and policy != AssignmentPolicy.CONFIG:
        raise CommandError(f"--assign goes with --assignment {AssignmentPolicy.CONFIG}, not with {policy}")
    changes = {"policy": policy, "default_mode": arguments.mode, "assignments": assigned or None}
    authority = msgspec.structs.replace(AuthorityConfig(), **{k: v for k, v in changes.items() if v is not None})
    return SessionConfig(
        name=arguments.name or name,
        host=arguments.host,
        control_port=defaults.control_port if arguments.control_port is None else arguments.control_port,
        state_port=defaults.state_port if arguments.state_port is None else arguments.state_port,
        record=False if arguments.no_record else arguments.record or True,
        curve_key=arguments.curve_key,
        curve_clients=arguments.curve_clients,
        authority=authority,
    )


def assignments(given: list[str]) -> dict[str, tuple[str, ...]]:
    """Participant name -> robots, from `NAME=ROBOT[,ROBOT]`; a name given twice has the robots of both."""
    found: dict[str, tuple[str, ...]] = {}
    for text in given:
        name, _, robots = text.partition("=")
        names = tuple(robot.strip() for robot in robots.split(","))
        if not name or not all(names):
            raise CommandError(f"--assign {text}: must be NAME=ROBOT[,ROBOT], for example ann=left")
        found[name] = tuple(dict.fromkeys((*found.get(name, ()), *names)))
    return found


def session_name(path: Path) -> str:
    """Default name of a session: that of its scene, with what a name cannot hold replaced."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem).strip("._-")[:48] or "session"


def run(arguments: argparse.Namespace) -> int:
    """Serves until the end that was asked for; prints where to join and, at the end, what happened."""
    from iris_session.cli.live import LiveView
    from iris_session.physics import load_model, load_robots_toml
    from iris_session.runtime.session import Session

    path = scene_file(arguments.scene)
    model = load_model(path)
    robots = None if arguments.robots is None else load_robots_toml(arguments.robots, model)
    session = Session(model, config=session_config(arguments, session_name(path)), robots=robots)
    with session.signals(), session:
        out = sys.stderr if arguments.json else sys.stdout
        names = ", ".join(r.name for r in session.robots) or "none"
        print(f"session '{session.config.name}' on {session.address}, robots: {names}", file=out, flush=True)
        if not session.robots:
            tip = f"see `iris-session robots {arguments.scene}`, or name them with --robots FILE"
            print(f"{no_robots(model)}; {tip}", file=out, flush=True)
        if session.recording is not None:
            print(f"recording to {session.recording}", file=out, flush=True)
        view = LiveView(session, out, f"iris-session {session.config.name} on {session.address}")
        with view.open():
            session.run(seconds=arguments.seconds, until=view.update)
        status = session.status()
        recording = None if session.recording is None else str(session.recording)
    if arguments.json:
        print_json({"ok": True, "recording": recording, **status.as_dict()})
    elif recording:
        print(f"recording: {recording}    check it: iris-session verify {recording}")
    return 0
