"""Scene of a session, fetched and decoded for drawing: specification, meshes and textures.

scene = fetch_scene(client)
for visual in scene.spec.visuals:
    if visual.geometry.mesh in scene.meshes:
        print(visual.name, scene.meshes[visual.geometry.mesh].position.shape)
"""

from __future__ import annotations

import reprlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

from iris_session.client.assets import AssetFetch
from iris_session.client.client import Client
from iris_session.client.errors import AssetError, ClientError, NotConnectedError
from iris_session.protocol.assets import is_address
from iris_session.protocol.names import AssetRefusal
from iris_session.protocol.scene import SceneError, SceneSpec, decode_scene
from iris_session.scene import MeshArrays, decode_image, decode_mesh
from iris_session.scene.budget import Budget, choose_levels
from iris_session.scene.images import Pixels

#: No limits: the finest levels of everything.
EVERYTHING: Final = Budget()
#: Default timeout of a fetch [s], sized for slow networks.
DEFAULT_TIMEOUT_S: Final = 60.0
#: Time for which a session may refuse the specification that it names itself as unknown, and the pause before the next
#: request [s].
REFUSED_S: Final = 2.0
RETRY_S: Final = 0.1
#: Time for which a complete scene that was patched meanwhile is updated before it is returned as it is [s]: a scene may
#: be patched faster than its specification travels over the network.
CATCH_UP_S: Final = 1.0


@dataclass(frozen=True)
class FetchedScene:
    """Scene with decoded assets, as `fetch_scene` returns it.

    Attributes:
        scene_hash: Content hash of the specification.
        spec: Specification of the scene.
        meshes: Meshes by their index in `spec.meshes`; vertices are in the frame of the visual [m].
        textures: Pixels (height, width, channels) uint8, top row first, by their index in `spec.textures`.
        hidden: Ids of visuals that exceed the budget and must not be drawn.
        failed: Errors of the assets that could not be fetched or decoded, by address.
    """

    scene_hash: str
    spec: SceneSpec
    meshes: Mapping[int, MeshArrays]
    textures: Mapping[int, Pixels]
    hidden: frozenset[int]
    failed: Mapping[str, AssetError]


def fetch_scene(
    client: Client,
    budget: Budget = EVERYTHING,
    timeout_s: float = DEFAULT_TIMEOUT_S,
    on_progress: Callable[[AssetFetch], None] | None = None,
) -> FetchedScene:
    """Fetch the present scene and wait until it is complete. Assets in the local cache are not transferred again.

    When the session loads another scene meanwhile, the fetch continues with that one and transfers only new assets. A
    scene that is patched continually is returned in the state after one of its patches. So compare `scene_hash` with
    `client.mirror.scene_hash` after the call and on every `scene_changed`, and call again when they differ.

    Args:
        client: A connected client.
        budget: Limits that select levels of detail; by default the finest levels.
        timeout_s: Seconds to wait at most.
        on_progress: Called with the fetch as bytes arrive.

    Returns:
        The scene; assets that could not be had are listed in `failed`.

    Raises:
        NotConnectedError: It took longer than `timeout_s`, or the session shares no specification.
        AssetError: The session refused its own specification as unknown for `REFUSED_S`.
        ClientError: This package cannot read the specification.
        TypeError: `budget` is no `Budget`.
    """
    if not isinstance(budget, Budget):
        raise TypeError(
            f"budget is {reprlib.repr(budget)}: a Budget is expected, as QUEST_3 of iris_session.scene.budget, or "
            "Budget(triangles=100_000)"
        )
    until = time.monotonic() + timeout_s
    refused, refused_until = "", 0.0
    whole: tuple[int, float] | None = None  # scene epoch of the first complete scene, and the time of its arrival
    made: Mapping[str, MeshArrays | Pixels] = {}
    while True:
        scene_hash, epoch = client.mirror.scene_hash, client.mirror.scene_epoch
        try:
            scene, made = _fetch(client, scene_hash, budget, until, on_progress, made)
        except ClientError as error:
            now = time.monotonic()
            if now >= until:
                raise
            if client.mirror.scene_hash != scene_hash:
                continue
            if not isinstance(error, AssetError) or error.reason != AssetRefusal.UNKNOWN:
                raise
            if refused != scene_hash:  # a session may name it moments before it serves it
                refused, refused_until = scene_hash, now + REFUSED_S
            if now >= refused_until:
                raise
            client.wait_for(lambda c, named=scene_hash: c.mirror.scene_hash != named, min(RETRY_S, until - now))  # type: ignore[misc]
            continue
        now = time.monotonic()
        if whole is None or whole[0] != epoch:
            whole = epoch, now
        patched = client.mirror.scene_epoch == epoch and now - whole[1] > CATCH_UP_S
        if client.mirror.scene_hash == scene_hash or patched:
            return scene


def _fetch(
    client: Client,
    scene_hash: str,
    budget: Budget,
    until: float,
    on_progress: Callable[[AssetFetch], None] | None,
    before: Mapping[str, MeshArrays | Pixels],
) -> tuple[FetchedScene, Mapping[str, MeshArrays | Pixels]]:
    """Return the scene, and its decoded assets by address. `before`: assets decoded earlier."""
    spec = _specification(client, scene_hash, until)
    choice = choose_levels(spec, budget)
    meshes = [mesh.levels[level] for mesh, level in zip(spec.meshes, choice.mesh_levels, strict=True)]
    textures = [texture.levels[level] for texture, level in zip(spec.textures, choice.texture_levels, strict=True)]
    decoders: dict[str, Callable[[memoryview], Any]] = {one.address: decode_mesh for one in meshes}
    decoders |= {one.address: partial(decode_image, encoding=one.encoding) for one in textures}

    def decode(address: str, data: memoryview) -> MeshArrays | Pixels:
        return decoders[address](data)  # type: ignore[no-any-return]

    sizes = {one.address: one.bytes for one in meshes} | {one.address: one.bytes for one in textures}
    missing = {address: size for address, size in sizes.items() if address not in before}
    fetch = _wait(client, client.assets.fetch(missing, on_progress, decode), until)
    made = {address: before[address] for address in sizes if address in before} | fetch.decoded
    scene = FetchedScene(
        scene_hash,
        spec,
        {i: made[one.address] for i, one in enumerate(meshes) if one.address in made},
        {i: made[one.address] for i, one in enumerate(textures) if one.address in made},
        choice.hidden,
        dict(fetch.failed),
    )
    return scene, made


def _specification(client: Client, scene_hash: str, until: float) -> SceneSpec:
    if not is_address(scene_hash):  # hash of a model, of which only bodies and poses are shared
        raise NotConnectedError("this session shares no specification of its scene, only bodies and poses")
    fetch = _wait(client, client.assets.fetch([scene_hash]), until)
    try:
        return decode_scene(fetch.view(scene_hash))
    except SceneError as error:
        raise ClientError(f"the scene cannot be read: {error}") from error


def _wait(client: Client, fetch: AssetFetch, until: float) -> AssetFetch:
    if not client.wait_for(lambda _: fetch.done, max(0.0, until - time.monotonic())):
        client.assets.cancel(fetch)
        megabytes = (fetch.bytes_done * 1e-6, fetch.bytes_total * 1e-6)
        said = f"; the session says {fetch.refusal}" if fetch.refusal else ""
        raise NotConnectedError(
            f"the scene has not come in time: {megabytes[0]:.1f} of {megabytes[1]:.1f} MB are here{said}"
        )
    return fetch
