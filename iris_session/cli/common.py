"""Shared parts of the commands: errors, option types, common options, output."""

from __future__ import annotations

import argparse
import inspect
import json
import math
import re
import signal
import socket
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, Final, NoReturn, TypeAlias, TypeVar

from anchors.pose import quat_normalize
from iris_session.protocol.errors import IrisError
from iris_session.protocol.names import AlignmentKind, AssignmentPolicy, LeaseMode, RefusalCode
from iris_session.system.files import write_output

if TYPE_CHECKING:
    from anchors.pose import PoseTuple
    from iris_session.client import Client
    from iris_session.demo.named_scenes import NamedScene
    from iris_session.protocol.server_messages import ParticipantInfo
    from iris_session.security import RegisteredSession

N = TypeVar("N", int, float)
Commands: TypeAlias = "argparse._SubParsersAction[CommandParser]"

#: Bytes of each unit of a size.
_BYTES: Final = {
    f"{letter}{i}b": base**n for n, letter in enumerate("kmgt", 1) for i, base in (("", 1000), ("i", 1024))
}
ABOVE_0: Final = math.ulp(0.0)
#: Lines of one kind that are printed; `--json` has all.
MOST_LINES: Final = 20


class CommandError(IrisError):
    """The command cannot continue. The text is one line: what is wrong, and what would be right."""

    def __init__(self, text: str, status: int = 2) -> None:
        super().__init__(text)
        self.status = status


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn an `OSError` into a `CommandError` about a file that cannot be written."""
    try:
        yield
    except OSError as error:
        raise CommandError(f"{path} cannot be written: {error.strerror or error}") from error


def write_file(path: Path, content: bytes | str) -> None:
    """Write the file of an option, completely or not at all. Raises `CommandError`."""
    with writing(path):
        write_output(path, content.encode() if isinstance(content, str) else content)


@contextmanager
def handling_signals(handler: Callable[[int, FrameType | None], Any], *numbers: signal.Signals) -> Iterator[None]:
    """Handle signals while the block runs."""
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, previous in before.items():
            signal.signal(number, previous)


def ending_as_interrupts() -> AbstractContextManager[None]:
    """Take SIGTERM and a closed terminal as Ctrl-C while the block runs, so that nothing is left behind."""
    return handling_signals(signal.default_int_handler, signal.SIGTERM, signal.SIGHUP)


def make_number_type(kind: Callable[[str], N], wanted: str, low: float, high: float = math.inf) -> Callable[[str], N]:
    """Return a type for `add_argument`: finite numbers from `low` to `high`. `wanted`: what to give, for the error."""

    def parse(text: str) -> N:
        with suppress(ValueError):
            number = kind(text)
            if math.isfinite(number) and low <= number <= high:
                return number
        raise argparse.ArgumentTypeError(f"{text!r} is not {wanted}")

    return parse


#: Timeout of the test whether a session is reachable [s].
CONNECT_S: Final = 2.0

#: Types of options: a duration [s], ports, and `--port-base`.
parse_seconds: Final = make_number_type(float, "a duration: give seconds above 0, for example 30", ABOVE_0)
parse_port: Final = make_number_type(int, "a port: give 1 to 65535", 1, 65535)
parse_free_port: Final = make_number_type(int, "a port: give 1 to 65535, or 0 for any free one", 0, 65535)
parse_port_base: Final = make_number_type(int, "a base of seven ports: give 1 to 65529, for example 7730", 1, 65529)


def parse_cloud_rate(text: str) -> float:
    """Parse `--record-clouds` [Hz]; 0 for `off`."""
    from iris_session.session.config import MAX_CLOUDS_HZ, MIN_CLOUDS_HZ

    number = text.lower().removesuffix("hz").strip()
    if number in ("off", "0"):
        return 0.0
    wanted = f"a rate: give {MIN_CLOUDS_HZ:g} to {MAX_CLOUDS_HZ:g} a second, for example 2Hz, or off"
    return make_number_type(float, wanted, MIN_CLOUDS_HZ, MAX_CLOUDS_HZ)(number)


def parse_budget(text: str) -> int:
    """Parse `--record-budget` [bytes]. The unit is required, so that 20 cannot mean 20 bytes."""
    from iris_session.recording.budget import MIN_BUDGET_BYTES

    match = re.fullmatch(r"([0-9]{1,9}(?:\.[0-9]{1,9})?)\s*([kmgt]i?b)", text.strip().lower())
    n_bytes = round(float(match[1]) * _BYTES[match[2]]) if match else 0
    if n_bytes < MIN_BUDGET_BYTES:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a size for a recording: give {MIN_BUDGET_BYTES // 10**6}MB or more, for example 20GB"
        )
    return n_bytes


class CommandParser(argparse.ArgumentParser):
    """A parser whose errors are one line, and whose help ends with examples: its own, or the first of each action."""

    notes = ""
    examples: Sequence[str] = ()

    def __init__(self, **options: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **options)
        self._negative_number_matcher = re.compile(r"-[0-9.]")  # a pose that begins with a minus, too

    def list_examples(self) -> Sequence[str]:
        """Return the examples of its help."""
        lists = (action.choices.values() for action in self._actions if isinstance(action, argparse._SubParsersAction))
        return self.examples or [one.list_examples()[0].split("  ")[0] for parsers in lists for one in parsers]

    def format_help(self) -> str:
        """Return the help."""
        lines = self.list_examples()
        title = "examples" if len(lines) > 1 else "example"
        self.epilog = f"{self.notes}\n\n" * bool(self.notes) + "\n  ".join((f"{title}:", *lines))
        return super().format_help()

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with 2; `--help` has the usage."""
        for action in self._actions:
            name = action.metavar or action.dest
            if action.choices and not action.option_strings and message.endswith(f"arguments are required: {name}"):
                message += f", one of {', '.join(action.choices)}"
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def add_command(
    commands: Commands,
    name: str,
    run: Callable[[argparse.Namespace], int],
    *,
    help: str,
    description: str = "",
    examples: str,
    notes: str = "",
    has_json: bool = True,
) -> CommandParser:
    """Add a command, or an action of one, and return its parser.

    Args:
        commands: Commands or actions to add it to.
        name: Its name.
        run: Function that runs it and returns the exit status.
        help: Its line in the list of commands.
        description: What it does, at the top of its help (default: `help`).
        examples: Examples, one a line, at the end of its help; may be indented.
        notes: Text before the examples.
        has_json: Add `--json`, which `print_result` obeys.
    """
    parser = _add_parser(commands, name, help, description)
    parser.notes, parser.examples = notes, inspect.cleandoc(examples).split("\n")
    parser.set_defaults(run=run)
    if has_json:
        add_json_option(parser)
    return parser


