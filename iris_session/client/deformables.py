"""What bends in the session's scene, as a client sees it: the newest vertices of every deformable.

shapes = Deformables(client)
while True:
    client.poll(0.01)
    for name in shapes.tend():
        print(name, shapes.vertices[name][0])  # p_world of vertex 0 [m]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from iris_session.client.asset_fetch import AssetFetch
from iris_session.client.client import Client
from iris_session.client.errors import ClientError
from iris_session.client.media import MediaFeed
from iris_session.protocol.assets import is_address
from iris_session.protocol.names import MediaEncoding
from iris_session.protocol.scene import Deformable, decode_scene
from iris_session.protocol.scene_names import ArrayKind
from iris_session.scene.arrays import decode_arrays, require
from iris_session.scene.errors import AssetError
from iris_session.streams.deformable import DeformableDecoder
from iris_session.streams.deformable_topology import MAX_VERTICES, DeformableTopology
from iris_session.streams.errors import StreamError

#: A scene whose assets did not come is tried again after so many calls of `tend`: who polls has the clock.
RETRY_CALLS: Final = 500
#: Largest asset of a deformable in memory, about twice what the largest mesh has: it is read where the client polls.
MAX_ASSET_BYTES: Final = 128 << 20


class _Mesh:
    """One deformable: its stream, and where its vertices stand in the numbering of the model."""

    feed: MediaFeed

    def __init__(self, key: str, spec: Deformable, asset: memoryview) -> None:
        arrays = decode_arrays(asset, ArrayKind.DEFORMABLE, MAX_ASSET_BYTES)
        topology = DeformableTopology.from_bytes(arrays["plan"].tobytes())
        self.key, self.stream = key, spec.stream
        self.decoder = DeformableDecoder(topology)
        self.numbers = arrays.get("vertex")
        if self.numbers is not None:
            self.numbers = require(arrays, "vertex", "u2 u4", (topology.n_vertices,))
            if int(self.numbers.max(initial=0)) >= MAX_VERTICES:
                raise ValueError(f"deformable {spec.name!r} numbers its vertices beyond {MAX_VERTICES}")
        self.seq = -1

    def placed(self, p_world: NDArray[np.float32]) -> NDArray[np.float32]:
        """By number in the model; what is inside of a solid is not a number."""
        if self.numbers is None:
            return p_world
        everywhere = np.full((int(self.numbers.max()) + 1, 3), np.nan, np.float32)
        everywhere[self.numbers] = p_world
        return everywhere


class Deformables:
    """`vertices`: positions (n, 3) [m], world frame, by name of the deformable; numbered as in the model. One without a
    name, or with that of another, goes by its stream (`keys`). `capture_ns`: the session time at which they were there,
    by the same names. What is at rest comes once a second: older than that is not known, but what was there then.

    `scene_hash`: of the scene they are of. `fault`: why nothing can be seen of it, empty while all is well. Everything
    happens in `tend`, which never waits.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self.scene_hash = ""
        self.fault = ""
        self.vertices: dict[str, NDArray[np.float32]] = {}
        self.capture_ns: dict[str, int] = {}
        self._meshes: list[_Mesh] = []
        self._parts: tuple[Deformable, ...] = ()
        self._fetch: AssetFetch | None = None
        self._retry_in = 0

    def tend(self) -> list[str]:
        """Follows the scene and takes the newest frames. Names of those that have moved since the last call."""
        scene_hash = self._client.mirror.scene_hash
        self._retry_in = max(0, self._retry_in - 1)
        if self._client.ready and (scene_hash != self.scene_hash or (self.fault and not self._retry_in)):
            self._begin(scene_hash)
        if self._fetch is not None and self._fetch.done:
            self._take(self._fetch)
        return [mesh.key for mesh in self._meshes if self._show(mesh)]

    def _begin(self, scene_hash: str) -> None:
        self._drop()
        self.scene_hash, self.fault, self._retry_in = scene_hash, "", RETRY_CALLS
        if is_address(scene_hash):
            self._fetch = self._client.fetch_assets([scene_hash])
        else:
            self.fault = "this session shares no specification of its scene"

    def _drop(self) -> None:
        if self._fetch is not None:
            self._client.cancel_assets(self._fetch)
        for mesh in self._meshes:
            self._client.drop_media(mesh.stream)
        self._meshes, self._parts, self._fetch = [], (), None
        self.vertices.clear()
        self.capture_ns.clear()

    def _take(self, fetch: AssetFetch) -> None:
        """The specification, then the meshes that it names."""
        self._fetch = None
        try:
            fetch.check()
            if not self._parts:
                self._parts = decode_scene(fetch.view(self.scene_hash)).deformables
                if self._parts:
                    self._fetch = self._client.fetch_assets([part.address for part in self._parts])
            else:
                for key, part in zip(keys(self._parts), self._parts, strict=True):
                    mesh = _Mesh(key, part, fetch.view(part.address))
                    mesh.feed = self._client.media(part.stream)
                    self._meshes.append(mesh)
        except (ClientError, AssetError, StreamError, KeyError, ValueError) as error:
            self._drop()
            self.fault = str(error)

    def _show(self, mesh: _Mesh) -> bool:
        frame = mesh.feed.newest
        if frame is None or frame.header.seq == mesh.seq or frame.header.encoding != MediaEncoding.DEFORMABLE:
            return False
        mesh.seq = frame.header.seq
        if frame.header.scene_epoch != self._client.mirror.scene_epoch:
            return False
        try:
            self.vertices[mesh.key] = mesh.placed(mesh.decoder.decode(frame.data))
        except StreamError as error:
            self.fault = str(error)
            return False
        self.capture_ns[mesh.key] = frame.header.capture_ns
        return True


def keys(parts: Sequence[Deformable]) -> list[str]:
    """What tells deformables apart: the name of each, where it has one that no other has; else its stream."""
    names = [part.name for part in parts]
    found: list[str] = []
    for part in parts:
        key = part.name if part.name and names.count(part.name) == 1 else part.stream
        while key in found or (key != part.name and key in names):  # somebody is called like a stream
            key += "'"
        found.append(key)
    return found
