"""`iris-session serve`: shares any MuJoCo scene until Ctrl-C."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from iris_session.cli.common import add_json, add_session_options, print_json

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
        "  iris-session serve handover --seconds 30     (a scene that comes with the package)",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("scene", help="MJCF or MJB file, or the name of a packaged scene")
    parser.add_argument("--robots", type=Path, metavar="TOML", help="robots by name; see `iris-session robots`")
    parser.add_argument("--seconds", type=float, help="stop after this many seconds")
    add_session_options(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def session_config(arguments: argparse.Namespace, name: str) -> SessionConfig:
    """`SessionConfig` from the options of `add_session_options`."""
    import msgspec

    from iris_session.authority import AuthorityConfig
    from iris_session.runtime.config import SessionConfig

    defaults = SessionConfig()
    changes = {"policy": arguments.assignment, "default_mode": arguments.mode}
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


def scene_file(scene: str) -> Path:
    """The file `scene`, or the packaged scene of that name."""
    from iris_session.cli.common import CommandError
    from iris_session.physics.scenes import scene_path

    path = Path(scene)
    if path.exists() or path.suffix:
        return path
    try:
        return scene_path(scene)
    except FileNotFoundError as error:
        raise CommandError(f"{scene}: no such file, and {error}") from None


def run(arguments: argparse.Namespace) -> int:
    """Serves until the end that was asked for; prints where to join and, at the end, what happened."""
    from iris_session.cli.live import LiveView
    from iris_session.physics import load_model, load_robots_toml
    from iris_session.runtime.session import Session

    path = scene_file(arguments.scene)
    model = load_model(path)
    robots = None if arguments.robots is None else load_robots_toml(arguments.robots, model)
    session = Session(model, config=session_config(arguments, path.stem), robots=robots)
    with session.signals(), session:
        out = sys.stderr if arguments.json else sys.stdout
        names = ", ".join(r.name for r in session.robots) or "none"
        print(f"session '{session.config.name}' on {session.address}, robots: {names}", file=out, flush=True)
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
