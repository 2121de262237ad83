"""`bench cloud` and `bench cloud-stream`: pictures of a room as stated, clouds delivered as they were made."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import zlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from iris_session.bench.cloud_camera import STAGES, CloudCamera, CloudCase
from iris_session.bench.cloud_room import BOXES, ROOM, make_room_camera, make_room_pose, render_room
from iris_session.bench.cloud_source import MovingCloud
from iris_session.bench.cloud_stream import Interval, _compare, plan_intervals, summarize
from iris_session.bench.report import BenchError
from iris_session.cli.main import main
from iris_session.cloud.voxels import make_rays
from iris_session.streams.cloud import read_header


def run_bench(folder: Path, *arguments: str) -> dict[str, Any]:
    command = [sys.executable, "-m", "iris_session.cli.main", "bench", *arguments, "--json"]
    done = subprocess.run(command, capture_output=True, text=True, cwd=folder, timeout=300, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    assert not list(folder.iterdir())
    result: dict[str, Any] = json.loads(done.stdout)
    assert list(result) == ["name", "version", "machine", "params", "results", "reference", "bars"]
    return result


@pytest.mark.long
@pytest.mark.e2e
def test_report_of_clouds(tmp_path: Path) -> None:
    result = run_bench(tmp_path, "cloud", "--points", "40000", "--seconds", "1.5", "--cameras", "2")
    assert {"points": 40_000, "cameras": 2}.items() <= result["params"].items()
    got = result["results"]
    for found in (got, got["room_2cm_10k"], got["recorded"]):
        assert 0.0 < found["total_ms_p50"] <= found["total_ms_p99"]
        assert found["total_ms_p50"] < 2e3
        assert tuple(found["stages_ms"]) == STAGES
        assert 0.5 * found["total_ms_p50"] < sum(found["stages_ms"].values()) < 1.5 * found["total_ms_p50"]
        assert found["hz"] > 0.0
        assert 100 < found["points_out"] <= 50_000
    assert got["numpy_voxel_ms"] > 0.0
    assert "open3d_voxel_ms" in got
    assert [one["key"] for one in result["bars"]] == ["hz", "room_2cm_10k.hz", "recorded.hz"]


@pytest.mark.long
@pytest.mark.e2e
def test_report_beside_a_session(tmp_path: Path) -> None:
    got = run_bench(tmp_path, "cloud", "--beside", "--points", "20000", "--seconds", "13")["results"]
    assert 0.0 < got["hz"] < 1.2 * 15.0  # of the worst interval, in which a busy machine may stand still
    assert got["rounds"] >= 2
    assert 0.1 * 500.0 * 12.0 < got["ticks"] < 1.2 * 500.0 * 12.0
    assert 0.0 <= got["late_tick_share"] <= 1.0
    assert 0.0 <= got["late_tick_share_without"] <= 1.0


@pytest.mark.long
@pytest.mark.e2e
def test_report_of_a_stream(tmp_path: Path) -> None:
    # Of these seconds a busy machine may stand still for ten.
    arguments = ("--points", "2000", "--hz", "30", "--clients", "2", "--seconds", "13", "--curve")
    result = run_bench(tmp_path, "cloud-stream", *arguments)
    got = result["results"]
    assert 0.0 < got["delivered_hz_min"] <= 31.0
    assert 8.0 < got["bytes_per_point"] <= 9.1
    assert 0.0 < got["max_error_mm"] <= got["stated_error_mm"] < 0.2
    assert 0.0 < got["decode_ms_p50"] <= got["decode_ms_p99"]
    assert got["frames_malformed"] == got["frames_not_logged"] == 0
    assert math.isfinite(got["age_ms_p99"])
    # Null where a busy machine has delivered nothing in time.
    ages = [got[key] for key in ("state_age_ms_p99", "state_age_ms_p99_without")]
    assert all(age is None or age > 0.0 for age in ages)
    keys = {one["key"] for one in result["bars"]}
    assert keys == {"bytes_per_point", "max_error_mm", "delivered_hz_min", "decode_ms_p50", "state_age_ms_p99"}


@pytest.mark.long
@pytest.mark.e2e
def test_report_over_a_slow_link(tmp_path: Path) -> None:
    # A third of these seconds the link is slow; of them a busy machine may stand still for ten.
    arguments = ("--points", "20000", "--mbit", "20", "--clients", "1", "--seconds", "40")
    got = run_bench(tmp_path, "cloud-stream", *arguments)["results"]
    assert 0.0 < got["lower_class_after_s"] < 13.0
    assert got["slow_hz_min"] > 0.0
    assert math.isfinite(got["state_age_ms_p99_slow_lowered"])


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


def test_cameras_share_the_pixels_of_a_cloud() -> None:
    one, two = (CloudCamera(CloudCase("room", n, 40_000, 50_000, 0.01), 0) for n in (1, 2))
    pixels = [sum(shown[0].depth.size for shown in camera.rig.pictures) for camera in (one, two)]
    assert pixels[0] == pytest.approx(40_000, rel=0.05)
    assert pixels[1] == pytest.approx(40_000, rel=0.05)
    cloud, _ = two.make_cloud(0)
    assert cloud.cameras == ("camera0", "camera1")


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
    log = {"clouds": np.array(rows), "counts": np.zeros(5, int), "handed_ns": at_ns, "state_ns": at_ns - 1_000_000}
    got: Any = SimpleNamespace(
        logs={"a": log}, begin_ns=0, stats=SimpleNamespace(late_share=0.0), scheduling="", drops=0
    )
    runs: Any = [{"captures": {str(n): n for n in frames}, "encode_ms": [1.0], "refused": 0}]
    assert summarize(got, plan, runs, cloud, 30)["delivered_hz_min"] == hz


def test_points_move_and_depend_on_the_seed_only() -> None:
    one, same, other = MovingCloud(100, 1), MovingCloud(100, 1), MovingCloud(100, 2)
    assert np.array_equal(one.compute_positions(0.5), same.compute_positions(0.5))
    assert not np.array_equal(one.compute_positions(0.5), other.compute_positions(0.5))
    assert np.abs(one.compute_positions(0.5) - one.compute_positions(0.0)).max() > 0.05


def test_intervals_alternate_and_fill_the_window() -> None:
    plan = plan_intervals(20.0, 0.0)
    assert [one.kind for one in plan] == ["without", "with"] * 4
    assert plan[-1].end_s == pytest.approx(20.0)
    assert [one.kind for one in plan_intervals(20.0, 5.0)] == ["with", "slow", "slow_without"]
    assert len(plan_intervals(1.0, 0.0)) == 2


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["cloud", "--points", "10"], "10000 to"),
        (["cloud", "--cameras", "9"], "1 to 4"),
        (["cloud", "--curve"], "--curve"),
        (["cloud-stream", "--points", "2000000"], "1000 to"),
        (["cloud-stream", "--hz", "0"], "1 to 120"),
        (["cloud-stream", "--profile", "lan"], "--mbit"),
    ],
)
def test_invalid_sizes_are_one_line_error(capsys: pytest.CaptureFixture[str], arguments: list[str], named: str) -> None:
    assert main(["bench", *arguments]) == 2
    text = capsys.readouterr().err
    assert named in text
    assert len(text.strip().splitlines()) == 1


def test_without_recorded_frames_the_rest_is_measured(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    from iris_session.bench.cloud import _make_cases

    told: list[str] = []
    monkeypatch.setenv("IRIS_DATA", str(tmp_path))
    assert [case.name for case in _make_cases(40_000, 1, False, told.append)] == ["room", "room_2cm_10k"]
    assert "IRIS_DATA" in told[0]
