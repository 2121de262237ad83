"""What `iris-session anchors calibrate-camera` does: pictures and poses in, the place of cameras and residuals out."""

from __future__ import annotations

import argparse
import csv
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from iris_session.cli.common import CommandError

if TYPE_CHECKING:
    from anchors.camera import Camera
    from anchors.detection import Sighting
    from anchors.pose import PoseTuple
    from anchors.sheet import Sheet

PICTURES: Final = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
COLUMNS: Final = ("image", "x", "y", "z", "qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Picture:
    """One picture, and what was found in it. `camera_name`: the folder it lies in."""

    path: Path
    camera_name: str
    camera: Camera
    sightings: tuple[Sighting, ...]


def calibrate(arguments: argparse.Namespace) -> dict[str, Any]:
    """The result as it is printed with `--json`. Raises `CommandError`, and `CalibrationError` where the pictures do
    not determine a result."""
    sheets = _sheets(arguments)
    _check_options(arguments, sheets)
    if arguments.at:
        return _by_sheets_of_known_place(_pictures(arguments.folder, arguments.intrinsics, sheets), arguments)
    poses = read_poses(arguments.poses)
    pictures = _pictures(arguments.folder, arguments.intrinsics, sheets)
    if len({picture.camera_name for picture in pictures}) > 1:
        raise CommandError("--poses calibrates one camera at a time: give the folder of that camera")
    return _by_kinematics(pictures, poses, arguments)


def _sheets(arguments: argparse.Namespace) -> list[Sheet]:
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


def _pictures(folder: Path, intrinsics: Path | None, sheets: list[Sheet]) -> list[Picture]:
    """Every picture of the folder, or of the folders in it, looked through for sheets."""
    if not folder.is_dir():
        raise CommandError(f"{folder} is not a folder")
    folders = [folder] if _files(folder) else [inner for inner in sorted(folder.iterdir()) if inner.is_dir()]
    found = [picture for one in folders for picture in _pictures_of_one(one, intrinsics, sheets)]
    if not found:
        raise CommandError(f"no pictures in {folder}: files that end in {', '.join(PICTURES)}")
    return found


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)


def _pictures_of_one(folder: Path, intrinsics: Path | None, sheets: list[Sheet]) -> list[Picture]:
    import cv2

    from anchors.detection import DetectionError, SheetDetector

    pictures: list[Picture] = []
    detectors: dict[tuple[int, int], SheetDetector] = {}
    for path in _files(folder):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CommandError(f"{path} is not a picture that can be read")
        height, width = image.shape
        if (width, height) not in detectors:
            detectors[width, height] = SheetDetector(sheets, _camera(folder, intrinsics, width, height))
        detector = detectors[width, height]
        try:
            pictures.append(Picture(path, folder.name, detector.camera, tuple(detector.detect(image))))
        except DetectionError as error:
            raise CommandError(f"{path}: {error}") from error
    return pictures


def _camera(folder: Path, given: Path | None, width: int, height: int) -> Camera:
    from anchors.camera import CameraError, parse_camera

    places = [given] if given is not None else [folder / "intrinsics.toml", folder / "intrinsics.txt"]
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


def _by_kinematics(
    pictures: list[Picture], poses: dict[str, PoseTuple], arguments: argparse.Namespace
) -> dict[str, Any]:
    from anchors.pose import compose, inverse
    from anchors.robot_world import CalibrationError, camera_on_hand, solve

    missing = [picture.path.name for picture in pictures if picture.path.name not in poses]
    if missing:
        raise CommandError(f"{arguments.poses} has no line for {missing[0]} ({len(missing)} pictures without a pose)")
    seen = [picture for picture in pictures if picture.sightings]
    if not seen:
        raise CalibrationError(_nothing_seen(len(pictures)))
    robot = [poses[picture.path.name] for picture in seen]
    if arguments.in_hand is not None:
        return _by_known_hand(pictures, seen, robot, arguments.in_hand)
    found = [picture.sightings[0] for picture in seen]
    solver = camera_on_hand if arguments.camera_on_hand else solve
    solved = solver(robot, [one.T_camera_sheet for one in found], [one.covariance for one in found])
    X, Y = solved.T_base_camera, solved.T_ee_marker
    result: dict[str, Any]
    if arguments.camera_on_hand:
        expected = [compose(inverse(compose(T, Y)), X) for T in robot]
        result = {"T_ee_camera": _pose(Y), "T_base_sheet": _pose(X)}
    else:
        expected = [compose(inverse(X), compose(T, Y)) for T in robot]
        result = {"T_base_camera": _pose(X), "T_ee_sheet": _pose(Y), **_stated(solved.covariance, X)}
    left_out = {str(seen[k].path) for k in solved.left_out}
    rows = _rows(pictures, {p.path: [T] for p, T in zip(seen, expected, strict=True)}, left_out)
    return {
        "mode": "camera-on-hand" if arguments.camera_on_hand else "sheet-on-hand",
        **result,
        **_fit(rows),
        "turned_deg": math.degrees(solved.spread_rad),
        "pictures": rows,
    }


def _by_known_hand(
    pictures: list[Picture], seen: list[Picture], robot: list[PoseTuple], T_ee_sheet: PoseTuple
) -> dict[str, Any]:
    """The place of the sheet on the hand is known, so in every picture it is a sheet of known place."""
    from anchors.camera_rig import View, solve_rig
    from anchors.pose import compose, inverse

    known = {str(p.path): compose(T, T_ee_sheet) for p, T in zip(seen, robot, strict=True)}
    views = [View("camera", str(p.path), p.sightings[0].T_camera_sheet, p.sightings[0].covariance) for p in seen]
    rig = solve_rig(views, known)
    at = rig.cameras["camera"]
    rows = _rows(pictures, {p.path: [compose(inverse(at), known[str(p.path)])] for p in seen}, set())
    return {
        "mode": "sheet-in-hand",
        "T_base_camera": _pose(at),
        **_stated(rig.covariances["camera"], at),
        **_fit(rows),
        "pictures": rows,
    }


