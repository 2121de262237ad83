"""Calibrate cameras by pictures of sheets: on the hand of a robot, or at known poses.

Results are plain objects, as they are printed and written; residuals are those of every picture, in space and in the
picture. The solvers are in `anchors.robot_world` and `anchors.camera_rig`; they are imported where they are used, so
that options and files are read without them.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from anchors.pose import PoseTuple, compose, distance, inverse, pose_to_dict, quat_angle

if TYPE_CHECKING:
    from anchors.camera import CameraModel
    from anchors.detection import SheetDetection

_NO_SHEET_HINT: Final = (
    "are --sheet and its size those of the print, are the pictures sharp, is the whole sheet in them?"
)


@dataclass(frozen=True)
class CalibrationPicture:
    """One picture and the sheets detected in it. `camera_name`: name of its folder."""

    path: Path
    camera_name: str
    camera: CameraModel
    sightings: tuple[SheetDetection, ...]


def solve_from_robot_poses(
    pictures: Sequence[CalibrationPicture],
    poses: Mapping[str, PoseTuple],
    *,
    camera_on_hand: bool = False,
    T_ee_sheet: PoseTuple | None = None,
) -> dict[str, Any]:
    """Solve the pose of one camera by a sheet, one of which moves with the hand of a robot.

    Args:
        pictures: Pictures of the camera, and the sheets in them.
        poses: `T_base_ee` by the name of the picture.
        camera_on_hand: The camera is on the hand, and the sheet does not move.
        T_ee_sheet: Pose of the sheet on the hand, where it is known; one picture is enough then.

    Returns:
        The object that `--json` prints.

    Raises:
        CalibrationError: The pictures do not determine a result.
    """
    from anchors.robot_world import CalibrationError, solve_camera_on_hand, solve_robot_world

    seen = [picture for picture in pictures if picture.sightings]
    if not seen:
        raise CalibrationError(_format_no_sheet_found(len(pictures)))
    robot = [poses[picture.path.name] for picture in seen]
    if T_ee_sheet is not None:
        return _solve_with_known_hand_pose(pictures, seen, robot, T_ee_sheet)
    found = [picture.sightings[0] for picture in seen]
    solver = solve_camera_on_hand if camera_on_hand else solve_robot_world
    solved = solver(robot, [one.T_camera_sheet for one in found], [one.covariance for one in found])
    X, Y = solved.T_base_camera, solved.T_ee_marker
    result: dict[str, Any]
    if camera_on_hand:
        expected = [compose(inverse(compose(T, Y)), X) for T in robot]
        result = {"T_ee_camera": pose_to_dict(Y), "T_base_sheet": pose_to_dict(X)}
    else:
        expected = [compose(inverse(X), compose(T, Y)) for T in robot]
        result = {
            "T_base_camera": pose_to_dict(X),
            "T_ee_sheet": pose_to_dict(Y),
            **_estimate_error(solved.covariance, X),
        }
    left_out = {str(seen[k].path) for k in solved.left_out}
    rows = _compute_residuals(pictures, {p.path: [T] for p, T in zip(seen, expected, strict=True)}, left_out)
    return {
        "mode": "camera-on-hand" if camera_on_hand else "sheet-on-hand",
        **result,
        **_summarize_fit(rows),
        "turned_deg": math.degrees(solved.spread_rad),
        "pictures": rows,
    }


def _solve_with_known_hand_pose(
    pictures: Sequence[CalibrationPicture],
    seen: Sequence[CalibrationPicture],
    robot: Sequence[PoseTuple],
    T_ee_sheet: PoseTuple,
) -> dict[str, Any]:
    """Solve with a known pose of the sheet on the hand: its pose is then known in every picture."""
    from anchors.camera_rig import SheetView, solve_rig

    known = {str(p.path): compose(T, T_ee_sheet) for p, T in zip(seen, robot, strict=True)}
    views = [SheetView("camera", str(p.path), p.sightings[0].T_camera_sheet, p.sightings[0].covariance) for p in seen]
    rig = solve_rig(views, known)
    at = rig.cameras["camera"]
    rows = _compute_residuals(pictures, {p.path: [compose(inverse(at), known[str(p.path)])] for p in seen}, set())
    return {
        "mode": "sheet-in-hand",
        "T_base_camera": pose_to_dict(at),
        **_estimate_error(rig.covariances["camera"], at),
        **_summarize_fit(rows),
        "pictures": rows,
    }


def solve_from_known_sheets(
    pictures: Sequence[CalibrationPicture], known: Mapping[str, PoseTuple], *, at_rest: bool = False
) -> tuple[dict[str, Any], dict[str, tuple[float, ...]]]:
    """Solve the poses of cameras by sheets, of which some are at known poses.

    Args:
        pictures: Pictures of all cameras, and the sheets in them.
        known: `T_base_sheet` by id.
        at_rest: Nothing moved between the pictures of a camera: they share their errors, and count as one.

    Returns:
        The object that `--json` prints, and the covariances of the cameras (36 values, base frame).

    Raises:
        CalibrationError: The pictures do not determine a result.
    """
    from anchors.camera_rig import SheetView, solve_rig
    from anchors.robot_world import CalibrationError

    views = [
        SheetView(picture.camera_name, one.anchor_id, one.T_camera_sheet, one.covariance)
        for picture in pictures
        for one in picture.sightings
        if not one.ambiguous
    ]
    if not views:
        raise CalibrationError(_format_no_sheet_found(len(pictures)))
    blind = {picture.camera_name for picture in pictures} - {view.camera for view in views}
    if blind:
        raise CalibrationError(f"camera {', '.join(sorted(blind))} saw no sheet: {_NO_SHEET_HINT}")
    rig = solve_rig(views, known)
    seen = Counter(picture.camera_name for picture in pictures if picture.sightings)
    covariances = {
        name: tuple(v * (seen[name] if at_rest else 1) for v in covariance)
        for name, covariance in rig.covariances.items()
    }
    expected = {
        p.path: [compose(inverse(rig.cameras[p.camera_name]), rig.sheets[one.anchor_id]) for one in p.sightings]
        for p in pictures
    }
    rows = _compute_residuals(pictures, expected, set())
    cameras = {
        name: {"T_base_camera": pose_to_dict(at), **_estimate_error(covariances[name], at)}
        for name, at in rig.cameras.items()
    }
    result = {
        "mode": "sheets-of-known-place",
        **(next(iter(cameras.values())) if len(cameras) == 1 else {"cameras": cameras}),
        "sheets": {name: {"T_base_sheet": pose_to_dict(at)} for name, at in rig.sheets.items()},
        **_summarize_fit(rows),
        "pictures": rows,
    }
    return result, covariances


def _format_no_sheet_found(n: int) -> str:
    return f"no sheet was found in {n} picture{'s' * (n != 1)}: {_NO_SHEET_HINT}"


def _compute_residuals(
    pictures: Sequence[CalibrationPicture], expected: dict[Path, list[PoseTuple]], left_out: set[str]
) -> list[dict[str, Any]]:
    """Return per picture and sheet the residual between detection and result, in space and in the picture."""
    import numpy as np

    from anchors.sheet import Sheet

    rows: list[dict[str, Any]] = []
    for picture in pictures:
        if not picture.sightings:
            rows.append({"file": picture.path.name, "camera": picture.camera_name, "found": False})
        for one, T in zip(picture.sightings, expected.get(picture.path, []), strict=False):
            corners = Sheet(one.anchor_id, one.edge_m, layout=one.layout).marker_corners.reshape(-1, 3)
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
    """Return the 95 % bound of the position and the standard deviation of the rotation."""
    from anchors.alignment import position_error_p95

    turn = math.sqrt(covariance[21] + covariance[28] + covariance[35])
    return {"error_mm_p95": 1e3 * position_error_p95(covariance, at[0], at[0]), "sigma_deg": math.degrees(turn)}


def calibration_to_toml(result: dict[str, Any]) -> str:
    """Return the result as TOML: named poses and residuals."""
    lines = ["# Written by iris-session. Metres; quaternions w first."]
    lines += [f'mode = "{result["mode"]}"']
    lines += [f"{key} = {result[key]!r}" for key in ("residual_mm_rms", "residual_deg_rms", "residual_px_rms")]
    lines += [f"{key} = {result[key]!r}" for key in ("error_mm_p95", "sigma_deg") if key in result]
    for key, value in result.items():
        if key.startswith("T_"):
            lines += ["", f"[{key}]", *_format_toml_pose(value)]
    for kind in ("cameras", "sheets"):
        for name, part in result.get(kind, {}).items():
            quoted = json.dumps(name, ensure_ascii=False)
            stated = [f"{key} = {part[key]!r}" for key in ("error_mm_p95", "sigma_deg") if key in part]
            lines += ["", f"[{kind}.{quoted}]", *stated] if stated else []
            for key, value in part.items():
                if key.startswith("T_"):
                    lines += ["", f"[{kind}.{quoted}.{key}]", *_format_toml_pose(value)]
    return "\n".join([*lines, ""])


def _format_toml_pose(value: dict[str, list[float]]) -> list[str]:
    return [f"{key} = [{', '.join(repr(v) for v in value[key])}]" for key in ("position_m", "quaternion_wxyz")]
