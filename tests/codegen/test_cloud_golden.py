"""docs/protocol/cloud.json decodes as stated, also by a reader that follows docs/clouds.md literally."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from iris_session.streams.cloud import decode_cloud

FILE = Path(__file__).parents[2] / "docs" / "protocol" / "cloud.json"
FRAMES: list[dict[str, Any]] = json.loads(FILE.read_text())["frames"]
frames = pytest.mark.parametrize("frame", FRAMES, ids=[frame["name"] for frame in FRAMES])


@frames
def test_decoder_agrees_with_the_vector(frame: dict[str, Any]) -> None:
    decoded = decode_cloud(bytes.fromhex(frame["hex"]))
    assert decoded.positions.astype(np.float64).tolist() == frame["positions"]
    assert decoded.colors[:, :3].tolist() == frame["colors"]
    assert (decoded.error_m, decoded.voxel_m) == (frame["error_m"] or math.inf, frame["voxel_m"])


@frames
def test_literal_reader_agrees_with_the_vector(frame: dict[str, Any]) -> None:
    payload = bytes.fromhex(frame["hex"])
    form, flags, e, zero, n, *origin, _, _, also_zero = struct.unpack_from("<BBbBI3iffI", payload)
    assert (form, flags, zero, also_zero) == (1, 0, 0, 0)
    assert len(payload) == 32 + 8 * n == 32 + 8 * len(frame["positions"])
    for i, (position, color) in enumerate(zip(frame["positions"], frame["colors"], strict=True)):
        *node, packed = struct.unpack_from("<4H", payload, 32 + 8 * i)
        assert [(o + u) * 2.0**e for o, u in zip(origin, node, strict=True)] == position
        parts = (packed >> 11) * 255 / 31, (packed >> 5 & 63) * 255 / 63, (packed & 31) * 255 / 31
        assert [round(part) for part in parts] == color


def test_classes_are_beginnings() -> None:
    whole: dict[str, Any] = {frame["name"].split("/")[0]: frame for frame in FRAMES if frame["name"].endswith("/full")}
    for frame in FRAMES:
        full = whole[frame["name"].split("/")[0]]
        assert full["positions"][: len(frame["positions"])] == frame["positions"]
