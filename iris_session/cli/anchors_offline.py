"""What `iris-session anchors calibrate-camera` does: pictures and poses in, the place of cameras and residuals out."""

from __future__ import annotations

import argparse
import csv
import math
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.cli.common import CommandError, add_json_option, parse_length, parse_pose, print_json, to_printable

if TYPE_CHECKING:
    from anchors.camera import Camera
    from anchors.constellation import Constellation
    from anchors.detection import Sighting
    from anchors.pose import PoseTuple
    from anchors.sheet import Sheet
    from iris_session.alignment.resolve import Compared, Relative, Result
    from iris_session.recording import Looks, Person, Recording


# --- anchors_calibrate ---


PICTURES: Final = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
COLUMNS: Final = ("image", "x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Picture:
    """One picture, and what was found in it. `camera_name`: the folder it lies in."""

    path: Path
    camera_name: str
    camera: Camera
    sightings: tuple[Sighting, ...]


def calibrate_cameras(arguments: argparse.Namespace) -> dict[str, Any]:
    """The result as it is printed with `--json`. Raises `CommandError`, and `CalibrationError` where the pictures do
    not determine a result."""
    sheets = _parse_sheets(arguments)
    _check_options(arguments, sheets)
    if arguments.at:
        return _solve_from_known_sheets(_read_pictures(arguments.folder, arguments.intrinsics, sheets), arguments)
    poses = read_poses(arguments.poses)
    pictures = _read_pictures(arguments.folder, arguments.intrinsics, sheets)
    if len({picture.camera_name for picture in pictures}) > 1:
        raise CommandError("--poses calibrates one camera at a time: give the folder of that camera")
    return _solve_from_robot_poses(pictures, poses, arguments)


def _parse_sheets(arguments: argparse.Namespace) -> list[Sheet]:
    from anchors.sheet import Sheet, SheetError

    try:
        sheets = [Sheet(name, edge) for name, edge in arguments.sheet]
    except SheetError as error:
        raise CommandError(str(error)) from error
    if len({sheet.anchor_id for sheet in sheets}) != len(sheets):
        raise CommandError("--sheet names the same sheet twice")
    return sheets


def _check_options(arguments: argparse.Namespace, sheets: list[Sheet]) -> None:
    if (arguments.poses is None) == (not arguments.at):
        raise CommandError("give --poses CSV (the robot's hand moves) or --at ID=POSE (sheets of known place)")
    if arguments.at and (arguments.in_hand or arguments.camera_on_hand):
        raise CommandError("--in-hand and --camera-on-hand belong to --poses")
    if arguments.in_hand and arguments.camera_on_hand:
        raise CommandError("--in-hand is the place of the sheet on the hand: not with --camera-on-hand")
    if arguments.poses is not None and len(sheets) != 1:
        raise CommandError(
            "with --poses exactly one --sheet: the one on the hand, or with --camera-on-hand in the room"
        )
    unknown = {name for name, _ in arguments.at} - {sheet.anchor_id for sheet in sheets}
    if unknown:
        raise CommandError(f"--at {sorted(unknown)[0]}: its size is missing, add --sheet {sorted(unknown)[0]}=160mm")


# --- input ------------------------------------------------------------------------------------------------------------


def read_poses(path: Path) -> dict[str, PoseTuple]:
    """`T_base_ee` by the name of the picture."""
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
                f"{path}, line {number}: wanted are the name of a picture, x,y,z in metres, and a unit quaternion "
                "with w first"
            )
        if name in poses:
            raise CommandError(f"{path}, line {number}: a second pose for {name}")
        n = math.hypot(*q)
        poses[name] = ((x, y, z), (q[0] / n, q[1] / n, q[2] / n, q[3] / n))
    return poses


