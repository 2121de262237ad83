"""`bench cloud` and `bench cloud-stream`: pictures of a room as stated, clouds delivered as they were made."""

from __future__ import annotations

import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from iris_session.bench.cloud_camera import BOXES, ROOM, make_room_camera, make_room_pose, render_room
from iris_session.bench.cloud_stream import Interval, MovingCloud, _compare, summarize
from iris_session.bench.report import BenchError
from iris_session.cloud.voxels import make_rays
from iris_session.streams.cloud import read_header


def test_pictures_show_the_room_with_noise_and_holes() -> None:
    camera, pose = make_room_camera(160, 90), make_room_pose(0.3)
    picture = render_room(camera, pose, 1)
    rays, z = make_rays(camera), picture.depth * 0.001
    assert 0.02 < np.mean(picture.depth == 0) < 0.2
    points = np.stack([rays.x * z, rays.y * z, z], axis=2)[z > 0.0] @ pose[:3, :3].T + pose[:3, 3]
    distance = np.abs(np.concatenate([points - ROOM[0], ROOM[1] - points], axis=1)).min(axis=1)
    for low, high, _ in BOXES:
        beside = np.maximum(np.maximum(low - points, points - high), 0.0)
        inside = np.minimum(points - low, high - points).min(axis=1)
        distance = np.minimum(distance, np.where(inside > 0.0, inside, np.linalg.norm(beside, axis=1)))
    assert np.percentile(distance, 50) < 0.005
    assert np.percentile(distance, 99) < 0.03
    assert distance.mean() > 1e-4, "noise"
    assert len(np.unique(picture.color.reshape(-1, 3) // 64, axis=0)) > 5
    again, other = render_room(camera, pose, 1), render_room(camera, pose, 2)
    assert np.array_equal(picture.depth, again.depth)
    assert not np.array_equal(picture.depth, other.depth)


def test_a_cloud_other_than_that_of_the_source_is_found() -> None:
    cloud = MovingCloud(500, 3)
    made = cloud.encode(7 / 30)
    runs = [{"captures": {"7": 1234}}]

    def rows(payload: bytes) -> Any:
        return np.array([[1234, 0, 0, zlib.crc32(payload), len(payload), 500, 0]])

    error_m, stated_m = _compare(np.concatenate([rows(made["full"]), rows(made["half"])]), runs, cloud, 30)
    assert 0.0 < error_m <= stated_m < 2e-4
    with pytest.raises(BenchError, match="another cloud 7"):
        _compare(rows(cloud.encode(8 / 30)["full"]), runs, cloud, 30)


@pytest.mark.parametrize(("level", "hz"), [(0, 30.0), (2, 0.0)])
def test_clouds_of_a_coarser_class_do_not_count_as_delivered(level: int, hz: float) -> None:
    cloud = MovingCloud(500, 3)
    frames = {n: cloud.encode(n / 30) for n in range(31)}
    plan = [Interval("without", 0.0, 1.0), Interval("with", 1.0, 2.0)]
    rows = []
    for n, made in frames.items():  # the first one is whole, and comes before the interval
        at_ns = 1_000_000_000 + (n - 1) * 33_333_333 if n else 500_000_000
        data = made["quarter" if n and level else "full"]
        n_points = read_header(data).n_points
        rows.append([n, at_ns, 1000, zlib.crc32(data), len(data), n_points, level if n else 0])
    at_ns = np.arange(0, 2_000_000_000, 16_666_667)
    log = {"frames": np.array(rows), "counts": np.zeros(5, int), "handed_ns": at_ns, "state_ns": at_ns - 1_000_000}
    got: Any = SimpleNamespace(logs={"a": log}, begin_ns=0, summarize=lambda *_: {})
    runs: Any = [{"captures": {str(n): n for n in frames}, "encode_ms": [1.0], "refused": 0}]
    assert summarize(got, plan, runs, cloud, 30)["delivered_hz_min"] == hz


def test_without_recorded_frames_the_rest_is_measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from iris_session.bench.cloud import _make_cases

    told: list[str] = []
    monkeypatch.setenv("IRIS_DATA", str(tmp_path))
    assert [case.name for case in _make_cases(40_000, 1, False, told.append)] == ["room", "room_2cm_10k"]
    assert "IRIS_DATA" in told[0]
