"""`iris-session pair`: create a join code, show it as a QR code, and wait until a device has used it."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.cli.common import (
    ABOVE_0,
    CommandError,
    Commands,
    add_command,
    make_number_type,
    parse_port,
    print_error,
    print_json,
    print_result,
    writing,
)
from iris_session.protocol.names import Role
from iris_session.security.allow_list import DEFAULT_ROLES
from iris_session.security.private_folder import KeysBusyError
from iris_session.system.files import write_atomic

if TYPE_CHECKING:
    from iris_session.security import JoinCode, KeyHome, KeyPair, RegisteredSession
    from iris_session.web.certificate import Certificate

ANY_ROLE: Final = "any"
POLL_S: Final = 0.2
MAX_MINUTES: Final = 24 * 60.0
#: Format of the file of `--unity`, read by `unity_client/Runtime/Core/PairingFile.cs`.
PAIRING_FILE_FORMAT: Final = 1
#: Text by reason why no device has paired.
FAILURE_TEXTS: Final = {
    "void": "void after five wrong attempts: create another code",
    "expired": "expired: the code was not used",
    "not_listed": "used, but the key is not on the list: see the session's terminal, and create another code",
}


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "pair",
        run,
        help="pair a new device with the session on this machine",
        description="Create a join code for one new device and show it, with address and key of the session, as a QR "
        "code. It is valid for ten minutes, one device, and five wrong attempts. Waits until it is used; Ctrl-C "
        "makes it void.",
        examples="""
            iris-session pair                               scan the code, or type it
            iris-session pair --role director --name ann    a key that may direct
            iris-session pair --web                         a link for a browser, as a QR code
            iris-session pair --web --role observer         a browser that may look only
            iris-session pair --png code.png --no-wait      to show on another screen
            iris-session pair --unity pairing.json --no-wait    a file to copy to one headset
            iris-session pair --address 10.0.0.5:7721       address at which others reach this machine
        """,
    )
    add_role_option(parser)
    wanted = f"a time: give more than 0 and at most {MAX_MINUTES:g} minutes"
    minutes = make_number_type(float, wanted, ABOVE_0, MAX_MINUTES)
    parser.add_argument("--minutes", type=minutes, default=10.0, metavar="M", help="validity in minutes (10)")
    parser.add_argument("--name", default="", help="name of the device in the list (default: as the device sends it)")
    parser.add_argument("--session", default="", metavar="NAME", help="which session, if several run on this machine")
    parser.add_argument("--address", default="", metavar="HOST[:PORT]", help="where others reach the session")
    parser.add_argument("--curve-key", default="", metavar="FILE", help="secret key of the session (default: yours)")
    parser.add_argument("--web", action="store_true", help="show a link to the page for browsers as the QR code")
    text = (
        "write addresses, key of the certificate and code as JSON, which the headset apps read at start; secret "
        "until the code is used"
    )
    parser.add_argument("--unity", type=Path, metavar="FILE", help=text)
    parser.add_argument("--web-port", type=parse_port, metavar="PORT", help="port of the page (default: it is found)")
    parser.add_argument("--png", type=Path, metavar="FILE", help="also write the QR code as an image")
    parser.add_argument("--web-cert", default="", metavar="FILE", help="certificate of the page (default: yours)")
    parser.add_argument("--no-wait", action="store_true", help="do not wait until the code is used")


def add_role_option(parser: argparse.ArgumentParser) -> None:
    """Add `--role`, for `pair` and `keys allow`."""
    text = f"role of the key, repeatable (default: {', '.join(DEFAULT_ROLES)}); {ANY_ROLE}: every role"
    parser.add_argument("--role", action="append", choices=[*sorted(Role.ALL), ANY_ROLE], metavar="ROLE", help=text)


def parse_roles(names: list[str] | None) -> tuple[str, ...]:
    """Return the roles for the allow-list: empty for any role."""
    return DEFAULT_ROLES if names is None else () if ANY_ROLE in names else tuple(names)


def run(arguments: argparse.Namespace) -> int:
    """Create a code, print it, and wait. Exit status 1 if the code was not used."""
    from iris_session.client.discovery import pairing_uri
    from iris_session.link.discovery import host_port
    from iris_session.security import KeyHome, load_secret
    from iris_session.web.config import format_page_address

    home = KeyHome()
    key = load_secret(arguments.curve_key) if arguments.curve_key else home.load_server_key()
    session, places, web = _find_addresses(arguments, home, key)
    roles = parse_roles(arguments.role)
    certificate = _find_certificate(arguments, home, [host for host, _ in places])
    code, made = home.join_codes.create(
        key,
        minutes=arguments.minutes,
        roles=roles,
        name=arguments.name,
        web_key=b"" if certificate is None else certificate.spki_hash,
    )
    try:
        uri = pairing_uri(*places[0], key.public, code, session)
        page = ""
        if certificate is not None and web:  # what follows the `#` is not sent to the server
            page = f"{format_page_address(places[0][0], web, secure=True)}#c={code}"
        invitation = {
            "code": code,
            "uri": uri,
            "session": session,
            "addresses": [host_port(*place) for place in places],
            "fingerprint": key.fingerprint,
            "roles": list(roles),
            "expires": made.expires,
            "page": page,
            "certificate": "" if certificate is None else certificate.fingerprint,
        }
        if arguments.unity is not None:
            assert certificate is not None, "made or loaded for --unity"
            _write_pairing_file(arguments.unity, certificate, [host for host, _ in places], web, invitation)
            invitation["file"] = str(arguments.unity)
        _print_invitation(arguments, invitation)
        return 0 if arguments.no_wait else _wait_until_used(home, made, arguments)
    except BaseException:
        home.join_codes.cancel(made.id)  # no process waits for the code any more
        raise


def _needs_web(arguments: argparse.Namespace) -> bool:
    return bool(arguments.web) or arguments.unity is not None


def _write_pairing_file(
    path: Path, certificate: Certificate, hosts: list[str], web: int, invitation: dict[str, Any]
) -> None:
    """Write what a headset app needs to pair by itself: only this user may read it."""
    from iris_session.link.config import is_loopback
    from iris_session.web.config import format_page_address

    pairing = {
        "format": PAIRING_FILE_FORMAT,
        "session": invitation["session"],
        "addresses": [format_page_address(host, web, secure=True) for host in hosts],
        "pin": certificate.key,
        "code": invitation["code"],
        "expires": invitation["expires"],
    }
    with writing(path):
        write_atomic(path, json.dumps(pairing, indent=2).encode() + b"\n", permissions=0o600)
    if all(is_loopback(host) for host in hosts):
        print_error(
            f"{hosts[0]} is this machine alone: a headset reaches it only by cable, after `adb reverse tcp:{web} "
            f"tcp:{web}`; serve with --interface for others"
        )


def _find_certificate(arguments: argparse.Namespace, home: KeyHome, hosts: list[str]) -> Certificate | None:
    """Return the certificate of the page: the code works there too. Made where `--web` or `--unity` needs it."""
    from iris_session.web.certificate import find_certificate, load_certificate, load_or_make_certificate

    if arguments.web_cert:
        return load_certificate(arguments.web_cert)
    return load_or_make_certificate(home, hosts) if _needs_web(arguments) else find_certificate(home)


def _find_addresses(
    arguments: argparse.Namespace, home: KeyHome, key: KeyPair
) -> tuple[str, list[tuple[str, int]], int]:
    """Return the session's name, hosts and ports at which others reach it, best first, and the page's port or 0."""
    from iris_session.client.discovery import Address
    from iris_session.web.config import WEB_FROM_CONTROL

    here = [note for note in home.sessions.read() if note.server == key.fingerprint]
    found = [note for note in here if arguments.session in ("", note.name)]
    if arguments.address:
        address = Address.parse(arguments.address)
        name, places = arguments.session, [(address.host, address.port)]
        found = [note for note in found if note.control == address.port]
    elif len(found) == 1:
        name, places = found[0].name, [(host, found[0].control) for host in found[0].hosts]
    else:
        raise CommandError(_format_session_choice(arguments.session, here, found))
    note = found[0] if found else None
    control = places[0][1]
    web = int(arguments.web_port or (control + WEB_FROM_CONTROL if note is None else note.web))
    if not _needs_web(arguments):
        pass
    elif note is None and arguments.web_port is None:
        print_error(
            f"no session with control port {control} runs here, so the page is assumed at port {web}: give --web-port "
            "if it has another one"
        )
    elif note is not None and not web:
        raise CommandError(
            f"session {note.name!r} serves no page: pip install 'iris-session[web]' there, or leave out --no-web"
        )
    elif note is not None and note.web not in (0, web):
        print_error(f"session {note.name!r} serves its page at port {note.web}, not {web}")
    return name, places, web


def _format_session_choice(name: str, here: list[RegisteredSession], found: list[RegisteredSession]) -> str:
    if not here:
        return (
            "no encrypted session of yours runs on this machine: start one with `iris-session serve SCENE "
            "--interface NAME`, or give its address with --address HOST:PORT"
        )
    names = ", ".join(sorted(note.name for note in here))
    if not found:
        return f"no session {name!r} runs here; running: {names}"
    return f"{len(found)} sessions run here ({names}): choose with --session NAME or --address HOST:PORT"


def _print_invitation(arguments: argparse.Namespace, invitation: dict[str, Any]) -> None:
    import segno

    qr = segno.make(invitation["page"] if arguments.web else invitation["uri"], micro=False, error="m")
    if arguments.png is not None:
        with writing(arguments.png):
            qr.save(str(arguments.png), kind="png", scale=10, border=4)
    if arguments.json:
        print_json(invitation)
        return
    qr.terminal(out=sys.stdout, compact=True)
    print(f"join code    {invitation['code']}    for {arguments.minutes:g} minutes, one device")
    print(f"address      {'  or  '.join(invitation['addresses'])}")
    print(f"fingerprint  {invitation['fingerprint']}")
    print(f"roles        {', '.join(invitation['roles']) or 'any'}")
    if arguments.unity is not None:
        print(f"file         {arguments.unity}    written; copy it to one headset before the code expires")
    if invitation["page"]:
        print(f"in a browser {invitation['page']}")
        print(f"certificate  {invitation['certificate']}    compare it when a browser warns or a headset shows it")
    print(f"from Python  Client({invitation['addresses'][0]!r}, join_code={invitation['code']!r})")
    print(f"or           {invitation['uri']}", flush=True)


def _wait_until_used(home: KeyHome, made: JoinCode, arguments: argparse.Namespace) -> int:
    """Wait until the code is used, void or expired, and print the outcome."""
    seen: object = None
    while True:
        if home.join_codes.signature != seen:
            seen = home.join_codes.signature
            try:
                with home.folder.lock():  # held from the use of a code until the key is on the list
                    now = home.join_codes.find_code(made.id)
            except KeysBusyError:  # another process holds the lock, on a slow disk: the code is still valid
                seen, now = None, made
            if now is None or now.paired or not now.is_open(time.time()):
                break
        if time.time() >= made.expires:
            now = made
            break
        time.sleep(POLL_S)
    entry = None if now is None else now.paired
    if entry is not None and entry.fingerprint in home.clients.read():
        result = {"paired": entry.name, "fingerprint": entry.fingerprint, "roles": entry.roles}
        return print_result(arguments, result, [f"paired: {entry.name} ({entry.fingerprint})"])
    reason = "expired"
    if now is not None and now.attempts_left == 0:
        reason = "void"
    elif now is not None and (entry is not None or (not now.secret and time.time() < now.expires)):
        reason = "not_listed"
    return print_result(arguments, {"paired": None, "reason": reason}, [FAILURE_TEXTS[reason]], ok=False)
