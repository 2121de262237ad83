"""`iris-session serve`: share a MuJoCo scene, or show a file with geometry, until Ctrl-C."""

from __future__ import annotations

import argparse
import dataclasses
import re
import sys
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TextIO

from iris_session.cli.common import (
    CommandError,
    Commands,
    add_command,
    add_session_options,
    format_scene_names,
    open_scene,
    parse_seconds,
    print_error,
    print_json,
    refuse_options,
)
from iris_session.cli.scene import add_file_options, check_file_options, find_scene_file, make_builder
from iris_session.cli.view import live_viewer
from iris_session.protocol.names import AssignmentPolicy

#: How the robot of a URDF is driven: it has joints, and nothing that moves them.
URDF_ADVICE: Final = (
    "to drive it: mujoco.MjSpec.from_file, spec.add_actuator for each joint, spec.to_xml, and serve that .xml "
    "(docs/robots.md)"
)
#: Options about who drives what.
_DRIVES: Final = ("robots", "assign", "unaligned", "assignment", "mode")
#: What `bench record` and `demo handover` cost.
RECORDING_COST: Final = "some 20 MB an hour at rest, 0.7 GB and more with two operators; `iris-session status`: now"

if TYPE_CHECKING:
    from iris_session.session.config import SessionConfig
    from iris_session.session.scene_publisher import ScenePublisher
    from iris_session.session.session import Session


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "serve",
        run,
        help="share a MuJoCo scene, or show a file",
        description="Share a MuJoCo scene in real time until Ctrl-C. Robots are found in the model, or given by name. "
        "Other files (GLB, STL, OBJ, ...) are shown as they are, a URDF in its zero configuration.",
        examples="""
            iris-session serve scene.xml
            iris-session serve scene.xml --robots robots.toml --assignment nearest --mode request
            iris-session serve scene.xml --anchors anchors.toml
            iris-session serve scene.xml --camera room.toml    (a point cloud; see `iris-session cloud example`)
            iris-session serve handover --task pour.toml    (episodes of a task)
            iris-session serve handover --picture operator --picture side:640x480@15    (for policies)
            iris-session serve handover --assign ann=left --assign bob=right
            iris-session serve aloha --seconds 30
            iris-session serve handover --interface wlan0 --name lab-1
            iris-session serve handover --port-base 7730    (a second session on this machine)
            iris-session serve part.glb    (shown; nothing moves)
            iris-session serve part.stl --scale 0.001    (a part in millimetres)
            iris-session serve --resume sessions/20261121T093000.000000Z-handover    (continue where it ended)
        """,
        notes=format_scene_names(),
    )
    parser.add_argument("scene", nargs="?", help="MJCF or MJB file, a file to show, or the name of a scene, see below")
    text = (
        "a robots file (.toml; see `iris-session robots`), names of robots found, separated by commas, `none`, or "
        "`auto` (default)"
    )
    parser.add_argument("--robots", metavar="WHICH", help=text)
    text = "poses of sheets and other anchors, instead of the scene's; see `iris-session anchors example`"
    parser.add_argument("--anchors", type=Path, metavar="TOML", help=text)
    text = "robots of a participant, repeatable; implies --assignment config"
    parser.add_argument("--assign", action="append", default=[], metavar="NAME=ROBOT[,ROBOT]", help=text)
    text = "a role, device or key:FINGERPRINT that may drive without an alignment too, repeatable (remote VR)"
    parser.add_argument("--unaligned", action="append", default=[], metavar="WHO", help=text)
    text = "depth cameras to show as a point cloud, repeatable; see `iris-session cloud example`"
    parser.add_argument("--camera", dest="cameras", action="append", type=Path, metavar="TOML", help=text)
    parser.add_argument("--task", type=Path, metavar="TOML", help="task of the episodes; progress is kept beside it")
    text = "a camera of the model whose pictures clients get, repeatable (top:320x240@30 is top with the defaults)"
    parser.add_argument("--picture", dest="pictures", action="append", metavar="CAMERA[:WxH][@HZ]", help=text)
    text = "draw them without shadows, reflections and smooth edges: faster without a graphics card"
    parser.add_argument("--plain-pictures", action="store_true", help=text)
    text = "continue at the end of a recording (a .rrd or its folder): same session, participants, leases, scene"
    parser.add_argument("--resume", type=Path, metavar="RECORDING", help=text)
    add_file_options(parser)
    parser.add_argument("--seconds", type=parse_seconds, help="stop after this many seconds")
    add_session_options(parser)


