"""Flexes of a compiled MuJoCo model as deformables: topology and rest shape once, vertices by the media channel.

Skins are not among them: MuJoCo moves their vertices by bodies with weights, on the drawing side.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.scene import Deformable
from iris_session.scene.build import Builder
from iris_session.scene.deformable_assets import encode_deformable
from iris_session.scene.mujoco_looks import drawn_rgba
from iris_session.scene.mujoco_names import label
from iris_session.streams.deformable_topology import DeformableTopology, used_vertices


def stream_name(index: int) -> str:
    """Media stream of a flex, by its id."""
    return f"flex-{index}"


def deformables(model: mujoco.MjModel, data: Any, builder: Builder) -> tuple[Deformable, ...]:
    """All flexes, by id; `data` has the initial state, with kinematics."""
    parts = [flex_mesh(model, i) for i in range(model.nflex)]
    rest = [np.array(data.flexvert_xpos[part.vertices], np.float32) for part in parts]
    notes = builder.run(
        [
            builder.blob([b"flex", *part.raw, vertices], part.encode(vertices))
            for part, vertices in zip(parts, rest, strict=True)
        ]
    )
    return tuple(
        Deformable(
            name=label(model, "flex", i),
            dim=int(model.flex_dim[i]),
            group=int(model.flex_group[i]),
            vertices=len(rest[i]),
            elements=len(parts[i].elements),
            radius=float(model.flex_radius[i]),
            flat=bool(model.flex_flatskin[i]),
            material=_material(model, i),
            rgba=drawn_rgba(model, model.flex_rgba[i], _material(model, i)),
            stream=stream_name(i),
            address=note.address,
            bytes=note.bytes,
        )
        for i, note in enumerate(notes)
    )


def _material(model: mujoco.MjModel, index: int) -> int:
    """Since MuJoCo 4 every element has one: that of the first, as models give it to a flex."""
    by_element = len(model.flex_matid) == model.nflexelem
    return int(model.flex_matid[int(model.flex_elemadr[index]) if by_element else index])


@dataclass(frozen=True)
class FlexMesh:
    """What is drawn of a flex: `elements`, edges (n, 2) of a rope, triangles (n, 3) of a cloth or of the surface of a
    soft body; `uv`, texture coordinates of each element's corners, where it has them.

    `vertices`: rows of `flexvert_xpos`, without those inside of a solid; `numbers`: theirs in the flex. `topology`: the
    plan of the stream.
    """

    elements: NDArray[np.uint32]
    uv: NDArray[np.float32] | None
    vertices: NDArray[np.int64]
    numbers: NDArray[np.int64]
    topology: DeformableTopology

    @property
    def raw(self) -> list[NDArray[Any]]:
        """What the asset depends on, besides the vertices at rest."""
        return [self.elements, self.numbers, *([] if self.uv is None else [self.uv])]

    def encode(self, rest: NDArray[np.float32]) -> Callable[[], bytes]:
        """The asset, for vertices at rest (n, 3) [m], world frame."""

        numbers = self.numbers if len(self.numbers) <= int(self.numbers.max()) else None  # the inside is left out
        return lambda: encode_deformable(self.elements, self.uv, rest, self.topology, numbers)


def flex_mesh(model: mujoco.MjModel, index: int) -> FlexMesh:
    """The mesh of one flex, by its id."""
    dim = int(model.flex_dim[index])
    if dim == 3:
        start, count = int(model.flex_shelldataadr[index]), int(model.flex_shellnum[index])
        corners = model.flex_shell[start : start + 3 * count].reshape(-1, 3)
    else:
        start, count = int(model.flex_elemdataadr[index]), int(model.flex_elemnum[index])
        corners = model.flex_elem[start : start + (dim + 1) * count].reshape(-1, dim + 1)
    n = int(model.flex_vertnum[index])
    used, elements = used_vertices(n, corners) if dim == 3 else (np.arange(n), corners)
    ends = {"edges": elements} if dim == 1 else {"faces": elements}
    return FlexMesh(
        np.ascontiguousarray(elements, np.uint32),
        _texture_coordinates(model, index, start, corners),
        int(model.flex_vertadr[index]) + used,
        used,
        DeformableTopology(len(used), **ends).bare(),
    )


def _texture_coordinates(
    model: mujoco.MjModel, index: int, start: int, corners: NDArray[np.int32]
) -> NDArray[np.float32] | None:
    at, dim = int(model.flex_texcoordadr[index]), int(model.flex_dim[index])
    if at < 0 or dim == 1:
        return None
    which = corners
    if dim == 2 and hasattr(model, "flex_elemtexcoord"):
        which = model.flex_elemtexcoord[start : start + 3 * len(corners)].reshape(-1, 3)
    return np.ascontiguousarray(model.flex_texcoord[at + which], np.float32)
