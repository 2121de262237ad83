"""What a client needs to draw a scene, from a served file to its own arrays: specification, meshes, what bends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from iris_session.assets.store import AssetStore
from iris_session.client import Client
from iris_session.client.deformables import Deformables
from iris_session.client.fetched_scene import fetch_scene
from iris_session.protocol.names import ArrayKind
from iris_session.protocol.scene import SceneSpec, decode_scene, list_assets
from iris_session.recording import Recording
from iris_session.scene import decode_arrays, decode_mesh
from tests.e2e.conftest import Server, Stage
from tests.recording.support import column, read

pytestmark = pytest.mark.e2e

#: A ball of triangles, used twice, and a cloth that falls onto it.
SCENE = """
<mujoco>
  <option timestep="0.005" integrator="discrete" solver="CG"/>
  <asset><mesh name="ball" builtin="sphere" params="3"/></asset>
  <worldbody>
    <geom name="floor" type="plane" size="2 2 0.1"/>
    <body name="still" pos="0 0 0.3"><geom type="mesh" mesh="ball"/></body>
    <body name="free" pos="2 0 1"><freejoint/><geom type="mesh" mesh="ball"/></body>
    <flexcomp name="cloth" type="grid" dim="2" count="9 7 1" spacing="0.1 0.1 0.1" pos="0 0 1.5" radius="0.01"
              mass="0.3"><edge equality="true"/><contact selfcollide="none"/></flexcomp>
  </worldbody>
</mujoco>"""


@pytest.fixture
def stage(tmp_path: Path, serve: Callable[..., Server]) -> Iterator[Stage]:
    (tmp_path / "scene.xml").write_text(SCENE)
    stage = Stage(serve(str(tmp_path / "scene.xml")))
    yield stage
    stage.close()


def fetched(stage: Stage, client: Client, cache: Path) -> SceneSpec:
    """The scene that the session says is the present one, and all its assets in `cache`."""
    client.assets.cache = AssetStore(cache)
    address = client.mirror.scene_hash
    fetch = client.assets.fetch([address])
    stage.run(lambda: fetch.done, "the specification has come")
    spec = decode_scene(fetch.read(address))
    rest = client.assets.fetch(list_assets(spec))
    stage.run(lambda: rest.done, "the assets have come")
    rest.check()
    return spec


def test_a_client_draws_what_the_session_has(stage: Stage, tmp_path: Path) -> None:
    ann = stage.join("ann", role="observer")
    spec = fetched(stage, ann, tmp_path / "cache")
    assert {body.id: body.name for body in spec.bodies if body.id} == {b.id: b.name for b in ann.mirror.bodies}
    balls = [v.geometry.mesh for v in spec.visuals if v.geometry.kind == "mesh"]
    assert balls == [0, 0], "one mesh, drawn twice"
    level = spec.meshes[0].levels[0]
    mesh = decode_mesh(ann.assets.cache.view(level.address))
    assert np.linalg.norm(mesh.position, axis=1) == pytest.approx(1.0, abs=0.05)

    scene = fetch_scene(ann, timeout_s=30.0)
    assert (scene.spec, scene.scene_hash, dict(scene.failed)) == (spec, ann.mirror.scene_hash, {})
    assert np.array_equal(scene.meshes[0].position, mesh.position)

    (cloth,) = spec.deformables
    arrays = decode_arrays(ann.assets.cache.view(cloth.address), ArrayKind.DEFORMABLE)
    shapes = Deformables(ann)

    def falls() -> bool:
        shapes.update()
        assert shapes.fault == ""
        return "cloth" in shapes.vertices and shapes.vertices["cloth"][:, 2].min() < 1.2

    stage.run(falls, "the cloth hangs over the ball")
    assert arrays["position"][:, 2] == pytest.approx(1.5)
    edges = arrays["elements"][:, :2]
    now = shapes.vertices["cloth"]
    lengths = np.linalg.norm(now[edges[:, 0]] - now[edges[:, 1]], axis=1)
    assert lengths.max() < 0.2, "neighbours are still neighbours"
    assert stage.server.finish()["ok"]
    rows = column(read(stage.server.recording)["/scene/1/world/cloth"], "Mesh3D:vertex_positions")
    lowest = [min(z for _, _, z in row) for row in rows if row is not None]
    assert max(lowest) == pytest.approx(1.5)
    assert min(lowest) < 1.2, "the picture of the recording shows it too"


def test_who_comes_again_or_late_needs_nothing_anew(stage: Stage, tmp_path: Path) -> None:
    ann, bob = stage.join("ann", role="observer"), stage.join("bob", role="observer")
    spec = fetched(stage, ann, tmp_path / "cache")
    bob.assets.cache = AssetStore(tmp_path / "cache")
    again = bob.assets.fetch([bob.mirror.scene_hash, *list_assets(spec)])
    stage.run(lambda: again.done, "all of it is there")
    assert (again.bytes_received, again.cached) == (0, len(again.addresses))
    stage.server.children()["front.main"].kill()
    stage.run(lambda: not ann.ready, "the front is gone")
    stage.run(lambda: ann.ready and bob.ready, "another one is there")
    bob.assets.cache = AssetStore(tmp_path / "other")
    late = bob.assets.fetch(list_assets(spec))
    stage.run(lambda: late.done, "the front that replaced it serves the scene too")
    late.check()
    assert late.bytes_received == late.bytes_total
    assert stage.server.finish()["ok"]
    with Recording.open(stage.server.recording) as recording:
        assert recording.header.bodies == ann.mirror.bodies
