"""Meshes: corners indexed without loss, quantised and simplified within the stated bounds."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from iris_session.scene import (
    AssetDecodeError,
    MeshArrays,
    decode_mesh,
    encode_arrays,
    encode_mesh,
    encode_mesh_quantised,
)
from iris_session.scene.arrays import StoredArray
from iris_session.scene.meshes import build_smooth_mesh, index_corners, simplify_mesh


def soup(seed: int, faces: int, *, uv: bool) -> MeshArrays:
    """Return triangles with repeated corners."""
    rng = np.random.default_rng(seed)
    choose = rng.integers(0, max(1, faces), (faces, 3))
    points, normals, texture = (rng.normal(size=(max(1, faces), n)).astype(np.float32) for n in (3, 3, 2))
    return index_corners(points[choose], normals[choose], texture[choose] if uv else None)


def ball(subdivisions: int) -> MeshArrays:
    shape = trimesh.creation.icosphere(subdivisions)
    return build_smooth_mesh(np.array(shape.vertices), np.array(shape.faces, np.int64))


@given(st.integers(0, 1000), st.integers(0, 60), st.booleans())
def test_corners_are_exact_and_unique(seed: int, faces: int, uv: bool) -> None:
    mesh = soup(seed, faces, uv=uv)
    back = decode_mesh(encode_mesh(mesh))
    for name in ("position", "normal", "uv", "index"):
        a, b = getattr(mesh, name), getattr(back, name)
        assert (a is None and b is None) or (a.dtype == b.dtype and a.tobytes() == b.tobytes())
    rows = np.concatenate([mesh.position, mesh.normal] + ([] if mesh.uv is None else [mesh.uv]), axis=1)
    assert len(np.unique(rows, axis=0)) == len(rows) <= max(1, faces)


@given(st.integers(0, 1000), st.floats(1e-3, 1e3), st.floats(-100, 100))
def test_quantised_positions_stay_within_the_bound(seed: int, scale: float, offset: float) -> None:
    mesh = soup(seed, 30, uv=True)
    moved = MeshArrays(mesh.position * np.float32(scale) + np.float32(offset), mesh.normal, mesh.uv, mesh.index)
    data, error = encode_mesh_quantised(moved)
    back = decode_mesh(data)
    assert np.linalg.norm(back.position.astype(np.float64) - moved.position, axis=1).max() <= error
    assert np.array_equal(back.index, moved.index)


def test_simplified_meshes_stay_within_the_stated_error() -> None:
    assert simplify_mesh(soup(0, 100, uv=True), 20) is None, "it would move texture coordinates across seams"
    assert simplify_mesh(ball(1), 79) is None, "it saves little"
    mesh = ball(4)
    coarse = simplify_mesh(mesh, mesh.triangles // 4)
    assert coarse is not None
    level, error = coarse
    assert 0.1 * mesh.triangles < level.triangles < 0.5 * mesh.triangles
    assert 0 < error < 0.2
    exact = trimesh.Trimesh(mesh.position, mesh.index)
    centres: NDArray[np.float64] = level.position[level.index].mean(axis=1)
    for points in (level.position, centres):
        _, distance, _ = trimesh.proximity.closest_point_naive(exact, points[::7])
        assert distance.max() <= error
    outwards = np.einsum("nc,nc->n", level.normal, level.position / np.linalg.norm(level.position, axis=1)[:, None])
    assert outwards.min() > -0.01
    assert np.mean(outwards > 0.9) > 0.85
    assert len(encode_mesh_quantised(level)[0]) < 0.8 * len(encode_mesh(level))


@pytest.mark.parametrize(
    ("arrays", "text"),
    [
        ([StoredArray("position", np.zeros((3, 3), np.float32))], "'normal' is missing"),
        ([StoredArray("position", np.zeros((3, 2), np.float32))], "expected f4"),
        ([StoredArray("position", np.full((1, 3), np.nan, np.float32))], "not finite"),
        ([StoredArray("index", np.full((1, 3), 7, np.uint16))], "has the corner 7"),
        ([StoredArray("index", np.full((1, 3), 1, np.uint16))], "corner 1, .* 1"),
    ],
)
def test_invalid_meshes_are_rejected(arrays: list[StoredArray], text: str) -> None:
    whole = {
        "position": np.zeros((1, 3), np.float32),
        "normal": np.zeros((1, 3), np.float32),
        "index": np.zeros((1, 3), np.uint16),
        **{array.name: array.values for array in arrays},
    }
    if len(whole["position"]) != 1:
        del whole["normal"]
    with pytest.raises(AssetDecodeError, match=text):
        decode_mesh(encode_arrays("mesh", [StoredArray(name, values) for name, values in whole.items()]))
