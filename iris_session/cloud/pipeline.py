"""From frames of one or several cameras to the encoded frames of one cloud. No sockets, no clocks: times are arguments.

Frames of the cameras are joined when they were captured within `JOIN_NS` of each other. A camera is waited for while
its next frame can still be one of those: one that is slower, late or has stopped does not stop the cloud of the others.
"""

from __future__ import annotations

import itertools
import math
from collections import Counter, deque
from collections.abc import Callable, Mapping
from statistics import median
from typing import Final, NamedTuple, Protocol

import numpy as np

from anchors.camera import CameraModel, pose_to_matrix
from anchors.pose import PoseTuple
from iris_session.cloud.camera_file import CameraSettings, CloudSettings
from iris_session.cloud.frames import DepthFrame, SourceFrame
from iris_session.cloud.voxels import (
    FULL,
    MIN_AROUND,
    MIN_POINTS,
    DepthLimits,
    Floats,
    PointSet,
    Rays,
    VoxelFilter,
    choose_max_cells,
    choose_voxel_m,
    count_outside,
    make_rays,
)
from iris_session.protocol.names import BudgetClass
from iris_session.streams.cloud import encode_cloud, order_points

MILLISECOND: Final = 1_000_000
SECOND: Final = 1_000_000_000
#: Captured further apart, frames of two cameras show another world: at walking speed 7 cm.
JOIN_NS: Final = 50 * MILLISECOND
#: A camera without a frame for this long, and a period, is not waited for.
SILENCE_NS: Final = 500 * MILLISECOND
#: A camera whose frames arrive later than this after their capture is not waited for: no device needs so long.
LATE_NS: Final = 500 * MILLISECOND
#: A camera whose frames come and are in no cloud for so long, for three periods, and in so many clouds, is left out.
LEFT_OUT_NS: Final = SECOND
LEFT_OUT_CLOUDS: Final = 3
#: Frames by which the period and the delay of a camera are known.
RECENT: Final = 5
#: Time for the pose of a body at the capture of a frame to arrive: states come after what cameras see.
POSE_NS: Final = 200 * MILLISECOND
#: Frames of one camera that wait for a pose.
MAX_WAITING: Final = 3
CLASSES: Final = (BudgetClass.FULL, BudgetClass.HALF, BudgetClass.QUARTER)

#: `T_world_body` by name and session time [ns]; `None` while it is not known.
BodyPose = Callable[[str, int], PoseTuple | None]


class PointRemover(Protocol):
    """Removes points of a cloud, such as those on robots."""

    def is_ready(self, capture_ns: int) -> bool:
        """Return whether it knows all that it needs about a session time [ns]; a frame waits for it."""
        ...

    def remove(self, points: PointSet, capture_ns: int) -> PointSet:
        """Return the points that stay."""
        ...


class PlacedFrame(NamedTuple):
    """A frame of a source, and the pose (4, 4) of its camera when it was captured."""

    source_frame: SourceFrame
    T_world_camera: Floats

    @property
    def capture_ns(self) -> int:
        """Session time of the capture [ns]."""
        return self.source_frame.frame.capture_ns


class Cloud(NamedTuple):
    """One cloud.

    Attributes:
        frames: Encoded frames by class.
        capture_ns: Session time of the oldest of the joined frames [ns].
        n_points: Points in class `full`.
        voxel_m: Edge of the cells [m].
        error_m: Stated error, the largest of the joined cameras' [m].
        cameras: Names of the joined cameras.
        stages_ms: Duration of each stage [ms].
    """

    frames: dict[str, bytes]
    capture_ns: int
    n_points: int
    voxel_m: float
    error_m: float
    cameras: tuple[str, ...]
    stages_ms: dict[str, float]


