"""`iris-session anchors`: print anchor sheets, calibrate cameras.

Commands on sessions, running or recorded, are in `anchors_session`.
"""

from __future__ import annotations

import argparse
import csv
import json
import math
import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from anchors.camera_calibration import (
    CalibrationPicture,
    calibration_to_toml,
    solve_from_known_sheets,
    solve_from_robot_poses,
)
from iris_session.cli.anchors_session import (
    register_align,
    register_move,
    register_place,
    register_solve,
    register_status,
)
from iris_session.cli.common import (
    CommandError,
    add_command,
    add_json_option,
    open_scene,
    parse_length,
    parse_pose,
    print_json,
    write_file,
)

if TYPE_CHECKING:
    from anchors.camera import CameraModel
    from anchors.pose import PoseTuple, Vec3
    from anchors.sheet import Sheet

#: For `cloud calibrate` too.
__all__ = [
    "CalibrationPicture",
    "calibration_to_toml",
    "format_calibration",
    "make_sheets",
    "parse_named_length",
    "parse_named_pose",
    "solve_from_known_sheets",
]
#: Edges of the code where none is given: with its marks it must be smaller to fit on A4.
PLAIN_SHEET_M: Final = 0.160
MARKED_SHEET_M: Final = 0.140


def register(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the command `anchors`."""
    parser = add_command(
        commands,
        "anchors",
        None,
        help="print anchor sheets, align headsets, calibrate cameras",
        description="Print sheets that headsets and cameras detect, align headsets to them, and calibrate cameras.",
        examples="""
            iris-session anchors print --size 160mm --id table --out table.pdf
            iris-session anchors example > anchors.toml
            iris-session anchors status --watch
            iris-session anchors align start ann
            iris-session anchors solve sessions/20261121T093000.000000Z-lab/session.rrd --out anchors.toml
            iris-session anchors calibrate-camera pictures --sheet table=160mm --poses poses.csv
            iris-session anchors calibrate-camera pictures --sheet table=160mm --at table=0,-0.45,0,1,0,0,0
        """,
    )
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    _register_print(actions)
    _register_example(actions)
    register_status(actions)
    register_align(actions)
    register_place(actions)
    register_move(actions)
    register_solve(actions)
    register_calibrate(actions)


def _register_print(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `print`."""
    one = add_command(
        actions,
        "print",
        run_print,
        help="write a sheet as PDF or SVG",
        description="Write a sheet of exact size: a QR code with the anchor's id between four markers that cameras "
        "detect from a distance, and a ruler to check the printed size. With --marks also four crosses, to be "
        "pricked and touched with a controller by devices that cannot read the code.",
        examples="""
            iris-session anchors print --size 160mm --id table --out table.pdf
            iris-session anchors print --id shelf --paper a3 --size 200mm
            iris-session anchors print --marks --out table.pdf
        """,
    )
    one.add_argument(
        "--size", type=parse_length, metavar="LENGTH", help="edge of the QR code (160mm; with --marks 140mm)"
    )
    one.add_argument("--marks", action="store_true", help="four crosses around the frame; a4 holds sizes up to 143mm")
    one.add_argument("--id", default="table", metavar="NAME", help="id of the anchor (%(default)s)")
    one.add_argument("--paper", default="a4", metavar="PAPER", help="a5, a4, a3, a2, letter or tabloid (%(default)s)")
    one.add_argument("--out", type=Path, metavar="FILE", help="*.pdf or *.svg (default: NAME.pdf)")
    add_json_option(one)


def _register_example(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `example`."""
    one = add_command(
        actions,
        "example",
        run_example,
        help="an anchors file to edit, for `serve --anchors`",
        description="Print the anchors of a scene as a file to edit. Pass it as `serve --anchors FILE`.",
        examples="""
            iris-session anchors example > anchors.toml
            iris-session anchors example handover
            iris-session anchors example --marks > anchors.toml
        """,
    )
    one.add_argument(
        "scene",
        nargs="?",
        default="",
        help="name of a scene (see `iris-session serve --help`); default: one sheet, `table`",
    )
    one.add_argument("--marks", action="store_true", help="of sheets with marks, as `print --marks` writes them")
    add_json_option(one)


def run_print(arguments: argparse.Namespace) -> int:
    """Write the sheet, and print its size."""
    from anchors.sheet import Sheet, SheetError
    from anchors.sheet_print import to_pdf, to_svg

    out: Path = arguments.out or Path(re.sub(r"[^\w.-]+", "_", arguments.id) + ".pdf" if arguments.id else "sheet.pdf")
    if out.suffix.lower() not in (".pdf", ".svg"):
        raise CommandError(f"{out}: the file must end in .pdf or .svg")
    try:
        size_m = arguments.size or (MARKED_SHEET_M if arguments.marks else PLAIN_SHEET_M)
        sheet = Sheet(arguments.id, size_m, arguments.marks)
        drawn = to_pdf(sheet, arguments.paper) if out.suffix.lower() == ".pdf" else to_svg(sheet, arguments.paper)
    except SheetError as error:
        raise CommandError(str(error)) from error
    write_file(out, drawn)
    if arguments.json:
        print_json(
            {
                "file": str(out),
                "id": sheet.anchor_id,
                "size_m": sheet.edge_m,
                "paper": arguments.paper,
                "markers": list(sheet.marker_ids),
                "marker_edge_m": sheet.marker_edge_m,
                "marks_m": {name: list(p) for name, p in sheet.marks.items()},
            }
        )
        return 0
    print(f"{out}: anchor {sheet.anchor_id!r}, code {1e3 * sheet.edge_m:g} mm, for {arguments.paper}")
    print(f"print at 100 % (not 'fit to page'), then measure the code: {1e3 * sheet.edge_m:g} mm from edge to edge")
    if sheet.has_marks:
        print("prick the crosses with a needle; the session must know them: lines for the anchors file")
        print(f"\nsize_m = {sheet.edge_m!r}\n[anchors.{json.dumps(sheet.anchor_id)}.marks_m]")
        for name, p in sheet.marks.items():
            print(f'"{name}" = [{", ".join(f"{c:.6g}" for c in p)}]')
    return 0


def run_example(arguments: argparse.Namespace) -> int:
    """Print the anchors of a scene in the format of `serve --anchors`."""
    from anchors.sheet import compute_marks
    from iris_session.session.config import SessionConfig, dump_anchors

    config = SessionConfig()
    anchors, sizes = config.anchors, config.sheet_sizes()
    if arguments.scene:
        scene = open_scene(arguments.scene)
        anchors, sizes = scene.anchors, scene.anchor_sizes
    marks: dict[str, dict[str, Vec3]] = {}
    if arguments.marks:
        sizes = dict.fromkeys(anchors, MARKED_SHEET_M)
        marks = {name: compute_marks(MARKED_SHEET_M) for name in anchors}
    text = dump_anchors(anchors, sizes, marks)
    if arguments.json:
        print_json({"toml": text})
    else:
        print(text, end="")
    return 0


# --- calibrate-camera -------------------------------------------------------------------------------------------------


PICTURES: Final = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
COLUMNS: Final = ("image", "x", "y", "z", "qw", "qx", "qy", "qz")


def calibrate_cameras(arguments: argparse.Namespace) -> dict[str, Any]:
    """Calibrate cameras from pictures. Return the object that `--json` prints.

    Raises:
        CommandError: The options or files are unusable.
        CalibrationError: The pictures do not determine a result.
    """
    sheets = make_sheets(arguments.sheet)
    _check_options(arguments, sheets)
    if arguments.at:
        pictures = _read_pictures(arguments.folder, arguments.intrinsics, sheets)
        return solve_from_known_sheets(pictures, dict(arguments.at))[0]
    poses = read_poses(arguments.poses)
    pictures = _read_pictures(arguments.folder, arguments.intrinsics, sheets)
    if len({picture.camera_name for picture in pictures}) > 1:
        raise CommandError("--poses calibrates one camera at a time: give the folder of that camera")
    missing = [picture.path.name for picture in pictures if picture.path.name not in poses]
    if missing:
        raise CommandError(f"{arguments.poses} has no line for {missing[0]} ({len(missing)} pictures have no pose)")
    return solve_from_robot_poses(
        pictures, poses, camera_on_hand=arguments.camera_on_hand, T_ee_sheet=arguments.in_hand
    )


def make_sheets(sizes: Iterable[tuple[str, float]]) -> list[Sheet]:
    """Return the sheets of the options `--sheet`: id and edge [m]."""
    from anchors.sheet import Sheet, SheetError

    try:
        sheets = [Sheet(name, edge) for name, edge in sizes]
    except SheetError as error:
        raise CommandError(str(error)) from error
    if len({sheet.anchor_id for sheet in sheets}) != len(sheets):
        raise CommandError("--sheet: the same sheet is given twice")
    return sheets


def _check_options(arguments: argparse.Namespace, sheets: list[Sheet]) -> None:
    if (arguments.poses is None) == (not arguments.at):
        raise CommandError("give --poses CSV (the robot's hand moves) or --at ID=POSE (sheets at known poses)")
    if arguments.at and (arguments.in_hand or arguments.camera_on_hand):
        raise CommandError("--in-hand and --camera-on-hand need --poses, not --at")
    if arguments.in_hand and arguments.camera_on_hand:
        raise CommandError("--in-hand cannot be combined with --camera-on-hand: it is the pose of a sheet on the hand")
    if arguments.poses is not None and len(sheets) != 1:
        raise CommandError(
            f"{len(sheets)} sheets with --poses: give exactly one --sheet, on the hand, or with "
            "--camera-on-hand in the room"
        )
    unknown = {name for name, _ in arguments.at} - {sheet.anchor_id for sheet in sheets}
    if unknown:
        raise CommandError(f"--at {sorted(unknown)[0]}: no size is given, add --sheet {sorted(unknown)[0]}=160mm")


# --- input ------------------------------------------------------------------------------------------------------------


def read_poses(path: Path) -> dict[str, PoseTuple]:
    """Read `T_base_ee` by name of the picture."""
    try:
        rows = list(csv.reader(path.read_text(encoding="utf-8").splitlines(), skipinitialspace=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CommandError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not rows or tuple(word.strip() for word in rows[0]) != COLUMNS:
        raise CommandError(f"{path}: the first line must be {','.join(COLUMNS)}")
    poses: dict[str, PoseTuple] = {}
    for number, row in enumerate(rows[1:], 2):
        if not any(word.strip() for word in row):
            continue
        try:
            name, x, y, z, *q = row[0].strip(), *map(float, row[1:])
        except ValueError:
            q = []
        if len(q) != 4 or not all(map(math.isfinite, (x, y, z, *q))) or abs(math.hypot(*q) - 1.0) > 0.01:
            raise CommandError(
                f"{path}, line {number}: must be the name of a picture, x,y,z in metres, and a unit quaternion "
                "with w first"
            )
        if name in poses:
            raise CommandError(f"{path}, line {number}: a second pose for {name}")
        n = math.hypot(*q)
        poses[name] = ((x, y, z), (q[0] / n, q[1] / n, q[2] / n, q[3] / n))
    return poses


def _read_pictures(folder: Path, intrinsics: Path | None, sheets: list[Sheet]) -> list[CalibrationPicture]:
    """Read the pictures of the folder, or of its subfolders, and detect sheets in them."""
    if not folder.is_dir():
        raise CommandError(f"{folder} is not a folder")
    folders = [folder] if _list_pictures(folder) else [inner for inner in sorted(folder.iterdir()) if inner.is_dir()]
    found = [picture for one in folders for picture in _read_camera_folder(one, intrinsics, sheets)]
    if not found:
        raise CommandError(f"no pictures in {folder}: they must end in {', '.join(PICTURES)}")
    return found


def _list_pictures(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)


def _read_camera_folder(folder: Path, intrinsics: Path | None, sheets: list[Sheet]) -> list[CalibrationPicture]:
    import cv2

    from anchors.detection import DetectionError, SheetDetector

    pictures: list[CalibrationPicture] = []
    detectors: dict[tuple[int, int], SheetDetector] = {}
    for path in _list_pictures(folder):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CommandError(f"{path} is not a readable picture")
        height, width = image.shape
        if (width, height) not in detectors:
            detectors[width, height] = SheetDetector(sheets, _read_camera(folder, intrinsics, width, height))
        detector = detectors[width, height]
        try:
            pictures.append(CalibrationPicture(path, folder.name, detector.camera, tuple(detector.detect(image))))
        except DetectionError as error:
            raise CommandError(f"{path}: {error}") from error
    return pictures


def _read_camera(folder: Path, intrinsics: Path | None, width: int, height: int) -> CameraModel:
    from anchors.camera import CameraError, parse_camera

    places = [intrinsics] if intrinsics is not None else [folder / "intrinsics.toml", folder / "intrinsics.txt"]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise CommandError(
            f"no intrinsics at {places[0]}: give with --intrinsics a TOML file with width, height, fx, fy, cx, cy "
            "[pixels] and distortion, from the maker of the camera or a calibration"
        )
    try:
        return parse_camera(path.read_text(encoding="utf-8"), width, height)
    except (CameraError, OSError, UnicodeDecodeError) as error:
        raise CommandError(f"{path}: {error}") from error


# --- output -----------------------------------------------------------------------------------------------------------


def format_calibration(result: dict[str, Any]) -> list[str]:
    """Return the result as lines of text."""
    lines = []
    for row in result["pictures"]:
        name = row["file"] if row["camera"] in ("", row["file"]) else f"{row['camera']}/{row['file']}"
        if not row["found"]:
            lines.append(f"{name}  no sheet found")
            continue
        note = "" if row["used"] else "  EXCLUDED: contradicts the others"
        lines.append(
            f"{name}  {row['sheet']}  {row['residual_mm']:.2f} mm  {row['residual_deg']:.3f} deg  "
            f"{row['residual_px']:.2f} px{note}"
        )
    lines.append(
        f"{result['used']} used, {result['left_out']} excluded; residual rms {result['residual_mm_rms']:.2f} mm, "
        f"{result['residual_deg_rms']:.3f} deg, {result['residual_px_rms']:.2f} px"
    )
    for name, value in _list_poses(result):
        p, q = value["position_m"], value["quaternion_wxyz"]
        place = ", ".join(f"{v:.5f}" for v in p)
        lines.append(f"{name}  p = [{place}] m  q = [{', '.join(f'{v:.6f}' for v in q)}]")
    for name, part in [("", result), *result.get("cameras", {}).items()]:
        if "error_mm_p95" in part:
            turn = f", {part['sigma_deg']:.3f} deg (sigma)" if "sigma_deg" in part else ""
            lines.append(f"{name + ': ' if name else ''}stated error {part['error_mm_p95']:.2f} mm (95 %){turn}")
    return lines


def _list_poses(result: dict[str, Any]) -> list[tuple[str, dict[str, list[float]]]]:
    found = [(key, value) for key, value in result.items() if key.startswith("T_")]
    for kind in ("cameras", "sheets"):
        for name, part in result.get(kind, {}).items():
            found += [(f"{key} of {name}", value) for key, value in part.items() if key.startswith("T_")]
    return found


def register_calibrate(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `calibrate-camera`."""
    one = add_command(
        actions,
        "calibrate-camera",
        run_calibrate,
        help="calibrate the pose of a camera",
        description="Compute T_base_camera from pictures: of a sheet on the robot's hand while the hand moves "
        "(--poses), or of sheets at known poses (--at). Prints residuals, and refuses pictures that do not "
        "determine the result.",
        examples="""
            iris-session anchors calibrate-camera pictures --sheet table=160mm --poses poses.csv
            iris-session anchors calibrate-camera pictures --sheet table=160mm --at table=0,-0.45,0,1,0,0,0
        """,
        notes="poses.csv, metres and unit quaternions, one line per picture:\n"
        "  image,x,y,z,qw,qx,qy,qz\n"
        "  0001.png,0.412,0.031,0.388,0.0012,0.9998,0.0131,0.0021\n\n"
        "Several cameras at once: one folder each below FOLDER, with its own intrinsics.toml.",
    )
    one.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the pictures")
    one.add_argument(
        "--sheet",
        type=parse_named_length,
        action="append",
        required=True,
        metavar="ID=LENGTH",
        help="id of a sheet and the printed edge of its code: table=160mm; repeatable",
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
        "--camera-on-hand", action="store_true", help="with --poses: the camera is on the hand, the sheet does not move"
    )
    one.add_argument(
        "--in-hand",
        type=parse_pose,
        metavar="X,Y,Z,QW,QX,QY,QZ",
        help="with --poses: known pose of the sheet on the hand, T_ee_sheet; one picture is enough",
    )
    one.add_argument(
        "--at",
        type=parse_named_pose,
        action="append",
        default=[],
        metavar="ID=X,Y,Z,QW,QX,QY,QZ",
        help="known pose of a sheet, T_base_sheet; repeatable",
    )
    one.add_argument("--out", type=Path, metavar="FILE", help="also write the result as TOML")
    add_json_option(one)


def parse_named_length(text: str) -> tuple[str, float]:
    """Parse `ID=LENGTH`, such as `table=160mm`."""
    name, _, rest = text.rpartition("=")
    return _check_sheet_id(name, text), parse_length(rest)


def parse_named_pose(text: str) -> tuple[str, PoseTuple]:
    """Parse `ID=X,Y,Z,QW,QX,QY,QZ`."""
    name, _, rest = text.rpartition("=")
    return _check_sheet_id(name, text), parse_pose(rest)


def _check_sheet_id(name: str, text: str) -> str:
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r}: the id of the sheet is missing, for example table=160mm")
    return name


def run_calibrate(arguments: argparse.Namespace) -> int:
    """Calibrate, print the result, and write it to `--out`. Exit status 1 if the pictures do not determine it."""
    from anchors.robot_world import CalibrationError

    try:
        result = calibrate_cameras(arguments)
    except CalibrationError as error:
        raise CommandError(str(error), status=1) from error
    if arguments.out is not None:
        write_file(arguments.out, calibration_to_toml(result))
    if arguments.json:
        print_json(result)
    else:
        print("\n".join(format_calibration(result)))
    return 0
