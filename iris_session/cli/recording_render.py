"""`iris-session recording render`: a film or a picture of a recording, as MuJoCo draws the scene."""

from __future__ import annotations

import argparse
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, Final

from iris_session.cli.common import (
    CommandError,
    Commands,
    add_command,
    ending_as_interrupts,
    make_number_type,
    print_result,
    report_damage,
    writing,
)
from iris_session.cli.progress import ProgressLine
from iris_session.system.files import Replacement

if TYPE_CHECKING:
    from iris_session.replay.pictures import Image, RecordingPictures, Timeline

VIDEO: Final = ".mp4"
ANIMATION: Final = ".gif"
PICTURE: Final = ".png"
DEFAULT_SIZE: Final = (960, 540)
MIN_SIDE: Final = 16
MAX_SIDE: Final = 8192
DEFAULT_FPS: Final = 30.0
#: An animation is held in memory, and its colours are chosen when all of it is there: this many pixels at most.
MAX_ANIMATION_PIXELS: Final = 100_000_000
#: Codecs of a video in the order of preference, by their names in OpenCV: browsers play the first.
_CODECS: Final = {"vp09": "VP9", "mp4v": "MPEG-4 Part 2, which no browser plays"}
_SECOND: Final = 1_000_000_000


def register(actions: Commands) -> None:
    parser = add_command(
        actions,
        "render",
        run,
        help="a film or a picture of the scene, through a camera of the model",
        description="Draw a recording with MuJoCo's renderer: a video (.mp4, codec VP9, which browsers play), an "
        "animation (.gif) or a picture of one moment (.png). Every picture is that of a step as it was: of class "
        "closed the session is simulated again and compared bit for bit, of class open the states are in the "
        "recording. It needs no display, but OpenGL (Debian: libegl1 libgl1-mesa-dri). Exit status 1 if something is "
        "damaged or missing.",
        examples="""
            iris-session recording render session.rrd -o session.mp4              a view of all that moves
            iris-session recording render session.rrd -o session.mp4 --camera operator --size 1920x1080
            iris-session recording render session.rrd -o handover.gif --from 4 --to 14 --speed 2 --fps 12 --people
            iris-session recording render session.rrd -o picture.png --at 12.5s
            iris-session recording render session.rrd --list-cameras
        """,
    )
    parser.add_argument("path", type=Path, metavar="RECORDING", help="a .rrd, or the folder of one session")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="the file to write: .mp4, .gif or .png")
    parser.add_argument("--camera", default="", metavar="NAME", help="camera of the model (default: all that moves)")
    parser.add_argument("--list-cameras", action="store_true", help="print the cameras of the scene, and draw nothing")
    parser.add_argument("--size", type=parse_size, default=DEFAULT_SIZE, metavar="WxH", help="pixels (960x540)")
    parser.add_argument("--fps", type=parse_rate, default=DEFAULT_FPS, metavar="N", help="pictures per second (30)")
    parser.add_argument("--speed", type=parse_rate, default=1.0, metavar="N", help="times as fast as it was (1)")
    parser.add_argument("--from", dest="begin", type=parse_time, metavar="S", help="session time to begin at [s]")
    parser.add_argument("--to", dest="end", type=parse_time, metavar="S", help="session time to end at [s]")
    parser.add_argument("--at", type=parse_time, metavar="S", help="session time of a .png [s] (default: the middle)")
    parser.add_argument("--people", action="store_true", help="draw heads and hands too, in their colours in `view`")
    parser.add_argument("--force", action="store_true", help="replace FILE if it exists")


def parse_size(text: str) -> tuple[int, int]:
    """Parse `--size`."""
    found = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.strip().lower())
    width, height = (int(found[1]), int(found[2])) if found else (0, 0)
    if not (MIN_SIDE <= width <= MAX_SIDE and MIN_SIDE <= height <= MAX_SIDE):
        raise argparse.ArgumentTypeError(
            f"{text!r} is not a size: give WIDTHxHEIGHT, each {MIN_SIDE} to {MAX_SIDE} pixels, for example 1280x720"
        )
    return width, height