def add_actions(
    commands: Commands, name: str, *, help: str, description: str = "", examples: str = "", metavar: str = "ACTION"
) -> Commands:
    """Add a command that has actions, and return them. `help`, `description`, `examples`: as of `add_command`; the
    default is the first example of each action."""
    parser = _add_parser(commands, name, help, description)
    parser.examples = inspect.cleandoc(examples).split("\n") if examples else ()
    return parser.add_subparsers(dest="action", required=True, metavar=metavar)


def _add_parser(commands: Commands, name: str, help: str, description: str) -> CommandParser:
    return commands.add_parser(name, help=help, description=description or f"{help[0].upper()}{help[1:]}.")


def add_json_option(parser: argparse._ActionsContainer) -> None:
    """Add `--json`."""
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of text")


def add_address_options(
    parser: argparse.ArgumentParser,
    *,
    option: bool = False,
    code: str = "join code, needed the first time at an encrypted session",
) -> None:
    """Add the options by which a client finds a session. `option`: the address is no positional argument."""
    text = "HOST:PORT or iris://... (default: 127.0.0.1:7721)"
    parser.add_argument("--address", default="", metavar="ADDR", help=text)
    if not option:
        parser.add_argument("address", nargs="?", default=argparse.SUPPRESS, help="the same as --address")
    parser.add_argument("--session", default="", metavar="NAME", help="name of the session, instead of an address")
    parser.add_argument("--code", default="", help=code)


