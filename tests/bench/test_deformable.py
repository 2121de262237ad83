"""`bench deformable`: the motion is simulated once and cached; delivered frames are compared with it."""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from iris_session.bench import cloth_motion as motion_module
from iris_session.bench.cloth_motion import ClothMotion, load_cloth_motion, simulate_cloth
from iris_session.bench.deformable import _ClothSource, _compute_max_error_m
from iris_session.bench.report import BenchError
from iris_session.cli.main import main
from iris_session.streams.deformable import DeformableDecoder, DeformableEncoder
from iris_session.streams.deformable_topology import DeformableTopology

KEYS = ("encode_ms_p50", "encode_ms_p99", "mbit_per_s", "max_error_mm", "delivered_hz_min")


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of its own, and a second of motion."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(motion_module, "SECONDS", 1)
    return tmp_path / "cache" / "iris-session" / "bench"


@pytest.mark.long
@pytest.mark.e2e
def test_report(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "iris_session.cli.main", "bench", "deformable", "--json"]
    command += ["--vertices", "100", "--clients", "2", "--seconds", "12"]  # a busy machine may stand still for ten
    folder = tmp_path / "empty"
    folder.mkdir()
    environment = {**os.environ, "XDG_CACHE_HOME": str(tmp_path / "cache")}
    done = subprocess.run(
        command, capture_output=True, text=True, cwd=folder, env=environment, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert not list(folder.iterdir())
    result: dict[str, Any] = json.loads(done.stdout)
    assert list(result) == ["name", "version", "machine", "params", "results", "reference", "bars"]
    assert {"vertices": 100, "clients": 2, "hz": 60}.items() <= result["params"].items()
    got = result["results"]
    assert all(math.isfinite(got[key]) for key in KEYS)
    assert 0.05 < got["max_error_mm"] <= 0.5, "the lattice of a cloth in motion errs by something"
    assert got["delivered_hz_min"] > 0.0
    assert got["frames_malformed"] == got["frames_not_logged"] == 0
    assert 0 <= got["frames_refused"] < got["frames_encoded"]  # by a front that a busy machine does not run
    assert got["mbit_per_s"] < result["reference"]["float32_mbit_per_s"]
    assert {one["key"] for one in result["bars"]} == set(KEYS)


def test_motion_depends_on_the_seed_only() -> None:
    one, same, other = simulate_cloth(6, 1), simulate_cloth(6, 1), simulate_cloth(6, 2)
    assert np.array_equal(one.nodes, same.nodes)
    assert not np.array_equal(one.nodes, other.nodes)
    vertices = np.stack([one.vertices(i) for i in range(len(one.nodes))])
    assert vertices.shape == (360, 36, 3)
    assert one.scale < 5e-5, "kept far finer than the bound"
    assert np.ptp(vertices[:, 0], axis=0).max() > 0.5, "the hands lead it"
    sides = np.linalg.norm(vertices[0, 1:6] - vertices[0, :5], axis=1)
    assert sides.sum() == pytest.approx(1.0, abs=0.05)


def test_motion_is_cached_and_damaged_file_is_replaced(home: Path) -> None:
    messages: list[str] = []
    made = load_cloth_motion(5, 0, messages.append)
    (file,) = home.iterdir()
    assert any("simulated" in text for text in messages)
    messages.clear()
    kept = load_cloth_motion(5, 0, messages.append)
    assert not messages
    assert np.array_equal(kept.nodes, made.nodes)
    assert (kept.scale, kept.origin.tolist()) == (made.scale, made.origin.tolist())
    file.write_bytes(file.read_bytes()[:1000])
    again = load_cloth_motion(5, 0, messages.append)
    assert "simulating again" in messages[0]
    assert np.array_equal(again.nodes, made.nodes)
    assert np.array_equal(load_cloth_motion(5, 0, messages.append).faces, made.faces)


def test_motion_runs_forward_and_back() -> None:
    motion = ClothMotion(np.zeros((4, 9, 3), np.uint16), np.zeros(3), 1.0, np.zeros((0, 3), np.int32))
    assert [motion.frame_index(frame) for frame in range(8)] == [0, 1, 2, 3, 2, 1, 0, 1]


def test_errors_are_relative_to_motion_and_wrong_decoding_is_detected() -> None:
    rng = np.random.default_rng(0)
    motion = ClothMotion(
        rng.integers(0, 2**16, (2, 9, 3)).astype(np.uint16), np.zeros(3), 2e-5, np.zeros((0, 3), np.int32)
    )
    topology = DeformableTopology(9)
    source = _ClothSource(motion, topology)
    source.frames = {700: 0}
    made = DeformableEncoder(topology).encode(motion.vertices(0))
    assert made is not None
    payload = made["full"]
    log = {
        "capture_ns": np.array([700]),
        "checksums": np.array([zlib.crc32(DeformableDecoder(topology).decode(payload).data)]),
        "sizes": np.array([len(payload)]),
        "payloads": np.frombuffer(payload, np.uint8),
    }
    assert 0.0 < _compute_max_error_m({"a": log}, source) <= 0.0005
    source.frames = {700: 1}
    assert _compute_max_error_m({"a": log}, source) > 0.1
    with pytest.raises(BenchError, match=r"^b decoded"):
        _compute_max_error_m({"a": log, "b": {**log, "checksums": log["checksums"] + 1}}, source)


def test_invalid_vertex_counts_are_one_line_error(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "deformable", "--vertices", "120"]) == 1
    assert "choose 100 or 121" in capsys.readouterr().err
    assert main(["bench", "deformable", "--vertices", "40000"]) == 2
    assert "16 to 10000" in capsys.readouterr().err
