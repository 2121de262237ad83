"""`bench deformable`: the motion is simulated once and cached; delivered frames are compared with it."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
import pytest

from iris_session.bench import deformable as motion_module
from iris_session.bench.deformable import ClothMotion, _ClothSource, _compute_max_error_m, load_cloth_motion
from iris_session.bench.media_clients import MediaColumn
from iris_session.bench.report import BenchError
from iris_session.streams.deformable import DeformableDecoder, DeformableEncoder
from iris_session.streams.deformable_topology import DeformableTopology


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of its own, and a second of motion."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(motion_module, "SECONDS", 1)
    return tmp_path / "cache" / "iris-session" / "bench"


def test_motion_is_cached_and_damaged_file_is_replaced(home: Path) -> None:
    messages: list[str] = []
    made = load_cloth_motion(5, 0, messages.append)
    (file,) = home.iterdir()
    assert any("simulated" in text for text in messages)
    messages.clear()
    kept = load_cloth_motion(5, 0, messages.append)
    assert not messages
    assert np.array_equal(kept.vertices, made.vertices)
    file.write_bytes(file.read_bytes()[:1000])
    again = load_cloth_motion(5, 0, messages.append)
    assert "simulating again" in messages[0]
    assert np.array_equal(again.vertices, made.vertices)
    assert np.array_equal(load_cloth_motion(5, 0, messages.append).faces, made.faces)


def test_errors_are_relative_to_motion_and_wrong_decoding_is_detected() -> None:
    rng = np.random.default_rng(0)
    motion = ClothMotion(rng.uniform(0.0, 1.3, (2, 9, 3)).astype(np.float32), np.zeros((0, 3), np.int32))
    topology = DeformableTopology(9)
    source = _ClothSource(motion, topology)
    made = DeformableEncoder(topology).encode(motion.vertices[0])
    assert made is not None
    payload = made["full"]
    source.frames = {700: (0, payload)}
    row = np.zeros((1, len(MediaColumn)), np.int64)
    row[0, MediaColumn.CAPTURE], row[0, MediaColumn.SIZE] = 700, len(payload)
    row[0, MediaColumn.CHECKSUM] = zlib.crc32(DeformableDecoder(topology).decode(payload).data)
    log = {"frames": row}
    wrong = row.copy()
    wrong[0, MediaColumn.CHECKSUM] += 1
    assert 0.0 < _compute_max_error_m({"a": log}, source) <= 0.0005
    source.frames = {700: (1, payload)}
    assert _compute_max_error_m({"a": log}, source) > 0.1
    with pytest.raises(BenchError, match=r"^b decoded"):
        _compute_max_error_m({"a": log, "b": {"frames": wrong}}, source)