def make_session_config(arguments: argparse.Namespace, name: str) -> SessionConfig:
    """Return the `SessionConfig` for the options of `add_session_options`."""
    import msgspec

    from iris_session.authority import AuthorityConfig
    from iris_session.session.config import SessionConfig

    if arguments.record is False:
        if arguments.view:
            raise CommandError("--view shows the recording: leave --no-record out")
        if arguments.record_assets or arguments.record_budget_bytes:
            raise CommandError("--record-assets and --record-budget are for a recording: leave --no-record out")
    if arguments.interfaces and arguments.host:
        raise CommandError("--interface and --host both set where to listen: give one of them")
    assigned = parse_assignments(getattr(arguments, "assign", []))
    policy = arguments.assignment or (AssignmentPolicy.CONFIG if assigned else None)
    if assigned and policy != AssignmentPolicy.CONFIG:
        raise CommandError(f"--assignment {policy}: --assign needs --assignment {AssignmentPolicy.CONFIG}")
    changes = {"policy": policy, "default_mode": arguments.mode, "assignments": assigned or None}
    changes["unaligned"] = parse_unaligned(getattr(arguments, "unaligned", []))
    authority = msgspec.structs.replace(AuthorityConfig(), **{k: v for k, v in changes.items() if v is not None})
    fields = {field.name for field in dataclasses.fields(SessionConfig)} - {"anchors", "name"}
    given: dict[str, Any] = {k: v for k, v in vars(arguments).items() if k in fields and v is not None}
    if arguments.port_base is not None:
        if arguments.control_port or arguments.state_port:
            raise CommandError("--port-base sets all ports: give it without --control-port and --state-port")
        given |= {"control_port": arguments.port_base + 1, "state_port": arguments.port_base + 2}
    given |= {k: tuple(v) for k, v in given.items() if isinstance(v, list)}
    return SessionConfig(arguments.name or name, **given, authority=authority)


def parse_assignments(options: list[str]) -> dict[str, tuple[str, ...]]:
    """Parse `NAME=ROBOT[,ROBOT]` into robots by participant; a name given twice gets the robots of both."""
    found: dict[str, tuple[str, ...]] = {}
    for text in options:
        name, _, robots = text.partition("=")
        names = tuple(robot.strip() for robot in robots.split(","))
        if not name or not all(names):
            raise CommandError(f"--assign {text}: must be NAME=ROBOT[,ROBOT], for example ann=left")
        found[name] = tuple(dict.fromkeys((*found.get(name, ()), *names)))
    return found


def parse_unaligned(options: list[str]) -> tuple[str, ...] | None:
    """Return the roles, devices and keys that may drive without an alignment, `None` for those of the default."""
    from iris_session.authority.config import KEY_PREFIX, UNALIGNED
    from iris_session.protocol.names import Device, Role

    for text in options:
        if text not in Role.ALL | Device.ALL and not text.startswith(KEY_PREFIX):
            known = ", ".join(sorted(Role.DRIVING | Device.ALL))
            raise CommandError(f"--unaligned {text}: must be a role or device ({known}) or {KEY_PREFIX}FINGERPRINT")
    return (*UNALIGNED, *options) if options else None


def make_session_name(path: Path) -> str:
    """Return the default name of a session: that of its scene, with invalid characters replaced."""
    return re.sub(r"[^A-Za-z0-9._-]+", "-", path.stem).strip("._-")[:48] or "session"


def create_session(arguments: argparse.Namespace) -> Session:
    """Return a new session of a MuJoCo scene."""
    from iris_session.session.session import Session

    if arguments.scene is None:
        raise CommandError("no scene is given: give an MJCF or MJB file, the name of a scene, or --resume RECORDING")
    scene = open_scene(arguments.scene)
    config = make_session_config(arguments, make_session_name(Path(arguments.scene)))
    cameras = (*scene.cameras, *config.cameras)
    config = dataclasses.replace(config, anchors=scene.anchors, anchor_sizes=scene.anchor_sizes, cameras=cameras)
    return Session(scene.model, config=apply_anchors_file(config, arguments.anchors), robots=arguments.robots)


def create_publisher(arguments: argparse.Namespace, path: Path) -> ScenePublisher:
    """Return a publisher that shows a file in which nothing moves."""
    from iris_session.session.scene_publisher import ScenePublisher

    refuse_options(arguments, (*_DRIVES, "task"), f": {path.name} has no robots, it is shown as it is")
    scene = make_builder(path, path.name, arguments)
    config = apply_anchors_file(make_session_config(arguments, make_session_name(path)), arguments.anchors)
    return ScenePublisher(scene, config)


