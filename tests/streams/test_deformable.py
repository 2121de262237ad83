"""Deformable stream: every vertex within the bound for any mesh; hostile bytes raise typed errors."""

from __future__ import annotations

import math
import struct
import zlib

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.protocol.names import BudgetClass
from iris_session.streams.deformable import (
    COARSER,
    MAX_NODE,
    DeformableDecoder,
    DeformableEncoder,
    exponent_for,
    interpolate,
    read_header,
)
from iris_session.streams.deformable_topology import DeformableTopology
from iris_session.streams.errors import StreamError
from tools.codegen.deformable_golden import make_cloth, make_rope, make_shell

HEADER = 32
MESHES = {"cloth": make_cloth(9, 7), "shell": make_shell(4), "rope": make_rope(20)}


def encode_full(topology: DeformableTopology, vertices: npt.NDArray[np.floating], bound_m: float = 0.0005) -> bytes:
    made = DeformableEncoder(topology, bound_m).encode(vertices)
    assert made is not None
    return made[BudgetClass.FULL]


def largest_error(a: npt.NDArray[np.floating], b: npt.NDArray[np.floating]) -> float:
    return float(np.linalg.norm(a.astype(np.float64) - b, axis=1).max())


@st.composite
def topologies(draw: st.DrawFn) -> DeformableTopology:
    """Draw any mesh: pieces, loose vertices, triangles without area, edges of many triangles, repeated edges."""
    n = draw(st.integers(1, 40))
    vertex = st.integers(0, n - 1)
    faces = draw(st.lists(st.tuples(vertex, vertex, vertex), max_size=40))
    edges = draw(st.lists(st.tuples(vertex, vertex), max_size=40))
    return DeformableTopology(n, faces, edges)


@settings(max_examples=80, deadline=None)
@given(topologies(), st.integers(0, 2**32 - 1), st.floats(-3.0, 3.5), st.floats(-4.5, -1.0))
def test_any_mesh_is_within_the_bound_of_every_class(
    topology: DeformableTopology, seed: int, log_extent: float, log_bound: float
) -> None:
    bound_m = 10.0**log_bound
    reach = min(10.0**log_extent, 0.999 * MAX_NODE * 2.0 ** exponent_for(bound_m))
    vertices = np.random.default_rng(seed).uniform(-reach, reach, (topology.n_vertices, 3))
    frames = DeformableEncoder(topology, bound_m).encode(vertices, tuple(COARSER))
    assert frames is not None
    decoder = DeformableDecoder(DeformableTopology.from_bytes(topology.to_bytes()))
    for name, factor in COARSER.items():
        decoded = decoder.decode(frames[name])
        assert decoded.dtype == np.float32
        assert largest_error(decoded, vertices) <= bound_m * factor
        assert decoder.bound_m == pytest.approx(bound_m * factor, rel=1e-6)
        on_lattice = decoded / 2.0 ** read_header(frames[name]).exponent
        assert not read_header(frames[name]).n_escaped
        assert np.array_equal(on_lattice, np.rint(on_lattice)), "off the lattice that is fixed in the world"


@pytest.mark.parametrize("name", MESHES)
def test_smooth_mesh_costs_about_a_byte_per_coordinate(name: str) -> None:
    topology, vertices = MESHES[name]
    assert len(encode_full(topology, vertices)) <= HEADER + 3 * topology.n_vertices


def test_prediction_reduces_the_size_of_a_large_cloth() -> None:
    topology, vertices = make_cloth(60, 60)
    unpredicted = DeformableTopology(3600, edges=np.random.default_rng(0).permutation(3600).reshape(-1, 2))
    assert len(encode_full(topology, vertices)) < 0.2 * len(encode_full(unpredicted, vertices))
    assert len(encode_full(topology, vertices)) < 0.5 * 3 * 3600, "half a byte per coordinate"


# --- rest -----------------------------------------------------------------------------------------------------------


def test_resting_mesh_is_sent_again_after_an_interval() -> None:
    topology, vertices = MESHES["cloth"]
    encoder = DeformableEncoder(topology, repeat_after=10)
    sent = [encoder.encode(vertices) is not None for _ in range(31)]
    assert [i for i, was in enumerate(sent) if was] == [0, 10, 20, 30]


def test_creeping_mesh_stays_within_the_bound_between_frames() -> None:
    topology, vertices = MESHES["shell"]
    encoder, decoder = DeformableEncoder(topology, repeat_after=10**6), DeformableDecoder(topology)
    shown: dict[str, npt.NDArray[np.float32]] = {}
    sent = 0
    for k in range(400):
        now = vertices.copy()
        now[5] += 4e-6 * k * np.array((1.0, -1.0, 1.0)) / math.sqrt(3.0)
        frames = encoder.encode(now, tuple(COARSER))
        if frames is not None:
            sent += 1
            shown = {name: decoder.decode(payload) for name, payload in frames.items()}
        for name, factor in COARSER.items():
            assert largest_error(shown[name], now) <= 0.0005 * factor
    assert 10 < sent < 40


# --- outside the lattice --------------------------------------------------------------------------------------------


