"""What commands share: options of a session, one-line errors, printing one JSON object."""

from __future__ import annotations

import argparse
import json
import math
import re
import socket
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.protocol.names import AssignmentPolicy, LeaseMode

if TYPE_CHECKING:
    import mujoco

    from anchors.pose import PoseTuple
    from iris_session.demo.named_scenes import NamedScene


#: Whatever is there has taken a connection by then.
CONNECT_S: Final = 2.0


class CommandError(Exception):
    """The command cannot go on; the text is one line that says what would be right."""

    def __init__(self, text: str, status: int = 2) -> None:
        super().__init__(text)
        self.status = status


def list_expected_errors() -> tuple[type[Exception], ...]:
    """Errors whose text is made for the user. Anything else is a defect and keeps its traceback."""
    from iris_session.assets.errors import AssetStoreError
    from iris_session.client import ClientError
    from iris_session.control import ControlError
    from iris_session.link import FrontError
    from iris_session.netsim.process import ImpairmentError
    from iris_session.netsim.profiles import ProfileError
    from iris_session.physics import PhysicsError
    from iris_session.recording import RecordingError
    from iris_session.scene import SceneBuildError
    from iris_session.security import KeysError
    from iris_session.session.errors import SessionError

    return (
        SessionError,
        SceneBuildError,
        AssetStoreError,
        PhysicsError,
        ControlError,
        FrontError,
        RecordingError,
        ClientError,
        ImpairmentError,
        ProfileError,
        KeysError,
    )