class _CameraState:
    """One camera: its frames that wait, the oldest first, with the time at which each arrived, and how they come."""

    def __init__(self, settings: CloudSettings, camera: CameraSettings) -> None:
        self.camera = camera
        self.limits = make_limits(settings, camera)
        self.error_m = math.inf if camera.error_mm is None else camera.error_mm / 1000.0
        self.T_body_camera = None if camera.pose is None else camera.pose.to_matrix()
        self.waiting: deque[tuple[SourceFrame, int]] = deque()
        self.lacks_pose = False
        self._rays: tuple[CameraModel, Rays] | None = None
        self.restart()

    def find_rays(self, model: CameraModel) -> Rays:
        """Return the directions of the pixels, computed anew for other intrinsics."""
        if self._rays is None or self._rays[0] != model:
            self._rays = model, make_rays(model)
        return self._rays[1]

    def restart(self) -> int:
        """Forget the frames: those that come next are of another clock. Return how many waited."""
        dropped = len(self.waiting)
        self.waiting.clear()
        self._recent: deque[tuple[int, int]] = deque(maxlen=RECENT)  # times of capture and arrival
        self._shown_ns: int | None = None  # time of the last cloud that it was in, at first of its first frame
        self._clouds_without = 0
        return dropped

    def add(self, new: SourceFrame, now_ns: int) -> None:
        """Take a frame. One from the future counts as captured now."""
        capture_ns = min(new.frame.capture_ns, now_ns)
        self.waiting.append((new._replace(frame=new.frame._replace(capture_ns=capture_ns)), now_ns))
        self._recent.append((capture_ns, now_ns))
        if self._shown_ns is None:
            self._shown_ns = now_ns

    def remove(self, placed: PlacedFrame) -> int:
        """Remove a frame that waits, and those before it. Return how many those were."""
        place = next(place for place, (one, _) in enumerate(self.waiting) if one is placed.source_frame)
        for _ in range(place + 1):
            self.waiting.popleft()
        return place

    @property
    def period_ns(self) -> float:
        """Median time between captures [ns], 0 while it is not known."""
        gaps = [after - before for (before, _), (after, _) in itertools.pairwise(self._recent)]
        return max(0.0, median(gaps)) if gaps else 0.0

    @property
    def late_ns(self) -> int:
        """Greatest time from capture to arrival [ns]."""
        return max((arrived_ns - captured_ns for captured_ns, arrived_ns in self._recent), default=0)

    @property
    def next_ns(self) -> float:
        """Capture of the next frame that it can give: one that waits for its pose, or the one to come."""
        return self.waiting[0][0].frame.capture_ns if self.waiting else self._recent[-1][0] + self.period_ns

    def is_delivering(self, now_ns: int) -> bool:
        return bool(self._recent) and now_ns - self._recent[-1][1] <= SILENCE_NS + self.period_ns

    def note_cloud(self, *, has_it: bool, now_ns: int) -> None:
        """Count a cloud, with a frame of this camera or without."""
        self._clouds_without = 0 if has_it else self._clouds_without + 1
        if has_it:
            self._shown_ns = now_ns

    def is_left_out(self, now_ns: int) -> bool:
        if self._shown_ns is None or self._clouds_without < LEFT_OUT_CLOUDS or not self.is_delivering(now_ns):
            return False
        return now_ns - self._shown_ns >= max(LEFT_OUT_NS, 3.0 * self.period_ns)


