"""Assets of a session on disk: held while they are served, then released."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path

import mujoco
import pytest

from iris_session.physics import FoundRobots, World
from iris_session.protocol.scene import AddMesh, Mesh, MeshLevel, SceneError, SetVisual
from iris_session.scene import AssetStore
from iris_session.session import shared_scene
from iris_session.session.config import SessionConfig
from iris_session.session.scene_change import prepare_scene
from iris_session.session.session import Session
from iris_session.session.shared_scene import SharedScenes
from tests.scene.models import flexes
from tests.session.play import make_core


@pytest.fixture
def world() -> World:
    return make_core().world


def held(folder: Path) -> list[Path]:
    return list((folder / "holds").glob("*"))


def test_replaced_specifications_are_released(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shared_scene, "KEPT_PATCHES", 5)
    monkeypatch.setattr(shared_scene, "KEPT_PATCHES_S", 0.0)
    scenes, store = SharedScenes(tmp_path, "test"), AssetStore(tmp_path)
    scenes.show(scenes.make(world))
    assert scenes.newest is not None
    addresses = [scenes.newest.info.scene_hash]
    for i in range(12):
        addresses.append(scenes.show(scenes.patch([SetVisual(0, rgba=(i / 20, 0.0, 0.0, 1.0))])).scene_hash)
    kept = [address in store for address in addresses]
    assert len(set(addresses)) == len(addresses)
    assert kept == [True, *[False] * 7, *[True] * 5], "the scene itself, and the newest looks of it"
    scenes.close()


def test_scene_without_specification_does_not_affect_the_next(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scenes = SharedScenes(tmp_path, "test")

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(AssetStore, "_write", full)
        scenes.show(scenes.make(world))
    with pytest.raises(SceneError, match="No space left"):
        scenes.patch([SetVisual(0, rgba=(0.0, 0.0, 0.0, 1.0))])
    assert "clients get no meshes" in scenes.notes[-1]
    scenes.show(scenes.make(world))
    assert scenes.newest is not None
    assert scenes.newest.spec is not None
    assert scenes.notes == [], "what was so of the scene before"
    scenes.close()
    with pytest.raises(SceneError, match="assets"):
        SharedScenes(False, "test").patch([SetVisual(0)])


def test_patch_with_missing_asset_raises(world: World, tmp_path: Path) -> None:
    """All clients would request it and be refused."""
    scenes = SharedScenes(tmp_path, "test")
    before = scenes.make(world)
    scenes.show(before)
    level = MeshLevel("0" * 64, 10, "arrays", 3, 1)
    with pytest.raises(SceneError, match=level.address):
        scenes.patch([AddMesh(Mesh("arrow", (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), False, (level,)))])
    assert scenes.newest is before


def test_deformables_of_the_next_scene_are_prepared_with_it() -> None:
    """Topologies take long: the loop that swaps scenes only hands them over."""
    model = flexes()
    model.opt.timestep = 0.002
    scene = prepare_scene(make_core(), SharedScenes(False, "test"), model, b"", FoundRobots(()), None)
    assert [mesh.stream for mesh in scene.deformables] == ["flex-0", "flex-1", "flex-2"]
    assert all(len(mesh.vertices()) == mesh.topology.n_vertices for mesh in scene.deformables)


@pytest.mark.usefixtures("simulation")
def test_sites_and_tendons_are_shared_on_request_or_noted(tmp_path: Path) -> None:
    xml = """<mujoco><worldbody><body name="arm"><joint/><geom size=".1"/><site name="end" pos="0 0 .2"/></body>
    <site name="hook" pos="0 0 1"/></worldbody>
    <tendon><spatial name="rope" width=".01"><site site="end"/><site site="hook"/></spatial></tendon></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    plain = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False, web=False, assets=tmp_path)
    with Session(model, config=plain) as session:
        newest = session.processes.scenes.newest
        assert newest is not None
        assert newest.spec is not None
        assert (newest.spec.sites, newest.spec.tendons) == ((), ())
        assert any("2 sites: serve --sites" in note for note in session.notes)
        assert any("--tendons" in note for note in session.notes)
    with Session(model, config=replace(plain, sites=True, tendons=True)) as session:
        newest = session.processes.scenes.newest
        assert newest is not None
        assert newest.spec is not None
        assert {site.name for site in newest.spec.sites} == {"end", "hook"}
        assert [tendon.name for tendon in newest.spec.tendons] == ["rope"]
        assert not any("sites" in note or "tendons" in note for note in session.notes)
