"""Commands that control a running session: e-stop, pause, reset, leases, names and roles, episodes, markers.

Each joins for the time of the request, in the first role that its key may have of those that may ask for it, under a
name that no assignment gives robots to, and leaves.
"""

from __future__ import annotations

import argparse
import getpass
import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any, Final

import msgspec

from iris_session.cli.common import (
    CommandError,
    Commands,
    add_address_options,
    add_command,
    describe_error,
    find_participant,
    make_client,
    print_error,
    print_json,
    print_result,
)
from iris_session.protocol.client_messages import Rename, SetRole
from iris_session.protocol.names import ControlAction, DenialReason, EpisodeAction, LeaseMode, Role

if TYPE_CHECKING:
    from iris_session.client import Client

#: Time to be admitted, and for the e-stop to be confirmed [s].
TIMEOUT_S: Final = 5.0
#: Roles that may ask for it, the least powerful first: a key may have few of them.
DIRECTORS: Final = (Role.DIRECTOR,)
DRIVERS: Final = (Role.AGENT, Role.OPERATOR, Role.LEADER, Role.DIRECTOR)
#: A director may end the episodes of others; it comes first.
EPISODE_ROLES: Final = tuple(reversed(DRIVERS))
ALL_ROLES: Final = (Role.OBSERVER, *DRIVERS)
#: A reason of one word that is an address was meant as one.
_ADDRESS: Final = re.compile(r"iris://.*|\d+\.\d+\.\d+\.\d+(:\d+)?|[\w.-]+:\d+|\[[0-9a-fA-F:]+\](:\d+)?")


#: Result of a command: one line for people, and fields for `--json`.
Outcome = tuple[str, dict[str, Any]]
Action = Callable[["Client", argparse.Namespace], Outcome]


def register(commands: Commands) -> None:
    add = partial(_add_command, commands)
    estop = add("stop every robot of a session; not a safety-rated stop", stop_session, 'estop "hand in the way"')
    estop.add_argument("reason", nargs="*", help="text for participants and the recording")
    estop.set_defaults(roles=ALL_ROLES)
    add("allow motion again after an e-stop; says who had stopped", clear_session, "clear-estop")
    add("pause physics; robots hold", control_physics, ControlAction.PAUSE)
    add("continue paused physics", control_physics, ControlAction.RESUME)
    add("put the scene back to its initial state; leases stay", control_physics, ControlAction.RESET)
    person: dict[str, Any] = {"metavar": "PERSON", "help": "name or id of a participant"}
    assign = add("give robots to a participant", assign_robots, "assign left ann", "assign left,right p3")
    assign.add_argument("robots", metavar="ROBOT[,ROBOT]", help="names of robots")
    assign.add_argument("person", **person)
    release = add("free robots, whichever participant holds them", release_robots, "release left right")
    release.add_argument("robots", nargs="+", metavar="ROBOT", help="names of robots")
    mode = add("change the lease mode of robots", set_modes, "mode request left right")
    mode.add_argument("mode", choices=sorted(LeaseMode.ALL), help="lease mode")
    mode.add_argument("robots", nargs="*", metavar="ROBOT", help="names of robots (default: all)")
    rename = add("give a participant another name", rename_participant, "rename p3 ann", "rename quest ann")
    rename.add_argument("person", **person)
    rename.add_argument("name", metavar="NAME", help="its new name; one that is taken gets a number")
    role = add("give a participant another role, one of those of its key", set_role, "role ann director")
    role.add_argument("person", **person)
    role.add_argument("role", choices=sorted(Role.ALL - {Role.GATEWAY}), metavar="ROLE", help="its new role")
    examples = ("episode start --label pour", "episode success", "episode discard", "episode take_over")
    episode = add("start and end episodes of training data", control_episode, *examples)
    episode.add_argument("action", choices=sorted(EpisodeAction.ALL), help="what happens to the episode")
    episode.add_argument("--label", default="", help="free text about the episode")
    episode.add_argument("--countdown", type=float, metavar="S", help="seconds until `start` begins (default: 3)")
    episode.set_defaults(roles=EPISODE_ROLES)
    marker = add("put a note into the recording", place_marker, 'marker "gripper was cleaned"')
    marker.add_argument("text", nargs="+", help="the note")
    marker.set_defaults(roles=ALL_ROLES)