class CloudPipeline:
    """Join frames, filter their points, and encode them.

        pipeline.offer("front", SourceFrame(frame, source.camera, source.depth_scale_m), now_ns)
        if frames := pipeline.take_frames(now_ns):
            cloud = pipeline.make_cloud(frames)

    Args:
        settings: The camera file.
        clock_ns: Clock by which the stages are measured [ns].
        body_pose: Poses of bodies that carry cameras.
        remover: Removes points of the merged cloud.
        voxels: The filter, by default one that takes numba where it is installed.

    Attributes:
        drops: Frames and points that were left out: `superseded`, `pose`, `join`, `cells` (points), `budget` (points);
            of clouds without a point also `range` and `box` (points), which say why.
    """

    def __init__(
        self,
        settings: CloudSettings,
        clock_ns: Callable[[], int],
        *,
        body_pose: BodyPose | None = None,
        remover: PointRemover | None = None,
        voxels: VoxelFilter | None = None,
    ) -> None:
        self.drops: Counter[str] = Counter()
        self._settings = settings
        self._states = {camera.name: _CameraState(settings, camera) for camera in settings.cameras}
        self._clock_ns = clock_ns
        self._body_pose = body_pose
        self._remover = remover
        self._voxels = voxels or VoxelFilter(settings.voxel_m, max_cells=choose_max_cells(settings.points))
        self._next_voxel_m = settings.voxel_m
        self._captures: dict[str, int] = {}  # of the last frames that were taken
        self._taken_ns = 0
        self._waited_from_ns: int | None = None  # capture of the frame with which waiting for a camera began

    def clear(self) -> None:
        """Drop all frames that wait: the clock by which they were captured is another."""
        self.drops["superseded"] += sum(state.restart() for state in self._states.values())
        self._captures.clear()
        self._waited_from_ns = None

    def offer(self, name: str, new: SourceFrame, now_ns: int) -> None:
        """Take a frame of a camera. One from the future counts as captured now."""
        state = self._states[name]
        state.add(new, now_ns)
        if len(state.waiting) > MAX_WAITING:
            del state.waiting[-2]  # the oldest stays: its pose or partner is the next to come, or shows that none does
            self.drops["superseded"] += 1

    def is_left_out(self, name: str, now_ns: int) -> bool:
        """Return whether the frames of a camera come, but are captured too long before those of the others."""
        return self._states[name].is_left_out(now_ns)

    def lacks_pose(self, name: str) -> bool:
        """Return whether the newest frame of a camera was dropped because a pose at its capture is not known."""
        return self._states[name].lacks_pose

    def take_frames(self, now_ns: int) -> dict[str, PlacedFrame]:
        """Return the frames that make the next cloud, by camera; empty while one of them is awaited.

        Args:
            now_ns: Session time [ns].
        """
        placed = {name: found for name, state in self._states.items() if (found := self._list_placed(state, now_ns))}
        joined, left_out = _join_frames(placed)
        for name, one in left_out:
            self.drops["superseded"] += self._states[name].remove(one)
            self.drops["join"] += 1
        if not joined:
            self._waited_from_ns = None
            return {}
        behind_ns = min(one.capture_ns for one in joined.values())
        if self._waited_from_ns is None:
            self._waited_from_ns = behind_ns
        if any(
            self._is_awaited(state, behind_ns, now_ns) for name, state in self._states.items() if name not in joined
        ):
            return {}
        self._waited_from_ns, self._taken_ns = None, now_ns
        for name, state in self._states.items():
            state.note_cloud(has_it=name in joined, now_ns=now_ns)
        for name, one in joined.items():
            self.drops["superseded"] += self._states[name].remove(one)
            self._captures[name] = one.capture_ns
        return joined

    def make_cloud(self, frames: dict[str, PlacedFrame]) -> Cloud:
        """Filter and encode the frames of `take_frames`.

        Raises:
            ValueError: A frame does not fit its camera.
        """
        settings, clock_ns = self._settings, self._clock_ns
        times = [clock_ns()]
        self._voxels.clear(self._next_voxel_m)
        for name, ((frame, model, depth_scale_m), T_world_camera) in frames.items():
            state = self._states[name]
            self._voxels.add_depth(
                frame.depth,
                frame.color,
                state.find_rays(model),
                T_world_camera,
                depth_scale_m=depth_scale_m,
                limits=state.limits,
            )
        self.drops["cells"] += self._voxels.overflow
        times.append(clock_ns())
        points = self._voxels.collect(min_points=MIN_POINTS, min_around=MIN_AROUND)
        capture_ns = min(one.capture_ns for one in frames.values())
        if self._remover is not None:  # a robot that moves is where each of the cameras saw it
            for at_ns in sorted({one.capture_ns for one in frames.values()}):
                points = self._remover.remove(points, at_ns)
        times.append(clock_ns())
        voxel_m, n = self._voxels.voxel_m, len(points.positions)
        for name, ((frame, model, depth_scale_m), T_world_camera) in frames.items() if not n else ():
            state = self._states[name]
            outside = count_outside(frame.depth, state.find_rays(model), T_world_camera, depth_scale_m, state.limits)
            self.drops.update(dict(zip(("range", "box"), outside, strict=True)))
        self._next_voxel_m = choose_voxel_m(voxel_m, self._count_needed(n), settings.points, settings.voxel_m)
        if n > settings.points:  # as at the beginning, and when a camera turns to something near
            self.drops["budget"] += n - settings.points
            # A fair sample, which keeps points at rest from frame to frame.
            chosen = order_points(points.positions.T, voxel_m)[: settings.points]
            points = PointSet(points.positions[chosen], points.colors[chosen], points.counts[chosen])
        times.append(clock_ns())
        error_m = max(self._states[name].error_m for name in frames)
        encoded = encode_cloud(points.positions, points.colors, voxel_m=voxel_m, error_m=error_m, classes=CLASSES)
        times.append(clock_ns())
        durations = [(after - before) / MILLISECOND for before, after in itertools.pairwise(times)]
        stages_ms = dict(zip(("voxels", "outliers", "budget", "encode"), durations, strict=True))
        return Cloud(encoded, capture_ns, len(points.positions), voxel_m, error_m, tuple(frames), stages_ms)

    def _count_needed(self, n_points: int) -> int:
        """Return the number of points by which the next cells are chosen: more where the filter is too full."""
        voxels, budget = self._voxels, self._settings.points
        if voxels.overflow:
            return max(n_points, 2 * budget)  # how many cells would have been enough is not known
        return max(n_points, math.ceil(budget * voxels.n_cells / (FULL * voxels.max_cells)))

    def _is_awaited(self, state: _CameraState, behind_ns: int, now_ns: int) -> bool:
        """Return whether a frame of a camera can still come that was captured within `JOIN_NS` of those here."""
        if state.lacks_pose or not state.is_delivering(now_ns) or state.next_ns > behind_ns + JOIN_NS:
            return False
        if state.waiting:
            return True  # for `POSE_NS` at most
        assert self._waited_from_ns is not None
        return state.late_ns <= LATE_NS and now_ns <= self._waited_from_ns + JOIN_NS + state.late_ns

    def _list_placed(self, state: _CameraState, now_ns: int) -> list[PlacedFrame]:
        """Return the frames of a camera whose pose is known; drop those that come too late, or whose pose does."""
        if now_ns - self._taken_ns <= SILENCE_NS:  # else times may have gone back
            others = (at_ns for name, at_ns in self._captures.items() if name != state.camera.name)
            first_ns = max(others, default=0) - JOIN_NS
            while state.waiting and state.waiting[0][0].frame.capture_ns < first_ns:
                state.waiting.popleft()
                self.drops["join"] += 1
        placed = []
        for new, _ in state.waiting:
            pose = self._find_pose(state, new.frame)
            if pose is not None and (self._remover is None or self._remover.is_ready(new.frame.capture_ns)):
                placed.append(PlacedFrame(new, pose))
        if placed:
            state.lacks_pose = False
            return placed
        while state.waiting and now_ns - state.waiting[0][1] > POSE_NS:
            state.waiting.popleft()
            self.drops["pose"] += 1
            state.lacks_pose = True
        return placed

    def _find_pose(self, state: _CameraState, frame: DepthFrame) -> Floats | None:
        """Return `T_world_camera` at the capture of a frame."""
        if frame.T_world_camera is not None:
            return np.asarray(frame.T_world_camera, np.float64)
        body = state.camera.body
        if state.T_body_camera is None or not body:
            return state.T_body_camera
        T_world_body = None if self._body_pose is None else self._body_pose(body, frame.capture_ns)
        return None if T_world_body is None else pose_to_matrix(T_world_body) @ state.T_body_camera


