"""Extent of a scene: exact for rotated parts."""

from __future__ import annotations

import math
from pathlib import Path

import mujoco
import numpy as np
import trimesh

from iris_session.scene import AssetStore
from iris_session.scene.builder import SceneBuilder
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.scene.nodes import to_matrix
from iris_session.scene.report import compute_box_extent, compute_extent
from iris_session.scene.shapes import build_primitive

TURN = (0.8, 0.1, -0.3, 0.5)


def test_extent_of_rotated_shapes(tmp_path: Path) -> None:
    """Against the triangles of the same shapes, which are inside and within their tessellation."""
    for kind in ("box", "sphere", "ellipsoid", "capsule", "cylinder"):
        scene = SceneBuilder()
        half = {"half_size": (0.3, 0.1, 0.2)}
        size = {
            "box": half,
            "sphere": {"radius": 0.3},
            "ellipsoid": half,
        }.get(kind, {"radius": 0.1, "half_length": 0.4})
        getattr(scene, f"add_{kind}")(position=(1, 2, 3), quaternion=TURN, **size)
        store = AssetStore(tmp_path / "store")
        spec = scene.build(store).spec
        shape = build_primitive(spec.visuals[0].geometry)
        assert shape is not None
        T = to_matrix(spec.visuals[0].T_body_visual)
        placed = shape.position.astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        found = compute_extent(spec, store)
        assert found is not None
        sides = np.ptp(placed, axis=0)
        assert (np.array(found.size) >= sides - 1e-6).all()
        np.testing.assert_allclose(found.size, sides, rtol=0.02 if kind != "box" else 1e-6)
        np.testing.assert_allclose(np.add(found.low, found.high) / 2, (1, 2, 3), atol=1e-9)
        np.testing.assert_allclose(np.subtract(found.high, found.low), found.size)


def test_extent_of_meshes_by_their_vertices(tmp_path: Path) -> None:
    """A rotated ball keeps its size; the box around it does not."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.5)
    scene = SceneBuilder()
    scene.add_mesh(vertices=ball.vertices, triangles=ball.faces, quaternion=(math.cos(0.4), 0, 0, math.sin(0.4)))
    scene.add_mesh(vertices=ball.vertices, triangles=ball.faces, rgba=(1, 1, 1, 0), position=(50, 0, 0))
    scene.add_plane("floor", half_size=(40, 40))
    scene.add_deformable("cloth", [[0, 0, 2], [0.2, 0, 2], [0, 0.2, 2]], [[0, 1, 2]])
    store = AssetStore(tmp_path / "store")
    spec = scene.build(store).spec
    found, boxes = compute_extent(spec, store), compute_box_extent(spec)
    assert found is not None
    assert boxes is not None
    np.testing.assert_allclose(found.low, (-0.5, -0.5, -0.5), atol=2e-3)
    np.testing.assert_allclose(found.high, (0.5, 0.5, 2.0), atol=2e-3)
    assert boxes.size[0] > 50, "what is not seen counts there: it may be shown later"
    assert spec.environment.extent > 25


def test_extent_of_a_model(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><asset><hfield name="h" nrow="3" ncol="3" size="1 2 0.5 0.25" elevation="0 0 0 0 1 0 0 0 0"/></asset>'
        '<worldbody><geom type="plane" size="9 9 1"/><geom type="hfield" hfield="h" pos="0 0 -3"/>'
        '<geom size="5" group="4"/><body pos="0 3 0"><joint/><geom size="0.5"/></body></worldbody></mujoco>'
    )
    store = AssetStore(tmp_path)
    found = compute_extent(parse_mujoco(model, store).spec, store)
    assert found is not None
    np.testing.assert_allclose(found.low, (-1, -2, -3.25))
    np.testing.assert_allclose(found.high, (1, 3.5, 0.5))
