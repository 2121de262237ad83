"""`bench csharp`: what the C# core decodes is what was encoded, and what differs is found."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from iris_session.bench import csharp
from iris_session.bench.report import BenchError
from tools.csharp.project import Build

pytestmark = pytest.mark.e2e


def test_frames_are_decoded_without_allocations_and_within_the_bound(
    built: Build, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(csharp, "make_command", lambda runtime: built.make_command(runtime, "bench"))
    ages = {name: {"age_ms_p50": 1.0, "age_ms_p99": 2.0} for name in ("dotnet", "mono", "python_web")}
    ages["python"] = {"age_ms_p50": 0.5, "age_ms_p99": 1.0}  # without a gateway: for information
    monkeypatch.setattr(csharp, "_measure_ages", lambda *_: ages)
    report = csharp.run_csharp(bodies=50, points=500, frames=100)
    assert report.ok
    assert {bar.key for bar in report.bars} >= {"allocated_bytes_per_frame", "max_error_mm", "age_ms_p99"}
    ages["mono"]["age_ms_p99"] = 2.1
    assert [bar.key for bar in csharp.run_csharp(bodies=5, points=50, frames=10).bars if not bar.ok] == ["age_ms_p99"]
    assert report.results["max_error_mm"] > 0.0
    assert report.results["cloud_difference_mm"] == 0.0


def test_another_pose_vertex_or_point_is_found() -> None:
    made = csharp._Frames(3, 50, 20, 1)
    decoded = made.poses.tobytes() + made.vertices.astype("<f4").tobytes() + made.last_cloud.astype("<f8").tobytes()
    assert csharp._measure_errors(made, decoded) == pytest.approx((0.0, 0.0, 0.0, 0.0), abs=2e-4)
    for at, index in ((8, 0), (made.poses.nbytes + 4, 2), (len(decoded) - 8, 3)):
        size = 4 if index == 2 else 8
        (value,) = struct.unpack_from(f"<{'f' if size == 4 else 'd'}", decoded, at)
        other = decoded[:at] + struct.pack(f"<{'f' if size == 4 else 'd'}", value + 0.01) + decoded[at + size :]
        assert csharp._measure_errors(made, other)[index] == pytest.approx(10.0, abs=0.1)


def test_without_a_checkout_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(csharp, "ROOT", tmp_path)
    with pytest.raises(BenchError, match="source checkout"):
        csharp.run_csharp()