def make_limits(settings: CloudSettings, camera: CameraSettings) -> DepthLimits:
    """Return which pixels of a camera count."""
    return DepthLimits(settings.low, settings.high, camera.nearest_m, camera.farthest_m)


def _join_frames(
    placed: Mapping[str, list[PlacedFrame]],
) -> tuple[dict[str, PlacedFrame], list[tuple[str, PlacedFrame]]]:
    """Return frames that were captured within `JOIN_NS` of each other, by camera, and those that are too old for it.

    The camera that is behind sets the time: of each other one it is the frame nearest to its newest.
    """
    left = {name: list(frames) for name, frames in placed.items()}
    too_old: list[tuple[str, PlacedFrame]] = []
    while left:
        behind_ns = min(frames[-1].capture_ns for frames in left.values())
        found = {name: min(frames, key=lambda one: abs(one.capture_ns - behind_ns)) for name, frames in left.items()}
        oldest = min(found, key=lambda name: found[name].capture_ns)
        newest_ns = max(one.capture_ns for one in found.values())
        if newest_ns - found[oldest].capture_ns <= JOIN_NS:
            return found, too_old
        too_old.append((oldest, found[oldest]))
        left[oldest] = [one for one in left[oldest] if one.capture_ns > found[oldest].capture_ns]
        if not left[oldest]:
            del left[oldest]
    return {}, too_old
