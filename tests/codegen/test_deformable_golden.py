"""docs/protocol/deformable.json decodes as stated. The decoders in TypeScript and C# have the same vectors."""

from __future__ import annotations

import json
import math
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from iris_session.streams.deformable import DeformableDecoder, read_header
from iris_session.streams.deformable_topology import DeformableTopology
from tools.codegen.deformable_golden import render_golden

FILE = Path(__file__).parents[2] / "docs" / "protocol" / "deformable.json"
MESHES: list[dict[str, Any]] = json.loads(FILE.read_text())["meshes"]
FRAMES = [(mesh, frame) for mesh in MESHES for frame in mesh["frames"]]
frames = pytest.mark.parametrize(("mesh", "frame"), FRAMES, ids=[f"{m['name']}-{f['name']}" for m, f in FRAMES])


def expected(frame: dict[str, Any]) -> np.ndarray[Any, np.dtype[np.float32]]:
    return np.array([[math.nan if v is None else v for v in row] for row in frame["vertices"]], np.float32)


@frames
def test_decoder_agrees_with_the_vector(mesh: dict[str, Any], frame: dict[str, Any]) -> None:
    topology = DeformableTopology.from_bytes(bytes.fromhex(mesh["topology"]))
    decoder = DeformableDecoder(topology)
    decoded = decoder.decode(bytes.fromhex(frame["hex"]))
    decoded[~np.isfinite(decoded)] = np.nan
    assert np.array_equal(decoded, expected(frame), equal_nan=True)
    assert decoder.bound_m == frame["bound_m"]


def test_vectors_cover_every_part_of_the_format() -> None:
    headers = [read_header(bytes.fromhex(frame["hex"])) for _, frame in FRAMES]
    assert {h.packed for h in headers} == {True, False}
    assert {h.planes for h in headers} >= {0, 1, 2, 4}
    assert {h.exponent for h in headers} >= {-11, -10, -9}
    assert any(h.n_escaped for h in headers)
    topologies = [DeformableTopology.from_bytes(bytes.fromhex(mesh["topology"])) for mesh in MESHES]
    assert {(t.plan, t.order is None) for t in topologies} == {(0, True), (0, False), (1, False)}


def test_file_is_current() -> None:
    """With planes unpacked: another version of zlib may compress differently."""

    def unpack(meshes: list[dict[str, Any]]) -> list[Any]:
        return [
            {**mesh, "frames": [{**frame, "hex": unpack_planes(frame)} for frame in mesh["frames"]]} for mesh in meshes
        ]

    assert unpack(json.loads(render_golden())["meshes"]) == unpack(MESHES)


def unpack_planes(frame: dict[str, Any]) -> bytes:
    payload = bytes.fromhex(frame["hex"])
    header = read_header(payload)
    at = 32 + 16 * header.n_escaped
    return payload[:at] + (zlib.decompress(payload[at:], -15) if header.packed else payload[at:])
