"""Joint calibration of cameras that observe the same sheets: poses of all cameras and sheets in one frame.

Sheets of known pose fix the frame; cameras and other sheets follow from the observations, by weighted robust least
squares over all of them. A sheet that is carried through the room counts as a new one at every instant (`wand@3`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from anchors.camera import apply_increment, pose_from_matrix, pose_to_matrix
from anchors.lie import Array
from anchors.pose import PoseTuple, compose, inverse
from anchors.robot_world import CalibrationError

#: Errors of the print and its pose, in addition to the covariance of a picture: [m], [rad] per axis.
_FLOOR: Final = (0.0003, math.radians(0.05))


@dataclass(frozen=True)
class SheetView:
    """Observation of one sheet by one camera: `T_camera_sheet` with its covariance (36 values, camera frame)."""

    camera: str
    sheet: str
    T_camera_sheet: PoseTuple
    covariance: tuple[float, ...]


@dataclass(frozen=True)
class CameraRig:
    """Poses in the common frame, covariances (36 values, common frame) beside them. `residuals`: per view, distance
    [m] and angle [rad] between the observation and the result."""

    cameras: dict[str, PoseTuple]
    sheets: dict[str, PoseTuple]
    covariances: dict[str, tuple[float, ...]]
    residuals: tuple[tuple[float, float], ...]


def solve_rig(views: Sequence[SheetView], T_base_sheet: Mapping[str, PoseTuple]) -> CameraRig:
    """Solve the poses of cameras and unknown sheets in the frame of the known sheets.

    Args:
        views: Observations of sheets by cameras.
        T_base_sheet: Poses of the known sheets.

    Raises:
        CalibrationError: No view, or a camera is not connected with a known sheet.
    """
    if not views:
        raise CalibrationError("no camera saw a sheet: step closer, light the sheet, check its size and id")
    poses = _initial_guess(views, T_base_sheet)
    names = [*sorted({("camera", v.camera) for v in views}), *sorted({("sheet", v.sheet) for v in views})]
    free = [name for name in names if not (name[0] == "sheet" and name[1] in T_base_sheet)]
    poses, normal, scale = _least_squares(views, poses, free)
    covariance = np.linalg.inv(normal) * scale
    blocks = {
        name[1]: tuple(float(v) for v in covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6].ravel())
        for k, name in enumerate(free)
        if name[0] == "camera"
    }
    differences = [_view_residual(view, poses) for view in views]
    return CameraRig(
        {name: pose_from_matrix(poses[kind, name]) for kind, name in names if kind == "camera"},
        {name: pose_from_matrix(poses[kind, name]) for kind, name in names if kind == "sheet"},
        blocks,
        tuple((float(np.linalg.norm(d[:3])), float(np.linalg.norm(d[3:]))) for d in differences),
    )


_Name = tuple[str, str]


def _initial_guess(views: Sequence[SheetView], known: Mapping[str, PoseTuple]) -> dict[_Name, Array]:
    """Return initial poses, outwards from the known sheets, by one view each."""
    poses: dict[_Name, PoseTuple] = {("sheet", name): T for name, T in known.items()}
    waiting = list(views)
    while waiting:
        left = []
        for view in waiting:
            camera, sheet = ("camera", view.camera), ("sheet", view.sheet)
            if camera in poses and sheet not in poses:
                poses[sheet] = compose(poses[camera], view.T_camera_sheet)
            elif sheet in poses and camera not in poses:
                poses[camera] = compose(poses[sheet], inverse(view.T_camera_sheet))
            elif camera not in poses:
                left.append(view)
        if len(left) == len(waiting):
            names = ", ".join(sorted({view.camera for view in left}))
            raise CalibrationError(
                f"nothing connects camera {names} with a sheet of known place ({', '.join(sorted(known)) or 'none'}): "
                "let it see one of those, or a sheet that another camera sees too"
            )
        waiting = left
    return {name: pose_to_matrix(T) for name, T in poses.items()}


def _least_squares(
    views: Sequence[SheetView], poses: dict[_Name, Array], free: list[_Name]
) -> tuple[dict[_Name, Array], Array, float]:
    from scipy.optimize import least_squares

    floor = np.diag([_FLOOR[0] ** 2] * 3 + [_FLOOR[1] ** 2] * 3)
    whiteners = [np.linalg.inv(np.linalg.cholesky(np.reshape(view.covariance, (6, 6)) + floor)) for view in views]

    def apply_increments(p: Array) -> dict[_Name, Array]:
        out = dict(poses)
        for name, step in zip(free, p.reshape(-1, 6), strict=True):
            out[name] = apply_increment(poses[name], step)
        return out

    def residuals(p: Array) -> Array:
        at = apply_increments(p)
        return np.concatenate([W @ _view_residual(view, at) for W, view in zip(whiteners, views, strict=True)])

    solved = least_squares(residuals, np.zeros(6 * len(free)), loss="huber", f_scale=3.0, x_scale="jac")
    freedom = max(6 * (len(views) - len(free)), 1)
    return (
        apply_increments(solved.x),
        np.asarray(solved.jac.T @ solved.jac),
        max(1.0, 2.0 * float(solved.cost) / freedom),
    )


def _view_residual(view: SheetView, poses: Mapping[_Name, Array]) -> Array:
    """Return predicted minus observed position [m] and rotation [rad] of a sheet (6,), camera frame."""
    from scipy.spatial.transform import Rotation

    seen = pose_to_matrix(view.T_camera_sheet)
    P = np.linalg.inv(poses["camera", view.camera]) @ poses["sheet", view.sheet]
    turn = Rotation.from_matrix(P[:3, :3] @ seen[:3, :3].T).as_rotvec()
    return np.concatenate([P[:3, 3] - seen[:3, 3], turn])
