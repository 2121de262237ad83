"""Deformables of a client: distinct keys whatever their names, and faults of a session that raise nothing."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest

from iris_session.client.deformables import MAX_ASSET_BYTES, Deformables, _Mesh, deformable_keys
from iris_session.protocol.names import ArrayKind, MediaEncoding
from iris_session.protocol.scene import Deformable, SceneSpec, encode_scene, list_assets
from iris_session.scene import AssetDecodeError, AssetStore
from iris_session.scene.arrays import StoredArray, decode_arrays, encode_arrays
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.streams.deformable import DeformableEncoder
from iris_session.streams.deformable_topology import DeformableTopology
from tests.client.session import ClientSession
from tests.scene.models import flexes


class SharedScene:
    """A scene of three deformables, and variants of it."""

    def __init__(self, folder: Path) -> None:
        self.store = AssetStore(folder)
        self.spec = parse_mujoco(flexes(), self.store).spec

    def start_session(self, parts: Iterable[Deformable]) -> ClientSession:
        address, assets = self.store_variant(parts)
        return ClientSession(store=self.store, assets=assets, scene_hash=address)

    def store_variant(self, parts: Iterable[Deformable], name: str = "scene") -> tuple[str, tuple[str, ...]]:
        """Return the address of a specification with these deformables, and the assets it needs."""
        spec: SceneSpec = msgspec.structs.replace(self.spec, deformables=tuple(parts), name=name)
        address = self.store.put(encode_scene(spec))
        return address, (address, *list_assets(spec))

    def rest_state(self, part: Deformable) -> tuple[DeformableEncoder, np.ndarray]:
        """Return the encoder of one deformable and its vertices at rest."""
        arrays = decode_arrays(self.store.get(part.address), ArrayKind.DEFORMABLE)
        topology = DeformableTopology.from_bytes(arrays["plan"].tobytes())
        return DeformableEncoder(topology, 0.0005), arrays["position"].astype(np.float64)


@pytest.fixture
def shared(tmp_path: Path) -> SharedScene:
    return SharedScene(tmp_path / "store")


class Watched:
    """A session whose deformables rise, and a client that reads them."""

    def __init__(self, shared: SharedScene, session: ClientSession, cache: Path, parts: Sequence[Deformable]) -> None:
        self.session, self.parts = session, list(parts)
        self.client = session.make_client(role="observer")
        self.client.assets.cache = AssetStore(cache)
        self.client.connect()
        self.shapes = Deformables(self.client)
        self.epoch = 1
        self.faults: set[str] = set()
        self.moved: set[str] = set()
        self._rests = {part.stream: shared.rest_state(part) for part in parts}
        self._height = 0.0

    def step(self) -> None:
        """Raise all deformables by a millimetre in the present epoch, and note those that moved in the client."""
        self._height += 0.001
        for stream, (encoder, rest) in self._rests.items():
            encoder.reset()
            frames = encoder.encode(rest + np.array((0.0, 0.0, self._height)))
            assert frames is not None
            self.session.publish_media(stream, frames["full"], epoch=self.epoch, encoding=MediaEncoding.DEFORMABLE)
        self.client.sleep(0.01)
        self.moved.update(self.shapes.update())
        self.faults.add(self.shapes.fault)

    def step_until(self, condition: Callable[[], bool]) -> None:
        for _ in range(500):
            self.step()
            if condition():
                return
        pytest.fail(f"{self.shapes.fault}: {self.moved}")

    def step_until_moved(self, names: set[str]) -> None:
        self.moved.clear()
        self.step_until(lambda: self.moved >= names)


@pytest.fixture
def watch(shared: SharedScene, tmp_path: Path) -> Iterator[Callable[..., Watched]]:
    """Return a function that starts a session with these deformables, and a client."""
    with contextlib.ExitStack() as stack:
        yield lambda parts: Watched(shared, stack.enter_context(shared.start_session(parts)), tmp_path / "cache", parts)


@pytest.fixture
def live(shared: SharedScene, watch: Callable[..., Watched]) -> Watched:
    return watch(shared.spec.deformables)


def test_mesh_data_is_fetched_with_each_deformable(live: Watched) -> None:
    """Triangles and lines name rows of the vertices; no triangle names the inner vertices of a soft body."""
    parts, shapes = live.parts, live.shapes
    live.step_until(lambda: len(shapes.vertices) == len(parts))
    assert {name: mesh.look for name, mesh in shapes.meshes.items()} == {part.name: part for part in parts}
    cloth, rope, soft = (shapes.meshes[name] for name in ("cloth", "rope", "soft"))
    assert (cloth.faces.shape, cloth.edges.shape) == ((24, 3), (0, 2))
    assert (rope.faces.shape, rope.edges.shape) == ((0, 3), (5, 2))
    assert cloth.uv is not None
    assert (cloth.uv.shape, rope.uv, soft.uv) == ((24, 3, 2), None, None)
    points = shapes.vertices["rope"][rope.edges]
    assert np.allclose(np.linalg.norm(points[:, 1] - points[:, 0], axis=1), 0.1, atol=0.002), "its spacing"
    a, b, c = np.moveaxis(shapes.vertices["cloth"][cloth.faces], 1, 0)
    assert np.isclose(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2, 0.4 * 0.3, atol=0.002), "its area"
    # 4 x 4 x 4 vertices, 2 x 2 x 2 of them inside
    drawn = np.flatnonzero(np.isfinite(shapes.vertices["soft"]).all(axis=1))
    assert shapes.vertices["soft"].shape == (64, 3)
    assert len(soft.rows) == 56
    assert drawn.tolist() == soft.rows.tolist() == np.unique(soft.faces).tolist()
    a, b, c = np.moveaxis(shapes.vertices["soft"][soft.faces].astype(np.float64), 1, 0)
    assert np.isclose(np.einsum("ij,ij->i", np.cross(a, b), c).sum() / 6, 0.3**3, atol=0.002), "outside is outside"
    for mesh in shapes.meshes.values():
        assert not mesh.rows.flags.writeable


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("elements", None),
        ("elements", np.array([[0, 1, 20]], np.uint32)),  # it has 20 vertices
        ("elements", np.zeros((4, 2), np.uint32)),
        ("uv", np.zeros((3, 3, 2), np.float32)),
        ("vertex", np.zeros(3, np.uint32)),
        ("vertex", np.full(20, 2**31, np.uint32)),
    ],
    ids=["none", "beyond the vertices", "lines", "uv of other triangles", "other vertices", "large numbers"],
)
def test_invalid_triangles_are_rejected(tmp_path: Path, name: str, values: np.ndarray | None) -> None:
    store = AssetStore(tmp_path)
    part = parse_mujoco(flexes(), store).spec.deformables[0]
    arrays = decode_arrays(store.get(part.address), ArrayKind.DEFORMABLE)
    kept = [StoredArray(key, array) for key, array in arrays.items() if key != name]
    bad = encode_arrays(ArrayKind.DEFORMABLE, kept if values is None else [*kept, StoredArray(name, values)])
    with pytest.raises((AssetDecodeError, ValueError), match=f"{name}|vert"):
        _Mesh("cloth", part, memoryview(bad))


def test_patch_keeps_unchanged_deformables_subscribed(live: Watched, shared: SharedScene) -> None:
    first, second, third = deformable_keys(live.parts)
    live.step_until_moved({first, second, third})
    feeds = {part.stream: live.client.media.subscribe(part.stream) for part in live.parts}
    kept = {mesh.key: mesh for mesh in live.shapes._meshes}
    renamed = msgspec.structs.replace(live.parts[1], name="other")
    recoloured = msgspec.structs.replace(live.parts[0], rgba=(0.5, 0.0, 1.0, 1.0))
    address, assets = shared.store_variant([recoloured, renamed], "patched")
    seen_ns = dict(live.shapes.capture_ns)
    live.session.change_scene(address, assets)
    live.faults.clear()

    def patched() -> bool:
        here = live.shapes.scene_hash == address
        assert live.shapes.vertices.keys() >= {first} if here else {first, second, third}
        return here

    live.step_until(patched)
    assert live.shapes.capture_ns.keys() >= {first}
    assert live.shapes.capture_ns[first] >= seen_ns[first]
    assert not {second, third} & live.shapes.vertices.keys(), "they are removed"
    live.step_until_moved({first, "other"})
    assert [mesh is kept.get(mesh.key) for mesh in live.shapes._meshes] == [True, False]
    assert {name: mesh.look for name, mesh in live.shapes.meshes.items()} == {first: recoloured, "other": renamed}
    assert live.client.media.subscribe(live.parts[0].stream) is feeds[live.parts[0].stream]
    assert live.client.media._feeds.keys() == {part.stream for part in live.parts[:2]}
    assert live.faults == {""}


def test_new_scene_shows_nothing_before_it_is_loaded(live: Watched, shared: SharedScene) -> None:
    """Nor frames of the previous scene, in any order of arrival."""
    first, second, third = deformable_keys(live.parts)
    live.step_until_moved({first, second, third})
    address, assets = shared.store_variant(live.parts[:2], "another")
    live.session.change_scene(address, assets[1:], "new_scene")
    live.step_until(lambda: live.client.mirror.synced and live.client.mirror.scene_epoch == 2)
    live.step_until(lambda: bool(live.shapes.fault))
    assert (live.shapes.vertices, live.shapes.capture_ns, live.shapes.meshes) == ({}, {}, {})
    assert not live.client.media._feeds
    live.session.change_scene(address, assets, "")
    live.step_until(lambda: live.shapes.scene_hash == address)
    feed = live.client.media.subscribe(live.parts[0].stream)
    had = feed.received
    live.step_until(lambda: feed.received > had + 5)
    assert live.shapes.vertices == {}, "all that came was of the epoch before"
    live.epoch = 2
    live.step_until_moved({first, second})
    assert live.shapes.fault == ""


def test_unique_names_are_kept_as_keys() -> None:
    def part(name: str, stream: str) -> Deformable:
        return Deformable(name, 2, 0, 1, 1, 0.0, False, -1, (1.0, 1.0, 1.0, 1.0), stream, "0" * 64, 1)

    assert deformable_keys([part("cloth", "flex-0"), part("rope", "flex-1")]) == ["cloth", "rope"]
    assert deformable_keys([part("", "a"), part("", "b"), part("x", "c"), part("x", "d")]) == ["a", "b", "c", "d"]
    assert deformable_keys([part("", "x"), part("x", "y")]) == ["x'", "x"], (
        "somebody is called like the stream of another"
    )
    assert deformable_keys([part("", "x"), part("", "x")]) == ["x", "x'"]


def test_small_asset_that_decompresses_large_is_rejected(tmp_path: Path) -> None:
    """Half a megabyte of zeros, which `poll` would unpack for a second and keep."""
    store = AssetStore(tmp_path)
    part = parse_mujoco(flexes(), store).spec.deformables[0]
    arrays = decode_arrays(store.get(part.address), ArrayKind.DEFORMABLE)
    padding = StoredArray("padding", np.zeros(MAX_ASSET_BYTES, np.uint8))
    bomb = encode_arrays(ArrayKind.DEFORMABLE, [*(StoredArray(*item) for item in arrays.items()), padding])
    assert len(bomb) < 1_000_000
    with pytest.raises(AssetDecodeError, match=str(MAX_ASSET_BYTES)):
        _Mesh("a", part, memoryview(bomb))
