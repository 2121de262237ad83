"""Camera process of `bench cloud`: pictures that are ready in memory become clouds that are sent to the session.

They show a room with tables and boxes, rendered by intersecting rays, with the noise and the holes of a camera.
"""

from __future__ import annotations

import importlib
import itertools
import math
import os
import time
from collections import defaultdict
from pathlib import Path
from statistics import median
from typing import Any, Final

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from anchors.camera import CameraModel, parse_camera
from iris_session.bench.cloud_stream import STREAM, MediaPublisher
from iris_session.cloud.camera_file import CameraSettings, CloudSettings
from iris_session.cloud.frames import DepthFrame, SourceFrame
from iris_session.cloud.pipeline import Cloud, CloudPipeline, PlacedFrame
from iris_session.cloud.sources.folder import FolderSource
from iris_session.cloud.voxels import DepthLimits, pack_keys

#: Inner corners of the room; boxes in it: low corner, high corner, red, green, blue [m].
ROOM: Final = ((-2.2, -2.2, 0.0), (2.2, 2.2, 2.6))
BOXES: Final = (
    ((0.3, -0.8, 0.70), (1.1, 0.8, 0.75), (150, 110, 70)),
    ((0.35, -0.75, 0.0), (0.41, -0.69, 0.7), (90, 90, 95)),
    ((0.35, 0.69, 0.0), (0.41, 0.75, 0.7), (90, 90, 95)),
    ((1.0, -0.75, 0.0), (1.06, -0.69, 0.7), (90, 90, 95)),
    ((1.0, 0.69, 0.0), (1.06, 0.75, 0.7), (90, 90, 95)),
    ((0.45, -0.5, 0.75), (0.65, -0.25, 0.93), (190, 60, 50)),
    ((0.60, 0.10, 0.75), (0.78, 0.40, 0.87), (60, 120, 190)),
    ((0.85, -0.1, 0.75), (0.95, 0.0, 1.05), (70, 160, 80)),
    ((1.5, -1.8, 0.0), (2.1, -0.9, 1.7), (200, 195, 180)),
    ((-0.4, 0.9, 0.0), (0.1, 1.5, 0.45), (120, 80, 140)),
)
#: Corners of the crop box of the benchmark: table, what is on it, and what is around it [m].
WORKSPACE: Final = ((-0.6, -1.6, -0.1), (1.9, 1.6, 2.0))
#: Standard deviation of a depth, divided by its square [1/m]: of a stereo camera, whose errors extend over the pixels
#: that it matches together, and beside it of single pixels.
NOISE: Final = 0.0015
NOISE_PIXELS: Final = 8
GRAIN: Final = 0.0003
#: Share of the pixels without a measurement, alone and in patches.
HOLES: Final = 0.02
PATCHES: Final = 60


def make_room_camera(width: int, height: int) -> CameraModel:
    """Return a camera of that size with a field of view of 70 degrees."""
    focal = 0.5 * width / math.tan(math.radians(35.0))
    return CameraModel(width, height, focal, focal, 0.5 * (width - 1), 0.5 * (height - 1))


def make_room_pose(angle: float) -> NDArray[np.float64]:
    """Return the pose of a camera at an angle around the table, which looks at it."""
    target = np.array((0.7, 0.0, 0.7))
    place = np.array((0.7 - 1.5 * math.cos(angle), 1.5 * math.sin(angle), 1.5))
    forward = (target - place) / np.linalg.norm(target - place)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = place
    return pose


