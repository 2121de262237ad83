"""`iris-session verify`: re-simulate recordings and compare every step bit for bit."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path

from iris_session.cli.common import (
    CommandError,
    add_command,
    add_json_option,
    ending_as_interrupts,
    print_error,
    print_json,
    to_printable,
)
from iris_session.cli.progress import ReadingProgress


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command `verify`."""
    parser = add_command(
        commands,
        "verify",
        run,
        help="re-simulate a recording and compare it bit for bit",
        description="Re-simulate recordings. Exit status 0 only if every step of every file is identical.",
        examples="""
            iris-session verify sessions/*/session.rrd
            iris-session verify sessions             every recording in a folder and below it
        """,
    )
    parser.add_argument(
        "files", nargs="+", type=Path, metavar="RECORDING", help="a .rrd, or a folder with recordings below it"
    )
    add_json_option(parser)


def run(arguments: argparse.Namespace) -> int:
    """Verify each file; the first problem of each is named with its step and entry."""
    from iris_session.recording import Problem, RecordingError, VerifyReport
    from iris_session.system.extras import require_package

    require_package("rerun", "verifying recordings")
    from iris_session.session.verification import verify_recording

    reports: list[VerifyReport] = []

    def refuse(path: str, why: str) -> None:  # must not hide the others
        reports.append(VerifyReport(path, problems=[Problem(-1, "unreadable", "file", why)]))
        print_error(why)

    for path in list_files(arguments.files, lambda error: refuse(str(error.filename), str(error))):
        try:
            with ending_as_interrupts(), ReadingProgress(path) as progress:
                report = verify_recording(path, progress.show_steps)
        except RecordingError as error:
            refuse(str(path), str(error))
            continue
        if not arguments.json:
            print(to_printable(f"{path}: {report.line()}"))
        reports.append(report)
    ok = all(report.ok for report in reports)
    if arguments.json:
        print_json({"ok": ok, "files": [report.as_dict() for report in reports]})
    unreadable = all(p.kind == "unreadable" and p.step < 0 for report in reports for p in report.problems)
    return 0 if ok else 2 if unreadable else 1


def list_files(given: Sequence[Path], on_error: Callable[[OSError], None]) -> list[Path]:
    """Return the recordings to verify: in place of a folder, all in and below it.

    `on_error`: called for every folder that cannot be read.

    Raises:
        CommandError: There is none in a folder.
    """
    from iris_session.recording.folders import find_recordings

    files: list[Path] = []
    for path in given:
        found = find_recordings(path, on_error) if path.is_dir() else [path]
        if not found:
            raise CommandError(f"there is no recording below the folder {path}: give a .rrd that `serve` wrote")
        files += found
    return files
