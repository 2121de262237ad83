"""What bends, as a client sees it: told apart whatever it is called, and nothing that a session says is an error."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from iris_session.client import AssetCache, Client
from iris_session.client.deformables import MAX_ASSET_BYTES, Deformables, _Mesh, keys
from iris_session.protocol.names import MediaEncoding
from iris_session.protocol.scene import Deformable, SceneSpec, asset_addresses, encode_scene
from iris_session.protocol.scene_names import ArrayKind
from iris_session.scene import AssetError, AssetStore
from iris_session.scene.arrays import Stored, decode_arrays, encode_arrays
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.streams.deformable import DeformableEncoder
from iris_session.streams.deformable_topology import DeformableTopology
from tests.client.harness import LiveSession
from tests.scene.models import flexes

DEADLINE_S = 60.0


class Shared:
    """A scene of three deformables, as changed by `change`, and a session that shares it."""

    def __init__(self, folder: Path) -> None:
        self.store = AssetStore(folder)
        self.spec = parse_mujoco(flexes(), self.store).spec

    def begin(self, parts: list[Deformable]) -> LiveSession:
        spec: SceneSpec = msgspec.structs.replace(self.spec, deformables=tuple(parts))
        address = self.store.put(encode_scene(spec))
        return LiveSession(
            asset_root=str(self.store.root), assets=(address, *asset_addresses(spec)), scene_hash=address
        )


@pytest.fixture
def shared(tmp_path: Path) -> Shared:
    return Shared(tmp_path / "store")


@pytest.fixture
def joined(tmp_path: Path) -> Iterator[list[Client]]:
    clients: list[Client] = []
    yield clients
    for client in clients:
        client.close()


def watch(live: LiveSession, joined: list[Client], cache: Path) -> tuple[Client, Deformables]:
    client = Client(live.address, role="observer", alignment="not_needed")
    client.asset_cache = AssetCache(cache)
    joined.append(client)
    return client.connect(DEADLINE_S), Deformables(client)


def test_deformables_of_one_name_or_none_are_told_apart(shared: Shared, joined: list[Client], tmp_path: Path) -> None:
    names = ("", "rope", "rope")
    parts = [msgspec.structs.replace(p, name=n) for p, n in zip(shared.spec.deformables, names, strict=True)]
    live = shared.begin(parts)
    try:
        client, shapes = watch(live, joined, tmp_path / "cache")
        rests = {}
        for part in parts:
            arrays = decode_arrays(shared.store.get(part.address), ArrayKind.DEFORMABLE)
            encoder = DeformableEncoder(DeformableTopology.from_bytes(arrays["plan"].tobytes()), 0.0005)
            rests[part.stream] = encoder, arrays["position"].astype(np.float64)

        def told(_: Client) -> bool:
            for stream, (encoder, rest) in rests.items():
                encoder.reset()
                frames = encoder.encode(rest)
                assert frames is not None
                live.front.publish_media(stream, frames, live.now_ns, 1, MediaEncoding.DEFORMABLE)
            shapes.tend()
            assert not shapes.fault
            return len(shapes.vertices) == len(parts)

        assert client.wait_for(told, DEADLINE_S), shapes.vertices.keys()
        assert set(shapes.vertices) == {"flex-0", "flex-1", "flex-2"}
        assert [len(shapes.vertices[f"flex-{i}"]) for i in range(3)] >= [20, 6, 50]
    finally:
        live.close()


def test_names_that_are_names_stay() -> None:
    def part(name: str, stream: str) -> Deformable:
        return Deformable(name, 2, 0, 1, 1, 0.0, False, -1, (1.0, 1.0, 1.0, 1.0), stream, "0" * 64, 1)

    assert keys([part("cloth", "flex-0"), part("rope", "flex-1")]) == ["cloth", "rope"]
    assert keys([part("", "a"), part("", "b"), part("x", "c"), part("x", "d")]) == ["a", "b", "c", "d"]
    assert keys([part("", "x"), part("x", "y")]) == ["x'", "x"], "somebody is called like the stream of another"
    assert keys([part("", "x"), part("", "x")]) == ["x", "x'"]


@pytest.mark.parametrize(
    "numbers",
    [np.zeros(3, np.float32), np.zeros(3, np.uint32), np.full(1000, 2**31, np.uint32)],
    ids=["fractions", "another length", "too large"],
)
def test_numbers_of_vertices_that_cannot_be_are_a_fault(
    shared: Shared, joined: list[Client], tmp_path: Path, numbers: np.ndarray
) -> None:
    good = shared.spec.deformables[0]
    arrays = decode_arrays(shared.store.get(good.address), ArrayKind.DEFORMABLE)
    kept = [Stored(name, values) for name, values in arrays.items() if name != "vertex"]
    bad = encode_arrays(ArrayKind.DEFORMABLE, [*kept, Stored("vertex", numbers[: max(3, good.vertices)])])
    live = shared.begin([good, msgspec.structs.replace(good, address=shared.store.put(bad), bytes=len(bad))])
    try:
        client, shapes = watch(live, joined, tmp_path / "cache")
        assert client.wait_for(lambda _: (shapes.tend(), bool(shapes.fault))[1], DEADLINE_S)
        assert "vertex" in shapes.fault or "vertices" in shapes.fault
        assert not client._feeds, "nothing of it is subscribed to"
    finally:
        live.close()


def test_a_small_asset_that_becomes_large_is_refused(tmp_path: Path) -> None:
    """A few kilobytes of nothing, which `poll` would unpack for a second and keep."""
    store = AssetStore(tmp_path)
    part = parse_mujoco(flexes(), store).spec.deformables[0]
    arrays = decode_arrays(store.get(part.address), ArrayKind.DEFORMABLE)
    padding = Stored("padding", np.zeros(MAX_ASSET_BYTES, np.uint8))
    bomb = encode_arrays(ArrayKind.DEFORMABLE, [*(Stored(*item) for item in arrays.items()), padding])
    assert len(bomb) < 100_000
    with pytest.raises(AssetError, match=f"at most {MAX_ASSET_BYTES}"):
        _Mesh("a", part, memoryview(bomb))