def _read_pictures(folder: Path, intrinsics: Path | None, sheets: list[Sheet]) -> list[Picture]:
    """Every picture of the folder, or of the folders in it, looked through for sheets."""
    if not folder.is_dir():
        raise CommandError(f"{folder} is not a folder")
    folders = [folder] if _list_pictures(folder) else [inner for inner in sorted(folder.iterdir()) if inner.is_dir()]
    found = [picture for one in folders for picture in _read_camera_folder(one, intrinsics, sheets)]
    if not found:
        raise CommandError(f"no pictures in {folder}: files that end in {', '.join(PICTURES)}")
    return found


def _list_pictures(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)


def _read_camera_folder(folder: Path, intrinsics: Path | None, sheets: list[Sheet]) -> list[Picture]:
    import cv2

    from anchors.detection import DetectionError, SheetDetector

    pictures: list[Picture] = []
    detectors: dict[tuple[int, int], SheetDetector] = {}
    for path in _list_pictures(folder):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CommandError(f"{path} is not a picture that can be read")
        height, width = image.shape
        if (width, height) not in detectors:
            detectors[width, height] = SheetDetector(sheets, _read_camera(folder, intrinsics, width, height))
        detector = detectors[width, height]
        try:
            pictures.append(Picture(path, folder.name, detector.camera, tuple(detector.detect(image))))
        except DetectionError as error:
            raise CommandError(f"{path}: {error}") from error
    return pictures


def _read_camera(folder: Path, intrinsics: Path | None, width: int, height: int) -> Camera:
    from anchors.camera import CameraError, parse_camera

    places = [intrinsics] if intrinsics is not None else [folder / "intrinsics.toml", folder / "intrinsics.txt"]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise CommandError(
            f"no intrinsics at {places[0]}: a TOML file with width, height, fx, fy, cx, cy [pixels] and distortion, "
            "from the maker of the camera or a calibration; name it with --intrinsics"
        )
    try:
        return parse_camera(path.read_text(encoding="utf-8"), width, height)
    except (CameraError, OSError, UnicodeDecodeError) as error:
        raise CommandError(f"{path}: {error}") from error


# --- solving ----------------------------------------------------------------------------------------------------------


def _solve_from_robot_poses(
    pictures: list[Picture], poses: dict[str, PoseTuple], arguments: argparse.Namespace
) -> dict[str, Any]:
    from anchors.pose import compose, inverse
    from anchors.robot_world import CalibrationError, camera_on_hand, solve

    missing = [picture.path.name for picture in pictures if picture.path.name not in poses]
    if missing:
        raise CommandError(f"{arguments.poses} has no line for {missing[0]} ({len(missing)} pictures without a pose)")
    seen = [picture for picture in pictures if picture.sightings]
    if not seen:
        raise CalibrationError(_format_no_sheet_found(len(pictures)))
    robot = [poses[picture.path.name] for picture in seen]
    if arguments.in_hand is not None:
        return _solve_with_known_hand_pose(pictures, seen, robot, arguments.in_hand)
    found = [picture.sightings[0] for picture in seen]
    solver = camera_on_hand if arguments.camera_on_hand else solve
    solved = solver(robot, [one.T_camera_sheet for one in found], [one.covariance for one in found])
    X, Y = solved.T_base_camera, solved.T_ee_marker
    result: dict[str, Any]
    if arguments.camera_on_hand:
        expected = [compose(inverse(compose(T, Y)), X) for T in robot]
        result = {"T_ee_camera": _pose_to_dict(Y), "T_base_sheet": _pose_to_dict(X)}
    else:
        expected = [compose(inverse(X), compose(T, Y)) for T in robot]
        result = {
            "T_base_camera": _pose_to_dict(X),
            "T_ee_sheet": _pose_to_dict(Y),
            **_estimate_error(solved.covariance, X),
        }
    left_out = {str(seen[k].path) for k in solved.left_out}
    rows = _compute_residuals(pictures, {p.path: [T] for p, T in zip(seen, expected, strict=True)}, left_out)
    return {
        "mode": "camera-on-hand" if arguments.camera_on_hand else "sheet-on-hand",
        **result,
        **_summarize_fit(rows),
        "turned_deg": math.degrees(solved.spread_rad),
        "pictures": rows,
    }


