"""A client fetches everything that it needs to draw a served scene: specification, meshes, deformables."""

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
from iris_session.scene import decode_arrays, decode_mesh
from tests.e2e.scenario import Scenario
from tests.e2e.session_process import SessionProcess
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
def scenario(tmp_path: Path, serve: Callable[..., SessionProcess]) -> Iterator[Scenario]:
    (tmp_path / "scene.xml").write_text(SCENE)
    scenario = Scenario(serve(str(tmp_path / "scene.xml")))
    yield scenario
    scenario.close()


def fetch_all(scenario: Scenario, client: Client, cache: Path) -> SceneSpec:
    """Fetch the current specification, and all its assets into `cache`."""
    client.assets.cache = AssetStore(cache)
    address = client.mirror.scene_hash
    fetch = client.assets.fetch([address])
    scenario.run_until(lambda: fetch.done, "the specification was received")
    spec = decode_scene(fetch.read(address))
    rest = client.assets.fetch(list_assets(spec))
    scenario.run_until(lambda: rest.done, "the assets were received")
    rest.check()
    return spec


def test_client_has_specification_meshes_and_moving_deformables(scenario: Scenario, tmp_path: Path) -> None:
    ann = scenario.join("ann", role="observer")
    spec = fetch_all(scenario, ann, tmp_path / "cache")
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

    def has_fallen() -> bool:
        shapes.update()
        assert shapes.fault == ""
        return "cloth" in shapes.vertices and shapes.vertices["cloth"][:, 2].min() < 1.2

    scenario.run_until(has_fallen, "the cloth hangs over the ball")
    assert arrays["position"][:, 2] == pytest.approx(1.5)
    edges = arrays["elements"][:, :2]
    now = shapes.vertices["cloth"]
    lengths = np.linalg.norm(now[edges[:, 0]] - now[edges[:, 1]], axis=1)
    assert lengths.max() < 0.2, "edges keep their lengths"
    assert scenario.server.finish()["ok"]
    rows = column(read(scenario.server.recording)["/scene/1/world/cloth"], "Mesh3D:vertex_positions")
    lowest = [min(z for _, _, z in row) for row in rows if row is not None]
    assert max(lowest) == pytest.approx(1.5)
    assert min(lowest) < 1.2, "the recording shows the same"
