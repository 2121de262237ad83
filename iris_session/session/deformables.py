"""Deformables of a session as media streams: the vertices of every mesh, after every published state.

A mesh at rest is sent once a second, for clients that joined meanwhile. Encoding 10,000 vertices costs the tick loop
about a millisecond.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iris_session.physics import World
from iris_session.protocol.media import MAX_STREAMS
from iris_session.protocol.names import MediaEncoding
from iris_session.scene.mujoco_deformables import read_drawn_meshes
from iris_session.streams.deformable import DeformableEncoder
from iris_session.streams.deformable_topology import DeformableTopology

#: Bound on the error of a delivered vertex [m].
BOUND_M: Final = 0.0005
#: Period of a mesh at rest.
REPEAT_NS: Final = 1_000_000_000
#: `publish(stream, frames, capture_ns, scene_epoch, encoding)`; false: the frame is dropped, and counted there.
Publish = Callable[[str, dict[str, bytes], int, int, str], bool]


class DeformableSourceMesh(NamedTuple):
    """A mesh whose vertices move. `vertices` returns the present ones, shape (n, 3) [m], world frame."""

    stream: str
    topology: DeformableTopology
    vertices: Callable[[], NDArray[np.floating]]


class _Stream:
    def __init__(self, mesh: DeformableSourceMesh) -> None:
        self.mesh = mesh
        self.encoder = DeformableEncoder(mesh.topology, BOUND_M)
        self.sent_ns = 0


class DeformableStreams:
    """Streams of the deformables of one scene at a time. `publish` passes a frame to the front."""

    def __init__(self, meshes: Sequence[DeformableSourceMesh], publish: Publish) -> None:
        self._publish_frame = publish
        self.replace_meshes(meshes)

    def replace_meshes(self, meshes: Sequence[DeformableSourceMesh]) -> None:
        """Stream the meshes of another scene from now on."""
        self._streams = [_Stream(mesh) for mesh in meshes]
        self._epoch = -1

    @property
    def stream_names(self) -> frozenset[str]:
        """Names of the streams. From any thread."""
        return frozenset(one.mesh.stream for one in self._streams)

    def publish(self, scene_epoch: int, end_ns: int, shown_ns: int) -> None:
        """Publish the vertices as they are after the newest tick; call it at the rate of the state.

        Args:
            scene_epoch: Of the published state.
            end_ns: Session time of the end of that tick, or now where the state is published again.
            shown_ns: Session time of the end of that tick.
        """
        if scene_epoch != self._epoch:
            self._epoch = scene_epoch
            for stream in self._streams:
                stream.encoder.reset()
        for stream in self._streams:
            if end_ns - stream.sent_ns >= REPEAT_NS:  # independent of the rate of the state
                stream.encoder.reset()
            frames = stream.encoder.encode(stream.mesh.vertices())
            if frames is None:
                continue
            stream.sent_ns = end_ns
            if not self._publish_frame(stream.mesh.stream, frames, shown_ns, scene_epoch, MediaEncoding.DEFORMABLE):
                stream.encoder.reset()  # it was dropped: the next frame must be complete


def list_deformables(world: World) -> list[DeformableSourceMesh]:
    """Return the meshes of a MuJoCo world whose vertices move: flexes, skins and tendons that are streamed."""
    meshes = read_drawn_meshes(world.model)[:MAX_STREAMS]
    return [
        DeformableSourceMesh(mesh.stream, mesh.topology, partial(mesh.read_vertices, world.data)) for mesh in meshes
    ]
