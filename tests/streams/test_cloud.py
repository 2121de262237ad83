"""Point cloud frames: points are within what is stated, every beginning is a fair sample, hostile bytes are refused."""

from __future__ import annotations

import math
import struct

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import cKDTree

from iris_session.protocol.names import BudgetClass
from iris_session.streams.cloud import (
    HEADER_BYTES,
    MAX_ORIGIN,
    MAX_POINTS,
    POINT,
    SHARES,
    CloudFrame,
    decode_cloud,
    encode_cloud,
    order_points,
    pack_colors,
    read_header,
    unpack_colors,
)
from iris_session.streams.errors import StreamError

Floats = npt.NDArray[np.float32]
Colors = npt.NDArray[np.uint8]


def make_room(n: int, seed: int = 0) -> tuple[Floats, Colors]:
    """Return points on floor, walls and a table, and their colours."""
    random = np.random.default_rng(seed)
    points = random.uniform((-2.0, -1.5, 0.0), (2.0, 1.5, 2.0), (n, 3)).astype(np.float32)
    side = random.integers(0, 4, n)
    points[side == 0, 2] = 0.0
    points[side == 1, 0] = 2.0
    points[side == 2, 1] = -1.5
    points[side == 3] = points[side == 3] * np.float32((0.2, 0.3, 0.0)) + np.float32((0.0, 0.0, 0.8))
    return points, random.integers(0, 256, (n, 3)).astype(np.uint8)


def match_points(frame: CloudFrame, points: Floats) -> npt.NDArray[np.float64]:
    """Return the distance of each point of the source to the nearest one of the frame [m]."""
    found, _ = cKDTree(frame.positions.astype(np.float64)).query(points.astype(np.float64))
    return np.asarray(found)


@settings(max_examples=120, deadline=None)
@given(
    st.integers(0, 2**32 - 1),
    st.integers(0, 300),
    st.floats(-3.0, 3.2),
    st.floats(-3.0, 3.5),
    st.sampled_from([np.float32, np.float64]),
)
def test_points_are_where_the_header_states(
    seed: int, n: int, log_extent: float, log_away: float, kind: type[np.floating]
) -> None:
    random = np.random.default_rng(seed)
    points = (random.uniform(-1.0, 1.0, (n, 3)) * 10.0**log_extent + 10.0**log_away).astype(kind)
    colors = random.integers(0, 256, (n, 3)).astype(np.uint8)
    payload = encode_cloud(points, colors, error_m=0.01)["full"]
    frame, header = decode_cloud(payload), read_header(payload)
    assert len(payload) == HEADER_BYTES + 8 * n
    assert frame.positions.shape == (n, 3)
    assert frame.error_m == pytest.approx(0.01)
    order = order_points(points.T, 2.0**header.exponent)
    errors = np.linalg.norm(frame.positions.astype(np.float64) - points[order].astype(np.float64), axis=1)
    assert errors.max(initial=0.0) <= header.quantum_error_m * (1.0 + 1e-6)
    finest_m = max(2.0**-14, 4.0 * 10.0**log_extent / 65_535, (10.0**log_away + 10.0**log_extent) / MAX_ORIGIN * 2.0)
    assert 2.0**header.exponent <= finest_m


def test_colours_are_within_half_a_level_and_grey_stays_grey() -> None:
    every = np.arange(256, dtype=np.uint8)
    colors = np.stack([every, every[::-1], np.roll(every, 7)], axis=1)
    decoded = unpack_colors(pack_colors(colors))
    assert (decoded[:, 3] == 255).all()
    error = np.abs(decoded[:, :3].astype(int) - colors).max(axis=0)
    assert error[0] <= 4
    assert error[1] <= 2
    assert error[2] <= 4
    ends = np.array([[0, 0, 0], [255, 255, 255]], np.uint8)
    assert (unpack_colors(pack_colors(ends))[:, :3] == ends).all()


def test_every_beginning_covers_the_room_like_a_fair_sample() -> None:
    """Distances from the points to the nearest of a beginning are those to a random sample of the same size."""
    points, colors = make_room(40_000)
    _, one_per_cell = np.unique(np.floor(points / 0.02), axis=0, return_index=True)
    points, colors = points[one_per_cell], colors[one_per_cell]
    frame = decode_cloud(encode_cloud(points, colors, voxel_m=0.02)["full"])
    random = np.random.default_rng(1)
    for n in (10_000, 5_000, 2_500, 1_000):
        begin = cKDTree(frame.positions[:n]).query(points)[0]
        fair = cKDTree(points[random.permutation(len(points))[:n]]).query(points)[0]
        assert begin.mean() == pytest.approx(fair.mean(), rel=0.1)
        assert np.percentile(begin, 95) == pytest.approx(np.percentile(fair, 95), rel=0.1)


