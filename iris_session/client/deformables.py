"""Deformables of the scene: newest vertices of every cloth, rope and soft body, with their triangles and looks.

shapes = Deformables(client)
while True:
    client.poll(0.01)
    for name in shapes.update():
        corners = shapes.vertices[name][shapes.meshes[name].faces]  # p_world (m, 3, 3) [m]; of a rope: edges (k, 2, 3)
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.client.assets import AssetFetch
from iris_session.client.client import Client
from iris_session.client.errors import ClientError
from iris_session.client.media import MediaFeed
from iris_session.protocol.assets import is_address
from iris_session.protocol.names import ArrayKind, ArrayName, MediaEncoding
from iris_session.protocol.scene import Deformable, decode_scene
from iris_session.scene.arrays import decode_arrays, require_array
from iris_session.scene.errors import AssetDecodeError
from iris_session.streams.deformable import DeformableDecoder
from iris_session.streams.deformable_topology import MAX_FACES, MAX_VERTICES, DeformableTopology
from iris_session.streams.errors import StreamError

#: First and longest pause before the assets of a scene are requested again after a failure [s]; each pause is twice the
#: one before.
FIRST_PAUSE_S: Final = 0.02
LONGEST_PAUSE_S: Final = 2.5
#: Largest asset of a deformable in memory [bytes], about twice that of the largest mesh. It is decoded in the thread
#: that polls the client.
MAX_ASSET_BYTES: Final = 128 << 20


#: `Deformable.dim` of deformables that are drawn as lines.
ROPE: Final = 1


@dataclass(frozen=True)
class DeformableMesh:
    """Mesh of one deformable, whose vertices are `Deformables.vertices[name]`. Arrays are read-only.

    Attributes:
        faces: Triangles (m, 3), rows of the vertices, counter-clockwise from outside where it has an outside; empty
            for a rope.
        edges: Lines (k, 2) of a rope, rows of the vertices, drawn as cylinders; empty otherwise.
        uv: Texture coordinates (m, 3, 2) of the corners of every triangle, or `None`; u to the right, v down from the
            upper left of the image.
        rows: Rows (n,) of the vertices that are drawn. The other vertices of a soft body are inside of it: they are not
            transferred and are NaN, so that row numbers equal vertex numbers in the model. `faces` and `edges` never
            refer to them.
        look: Its entry in the specification: `dim` (1 rope, 2 cloth, 3 soft body), `group`, `rgba`, `material` (index
            in `FetchedScene.spec.materials`, -1: none), `radius` (half the thickness [m]), `flat` (one normal per
            triangle).
    """

    faces: NDArray[np.int32]
    edges: NDArray[np.int32]
    uv: NDArray[np.float32] | None
    rows: NDArray[np.int32]
    look: Deformable

    def with_look(self, look: Deformable) -> DeformableMesh:
        """Return the same mesh with another look."""
        return self if look == self.look else replace(self, look=look)


def read_mesh(spec: Deformable, arrays: Mapping[str, NDArray[Any]], n_vertices: int) -> DeformableMesh:
    """Return the mesh of a deformable.

    Args:
        spec: Its entry in the specification.
        arrays: Arrays of its asset.
        n_vertices: Number of vertices in its stream.

    Raises:
        AssetDecodeError: An array is missing, or has another type or shape.
        ValueError: Numbers of vertices or elements are out of range.
    """
    corners = 2 if spec.dim == ROPE else 3
    rows = np.arange(n_vertices, dtype=np.int32)
    if ArrayName.VERTEX in arrays:
        numbers = require_array(arrays, ArrayName.VERTEX, "u2 u4", (n_vertices,))
        if int(numbers.max(initial=0)) >= MAX_VERTICES:
            raise ValueError(f"deformable {spec.name!r} numbers its vertices beyond {MAX_VERTICES}")
        rows = numbers.astype(np.int32)
    places = require_array(arrays, ArrayName.ELEMENTS, "u2 u4", (None, corners))
    if len(places) > MAX_FACES or int(places.max(initial=0)) >= n_vertices:
        raise ValueError(
            f"deformable {spec.name!r} has {len(places)} elements up to vertex {int(places.max(initial=0))}: "
            f"at most {MAX_FACES}, of {n_vertices} vertices"
        )
    elements, none = rows[places], np.empty((0, 5 - corners), np.int32)
    uv = None
    if ArrayName.UV in arrays:
        # A copy, so that the asset can be freed.
        uv = require_array(arrays, ArrayName.UV, "f4", (len(places), corners, 2)).astype(np.float32)
    faces, edges = (none, elements) if corners == 2 else (elements, none)
    for array in (faces, edges, rows, uv):
        if array is not None:
            array.setflags(write=False)
    return DeformableMesh(faces, edges, uv, rows, spec)


class _Mesh:
    """One deformable: its stream, and the numbers of its vertices in the model."""

    feed: MediaFeed

    def __init__(self, key: str, spec: Deformable, asset: memoryview) -> None:
        arrays = decode_arrays(asset, ArrayKind.DEFORMABLE, MAX_ASSET_BYTES)
        topology = DeformableTopology.from_bytes(arrays["plan"].tobytes())
        self.key, self.stream, self.address = key, spec.stream, spec.address
        self.decoder = DeformableDecoder(topology)
        self.shape = read_mesh(spec, arrays, topology.n_vertices)
        self.numbered = ArrayName.VERTEX in arrays
        self.seq = -1
        self.fault = ""

    def place_vertices(self, p_world: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return vertices by their number in the model; those inside of a solid are NaN."""
        if not self.numbered:
            return p_world
        everywhere = np.full((int(self.shape.rows.max()) + 1, 3), np.nan, np.float32)
        everywhere[self.shape.rows] = p_world
        return everywhere