parse_rate: Final = make_number_type(float, "a rate: give a number from 0.001 to 1000, for example 30", 1e-3, 1e3)
_SESSION_TIME: Final = "a session time: give seconds from 0, for example 12.5"
parse_time: Final = make_number_type(lambda text: float(text.removesuffix("s")), _SESSION_TIME, 0.0, 1e9)


def run(arguments: argparse.Namespace) -> int:
    """Draw the pictures, and print what was written."""
    from iris_session.system.extras import require_package

    require_package("cv2", "writing pictures")
    from iris_session.recording import Recording
    from iris_session.replay.pictures import PictureOptions, RecordingPictures, Timeline, list_cameras

    if arguments.list_cameras:
        with Recording.open(arguments.path, warn=False) as recording:
            cameras = list_cameras(recording)
        print_result(arguments, {"cameras": cameras}, cameras)
        return 0
    out = _check_output(arguments)
    width, height = arguments.size
    with (
        ending_as_interrupts(),
        ProgressLine(arguments.path) as progress,
        Recording.open(arguments.path, warn=False) as recording,
    ):
        progress.show("reading")
        timeline = Timeline(recording)
        times_ns = list_times(arguments, timeline)
        options = PictureOptions(width, height, arguments.camera, arguments.people)
        with RecordingPictures(recording, timeline, options) as pictures:
            codec = _write(out, arguments, _draw(pictures, times_ns, progress), len(times_ns))
        problems = [f"steps {first} to {last} are left out" for first, last in pictures.left_out]
        problems += [*recording.missing, *recording.damage]
    begin_s, end_s, n = times_ns[0] / _SECOND, times_ns[-1] / _SECOND, len(times_ns)
    n_bytes = out.stat().st_size
    report = {"file": str(out), "pictures": n, "begin_s": begin_s, "end_s": end_s, "codec": codec, "width": width}
    report |= {"height": height, "bytes": n_bytes, "notes": pictures.notes, "problems": problems}
    span = f"{n:,} pictures from {begin_s:.2f} s to {end_s:.2f} s" if n > 1 else f"the picture of {begin_s:.2f} s"
    line = f"{out}: {span}, {width} x {height}, {codec}, {n_bytes / 1e6:.1f} MB"
    print_result(arguments, report, [line, *pictures.notes])
    return report_damage(arguments.path, problems)


def _check_output(arguments: argparse.Namespace) -> Path:
    """Return the file to write. Raises `CommandError` for one that cannot be."""
    from iris_session.system.extras import require_package

    out: Path | None = arguments.out
    kinds = f"give -o FILE{VIDEO}, FILE{ANIMATION} or FILE{PICTURE}"
    if out is None:
        raise CommandError(f"there is no file to write: {kinds}, or --list-cameras")
    kind = out.suffix.lower()
    if kind not in (VIDEO, ANIMATION, PICTURE):
        raise CommandError(f"{out} is of a kind that is not written: {kinds}")
    if out.exists() and not (arguments.force and out.is_file()):
        raise CommandError(f"{out} exists: give another file, or --force" if out.is_file() else f"{out} is no file")
    if not out.parent.is_dir():
        raise CommandError(f"the folder {out.parent} does not exist: make it, or give another one")
    if arguments.at is not None and kind != PICTURE:
        raise CommandError(f"--at is for one picture ({PICTURE}): give --from and --to")
    if kind == VIDEO and (arguments.size[0] % 2 or arguments.size[1] % 2):
        raise CommandError(f"--size {'x'.join(map(str, arguments.size))}: a video needs even numbers")
    if kind == ANIMATION:
        require_package("PIL", "writing animations")
    return out