def _solve_with_known_hand_pose(
    pictures: list[Picture], seen: list[Picture], robot: list[PoseTuple], T_ee_sheet: PoseTuple
) -> dict[str, Any]:
    """The place of the sheet on the hand is known, so in every picture it is a sheet of known place."""
    from anchors.camera_rig import View, solve_rig
    from anchors.pose import compose, inverse

    known = {str(p.path): compose(T, T_ee_sheet) for p, T in zip(seen, robot, strict=True)}
    views = [View("camera", str(p.path), p.sightings[0].T_camera_sheet, p.sightings[0].covariance) for p in seen]
    rig = solve_rig(views, known)
    at = rig.cameras["camera"]
    rows = _compute_residuals(pictures, {p.path: [compose(inverse(at), known[str(p.path)])] for p in seen}, set())
    return {
        "mode": "sheet-in-hand",
        "T_base_camera": _pose_to_dict(at),
        **_estimate_error(rig.covariances["camera"], at),
        **_summarize_fit(rows),
        "pictures": rows,
    }


def _solve_from_known_sheets(pictures: list[Picture], arguments: argparse.Namespace) -> dict[str, Any]:
    from anchors.camera_rig import View, solve_rig
    from anchors.pose import compose, inverse
    from anchors.robot_world import CalibrationError

    views = [
        View(picture.camera_name, one.anchor_id, one.T_camera_sheet, one.covariance)
        for picture in pictures
        for one in picture.sightings
        if not one.ambiguous
    ]
    if not views:
        raise CalibrationError(_format_no_sheet_found(len(pictures)))
    blind = {picture.camera_name for picture in pictures} - {view.camera for view in views}
    if blind:
        raise CalibrationError(f"camera {', '.join(sorted(blind))} saw no sheet: {_NO_SHEET_HINT}")
    rig = solve_rig(views, dict(arguments.at))
    expected = {
        p.path: [compose(inverse(rig.cameras[p.camera_name]), rig.sheets[one.anchor_id]) for one in p.sightings]
        for p in pictures
    }
    rows = _compute_residuals(pictures, expected, set())
    cameras = {
        name: {"T_base_camera": _pose_to_dict(at), **_estimate_error(rig.covariances[name], at)}
        for name, at in rig.cameras.items()
    }
    return {
        "mode": "sheets-of-known-place",
        **(next(iter(cameras.values())) if len(cameras) == 1 else {"cameras": cameras}),
        "sheets": {name: {"T_base_sheet": _pose_to_dict(at)} for name, at in rig.sheets.items()},
        **_summarize_fit(rows),
        "pictures": rows,
    }


_NO_SHEET_HINT: Final = (
    "are --sheet and its size those of the print, are the pictures sharp, is the whole sheet in them?"
)


def _format_no_sheet_found(n: int) -> str:
    return f"no sheet was found in {n} picture{'s' * (n != 1)}: {_NO_SHEET_HINT}"


# --- what is said -----------------------------------------------------------------------------------------------------


def _compute_residuals(
    pictures: list[Picture], expected: dict[Path, list[PoseTuple]], left_out: set[str]
) -> list[dict[str, Any]]:
    """Per picture and sheet: how far the sheet is seen from where the result puts it, in space and in the picture."""
    import numpy as np

    from anchors.pose import distance, quat_angle
    from anchors.sheet import Sheet

    rows: list[dict[str, Any]] = []
    for picture in pictures:
        if not picture.sightings:
            rows.append({"file": picture.path.name, "camera": picture.camera_name, "found": False})
        for one, T in zip(picture.sightings, expected.get(picture.path, []), strict=False):
            corners = Sheet(one.anchor_id, one.edge_m).marker_corners.reshape(-1, 3)
            off = picture.camera.project(corners, one.T_camera_sheet) - picture.camera.project(corners, T)
            rows.append(
                {
                    "file": picture.path.name,
                    "camera": picture.camera_name,
                    "found": True,
                    "sheet": one.anchor_id,
                    "used": str(picture.path) not in left_out,
                    "residual_mm": 1e3 * distance(one.T_camera_sheet[0], T[0]),
                    "residual_deg": math.degrees(quat_angle(one.T_camera_sheet[1], T[1])),
                    "residual_px": float(np.sqrt(np.mean(np.sum(off**2, axis=1)))),
                    "markers": one.markers,
                }
            )
    return rows