class Deformables:
    """Vertices and meshes of the deformables of a session, kept up to date by `update`, which never waits.

    After a patch of the scene they continue unchanged until the new specification has arrived; deformables that are
    equal in both continue after it.

    Args:
        client: A client.

    Attributes:
        vertices: Positions (n, 3) [m] in the world frame, by name of the deformable, numbered as in the model. Vertices
            inside of a soft body are not transferred: their rows are NaN, `meshes[name].rows` lists the others. A
            deformable without a unique name has the name of its stream as key.
        capture_ns: Session time of `vertices` [ns], by the same names. Deformables at rest are sent once a second, so
            their time may be that old.
        scene_hash: Content hash of the scene that they belong to.
    """

    def __init__(self, client: Client) -> None:
        self._client = client
        self.scene_hash = ""
        self.vertices: dict[str, NDArray[np.float32]] = {}
        self.capture_ns: dict[str, int] = {}
        self._meshes: list[_Mesh] = []
        self._epoch = ("", -1)  # session and scene epoch: every session counts from 1
        self._parked = False  # the meshes belong to an earlier scene: their vertices are not shown
        self._asked = ""  # the scene whose specification was requested, arrived or not
        self._parts: tuple[Deformable, ...] | None = None  # deformables of that scene
        self._fetch: AssetFetch | None = None
        self._fault = ""
        self._pause_s = self._retry_s = 0.0

    @property
    def meshes(self) -> Mapping[str, DeformableMesh]:
        """Triangles, lines and looks by name; empty while another scene is being fetched."""
        return {} if self._parked else {mesh.key: mesh.shape for mesh in self._meshes}

    @property
    def fault(self) -> str:
        """Reason why a deformable cannot be shown; empty without a fault."""
        return self._fault or next((mesh.fault for mesh in self._meshes if mesh.fault), "")

    def update(self) -> list[str]:
        """Follow the scene and take the newest frames, without waiting.

        Returns:
            Names of the deformables that have moved since the last call.
        """
        now = self._client.scene.version  # the thread of `start` may be about to hear of another
        if now is None:  # it has heard of one, and not yet of which
            return []
        if self._client.ready:
            session, scene_hash, epoch = now
            self._follow(scene_hash, (session, epoch))
        if self._fetch is not None and self._fetch.done:
            self._process_fetch(self._fetch)
        return [] if self._parked else [mesh.key for mesh in self._meshes if self._show(mesh)]

    def _follow(self, scene_hash: str, epoch: tuple[str, int]) -> None:
        begun_anew, self._epoch = epoch != self._epoch, epoch
        if scene_hash == self.scene_hash:  # also after a reset, or when a patch was taken back
            if self._asked != scene_hash:
                self._cancel()
                self._asked, self._fault = scene_hash, ""
            self._parked = False
            return
        if begun_anew:  # what waits is of another scene, and so is what was shown
            self._cancel()
            self._parked = True
            self.vertices.clear()
            self.capture_ns.clear()
        if self._fetch is not None:  # it has most of what a later look has: patches may come faster than assets
            return
        if scene_hash != self._asked:
            self._asked, self._pause_s = scene_hash, FIRST_PAUSE_S / 2.0
        elif time.monotonic() < self._retry_s:
            return
        self._begin()

    def _begin(self) -> None:
        if is_address(self._asked):
            self._fetch = self._client.assets.fetch([self._asked])
        else:
            self._show_meshes([], self._asked)
            self._fault = "this session shares no specification of its scene"

    def _cancel(self) -> None:
        if self._fetch is not None:
            self._client.assets.cancel(self._fetch)
        self._fetch = self._parts = None

    def _process_fetch(self, fetch: AssetFetch) -> None:
        """Decode the specification, then fetch the meshes that it names and that are not here."""
        self._fetch = None
        try:
            fetch.check()
            if self._parts is None:
                self._parts = decode_scene(fetch.view(self._asked)).deformables
                if new := [part.address for key, part in self._name_parts() if self._find_mesh(key, part) is None]:
                    self._fetch = self._client.assets.fetch(new)
                    return
            self._show_meshes(self._build_meshes(fetch), self._asked)
        except (ClientError, AssetDecodeError, StreamError, KeyError, ValueError) as error:
            self._failed(error)
        self._parts = None

    def _name_parts(self) -> Iterable[tuple[str, Deformable]]:
        """Return the deformables of the scene that is asked for, by their keys."""
        return zip(deformable_keys(self._parts or ()), self._parts or (), strict=True)

    def _find_mesh(self, key: str, part: Deformable) -> _Mesh | None:
        """Return the mesh that is here of a deformable that may be of another specification."""
        wanted = (key, part.stream, part.address)
        return next((mesh for mesh in self._meshes if (mesh.key, mesh.stream, mesh.address) == wanted), None)

    def _build_meshes(self, fetch: AssetFetch) -> list[_Mesh]:
        """Return the meshes of a scene; those that are here already are kept."""
        found = []
        for key, part in self._name_parts():
            found.append(self._find_mesh(key, part) or _Mesh(key, part, fetch.view(part.address)))
        for mesh, (_, part) in zip(found, self._name_parts(), strict=True):  # nothing of it has failed
            mesh.shape = mesh.shape.with_look(part)
        return found

    def _show_meshes(self, meshes: list[_Mesh], scene_hash: str) -> None:
        """Show these meshes and no others from now on."""
        kept = [mesh for mesh in self._meshes if mesh in meshes]
        gone = [mesh for mesh in self._meshes if mesh not in meshes]
        for stream in {mesh.stream for mesh in gone} - {mesh.stream for mesh in kept}:
            self._client.media.unsubscribe(stream)
        for mesh in gone:
            self.vertices.pop(mesh.key, None)
            self.capture_ns.pop(mesh.key, None)
        for mesh in meshes:
            if mesh not in kept:
                mesh.feed = self._client.media.subscribe(mesh.stream)
        self._meshes, self.scene_hash = meshes, scene_hash
        self._parked, self._fault = False, ""

    def _failed(self, error: Exception) -> None:
        """Keep what is shown, unless it is of another scene."""
        if self._client.mirror.scene_hash != self._asked:  # the newest is asked for at the next call
            return
        if self._parked:
            self._show_meshes([], "")
        self._fault = str(error)
        self._pause_s = min(2.0 * self._pause_s, LONGEST_PAUSE_S)
        self._retry_s = time.monotonic() + self._pause_s

    def _show(self, mesh: _Mesh) -> bool:
        frame = mesh.feed.newest
        if frame is None or frame.header.seq == mesh.seq or frame.header.encoding != MediaEncoding.DEFORMABLE:
            return False
        if frame.header.scene_epoch != self._client.mirror.scene_epoch:  # or the event of its scene is on its way
            return False
        mesh.seq = frame.header.seq
        try:
            self.vertices[mesh.key] = mesh.place_vertices(mesh.decoder.decode(frame.data))
        except StreamError as error:
            mesh.fault = str(error)
            return False
        self.capture_ns[mesh.key] = frame.header.capture_ns
        mesh.fault = ""
        return True


def deformable_keys(parts: Sequence[Deformable]) -> list[str]:
    """Return unique keys of deformables: the name of each if no other has it, else its stream."""
    names = [part.name for part in parts]
    found: list[str] = []
    for part in parts:
        key = part.name if part.name and names.count(part.name) == 1 else part.stream
        while key in found or (key != part.name and key in names):  # a deformable is named like a stream
            key += "'"
        found.append(key)
    return found
