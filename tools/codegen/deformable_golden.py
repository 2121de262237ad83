"""Golden vectors of the deformable stream, for tests of this and every other decoder.

docs/protocol/deformable.json, written by `python -m tools.codegen deformable`: per mesh its topology, and frames
with the vertices that they decode to. Packed planes are those of the zlib that is installed: another may pack
them otherwise, which decodes to the same.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from iris_session.protocol.names import BudgetClass
from iris_session.streams.deformable import COARSER, DeformableDecoder, DeformableEncoder, read_header
from iris_session.streams.deformable_topology import DeformableTopology, used_vertices
from tools.codegen.vectors import render_vectors, scatter_numbers, to_json_numbers

Floats = npt.NDArray[np.float64]


def make_cloth(rows: int, cols: int, spacing_m: float = 0.01) -> tuple[DeformableTopology, Floats]:
    """Return a wavy cloth, numbered along its rows: topology and vertices (n, 3) [m]."""
    row, col = np.divmod(np.arange(rows * cols), cols)
    u, v = row * spacing_m, col * spacing_m
    vertices = np.stack([u - 0.2, v + 1.5, 0.8 + 0.02 * np.sin(40.0 * u) * np.cos(25.0 * v)], axis=1)
    corner = np.arange(rows * cols).reshape(rows, cols)
    a, b, c, d = (x.ravel() for x in (corner[:-1, :-1], corner[1:, :-1], corner[1:, 1:], corner[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    return DeformableTopology(rows * cols, faces), vertices


def make_shell(side: int, spacing_m: float = 0.02) -> tuple[DeformableTopology, Floats]:
    """Return the outside of a squeezed box of `side`^3 vertices: closed, and numbered without order."""
    grid = np.array(list(itertools.product(range(side), repeat=3)))
    number = {tuple(place): i for i, place in enumerate(grid.tolist())}
    faces = []
    for axis, end in itertools.product(range(3), (0, side - 1)):
        for i, j in itertools.product(range(side - 1), repeat=2):
            corners = [(i, j), (i + 1, j), (i + 1, j + 1), (i, j + 1)]
            a, b, c, d = (number[tuple(np.insert(np.array(place), axis, end).tolist())] for place in corners)
            faces += [(a, b, c), (a, c, d)]
    used, table = used_vertices(len(grid), faces)
    shuffled = np.argsort(scatter_numbers(len(used)))
    places = np.empty((len(used), 3))
    places[shuffled] = grid[used] * spacing_m
    height = places[:, 2:] / (side * spacing_m)
    places[:, :2] *= 1.0 + 0.3 * np.sin(3.0 * height)
    return DeformableTopology(len(used), shuffled[table]), places + np.array((3.0, -2.0, 0.5))


def make_rope(n: int, spacing_m: float = 0.015) -> tuple[DeformableTopology, Floats]:
    """Return a hanging rope whose vertices are numbered without order."""
    shuffled = np.argsort(scatter_numbers(n))
    x = (np.arange(n) - n / 2) * spacing_m
    vertices = np.empty((n, 3))
    vertices[shuffled] = np.stack([x, 0.1 * x, 1.0 + 2.0 * x**2], axis=1)
    return DeformableTopology(n, edges=np.stack([shuffled[:-1], shuffled[1:]], axis=1)), vertices


def iterate_meshes() -> Iterator[tuple[str, DeformableTopology, dict[str, Floats]]]:
    """Return name, topology, and vertices by the name of a frame."""
    topology, vertices = make_cloth(6, 5)
    broken = vertices.copy()
    broken[3], broken[17] = (np.nan, 0.0, np.inf), (0.25, -5e6, 1.0)
    noise = 2.0 * scatter_numbers(vertices.size).reshape(vertices.shape) - 1.0
    crumpled, scattered = vertices + 0.2 * noise, 4000.0 * noise
    yield (
        "cloth",
        topology,
        {"wavy": vertices, "two escapes": broken, "crumpled": crumpled, "scattered over 8 km": scattered},
    )
    topology, vertices = make_cloth(24, 24)
    yield "larger cloth, packed", topology, {"wavy": vertices}
    topology, vertices = make_shell(5)
    yield "shell of a soft body", topology, {"squeezed": vertices}
    topology, vertices = make_rope(16)
    yield "rope", topology, {"hanging": vertices}
    yield "one vertex", DeformableTopology(1), {"alone": np.array([[0.1, -0.2, 0.3]])}


def build_golden() -> dict[str, Any]:
    """Return the content of the file. Coordinates are numbers with the value of the float32, null if not finite."""
    content = []
    for name, topology, frames in iterate_meshes():
        rows = []
        for frame, vertices in frames.items():
            for budget_class in COARSER if name == "cloth" and frame == "wavy" else (BudgetClass.FULL,):
                made = DeformableEncoder(topology).encode(vertices, (budget_class,))
                assert made is not None
                payload = made[budget_class]
                rows.append(
                    {
                        "name": f"{frame}/{budget_class}",
                        "bound_m": read_header(payload).bound_m,
                        "hex": payload.hex(),
                        "vertices": to_json_numbers(DeformableDecoder(topology).decode(payload)),
                    }
                )
        content.append({"name": name, "topology": topology.to_bytes().hex(), "frames": rows})
    return {"format": 1, "meshes": content}


def render_golden() -> str:
    """Return the text of the file."""
    return render_vectors(build_golden(), "frames")