def check_session_reachable(arguments: argparse.Namespace) -> None:
    """Raise `CommandError` within `CONNECT_S` if nothing listens at the given address: a client would wait for it."""
    from iris_session.client.discovery import Address, resolve_host
    from iris_session.client.endpoint_resolver import LOCAL_ADDRESS

    if arguments.session:  # found by its name, it has no address yet
        return
    address = Address.parse(arguments.address or LOCAL_ADDRESS)
    until_s = time.monotonic() + CONNECT_S
    resolving = resolve_host(address.host, until_s)  # an e-stop does not wait for a name server
    try:
        while True:
            try:
                next(resolving)
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


def make_client(arguments: argparse.Namespace, role: str, name: str) -> Client:
    """Return a client, not connected yet, for the options of `add_address_options`. Raises `CommandError`."""
    from iris_session.client import Client

    check_session_reachable(arguments)
    session, code = arguments.session, arguments.code
    return Client(
        arguments.address, session=session, join_code=code, role=role, name=name, alignment=AlignmentKind.NOT_NEEDED
    )


def is_given(value: object) -> bool:
    """Return whether an option was given, by its value: 0 is one."""
    return value is not None and value is not False and value not in ("", [])


def refuse_options(arguments: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Raise `CommandError` if some of these options are given: their list, then `why`."""
    given = ", ".join(f"--{name}" for name in names if is_given(getattr(arguments, name)))
    if given:
        raise CommandError(f"{given}{why}")


def find_participant(client: Client, name: str) -> ParticipantInfo:
    """Return the participant with an id or name. Raises `CommandError` with the candidates if it is none, or many."""
    people = sorted(client.mirror.participants.values(), key=lambda one: (len(one.id), one.id))
    found = [one for one in people if one.id == name] or [one for one in people if one.name == name]
    if len(found) == 1:
        return found[0]
    if found:
        ids = ", ".join(f"{one.id} ({one.role}{'' if one.connected else ', disconnected'})" for one in found)
        raise CommandError(to_printable(f"{len(found)} participants are named {name!r}: give one of the ids {ids}"))
    others = ", ".join(f"{one.name} ({one.id})" for one in people if one.id != client.participant_id) or "none"
    raise CommandError(to_printable(f"no participant {name!r} in the session; there are: {others}"))


def _read_own_sessions() -> Sequence[RegisteredSession]:
    """Return the encrypted sessions of this user that run here."""
    from iris_session.security import KeyHome, KeysError

    with suppress(KeysError):
        return KeyHome().sessions.read()
    return ()


def describe_own_sessions() -> str:
    """Return the addresses of this user's encrypted sessions, for errors of commands without an address."""
    yours = (f"; your session {x.name!r} is at {x.hosts[0]}:{x.control}" for x in _read_own_sessions() if x.hosts)
    return "".join(yours) or "; for a session on another machine, give its address or --session NAME"


def describe_error(error: IrisError) -> str:
    """Return an error as a line: of a key that is not on the list, with what the owner of a session here does."""
    owns = getattr(error, "code", "") == RefusalCode.UNPAIRED and _read_own_sessions()
    return f"{error}{'; if the session is your own: `iris-session keys allow me`' if owns else ''}"


def add_session_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of commands that open a session. Most are stored under the name of a field of `SessionConfig`,
    and are `None` if not given.
    """
    group = parser.add_argument_group("session")
    group.add_argument("--name", help="name of the session (default: that of the scene)")
    group.add_argument("--host", metavar="ADDR", help="address to listen on, 0.0.0.0 for all (default: 127.0.0.1)")
    text = "network to listen on instead of --host: a name like eth0, or an address; repeatable"
    group.add_argument("--interface", dest="interfaces", action="append", metavar="NAME_OR_ADDR", help=text)
    group.add_argument("--advertise", metavar="ADDR", help="address for clients, if a router forwards our ports")
    text = "block of ports: introduction N, control N+1, state N+2, ... N+6 (default: 7720)"
    group.add_argument("--port-base", type=parse_port_base, metavar="N", help=text)
    text = "do not announce the session on the network"
    group.add_argument("--no-beacon", dest="beacon_port", action="store_const", const=0, help=text)
    group.add_argument("--control-port", type=int, metavar="PORT", help="0: any free port")
    group.add_argument("--state-port", type=int, metavar="PORT", help="0: any free port")
    group.add_argument("--curve", action="store_true", help="encrypt on loopback too, and admit listed keys only")
    text = (
        "secret key of the session for encryption, a ZeroMQ certificate *.key_secret that only you can read "
        "(default: your own, made on first use; `iris-session keys show` has its fingerprint)"
    )
    group.add_argument("--curve-key", metavar="FILE", help=text)
    record = group.add_mutually_exclusive_group()
    text = "path of the recording (default: below sessions/)"
    record.add_argument("--record", type=parse_recording_name, metavar="FILE", help=text)
    record.add_argument("--no-record", dest="record", action="store_const", const=False, help="record nothing")
    text = "frames per second of each point cloud and picture in the recording, or off (default: 2Hz)"
    group.add_argument("--record-clouds", dest="record_clouds_hz", type=parse_cloud_rate, metavar="RATE", help=text)
    text = (
        "what of the scenes goes into the recording: what the best level of detail needs (scene), all levels, or "
        "nothing (default: scene)"
    )
    group.add_argument("--record-assets", choices=("none", "scene", "all"), help=text)
    text = "size that the recording may have, such as 20GB; the session goes on without one then (default: no limit)"
    group.add_argument("--record-budget", dest="record_budget_bytes", type=parse_budget, metavar="SIZE", help=text)
    text = (
        "folder of public ZeroMQ certificates *.key: these keys may join, in every role, and no other; there is "
        "no pairing and no page then (default: the keys of `iris-session keys list`)"
    )
    group.add_argument("--curve-clients", metavar="DIR", help=text)
    add_page_options(group, parse_free_port)
    group.add_argument("--view", action="store_true", help="show the recording in Rerun's viewer while it is written")
    group.add_argument("--no-web", dest="web", action="store_false", help="serve no page for browsers")
    text = "geom groups that clients show, such as 0,1,2 (default: as the model's own viewer)"
    group.add_argument("--groups", type=parse_groups, metavar="GROUPS", help=text)
    text = "show all sites, those of these groups, or `none` (default: groups 0 to 2, as MuJoCo's viewer)"
    group.add_argument("--sites", nargs="?", const=True, type=parse_sites, metavar="GROUPS", help=text)
    group.add_argument("--assignment", choices=sorted(AssignmentPolicy.ALL), help="how robots are assigned")
    group.add_argument("--mode", choices=sorted(LeaseMode.ALL), help="lease mode of every robot")


def parse_recording_name(text: str) -> str:
    """Parse `--record`."""
    if not text.endswith(".rrd"):
        raise argparse.ArgumentTypeError(f"{text!r}: a recording is one file: give a name that ends in .rrd")
    return text


def parse_groups(text: str) -> tuple[int, ...]:
    """Parse numbers of groups, separated by commas."""
    parts = text.split(",")
    if not all(part.strip().isdecimal() for part in parts):
        raise argparse.ArgumentTypeError(f"{text!r}: must be numbers of groups, such as 0,1,2")
    return tuple(int(part) for part in parts)


def parse_sites(text: str) -> bool | tuple[int, ...]:
    """Parse groups of sites, `all` or `none`."""
    return text == "all" if text in ("all", "none") else parse_groups(text)


def add_page_options(group: argparse._ActionsContainer, port: Callable[[str], int]) -> None:
    """Add the options of the page for browsers, for `serve`, `demo` and `web`. `port`: type of its port."""
    group.add_argument("--web-port", type=port, metavar="PORT", help="port of the page for browsers (default: 7725)")
    group.add_argument("--web-cert", default="", metavar="FILE", help="certificate for HTTPS, PEM (default: your own)")
    group.add_argument("--web-key", default="", metavar="FILE", help="key of that certificate, PEM")


def open_scene(scene: str) -> NamedScene:
    """Return the scene of that name, or load it from a file."""
    from iris_session.demo.named_scenes import NamedScene, scene_by_name
    from iris_session.physics import load_model

    path = Path(scene)
    if path.suffix or path.is_file():
        return NamedScene(load_model(path))
    return scene_by_name(scene)


def format_scene_names() -> str:
    """Return the named scenes, one per line under a heading."""
    from iris_session.demo.scene_names import SCENE_NAMES, SCENE_NOTE

    width = max(map(len, SCENE_NAMES))
    return "\n".join(
        (f"named scenes ({SCENE_NOTE}):", *(f"  {name:<{width}}  {what}" for name, what in SCENE_NAMES.items()))
    )


def to_printable(text: str) -> str:
    """Replace characters that control a terminal: names and notes come from other users."""
    return "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)


def print_json(value: object) -> None:
    """Print one JSON object to standard output. Structs in it are printed by their fields."""
    from msgspec import to_builtins

    print(json.dumps(value, allow_nan=False, default=to_builtins), flush=True)


def print_result(arguments: argparse.Namespace, value: object, lines: Iterable[str], *, ok: bool = True) -> int:
    """Print the result of a command, for `--json` one object, else printable lines. Return the exit status."""
    if arguments.json:
        print_json(value)
    else:
        print("\n".join(map(to_printable, lines)), flush=True)
    return 0 if ok else 1


def list_first(lines: Sequence[str], most: int = MOST_LINES) -> list[str]:
    """Return the first lines of a long list, and how many more `--json` has."""
    more = [f"and {len(lines) - most} more: --json has all"] if len(lines) > most else []
    return [*lines[:most], *more]


def pick_attributes(value: object, *names: str) -> dict[str, object]:
    """Return some attributes of an object by their names."""
    return {name: getattr(value, name) for name in names}


def print_error(text: str) -> None:
    """Print one printable line to standard error."""
    print(to_printable(f"iris-session: {text}"), file=sys.stderr)


def name_first(problems: Sequence[str]) -> str:
    """Return the first problem, and how many more there are."""
    return problems[0] + (f" (and {len(problems) - 1} more)" if len(problems) > 1 else "")


def report_damage(path: Path, problems: Sequence[str]) -> int:
    """Print the first problem of a recording. Return the exit status."""
    if problems:
        print_error(f"{path} is damaged: {name_first(problems)}")
    return 1 if problems else 0


def parse_pose(text: str) -> PoseTuple:
    """Parse a pose: position [m] and unit quaternion, w first."""
    try:
        numbers = [float(word) for word in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) != 7 or not all(map(math.isfinite, numbers)) or abs(math.hypot(*numbers[3:]) - 1.0) > 0.01:
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a pose: x,y,z in metres and a unit quaternion qw,qx,qy,qz, for example 0,-0.45,0,1,0,0,0"
        )
    x, y, z, *q = numbers
    return (x, y, z), quat_normalize((q[0], q[1], q[2], q[3]))


def add_pose_option(parser: argparse.ArgumentParser, description: str) -> None:
    """Add the required option `--pose`."""
    text = f"{description}: metres, unit quaternion with w first"
    parser.add_argument("--pose", type=parse_pose, required=True, metavar="X,Y,Z,QW,QX,QY,QZ", help=text)


def parse_length(text: str) -> float:
    """Parse a length with its unit [m]. The unit is required, so that 160 cannot mean 160 m."""
    match = re.fullmatch(r"([0-9]*\.?[0-9]+)\s*(mm|cm|m)", text.strip())
    if not match:
        raise argparse.ArgumentTypeError(f"{text!r} is not a length: give a number with its unit, for example 150mm")
    return float(match[1]) * {"mm": 1e-3, "cm": 1e-2, "m": 1.0}[match[2]]