def _by_sheets_of_known_place(pictures: list[Picture], arguments: argparse.Namespace) -> dict[str, Any]:
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
        raise CalibrationError(_nothing_seen(len(pictures)))
    blind = {picture.camera_name for picture in pictures} - {view.camera for view in views}
    if blind:
        raise CalibrationError(f"camera {', '.join(sorted(blind))} saw no sheet: {_LOOK}")
    rig = solve_rig(views, dict(arguments.at))
    expected = {
        p.path: [compose(inverse(rig.cameras[p.camera_name]), rig.sheets[one.anchor_id]) for one in p.sightings]
        for p in pictures
    }
    rows = _rows(pictures, expected, set())
    cameras = {
        name: {"T_base_camera": _pose(at), **_stated(rig.covariances[name], at)} for name, at in rig.cameras.items()
    }
    return {
        "mode": "sheets-of-known-place",
        **(next(iter(cameras.values())) if len(cameras) == 1 else {"cameras": cameras}),
        "sheets": {name: {"T_base_sheet": _pose(at)} for name, at in rig.sheets.items()},
        **_fit(rows),
        "pictures": rows,
    }


_LOOK: Final = "are --sheet and its size those of the print, are the pictures sharp, is the whole sheet in them?"


def _nothing_seen(n: int) -> str:
    return f"no sheet was found in {n} picture{'s' * (n != 1)}: {_LOOK}"


# --- what is said -----------------------------------------------------------------------------------------------------


def _rows(pictures: list[Picture], expected: dict[Path, list[PoseTuple]], left_out: set[str]) -> list[dict[str, Any]]:
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


def _fit(rows: list[dict[str, Any]]) -> dict[str, Any]:
    used = [row for row in rows if row.get("used")]

    def rms(key: str) -> float:
        return math.sqrt(sum(row[key] ** 2 for row in used) / max(len(used), 1))

    fit = {f"{key}_rms": rms(key) for key in ("residual_mm", "residual_deg", "residual_px")}
    return {"used": len(used), "left_out": sum(row.get("used") is False for row in rows), **fit}


def _stated(covariance: tuple[float, ...], at: PoseTuple) -> dict[str, float]:
    """95 % bound of the position, standard deviation of the rotation, from what the pictures scatter."""
    from anchors.alignment import position_error_p95

    turn = math.sqrt(covariance[21] + covariance[28] + covariance[35])
    return {"error_mm_p95": 1e3 * position_error_p95(covariance, at[0], at[0]), "sigma_deg": math.degrees(turn)}


def _pose(T: PoseTuple) -> dict[str, list[float]]:
    return {"position_m": list(T[0]), "quaternion_wxyz": list(T[1])}


def lines_of(told: dict[str, Any]) -> list[str]:
    """The result for people."""
    lines = []
    for row in told["pictures"]:
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
        f"{told['used']} used, {told['left_out']} left out; residual rms {told['residual_mm_rms']:.2f} mm, "
        f"{told['residual_deg_rms']:.3f} deg, {told['residual_px_rms']:.2f} px"
    )
    for name, value in _named_poses(told):
        p, q = value["position_m"], value["quaternion_wxyz"]
        place = ", ".join(f"{v:.5f}" for v in p)
        lines.append(f"{name}  p = [{place}] m  q = [{', '.join(f'{v:.6f}' for v in q)}]")
    for name, part in [("", told), *told.get("cameras", {}).items()]:
        if "error_mm_p95" in part:
            said = f"stated error {part['error_mm_p95']:.2f} mm (95 %), {part['sigma_deg']:.3f} deg (sigma)"
            lines.append(f"{name + ': ' if name else ''}{said}")
    return lines


def _named_poses(told: dict[str, Any]) -> list[tuple[str, dict[str, list[float]]]]:
    found = [(key, value) for key, value in told.items() if key.startswith("T_")]
    for kind in ("cameras", "sheets"):
        for name, part in told.get(kind, {}).items():
            found += [(f"{key} of {name}", value) for key, value in part.items() if key.startswith("T_")]
    return found


def to_toml(told: dict[str, Any]) -> str:
    """The result as a file: poses with their names, and how well they fit."""
    lines = ["# Written by iris-session anchors calibrate-camera. Metres; quaternions w first."]
    lines += [f'mode = "{told["mode"]}"']
    lines += [f"{key} = {told[key]!r}" for key in ("residual_mm_rms", "residual_deg_rms", "residual_px_rms")]
    lines += [f"{key} = {told[key]!r}" for key in ("error_mm_p95", "sigma_deg") if key in told]
    for key, value in told.items():
        if key.startswith("T_"):
            lines += ["", f"[{key}]", *_toml_pose(value)]
    for kind in ("cameras", "sheets"):
        for name, part in told.get(kind, {}).items():
            for key, value in part.items():
                if key.startswith("T_"):
                    quoted = name.replace("\\", "\\\\").replace('"', '\\"')
                    lines += ["", f'[{kind}."{quoted}".{key}]', *_toml_pose(value)]
    return "\n".join([*lines, ""])


def _toml_pose(value: dict[str, list[float]]) -> list[str]:
    return [f"{key} = [{', '.join(repr(v) for v in value[key])}]" for key in ("position_m", "quaternion_wxyz")]