def _summarize_fit(rows: list[dict[str, Any]]) -> dict[str, Any]:
    used = [row for row in rows if row.get("used")]

    def rms(key: str) -> float:
        return math.sqrt(sum(row[key] ** 2 for row in used) / max(len(used), 1))

    fit = {f"{key}_rms": rms(key) for key in ("residual_mm", "residual_deg", "residual_px")}
    return {"used": len(used), "left_out": sum(row.get("used") is False for row in rows), **fit}


def _estimate_error(covariance: tuple[float, ...], at: PoseTuple) -> dict[str, float]:
    """95 % bound of the position, standard deviation of the rotation, from what the pictures scatter."""
    from anchors.alignment import position_error_p95

    turn = math.sqrt(covariance[21] + covariance[28] + covariance[35])
    return {"error_mm_p95": 1e3 * position_error_p95(covariance, at[0], at[0]), "sigma_deg": math.degrees(turn)}


def _pose_to_dict(T: PoseTuple) -> dict[str, list[float]]:
    return {"position_m": list(T[0]), "quaternion_wxyz": list(T[1])}


def format_calibration(result: dict[str, Any]) -> list[str]:
    """The result for people."""
    lines = []
    for row in result["pictures"]:
        name = row["file"] if row["camera"] in ("", row["file"]) else f"{row['camera']}/{row['file']}"
        if not row["found"]:
            lines.append(f"{name}  no sheet found")
            continue
        note = "" if row["used"] else "  LEFT OUT: contradicts the others"
        lines.append(
            f"{name}  {row['sheet']}  {row['residual_mm']:.2f} mm  {row['residual_deg']:.3f} deg  "
            f"{row['residual_px']:.2f} px{note}"
        )
    lines.append(
        f"{result['used']} used, {result['left_out']} left out; residual rms {result['residual_mm_rms']:.2f} mm, "
        f"{result['residual_deg_rms']:.3f} deg, {result['residual_px_rms']:.2f} px"
    )
    for name, value in _list_poses(result):
        p, q = value["position_m"], value["quaternion_wxyz"]
        place = ", ".join(f"{v:.5f}" for v in p)
        lines.append(f"{name}  p = [{place}] m  q = [{', '.join(f'{v:.6f}' for v in q)}]")
    for name, part in [("", result), *result.get("cameras", {}).items()]:
        if "error_mm_p95" in part:
            said = f"stated error {part['error_mm_p95']:.2f} mm (95 %), {part['sigma_deg']:.3f} deg (sigma)"
            lines.append(f"{name + ': ' if name else ''}{said}")
    return lines


def _list_poses(result: dict[str, Any]) -> list[tuple[str, dict[str, list[float]]]]:
    found = [(key, value) for key, value in result.items() if key.startswith("T_")]
    for kind in ("cameras", "sheets"):
        for name, part in result.get(kind, {}).items():
            found += [(f"{key} of {name}", value) for key, value in part.items() if key.startswith("T_")]
    return found


def calibration_to_toml(result: dict[str, Any]) -> str:
    """The result as a file: poses with their names, and how well they fit."""
    lines = ["# Written by iris-session anchors calibrate-camera. Metres; quaternions w first."]
    lines += [f'mode = "{result["mode"]}"']
    lines += [f"{key} = {result[key]!r}" for key in ("residual_mm_rms", "residual_deg_rms", "residual_px_rms")]
    lines += [f"{key} = {result[key]!r}" for key in ("error_mm_p95", "sigma_deg") if key in result]
    for key, value in result.items():
        if key.startswith("T_"):
            lines += ["", f"[{key}]", *_format_toml_pose(value)]
    for kind in ("cameras", "sheets"):
        for name, part in result.get(kind, {}).items():
            for key, value in part.items():
                if key.startswith("T_"):
                    quoted = name.replace("\\", "\\\\").replace('"', '\\"')
                    lines += ["", f'[{kind}."{quoted}".{key}]', *_format_toml_pose(value)]
    return "\n".join([*lines, ""])


