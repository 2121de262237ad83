"""Options and output of `iris-session export --to lerobot|robomimic|mcap`: a data set made of recordings."""

from __future__ import annotations

import argparse
import re
import socket
import sys
from contextlib import redirect_stdout
from functools import partial
from typing import Final

from iris_session.cli.common import (
    CONNECT_S,
    CommandError,
    ending_as_interrupts,
    is_given,
    list_first,
    make_number_type,
    print_error,
    print_result,
)
from iris_session.cli.progress import ProgressLine
from iris_session.cli.recording_render import parse_size
from iris_session.dataset.formats import FORMATS

LABELS: Final = ("success", "failure", "unknown")
#: Options that only data sets have.
OPTIONS: Final = (
    *("fps", "cameras", "size", "looks", "seed", "labels", "task", "jobs", "ray"),
    *("plain", "depth", "masks", "anonymise"),
)
DEFAULT_FPS: Final = 30
DEFAULT_SIZE: Final = (640, 480)
#: Options that say something about pictures.
_OF_PICTURES: Final = ("size", "looks", "seed", "plain", "depth", "masks")


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of data sets."""
    group = parser.add_argument_group("data sets (--to lerobot, robomimic or mcap)")
    whole = make_number_type(int, "a rate: give 1 to 1000 frames a second, a whole number", 1, 1000)
    group.add_argument("--fps", type=whole, metavar="N", help="frames per second of simulated time (default: 30)")
    text = (
        "pictures of every frame: cameras of the model, streams of recorded pictures, NAME=CAMERA, or places "
        "NAME=X,Y,Z->X,Y,Z:FOVY, separated by commas (default: none)"
    )
    group.add_argument("--cameras", metavar="LIST", help=text)
    group.add_argument("--size", type=parse_size, metavar="WxH", help="pixels of a drawn picture (default: 640x480)")
    looks = make_number_type(int, "a number of looks: give 0 to 1000", 0, 1000)
    group.add_argument("--looks", type=looks, metavar="N", help="every episode N more times: other light and colours")
    seed = make_number_type(int, "a seed: give a whole number from 0", 0)
    group.add_argument("--seed", type=seed, metavar="N", help="of the looks")
    group.add_argument("--plain", action="store_true", help="pictures without shadows: faster without a graphics card")
    group.add_argument("--depth", action="store_true", help="depth of every picture too (robomimic, mcap)")
    group.add_argument("--masks", action="store_true", help="the body of every pixel too (robomimic, mcap)")
    group.add_argument("--labels", metavar="LIST", help=f"episodes, of {', '.join(LABELS)} (default: success)")
    group.add_argument("--task", metavar="TEXT", help="what was to be done, for all episodes")
    group.add_argument("--anonymise", action="store_true", help="p1, p2, ... in place of the names of people")
    jobs = make_number_type(int, "a number of processes: give 1 or more", 1, 1024)
    group.add_argument("--jobs", type=jobs, metavar="N", help="processes, an episode each (default: 1)")
    text = (
        "a Ray cluster makes the episodes, a task each: local (this machine), auto, HOST:PORT or ray://HOST:PORT; "
        "--jobs is then the number of tasks at once"
    )
    group.add_argument("--ray", metavar="ADDRESS", help=text)


def check_cluster_reachable(address: str) -> None:
    """Raise `CommandError` within `CONNECT_S` if nothing listens at a given address: Ray would try for minutes."""
    if (at := re.fullmatch(r"(?:ray://)?\[?([^/]+?)\]?:(\d{1,5})", address)) is None:
        return  # `local`, `auto`
    try:
        socket.create_connection((at[1], int(at[2])), CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise CommandError(
            f"no Ray cluster answers at {address}: `ray start --head` prints its address ({error})"
        ) from None


def run(arguments: argparse.Namespace) -> int:
    """Write the data set, and print what it holds."""
    from iris_session.system.extras import require_package

    for package in FORMATS[arguments.to].packages:
        require_package(package, f"--to {arguments.to}")
    if arguments.ray:
        require_package("ray", "--ray")
        check_cluster_reachable(arguments.ray)
    from iris_session.dataset.cameras import PictureSpec, parse_cameras
    from iris_session.dataset.episodes import PlanOptions, list_files
    from iris_session.dataset.ray_pool import RayPool
    from iris_session.dataset.run import DatasetOptions, export_dataset

    width, height = arguments.size or DEFAULT_SIZE
    if width % 2 or height % 2:
        raise CommandError(f"--size {width}x{height}: a video needs even numbers")
    of_pictures = [f"--{name}" for name in _OF_PICTURES if is_given(getattr(arguments, name))]
    if of_pictures and not arguments.cameras:
        raise CommandError(f"{of_pictures[0]} is about pictures, and there are none: name some by --cameras")
    if not FORMATS[arguments.to].has_layers and (arguments.depth or arguments.masks):
        there_are = " or ".join(name for name, one in FORMATS.items() if one.has_layers)
        raise CommandError(f"--to {arguments.to} has no depth and masks, its videos have 8 bits: --to {there_are}")
    labels = tuple(dict.fromkeys(filter(None, (arguments.labels or LABELS[0]).replace(" ", "").split(","))))
    if not labels or not set(labels) <= set(LABELS):
        raise CommandError(f"--labels {arguments.labels!r:.60}: give some of {', '.join(LABELS)}")
    options = DatasetOptions(
        arguments.fps or DEFAULT_FPS,
        PictureSpec(
            parse_cameras(arguments.cameras or ""),
            *(width, height, arguments.looks or 0, arguments.seed or 0),
            *(arguments.plain, arguments.depth, arguments.masks),
        ),
        PlanOptions(labels, arguments.task or "", arguments.anonymise),
        arguments.jobs or 1,
    )
    open_pool = partial(RayPool, arguments.ray, arguments.jobs) if arguments.ray else None
    with (
        ending_as_interrupts(),
        ProgressLine(arguments.out) as progress,
        redirect_stdout(sys.stderr),  # of Ray, which tells of workers that died
    ):
        files = list_files(arguments.paths)
        try:
            report = export_dataset(files, arguments.out, arguments.to, options, progress.show, open_pool)
        except KeyboardInterrupt:
            progress.end()
            if arguments.out.exists():
                print_error(f"{arguments.out} is not finished: the same command goes on after its last closed episode")
            raise
    n = f"{report.episodes:,} episode{'' if report.episodes == 1 else 's'}"
    lines = [f"{report.folder}: {n}, {report.frames:,} frames, {report.format}"]
    lines += [f"  {line}" for line in (*list_first(report.left_out), *list_first(report.notes))]
    return print_result(arguments, report, lines, ok=not report.left_out)
