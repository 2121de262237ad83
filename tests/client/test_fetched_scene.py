"""The scene as arrays from a real front: complete, within a budget, replaced meanwhile, or missing."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import mujoco
import pytest

from iris_session.client import AssetError, Client, ClientError, NotConnectedError, fetched_scene
from iris_session.client.assets import AssetFetch
from iris_session.client.fetched_scene import fetch_scene
from iris_session.protocol.assets import AssetRefused, AssetRequest
from iris_session.protocol.codec import encode_asset_header
from iris_session.protocol.names import AssetRefusal
from iris_session.protocol.scene import MAX_SCENE_BYTES, encode_scene
from iris_session.scene import AssetStore
from iris_session.scene.budget import Budget
from iris_session.scene.mujoco_scene import parse_mujoco
from tests.client.harness import LiveSession
from tests.client.test_assets import HostileSession

pytestmark = pytest.mark.e2e

DEADLINE_S = 60.0

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
def sessions() -> list[LiveSession]:
    """Sessions started by the test."""
    return []


@pytest.fixture
def join(tmp_path: Path, store: AssetStore, sessions: list[LiveSession]) -> Iterator[Callable[..., Client]]:
    opened: list[LiveSession | Client] = []

    def make(scene_hash: str, *addresses: str) -> Client:
        live = LiveSession(asset_root=str(store.root), assets=addresses, scene_hash=scene_hash)
        opened.append(live)
        sessions.append(live)
        client = Client(live.address, name="ann", role="observer", alignment="not_needed")
        client.assets.cache = AssetStore(tmp_path / "cache")
        opened.append(client)
        return client.connect(30.0)

    yield make
    for one in reversed(opened):
        one.close()


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
    with pytest.raises(NotConnectedError, match="shares no specification"):
        fetch_scene(join("model"))
    parsed = parse_mujoco(mujoco.MjModel.from_xml_string(SCENE), store)
    with pytest.raises(AssetError):
        fetch_scene(join("0" * 64, *parsed.addresses))
    for data, reason in ((b"no scene", "the scene cannot be read"), (bytes(MAX_SCENE_BYTES + 1), "at most")):
        address = store.put(data)
        with pytest.raises(ClientError, match=reason):
            fetch_scene(join(address, address))
    lonely = store.put(encode_scene(parsed.spec))
    part = fetch_scene(join(lonely, lonely))
    assert part.meshes == part.textures == {}
    assert len(part.failed) == 2, "the session does not offer them"


def test_refused_scene_is_retried_and_permanent_refusal_raises(
    store: AssetStore, join: Callable[..., Client], sessions: list[LiveSession], monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed = parse_mujoco(mujoco.MjModel.from_xml_string(SCENE), store)
    client = join(parsed.scene_hash)
    (live,) = sessions
    monkeypatch.setattr(fetched_scene, "REFUSED_S", DEADLINE_S)
    with ThreadPoolExecutor(1) as other:
        fetching = other.submit(fetch_scene, client, timeout_s=DEADLINE_S)
        while live.front.link.status.drops.get(f"assets_{AssetRefusal.UNKNOWN}", 0) < 2 and not fetching.done():
            time.sleep(0.01)
        live.change_scene(parsed.scene_hash, parsed.addresses, "")
        assert fetching.result().spec == parsed.spec

    monkeypatch.setattr(fetched_scene, "REFUSED_S", 0.2)
    live.change_scene("0" * 64, parsed.addresses)
    assert client.wait_for(lambda c: c.mirror.scene_hash == "0" * 64, DEADLINE_S)
    with pytest.raises(AssetError) as raised:
        fetch_scene(client)
    assert (raised.value.address, raised.value.reason) == ("0" * 64, AssetRefusal.UNKNOWN)


def test_replaced_scene_is_abandoned_for_the_newest(
    store: AssetStore,
    join: Callable[..., Client],
    sessions: list[LiveSession],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    parsed = parse_mujoco(mujoco.MjModel.from_xml_string(SCENE), store)
    plain = msgspec.structs.replace(parsed.spec, visuals=parsed.spec.visuals[:2])
    newest, refused = store.put(encode_scene(plain)), "1" * 64
    client = join(parsed.scene_hash, *parsed.addresses)
    fetches: list[AssetFetch] = []
    wait = fetched_scene._wait

    def replace_meanwhile(client: Client, fetch: AssetFetch, until: float) -> AssetFetch:
        fetches.append(fetch)
        if fetch.addresses == (refused,):
            sessions[0].change_scene(newest, (newest, *parsed.addresses))
            assert client.wait_for(lambda c: c.mirror.scene_hash == newest, DEADLINE_S)
        result = wait(client, fetch, until)
        if len(fetches) == 2:  # the meshes are stored
            sessions[0].change_scene(refused, parsed.addresses)
            assert client.wait_for(lambda c: c.mirror.scene_hash == refused, DEADLINE_S)
        return result

    monkeypatch.setattr(fetched_scene, "_wait", replace_meanwhile)
    scene = fetch_scene(client, timeout_s=DEADLINE_S)
    assert (scene.spec, scene.scene_hash) == (plain, newest)
    assert (scene.meshes.keys(), scene.textures.keys()) == ({0}, {0})
    asked = [fetch.addresses for fetch in fetches]
    assert asked == [(parsed.scene_hash,), asked[1], (refused,), (newest,), ()]
    assert len(asked[1]) == 2, "a mesh and a texture, which are not fetched and decoded again"


@pytest.mark.parametrize("cause", ["patch", "new_scene"])
def test_endlessly_patched_scene_arrives_and_endlessly_replaced_one_does_not(
    store: AssetStore,
    join: Callable[..., Client],
    sessions: list[LiveSession],
    monkeypatch: pytest.MonkeyPatch,
    cause: str,
) -> None:
    parsed = parse_mujoco(mujoco.MjModel.from_xml_string(SCENE), store)
    client = join(parsed.scene_hash, *parsed.addresses)
    variants = [store.put(encode_scene(msgspec.structs.replace(parsed.spec, name=str(n)))) for n in range(20)]
    shown = [parsed.scene_hash]
    wait = fetched_scene._wait

    def replace_meanwhile(client: Client, fetch: AssetFetch, until: float) -> AssetFetch:
        result = wait(client, fetch, until)
        if fetch.addresses == (shown[-1],) and len(shown) < len(variants):
            shown.append(variants[len(shown)])
            sessions[0].change_scene(shown[-1], (shown[-1], *parsed.addresses), cause)
            assert client.wait_for(lambda c: c.mirror.synced and c.mirror.scene_hash == shown[-1], DEADLINE_S)
        return result

    monkeypatch.setattr(fetched_scene, "_wait", replace_meanwhile)
    monkeypatch.setattr(fetched_scene, "CATCH_UP_S", 0.0)
    scene = fetch_scene(client, timeout_s=DEADLINE_S)
    assert scene.meshes.keys() == {0}
    if cause == "patch":
        assert len(shown) == 3, "what is here is returned after a while"
        assert scene.scene_hash == shown[1]
    else:
        assert scene.scene_hash == shown[-1] == variants[-1], "of another scene nothing is of use"


def test_late_assets_are_not_fetched_after_the_timeout(join: Callable[..., Client]) -> None:
    client = join("1" * 64)
    fetch = client.assets.fetch(["2" * 64])
    with pytest.raises(NotConnectedError, match="in time"):
        fetched_scene._wait(client, fetch, time.monotonic() - 1.0)
    assert fetch.failed["2" * 64].reason == "cancelled"


def test_permanently_busy_session_is_named_as_the_reason(join: Callable[..., Client]) -> None:
    def refuse_busy(request: AssetRequest) -> list[list[bytes]]:
        refused = AssetRefused(1, request.request_id, request.address, AssetRefusal.NOT_ALLOWED, "join first")
        return [[encode_asset_header(refused)]]

    client, session = join("1" * 64), HostileSession(refuse_busy)
    try:
        welcome = client.connection.welcome
        assert welcome is not None
        endpoints = msgspec.structs.replace(welcome.endpoints, assets=session.port)
        client.connection.welcome = msgspec.structs.replace(welcome, endpoints=endpoints)
        with pytest.raises(NotConnectedError, match="not_allowed"):
            fetch_scene(client, timeout_s=2.0)
    finally:
        session.close()
