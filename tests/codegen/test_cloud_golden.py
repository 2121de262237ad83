"""docs/protocol/cloud.json decodes as stated. The decoders in TypeScript and C# have the same vectors."""

from __future__ import annotations

import json
import math
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


def test_classes_are_beginnings() -> None:
    whole: dict[str, Any] = {frame["name"].split("/")[0]: frame for frame in FRAMES if frame["name"].endswith("/full")}
    for frame in FRAMES:
        full = whole[frame["name"].split("/")[0]]
        assert full["positions"][: len(frame["positions"])] == frame["positions"]
