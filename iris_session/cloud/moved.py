"""Find a camera that was moved: sheets that it sees are not where its calibration puts them. Times are passed in.

One look is one picture. A look is off when no sheet in it fits, so a sheet that was moved beside one that was not is no
alarm; several looks in a row decide, so one bad detection is none either. `anchors.drift` does not fit here: it has
many detections a second without a covariance of their own, and compares them with each other. `MoveMonitor` is the
pure part, for one camera; `MoveWatch` does its work for all cameras of a cloud in a thread.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Final, NamedTuple

import numpy as np
import numpy.typing as npt

from anchors.camera import CameraModel, pose_from_matrix
from anchors.camera_rig import SheetView, solve_rig
from anchors.detection import SheetDetection, SheetDetector
from anchors.pose import PoseTuple, compose, distance, inverse, quat_angle, quat_conj, quat_mul, quat_to_rotvec
from anchors.sheet import Sheet, SheetError

log = logging.getLogger(__name__)
Floats = npt.NDArray[np.float64]
#: Edges [m] and poses in the world of the session's sheets, by id.
Sheets = Mapping[str, tuple[float, PoseTuple]]

#: Time between looks, and until the next one after a look that contradicts the verdict: a bump is found within a
#: second, for one detection every half second.
LOOK_EVERY_NS: Final = 500_000_000
CONFIRM_EVERY_NS: Final = 150_000_000
#: Time until the next look after one without a sheet: such a picture takes the longest.
BLIND_EVERY_NS: Final = 2_000_000_000
#: Looks in a row that change the verdict.
LOOKS: Final = 3
#: Error of a calibration that states none, 95 % [m].
UNKNOWN_ERROR_M: Final = 0.02
#: Rotation that a calibration is not off by, 95 % [rad]; what a smaller one does at a distance is seen as a shift.
ERROR_RAD: Final = math.radians(1.0)
#: Standard deviations of a detection that are allowed beyond the stated error.
_SIGMAS: Final = 3.0
#: Errors of the print, in addition to the covariance of a picture [m], [rad] per axis.
_FLOOR: Final = (0.0005, math.radians(0.1))


class CameraMove(NamedTuple):
    """By how much a camera is not where its calibration has it: of its centre [m], and of its axes [rad]."""

    shift_m: float
    turn_rad: float

    def __str__(self) -> str:
        return f"by {1e3 * self.shift_m:.0f} mm, {math.degrees(self.turn_rad):.1f} deg"


class _Look(NamedTuple):
    """One picture with sheets in it, the pose that the camera should have, and whether no sheet fits that."""

    off: bool
    seen: tuple[SheetDetection, ...]
    T_world_camera: PoseTuple


class MoveMonitor:
    """Compare the sheets that one camera sees with its calibration.

    Args:
        camera: Intrinsics, for pictures of this size.
        sheets: Sheets of the session.
        error_m: Stated error of the calibration, 95 % [m].
        error_rad: Stated error of its rotation, 95 % [rad].

    Attributes:
        move: The verdict: how far the camera was moved; `None` while it fits, and before the first looks.
        seen_ns: Time of the last look that had a sheet in it; `None` before the first.

    Raises:
        DetectionError: Two sheets have the same id.
    """

    def __init__(
        self, camera: CameraModel, sheets: Sequence[Sheet], *, error_m: float, error_rad: float = ERROR_RAD
    ) -> None:
        self._detector = SheetDetector(sheets, camera)
        self._error = (error_m, error_rad)
        self._looks: deque[_Look] = deque(maxlen=LOOKS)
        self._due_ns: int | None = None
        self.move: CameraMove | None = None
        self.seen_ns: int | None = None

    def is_due(self, now_ns: int) -> bool:
        """Return whether it is time for a look."""
        return self._due_ns is None or now_ns >= self._due_ns or self._due_ns - now_ns > BLIND_EVERY_NS

    def look(
        self,
        color: npt.NDArray[np.uint8],
        T_world_camera: npt.NDArray[Any],
        T_world_sheets: Mapping[str, PoseTuple],
        now_ns: int,
    ) -> CameraMove | None:
        """Detect sheets in a picture and compare them with the calibration.

        Args:
            color: (height, width, 3) uint8, RGB.
            T_world_camera: (4, 4) by the calibration, at the time of the picture.
            T_world_sheets: Poses of the session's anchors.
            now_ns: Time of the picture.

        Returns:
            `move`.

        Raises:
            DetectionError: The picture is not of this camera's size or type.
        """
        self._due_ns = now_ns + BLIND_EVERY_NS  # also of a picture that cannot be used
        seen = self._detector.detect(color[:, :, ::-1])
        return self.add_look(seen, pose_from_matrix(np.asarray(T_world_camera)), T_world_sheets, now_ns)

    def add_look(
        self,
        detections: Sequence[SheetDetection],
        T_world_camera: PoseTuple,
        T_world_sheets: Mapping[str, PoseTuple],
        now_ns: int,
    ) -> CameraMove | None:
        """Add the detections of one picture. Return `move`."""
        seen = tuple(one for one in detections if one.anchor_id in T_world_sheets and not one.ambiguous)
        self._due_ns = now_ns + (LOOK_EVERY_NS if seen else BLIND_EVERY_NS)
        if not seen:
            return self.move
        self.seen_ns = now_ns
        off = all(self._is_off(one, T_world_camera, T_world_sheets[one.anchor_id]) for one in seen)
        self._looks.append(_Look(off, seen, T_world_camera))
        agreed = len(self._looks) == LOOKS and len({look.off for look in self._looks}) == 1
        if agreed:
            self.move = self._measure(T_world_sheets) if off else None
        elif off != (self.move is not None):
            self._due_ns = now_ns + CONFIRM_EVERY_NS
        return self.move

    def _is_off(self, seen: SheetDetection, T_world_camera: PoseTuple, T_world_sheet: PoseTuple) -> bool:
        """Return whether a sheet is further from where it should be than the errors explain, camera frame."""
        p, q = compose(inverse(T_world_camera), T_world_sheet)
        shift = np.subtract(seen.T_camera_sheet[0], p)
        turn = np.array(quat_to_rotvec(quat_mul(seen.T_camera_sheet[1], quat_conj(q))))
        covariance = np.reshape(seen.covariance, (6, 6))
        return any(
            _exceeds(d, covariance[part, part], allowed, floor)
            for d, part, allowed, floor in zip(
                (shift, turn), (slice(0, 3), slice(3, 6)), self._error, _FLOOR, strict=True
            )
        )

    def _measure(self, T_world_sheets: Mapping[str, PoseTuple]) -> CameraMove:
        """Return the move by all detections of the last looks."""
        # Relative to the pose by the calibration, which moves with the body that carries the camera.
        views, known = [], {}
        for number, look in enumerate(self._looks):
            for one in look.seen:
                name = f"{one.anchor_id}@{number}"
                known[name] = compose(inverse(look.T_world_camera), T_world_sheets[one.anchor_id])
                views.append(SheetView("camera", name, one.T_camera_sheet, one.covariance))
        p, q = solve_rig(views, known).cameras["camera"]
        return CameraMove(distance(p, (0.0, 0.0, 0.0)), quat_angle(q, (1.0, 0.0, 0.0, 0.0)))


class MoveWatch:
    """Looks for moved cameras in a thread: one picture at a time, those of other cameras meanwhile are left out.

    Args:
        find_sheets: Returns the sheets of the session.
    """

    def __init__(self, find_sheets: Callable[[], Sheets]) -> None:
        self._find_sheets = find_sheets
        self._pool = ThreadPoolExecutor(1, "iris-moved")
        self._look: Future[None] | None = None
        self._monitors: dict[str, tuple[MoveMonitor, CameraModel, Mapping[str, float]]] = {}

    def offer(
        self,
        name: str,
        camera: CameraModel,
        error_m: float,
        color: npt.NDArray[np.uint8],
        T_world_camera: npt.NDArray[Any],
        now_ns: int,
    ) -> None:
        """Take a picture, if it is time for one of this camera. Returns at once.

        Args:
            name: Name of the camera.
            camera: Its intrinsics.
            error_m: Stated error of its calibration, 95 % [m].
            color: (height, width, 3) uint8, RGB; it must not change afterwards.
            T_world_camera: (4, 4) by the calibration, at the time of the picture.
            now_ns: That time.
        """
        if self._look is not None and not self._look.done():
            return
        if name in self._monitors and not self._monitors[name][0].is_due(now_ns):
            return
        sheets = self._find_sheets()
        sizes = {anchor_id: edge_m for anchor_id, (edge_m, _) in sheets.items()}
        poses = {anchor_id: pose for anchor_id, (_, pose) in sheets.items()}
        if name not in self._monitors or self._monitors[name][1:] != (camera, sizes):
            known = list(_make_sheets(sizes))
            self._monitors[name] = MoveMonitor(camera, known, error_m=error_m), camera, sizes
        if sizes:
            monitor = self._monitors[name][0]
            self._look = self._pool.submit(_look_safely, monitor, color, T_world_camera, poses, now_ns)

    def find_move(self, name: str) -> CameraMove | None:
        """Return how far a camera was moved, `None` where it fits or is not known."""
        found = self._monitors.get(name)
        return None if found is None else found[0].move

    def close(self) -> None:
        """End the thread; a look that has begun is not waited for."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _make_sheets(sizes: Mapping[str, float]) -> Iterator[Sheet]:
    """Yield the sheets of anchors; one whose name or size no sheet can have is no printed sheet."""
    for anchor_id, edge_m in sizes.items():
        with suppress(SheetError):
            yield Sheet(anchor_id, edge_m)


def _look_safely(monitor: MoveMonitor, *picture: Any) -> None:
    try:
        monitor.look(*picture)
    except Exception as error:  # of OpenCV or SciPy, for pictures that cannot be used; others come
        log.warning("a picture was not compared with the calibration: %s", error)


def _exceeds(d: Floats, covariance: Floats, allowed: float, floor: float) -> bool:
    """Return whether a difference (3,) is larger than allowed, and than the noise in its direction beyond that."""
    size = float(np.linalg.norm(d))
    if size <= allowed:
        return False
    way = d / size
    return size - allowed > _SIGMAS * math.sqrt(float(way @ covariance @ way) + floor**2)
