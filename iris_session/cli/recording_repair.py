"""`iris-session recording repair`: everything that can be read of a damaged recording, in a new file."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Final

from iris_session.cli.common import CommandError, add_json_option, ending_as_interrupts, print_json, to_printable
from iris_session.cli.progress import ReadingProgress

if TYPE_CHECKING:
    from iris_session.recording.repair import RepairReport

#: Lines about damage that are printed; `--json` has all.
MOST_LINES: Final = 20


def register(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `repair`."""
    repair = actions.add_parser(
        "repair",
        help="everything that can be read of a damaged recording, in a new file",
        description="Write everything that can be read of a recording, its parts included, into one new file that "
        "Rerun's viewer opens at once, and say what is lost. The recording itself is not changed. Exit status 1 if "
        "something inside is damaged or missing, as with `inspect`; 2 if nothing could be written.",
        epilog="examples:\n"
        "  iris-session recording repair sessions/20261121T093000.000000Z-handover -o repaired.rrd\n"
        "  iris-session recording repair session.rrd -o repaired.rrd --force --json",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    repair.add_argument("path", type=Path, metavar="RECORDING", help="a .rrd, or the folder of one session")
    repair.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="the file to write")
    repair.add_argument("--force", action="store_true", help="replace FILE if it exists")
    add_json_option(repair)
    repair.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Repair a recording, and print what is in the new file and what is lost."""
    import msgspec

    from iris_session.recording.repair import repair

    path: Path = arguments.path
    if not path.exists():
        raise CommandError(f"{path} does not exist: give a recording (session.rrd), or its folder")
    with ending_as_interrupts(), ReadingProgress(path) as progress:
        report = repair(path, arguments.out, overwrite=arguments.force, progress=progress.show_bytes)
    if arguments.json:
        print_json(msgspec.to_builtins(report))
    else:
        print("\n".join(map(to_printable, format_report(report))))
    return 0 if report.ok else 1


def format_report(report: RepairReport) -> list[str]:
    """Return a report as lines."""
    lines = [
        f"{report.output}: {report.steps:,} steps, {report.duration_s:.1f} s, {report.bytes / 1e6:.1f} MB, of "
        f"{', '.join(report.files)}"
    ]
    lost = []
    if report.lost_bytes:
        lost.append(f"{report.lost_bytes:,} bytes that cannot be read")
    if report.lost_steps:
        span = f" in {report.lost_s:.2f} s" if report.lost_s else ""
        lost.append(f"{report.lost_steps:,} steps{span}")
    if not report.finished:
        lost.append("what may have followed the last step: the recording was not closed")
    lines.append(f"  lost    {'; '.join(lost) or 'nothing'}")
    found = (*report.damage, *report.cuts, *report.notes)
    lines += [f"  {'found' if i == 0 else '':7s} {line}" for i, line in enumerate(found[:MOST_LINES])]
    if len(found) > MOST_LINES:
        lines.append(f"  {'':7s} and {len(found) - MOST_LINES} more: --json has all")
    return lines