def resume_session(arguments: argparse.Namespace) -> Session:
    """Return a session that continues a recording."""
    from iris_session.session.session import Session

    refuse_options(arguments, _DRIVES, " cannot be combined with --resume: the recording defines them")
    if arguments.record is not None:
        raise CommandError("--record and --no-record cannot be combined with --resume: the recording goes on")
    model = None if arguments.scene is None else open_scene(arguments.scene).model
    config = make_session_config(arguments, "session")
    return Session(model, config=apply_anchors_file(config, arguments.anchors))


def apply_anchors_file(config: SessionConfig, path: Path | None) -> SessionConfig:
    """Return the configuration with the anchors of a file, if one is given."""
    from iris_session.session.config import load_anchors

    if path is None:
        return config
    given = load_anchors(path)
    known: dict[str, Any] = {"anchor_sizes": given.sizes, "anchor_errors": given.error_m, "anchor_marks": given.marks}
    return dataclasses.replace(config, anchors=given.anchors, **known)


def run(arguments: argparse.Namespace) -> int:
    """Serve until Ctrl-C or `--seconds`; print where to join and, at the end, the result."""
    shown = None if arguments.resume is not None or arguments.scene is None else find_scene_file(arguments.scene)
    check_file_options(arguments, shown)
    if shown is not None:
        publisher = create_publisher(arguments, shown)
        return _serve(arguments, publisher, lambda session: _describe_shown_file(session, shown))
    session = resume_session(arguments) if arguments.resume is not None else create_session(arguments)
    hint = ""
    if not session.robots and arguments.robots != "none":
        from iris_session.session.robots import explain_no_robots

        tip = f"see `iris-session robots {arguments.scene} --all`, or give them with --robots FILE"
        hint = f"{explain_no_robots(session.model)}; {tip}"
    return _serve(arguments, session, lambda _: hint, ", ".join(robot.name for robot in session.robots))


def _describe_shown_file(session: Session | ScenePublisher, path: Path) -> str:
    """Return what is shown, its extent, and the meshes that should be simplified."""
    from iris_session.scene import AssetStore, SceneBuildError
    from iris_session.scene.report import compute_extent, format_size, list_large_meshes

    spec, what = session.scene, f"showing {path.name}, without robots"
    if spec is None:
        return what
    where = session.config.assets
    try:
        extent = compute_extent(spec, AssetStore(None if isinstance(where, bool) else where))
    except (OSError, SceneBuildError):  # the session reports a damaged store
        extent = None
    if extent is not None:
        what += f"; its extent is {format_size(extent)}"
    advice = (URDF_ADVICE,) if path.suffix.lower() == ".urdf" else ()
    return "\n".join((what, *advice, *list_large_meshes(spec)))


def _serve(
    arguments: argparse.Namespace,
    session: Session | ScenePublisher,
    make_hint: Callable[[Session | ScenePublisher], str],
    robots: str = "",
) -> int:
    """Run a session. `make_hint` returns a text to print once it runs; empty: none."""
    with session.signals(), session:
        out = sys.stderr if arguments.json else sys.stdout
        print(f"session '{session.name}' on {session.address}, robots: {robots or 'none'}", file=out, flush=True)
        for note in filter(None, (*session.notes, make_hint(session))):
            print(note, file=out, flush=True)
        if session.recording is not None:
            print(f"recording to {session.recording} ({RECORDING_COST})", file=out, flush=True)
        with live_viewer(session.recording, out) if arguments.view else nullcontext():
            _run_with_live_view(arguments, session, out)
        status = session.status()
        recording = None if session.recording is None else str(session.recording)
    fault = session.recording_fault
    if arguments.json:
        print_json({"ok": not fault, "recording": recording, "recording_fault": fault, **status.as_dict()})
    elif recording:
        print(f"recording: {recording}")
        print(f"  look at it: iris-session view {recording}    check it: iris-session verify {recording}")
    if fault:
        print_error(fault)
    return 1 if fault else 0


def _run_with_live_view(arguments: argparse.Namespace, session: Session | ScenePublisher, out: TextIO) -> None:
    from iris_session.cli.keyboard import bind_session_keys, read_keys
    from iris_session.cli.live import TerminalView

    keys = bind_session_keys(session)
    with nullcontext(False) if arguments.json else read_keys(keys) as has_keys:
        footer = "  ".join((*(one.text for one in keys.values()), "Ctrl-C end")) if has_keys else ""
        view = TerminalView(session, out, f"iris-session {session.name} on {session.address}", footer)
        with view.open():
            session.run(seconds=arguments.seconds, until=view.update)
