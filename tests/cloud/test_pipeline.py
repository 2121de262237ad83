"""Pipeline: which frames are joined, what happens to the others, the budget of points, poses of bodies, removal."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import pytest

from anchors.camera import CameraModel
from anchors.pose import PoseTuple
from iris_session.cloud.camera_file import CameraPose, CameraSettings, CloudSettings
from iris_session.cloud.frames import DepthFrame, SourceFrame
from iris_session.cloud.pipeline import CloudPipeline
from iris_session.cloud.voxels import PointSet, VoxelFilter
from iris_session.streams.cloud import decode_cloud

MS = 1_000_000
CAMERA = CameraModel(160, 120, 140.0, 140.0, 79.5, 59.5)
VOXEL_M = 0.03


def make_frame(capture_ms: float, depth_mm: int = 1500, color: int = 100, **changes: Any) -> SourceFrame:
    """Return a wall before the camera."""
    depth = np.full((120, 160), depth_mm, np.uint16)
    frame = DepthFrame(depth, np.full((120, 160, 3), color, np.uint8), round(capture_ms * MS))
    return SourceFrame(frame._replace(**changes), CAMERA, 0.001)


def make_pipeline(
    *names: str, points: int = 50_000, body: str = "", voxels: VoxelFilter | None = None, **options: Any
) -> CloudPipeline:
    """Return a pipeline of cameras that look along z, side by side every 10 m. The last one is on a body."""
    cameras = tuple(
        CameraSettings(
            name=name,
            source="folder",
            error_mm=10.0 * (i + 1),
            pose=CameraPose((10.0 * i, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
            body=body if i == len(names) - 1 else "",
        )
        for i, name in enumerate(names)
    )
    low, high = (-100.0, -100.0, -100.0), (100.0, 100.0, 100.0)
    return CloudPipeline(
        CloudSettings(stream="room", points=points, voxel_m=VOXEL_M, low=low, high=high, cameras=cameras),
        iter(range(0, 10**9, MS)).__next__,
        voxels=VoxelFilter(VOXEL_M, use_numba=False) if voxels is None else voxels,
        **options,
    )


def test_one_camera_gives_its_newest_frame() -> None:
    pipeline = make_pipeline("front")
    assert pipeline.take_frames(0) == {}
    for at in (0, 33, 66):
        pipeline.offer("front", make_frame(at), at * MS)
    frames = pipeline.take_frames(66 * MS)
    assert frames["front"].capture_ns == 66 * MS
    assert pipeline.drops["superseded"] == 2
    cloud = pipeline.make_cloud(frames)
    assert (cloud.capture_ns, cloud.cameras, cloud.voxel_m) == (66 * MS, ("front",), VOXEL_M)
    assert cloud.stages_ms == {"voxels": 1.0, "outliers": 1.0, "budget": 1.0, "encode": 1.0}
    assert set(cloud.frames) == {"full", "half", "quarter"}
    shown = decode_cloud(cloud.frames["full"])
    assert len(shown.positions) == cloud.n_points > 1000
    assert np.allclose(shown.positions[:, 2], 1.5, atol=0.001)
    assert shown.error_m == pytest.approx(0.01)
    assert pipeline.take_frames(70 * MS) == {}, "a frame is used once"


def test_a_frame_that_is_too_old_to_be_joined_is_left_out_alone_and_counted() -> None:
    pipeline = make_pipeline("left", "right")
    pipeline.offer("left", make_frame(40), 50 * MS)
    pipeline.offer("right", make_frame(100), 110 * MS)
    assert pipeline.take_frames(110 * MS) == {}, "the next one of the left camera can still be joined"
    assert pipeline.drops["join"] == 1
    pipeline.offer("left", make_frame(106), 116 * MS)
    assert set(pipeline.take_frames(116 * MS)) == {"left", "right"}
    assert pipeline.drops == {"join": 1, "superseded": 0}


class Sight(NamedTuple):
    """Clouds that were taken after the first second: the time [ms] and the cameras of each."""

    clouds: list[tuple[float, frozenset[str]]]
    pipeline: CloudPipeline
    left_out: set[str]

    def count(self, *names: str) -> int:
        return sum(shown >= set(names) for _, shown in self.clouds)


def run_cameras(*cameras: Callable[[int], tuple[float, float]], seconds: float = 3.0) -> Sight:
    """Run cameras "0", "1", ..., each of which gives the times of capture and arrival of its frame by number [ms]."""
    pipeline = make_pipeline(*(str(i) for i in range(len(cameras))))
    arrivals = []
    for i, camera in enumerate(cameras):
        number = 0
        while (times := camera(number))[1] < 1000.0 * seconds:
            arrivals.append((times[1], times[0], str(i)))
            number += 1
    arrivals.sort(reverse=True)
    sight = Sight([], pipeline, set())
    for at in range(0, round(1000 * seconds), 5):
        while arrivals and arrivals[-1][0] <= at:
            _, captured, name = arrivals.pop()
            pipeline.offer(name, make_frame(captured), at * MS)
        frames = pipeline.take_frames(at * MS)
        if frames and at >= 1000:
            sight.clouds.append((at, frozenset(frames)))
        sight.left_out.update(name for name in map(str, range(len(cameras))) if pipeline.is_left_out(name, at * MS))
    return sight


def capture_evenly(hz: float, phase_ms: float = 0.0, late_ms: float = 5.0) -> Callable[[int], tuple[float, float]]:
    return lambda number: (1000.0 * number / hz + phase_ms, 1000.0 * number / hz + phase_ms + late_ms)


@pytest.mark.parametrize(("hz", "phase_ms"), [(30, 20), (15, 33), (5, 45), (1, 14)])
def test_cameras_of_any_rate_and_phase_are_joined(hz: int, phase_ms: int) -> None:
    sight = run_cameras(capture_evenly(hz), capture_evenly(hz, phase_ms), seconds=max(3.0, 6.0 / hz))
    assert sight.count("0", "1") >= max(2 * hz - 1, 3)
    assert sight.count("0", "1") >= len(sight.clouds) - 2
    assert sight.pipeline.drops["join"] <= 1
    assert not sight.left_out


@pytest.mark.parametrize(("hz", "phase_ms"), [(8, 60), (1, 500)])
def test_cameras_that_are_never_close_in_time_are_shown_in_turn(hz: int, phase_ms: int) -> None:
    sight = run_cameras(capture_evenly(hz), capture_evenly(hz, phase_ms))
    assert sight.count("0", "1") == 0
    assert min(sight.count("0"), sight.count("1")) >= 2 * hz - 1
    assert not sight.left_out


def test_a_slow_camera_does_not_slow_down_the_cloud() -> None:
    sight = run_cameras(capture_evenly(30), capture_evenly(1, 10))
    assert len(sight.clouds) >= 50
    assert max(after - before for (before, _), (after, _) in itertools.pairwise(sight.clouds)) < 100
    assert sight.count("0", "1") == 2
    assert not sight.left_out


def test_a_camera_that_stops_does_not_stop_the_cloud() -> None:
    def stop(number: int) -> tuple[float, float]:
        captured = 1000.0 * number / 30.0 + (1e6 if number > 45 else 0.0)
        return captured, captured + 5.0

    sight = run_cameras(capture_evenly(30), stop)
    assert sight.count("1") >= 14
    assert max(after - before for (before, _), (after, _) in itertools.pairwise(sight.clouds)) < 150
    assert len([at for at, _ in sight.clouds if at > 2100]) >= 26, "it is not waited for any more"


def test_the_voxel_meets_the_budget_and_no_frame_is_above_it() -> None:
    pipeline = make_pipeline("front", points=1000)
    edges = []
    for at in range(5):
        pipeline.offer("front", make_frame(at), at * MS)
        cloud = pipeline.make_cloud(pipeline.take_frames(at * MS))
        assert cloud.n_points <= 1000
        assert len(decode_cloud(cloud.frames["full"]).positions) == cloud.n_points
        edges.append(cloud.voxel_m)
    assert edges[0] == VOXEL_M
    assert edges[1] > VOXEL_M
    assert len(set(edges[2:])) == 1, "it has settled"
    assert pipeline.drops["budget"] > 0
    settled = pipeline.drops["budget"]
    pipeline.offer("front", make_frame(9), 9 * MS)
    pipeline.make_cloud(pipeline.take_frames(9 * MS))
    assert pipeline.drops["budget"] == settled


def test_a_camera_on_a_body_is_placed_by_the_pose_at_its_capture() -> None:
    known: dict[int, PoseTuple] = {}
    pipeline = make_pipeline("hand", body="gripper", body_pose=lambda body, at: known.get(at) if body else None)
    pipeline.offer("hand", make_frame(10), 15 * MS)
    assert pipeline.take_frames(15 * MS) == {}, "the state of that moment is not there yet"
    pipeline.offer("hand", make_frame(43), 48 * MS)
    known[10 * MS] = ((3.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    frames = pipeline.take_frames(50 * MS)
    assert frames["hand"].capture_ns == 10 * MS, "not replaced by one whose pose is not known"
    assert frames["hand"].T_world_camera[0, 3] == 3.0
    assert not pipeline.lacks_pose("hand")
    known[43 * MS] = known[10 * MS]
    assert pipeline.take_frames(60 * MS)["hand"].capture_ns == 43 * MS, "the later one still waited"


def test_waiting_frames_are_bounded() -> None:
    pipeline = make_pipeline("hand", body="gripper", body_pose=lambda body, at: None)
    for at in range(10):
        pipeline.offer("hand", make_frame(at), at * MS)
    assert pipeline.drops["superseded"] == 7


def test_points_are_removed_at_the_time_of_capture() -> None:
    class Remover:
        """Removes the right half, once it knows about that time."""

        def __init__(self) -> None:
            self.known_ns = 0
            self.asked: list[int] = []

        def is_ready(self, capture_ns: int) -> bool:
            return capture_ns <= self.known_ns

        def remove(self, points: PointSet, capture_ns: int) -> PointSet:
            self.asked.append(capture_ns)
            kept = points.positions[:, 0] < 0.0
            return PointSet(points.positions[kept], points.colors[kept], points.counts[kept])

    remover = Remover()
    pipeline = make_pipeline("front", "back", remover=remover)
    pipeline.offer("front", make_frame(20), 30 * MS)
    pipeline.offer("back", make_frame(10), 30 * MS)
    assert pipeline.take_frames(30 * MS) == {}, "the state of that moment is not there yet"
    remover.known_ns = 25 * MS
    cloud = pipeline.make_cloud(pipeline.take_frames(32 * MS))
    assert remover.asked == [10 * MS, 20 * MS], "at the time of each camera"
    assert decode_cloud(cloud.frames["full"]).positions[:, 0].max() < 0.001


def test_a_cloud_without_points_is_one() -> None:
    pipeline = make_pipeline("front")
    pipeline.offer("front", make_frame(0, depth_mm=0), 0)
    cloud = pipeline.make_cloud(pipeline.take_frames(0))
    assert cloud.n_points == 0
    assert len(decode_cloud(cloud.frames["full"]).positions) == 0


@pytest.mark.parametrize(("depth_mm", "at_m", "reason"), [(9000, 0.0, "range"), (1500, 200.0, "box")])
def test_a_cloud_without_points_counts_why(depth_mm: int, at_m: float, reason: str) -> None:
    pipeline = make_pipeline("front")
    T_world_camera = np.eye(4)
    T_world_camera[2, 3] = at_m
    pipeline.offer("front", make_frame(0, depth_mm, T_world_camera=T_world_camera), 0)
    assert pipeline.make_cloud(pipeline.take_frames(0)).n_points == 0
    assert +pipeline.drops == {reason: 160 * 120}


def test_a_camera_without_a_pose_does_not_stop_the_other() -> None:
    """Its body may not be in this scene. Until that is known, it is waited for."""
    pipeline = make_pipeline("front", "hand", body="gripper", body_pose=lambda body, at: None)
    made = []
    for at in range(0, 600, 30):
        for name in ("front", "hand"):
            pipeline.offer(name, make_frame(at), at * MS)
        made.append(set(pipeline.take_frames(at * MS)))
    assert made[0] == set()
    assert made[-1] == {"front"}
    assert pipeline.lacks_pose("hand")