def _add_command(commands: Commands, text: str, act: Action, *examples: str) -> argparse.ArgumentParser:
    """Add the command with which the first example begins."""
    parser = add_command(
        commands,
        examples[0].split(" ")[0],
        run,
        help=text,
        notes="The session is the one on this machine, or that of --address or --session.",
        examples="\n".join(f"iris-session {example}" for example in (*examples, f"{examples[0]} --session lab-1")),
    )
    add_address_options(parser, option=True)
    parser.set_defaults(act=act, roles=DIRECTORS)
    return parser


def run(arguments: argparse.Namespace) -> int:
    """Join, act, leave. Exit status 1 if the session denies it or does not answer, 2 if there is nothing to ask."""
    from iris_session.client import DeniedError, NotConnectedError, RefusedError, RequestTimeoutError

    result: dict[str, Any] = {"ok": True, "command": arguments.command}
    try:
        with _join_session(arguments) as client:
            result["session"] = client.address
            text, fields = arguments.act(client, arguments)
    except (DeniedError, RefusedError, NotConnectedError, RequestTimeoutError, CommandError) as error:
        text = describe_error(error)
        if isinstance(error, RefusedError) and error.code == DenialReason.ROLE and Role.DIRECTOR in arguments.roles:
            text += "; on the server: `iris-session pair --role director`"
        if isinstance(error, RefusedError) and arguments.act is stop_session:
            text += "; the e-stop was sent before, but not confirmed: look at the robots"
        print_error(text)
        if arguments.json:
            denied = error.denial.reason if isinstance(error, DeniedError) else ""
            reason = denied or (error.code if isinstance(error, RefusedError) else "no_answer")
            print_json({**result, "ok": False, "reason": reason, "error": text})
        return error.status if isinstance(error, CommandError) else 1
    return print_result(arguments, result | fields, [text])


@contextmanager
def _join_session(arguments: argparse.Namespace) -> Iterator[Client]:
    from iris_session.client import RefusedError

    stops = arguments.act is stop_session
    if stops and _ADDRESS.fullmatch(" ".join(arguments.reason)):
        raise CommandError(f"{arguments.reason[0]} is an address, not a reason: give it with --address")
    for role in arguments.roles:
        with closing(make_client(arguments, role, f"{_get_user_name()} (terminal)")) as client:
            try:
                if stops:
                    _begin_stop(client, " ".join(arguments.reason))
                client.connect()
            except RefusedError as error:
                if error.code != DenialReason.ROLE or role == arguments.roles[-1]:
                    raise
                continue
            yield client
            return


def _begin_stop(client: Client, reason: str) -> None:
    """Send the e-stop with the hello: a session that is slow to admit, or full, stops all the same."""
    from iris_session.client import NotConnectedError

    def try_stop(one: Client) -> bool:
        try:
            one.estop(reason)
        except NotConnectedError:  # no socket yet
            return False
        return True

    client.open()
    client.wait_for(try_stop, TIMEOUT_S)


def _get_user_name() -> str:
    try:
        return getpass.getuser()[:32]
    except (KeyError, OSError):  # a container may have no name for its user
        return "user"


def stop_session(client: Client, arguments: argparse.Namespace) -> Outcome:
    """Wait until the session reports the e-stop that was sent with the hello."""
    from iris_session.client import RequestTimeoutError

    if not client.wait_for(lambda one: one.mirror.estop, TIMEOUT_S):
        raise RequestTimeoutError(
            f"the e-stop was sent, but the session has not confirmed it within {TIMEOUT_S:g} s: "
            "use the emergency stop of the robot"
        )
    given = (("--address", arguments.address), ("--session", arguments.session))
    where = "".join(f" {option} {value}" for option, value in given if value)
    text = f"E-STOP at {client.address}: every robot holds; continue with `iris-session clear-estop{where}`"
    return text, {"estop": True}


