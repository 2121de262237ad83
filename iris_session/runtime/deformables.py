"""What bends in the present world, as media streams: the vertices of every flex, after every published state.

A mesh at rest is sent once a second, for those who came meanwhile. Encoding 10,000 vertices takes the loop that takes
the ticks about a millisecond.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, NamedTuple

from iris_session.physics import World
from iris_session.protocol.names import MediaEncoding
from iris_session.scene.mujoco_deformables import FlexMesh, flex_mesh, stream_name
from iris_session.streams.deformable import DeformableEncoder

#: Farthest that a delivered vertex is from where it was [m].
BOUND_M: Final = 0.0005
#: `publish(stream, frames, capture_ns, scene_epoch, encoding)`; false: the frame is dropped, and counted there.
Publish = Callable[[str, dict[str, bytes], int, int, str], bool]


class _Stream(NamedTuple):
    name: str
    mesh: FlexMesh
    encoder: DeformableEncoder


class DeformableStreams:
    """The flexes of one world at a time. `publish` hands a frame to the front."""

    def __init__(self, world: World, publish: Publish) -> None:
        self._publish = publish
        self.use(world)

    def use(self, world: World) -> None:
        """Another world from now on."""
        self._world = world
        meshes = [flex_mesh(world.model, index) for index in range(world.model.nflex)]
        self._streams = [
            _Stream(stream_name(i), mesh, DeformableEncoder(mesh.topology, BOUND_M)) for i, mesh in enumerate(meshes)
        ]
        self._epoch = -1

    def send(self, scene_epoch: int, end_ns: int) -> None:
        """The vertices as they are after the newest tick, which ended at `end_ns`; call it at the rate of the state."""
        if scene_epoch != self._epoch:
            self._epoch = scene_epoch
            for stream in self._streams:
                stream.encoder.reset()
        for stream in self._streams:
            frames = stream.encoder.encode(self._world.data.flexvert_xpos[stream.mesh.vertices])
            if frames is not None and not self._publish(
                stream.name, frames, end_ns, scene_epoch, MediaEncoding.DEFORMABLE
            ):
                stream.encoder.reset()  # nobody got it: the next one is sent whatever it is
