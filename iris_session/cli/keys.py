"""`iris-session keys`: the allow-list of this user's sessions, and fingerprints to compare."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from iris_session.cli.common import CommandError, Commands, add_actions, add_command, pick_attributes, print_result
from iris_session.cli.pair import add_role_option, parse_roles
from iris_session.protocol.names import Role
from iris_session.security.allow_list import CURVE

if TYPE_CHECKING:
    from iris_session.security import KeyPair


def register(commands: Commands) -> None:
    actions = add_actions(
        commands,
        "keys",
        help="list, allow and revoke the keys that may join",
        description="Manage the keys that may join encrypted sessions of this user, and show the user's own keys. "
        "Running sessions apply changes within half a second: a revoked key is disconnected at once.",
    )
    add_command(actions, "list", run_list, help="list the keys that may join", examples="iris-session keys list --json")
    one = add_command(
        actions,
        "allow",
        run_allow,
        has_json=False,
        help="allow a key",
        description="Add a key to the list, or change its roles. Without a key: this user's own, to direct too.",
        examples="""
            iris-session keys allow ann ann.key --role operator
            iris-session keys allow me --role any
        """,
    )
    one.add_argument("name", help="name of the key in the list")
    text = "ZeroMQ certificate (*.key), or the public key as 40 characters of Z85 (default: this user's own)"
    one.add_argument("key", nargs="?", default="", help=text)
    add_role_option(one)
    one = add_command(
        actions,
        "revoke",
        run_revoke,
        has_json=False,
        help="revoke a key",
        description="Remove a key from the list; participants who use it are disconnected.",
        examples="iris-session keys revoke quest-3",
    )
    one.add_argument("name", help="name or fingerprint in the list")
    add_command(
        actions,
        "show",
        run_show,
        help="show the folder of keys, and the user's own keys",
        examples="iris-session keys show",
    )
    one = add_command(
        actions,
        "forget",
        run_forget,
        has_json=False,
        help="forget the key of a server",
        description="Remove the stored key of a session's address, so that a new key can be trusted.",
        examples="iris-session keys forget 192.168.1.20:7721",
    )
    one.add_argument("address", help="HOST:PORT as used to join")


def run_list(arguments: argparse.Namespace) -> int:
    """Print the allow-list."""
    from iris_session.security import KeyHome

    keys = KeyHome().clients.read()
    names = ("name", "key", "roles", "kind", "added", "last_seen")
    rows = [{"fingerprint": mark, **pick_attributes(one, *names)} for mark, one in keys.items()]
    width = max((len(one.name) for one in keys.values()), default=0)
    lines = [
        f"{one.name:{width}}  {mark}  {'' if one.kind == CURVE else f'{one.kind}  '}"
        f"{', '.join(one.roles) or 'any role'}  added {one.added or 'manually'}  last seen {one.last_seen or 'never'}"
        for mark, one in keys.items()
    ]
    return print_result(
        arguments, {"keys": rows}, lines or ["no keys are allowed yet: `iris-session pair` adds a new device"]
    )


def run_allow(arguments: argparse.Namespace) -> int:
    """Add a key to the allow-list."""
    from iris_session.security import KeyHome, load_public

    home = KeyHome()
    given = arguments.key or home.load_identity().public
    is_file = os.path.exists(given) or Path(given).suffix in (".key", ".key_secret")
    key = load_public(given) if is_file else given
    roles = parse_roles(arguments.role)
    if not arguments.key and arguments.role is None:
        roles = (*roles, Role.DIRECTOR)  # a user who can write this list can take every role anyway
    entry = home.clients.allow_key(arguments.name, key, roles)
    print(f"{entry.name} may join ({entry.fingerprint}) as {', '.join(entry.roles) or 'any role'}")
    return 0


def run_revoke(arguments: argparse.Namespace) -> int:
    """Remove a key from the allow-list."""
    from iris_session.security import KeyHome

    clients = KeyHome().clients
    entry = clients.revoke_key(arguments.name)
    if entry is None:
        names = ", ".join(one.name for one in clients.read().values()) or "none"
        raise CommandError(f"no key {arguments.name!r} on the list; listed: {names}")
    print(f"{entry.name} is revoked ({entry.fingerprint})")
    return 0


def run_show(arguments: argparse.Namespace) -> int:
    """Print the user's own keys, without secrets. Creates none."""
    from iris_session.security import KeyHome
    from iris_session.web.certificate import find_certificate

    home = KeyHome()
    server, own, page = home.find_server_key(), home.find_identity(), find_certificate(home)
    certificate = None if page is None else {"fingerprint": page.fingerprint, "key": page.key}
    keys = {"server": _key_to_dict(server), "identity": _key_to_dict(own), "certificate": certificate}
    text = "no certificate yet, created when you serve an encrypted session"
    if page is not None:
        text = f"certificate {page.fingerprint}    for {', '.join(page.names)}"
    lines = [
        f"folder of keys    {home.path}",
        f"your sessions     {_format_key(server, 'created when you serve an encrypted session')}",
        f"you as a client   {_format_key(own, 'created when you join an encrypted session')}",
        f"page for browsers {text}",
    ]
    return print_result(arguments, {"home": str(home.path), **keys}, lines)


def _key_to_dict(pair: KeyPair | None) -> dict[str, str] | None:
    return None if pair is None else {"key": pair.public, "fingerprint": pair.fingerprint}


def _format_key(pair: KeyPair | None, when: str) -> str:
    return f"no key yet, {when}" if pair is None else f"{pair.fingerprint}    public key {pair.public}"


def run_forget(arguments: argparse.Namespace) -> int:
    """Remove the stored key of a server."""
    from iris_session.security import KeyHome

    servers = KeyHome().known_servers
    removed = servers.remove(arguments.address)
    if removed is None:
        known = ", ".join(one.address for one in servers.read()) or "none"
        raise CommandError(f"no key is stored for {arguments.address!r}; stored: {known}")
    print(f"the key of {removed.address} ({removed.fingerprint}) is removed")
    return 0
