"""Joint calibration of cameras that observe the same sheets: poses of all cameras and sheets in one frame.

Sheets of known pose fix the frame; cameras and other sheets follow from the observations, by weighted robust least
squares over all of them (`anchors.constellation`, without gravity). A sheet that is carried through the room counts as
a new one at every instant (`wand@3`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from anchors.constellation import Edge, ObservationGraph, find_reachable, initial_guess, solve_graph
from anchors.lie import to_quat, to_vec3
from anchors.pose import PoseTuple
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
    """Poses in the common frame, and covariances of those of the cameras (36 values, common frame)."""

    cameras: dict[str, PoseTuple]
    sheets: dict[str, PoseTuple]
    covariances: dict[str, tuple[float, ...]]


def solve_rig(views: Sequence[SheetView], T_base_sheet: Mapping[str, PoseTuple]) -> CameraRig:
    """Solve the poses of cameras and unknown sheets in the frame of the known sheets.

    Args:
        views: Observations of sheets by cameras.
        T_base_sheet: Poses of the known sheets.

    Returns:
        Poses of all cameras and sheets of the views.

    Raises:
        CalibrationError: No view, or a camera is not connected with a known sheet.
    """
    if not views:
        raise CalibrationError("no camera saw a sheet: step closer, light the sheet, check its size and id")
    floor = np.diag([_FLOOR[0] ** 2] * 3 + [_FLOOR[1] ** 2] * 3)
    edges = [
        Edge(v.camera, 0, i, v.sheet, np.array(p), np.array(q), np.reshape(v.covariance, (6, 6)) + floor)
        for i, v in enumerate(views)
        for p, q in [v.T_camera_sheet]
    ]
    reached = find_reachable(edges, T_base_sheet)
    lost = sorted({v.camera for v in views if v.sheet not in reached})
    if lost:
        raise CalibrationError(
            f"nothing connects camera {', '.join(lost)} with a sheet of known place "
            f"({', '.join(sorted(T_base_sheet)) or 'none'}): let it see one of those, or a sheet that another camera "
            "sees too"
        )
    graph = ObservationGraph(edges, T_base_sheet)
    solved = solve_graph(graph, initial_guess(graph), np.ones(len(edges)), loss="huber")
    scale = max(1.0, 2.0 * solved.cost / max(6 * (len(edges) - len(solved.p)), 1))
    poses = [(to_vec3(p), to_quat(q)) for p, q in zip(solved.p, solved.q, strict=True)]
    n = len(graph.unknown)
    names = [camera for camera, _ in graph.headsets]
    seen = {v.sheet for v in views}
    blocks = (solved.covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] * scale for k in range(n, len(poses)))
    return CameraRig(
        dict(zip(names, poses[n:], strict=True)),
        {name: T for name, T in (*T_base_sheet.items(), *zip(graph.unknown, poses[:n], strict=True)) if name in seen},
        {name: tuple(block.ravel().tolist()) for name, block in zip(names, blocks, strict=True)},
    )