def clear_session(client: Client, _: argparse.Namespace) -> Outcome:
    """End the e-stop, and say who had stopped. A stop that came after the list was read stays."""
    if not client.mirror.estop:
        return "there is no e-stop", {"estop": False, "cleared": []}
    stops = client.status().stops
    until_s = time.monotonic() + TIMEOUT_S
    while not stops and time.monotonic() < until_s:  # the status is a moment older than the event
        client.sleep(0.1)
        stops = client.status().stops
    if not stops:
        raise CommandError("the session is stopped, but its status does not say by whom: try again", 1)
    client.clear_estop(max(one.stop_seq for one in stops))
    who = "; ".join(f"{one.name or 'a connection without a name'}: {one.reason or 'no reason given'}" for one in stops)
    cleared = [{"stop_seq": one.stop_seq, "name": one.name, "reason": one.reason} for one in stops]
    text = f"e-stop cleared ({who}): robots move when they are clutched again"
    return text, {"estop": False, "cleared": cleared}


def control_physics(client: Client, arguments: argparse.Namespace) -> Outcome:
    """Pause, resume or reset."""
    client.control(arguments.command)
    text = {"pause": "paused", "resume": "running", "reset": "reset to the initial state"}[arguments.command]
    if client.mirror.estop:
        text += "; the e-stop is still active: clear-estop"
    return text, {"action": arguments.command}


def assign_robots(client: Client, arguments: argparse.Namespace) -> Outcome:
    """Give robots to a participant."""
    person = find_participant(client, arguments.person).id
    robots = _split_names([arguments.robots])
    leases = client.assign(robots, person)
    text = f"{', '.join(robots)} -> {client.mirror.participants[person].name} ({person})"
    return text, {"participant": person, "robots": [lease.target for lease in leases] or robots}


def rename_participant(client: Client, arguments: argparse.Namespace) -> Outcome:
    """Give a participant another name."""
    person = find_participant(client, arguments.person).id
    before = client.mirror.participants[person].name
    client.request(Rename(0, person, arguments.name))
    client.wait_for(lambda one: _find_name(one, person) != before, 0.5)  # it comes with the reply, if it changed
    name = _find_name(client, person)
    return f"{person}: {before} is now {name}", {"participant": person, "name": name}


def _find_name(client: Client, person: str) -> str:
    info = client.mirror.participants.get(person)
    return "" if info is None else info.name


def set_role(client: Client, arguments: argparse.Namespace) -> Outcome:
    """Give a participant another role."""
    person = find_participant(client, arguments.person).id
    client.request(SetRole(0, person, arguments.role))
    name = _find_name(client, person)
    return f"{name} ({person}) is now {arguments.role}", {"participant": person, "role": arguments.role}


def release_robots(client: Client, arguments: argparse.Namespace) -> Outcome:
    """Free robots."""
    robots = _split_names(arguments.robots)
    client.assign(robots)
    return f"{', '.join(robots)}: free", {"robots": robots}


def _split_names(words: Sequence[str]) -> list[str]:
    """Return the names of words that may hold several, separated by commas."""
    return [name.strip() for word in words for name in word.split(",") if name.strip()]


def set_modes(client: Client, arguments: argparse.Namespace) -> Outcome:
    """Change the lease mode of robots."""
    robots = _split_names(arguments.robots) or sorted(client.mirror.robots)
    for robot in robots:
        client.set_mode(robot, arguments.mode)
    return f"{', '.join(robots)}: mode {arguments.mode}", {"robots": robots, "mode": arguments.mode}


def control_episode(client: Client, arguments: argparse.Namespace) -> Outcome:
    """Start, end, discard, repeat or take over an episode."""
    action = arguments.action
    if action == EpisodeAction.RESET:
        client.episode(action)
        return "scene reset, no episode runs", {"action": action}
    if action == EpisodeAction.START:
        episode = client.start_episode(arguments.label, countdown_s=arguments.countdown)
    elif action in (EpisodeAction.DISCARD, EpisodeAction.RERECORD):
        episode = client.discard_episode(again=action == EpisodeAction.RERECORD)
    elif action == EpisodeAction.TAKE_OVER:
        episode = client.take_over_episode()
    else:
        stops = action == EpisodeAction.STOP
        episode = client.stop_episode() if stops else client.end_episode(action, arguments.label)
    fields = {"action": action, **msgspec.structs.asdict(episode)}
    count = f", {episode.successes} of {episode.wanted}" if episode.wanted else ""
    return f"episode {episode.number}: {episode.state}{count}", fields


def place_marker(client: Client, arguments: argparse.Namespace) -> Outcome:
    """Put a note into the recording."""
    text = " ".join(arguments.text)
    client.marker(text)
    return f"noted: {text}", {"text": text}
