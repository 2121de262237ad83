"""`iris-session recording episodes`: episodes of recordings with their numbers, and decisions about them."""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.cli.common import (
    CommandError,
    Commands,
    add_command,
    add_json_option,
    ending_as_interrupts,
    parse_free_port,
    pick_attributes,
    print_error,
    print_json,
    to_printable,
)
from iris_session.cli.progress import PROGRESS_AFTER_S, ProgressLine
from iris_session.cli.recording_dataset import DEFAULT_SIZE
from iris_session.cli.recording_render import parse_size

if TYPE_CHECKING:
    from iris_session.dataset.curation import Edits
    from iris_session.dataset.listing import ListedEpisode, ListedRecording

#: Columns of a terminal that is not one, and of a wide one.
WIDTH: Final = 100
_EDITS: Final = ("drop", "keep", "trim", "label", "task", "reset")


def register(actions: Commands) -> None:
    parser = add_command(
        actions,
        "episodes",
        run,
        has_json=False,
        help="list the episodes of recordings with their numbers, and choose those that are exported",
        description="List the episodes of recordings: verdict, length, people, handovers, share of time in which no "
        "robot was engaged, clutches, rejected samples, path of each end effector, least distance of two, "
        "interventions. Decisions about them are written beside the recording, which is never changed, and `export` "
        "follows them. Nothing is simulated again without --verify. Exit status 1 if something is damaged, or "
        "recordings do not fit into one data set.",
        examples="""
            iris-session recording episodes sessions
            iris-session recording episodes sessions --page                        in a browser, with film strips
            iris-session recording episodes sessions --cameras operator,wrist      how long grippers are not seen
            iris-session recording episodes session.rrd --drop 4 --trim 3=1.2:8.5 --label 5=success
            iris-session recording episodes session.rrd --task "Hand over the hammer." --task "2=Put it down."
            iris-session recording episodes session.rrd --reset 4,5                or --reset all
        """,
    )
    parser.add_argument("paths", type=Path, nargs="+", metavar="RECORDING", help="recordings, and folders with some")
    parser.add_argument("--cameras", metavar="LIST", help="as of `export`: share of time with a gripper out of view")
    parser.add_argument("--size", type=parse_size, metavar="WxH", help="of their pictures (default: 640x480)")
    parser.add_argument("--verify", action="store_true", help="simulate every recording again, and mark what differs")
    output = parser.add_mutually_exclusive_group()
    add_json_option(output)
    output.add_argument("--csv", action="store_true", help="print a table with all numbers, one line an episode")
    output.add_argument("--page", action="store_true", help="list them in a browser on this machine, until Ctrl-C")
    parser.add_argument("--port", type=parse_free_port, default=0, metavar="N", help="of the page (default: any)")
    parser.add_argument("--no-open", action="store_true", help="of the page: print its address only")
    group = parser.add_argument_group("decisions (of one recording)")
    wanted = {
        "drop": ("LIST", "leave episodes out of data sets: 4 or 4,5"),
        "keep": ("LIST", "undo --drop"),
        "trim": ("N=FROM:TO", "export this part only [s of simulated time since its beginning]"),
        "label": ("N=LABEL", "verdict in place of the recorded one: success, failure or unknown"),
        "task": ("TEXT", "what was to be done, in all episodes; N=TEXT: in one"),
        "reset": ("LIST", "remove all decisions about episodes: 4,5 or all"),
    }
    for name, (metavar, text) in wanted.items():
        group.add_argument(f"--{name}", action="append", default=[], metavar=metavar, help=f"{text}; repeatable")


def run(arguments: argparse.Namespace) -> int:
    """List the episodes, write decisions, or serve the page."""
    from iris_session.system.extras import require_package

    if arguments.page:
        require_package("aiohttp", "--page")
        require_package("PIL", "--page")
    elif not (arguments.json or arguments.csv):
        require_package("rich", "a table of episodes")
    from iris_session.dataset.cameras import parse_cameras
    from iris_session.dataset.curation import parse_edits
    from iris_session.dataset.episodes import list_files
    from iris_session.dataset.listing import ListOptions, attach_edits, list_recordings

    edits = parse_edits(**{name: getattr(arguments, name) for name in _EDITS})
    files = list_files(arguments.paths)
    if edits and len(files) != 1:
        raise CommandError(f"decisions are about one recording, not {len(files)}: give its file")
    width, height = arguments.size or DEFAULT_SIZE
    cameras = parse_cameras(arguments.cameras or "")
    found: list[ListedRecording] = []
    with ending_as_interrupts(), ProgressLine(arguments.paths[0], PROGRESS_AFTER_S) as progress:

        def say(path: Path, text: str) -> None:
            progress.show(f"{len(found) + 1} of {len(files)}, {text}" if len(files) > 1 else text)

        for one in list_recordings(files, ListOptions(cameras, width / height, arguments.verify), say):
            if edits:
                _write_edits(one, edits)
            listed = attach_edits(one)
            found.append(one if arguments.page else listed)
            if not (arguments.page or arguments.json or arguments.csv):
                progress.end()
                _print_table(listed)
        progress.end()
        if arguments.page:
            from iris_session.cli.episodes_page import serve_page

            return serve_page(found, cameras, arguments.port, opens=not arguments.no_open)
    if arguments.json:
        recordings = [pick_attributes(one, "path", "id", "session_name", "problems") for one in found]
        episodes = [_to_row(one) for listed in found for one in listed.episodes]
        ok = not any(one.problems for one in found)
        print_json({"ok": ok, "episodes": episodes, "recordings": recordings})
    elif arguments.csv:
        _print_csv(found)
    return 1 if any(one.problems for one in found) else 0


