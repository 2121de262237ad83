"""Flexes of a compiled MuJoCo model as deformables: topology and rest shape once, vertices by the media channel.

Skins are not among them: MuJoCo moves their vertices by bodies with weights, on the drawing side.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.scene import Deformable
from iris_session.protocol.scene_names import ArrayFilter, ArrayKind
from iris_session.scene.arrays import Stored, encode_arrays
from iris_session.scene.build import Builder
from iris_session.scene.mujoco_looks import drawn_rgba
from iris_session.scene.mujoco_names import label

#: Below this many vertices their numbers fit 16 bits.
_SHORT: Final = 1 << 16


def stream_name(index: int) -> str:
    """Media stream of a flex, by its id."""
    return f"flex-{index}"


def deformables(model: mujoco.MjModel, data: Any, builder: Builder) -> tuple[Deformable, ...]:
    """All flexes, by id; `data` has the initial state, with kinematics."""
    parts = [topology(model, i) for i in range(model.nflex)]
    rest = [_vertices(model, data, i) for i in range(model.nflex)]
    notes = builder.run(
        [
            builder.blob([b"flex", vertices, elements, *([] if uv is None else [uv])], _encode(vertices, elements, uv))
            for vertices, (elements, uv) in zip(rest, parts, strict=True)
        ]
    )
    return tuple(
        Deformable(
            name=label(model, "flex", i),
            dim=int(model.flex_dim[i]),
            group=int(model.flex_group[i]),
            vertices=len(rest[i]),
            elements=len(parts[i][0]),
            radius=float(model.flex_radius[i]),
            flat=bool(model.flex_flatskin[i]),
            material=int(model.flex_matid[i]),
            rgba=drawn_rgba(model, model.flex_rgba[i], int(model.flex_matid[i])),
            stream=stream_name(i),
            address=note.address,
            bytes=note.bytes,
        )
        for i, note in enumerate(notes)
    )


def topology(model: mujoco.MjModel, index: int) -> tuple[NDArray[np.uint32], NDArray[np.float32] | None]:
    """What is drawn of a flex: edges (n, 2) of a rope, triangles (n, 3) of a cloth or of the surface of a soft body;
    and texture coordinates of each element's corners, where it has them."""
    dim = int(model.flex_dim[index])
    if dim == 3:
        start, count = int(model.flex_shelldataadr[index]), int(model.flex_shellnum[index])
        corners = model.flex_shell[start : start + 3 * count].reshape(-1, 3)
    else:
        start, count = int(model.flex_elemdataadr[index]), int(model.flex_elemnum[index])
        corners = model.flex_elem[start : start + (dim + 1) * count].reshape(-1, dim + 1)
    uv = None
    at = int(model.flex_texcoordadr[index])
    if at >= 0 and dim == 2:
        which = corners
        if hasattr(model, "flex_elemtexcoord"):
            which = model.flex_elemtexcoord[start : start + 3 * count].reshape(-1, 3)
        uv = np.ascontiguousarray(model.flex_texcoord[at + which], np.float32)
    elif at >= 0 and dim == 3:
        uv = np.ascontiguousarray(model.flex_texcoord[at + corners], np.float32)
    return np.ascontiguousarray(corners, np.uint32), uv


def _vertices(model: mujoco.MjModel, data: Any, index: int) -> NDArray[np.float32]:
    start = int(model.flex_vertadr[index])
    return np.array(data.flexvert_xpos[start : start + int(model.flex_vertnum[index])], np.float32)


def _encode(
    vertices: NDArray[np.float32], elements: NDArray[np.uint32], uv: NDArray[np.float32] | None
) -> Callable[[], bytes]:
    def encode() -> bytes:
        narrow = elements.astype(np.uint16) if len(vertices) <= _SHORT else elements
        arrays = [
            Stored("elements", narrow, ArrayFilter.DELTA),
            Stored("position", vertices, ArrayFilter.SHUFFLE),
        ]
        if uv is not None:
            arrays.append(Stored("uv", uv, ArrayFilter.SHUFFLE))
        return encode_arrays(ArrayKind.DEFORMABLE, arrays)

    return encode