def render_room(camera: CameraModel, T_world_camera: NDArray[np.float64], seed: int) -> DepthFrame:
    """Render the room for a camera without lens distortion. `seed`: of noise and holes."""
    random = np.random.default_rng(seed)
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=2)
    rays = (rays @ T_world_camera[:3, :3].T).astype(np.float32)
    rays[rays == 0.0] = 1e-9
    place = T_world_camera[:3, 3].astype(np.float32)
    walls = (np.where(rays > 0.0, *(np.array(corner, np.float32) for corner in ROOM[::-1])) - place) / rays
    z = walls.min(axis=2)
    color = np.array(((215, 210, 200), (205, 210, 215), (130, 120, 110)), np.uint8)[walls.argmin(axis=2)]
    for low, high, paint in BOXES:
        sides = np.stack([(np.array(corner, np.float32) - place) / rays for corner in (low, high)])
        enter, leave = sides.min(axis=0).max(axis=2), sides.max(axis=0).min(axis=2)
        hit = (enter > 0.0) & (enter < leave) & (enter < z)
        z[hit] = enter[hit]
        color[hit] = paint
    grain = random.integers(-12, 13, u.shape, np.int8)[..., None]
    color = np.clip(color.astype(np.int16) + grain, 0, 255).astype(np.uint8)
    wide = random.standard_normal((z.shape[0] // NOISE_PIXELS, z.shape[1] // NOISE_PIXELS), np.float32) * np.float32(
        NOISE
    )
    noise = np.asarray(cv2.resize(wide, z.shape[::-1], interpolation=cv2.INTER_LINEAR), np.float32)
    z += (noise + random.standard_normal(z.shape, np.float32) * np.float32(GRAIN)) * z**2
    z[random.random(z.shape, np.float32) < HOLES] = 0.0
    for row, column in random.integers(0, z.shape, (PATCHES, 2)):
        z[row : row + camera.height // 40, column : column + camera.width // 40] = 0.0
    return DepthFrame(np.clip(np.rint(z * 1000.0), 0, 65_535).astype(np.uint16), color, 0, T_world_camera)


# --- the camera process -----------------------------------------------------------------------------------------------


STAGES: Final = ("read", "voxels", "outliers", "budget", "encode", "send")
#: Pictures of each camera, shown again and again.
CYCLE: Final = 4
#: Clouds before the measured ones: compilation, and the edge of the cells that meets the budget.
WARM_UP: Final = 6


class CloudCase(msgspec.Struct, frozen=True):
    """One case.

    Attributes:
        pixels: Pixels of a cloud, shared by its cameras; 0 for the recorded frames.
        points: Budget of points.
        voxel_m: Least edge of the cells [m].
        hz: Pictures per second; 0 for as many as can be processed.
    """

    name: str
    cameras: int
    pixels: int
    points: int
    voxel_m: float
    hz: float = 0.0


Rig = tuple[CameraModel, DepthLimits, list[list[DepthFrame]]]


def make_rig(case: CloudCase, seed: int) -> Rig:
    """Return the intrinsics and limits of the cameras of a case, and for each camera its pictures."""
    if not case.pixels:
        return _load_recorded_rig(case)
    width = max(32, 8 * round(math.sqrt(case.pixels / case.cameras * 16.0 / 9.0) / 8.0))
    model = make_room_camera(width, round(case.pixels / case.cameras / width))
    limits = DepthLimits(*WORKSPACE, nearest_m=0.3, farthest_m=4.0)
    pictures = [
        [
            render_room(model, make_room_pose(angle + 0.05 * math.sin(math.tau * i / CYCLE)), seed + CYCLE * number + i)
            for i in range(CYCLE)
        ]
        for number, angle in enumerate(np.linspace(0.0, 1.2, case.cameras).tolist())
    ]
    return model, limits, pictures


def _load_recorded_rig(case: CloudCase) -> Rig:
    """Load the recorded frames; each further camera begins some frames later in the recording."""
    folder = Path(os.environ["IRIS_DATA"]) / "rgbd"
    model = parse_camera((folder / "camera-intrinsics.txt").read_text(), 640, 480)
    settings = CameraSettings(name="recorded", source="folder", path=str(folder), intrinsics=model)
    source = FolderSource(settings, itertools.count(0, 10**9).__next__)  # a frame is due whenever it is read
    frames = [source.read(0.0) for _ in range(CYCLE + case.cameras - 1)]
    pictures = [frame for frame in frames if frame is not None]
    return model, DepthLimits(farthest_m=3.5), [pictures[i : i + CYCLE] for i in range(case.cameras)]


class CloudCamera:
    """The cameras of one case, and the pipeline that makes clouds of their pictures."""

    def __init__(self, case: CloudCase, seed: int) -> None:
        self.case = case
        self.model, self.limits, pictures = make_rig(case, seed)
        self.pictures = {f"camera{i}": own for i, own in enumerate(pictures)}
        low, high, nearest_m, farthest_m, _ = self.limits
        cameras = tuple(
            CameraSettings(name=name, source="folder", nearest_m=nearest_m, farthest_m=farthest_m, error_mm=10.0)
            for name in self.pictures
        )
        settings = CloudSettings(
            stream=STREAM, points=case.points, voxel_m=case.voxel_m, low=low, high=high, cameras=cameras
        )
        self._pipeline = CloudPipeline(settings, time.perf_counter_ns)
        self._next = 0
        for _ in range(WARM_UP):
            self.make_cloud(0)

    def make_cloud(self, now_ns: int) -> tuple[Cloud, float]:
        """Make a cloud of the next pictures. Return it, and the duration of their copying [ms]."""
        began_ns = time.perf_counter_ns()
        frames = {}
        for name, pictures in self.pictures.items():
            depth, color, _, pose = pictures[self._next % len(pictures)]
            assert pose is not None
            frame = DepthFrame(depth.copy(), color.copy(), now_ns)
            frames[name] = PlacedFrame(SourceFrame(frame, self.model, 0.001), pose)
        self._next += 1
        read_ms = (time.perf_counter_ns() - began_ns) * 1e-6
        return self._pipeline.make_cloud(frames), read_ms


class CameraPublisher(MediaPublisher):
    """Publisher of the clouds of its cases."""

    role = "camera"

    def __init__(self, cases: tuple[CloudCase, ...], seed: int) -> None:
        super().__init__()
        self._cameras = {case.name: CloudCamera(case, seed) for case in cases}

    def compare(self) -> dict[str, float | None]:
        """Return what the voxel filters of numpy and open3d take for a picture of the first case [ms]."""
        return compare_filters(next(iter(self._cameras.values())))

    def run(self, case: str, seconds: float) -> dict[str, Any]:
        """Make and send clouds of a case for some seconds. Return the results."""
        assert self._client is not None
        camera, client = self._cameras[case], self._client
        stages: dict[str, list[float]] = defaultdict(list)
        totals, points, edges, refused = [], [], [], 0
        cpu_s, begin = time.process_time(), time.perf_counter()
        while (began := time.perf_counter()) - begin < seconds:
            now_ns = client.session_now_ns()
            cloud, stages_ms = camera.make_cloud(now_ns)
            made = time.perf_counter()
            sent = self.publish(cloud.frames, now_ns)
            client.poll(0.0)
            ended = time.perf_counter()
            refused += not sent
            for name, spent_ms in {"read": stages_ms, **cloud.stages_ms, "send": (ended - made) * 1e3}.items():
                stages[name].append(spent_ms)
            totals.append((ended - began) * 1e3)
            points.append(cloud.n_points)
            edges.append(cloud.voxel_m)
            due = begin + len(totals) / camera.case.hz if camera.case.hz else 0.0
            while (left := due - time.perf_counter()) > 0.0:
                client.poll(left)
        elapsed_s = time.perf_counter() - begin
        return {
            "hz": round((len(totals) - refused) / elapsed_s, 2),
            "total_ms_p50": round(median(totals), 3),
            "total_ms_p99": round(float(np.percentile(totals, 99)), 3),
            "stages_ms": {name: round(median(stages[name]), 3) for name in STAGES},
            "cpu_ms": round((time.process_time() - cpu_s) / len(totals) * 1e3, 3),
            "points_out": round(median(points)),
            "voxel_mm": round(median(edges) * 1e3, 2),
            "frames_refused": refused,
        }


def compare_filters(cameras: CloudCamera) -> dict[str, float | None]:
    """Return what the voxel filters of numpy and open3d take for a picture [ms].

    Both get points that lie in memory, cropped, with colours, so that they deproject nothing and leave out no outliers.
    """
    depth, color, _, pose = cameras.pictures["camera0"][0]
    assert pose is not None
    camera, limits, voxel_m = cameras.model, cameras.limits, cameras.case.voxel_m
    v, u = np.nonzero((depth > 0) & (depth < 0xFFFF) & (depth <= limits.farthest_m * 1000.0))
    z = depth[v, u] * 0.001
    points = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
    points = points @ pose[:3, :3].T + pose[:3, 3]
    inside = ((points >= limits.low) & (points < limits.high)).all(axis=1)
    points, colors = points[inside], color[v, u][inside] / 255.0
    return {
        "numpy_voxel_ms": _time_ms(lambda: _filter_with_numpy(points, colors, voxel_m)),
        "open3d_voxel_ms": _time_open3d_ms(points, colors, voxel_m),
    }


def _filter_with_numpy(points: NDArray[Any], colors: NDArray[Any], voxel_m: float) -> NDArray[Any]:
    keys = pack_keys(np.floor(points / voxel_m).astype(np.int64))
    _, cells, counts = np.unique(keys, return_inverse=True, return_counts=True)
    columns = [np.bincount(cells, values) / counts for values in (*points.T, *colors.T)]
    return np.stack(columns, axis=1)


def _time_open3d_ms(points: NDArray[Any], colors: NDArray[Any], voxel_m: float) -> float | None:
    try:
        open3d: Any = importlib.import_module("open3d")
    except (ImportError, OSError):  # not installed, or a library of the system is missing
        return None
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points))
    cloud.colors = open3d.utility.Vector3dVector(colors)
    return _time_ms(lambda: cloud.voxel_down_sample(voxel_m))


def _time_ms(call: Any) -> float:
    spent = []
    for _ in range(5):
        began = time.perf_counter()
        call()
        spent.append((time.perf_counter() - began) * 1e3)
    return round(median(spent), 3)
