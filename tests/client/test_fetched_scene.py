"""The scene as arrays, from a real front: whole, within a budget, replaced meanwhile, or not there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import mujoco
import pytest

from iris_session.client import AssetCache, AssetError, Client, ClientError, NotConnectedError
from iris_session.client.asset_fetch import AssetFetch
from iris_session.client.fetched_scene import fetch_scene
from iris_session.protocol.scene import MAX_SCENE_BYTES, encode_scene
from iris_session.scene import AssetStore
from iris_session.scene.budget import Budget
from iris_session.scene.mujoco_scene import parse_mujoco
from tests.client.harness import LiveSession

pytestmark = pytest.mark.e2e

SCENE = """
<mujoco>
  <asset>
    <mesh name="ball" builtin="sphere" params="4"/>
    <texture name="squares" type="2d" builtin="checker" rgb1="1 0 0" rgb2="0 0 1" width="64" height="32"/>
    <material name="paint" texture="squares"/>
  </asset>
  <worldbody>
    <geom type="plane" size="2 2 0.1" material="paint"/>
    <geom type="mesh" mesh="ball" pos="0 0 1"/>
    <geom type="box" size="0.1 0.1 0.1"/>
  </worldbody>
</mujoco>"""


@pytest.fixture
def store(tmp_path: Path) -> AssetStore:
    return AssetStore(tmp_path / "store")


@pytest.fixture
def join(tmp_path: Path, store: AssetStore) -> Iterator[Callable[..., Client]]:
    opened: list[LiveSession | Client] = []

    def make(scene_hash: str, *addresses: str) -> Client:
        live = LiveSession(asset_root=str(store.root), assets=addresses, scene_hash=scene_hash)
        opened.append(live)
        client = Client(live.address, name="ann", role="observer", alignment="not_needed")
        client.asset_cache = AssetCache(tmp_path / "cache")
        opened.append(client)
        return client.connect(30.0)

    yield make
    for one in reversed(opened):
        one.close()


def test_everything_or_what_a_budget_allows(store: AssetStore, join: Callable[..., Client]) -> None:
    parsed = parse_mujoco(mujoco.MjModel.from_xml_string(SCENE), store)
    client = join(parsed.scene_hash, *parsed.addresses)
    whole = fetch_scene(client)
    assert whole.spec == parsed.spec
    assert whole.meshes[0].triangles == parsed.spec.meshes[0].levels[0].triangles
    assert whole.textures[0].shape == (32, 64, 3)
    assert (whole.hidden, dict(whole.failed)) == (frozenset(), {})
    coarse = fetch_scene(client, Budget(triangles=1000, objects=2))
    assert coarse.meshes[0].triangles < whole.meshes[0].triangles
    assert len(coarse.hidden) == 1


def test_what_cannot_be_had_is_said(
    store: AssetStore, join: Callable[..., Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    def copied(*_: object) -> bytes:
        raise AssertionError("a session could fill the memory with it before it is refused")

    monkeypatch.setattr(AssetCache, "read", copied)
    monkeypatch.setattr(AssetFetch, "read", copied)
    with pytest.raises(NotConnectedError, match="shares no specification"):
        fetch_scene(join("model"))
    parsed = parse_mujoco(mujoco.MjModel.from_xml_string(SCENE), store)
    with pytest.raises(AssetError):
        fetch_scene(join("0" * 64, *parsed.addresses))
    for data, says in ((b"no scene", "the scene cannot be read"), (bytes(MAX_SCENE_BYTES + 1), "at most")):
        address = store.put(data)
        with pytest.raises(ClientError, match=says):
            fetch_scene(join(address, address))
    lonely = store.put(encode_scene(parsed.spec))
    part = fetch_scene(join(lonely, lonely))
    assert part.meshes == part.textures == {}
    assert len(part.failed) == 2, "the session does not offer them"
