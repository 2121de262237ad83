"""`iris-session anchors`: print a sheet, an anchors file to edit, and where a camera stands.

What concerns sessions lies in `anchors_live` (one that runs) and `anchors_solve` (a recorded one).
"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Final

from iris_session.cli.anchors_live import register_live
from iris_session.cli.anchors_solve import register_solve
from iris_session.cli.common import CommandError, add_json, open_scene, print_json
from iris_session.cli.poses import pose

if TYPE_CHECKING:
    from anchors.pose import PoseTuple

_UNITS: Final = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    parser = commands.add_parser(
        "anchors",
        help="print anchor sheets, align headsets, calibrate cameras",
        description="Sheets that headsets and cameras find in the room, how well headsets are aligned to them, and "
        "where cameras stand.",
        epilog="examples:\n"
        "  iris-session anchors print --size 160mm --id table --out table.pdf\n"
        "  iris-session anchors example > anchors.toml\n"
        "  iris-session anchors status --watch\n"
        "  iris-session anchors align start ann\n"
        "  iris-session anchors solve sessions/20261121T093000.000000Z-lab/session.rrd --out anchors.toml\n"
        "  iris-session anchors calibrate-camera pictures --sheet table=160mm --poses poses.csv\n"
        "  iris-session anchors calibrate-camera pictures --sheet table=160mm --at table=0,-0.45,0,1,0,0,0",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    _register_print(actions)
    _register_example(actions)
    register_live(actions)
    register_solve(actions)
    _register_calibrate(actions)


def _register_print(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "print",
        help="write a sheet as PDF or SVG",
        description="Writes a sheet of exact size: a QR code with the anchor's id between four markers that cameras "
        "find from afar, and a ruler that shows whether the printer kept the size.",
    )
    one.add_argument("--size", type=length, default=0.160, metavar="LENGTH", help="edge of the QR code (160mm)")
    one.add_argument("--id", default="table", metavar="NAME", help="id of the anchor (%(default)s)")
    one.add_argument("--paper", default="a4", metavar="PAPER", help="a5, a4, a3, a2, letter or tabloid (%(default)s)")
    one.add_argument("--out", type=Path, metavar="FILE", help="*.pdf or *.svg (default: NAME.pdf)")
    add_json(one)
    one.set_defaults(run=run_print)


def _register_example(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "example",
        help="an anchors file to edit, for `serve --anchors`",
        description="Prints the anchors of a scene as a file ready to edit. Pass it as `serve --anchors FILE`.",
        epilog="examples:\n  iris-session anchors example > anchors.toml\n  iris-session anchors example handover",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    one.add_argument(
        "scene",
        nargs="?",
        default="",
        help="name of a scene (see `iris-session serve --help`); default: the usual sheet",
    )
    add_json(one)
    one.set_defaults(run=run_example)


def _register_calibrate(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "calibrate-camera",
        help="find out where a camera stands",
        description="T_base_camera from pictures: of a sheet on the robot's hand while the hand moves (--poses), or of "
        "sheets of known place (--at). Says how well it fits, and refuses what does not determine the result.",
        epilog="poses.csv, metres and unit quaternions, one line per picture:\n"
        "  image,x,y,z,qw,qx,qy,qz\n"
        "  0001.png,0.412,0.031,0.388,0.0012,0.9998,0.0131,0.0021\n\n"
        "Several cameras at once: one folder each below FOLDER, with its own intrinsics.toml.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    one.add_argument("folder", type=Path, metavar="FOLDER", help="with the pictures")
    one.add_argument(
        "--sheet",
        type=_named_length,
        action="append",
        required=True,
        metavar="ID=LENGTH",
        help="a sheet that may be seen and the edge of its code, as printed: table=160mm; repeatable",
    )
    one.add_argument(
        "--intrinsics",
        type=Path,
        metavar="FILE",
        help="TOML with width, height, fx, fy, cx, cy, distortion, or a 3x3 matrix as text "
        "(default: intrinsics.toml or intrinsics.txt beside the pictures)",
    )
    one.add_argument("--poses", type=Path, metavar="CSV", help="T_base_ee, pose of the robot's hand, per picture")
    one.add_argument(
        "--camera-on-hand", action="store_true", help="with --poses: the hand carries the camera, the sheet lies still"
    )
    one.add_argument(
        "--in-hand",
        type=pose,
        metavar="X,Y,Z,QW,QX,QY,QZ",
        help="with --poses: the place of the sheet on the hand is known, T_ee_sheet; one picture is enough",
    )
    one.add_argument(
        "--at",
        type=_named_pose,
        action="append",
        default=[],
        metavar="ID=X,Y,Z,QW,QX,QY,QZ",
        help="the place of a sheet is known, T_base_sheet; repeatable",
    )
    one.add_argument("--out", type=Path, metavar="FILE", help="also write the result as TOML")
    add_json(one)
    one.set_defaults(run=run_calibrate)


def length(text: str) -> float:
    """Type of lengths, with their unit so that nobody prints a sheet of 160 m: metres."""
    found = re.fullmatch(r"([0-9]*\.?[0-9]+)\s*(mm|cm|m)", text.strip())
    if not found:
        raise argparse.ArgumentTypeError(f"{text!r} is not a length: a number with its unit, for example 160mm")
    return float(found[1]) * _UNITS[found[2]]


def _named_length(text: str) -> tuple[str, float]:
    name, _, rest = text.rpartition("=")
    return _named(name, text), length(rest)


def _named_pose(text: str) -> tuple[str, PoseTuple]:
    name, _, rest = text.rpartition("=")
    return _named(name, text), pose(rest)


def _named(name: str, text: str) -> str:
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r}: the id of the sheet is missing, for example table=160mm")
    return name


def run_print(arguments: argparse.Namespace) -> int:
    from anchors.sheet import Sheet, SheetError
    from anchors.sheet_print import to_pdf, to_svg

    out: Path = arguments.out or Path(re.sub(r"[^\w.-]+", "_", arguments.id) + ".pdf" if arguments.id else "sheet.pdf")
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise CommandError(f"{out}: the file must end in .pdf or .svg")
    try:
        sheet = Sheet(arguments.id, arguments.size)
        drawn = to_pdf(sheet, arguments.paper) if out.suffix.lower() == ".pdf" else to_svg(sheet, arguments.paper)
    except SheetError as error:
        raise CommandError(str(error)) from error
    try:
        out.write_bytes(drawn if isinstance(drawn, bytes) else drawn.encode())
    except OSError as error:
        raise CommandError(f"{out} cannot be written: {error.strerror}") from error
    if arguments.json:
        print_json(
            {
                "file": str(out),
                "id": sheet.anchor_id,
                "size_m": sheet.edge_m,
                "paper": arguments.paper,
                "markers": list(sheet.marker_ids),
                "marker_edge_m": sheet.marker_edge_m,
            }
        )
        return 0
    print(f"{out}: anchor {sheet.anchor_id!r}, code {1e3 * sheet.edge_m:g} mm, for {arguments.paper}")
    print(f"print at 100 % (not 'fit to page'), then measure the code: {1e3 * sheet.edge_m:g} mm from edge to edge")
    return 0


def run_example(arguments: argparse.Namespace) -> int:
    """Prints what the scene has, in the form that `serve --anchors` reads."""
    from iris_session.session.anchors_file import dump_anchors
    from iris_session.session.config import SessionConfig

    config = SessionConfig()
    anchors, sizes = config.anchors, config.sheet_sizes()
    if arguments.scene:
        scene = open_scene(arguments.scene)
        anchors, sizes = scene.anchors, scene.anchor_sizes
    text = dump_anchors(anchors, sizes)
    if arguments.json:
        print_json({"toml": text})
    else:
        print(text, end="")
    return 0


def run_calibrate(arguments: argparse.Namespace) -> int:
    from anchors.robot_world import CalibrationError
    from iris_session.cli.anchors_calibrate import calibrate, lines_of, to_toml

    try:
        told = calibrate(arguments)
    except CalibrationError as error:
        raise CommandError(str(error), status=1) from error
    if arguments.out is not None:
        try:
            arguments.out.write_text(to_toml(told), encoding="utf-8")
        except OSError as error:
            raise CommandError(f"{arguments.out} cannot be written: {error.strerror}") from error
    if arguments.json:
        print_json(told)
    else:
        print("\n".join(lines_of(told)))
    return 0