def test_classes_are_beginnings_of_the_whole() -> None:
    points, colors = make_room(1001)
    frames = encode_cloud(points, colors, voxel_m=0.02, classes=tuple(SHARES))
    assert [read_header(frames[name]).n_points for name in SHARES] == [1001, 501, 251]
    assert [decode_cloud(frames[name]).voxel_m for name in SHARES] == pytest.approx([0.02, 0.02 * math.sqrt(2.0), 0.04])
    for frame in frames.values():
        assert frames[BudgetClass.FULL][HEADER_BYTES:].startswith(frame[HEADER_BYTES:])


def test_a_point_at_rest_stays_in_its_class_while_others_come_and_go() -> None:
    points, colors = make_room(4000)
    quarter = decode_cloud(encode_cloud(points, colors, voxel_m=0.02, classes=["quarter"])["quarter"])
    fewer = np.random.default_rng(3).permutation(4000)[:3600]
    after = decode_cloud(encode_cloud(points[fewer], colors[fewer], voxel_m=0.02, classes=["quarter"])["quarter"])
    stayed = match_points(after, quarter.positions) < 0.001
    assert stayed.mean() > 0.85  # a tenth is gone; of a random quarter a quarter would be left


def test_points_that_are_not_finite_are_left_out() -> None:
    points, colors = make_room(10)
    points[3, 1], points[7] = np.nan, np.inf
    frame = decode_cloud(encode_cloud(points, colors)["full"])
    assert len(frame.positions) == len(frame.colors) == 8
    assert np.isfinite(frame.positions).all()


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"positions": np.zeros((4, 2))}, "shape"),
        ({"colors": np.zeros((4, 3))}, "uint8"),
        ({"classes": ("full", "none")}, "none"),
        ({"voxel_m": -0.1}, "voxel_m"),
        ({"error_m": math.nan}, "error_m"),
        ({"error_m": 1e-60}, "error_m"),
        ({"positions": np.array([[0.0] * 3, [1.0] * 3, [2.0] * 3, [9000.0] * 3])}, "4 km"),
    ],
)
def test_what_cannot_be_sent_is_refused(change: dict[str, object], named: str) -> None:
    arguments = {"positions": np.zeros((4, 3)), "colors": np.zeros((4, 3), np.uint8), **change}
    with pytest.raises(ValueError, match=named):
        encode_cloud(**arguments)  # type: ignore[arg-type]


def damage(payload: bytes, at: int, kind: str, value: float) -> bytes:
    changed = bytearray(payload)
    struct.pack_into(f"<{kind}", changed, at, value)
    return bytes(changed)


def test_frames_that_no_encoder_makes_are_refused() -> None:
    payload = encode_cloud(*make_room(5))["full"]
    for bad in (
        b"",
        payload[: HEADER_BYTES - 1],
        payload[:-1],
        payload + b"\0",
        damage(payload, 0, "B", 2),
        damage(payload, 1, "B", 1),
        damage(payload, 2, "b", -15),
        damage(payload, 2, "b", 0),
        damage(payload, 3, "B", 1),
        damage(payload, 4, "I", 4),
        damage(payload, 4, "I", 2**32 - 1),
        damage(payload, 8, "i", 2**31 - 1),
        damage(payload, 20, "f", math.nan),
        damage(payload, 20, "f", 0.0),
        damage(payload, 24, "f", math.nan),
        damage(payload, 24, "f", 11.0),
        damage(payload, 28, "I", 1),
    ):
        with pytest.raises(StreamError):
            decode_cloud(bad)


def test_the_largest_frame_is_stated() -> None:
    n = MAX_POINTS + 1
    with pytest.raises(ValueError, match=str(MAX_POINTS)):
        encode_cloud(np.zeros((n, 3), np.float32), np.zeros((n, 3), np.uint8))
    head = encode_cloud(*make_room(0))["full"]
    with pytest.raises(StreamError):
        decode_cloud(damage(head, 4, "I", n) + bytes(POINT.itemsize * n))