def test_vertices_outside_the_lattice_are_sent_as_float32() -> None:
    topology, vertices = MESHES["shell"]
    strange = vertices.copy()
    strange[0] = (np.nan, 1.0, -np.inf)
    strange[7] = (1e30, 0.1, 1e300)
    strange[20] = (0.1, 0.2, 4097.0)
    payload = encode_full(topology, strange)
    decoded = DeformableDecoder(topology).decode(payload)
    assert read_header(payload).n_escaped == 3
    with np.errstate(over="ignore"):
        assert np.array_equal(decoded[[0, 7, 20]], strange[[0, 7, 20]].astype(np.float32), equal_nan=True)
    rest = np.setdiff1d(np.arange(len(vertices)), [0, 7, 20])
    assert largest_error(decoded[rest], vertices[rest]) <= 0.0005


# --- hostile --------------------------------------------------------------------------------------------------------


@settings(max_examples=120, deadline=None)
@given(st.sampled_from(sorted(MESHES)), st.data())
def test_damaged_frames_are_rejected_or_decode(name: str, data: st.DataObject) -> None:
    topology, vertices = MESHES[name]
    damaged = bytearray(encode_full(topology, vertices))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(damaged) - 1))
        damaged[at] = data.draw(st.integers(0, 255))
    end = data.draw(st.one_of(st.just(len(damaged)), st.integers(0, len(damaged))))
    payload = bytes(damaged[:end]) + data.draw(st.binary(max_size=8))
    try:
        decoded = DeformableDecoder(topology).decode(memoryview(payload))
    except StreamError:
        return
    assert decoded.shape == vertices.shape


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=200))
def test_arbitrary_bytes_are_rejected(data: bytes) -> None:
    topology = MESHES["rope"][0]
    with pytest.raises(StreamError):
        DeformableDecoder(topology).decode(data)
    with pytest.raises(StreamError):
        DeformableTopology.from_bytes(data)


def _with_planes(payload: bytes, packed: bytes) -> bytes:
    """`payload` of one plane without escapes, its planes replaced by `packed` and marked as compressed."""
    return payload[:1] + b"\1\1" + payload[3:HEADER] + packed


@pytest.mark.parametrize("more", [-1, 1, 2**28])
def test_planes_of_wrong_length_are_rejected(more: int) -> None:
    topology, vertices = MESHES["rope"]
    payload = encode_full(topology, vertices)
    size = 3 * topology.n_vertices
    packed = zlib.compress(bytes(size + more), wbits=-15)
    with pytest.raises(StreamError, match="60 bytes"):
        DeformableDecoder(topology).decode(_with_planes(payload, packed))
    good = zlib.compress(bytes(size), wbits=-15)
    assert DeformableDecoder(topology).decode(_with_planes(payload, good)).shape == (20, 3)
    with pytest.raises(StreamError):
        DeformableDecoder(topology).decode(_with_planes(payload, good + good))


def test_frame_of_another_mesh_is_rejected() -> None:
    topology, vertices = make_cloth(4, 6)
    other, _ = make_cloth(6, 4)
    assert other.identity != topology.identity
    with pytest.raises(StreamError, match="topology"):
        DeformableDecoder(other).decode(encode_full(topology, vertices))


def test_escapes_out_of_order_or_range_are_rejected() -> None:
    topology, vertices = MESHES["rope"]
    vertices = vertices.copy()
    vertices[[3, 8]] = np.nan
    payload = encode_full(topology, vertices)
    assert struct.unpack_from("<I", payload, HEADER) == (3,)
    for wrong in (8, 9, 2**32 - 1):
        with pytest.raises(StreamError, match="ascending"):
            DeformableDecoder(topology).decode(payload[:HEADER] + struct.pack("<I", wrong) + payload[HEADER + 4 :])
    second = HEADER + 16  # of two escapes of 16 bytes
    beyond = payload[:second] + struct.pack("<I", topology.n_vertices) + payload[second + 4 :]
    with pytest.raises(StreamError, match="in range"):
        DeformableDecoder(topology).decode(beyond)


@pytest.mark.parametrize("bad", [{"bound_m": 0.0}, {"bound_m": math.nan}, {"bound_m": 2.0}, {"repeat_after": 0}])
def test_invalid_settings_are_rejected(bad: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(bad))):
        DeformableEncoder(MESHES["rope"][0], **bad)  # type: ignore[arg-type]


def test_wrong_shapes_and_classes_are_rejected() -> None:
    topology, vertices = MESHES["rope"]
    with pytest.raises(ValueError, match=r"shape \(19, 3\), expected \(20, 3\)"):
        DeformableEncoder(topology).encode(vertices[1:])
    with pytest.raises(ValueError, match="full, half, quarter"):
        DeformableEncoder(topology).encode(vertices, ("none",))


# --- between frames -------------------------------------------------------------------------------------------------


def test_interpolation_is_clamped_to_its_two_frames() -> None:
    topology, vertices = MESHES["cloth"]
    decoder = DeformableDecoder(topology)
    a, b = decoder.decode(encode_full(topology, vertices)), decoder.decode(encode_full(topology, vertices + 0.02))
    assert np.array_equal(interpolate(a, b, 0.0), a)
    assert np.array_equal(interpolate(a, b, -1.0), a)
    assert largest_error(interpolate(a, b, 1.5), b) < 1e-6
    assert largest_error(interpolate(a, b, 0.25), vertices + 0.005) <= 0.0005 + 1e-6
    assert interpolate(a, b, 0.5).dtype == np.float32
