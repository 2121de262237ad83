"""Levels of detail within a client's budget: the finest that fit, the coarsest where nothing fits."""

from __future__ import annotations

from pathlib import Path

import msgspec
import pytest

from iris_session.protocol.scene import Deformable, SceneSpec
from iris_session.scene import AssetStore
from iris_session.scene.budget import Budget, add_totals, choose_levels
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.scene.report import build_report, format_tree
from tests.scene.models import many_objects


@pytest.fixture(scope="module")
def spec(tmp_path_factory: pytest.TempPathFactory) -> SceneSpec:
    return parse_mujoco(many_objects(30, 3, 12_000, 512), AssetStore(tmp_path_factory.mktemp("assets"))).spec


def test_without_a_budget_everything_is_exact(spec: SceneSpec) -> None:
    choice = choose_levels(spec, Budget())
    assert (set(choice.mesh_levels), set(choice.texture_levels), choice.hidden) == ({0}, {0}, frozenset())
    assert choice.triangles == spec.totals.triangles == sum(10 * mesh.levels[0].triangles for mesh in spec.meshes)
    assert choice.objects == spec.totals.objects == 30
    assert choice.fits


def test_deformables_are_drawn_too(spec: SceneSpec) -> None:
    """Hidden ones and ropes cost no triangles; none of them has levels, or is left out."""
    cloth = Deformable("", 2, 0, 60, 5_000, 0.01, False, -1, (1.0, 1.0, 1.0, 1.0), "flex-0", "0" * 64, 100)
    rope, hidden = msgspec.structs.replace(cloth, dim=1), msgspec.structs.replace(cloth, group=4)
    bending = add_totals(msgspec.structs.replace(spec, deformables=(cloth, rope, hidden)))
    assert bending.totals.objects == spec.totals.objects + 2
    assert bending.totals.triangles == spec.totals.triangles + 5_000
    limit = spec.totals.triangles // 2
    choice = choose_levels(bending, Budget(triangles=limit, objects=20))
    assert (choice.fits, choice.objects, len(choice.hidden)) == (True, 20, 12)
    assert 5_000 < choice.triangles <= limit
    assert not choose_levels(bending, Budget(objects=2)).fits


@pytest.mark.parametrize("share", [0.9, 0.5, 0.1])
def test_triangles_fit(spec: SceneSpec, share: float) -> None:
    limit = int(share * spec.totals.triangles)
    choice = choose_levels(spec, Budget(triangles=limit))
    used = sum(10 * mesh.levels[k].triangles for mesh, k in zip(spec.meshes, choice.mesh_levels, strict=True))
    assert used == choice.triangles <= limit
    assert choice.fits
    assert sum(choice.mesh_levels) > 0
    if share == 0.9:
        assert sum(choice.mesh_levels) == 1  # no more than needed


def test_textures_fit(spec: SceneSpec) -> None:
    choice = choose_levels(spec, Budget(texture_bytes=spec.totals.texture_memory // 2))
    assert choice.texture_bytes <= spec.totals.texture_memory // 2
    assert choice.mesh_levels == (0, 0, 0)
    assert 0 < sum(choice.texture_levels) < 6


def test_scene_beyond_the_budget_uses_the_coarsest_levels(spec: SceneSpec) -> None:
    choice = choose_levels(spec, Budget(triangles=10, texture_bytes=10))
    assert choice.mesh_levels == tuple(len(mesh.levels) - 1 for mesh in spec.meshes)
    assert choice.texture_levels == tuple(len(texture.levels) - 1 for texture in spec.textures)
    assert (choice.fits, choice.objects) == (False, 30)


def test_smallest_visuals_are_left_out_first(spec: SceneSpec) -> None:
    choice = choose_levels(spec, Budget(objects=12))
    assert (choice.fits, choice.objects, len(choice.hidden)) == (True, 12, 18)
    sides = [max(b - a for a, b in zip(mesh.low, mesh.high, strict=True)) for mesh in spec.meshes]
    largest = sides.index(max(sides))
    assert not any(visual.geometry.mesh == largest for visual in spec.visuals if visual.id in choice.hidden)


def test_report_names_heavy_parts(spec: SceneSpec) -> None:
    found = build_report(spec, "0" * 64)
    assert found.struggles == ()
    assert (found.bodies, found.moving, found.kinds) == (30, 30, {"mesh": 30})
    assert {heavy.name for heavy in found.heavy} == {"m0", "m1", "m2", "t0", "t1", "t2"}
    assert all(heavy.uses == 10 for heavy in found.heavy)
    assert len(list(format_tree(spec))) == 31


def test_report_names_problems_of_a_headset(tmp_path: Path) -> None:
    heavy = parse_mujoco(many_objects(220, 2, 12_000, 64), AssetStore(tmp_path)).spec
    objects, triangles = build_report(heavy, "0" * 64).struggles
    assert "220 objects" in objects
    assert "coarser levels" in triangles