def _format_toml_pose(value: dict[str, list[float]]) -> list[str]:
    return [f"{key} = [{', '.join(repr(v) for v in value[key])}]" for key in ("position_m", "quaternion_wxyz")]


def register_calibrate(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
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
        type=_parse_named_length,
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
        type=parse_pose,
        metavar="X,Y,Z,QW,QX,QY,QZ",
        help="with --poses: the place of the sheet on the hand is known, T_ee_sheet; one picture is enough",
    )
    one.add_argument(
        "--at",
        type=_parse_named_pose,
        action="append",
        default=[],
        metavar="ID=X,Y,Z,QW,QX,QY,QZ",
        help="the place of a sheet is known, T_base_sheet; repeatable",
    )
    one.add_argument("--out", type=Path, metavar="FILE", help="also write the result as TOML")
    add_json_option(one)
    one.set_defaults(run=run_calibrate)


def _parse_named_length(text: str) -> tuple[str, float]:
    name, _, rest = text.rpartition("=")
    return _check_sheet_id(name, text), parse_length(rest)


def _parse_named_pose(text: str) -> tuple[str, PoseTuple]:
    name, _, rest = text.rpartition("=")
    return _check_sheet_id(name, text), parse_pose(rest)


def _check_sheet_id(name: str, text: str) -> str:
    if not name:
        raise argparse.ArgumentTypeError(f"{text!r}: the id of the sheet is missing, for example table=160mm")
    return name


def run_calibrate(arguments: argparse.Namespace) -> int:
    from anchors.robot_world import CalibrationError

    try:
        told = calibrate_cameras(arguments)
    except CalibrationError as error:
        raise CommandError(str(error), status=1) from error
    if arguments.out is not None:
        try:
            arguments.out.write_text(calibration_to_toml(told), encoding="utf-8")
        except OSError as error:
            raise CommandError(f"{arguments.out} cannot be written: {error.strerror}") from error
    if arguments.json:
        print_json(told)
    else:
        print("\n".join(format_calibration(told)))
    return 0


# --- anchors_solve ---


#: Lines about alignments and outliers per tracking frame; `--json` has all.
MAX_LISTED: Final = 12


