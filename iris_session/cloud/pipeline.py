"""From frames of one or several cameras to the encoded frames of one cloud. No sockets, no clocks: times are arguments.

The newest frames of the cameras are joined when they were captured within `JOIN_NS` of each other. A camera that has
stopped delivering does not stop the cloud of the others.
"""

from __future__ import annotations

import itertools
from collections import Counter, deque
from collections.abc import Callable, Sequence
from typing import Final, NamedTuple, Protocol

import numpy as np

from anchors.camera import CameraModel, pose_to_matrix
from anchors.pose import PoseTuple
from iris_session.cloud.frames import DepthFrame
from iris_session.cloud.voxels import DepthLimits, Floats, PointSet, Rays, VoxelFilter, choose_voxel_m, make_rays
from iris_session.protocol.names import BudgetClass
from iris_session.streams.cloud import encode_cloud, order_points

MILLISECOND: Final = 1_000_000
#: Captured further apart, frames of two cameras show another world: at walking speed 7 cm.
JOIN_NS: Final = 50 * MILLISECOND
#: A camera without a frame for this long is not waited for.
SILENCE_NS: Final = 500 * MILLISECOND
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


class PipelineCamera(NamedTuple):
    """A camera of a pipeline.

    Attributes:
        name: Its name.
        limits: Which of its pixels count.
        error_m: Stated error of its points, 95 % [m].
        T_body_camera: (4, 4), from its optical frame to the body, or to the world; `None`: each frame has its own.
        body: Name of the body that carries it, empty for the world.
    """

    name: str
    limits: DepthLimits
    error_m: float
    T_body_camera: Floats | None
    body: str = ""


class PipelineSettings(NamedTuple):
    """Settings of a pipeline.

    Attributes:
        points: Points of a cloud at most.
        voxel_m: Least edge of the cells [m].
        min_points: Cells with fewer points are left out.
        min_around: Cells with fewer occupied cells around them are left out.
        classes: Classes that are encoded.
    """

    points: int
    voxel_m: float
    min_points: int = 1
    min_around: int = 0
    classes: tuple[str, ...] = CLASSES


class PlacedFrame(NamedTuple):
    """A frame and the pose of its camera when it was captured."""

    frame: DepthFrame
    T_world_camera: Floats


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
    """The frames of one camera that wait, the oldest first, with the time at which each arrived."""

    def __init__(self, camera: PipelineCamera) -> None:
        self.camera = camera
        self.model: CameraModel | None = None
        self.rays: Rays | None = None
        self.depth_scale_m = 0.001
        self.waiting: deque[tuple[DepthFrame, int]] = deque()
        self.arrived_ns: int | None = None
        self.lacks_pose = False


