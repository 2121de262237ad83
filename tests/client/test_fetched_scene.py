"""The scene as arrays: complete, within a budget, replaced meanwhile, or missing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import pytest

from iris_session.client import AssetError, Client, ClientError, NotConnectedError, fetched_scene
from iris_session.client.assets import AssetFetch
from iris_session.client.fetched_scene import fetch_scene
from iris_session.protocol.names import AssetRefusal
from iris_session.protocol.scene import MAX_SCENE_BYTES, encode_scene
from iris_session.scene import AssetStore
from iris_session.scene.budget import Budget
from iris_session.scene.mujoco_scene import parse_mujoco
from tests.client.session import ClientSession, refuse_asset

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
def join(session: ClientSession, tmp_path: Path, store: AssetStore) -> Callable[..., Client]:
    """Return a function that joins the session after it has loaded a scene."""
    session.store = store

    def make(scene_hash: str, *addresses: str) -> Client:
        session.change_scene(scene_hash, addresses, "new_scene")
        client = session.make_client(role="observer")
        client.assets.cache = AssetStore(tmp_path / "cache")
        client.connect()
        assert client.wait_for(lambda c: c.mirror.synced and c.mirror.scene_hash == scene_hash)
        return client

    return make


def test_scene_is_complete_or_within_a_budget(store: AssetStore, join: Callable[..., Client]) -> None:
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


def test_unavailable_scenes_raise_with_reason(
    store: AssetStore, join: Callable[..., Client], monkeypatch: pytest.MonkeyPatch
) -> None:
    def copied(*_: object) -> bytes:
        raise AssertionError("a session could fill the memory with it before it is refused")

    monkeypatch.setattr(fetched_scene, "REFUSED_S", 0.2)
    monkeypatch.setattr(AssetStore, "get", copied)
    monkeypatch.setattr(AssetFetch, "read", copied)
    with pytest.raises(NotConnectedError):
        fetch_scene(join("model"))
    parsed = parse_mujoco(mujoco.MjModel.from_xml_string(SCENE), store)
    with pytest.raises(AssetError):
        fetch_scene(join("0" * 64, *parsed.addresses))
    for data in (b"no scene", bytes(MAX_SCENE_BYTES + 1)):
        address = store.put(data)
        with pytest.raises(ClientError):
            fetch_scene(join(address, address))
    lonely = store.put(encode_scene(parsed.spec))
    part = fetch_scene(join(lonely, lonely))
    assert part.meshes == part.textures == {}
    assert len(part.failed) == 2, "the session does not offer them"


def test_refused_scene_is_retried_and_permanent_refusal_raises(
    store: AssetStore, join: Callable[..., Client], session: ClientSession
) -> None:
    parsed = parse_mujoco(mujoco.MjModel.from_xml_string(SCENE), store)
    client = join(parsed.scene_hash)
    serves_ns = session.simulation.now_ns + 500_000_000
    session.simulation.call_at(serves_ns, lambda: session.change_scene(parsed.scene_hash, parsed.addresses, ""))
    assert fetch_scene(client).spec == parsed.spec
    assert len(session.sockets_of(client).assets.requests) > 2
    session.change_scene("0" * 64, parsed.addresses)
    assert client.wait_for(lambda c: c.mirror.scene_hash == "0" * 64)
    began_ns = session.simulation.now_ns
    with pytest.raises(AssetError) as raised:
        fetch_scene(client)
    assert (raised.value.address, raised.value.reason) == ("0" * 64, AssetRefusal.UNKNOWN)
    assert session.simulation.now_ns - began_ns >= fetched_scene.REFUSED_S * 0.5e9


def test_late_assets_are_not_fetched_after_the_timeout(session: ClientSession, join: Callable[..., Client]) -> None:
    client = join("1" * 64)
    channel = session.sockets_of(client).assets
    channel.answers = lambda request: [refuse_asset(request, AssetRefusal.NOT_ALLOWED)]
    with pytest.raises(NotConnectedError, match=AssetRefusal.NOT_ALLOWED):
        fetch_scene(client, timeout_s=2.0)
    assert len(channel.requests) > 2
    assert not client.assets.is_loading