def register_solve(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    one = actions.add_parser(
        "solve",
        help="solve the alignments of a recording again, and where its sheets lie",
        description="Reads every observation of a recording and solves alignments again, with what was seen before and "
        "after each moment: how far off was each alignment that was in force, which looks contradict it, which sheets "
        "were moved. With two or more sheets also where they lie to each other, as a file for `serve --anchors`.",
        epilog="examples:\n"
        "  iris-session anchors solve sessions/20261121T093000.000000Z-lab/session.rrd\n"
        "  iris-session anchors solve session.rrd --anchors anchors.toml --json\n"
        "  iris-session anchors solve session.rrd --out anchors.toml",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    one.add_argument(
        "recording", type=Path, metavar="RECORDING", help="a .rrd file; later parts are found by their names"
    )
    one.add_argument(
        "--anchors", type=Path, metavar="TOML", help="where the anchors really were (default: as the session had them)"
    )
    one.add_argument("--out", type=Path, metavar="FILE", help="write where the sheets lie, for `serve --anchors`")
    add_json_option(one)
    one.set_defaults(run=run_solve)


def run_solve(arguments: argparse.Namespace) -> int:
    """Exit status 1 when `--out` was asked for and nothing can be written."""
    from iris_session.alignment.resolve import constellation
    from iris_session.alignment.smoother import Anchors
    from iris_session.recording import Recording, read_looks
    from iris_session.session.anchors_file import load_anchors

    given = None if arguments.anchors is None else load_anchors(arguments.anchors)
    with Recording.open(arguments.recording, warn=False) as recording:
        looks = read_looks(recording, make_progress_printer("reading"))
        saved = _load_reference_anchors(recording, given)
        anchors = Anchors(looks, dict(saved.anchors), given)
        results = _resolve_frames(looks, anchors, saved.sizes)
        relative = constellation(looks, _replace_anchors(saved, anchors.last))
        damage = recording.damage + recording.missing
    wanted = arguments.out is not None
    written = _write_constellation(arguments.out, relative) if wanted and relative.solved is not None else ""
    if arguments.json:
        print_json(solution_to_dict(str(arguments.recording), looks, results, relative, damage, written))
    else:
        for line in format_solution(looks, results, relative, damage):
            print(to_printable(line))
        if written:
            print(f"written: {written}    use it: iris-session serve SCENE --anchors {written}")
    if wanted and not written:  # after what was found out all the same
        raise CommandError(f"{arguments.out} is not written: {relative.advice}", status=1)
    return 0


def make_progress_printer(what: str) -> Callable[[int, int], None] | None:
    """Shows how far it is, on a terminal."""
    if not sys.stderr.isatty():
        return None

    def show(done: int, total: int) -> None:
        end = "" if done < total else "\n"
        print(f"\r{what}: {done} of {total}", end=end, file=sys.stderr, flush=True)

    return show


def _load_reference_anchors(recording: Recording, given: Constellation | None) -> Constellation:
    """Where the anchors ought to be: the file, else as the session had them when it began."""
    from anchors.constellation import Constellation

    if given is not None:
        return given
    header = recording.header
    places: dict[str, PoseTuple] = {name: (pose.p, pose.q) for name, pose in header.anchors.items()}
    sizes = {} if header.settings is None else dict(header.settings.anchor_sizes)
    return Constellation(next(iter(places), ""), places, {}, sizes)


def _replace_anchors(saved: Constellation, anchors: dict[str, PoseTuple]) -> Constellation:
    from anchors.constellation import Constellation

    return Constellation(saved.reference, anchors, saved.error_m, saved.sizes)


def _resolve_frames(looks: Looks, anchors: Any, sizes: dict[str, float]) -> list[Result]:
    from iris_session.alignment.resolve import resolve

    by_frame = {frame: [one for one in looks.in_force if one.frame == frame] for frame in looks.looks}
    total = sum(map(len, by_frame.values()))
    show, done = make_progress_printer("solving"), 0
    results = []

    def told() -> None:
        nonlocal done
        done += 1
        if show is not None:
            show(done, total)

    for frame, every in looks.looks.items():
        results.append(resolve(frame, every, by_frame[frame], anchors, sizes, told))
    return results


def _write_constellation(path: Path, relative: Relative) -> str:
    """The constellation as a file for `serve --anchors`."""
    assert relative.solved is not None
    try:
        path.write_text(relative.solved.constellation.to_toml(), encoding="utf-8")
    except OSError as error:
        raise CommandError(f"{path} cannot be written: {error.strerror}") from error
    return str(path)


# --- as text ----------------------------------------------------------------------------------------------------------


def format_solution(looks: Looks, results: list[Result], relative: Relative, damage: list[str]) -> Iterator[str]:
    """Everybody who was to be aligned, then the sheets, then what could not be read."""
    wearers = [one for one in looks.people.values() if one.aligned]
    if not wearers:
        yield "nobody in this recording had a headset to be aligned"
    for person in wearers:
        own = [one for one in results if one.frame.participant == person.id]
        if not own:
            yield f"{person.name} ({person.id}): no observations"
        for result in own:
            yield from _format_frame(person, result)
    yield from _format_sheets(relative)
    if looks.unowned:
        yield f"{looks.unowned} observations over connections whose join is not in this recording"
    if looks.unreadable:
        yield f"{looks.unreadable} recorded messages do not decode"
    yield from (f"damaged: {line}" for line in damage)


def _format_frame(person: Person, r: Result) -> Iterator[str]:
    run = f", run {r.frame.run}" if len(person.runs) > 1 else ""
    run += f", after jump {r.frame.jumps}" if r.frame.jumps else ""
    sheets = ", ".join(f"{name} {n}" for name, n in sorted(r.sheets.items()))
    unused = "".join(f"; {n} {why}" for why, n in r.unused.items())
    yield (
        f"{person.name} ({person.id}), tracking epoch {r.frame.tracking_epoch}{run}: {r.looks} looks from "
        f"{r.viewpoints} places, {r.first_ns * 1e-9:.1f} to {r.last_ns * 1e-9:.1f} s ({sheets}){unused}"
    )
    if r.last.refused:
        yield f"    solved again: refused, {r.last.advice}"
    else:
        tilt = math.degrees(r.last.residual_tilt_rad)
        advice = f"; {r.last.advice}" if r.last.advice else ""
        yield (
            f"    solved again: {_format_mm(r.last.error_at_anchor_m)} at the sheet (95 %), tilt {tilt:.1f} deg{advice}"
        )
    if 2 * r.unused.get("against gravity", 0) > r.looks:
        yield "    most looks contradict the vertical: the sheet does not lie as configured (on the table, on a wall?)"
    yield from _limit_lines(
        [_format_comparison(one) for one in _select_worst(r.compared)], len(r.compared), "alignments"
    )
    told = [
        f"    outlier: '{o.anchor_id}' from place {o.viewpoint_id} at {o.at_ns * 1e-9:.1f} s, {o.looks} looks: "
        f"{_format_mm(o.off_m)}, {math.degrees(o.off_rad):.1f} deg off, "
        f"95 % expected below {_format_mm(o.expected_p95_m)}"
        for o in r.outliers
    ]
    yield from _limit_lines(told[:MAX_LISTED], len(told), "outliers")


def _select_worst(compared: list[Compared]) -> list[Compared]:
    """The worst of them, in order of time."""
    kept = sorted(compared, key=lambda one: -max(one.off_m or 0.0, one.off_end_m or 0.0))[:MAX_LISTED]
    return sorted(kept, key=lambda one: one.live.since_ns)


def _limit_lines(shown: list[str], of: int, what: str) -> Iterator[str]:
    yield from shown
    if of > len(shown):
        yield f"    ... {of - len(shown)} more {what}, which --json lists"


def _format_comparison(one: Compared) -> str:
    a, until = one.live.alignment, one.live.until_ns
    end = "the end" if until < 0 else f"{until * 1e-9:.1f} s"
    kind = a.kind + (" with offset" if a.offset else "")
    head = f"    version {a.version} ({kind}), {one.live.since_ns * 1e-9:.1f} s to {end}"
    if one.off_m is None or one.off_rad is None:
        return f"{head}: nothing to compare with"
    stated = "nothing stated" if one.stated_m is None else f"stated {_format_mm(one.stated_m)}"
    at_end = "" if one.off_end_m is None else f", {_format_mm(one.off_end_m)} at its end"
    solved = "" if one.solved_m is None else f", solved again {_format_mm(one.solved_m)}"
    beyond = "  BEYOND WHAT WAS STATED" if one.beyond else ""
    return f"{head}: {_format_mm(one.off_m)}, {math.degrees(one.off_rad):.2f} deg off{at_end}; {stated}{solved}{beyond}"


def _format_sheets(relative: Relative) -> Iterator[str]:
    if relative.solved is None:
        yield f"sheets to each other: {relative.advice}"
        return
    c = relative.solved.constellation
    for name in sorted(c.anchors):
        (x, y, z), q = c.anchors[name]
        what = "reference" if name == c.reference else f"known to {_format_mm(c.error_m[name])} (95 %)"
        residual = relative.solved.residuals_m.get(name, 0.0)
        turned = ",".join(f"{v:.5g}" for v in q)
        yield (
            f"sheet '{name}': at {x:.4f}, {y:.4f}, {z:.4f} m, turned {turned}; {what}, "
            f"looks scatter {_format_mm(residual)}"
        )
    for headset, epoch, viewpoint, name in relative.solved.rejected:
        participant = headset.split(" ")[0]
        yield f"left out: '{name}' as {participant} saw it from place {viewpoint} in epoch {epoch}, it fits nowhere"
    for moved in relative.moved:
        yield (
            f"MOVED: sheet '{moved.anchor_id}' lies {_format_mm(moved.distance_m)}, "
            f"{math.degrees(moved.angle_rad):.1f} deg "
            "from where it ought to, as seen from the others"
        )
    if relative.unsaid:
        yield f"moved sheets: {relative.unsaid}"


def _format_mm(metres: float) -> str:
    return f"{metres * 1e3:.1f} mm"


# --- as JSON ----------------------------------------------------------------------------------------------------------


def solution_to_dict(
    path: str, looks: Looks, results: list[Result], relative: Relative, damage: list[str], written: str
) -> dict[str, Any]:
    """For `--json`."""
    people = [
        {
            "id": one.id,
            "name": one.name,
            "role": one.role,
            "frames": [_frame_to_dict(r) for r in results if r.frame.participant == one.id],
        }
        for one in looks.people.values()
        if one.aligned
    ]
    return {
        "recording": path,
        "participants": people,
        "constellation": _constellation_to_dict(relative),
        "unowned": looks.unowned,
        "unreadable": looks.unreadable,
        "damage": damage,
        "out": written,
    }


def _frame_to_dict(r: Result) -> dict[str, Any]:
    return {
        "run": r.frame.run,
        "tracking_epoch": r.frame.tracking_epoch,
        "jumps": r.frame.jumps,
        "looks": r.looks,
        "viewpoints": r.viewpoints,
        "sheets": r.sheets,
        "first_s": r.first_ns * 1e-9,
        "last_s": r.last_ns * 1e-9,
        "unused": r.unused,
        "refused": r.last.refused,
        "advice": r.last.advice,
        "T_world_tracking": None if r.last.refused else _pose_to_dict(r.last.T_world_tracking),
        "error_at_anchor_m": None if r.last.refused else r.last.error_at_anchor_m,
        "residual_tilt_rad": r.last.residual_tilt_rad,
        "alignments": [_alignment_to_dict(one) for one in r.compared],
        "outliers": [
            {
                "anchor_id": o.anchor_id,
                "viewpoint_id": o.viewpoint_id,
                "looks": o.looks,
                "off_m": o.off_m,
                "off_rad": o.off_rad,
                "expected_p95_m": o.expected_p95_m,
                "at_s": o.at_ns * 1e-9,
            }
            for o in r.outliers
        ],
    }


def _alignment_to_dict(one: Compared) -> dict[str, Any]:
    a, until = one.live.alignment, one.live.until_ns
    return {
        "version": a.version,
        "kind": a.kind,
        "offset": a.offset,
        "since_s": one.live.since_ns * 1e-9,
        "until_s": None if until < 0 else until * 1e-9,
        "off_m": one.off_m,
        "off_rad": one.off_rad,
        "off_end_m": one.off_end_m,
        "stated_m": one.stated_m,
        "solved_m": one.solved_m,
        "beyond": one.beyond,
    }


def _constellation_to_dict(relative: Relative) -> dict[str, Any]:
    if relative.solved is None:
        return {"advice": relative.advice}
    c = relative.solved.constellation
    sheets = {
        name: {**_pose_to_dict(pose), "error_m": c.error_m[name], "residual_m": relative.solved.residuals_m.get(name)}
        for name, pose in c.anchors.items()
    }
    moved = [{"anchor_id": m.anchor_id, "distance_m": m.distance_m, "angle_rad": m.angle_rad} for m in relative.moved]
    return {
        "reference": c.reference,
        "anchors": sheets,
        "rejected": [list(one) for one in relative.solved.rejected],
        "moved": moved,
        "advice": relative.unsaid,
    }
