"""What a `SceneBuilder` makes: a specification with its assets in a store, and what is needed to move its things.

Publishing code reads this; nothing here knows files, sessions or clocks. Body 0 is the world; moving bodies have the
ids 1..n in the order of `ComposedScene.moving` and no parent but the world; bodies that stand still come after them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import Pose
from iris_session.protocol.scene import SceneSpec, asset_addresses
from iris_session.scene.articulation import Articulation
from iris_session.streams.deformable_topology import DeformableTopology


@dataclass(frozen=True)
class DeformableSource:
    """A mesh whose vertices are published. `name`: as it was added. `stream`: its media stream.

    `topology`: the plan of the stream, as `DeformableEncoder` takes it. `vertices`: the first ones, float32 (n, 3) [m],
    world frame, read-only; all later ones have the same shape and order.
    """

    name: str
    stream: str
    topology: DeformableTopology
    vertices: NDArray[np.float32]


@dataclass(frozen=True)
class ComposedScene:
    """A scene whose assets, the specification among them, are in the store: hold `addresses` there while it is served.

    `moving`: names of the bodies that are streamed, each once; body `i + 1` is `moving[i]`. `poses`: their first poses,
    T_world_body, in the same order. `articulations`, `deformables`: by the name they were added under. Bodies of an
    articulation are in `moving` too; its root is moved by `Articulation.name`. `skipped`: what clients will not see, a
    line each. `notes`: what looks like a mistake of units, a line each, with what would be right. `built`, `recalled`:
    pieces of work that were done, and that the store remembered.
    """

    spec: SceneSpec
    scene_hash: str
    moving: tuple[str, ...]
    poses: tuple[Pose, ...]
    articulations: Mapping[str, Articulation]
    deformables: Mapping[str, DeformableSource]
    skipped: tuple[str, ...]
    notes: tuple[str, ...] = ()
    built: int = 0
    recalled: int = 0

    @property
    def addresses(self) -> tuple[str, ...]:
        """All assets in the order in which they show something: to be held in the store, and served."""
        return (self.scene_hash, *asset_addresses(self.spec))
