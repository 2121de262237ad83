"""`iris-session doctor`: find out what is wrong, why, and what to do, on a client's machine or on the server's."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Final

from iris_session.cli.common import Commands, add_address_options, add_command, print_result
from iris_session.protocol.names import Role

if TYPE_CHECKING:
    from iris_session.doctor.findings import Finding

PROBLEM_STATES: Final = ("failed", "warning", "skipped")
MARKS: Final = {"ok": "ok     ", "warning": "WARNING", "failed": "FAILED ", "skipped": "-      "}


def register(commands: Commands) -> None:
    parser = add_command(
        commands,
        "doctor",
        run,
        help="what is wrong, why, and what to do",
        description="Check the route to a session, keys and joining, and the status of the session, one check after "
        "the other. Exit status 1 if a check failed. It joins for two seconds, as an observer.",
        examples="""
            iris-session doctor                      the session on this machine
            iris-session doctor 192.168.1.20         from a client's machine
            iris-session doctor --session lab-1 --code 7KQ2-M4XD-9PTR
            iris-session doctor --server             the machine that serves, or will serve
        """,
    )
    add_address_options(parser, code="a join code to try; it is used up")
    parser.add_argument("--role", choices=sorted(Role.ALL), default=Role.OBSERVER, help="role to try (%(default)s)")
    parser.add_argument("--server", action="store_true", help="check this machine as a server")
    parser.add_argument("--identity", default="", metavar="DIR", help="folder of keys (default: as for every command)")
    text = "--server: folder of recordings"
    parser.add_argument("--record", type=Path, default=Path("sessions"), metavar="DIR", help=text)
    parser.add_argument("--all", action="store_true", help="also print skipped checks")


def run(arguments: argparse.Namespace) -> int:
    """Run the checks and print one screen, or one JSON object. Exit status 1 if a check failed."""
    from iris_session.doctor.runner import DoctorReport, run_checks, run_host_checks

    if arguments.identity:
        os.environ["IRIS_HOME"] = arguments.identity

    def show_progress(what: str) -> None:
        if sys.stderr.isatty() and not arguments.json:
            print(f"... {what}", file=sys.stderr, flush=True)

    result: DoctorReport
    if arguments.server:
        result = run_host_checks(arguments.address, arguments.record, on_progress=show_progress)
    else:
        result = run_checks(
            arguments.address,
            session=arguments.session,
            code=arguments.code,
            role=arguments.role,
            on_progress=show_progress,
        )
    lines = [*format_findings(result.findings, show_skipped=arguments.all), format_verdict(result.findings)]
    return print_result(arguments, result.as_dict(), lines, ok=result.ok)


def format_findings(findings: Iterable[Finding], *, show_skipped: bool = False) -> Iterator[str]:
    """Yield one line per check, with cause and advice below warnings and failures."""
    for one in findings:
        if one.state == "skipped" and not show_skipped:
            continue
        yield f"{MARKS[one.state]} {one.check:12s} {one.text}"
        if one.state in ("warning", "failed"):
            yield from (f"{'':20s} {label}: {text}" for label, text in (("why", one.why), ("do", one.advice)) if text)


def format_verdict(findings: Iterable[Finding]) -> str:
    """Return the last line: which checks to read above."""
    failed, warned, skipped = ([one.check for one in findings if one.state == state] for state in PROBLEM_STATES)
    warnings = f"warnings: {', '.join(warned)}" if warned else ""
    if failed:
        left = f"{len(skipped)} skipped" if skipped else ""
        return "; ".join(text for text in (f"FAILED: {', '.join(failed)}", warnings, left) if text)
    return f"nothing failed; {warnings}" if warned else "all well"
