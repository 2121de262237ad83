"""Deformables in the file: topology once, vertices when they move, on the timelines of their states."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from iris_session.journal.messages import Batch, SceneAssets, VertexFrame
from iris_session.physics.load import encode_model
from iris_session.recording import SessionHeader, pack_model
from iris_session.recording.writer import RrdWriter
from iris_session.scene import AssetDecodeError, AssetStore, decode_arrays
from iris_session.scene.mujoco_deformables import read_drawn_meshes
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.streams.deformable import DeformableEncoder
from iris_session.viewer.deformables import DrawnDeformable
from tests.recording.support import column, read
from tests.recording.test_writer import frame
from tests.scene.models import flexes

BOUND_M = 0.0005
CLOTH, ROPE, SOFT = "/scene/1/world/cloth", "/scene/1/world/rope", "/scene/1/world/soft"


class World:
    """A model with flexes, a file of a session with it, and encoders like those of the session."""

    def __init__(self, folder: Path) -> None:
        self.model = flexes()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)
        self.meshes = read_drawn_meshes(self.model)
        self.encoders = [DeformableEncoder(mesh.topology, BOUND_M) for mesh in self.meshes]
        self.store = AssetStore(folder / "assets")
        self.parsed = parse_mujoco(self.model, self.store)
        self.assets = SceneAssets(-1, 0, str(self.store.root), self.parsed.scene_hash)
        self.packed = pack_model(bytes(encode_model(self.model)))
        self.path, self.closed = folder / "w.rrd", False
        self.writer = RrdWriter(self.path, "id")
        self.writer.write_header(SessionHeader("s", "n", "closed", 2_000_000, model=self.packed))
        self.writer.add(Batch(assets=[self.assets]))

    def vertices(self, index: int) -> np.ndarray:
        return np.array(self.meshes[index].read_vertices(self.data))

    def publish(self, step: int, index: int, vertices: np.ndarray) -> None:
        self.encoders[index].reset()
        frames = self.encoders[index].encode(vertices)
        assert frames is not None
        self.add(VertexFrame(f"flex-{index}", step * 2_000_000 + 7, frames["full"]))

    def add(self, frame: VertexFrame) -> None:
        self.writer.add(Batch(vertices=[frame]))

    def state(self, step: int) -> None:
        self.writer.add(Batch(states=[frame(step, np.zeros((0, 7)))]))

    def read(self) -> dict[str, list[Any]]:
        self.writer.close()
        self.closed = True
        return read(self.path)


@pytest.fixture
def world(tmp_path: Path) -> Iterator[World]:
    world = World(tmp_path)
    yield world
    if not world.closed:
        world.writer.close()


def told(batches: list[Any], name: str) -> dict[int, Any]:
    """Return the vertices by step."""
    found = [batch for batch in batches if name in batch.schema.names]
    return dict(zip(column(found, "step"), column(found, name), strict=True))


def test_topology_is_written_once_and_vertices_as_they_move(world: World) -> None:
    first, then = world.vertices(0), world.vertices(0) + np.array((0.01, 0.02, 0.03))
    world.state(0)
    world.publish(8, 0, first)
    world.state(8)
    world.writer.flush()
    world.state(16)
    world.publish(16, 0, then)
    world.publish(16, 0, then)  # says nothing new
    found = world.read()
    cloth = found[CLOTH]
    assert list(told(cloth, "Mesh3D:triangle_indices")) == [0]
    positions = told(cloth, "Mesh3D:vertex_positions")
    assert sorted(positions) == [0, 8, 16]
    for step, expected in ((0, first), (8, first), (16, then)):
        assert np.linalg.norm(np.array(positions[step]) - expected, axis=1).max() <= BOUND_M + 1e-6
    times = [value.value for batch in cloth for value in batch.column("session_time")]
    assert sorted(times) == [7, 16_000_007, 32_000_007]
    assert world.writer.drawing.vertices_refused == 0


def test_non_finite_vertices_are_finite_in_the_file(world: World) -> None:
    vertices = world.vertices(0)
    vertices[[0, 7]] = (np.nan, np.inf, -np.inf)
    world.state(0)
    world.publish(8, 0, vertices)
    world.state(8)
    drawn = world.read()[CLOTH]
    for name in ("positions", "normals"):
        assert np.isfinite(np.array(told(drawn, f"Mesh3D:vertex_{name}")[8])).all()


def test_ropes_are_lines_and_soft_bodies_surfaces(world: World) -> None:
    rope, soft = world.vertices(1) + 0.5, world.vertices(2) + 0.5
    world.state(0)
    world.publish(8, 1, rope)
    world.publish(8, 2, soft)
    world.state(8)
    found = world.read()
    strips = np.array(told(found[ROPE], "LineStrips3D:strips")[8])
    assert strips == pytest.approx(rope[world.meshes[1].elements], abs=BOUND_M)
    assert told(found[ROPE], "LineStrips3D:radii")[0] == [pytest.approx(0.02)]
    indices = np.array(told(found[SOFT], "Mesh3D:triangle_indices")[0])
    moved = np.array(told(found[SOFT], "Mesh3D:vertex_positions")[8])
    assert moved[indices] == pytest.approx(soft[world.meshes[2].elements], abs=BOUND_M)


def test_invalid_frames_are_rejected_and_counted(world: World) -> None:
    world.state(0)
    for data in (b"", b"\1" * 200):
        world.add(VertexFrame("flex-0", 7, data))
    world.add(VertexFrame("unknown", 7, b""))
    frames = world.encoders[1].encode(world.vertices(1))
    assert frames is not None
    world.add(VertexFrame("flex-0", 7, frames["full"]))  # of another mesh
    found = world.read()
    assert len(told(found[CLOTH], "Mesh3D:vertex_positions")) == 1
    assert world.writer.drawing.vertices_refused == 3


@pytest.mark.parametrize("name", ["elements", "position", "plan"])
def test_damaged_asset_is_an_asset_error(world: World, name: str) -> None:
    (cloth, *_) = world.parsed.spec.deformables
    arrays = dict(decode_arrays(world.store.get(cloth.address), "deformable"))
    arrays[name] = arrays[name][:-1] if name == "position" else np.full_like(arrays[name], 200)
    with pytest.raises(AssetDecodeError):
        DrawnDeformable("e", cloth, arrays)
