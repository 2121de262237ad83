"""What bends in a session, as media streams: the vertices of every mesh, after every published state.

A mesh at rest is sent once a second, for those who came meanwhile. Encoding 10,000 vertices takes the loop that takes
the ticks about a millisecond.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iris_session.physics import World
from iris_session.protocol.names import MediaEncoding
from iris_session.scene.mujoco_assets import read_flex_mesh, stream_name
from iris_session.streams.deformable import DeformableEncoder
from iris_session.streams.deformable_topology import DeformableTopology

#: Farthest that a delivered vertex is from where it was [m].
BOUND_M: Final = 0.0005
#: Of a mesh at rest.
REPEAT_NS: Final = 1_000_000_000
#: `publish(stream, frames, capture_ns, scene_epoch, encoding)`; false: the frame is dropped, and counted there.
Publish = Callable[[str, dict[str, bytes], int, int, str], bool]


class Bending(NamedTuple):
    """A mesh whose vertices move. `vertices` gives those of now, (n, 3) [m], world frame."""

    stream: str
    topology: DeformableTopology
    vertices: Callable[[], NDArray[np.floating]]


class _Stream:
    def __init__(self, mesh: Bending) -> None:
        self.mesh = mesh
        self.encoder = DeformableEncoder(mesh.topology, BOUND_M)
        self.sent_ns = 0


class DeformableStreams:
    """What bends in one scene at a time. `publish` hands a frame to the front."""

    def __init__(self, meshes: Sequence[Bending], publish: Publish) -> None:
        self._publish = publish
        self.use(meshes)

    def use(self, meshes: Sequence[Bending]) -> None:
        """Those of another scene from now on."""
        self._streams = [_Stream(mesh) for mesh in meshes]
        self._epoch = -1

    @property
    def streams(self) -> frozenset[str]:
        """Their names. From any thread."""
        return frozenset(one.mesh.stream for one in self._streams)

    def send(self, scene_epoch: int, end_ns: int, shown_ns: int) -> None:
        """The vertices as they are after the newest tick, which ended at `shown_ns`; call it at the rate of the state.
        `end_ns`: when it did, or now, where the state is sent again."""
        if scene_epoch != self._epoch:
            self._epoch = scene_epoch
            for stream in self._streams:
                stream.encoder.reset()
        for stream in self._streams:
            if end_ns - stream.sent_ns >= REPEAT_NS:  # whatever the rate of the state is
                stream.encoder.reset()
            frames = stream.encoder.encode(stream.mesh.vertices())
            if frames is None:
                continue
            stream.sent_ns = end_ns
            if not self._publish(stream.mesh.stream, frames, shown_ns, scene_epoch, MediaEncoding.DEFORMABLE):
                stream.encoder.reset()  # nobody got it: the next one is sent whatever it is


def flexes(world: World) -> list[Bending]:
    """The flexes of a world."""
    meshes = [read_flex_mesh(world.model, index) for index in range(world.model.nflex)]
    return [Bending(stream_name(index), mesh.topology, _of(world, mesh.vertices)) for index, mesh in enumerate(meshes)]


def _of(world: World, rows: NDArray[np.int64]) -> Callable[[], NDArray[np.floating]]:
    return lambda: world.data.flexvert_xpos[rows]
