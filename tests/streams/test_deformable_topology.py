"""Topologies: the plan of each mesh, stable bytes, read-only tables, and rejection of tables no encoder makes."""

from __future__ import annotations

import struct
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.streams.deformable import DeformableDecoder, DeformableEncoder
from iris_session.streams.deformable_topology import (
    MAX_LEVELS,
    MAX_VERTICES,
    ROWS,
    TREE,
    DeformableTopology,
    used_vertices,
)
from iris_session.streams.errors import StreamError
from tools.codegen.deformable_golden import make_cloth, make_rope, make_shell

SCENE = """
<mujoco>
  <option integrator="discrete" solver="CG" timestep="0.005"/>
  <worldbody>
    <geom type="plane" size="2 2 .1"/>
    <flexcomp name="rope" type="grid" dim="1" count="12 1 1" spacing=".02 .02 .02" pos="1 0 .5" mass=".1">
      <edge equality="true"/>
    </flexcomp>
    <flexcomp name="cloth" type="grid" dim="2" count="8 6 1" spacing=".02 .02 .02" pos="0 1 .5" mass=".1">
      <edge equality="true"/>
    </flexcomp>
    <flexcomp name="soft" type="grid" dim="3" count="5 4 4" spacing=".02 .02 .02" pos="0 0 .2" mass=".1"
              dof="trilinear">
      <elasticity young="5e3" poisson=".2" damping=".1"/>
    </flexcomp>
  </worldbody>
</mujoco>
"""


def test_mujoco_flexes_of_every_dimension() -> None:
    """A rope is one row, a cloth rows, the shell of a solid a tree without inner vertices; decoded in motion."""
    model = mujoco.MjModel.from_xml_string(SCENE)
    data = mujoco.MjData(model)
    plans = []
    streams = []
    for flex in range(model.nflex):
        begin, count = int(model.flex_vertadr[flex]), int(model.flex_vertnum[flex])
        if model.flex_dim[flex] == 3:
            at, size = int(model.flex_shelldataadr[flex]), 3 * int(model.flex_shellnum[flex])
            used, faces = used_vertices(count, model.flex_shell[at : at + size])
            topology = DeformableTopology(len(used), faces)
        else:
            at = int(model.flex_elemdataadr[flex])
            width = int(model.flex_dim[flex]) + 1
            elements = model.flex_elem[at : at + width * int(model.flex_elemnum[flex])]
            used = np.arange(count)
            topology = DeformableTopology(count, elements) if width == 3 else DeformableTopology(count, edges=elements)
        plans.append((topology.plan, topology.n_vertices, topology.order is None))
        streams.append((begin + used, DeformableEncoder(topology), DeformableDecoder(topology)))
    assert plans == [(ROWS, 12, True), (ROWS, 48, True), (TREE, 80 - 3 * 2 * 2, False)]
    moved = np.zeros(model.nflex)
    for _ in range(60):
        mujoco.mj_step(model, data)
        for i, (vertices, encoder, decoder) in enumerate(streams):
            truth = data.flexvert_xpos[vertices]
            frames = encoder.encode(truth)
            if frames is not None:
                moved[i] += 1
                assert np.linalg.norm(decoder.decode(frames["full"]) - truth, axis=1).max() <= 0.0005
    assert (moved > 50).all()


def test_plans() -> None:
    assert (make_cloth(9, 7)[0].rows, make_cloth(9, 7)[0].cols) == (9, 7)
    quads = np.arange(20).reshape(4, 5)
    lines = np.concatenate(
        [
            np.stack([quads[:, :-1].ravel(), quads[:, 1:].ravel()], 1),
            np.stack([quads[:-1].ravel(), quads[1:].ravel()], 1),
        ]
    )
    net = DeformableTopology(20, edges=lines)
    assert (net.plan, net.rows, net.cols) == (ROWS, 4, 5)
    walked = make_rope(30)[0]
    assert (walked.plan, walked.rows, walked.cols) == (ROWS, 1, 30)
    assert walked.order is not None
    assert {frozenset(pair) for pair in zip(walked.order[:-1].tolist(), walked.order[1:].tolist(), strict=True)} == {
        frozenset(pair) for pair in walked.edges.tolist()
    }, "a rope is walked from end to end"
    assert make_shell(4)[0].plan == TREE