def parse_seconds(text: str) -> float:
    """Type of options that take a duration [s]."""
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not (math.isfinite(seconds) and seconds > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a duration: give seconds above 0, for example 30")
    return seconds


def parse_port_base(text: str) -> int:
    """Type of `--port-base`."""
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= 65529:
        raise argparse.ArgumentTypeError(f"{text!r} is not the first of seven ports: 1 to 65529, for example 7730")
    return int(text)


def add_json_option(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def add_address_options(
    parser: argparse.ArgumentParser,
    *,
    option: bool = False,
    code: str = "join code, for the first time at an encrypted session",
) -> None:
    """How a command of a client finds the session: `address`, `session`, `code`. `option`: `--address`, where other
    words stand at its place."""
    text = "HOST:PORT or iris://... (default: 127.0.0.1:7721)"
    if option:
        parser.add_argument("--address", default="", metavar="ADDR", help=text)
    else:
        parser.add_argument("address", nargs="?", default="", help=text)
    parser.add_argument("--session", default="", metavar="NAME", help="a session by its name instead of an address")
    parser.add_argument("--code", default="", help=code)


def check_session_reachable(arguments: argparse.Namespace) -> None:
    """Raises `CommandError` within `CONNECT_S` where nothing listens at the address that was given: a client would wait
    for it to begin. A session by its name has no address yet."""
    from iris_session.client.address import Address
    from iris_session.client.joining import LOCAL
    from iris_session.client.resolving import resolve

    if arguments.session:
        return
    address = Address.parse(arguments.address or LOCAL)
    until_s = time.monotonic() + CONNECT_S
    looking = resolve(address.host, until_s)
    try:
        while True:
            try:
                next(looking)
            except StopIteration as found:
                socket.create_connection((found.value, address.port), max(0.1, until_s - time.monotonic())).close()
                return
            time.sleep(0.005)
    except OSError as error:
        raise CommandError(
            f"no session answers at {address}: is `iris-session serve` running there? "
            f"(TCP port {address.port}: {error.strerror or error})"
            f"{'' if arguments.address else describe_own_sessions()}"
        ) from None


def describe_own_sessions() -> str:
    """Where the encrypted sessions of this user are, for who has typed no address."""
    from iris_session.security import KeyHome, KeysError

    try:
        notes = KeyHome().sessions.read()
    except KeysError:
        notes = []
    yours = (f"; your session {one.name!r} is at {one.hosts[0]}:{one.control}" for one in notes if one.hosts)
    return "".join(yours) or "; for one on another machine, give its address or --session NAME"


def add_session_options(parser: argparse.ArgumentParser) -> None:
    """Options that every command which opens a session takes."""
    group = parser.add_argument_group("session")
    group.add_argument("--name", default=None, help="name of the session (default: that of the scene)")
    group.add_argument(
        "--host",
        default="127.0.0.1",
        metavar="ADDR",
        help="address to listen on, 0.0.0.0 for all (default: %(default)s)",
    )
    group.add_argument(
        "--interface",
        action="append",
        default=[],
        metavar="NAME_OR_ADDR",
        help="network to listen on instead of --host: a name like eth0, or an address; repeatable",
    )
    group.add_argument(
        "--advertise", default="", metavar="ADDR", help="address that others are told, behind a router that forwards"
    )
    group.add_argument(
        "--port-base",
        type=parse_port_base,
        default=None,
        metavar="N",
        help="block of ports: introduction N, control N+1, state N+2, ... N+6 (default: 7720)",
    )
    group.add_argument("--no-beacon", action="store_true", help="do not tell the network that this session is here")
    group.add_argument("--control-port", type=int, default=None, metavar="PORT", help="0: any free one")
    group.add_argument("--state-port", type=int, default=None, metavar="PORT", help="0: any free one")
    group.add_argument("--curve", action="store_true", help="encrypt on loopback too, and let listed keys in only")
    group.add_argument(
        "--curve-key", default="", metavar="FILE", help="another CURVE secret key of the server than the user's"
    )
    group.add_argument(
        "--record", default=None, metavar="FILE", help="path of the recording (default: below sessions/)"
    )
    group.add_argument(
        "--curve-clients", default="", metavar="DIR", help="public certificates to let in instead of the allow-list"
    )
    group.add_argument("--no-record", action="store_true", help="record nothing")
    group.add_argument("--sites", action="store_true", help="clients are told of the model's sites too")
    group.add_argument("--tendons", action="store_true", help="and of its spatial tendons")
    group.add_argument("--assignment", choices=sorted(AssignmentPolicy.ALL), default=None, help="who gets which robot")
    group.add_argument("--mode", choices=sorted(LeaseMode.ALL), default=None, help="lease mode of every robot")


def open_scene(scene: str) -> NamedScene:
    """The scene of that name, or in that file; a file or folder in the way of a name is no scene."""
    from iris_session.demo.named_scenes import NamedScene, scene_by_name
    from iris_session.physics import load_model

    path = Path(scene)
    if path.suffix or path.is_file():
        return NamedScene(load_model(path))
    return scene_by_name(scene)


def format_scene_names() -> str:
    """The scenes that can be named, a line each."""
    from iris_session.demo.scene_names import SCENE_NAMES

    width = max(map(len, SCENE_NAMES))
    return "\n".join(f"  {name:<{width}}  {what}" for name, what in SCENE_NAMES.items())


def explain_no_robots(model: mujoco.MjModel) -> str:
    """One line about a model in which no robot was found: why, and what helps."""
    from iris_session.physics.robots import MIN_JOINTS

    has = f"the model has {model.nu} actuators and {model.njnt} joints" if model.nu else "the model has no actuators"
    return (
        f"no robots found, so people can only look and take objects: a robot is a chain of at least {MIN_JOINTS} "
        f"actuated joints, and {has}"
    )


def to_printable(text: str) -> str:
    """`text` without anything that a terminal obeys: names and notes are strangers' words."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def print_json(value: dict[str, Any]) -> None:
    """Exactly one JSON object on standard output."""
    print(json.dumps(value, allow_nan=False), flush=True)


_UNITS: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
POSE_FORMAT: Final = "X,Y,Z,QW,QX,QY,QZ"
#: Numbers with a comma between them, the first negative: no option looks like that.
_BEGINS_WITH_MINUS: Final = re.compile(r"-[0-9.][^,]*(,[^,]*)+")


def parse_pose(text: str) -> PoseTuple:
    """Type of poses: position [m] and unit quaternion, w first."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 7 or not all(map(math.isfinite, numbers)) or abs(math.hypot(*numbers[3:]) - 1.0) > 0.01:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a pose: x,y,z in metres and a unit quaternion qw,qx,qy,qz, for example 0,-0.45,0,1,0,0,0"
        )
    x, y, z, *q = numbers
    norm = math.hypot(*q)
    return (x, y, z), (q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm)


def pose_to_dict(T: PoseTuple) -> dict[str, list[float]]:
    """Return a pose as a JSON object."""
    return {"position_m": list(T[0]), "quaternion_wxyz": list(T[1])}


def join_negative_poses(arguments: Sequence[str]) -> list[str]:
    """Words of a command line, where a pose that begins with a minus is joined to its option: alone it would be read as
    an option itself."""
    out: list[str] = []
    for word in arguments:
        if _BEGINS_WITH_MINUS.fullmatch(word) and out and out[-1].startswith("--") and "=" not in out[-1]:
            out[-1] += f"={word}"
        else:
            out.append(word)
    return out


def add_pose_option(parser: argparse.ArgumentParser, description: str) -> None:
    """`--pose`, which must be given."""
    parser.add_argument(
        "--pose",
        type=parse_pose,
        required=True,
        metavar=POSE_FORMAT,
        help=f"{description}: metres, unit quaternion with w first",
    )


def parse_length(text: str) -> float:
    """Type of lengths, with their unit so that nobody prints a sheet of 160 m: metres."""
    found = re.fullmatch(r"([0-9]*\.?[0-9]+)\s*(mm|cm|m)", text.strip())
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} is not a length: a number with its unit, for example 160mm")
    return float(found[1]) * _UNITS[found[2]]
