"""Deformables of a client: distinct keys whatever their names, and faults of a session that raise nothing."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import msgspec
import numpy as np
import pytest

from iris_session.client import Client
from iris_session.client.deformables import FIRST_PAUSE_S, MAX_ASSET_BYTES, Deformables, _Mesh, deformable_keys
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


def test_equal_or_empty_names_have_distinct_keys(shared: SharedScene, watch: Callable[..., Watched]) -> None:
    names = ("", "rope", "rope")
    parts = [msgspec.structs.replace(p, name=n) for p, n in zip(shared.spec.deformables, names, strict=True)]
    live = watch(parts)
    live.step_until(lambda: len(live.shapes.vertices) == len(parts))
    assert set(live.shapes.vertices) == {"flex-0", "flex-1", "flex-2"}
    assert [len(live.shapes.vertices[f"flex-{i}"]) for i in range(3)] >= [20, 6, 50]
    assert live.faults == {""}


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
    ],
    ids=["none", "beyond the vertices", "lines of a cloth", "uv of other triangles"],
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


def test_deformables_continue_until_a_late_patch_arrives(live: Watched, shared: SharedScene) -> None:
    names = set(deformable_keys(live.parts))
    live.step_until_moved(names)
    address, assets = shared.store_variant(live.parts, "patched")
    live.session.change_scene(address, assets[1:])
    live.step_until(lambda: bool(live.shapes.fault))
    live.step_until_moved(names)
    assert live.shapes.scene_hash != address
    live.session.change_scene(address, assets, "")
    live.step_until(lambda: not live.shapes.fault)
    assert live.shapes.scene_hash == address
    assert live.shapes.vertices.keys() == names


def test_patches_faster_than_their_assets_interrupt_nothing(live: Watched, shared: SharedScene) -> None:
    names = set(deformable_keys(live.parts))
    live.step_until_moved(names)
    for number in range(5):  # none of them is served
        address = f"{number:064x}"
        live.session.change_scene(address, ())
        live.step_until(lambda address=address: live.client.mirror.scene_hash == address)  # type: ignore[misc]
        assert live.shapes.vertices.keys() == names
    address, assets = shared.store_variant(live.parts, "the last one")
    live.session.change_scene(address, assets)
    live.step_until(lambda: live.shapes.scene_hash == address)
    live.step_until_moved(names)
    assert live.shapes.fault == ""


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


@pytest.mark.parametrize(
    "numbers",
    [np.zeros(3, np.float32), np.zeros(3, np.uint32), np.full(1000, 2**31, np.uint32)],
    ids=["fractions", "another length", "too large"],
)
def test_invalid_vertex_counts_are_a_fault(
    shared: SharedScene, watch: Callable[..., Watched], numbers: np.ndarray
) -> None:
    good = shared.spec.deformables[0]
    arrays = decode_arrays(shared.store.get(good.address), ArrayKind.DEFORMABLE)
    kept = [StoredArray(name, values) for name, values in arrays.items() if name != "vertex"]
    bad = encode_arrays(ArrayKind.DEFORMABLE, [*kept, StoredArray("vertex", numbers[: max(3, good.vertices)])])
    live = watch([good])
    parts = [good, msgspec.structs.replace(good, address=shared.store.put(bad), bytes=len(bad))]
    live.session.change_scene(*shared.store_variant(parts, "bad"))
    live.step_until(lambda: bool(live.shapes.fault))
    assert "vert" in live.shapes.fault
    assert live.client.media._feeds.keys() <= {good.stream}, "nothing else is subscribed to"


def test_small_asset_that_decompresses_large_is_rejected(tmp_path: Path) -> None:
    """A few kilobytes of zeros, which `poll` would unpack for a second and keep."""
    store = AssetStore(tmp_path)
    part = parse_mujoco(flexes(), store).spec.deformables[0]
    arrays = decode_arrays(store.get(part.address), ArrayKind.DEFORMABLE)
    padding = StoredArray("padding", np.zeros(MAX_ASSET_BYTES, np.uint8))
    bomb = encode_arrays(ArrayKind.DEFORMABLE, [*(StoredArray(*item) for item in arrays.items()), padding])
    assert len(bomb) < 100_000
    with pytest.raises(AssetDecodeError, match=str(MAX_ASSET_BYTES)):
        _Mesh("a", part, memoryview(bomb))


def test_new_session_shows_nothing_of_the_previous_one() -> None:
    """A server restarted at the same address: both count their scenes from 1."""
    client = Client("127.0.0.1:1", role="observer", name="screen")
    shapes = Deformables(client)
    shapes._follow("one", ("a", 1))
    shapes.vertices["cloth"], shapes.capture_ns["cloth"] = np.zeros((4, 3), np.float32), 5
    shapes._follow("patched", ("a", 1))
    assert shapes.vertices.keys() == shapes.capture_ns.keys() == {"cloth"}
    shapes._follow("other", ("b", 1))
    assert shapes.vertices == shapes.capture_ns == {}
    client.close()


def test_remaining_deformable_of_a_shared_stream_continues(tmp_path: Path) -> None:
    store = AssetStore(tmp_path)
    part = parse_mujoco(flexes(), store).spec.deformables[0]
    client = Client("127.0.0.1:1", role="observer", name="screen")
    shapes = Deformables(client)
    both = [_Mesh(key, part, memoryview(store.get(part.address))) for key in ("one", "two")]
    shapes._show_meshes(both, "1" * 64)
    feed = client.media.subscribe(part.stream)
    shapes._show_meshes(both[:1], "2" * 64)
    assert client.media._feeds == {part.stream: feed}
    assert both[0].feed is feed
    shapes._show_meshes([], "3" * 64)
    assert client.media._feeds == {}
    client.close()


def test_repeated_scene_is_shown_and_a_failed_one_is_retried_after_a_pause(tmp_path: Path) -> None:
    client = Client("127.0.0.1:1", role="observer", name="screen")
    client.assets.cache = AssetStore(tmp_path)
    shapes, (one, two, three) = Deformables(client), ("1" * 64, "2" * 64, "3" * 64)
    shapes._show_meshes([], one)
    shapes._follow(one, ("a", 1))
    shapes._follow(two, ("a", 2))
    assert shapes._parked
    shapes._follow(one, ("a", 3))
    assert (shapes._parked, shapes._fetch) == (False, None)
    shapes._follow(two, ("a", 3))
    client.mirror.scene_hash = three
    shapes._failed(AssetDecodeError("of a scene that is no more"))
    assert shapes.fault == ""
    client.mirror.scene_hash = two
    for pause_s in (FIRST_PAUSE_S, 2 * FIRST_PAUSE_S):
        before = time.monotonic()
        shapes._failed(AssetDecodeError("unknown"))
        assert shapes._retry_s >= before + pause_s
    assert shapes.fault == "unknown"
    client.close()