class CloudPipeline:
    """Join frames, filter their points, and encode them.

        pipeline.open_camera("front", source.camera, source.depth_scale_m)
        pipeline.offer("front", frame, now_ns)
        if frames := pipeline.take_frames(now_ns):
            cloud = pipeline.make_cloud(frames)

    Args:
        settings: Settings of the cloud.
        cameras: At least one.
        clock_ns: Clock by which the stages are measured [ns].
        body_pose: Poses of bodies that carry cameras.
        remover: Removes points of the merged cloud.
        voxels: The filter, by default one that takes numba where it is installed.

    Attributes:
        drops: Frames and points that were left out: `superseded`, `pose`, `join`, `cells` (points), `budget` (points).
    """

    def __init__(
        self,
        settings: PipelineSettings,
        cameras: Sequence[PipelineCamera],
        clock_ns: Callable[[], int],
        *,
        body_pose: BodyPose | None = None,
        remover: PointRemover | None = None,
        voxels: VoxelFilter | None = None,
    ) -> None:
        self.drops: Counter[str] = Counter()
        self._settings = settings
        self._states = {camera.name: _CameraState(camera) for camera in cameras}
        self._clock_ns = clock_ns
        self._body_pose = body_pose
        self._remover = remover
        self._voxels = voxels or VoxelFilter(settings.voxel_m)
        self._next_voxel_m = settings.voxel_m

    def open_camera(self, name: str, model: CameraModel, depth_scale_m: float) -> None:
        """Take the intrinsics of a camera whose source was opened. Frames that wait are dropped."""
        state = self._states[name]
        if model != state.model:
            state.model, state.rays = model, make_rays(model)
        state.depth_scale_m = depth_scale_m
        state.waiting.clear()

    def clear(self) -> None:
        """Drop all frames that wait: the clock by which they were captured is another."""
        for state in self._states.values():
            state.waiting.clear()
            state.arrived_ns = None

    def offer(self, name: str, frame: DepthFrame, now_ns: int) -> None:
        """Take a frame of a camera. It replaces the one before, unless that waits for the pose of its camera."""
        state = self._states[name]
        state.arrived_ns = now_ns
        state.waiting.append((frame, now_ns))
        if len(state.waiting) > MAX_WAITING:
            del state.waiting[-2]  # the oldest stays: its pose is the next to come, or shows that none does
            self.drops["superseded"] += 1

    def list_missing(self, now_ns: int) -> list[str]:
        """Return the cameras that are left out because no frame of theirs came for `SILENCE_NS`."""
        return [name for name, state in self._states.items() if not _is_delivering(state, now_ns)]

    def lacks_pose(self, name: str) -> bool:
        """Return whether the newest frame of a camera was dropped because a pose at its capture is not known."""
        return self._states[name].lacks_pose

    def take_frames(self, now_ns: int) -> dict[str, PlacedFrame]:
        """Return the frames that make the next cloud, by camera; empty while one of them is awaited.

        Args:
            now_ns: Session time [ns].
        """
        placed = {name: one for name, state in self._states.items() if (one := self._place_newest(state, now_ns))}
        awaited = (
            name for name, state in self._states.items() if _is_delivering(state, now_ns) and not state.lacks_pose
        )
        if any(name not in placed for name in awaited):
            return {}
        newest_ns = max((one.frame.capture_ns for one in placed.values()), default=0)
        joined = {name: one for name, one in placed.items() if newest_ns - one.frame.capture_ns <= JOIN_NS}
        self.drops["join"] += len(placed) - len(joined)
        for name in placed:
            self._states[name].waiting.popleft()  # what came after it still waits for its pose
        return joined

    def make_cloud(self, frames: dict[str, PlacedFrame]) -> Cloud:
        """Filter and encode the frames of `take_frames`.

        Raises:
            ValueError: A frame does not fit its camera.
        """
        settings, clock_ns = self._settings, self._clock_ns
        times = [clock_ns()]
        self._voxels.clear(self._next_voxel_m)
        for name, (frame, T_world_camera) in frames.items():
            state = self._states[name]
            if state.rays is None:
                raise ValueError(f"the source of camera {name!r} was not opened: open_camera() comes first")
            self._voxels.add_depth(
                frame.depth,
                frame.color,
                state.rays,
                T_world_camera,
                depth_scale_m=state.depth_scale_m,
                limits=state.camera.limits,
            )
        self.drops["cells"] += self._voxels.overflow
        times.append(clock_ns())
        points = self._voxels.collect(min_points=settings.min_points, min_around=settings.min_around)
        capture_ns = min(one.frame.capture_ns for one in frames.values())
        if self._remover is not None:
            points = self._remover.remove(points, capture_ns)
        times.append(clock_ns())
        voxel_m, n = self._voxels.voxel_m, len(points.positions)
        self._next_voxel_m = choose_voxel_m(voxel_m, n, settings.points, settings.voxel_m)
        if n > settings.points:  # as at the beginning, and when a camera turns to something near
            self.drops["budget"] += n - settings.points
            points = _take_sample(points, settings.points, voxel_m)
        times.append(clock_ns())
        error_m = max(self._states[name].camera.error_m for name in frames)
        encoded = encode_cloud(
            points.positions, points.colors, voxel_m=voxel_m, error_m=error_m, classes=settings.classes
        )
        times.append(clock_ns())
        durations = [(after - before) / MILLISECOND for before, after in itertools.pairwise(times)]
        stages_ms = dict(zip(("voxels", "outliers", "budget", "encode"), durations, strict=True))
        return Cloud(encoded, capture_ns, len(points.positions), voxel_m, error_m, tuple(frames), stages_ms)

    def _place_newest(self, state: _CameraState, now_ns: int) -> PlacedFrame | None:
        """Return the newest frame whose pose is known; drop those before it, and those whose pose does not come."""
        for place in reversed(range(len(state.waiting))):
            frame, _ = state.waiting[place]
            pose = self._find_pose(state.camera, frame)
            if pose is None or (self._remover is not None and not self._remover.is_ready(frame.capture_ns)):
                continue
            self.drops["superseded"] += place
            for _ in range(place):
                state.waiting.popleft()
            state.lacks_pose = False
            return PlacedFrame(frame, pose)
        while state.waiting and now_ns - state.waiting[0][1] > POSE_NS:
            state.waiting.popleft()
            self.drops["pose"] += 1
            state.lacks_pose = True
        return None

    def _find_pose(self, camera: PipelineCamera, frame: DepthFrame) -> Floats | None:
        """Return `T_world_camera` at the capture of a frame."""
        if frame.T_world_camera is not None:
            return np.asarray(frame.T_world_camera, np.float64)
        if camera.T_body_camera is None or not camera.body:
            return camera.T_body_camera
        T_world_body = None if self._body_pose is None else self._body_pose(camera.body, frame.capture_ns)
        return None if T_world_body is None else pose_to_matrix(T_world_body) @ camera.T_body_camera


def _is_delivering(state: _CameraState, now_ns: int) -> bool:
    return state.arrived_ns is not None and now_ns - state.arrived_ns <= SILENCE_NS


def _take_sample(points: PointSet, n: int, voxel_m: float) -> PointSet:
    """Return `n` of the points, a fair sample that keeps points at rest from frame to frame."""
    chosen = order_points(points.positions.T, voxel_m)[:n]
    return PointSet(points.positions[chosen], points.colors[chosen], points.counts[chosen])
