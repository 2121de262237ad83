"""`iris-session keys`: who may join the sessions of this user, and the fingerprints to compare."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from iris_session.cli.common import CommandError, add_json_option, print_json
from iris_session.cli.pair import add_role_option, parse_roles


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "keys",
        help="list, allow and revoke the keys that may join",
        description="The keys that may join encrypted sessions of this user, and the user's own. Sessions that run "
        "take over every change within half a second: a revoked key loses control and picture at once.",
        epilog="examples:\n"
        "  iris-session keys list\n"
        "  iris-session keys revoke quest-3\n"
        "  iris-session keys allow ann ann.key --role operator    a key that came by another way than a join code\n"
        "  iris-session keys allow me                             this user, on the machine that serves\n"
        "  iris-session keys show                                 fingerprints of this user",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    one = actions.add_parser("list", help="keys that may join", description="Lists the keys that may join.")
    add_json_option(one)
    one.set_defaults(run=run_list)
    one = actions.add_parser("allow", help="let a key in", description="Puts a key on the list, or changes its roles.")
    one.add_argument("name", help="under which it is listed")
    one.add_argument(
        "key",
        nargs="?",
        default="",
        help="ZeroMQ certificate (*.key), or the public key itself: 40 characters of Z85 (default: this user's own)",
    )
    add_role_option(one)
    one.set_defaults(run=run_allow)
    one = actions.add_parser(
        "revoke", help="let a key in no more", description="Takes a key off the list; whoever uses it now is out."
    )
    one.add_argument("name", help="name or fingerprint in the list")
    one.set_defaults(run=run_revoke)
    one = actions.add_parser("show", help="own fingerprints", description="Shows where keys are, and whose they are.")
    add_json_option(one)
    one.set_defaults(run=run_show)
    one = actions.add_parser(
        "forget", help="trust an address anew", description="Forgets the key that was stored for a session's address."
    )
    one.add_argument("address", help="HOST:PORT as it was joined")
    one.set_defaults(run=run_forget)


def run_list(arguments: argparse.Namespace) -> int:
    from iris_session.security import KeyHome

    keys = KeyHome().clients.read()
    if arguments.json:
        rows = [
            {
                "name": one.name,
                "fingerprint": mark,
                "key": one.key,
                "roles": list(one.roles),
                "added": one.added,
                "last_seen": one.last_seen,
            }
            for mark, one in keys.items()
        ]
        print_json({"keys": rows})
        return 0
    if not keys:
        print("nobody may join yet: `iris-session pair` lets a new device in")
    width = max((len(one.name) for one in keys.values()), default=0)
    for mark, one in keys.items():
        roles, seen = ", ".join(one.roles) or "any role", one.last_seen or "never"
        print(f"{one.name:{width}}  {mark}  {roles}  added {one.added or 'by hand'}  last here {seen}")
    return 0


def run_allow(arguments: argparse.Namespace) -> int:
    from iris_session.security import KeyHome, load_public

    home = KeyHome()
    given = arguments.key or home.load_identity().public
    key = load_public(given) if _is_key_file(given) else given
    entry = home.clients.allow_key(arguments.name, key, parse_roles(arguments.role))
    print(f"{entry.name} may join ({entry.fingerprint}) as {', '.join(entry.roles) or 'anything'}")
    return 0


def _is_key_file(text: str) -> bool:
    return os.path.exists(text) or Path(text).suffix in (".key", ".key_secret")


def run_revoke(arguments: argparse.Namespace) -> int:
    from iris_session.security import KeyHome

    clients = KeyHome().clients
    entry = clients.revoke_key(arguments.name)
    if entry is None:
        names = ", ".join(one.name for one in clients.read().values()) or "nobody"
        raise CommandError(f"no key {arguments.name!r} on the list, there are: {names}")
    print(f"{entry.name} may not join any more ({entry.fingerprint})")
    return 0


def run_show(arguments: argparse.Namespace) -> int:
    from iris_session.security import KeyHome

    home = KeyHome()
    server, own = home.load_server_key(), home.load_identity()
    if arguments.json:
        print_json(
            {
                "home": str(home.path),
                "server": {"key": server.public, "fingerprint": server.fingerprint},
                "identity": {"key": own.public, "fingerprint": own.fingerprint},
            }
        )
        return 0
    print(f"home of keys      {home.path}")
    print(f"sessions you run  {server.fingerprint}    public key {server.public}")
    print(f"you as a client   {own.fingerprint}    public key {own.public}")
    return 0


def run_forget(arguments: argparse.Namespace) -> int:
    from iris_session.security import KeyHome

    servers = KeyHome().known_servers
    gone = servers.remove(arguments.address)
    if gone is None:
        known = ", ".join(one.address for one in servers.read()) or "none"
        raise CommandError(f"no key is stored for {arguments.address!r}, stored are: {known}")
    print(f"the key of {gone.address} ({gone.fingerprint}) is forgotten")
    return 0