def list_times(arguments: argparse.Namespace, timeline: Timeline) -> Sequence[int]:
    """Return the session times of the pictures [ns], ascending. Raises `CommandError`."""
    first_s, last_s = timeline.begin_ns / _SECOND, timeline.end_ns / _SECOND
    begin_s = first_s if arguments.begin is None else arguments.begin
    end_s = last_s if arguments.end is None else arguments.end
    if begin_s > end_s:
        raise CommandError(f"--from {begin_s:g} is after the end, {end_s:.2f} s: give an earlier one, or a later --to")
    # Printed times are rounded to 0.01 s.
    for option, begin, end in (("--at", arguments.at, arguments.at), ("--from and --to", begin_s, end_s)):
        if begin is not None and (begin > last_s + 0.01 or end < first_s - 0.01):
            raise CommandError(
                f"{option}: the recording has nothing there, it goes from {first_s:.2f} s to {last_s:.2f} s"
            )
    begin_ns = max(timeline.begin_ns, round(begin_s * _SECOND))
    end_ns = max(begin_ns, min(timeline.end_ns, round(end_s * _SECOND)))
    if arguments.out.suffix.lower() == PICTURE:
        at_ns = (begin_ns + end_ns) // 2 if arguments.at is None else round(arguments.at * _SECOND)
        return (min(max(at_ns, timeline.begin_ns), timeline.end_ns),)
    period_ns = max(1, round(arguments.speed / arguments.fps * _SECOND))
    times_ns = range(begin_ns, end_ns + 1, period_ns)
    width, height = arguments.size
    if arguments.out.suffix.lower() == ANIMATION and len(times_ns) * width * height > MAX_ANIMATION_PIXELS:
        raise CommandError(
            f"an animation of {len(times_ns):,} pictures of {width} x {height} is too large: give --from and --to, a "
            f"smaller --size or --fps, or a {VIDEO}"
        )
    return times_ns


def _draw(pictures: RecordingPictures, times_ns: Sequence[int], progress: ProgressLine) -> Iterator[Image]:
    """Yield the pictures, and show how many there are."""
    for done, image in enumerate(pictures.draw(times_ns), start=1):
        progress.show(f"picture {done:,} of {len(times_ns):,}")
        yield image


def _write(out: Path, arguments: argparse.Namespace, images: Iterator[Image], n_images: int) -> str:
    """Write the file, as a whole or not at all. Return the name of its codec."""
    import cv2

    kind = out.suffix.lower()
    with writing(out), Replacement(out, permissions=None, suffix=kind) as replacement:
        if kind == VIDEO:
            return _write_video(replacement.temporary, images, n_images, arguments.size, arguments.fps)
        if kind == ANIMATION:
            _write_animation(replacement.file, list(images), round(1000 / arguments.fps))
            return "GIF"
        _, data = cv2.imencode(PICTURE, next(images)[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])
        replacement.file.write(data.tobytes())
        return "PNG"


def _write_video(path: Path, images: Iterator[Image], n_images: int, size: tuple[int, int], fps: float) -> str:
    """Write a video, picture by picture. Return the name of its codec."""
    import cv2

    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # of codecs that are not there
    for code in _CODECS:
        writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*code), fps, size)
        if writer.isOpened():
            break
    else:
        raise CommandError(
            "this OpenCV writes no video: pip install opencv-python-headless, which brings its codecs, or give a .gif"
        )

    def encode(image: Image) -> None:
        writer.write(cv2.cvtColor(image, cv2.COLOR_RGB2BGR))

    try:
        with ThreadPoolExecutor(1) as encoder:  # a picture is encoded while the next one is drawn
            encoded: Future[None] | None = None
            for image in images:
                if encoded is not None:
                    encoded.result()
                encoded = encoder.submit(encode, image)
    finally:
        writer.release()
    written = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)  # the writer says nothing about a full disk
    n_written = int(written.get(cv2.CAP_PROP_FRAME_COUNT))
    written.release()
    if n_written != n_images:
        raise OSError(f"{n_written} of {n_images} pictures are in it: is the disk full?")
    return _CODECS[code]


def _write_animation(file: BinaryIO, images: Sequence[Image], frame_ms: int) -> None:
    """Write an endless GIF, all of whose pictures have the colours of the middle one."""
    from PIL import Image as Pillow

    frames = [Pillow.fromarray(image) for image in images]
    palette = frames[len(frames) // 2].quantize(colors=200)
    frames = [frame.quantize(palette=palette, dither=Pillow.Dither.NONE) for frame in frames]
    frames[0].save(file, "GIF", save_all=True, append_images=frames[1:], duration=frame_ms, loop=0, optimize=True)