def test_long_ribbon_uses_a_walk_instead_of_a_deep_tree() -> None:
    n = 4 * MAX_LEVELS
    shuffled = np.random.default_rng(0).permutation(n)
    ribbon = shuffled[np.stack([np.arange(n - 2) + k for k in range(3)], axis=1)]
    topology = DeformableTopology(n, ribbon)
    assert (topology.plan, topology.cols) == (ROWS, n)
    vertices = np.random.default_rng(1).uniform(0.0, 1.0, (n, 3))
    frames = DeformableEncoder(topology).encode(vertices)
    assert frames is not None
    assert np.linalg.norm(DeformableDecoder(topology).decode(frames["full"]) - vertices, axis=1).max() <= 0.0005


@pytest.mark.parametrize("made", [make_cloth(5, 4), make_shell(3), make_rope(9)], ids=["cloth", "shell", "rope"])
def test_bytes_are_stable_and_tables_read_only(made: tuple[DeformableTopology, Any]) -> None:
    topology = made[0]
    back = DeformableTopology.from_bytes(topology.to_bytes())
    assert back.to_bytes() == topology.to_bytes()
    assert back.identity == topology.identity
    assert back.levels == topology.levels
    for table in (back.faces, back.edges, back.order, back.parents):
        assert table is None or not table.flags.writeable


def test_topology_without_tables_has_only_the_plan() -> None:
    grid, tree = make_cloth(100, 100)[0], make_shell(5)[0]
    assert len(grid.without_faces().to_bytes()) == 24
    assert len(tree.without_faces().to_bytes()) == 24 + 16 * tree.n_vertices
    assert tree.without_faces().identity != tree.identity
    vertices = make_shell(5)[1]
    frames = DeformableEncoder(tree.without_faces()).encode(vertices)
    assert frames is not None
    client = DeformableTopology.from_bytes(tree.without_faces().to_bytes())
    assert np.linalg.norm(DeformableDecoder(client).decode(frames["full"]) - vertices, axis=1).max() <= 0.0005


@settings(max_examples=120, deadline=None)
@given(
    st.sampled_from([make_shell(3)[0].to_bytes(), make_rope(6)[0].to_bytes(), make_cloth(3, 3)[0].to_bytes()]),
    st.data(),
)
def test_damaged_topologies_are_rejected_or_usable(good: bytes, data: st.DataObject) -> None:
    damaged = bytearray(good)
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    try:
        topology = DeformableTopology.from_bytes(memoryview(damaged))
    except StreamError:
        return
    vertices = np.random.default_rng(0).uniform(0.0, 1.0, (topology.n_vertices, 3))
    frames = DeformableEncoder(topology).encode(vertices)
    assert frames is not None
    assert np.linalg.norm(DeformableDecoder(topology).decode(frames["full"]) - vertices, axis=1).max() <= 0.0005


def test_inconsistent_tables_are_rejected() -> None:
    chain = np.stack([np.arange(-1, 2 * MAX_LEVELS - 1)] * 3).clip(0)
    n = chain.shape[1]
    head = struct.pack("<BBHIIIII", 1, TREE, 0, n, 0, 0, 0, 0)
    with pytest.raises(StreamError, match="levels"):
        DeformableTopology.from_bytes(head + chain.astype("<u4").tobytes())
    forward = struct.pack("<BBHIIIII", 1, TREE, 0, 2, 0, 0, 0, 0) + np.array([0, 1] * 3, "<u4").tobytes()
    with pytest.raises(StreamError, match="after it"):
        DeformableTopology.from_bytes(forward)
    twice = struct.pack("<BBHIIIII", 1, ROWS, 1, 2, 1, 2, 0, 0) + np.array([1, 1], "<u4").tobytes()
    with pytest.raises(StreamError, match="each once"):
        DeformableTopology.from_bytes(twice)
    beyond = struct.pack("<BBHIIIII", 1, ROWS, 0, 2, 1, 2, 1, 0) + np.array([0, 1, 2], "<u4").tobytes()
    with pytest.raises(StreamError, match="names vertex 2 of 2"):
        DeformableTopology.from_bytes(beyond)
    with pytest.raises(StreamError, match="header asks"):
        DeformableTopology.from_bytes(struct.pack("<BBHIIIII", 1, ROWS, 0, 2**18, 1, 2**18, 2**20, 2**20))


def test_invalid_meshes_are_rejected() -> None:
    for n in (0, MAX_VERTICES + 1):
        with pytest.raises(ValueError, match="1 to"):
            DeformableTopology(n)
    with pytest.raises(ValueError, match="numbers begin at 0"):
        DeformableTopology(3, [(0, 1, 3)])
    with pytest.raises(ValueError, match="numbers begin at 0"):
        DeformableTopology(3, edges=[(-1, 0)])
