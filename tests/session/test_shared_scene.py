"""Assets of a session on disk: held while they are served, then released."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import mujoco
import pytest

from iris_session.physics import FoundRobots, World
from iris_session.protocol.scene import AddMesh, Mesh, MeshLevel, SceneError, SetVisual
from iris_session.scene import AssetStore
from iris_session.session import shared_scene
from iris_session.session.errors import ConfigError
from iris_session.session.scene_change import prepare_scene
from iris_session.session.session import Session
from iris_session.session.shared_scene import SharedScenes
from tests.scene.models import flexes
from tests.session.play import make_core
from tests.session.test_session import QUIET


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
@pytest.mark.parametrize("way", ["config", "arguments"])
def test_groups_and_sites_of_a_session_are_chosen(tmp_path: Path, way: str) -> None:
    xml = """<mujoco><worldbody><body name="arm"><joint/><geom size=".1" group="3"/><site name="end" group="4"/></body>
        <site name="goal"/></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    plain = replace(QUIET, assets=tmp_path)
    with Session(model, config=plain) as session:
        assert session.scene is not None
        assert ([one.name for one in session.scene.visuals], session.scene.groups_shown) == (["", "goal"], (0, 1, 2))
    config = replace(plain, groups=(3,), sites=(4,)) if way == "config" else plain
    given: dict[str, Any] = {} if way == "config" else {"groups": [3], "sites": [4]}
    with Session(model, config=config, **given) as session:
        assert session.scene is not None
        assert ([one.name for one in session.scene.visuals], session.scene.groups_shown) == (["", "end"], (3,))
    with pytest.raises(ConfigError, match="groups"):
        Session(model, config=plain, groups=["visual"])


@pytest.mark.parametrize("scale", [1.0, 0.001])
def test_model_whose_meshes_seem_to_be_in_millimetres_is_advice(scale: float, tmp_path: Path) -> None:
    """On the terminal, and on the page, where an empty picture would be all that people see."""
    box = " ".join(f"{x} {y} {z}" for x in (0, 300) for y in (0, 200) for z in (0, 100))
    mesh = f'<mesh name="box" vertex="{box}" scale="{scale} {scale} {scale}"/>'
    xml = f'<mujoco><asset>{mesh}</asset><worldbody><geom type="mesh" mesh="box"/></worldbody></mujoco>'
    scenes = SharedScenes(tmp_path, "test")
    scenes.show(scenes.make(World(mujoco.MjModel.from_xml_string(xml), (), ())))
    assert list(scenes.advice) == scenes.notes == [note for note in scenes.notes if 'scale="0.001' in note]
    assert bool(scenes.advice) == (scale == 1.0)
    scenes.close()
