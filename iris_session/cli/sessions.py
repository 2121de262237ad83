"""`iris-session sessions`: list the sessions on this network."""

from __future__ import annotations

import argparse

from iris_session.cli.common import add_command, add_json_option, parse_seconds, pick_attributes, print_result


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command `sessions`."""
    parser = add_command(
        commands,
        "sessions",
        run,
        help="list the sessions on this network",
        description="List the sessions that announce themselves on the networks of this machine. If an access point "
        "blocks broadcasts, none is heard: type the address of the session, or scan the code of `iris-session pair`.",
        examples="""
            iris-session sessions
            iris-session sessions --seconds 3 --json
        """,
    )
    parser.add_argument("--seconds", type=parse_seconds, default=1.0, help="listen this long (default: %(default)g)")
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Listen for beacons and print the sessions. Exit status 1 if none was heard."""
    from iris_session.client import find_sessions
    from iris_session.client.server_trust import known_fingerprints

    known = known_fingerprints()
    found = find_sessions(arguments.seconds)
    names = ("name", "address", "addresses", "session_id", "kind", "key_fingerprint")
    marks = [{"encrypted": bool(one.key_fingerprint), "known": one.key_fingerprint in known} for one in found]
    rows = [pick_attributes(one, *names) | mark for one, mark in zip(found, marks, strict=True)]
    lines = [f"{row['name']:<24} {row['address']:<24} {row['kind']:<8} {_format_key(row)}" for row in rows]
    none = "no session was heard: type the address of a session, or scan its code (docs/network.md)"
    print_result(arguments, {"ok": bool(rows), "sessions": rows}, lines or [none])
    return 0 if rows else 1


def _format_key(row: dict[str, object]) -> str:
    if not row["encrypted"]:
        return "not encrypted: this machine only"
    return f"key {row['key_fingerprint']}{'' if row['known'] else ' (new: join with --code)'}"
