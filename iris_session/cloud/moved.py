"""Find a camera that was moved: what it sees is not where its calibration puts it. Times are passed in.

What it sees are printed sheets, or where it sees none the robots' surface (`iris_session.cloud.robot_surface`). One
look is one picture; several looks in a row decide, so one bad detection is no alarm. A look at sheets is off when none
of them fits, so a sheet that was moved beside one that was not is no alarm either. `anchors.drift` does not fit here:
it has many detections a second without a covariance of their own, and compares them with each other. `MoveMonitor` and
`RobotMonitor` are the pure part, for one camera; `MoveWatch` does their work for all cameras of a cloud in a thread.
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import Any, Final, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from anchors.camera import CameraModel, pose_from_matrix
from anchors.camera_rig import SheetView, solve_rig
from anchors.detection import SheetDetection, SheetDetector
from anchors.pose import PoseTuple, compose, distance, inverse, quat_angle, quat_conj, quat_mul, quat_to_rotvec
from anchors.sheet import Sheet, SheetError
from iris_session.cloud.frames import DepthFrame
from iris_session.cloud.icp import measure_turn
from iris_session.cloud.pipeline import POSE_NS
from iris_session.cloud.robot_surface import PlacedSurface, SurfaceLook, compare_depth

log = logging.getLogger(__name__)
Floats = npt.NDArray[np.float64]
#: Edges [m] and poses in the world of the session's sheets, by id.
Sheets = Mapping[str, tuple[float, PoseTuple]]

#: Time between looks, and until the next one after a look that contradicts the verdict: a bump is found within a
#: second by a sheet, for one detection every half second, and within two by a robot.
LOOK_EVERY_NS: Final = 500_000_000
ROBOT_EVERY_NS: Final = 1_000_000_000
CONFIRM_EVERY_NS: Final = 150_000_000
#: Time until the next look after one without a sheet: such a picture takes the longest.
BLIND_EVERY_NS: Final = 2_000_000_000
#: Robots decide when sheets have not for so long. Until then they are looked at this often: a camera that sees neither
#: sheets nor robots any more can only be found if it is known to have seen the robots before.
SHEET_NS: Final = 5_000_000_000
#: Looks in a row that change the verdict.
LOOKS: Final = 3
#: Looks at robots agree when their corrections move the camera to within this distance [m].
_AGREE_M: Final = 0.02
#: Error of a calibration that states none, 95 % [m].
UNKNOWN_ERROR_M: Final = 0.02
#: Rotation that a calibration is not off by, 95 % [rad]; what a smaller one does at a distance is seen as a shift.
ERROR_RAD: Final = math.radians(1.0)
#: Standard deviations of a detection that are allowed beyond the stated error.
_SIGMAS: Final = 3.0
#: Errors of the print, in addition to the covariance of a picture [m], [rad] per axis.
_FLOOR: Final = (0.0005, math.radians(0.1))


class CameraMove(NamedTuple):
    """By how much a camera is not where its calibration has it: of its centre [m], and of its axes [rad].

    Both are NaN where that could not be measured.
    """

    shift_m: float
    turn_rad: float

    def __str__(self) -> str:
        if math.isnan(self.shift_m):
            return "by an unknown distance"
        return f"by {1e3 * self.shift_m:.0f} mm, {math.degrees(self.turn_rad):.1f} deg"


class WatchedFrame(NamedTuple):
    """A frame of a camera that is watched.

    Attributes:
        frame: The frame; its arrays must not change afterwards.
        camera: Intrinsics.
        depth_scale_m: Length of one unit of depth [m].
        T_world_camera: (4, 4) by the calibration, at the capture.
        error_m: Stated error of the calibration, 95 % [m].
        body: Name of the body that carries the camera, empty for the world.
    """

    frame: DepthFrame
    camera: CameraModel
    depth_scale_m: float
    T_world_camera: Floats
    error_m: float
    body: str = ""


class _Look(NamedTuple):
    """One picture with sheets in it, the pose that the camera should have, and whether no sheet fits that."""

    off: bool
    seen: tuple[SheetDetection, ...]
    T_world_camera: PoseTuple


class SurfaceFinder(Protocol):
    """The robots of a session."""

    def is_ready(self, capture_ns: int) -> bool:
        """Return whether it knows all that it needs about a session time [ns]; a look waits for it."""
        ...

    def place_surface(self, capture_ns: int, carrier: str) -> PlacedSurface | None:
        """Place the surface of the robots, for a camera on a body; `None` where there is none."""
        ...


class _HasOff(Protocol):
    @property
    def off(self) -> bool: ...


_AnyLook = TypeVar("_AnyLook", bound=_HasOff)


class _Monitor(Generic[_AnyLook]):
    """Looks in a row, and the verdict that they change.

    Attributes:
        move: The verdict: how far the camera was moved; `None` while it fits, and before the first looks.
        seen_ns: Time of the last look that had something to compare in it; `None` before the first.
        decided_ns: Time of the last look that agreed with those before it; `None` before the first.
    """

    def __init__(self) -> None:
        self._looks: deque[_AnyLook] = deque(maxlen=LOOKS)
        self._due_ns: int | None = None
        self.move: CameraMove | None = None
        self.seen_ns: int | None = None
        self.decided_ns: int | None = None

    def is_due(self, now_ns: int) -> bool:
        """Return whether it is time for a look."""
        return self._due_ns is None or now_ns >= self._due_ns or self._due_ns - now_ns > BLIND_EVERY_NS

    def postpone(self, now_ns: int, every_ns: int) -> None:
        """Set when the next look is due, should this one come to nothing."""
        self._due_ns = now_ns + every_ns

    def _take(self, look: _AnyLook, now_ns: int, every_ns: int) -> bool:
        """Take a look. Return whether the last ones agree; if not, and it contradicts the verdict, the next is soon."""
        self.seen_ns, self._due_ns = now_ns, now_ns + every_ns
        self._looks.append(look)
        if len(self._looks) == LOOKS and len({one.off for one in self._looks}) == 1:
            self.decided_ns = now_ns
            return True
        if look.off != (self.move is not None):
            self._due_ns = now_ns + CONFIRM_EVERY_NS
        return False


class MoveMonitor(_Monitor[_Look]):
    """Compare the sheets that one camera sees with its calibration.

    Args:
        camera: Intrinsics, for pictures of this size.
        sheets: Sheets of the session.
        error_m: Stated error of the calibration, 95 % [m].
        error_rad: Stated error of its rotation, 95 % [rad].

    Raises:
        DetectionError: Two sheets have the same id.
    """

    def __init__(
        self, camera: CameraModel, sheets: Sequence[Sheet], *, error_m: float, error_rad: float = ERROR_RAD
    ) -> None:
        super().__init__()
        self._detector = SheetDetector(sheets, camera)
        self._error = (error_m, error_rad)

    def replace_sheets(self, sheets: Sequence[Sheet]) -> None:
        """Look for other sheets from now on. The verdict stays, and so do looks at sheets that are still the same.

        Raises:
            DetectionError: Two sheets have the same id.
        """
        self._detector = SheetDetector(sheets, self._detector.camera)
        edges_m = {one.anchor_id: one.edge_m for one in sheets}
        same = [look for look in self._looks if all(edges_m.get(one.anchor_id) == one.edge_m for one in look.seen)]
        self._looks.clear()
        self._looks.extend(same)

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
        self.postpone(now_ns, BLIND_EVERY_NS)  # also of a picture that cannot be used
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
        if not seen:
            self.postpone(now_ns, BLIND_EVERY_NS)
            return self.move
        off = all(self._is_off(one, T_world_camera, T_world_sheets[one.anchor_id]) for one in seen)
        if self._take(_Look(off, seen, T_world_camera), now_ns, LOOK_EVERY_NS):
            self.move = self._measure(T_world_sheets) if off else None
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


class _RobotLook(NamedTuple):
    """One picture with robots in it, and how far the camera is off, `None` where that is too far to be measured."""

    off: bool
    T_camera_camera: Floats | None


class RobotMonitor(_Monitor[_RobotLook]):
    """Judge looks of one camera at the robots."""

    def __init__(self) -> None:
        super().__init__()
        self._has_fitted = False

    def add_look(self, look: SurfaceLook, T_world_camera: npt.NDArray[Any], now_ns: int) -> CameraMove | None:
        """Add the comparison of one picture.

        Args:
            look: The comparison.
            T_world_camera: (4, 4) by the calibration, at the time of the picture.
            now_ns: Time of the picture.

        Returns:
            `move`.
        """
        # Robots that were never seen may be those of a simulation, in a room without any.
        if not look.verdict or (look.verdict == "lost" and not self._has_fitted):
            self.postpone(now_ns, ROBOT_EVERY_NS)
            return self.move
        pose = np.asarray(T_world_camera)
        # Relative to the pose by the calibration, which moves with the body that carries the camera.
        correction = None if look.verdict == "lost" else np.linalg.inv(pose) @ look.T_world_world @ pose
        off = look.verdict != "fits"
        if off and any(one.off and _disagree(one.T_camera_camera, correction) for one in self._looks):
            self._looks.clear()
        if self._take(_RobotLook(off, correction), now_ns, ROBOT_EVERY_NS):
            self._has_fitted |= not off
            self.move = self._measure() if off else None
        return self.move

    def _measure(self) -> CameraMove:
        """Return the move by the last looks that measured it."""
        found = [one.T_camera_camera for one in self._looks if one.T_camera_camera is not None]
        if not found:
            return CameraMove(math.nan, math.nan)
        shift = np.mean([one[:3, 3] for one in found], axis=0)
        return CameraMove(float(np.linalg.norm(shift)), float(np.mean([measure_turn(one[:3, :3]) for one in found])))


class MoveWatch:
    """Looks for moved cameras in a thread: one picture at a time, of the camera whose last look is the oldest.

    Args:
        find_sheets: Returns the sheets of the session.
        robots: The robots of the session; `None`: only sheets are looked for.
    """

    def __init__(self, find_sheets: Callable[[], Sheets], robots: SurfaceFinder | None = None) -> None:
        self._find_sheets = find_sheets
        self._robots = robots
        self._pool = ThreadPoolExecutor(1, "iris-moved")
        self._look: Future[None] | None = None
        self._by_sheets: dict[str, tuple[MoveMonitor, CameraModel, Mapping[str, float]]] = {}
        self._by_robots: dict[str, RobotMonitor] = {}
        self._robots_ns: dict[str, int] = {}  # captures of the last looks at robots
        self._newest: dict[str, WatchedFrame] = {}  # frames that were not looked at
        self._waiting: dict[str, WatchedFrame] = {}  # for the state of the robots
        self._turns: dict[str, int] = {}  # number of the last look of each camera

    def offer(self, name: str, watched: WatchedFrame) -> None:
        """Take a frame, and begin a look if one is due and none is under way. Returns at once.

        Args:
            name: Name of the camera.
            watched: The frame.
        """
        self._newest[name] = watched
        if self._look is not None and not self._look.done():
            return
        for one in sorted(self._newest, key=lambda camera: self._turns.get(camera, 0)):
            if self._begin_look(one, self._newest[one]):
                del self._newest[one]
                self._turns[one] = max(self._turns.values(), default=0) + 1
                return

    def _begin_look(self, name: str, watched: WatchedFrame) -> bool:
        """Begin the look of a camera that is due. Return whether there is one."""
        now_ns = watched.frame.capture_ns
        seen_ns = self._by_sheets[name][0].seen_ns if name in self._by_sheets else None
        if _has_passed(self._robots_ns.get(name), now_ns):
            kinds = [self._offer_to_robots, self._offer_to_sheets]
        elif _has_passed(seen_ns, now_ns):
            kinds = [self._offer_to_sheets, self._offer_to_robots]
        else:
            kinds = [self._offer_to_sheets]
        looks = (offer(name, watched) for offer in kinds)
        look = next((one for one in looks if one is not None), None)
        self._look = look or self._look
        return look is not None

    def _offer_to_sheets(self, name: str, watched: WatchedFrame) -> Future[None] | None:
        if name in self._by_sheets and not self._by_sheets[name][0].is_due(watched.frame.capture_ns):
            return None
        sheets = self._find_sheets()
        sizes = {anchor_id: edge_m for anchor_id, (edge_m, _) in sheets.items()}
        poses = {anchor_id: pose for anchor_id, (_, pose) in sheets.items()}
        if name not in self._by_sheets or self._by_sheets[name][1] != watched.camera:
            known = list(_make_sheets(sizes))
            self._by_sheets[name] = MoveMonitor(watched.camera, known, error_m=watched.error_m), watched.camera, sizes
        monitor, camera, before = self._by_sheets[name]
        if before != sizes:
            monitor.replace_sheets(list(_make_sheets(sizes)))
            self._by_sheets[name] = monitor, camera, sizes
        frame = watched.frame
        if not sizes:
            monitor.postpone(frame.capture_ns, LOOK_EVERY_NS)
            return None
        arguments = (frame.color, watched.T_world_camera, poses, frame.capture_ns)
        return self._pool.submit(_do_safely, monitor.look, *arguments)

    def _offer_to_robots(self, name: str, watched: WatchedFrame) -> Future[None] | None:
        if self._robots is None:
            return None
        monitor = self._by_robots.setdefault(name, RobotMonitor())
        if name not in self._waiting and monitor.is_due(watched.frame.capture_ns):
            self._waiting[name] = watched
        waiting = self._waiting.get(name)
        if waiting is None:
            return None
        if self._robots.is_ready(waiting.frame.capture_ns):
            del self._waiting[name]
            self._robots_ns[name] = waiting.frame.capture_ns
            monitor.postpone(waiting.frame.capture_ns, ROBOT_EVERY_NS)  # also of a look that fails
            return self._pool.submit(_do_safely, self._look_at_robots, monitor, waiting)
        if abs(watched.frame.capture_ns - waiting.frame.capture_ns) > POSE_NS:
            del self._waiting[name]
        return None

    def _look_at_robots(self, monitor: RobotMonitor, watched: WatchedFrame) -> None:
        assert self._robots is not None
        frame, pose = watched.frame, watched.T_world_camera
        surface = self._robots.place_surface(frame.capture_ns, watched.body)
        if surface is not None:
            look = compare_depth(surface, frame.depth, watched.camera, watched.depth_scale_m, pose, watched.error_m)
            monitor.add_look(look, pose, frame.capture_ns)

    def find_move(self, name: str) -> CameraMove | None:
        """Return how far a camera was moved, `None` where it fits or is not known."""
        sheets = self._by_sheets[name][0] if name in self._by_sheets else None
        robots = self._by_robots.get(name)
        if robots is None or robots.decided_ns is None:
            return None if sheets is None else sheets.move
        if sheets is None or sheets.decided_ns is None or robots.decided_ns - sheets.decided_ns > SHEET_NS:
            return robots.move
        return sheets.move

    def restart(self) -> None:
        """Forget all looks: session time is that of another session."""
        for kept in (self._by_sheets, self._by_robots, self._robots_ns, self._newest, self._waiting):
            kept.clear()

    def close(self) -> None:
        """End the thread; a look that has begun is not waited for."""
        self._pool.shutdown(wait=False, cancel_futures=True)


def _has_passed(since_ns: int | None, now_ns: int) -> bool:
    return since_ns is None or abs(now_ns - since_ns) > SHEET_NS


def _disagree(one: Floats | None, other: Floats | None) -> bool:
    return one is not None and other is not None and bool(np.linalg.norm((one - other)[:3, 3]) > _AGREE_M)


def _make_sheets(sizes: Mapping[str, float]) -> Iterator[Sheet]:
    """Yield the sheets of anchors; one whose name or size no sheet can have is no printed sheet."""
    for anchor_id, edge_m in sizes.items():
        with suppress(SheetError):
            yield Sheet(anchor_id, edge_m)


def _do_safely(look: Callable[..., object], *arguments: Any) -> None:
    try:
        look(*arguments)
    except Exception as error:  # of OpenCV or SciPy, for pictures that cannot be used; others come
        log.warning("a picture was not compared with the calibration: %s", error)


def _exceeds(d: Floats, covariance: Floats, allowed: float, floor: float) -> bool:
    """Return whether a difference (3,) is larger than allowed, and than the noise in its direction beyond that."""
    size = float(np.linalg.norm(d))
    if size <= allowed:
        return False
    way = d / size
    return size - allowed > _SIGMAS * math.sqrt(float(way @ covariance @ way) + floor**2)
