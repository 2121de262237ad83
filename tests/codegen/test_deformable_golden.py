"""docs/protocol/deformable.json decodes as stated, also by a reader that follows docs/deformables.md literally."""

from __future__ import annotations

import json
import math
import struct
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


@frames
def test_literal_reader_agrees_with_the_vector(mesh: dict[str, Any], frame: dict[str, Any]) -> None:
    read = read_by_the_document(bytes.fromhex(mesh["topology"]), bytes.fromhex(frame["hex"]))
    for row, true in zip(read, frame["vertices"], strict=True):
        assert [v if math.isfinite(v) else None for v in row] == true


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


# --- docs/deformables.md, in the order of its steps, one number at a time -------------------------------------------


def read_by_the_document(topology: bytes, payload: bytes) -> list[list[float]]:
    """Return the vertices of `payload` with struct and zlib only, as a port to another language would."""
    _, plan, flags, n, rows, cols, _, _ = struct.unpack_from("<BBHIIIII", topology)
    words = struct.unpack(f"<{(len(topology) - 24) // 4}I", topology[24:])
    order = words[:n] if flags & 1 else range(n)
    parents = words[n * (flags & 1) :][: 3 * n] if plan == 1 else ()

    _, frame_flags, n_planes, exponent, _, n_of, identity, n_escaped, *origin = struct.unpack_from(
        "<BBBbfIII3i", payload
    )
    assert (n_of, identity) == (n, zlib.crc32(topology))
    at = 32 + 16 * n_escaped
    data = zlib.decompress(payload[at:], -15) if frame_flags & 1 and n_planes else payload[at:]
    assert len(data) == 3 * n * n_planes

    step = 2.0**exponent
    out = [[0.0] * 3 for _ in range(n)]
    for axis in range(3):
        node = [0] * n
        for i in range(n):
            coded = sum(data[plane * 3 * n + axis * n + i] << (8 * plane) for plane in range(n_planes))
            value = (coded >> 1) ^ -(coded & 1)
            if plan == 1:
                if i:
                    value += node[parents[i]] + node[parents[n + i]] - node[parents[2 * n + i]]
            else:
                r, c = divmod(i, cols)
                value += node[i - 1] if c else 0
                value += node[i - cols] if r else 0
                value -= node[i - cols - 1] if r and c else 0
            node[i] = wrap_int32(value)
            out[order[i]][axis] = wrap_int32(node[i] + origin[axis]) * step
    assert plan == 1 or rows * cols == n
    for k in range(n_escaped):
        vertex, *position = struct.unpack_from("<I3f", payload, 32 + 16 * k)
        out[vertex] = list(position)
    return out


def wrap_int32(value: int) -> int:
    """Return the value wrapped to int32."""
    return (value + 2**31) % 2**32 - 2**31
