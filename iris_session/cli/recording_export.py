"""`iris-session export`, also `recording export`: recordings as a data set for training; one as tables, for pandas,
NumPy, MATLAB or a spreadsheet; its assets."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final

from iris_session.cli import recording_dataset
from iris_session.cli.common import (
    ABOVE_0,
    CommandError,
    Commands,
    add_command,
    ending_as_interrupts,
    list_first,
    make_number_type,
    print_result,
    refuse_options,
    report_damage,
)
from iris_session.cli.progress import ProgressLine
from iris_session.dataset.formats import FORMATS as DATASETS

#: What `--to` may be: formats of tables, and the other thing that is exported.
FORMATS: Final = ("csv", "parquet", "npz")
ASSETS: Final = "assets"
#: Options that choose tables and their rows.
_TABLES: Final = ("hz", "robot", "object", "table")


def register(actions: Commands) -> None:
    parser = add_command(
        actions,
        "export",
        run_export,
        help="write recordings as a data set for training, or one as tables or as what its scenes are drawn of",
        description="Make a data set of the episodes of recordings: frames of exact simulated time, pictures of "
        "cameras that are chosen now, actions, labels. Every episode is on the disk before the next begins, and a run "
        "that was killed is finished by the same command. Or write one recording as tables: one per robot (joints, end "
        "effector, gripper, contact force), per object (pose, contact force) and of the commands of each robot, one of "
        "raw samples, one of events. Sessions of class closed are simulated again and compared bit for bit, of class "
        "open the states are in the recording. Or write the assets of its scenes: specifications, meshes, textures, "
        "each in a file named by its hash. Exit status 1 if something is damaged, missing or left out.",
        examples="""
            iris-session export sessions --to lerobot --out set --cameras operator --size 320x240 --plain
            iris-session export session.rrd --to lerobot --out set --cameras "top=0,0,2->0,0,0:50" --looks 5 --jobs 4
            iris-session export /data/sessions --to lerobot --out set --ray auto      on a Ray cluster
            iris-session recording export session.rrd --to parquet -o tables
            iris-session recording export session.rrd --to csv -o tables --hz 30 --robot left --table robots
            iris-session recording export session.rrd --to npz -o tables --hz 500    every step at 500 Hz
            iris-session recording export session.rrd --to assets -o scene-files
        """,
    )
    text = "recordings (.rrd) and folders of them for a data set; one recording for tables and assets"
    parser.add_argument("paths", type=Path, nargs="+", metavar="RECORDING", help=text)
    formats = (*DATASETS, *FORMATS, ASSETS)
    parser.add_argument("--to", required=True, choices=formats, help="format of the data set or tables, or assets")
    parser.add_argument("-o", "--out", required=True, type=Path, metavar="FOLDER", help="folder for the files")
    text = "rows per second of robots, objects and commands; at the rate of the session, every step (default: 100)"
    rate = make_number_type(float, "a rate: give rows per second above 0, for example 100", ABOVE_0)
    parser.add_argument("--hz", type=rate, metavar="RATE", help=text)
    parser.add_argument("--robot", action="append", default=[], metavar="NAME", help="only this robot; repeatable")
    parser.add_argument("--object", action="append", default=[], metavar="NAME", help="only this object; repeatable")
    kinds = ("robots", "objects", "commands", "samples", "events")
    text = "only tables of this kind; repeatable"
    parser.add_argument("--table", action="append", default=[], choices=kinds, help=text)
    parser.add_argument("--force", action="store_true", help="write into a folder that is not empty, replace its files")
    recording_dataset.add_options(parser)


def run_export(arguments: argparse.Namespace) -> int:
    """Write a data set; or the tables, and print a line for each; or the assets."""
    if arguments.to in DATASETS:
        refuse_options(arguments, (*_TABLES, "force"), f" are for tables: leave them out with --to {arguments.to}")
        return recording_dataset.run(arguments)
    why = f" are for data sets: leave them out with --to {arguments.to}"
    refuse_options(arguments, recording_dataset.OPTIONS, why)
    if len(arguments.paths) > 1:
        raise CommandError(f"--to {arguments.to} takes one recording: give one, or a data set (--to lerobot)")
    arguments.path = arguments.paths[0]
    if arguments.to == ASSETS:
        return _export_assets(arguments)
    from iris_session.replay.export import TABLES, ExportOptions, export_recording
    from iris_session.replay.recorded_session import SessionRecording

    options = ExportOptions(
        arguments.hz or 100.0,
        tuple(arguments.table) or TABLES,
        tuple(arguments.robot),
        tuple(arguments.object),
        arguments.force,
    )
    with (
        ending_as_interrupts(),
        ProgressLine(arguments.path) as progress,
        SessionRecording.open(arguments.path, warn=False) as recording,
    ):
        report = export_recording(recording, arguments.out, arguments.to, options, progress.show)
    lines = (f"{arguments.out / one.file}: {one.rows:,} rows, {one.columns} columns" for one in report.tables)
    print_result(arguments, report, lines)
    left_out = (f"steps {first} to {last} are left out" for first, last in report.left_out)
    return report_damage(arguments.path, [*left_out, *report.damage])


def _export_assets(arguments: argparse.Namespace) -> int:
    """Write the assets of the scenes, and print what was written."""
    import msgspec

    from iris_session.recording import Recording
    from iris_session.recording.reader import check_assets
    from iris_session.rrd.assets import export_assets

    refuse_options(arguments, _TABLES, f" choose tables: leave them out with --to {ASSETS}")
    with (
        ending_as_interrupts(),
        ProgressLine(arguments.path) as progress,
        Recording.open(arguments.path, warn=False) as recording,
    ):
        report = export_assets(
            recording.files[0],
            arguments.out,
            check_assets(recording),
            recording.assets(),
            recording.scenes(),
            finished=recording.all_closed,
            force=arguments.force,
            progress=progress.show,
        )
        damage = (*recording.missing, *recording.damage, *report.damage)
        report = msgspec.structs.replace(report, damage=damage)
    size = f"{report.assets:,} assets, {report.bytes / 1e6:.1f} MB, scenes: {report.scenes:,}"
    missing = (f"  not recorded: {line}" for line in list_first(report.left_out))
    print_result(arguments, report, [f"{report.folder}: {size}", *missing])
    return report_damage(arguments.path, report.damage)