def _write_edits(listed: ListedRecording, edits: Edits) -> None:
    from iris_session.dataset.curation import edit_curation, write_curation
    from iris_session.dataset.listing import read_lengths

    if not listed.id:
        raise CommandError(listed.problems[-1])
    write_curation(listed.path, edit_curation(*read_lengths(listed), edits))


def describe_edit(one: ListedEpisode) -> Iterator[str]:
    """Yield what people decided about an episode, in short words."""
    if one.edit.label:
        yield f"-> {one.edit.label}"
    if one.edit.drop:
        yield "dropped"
    if one.edit.trim:
        yield f"{one.edit.trim[0]:g} to {one.edit.trim[1]:g} s"
    if not one.is_editable:
        yield "repeated"
    if one.verdict == "running":
        yield "(cut: unknown)"


def _print_table(listed: ListedRecording) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(width=min(WIDTH, Console().width) if sys.stdout.isatty() else WIDTH)
    console.print(Text(to_printable(f"{listed.path}  {listed.session_name}"), overflow="fold"), style="bold")
    for problem in listed.problems:
        console.print(Text(to_printable(f"  {problem}"), overflow="fold"), style="red")
    if not listed.episodes:
        return
    cameras = list(dict.fromkeys(name for one in listed.episodes for name in one.outside))
    table = Table(box=None, pad_edge=False, padding=(0, 1), expand=True)
    table.add_column("#", justify="right", no_wrap=True)
    table.add_column("verdict", no_wrap=True)
    table.add_column(Text("[s]"), justify="right", no_wrap=True)
    table.add_column("people\ntask", ratio=1, overflow="fold")
    heads = ("hand-\novers", "idle\n[%]", "clut-\nches", "rejec-\nted", "path\n[m]", "near\n[m]", "inter-\nvened")
    for head in (*heads, *(f"out of\n{to_printable(name)[:12]}\n[%]" for name in cameras)):
        table.add_column(Text(head), justify="right", no_wrap=True)
    for one in listed.episodes:
        who = "\n".join(map(to_printable, filter(None, (", ".join(one.people), _describe_task(one)))))
        cells = (
            *(str(one.number), "\n".join((one.verdict, *describe_edit(one))), f"{one.duration_s:.1f}", who),
            *(str(one.handovers), f"{one.idle_share * 100.0:.0f}", str(one.clutches), str(one.rejected)),
            "\n".join(f"{path:.2f}" for path in one.path_m.values()),
            "" if one.closest_m is None else f"{one.closest_m:.2f}",
            str(one.interventions),
            *(f"{one.outside[name] * 100.0:.0f}" if name in one.outside else "" for name in cameras),
        )
        table.add_row(*map(Text, cells), style="dim" if one.edit.drop or not one.is_editable else "")
    console.print(table)


def _describe_task(one: ListedEpisode) -> str:
    text = one.edit.task or one.instruction or one.task or one.label
    return f"{text[:60]}..." if len(text) > 60 else text


def _to_row(one: ListedEpisode) -> dict[str, Any]:
    import msgspec

    return {**msgspec.to_builtins(one), "final_verdict": one.final_verdict}


def _print_csv(found: Sequence[ListedRecording]) -> None:
    """Print a line for each episode; numbers by robot or camera have columns of their own."""
    rows = []
    for one in (one for listed in found for one in listed.episodes):
        row = _to_row(one)
        for key in ("path_m", "outside", "edit"):
            row |= {f"{key}.{name}": value for name, value in row.pop(key).items()}
        joined = {key: "; ".join(map(str, value)) for key, value in row.items() if isinstance(value, tuple | list)}
        rows.append(row | joined)
    columns = dict.fromkeys(key for row in rows for key in row)
    writer = csv.DictWriter(sys.stdout, [*columns], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    for listed in found:
        for problem in listed.problems:
            print_error(f"{listed.path} {problem}")
