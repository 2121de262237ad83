"""Building assets: no duplicates, levels of detail, damaged cache notes, and a warm start that encodes nothing."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from iris_session.scene import AssetBuilder, AssetStore, EncodeOptions, decode_image, decode_mesh
from iris_session.scene.mujoco_scene import parse_mujoco
from tests.scene.models import many_objects
from tests.scene.test_images import picture
from tests.scene.test_meshes import ball


def test_equal_content_is_built_once_and_remembered(tmp_path: Path) -> None:
    model = many_objects(40, 3, 1_000, 64)
    cold = parse_mujoco(model, AssetStore(tmp_path))
    assert (cold.built, cold.recalled) == (6, 0)
    warm = parse_mujoco(model, AssetStore(tmp_path), threads=1)
    assert (warm.built, warm.recalled) == (0, 6)
    assert warm.spec == cold.spec
    twins = parse_mujoco(many_objects(4, 3, 1_000, 64, seed=0), AssetStore(tmp_path))
    assert twins.built == 0
    other = parse_mujoco(model, AssetStore(tmp_path), options=EncodeOptions(levels=False))
    assert other.built == 6


def test_lost_assets_and_damaged_notes_are_rebuilt(tmp_path: Path) -> None:
    model = many_objects(3, 2, 1_000, 64)
    store = AssetStore(tmp_path)
    first = parse_mujoco(model, store)
    store.path(first.spec.meshes[0].levels[0].address).unlink()
    store.path(first.spec.textures[0].levels[0].address).write_bytes(b"")
    assert parse_mujoco(model, store).built == 2
    next(path for path in (tmp_path / "index").rglob("*") if path.is_file()).write_bytes(b"\xc1")
    again = parse_mujoco(model, store)
    assert again.built == 1
    assert again.spec == first.spec


def test_levels_of_a_mesh(tmp_path: Path) -> None:
    store, mesh = AssetStore(tmp_path), ball(5)
    (note,) = AssetBuilder(store).run([AssetBuilder(store).mesh_work([mesh.position], lambda: mesh)])
    exact, *coarse = note.levels
    assert np.array_equal(decode_mesh(store.get(exact.address)).index, mesh.index)
    assert (exact.max_error_m, exact.triangles, exact.bytes) == (0.0, 20_480, len(store.view(exact.address)))
    assert len(coarse) >= 2
    for fine, level in zip(note.levels, coarse, strict=False):
        assert level.triangles < 0.5 * fine.triangles
        assert level.max_error_m > fine.max_error_m
        assert decode_mesh(store.get(level.address)).triangles == level.triangles
    assert np.allclose((note.low, note.high), [(-1, -1, -1), (1, 1, 1)])


@pytest.mark.parametrize("encoding", ["arrays", "png", "jpeg"])
def test_levels_of_a_texture(tmp_path: Path, encoding: str) -> None:
    store = AssetStore(tmp_path)
    builder = AssetBuilder(store, EncodeOptions(texture_encoding=encoding))
    pixels = picture(512, 1024)
    (note,) = builder.run([builder.texture_work(pixels, "2d")])
    assert [(level.width, level.height) for level in note.levels] == [(1024, 512), (512, 256)]
    for level in note.levels:
        assert level.encoding == encoding
        assert decode_image(store.get(level.address), encoding).shape == (level.height, level.width, 3)
    error = np.abs(decode_image(store.get(note.levels[0].address), encoding).astype(int) - pixels).max()
    assert error == note.levels[0].max_error
    assert (error > 0) == (encoding == "jpeg")


#: A mesh and a flex, and one difference at a time.
ALIKE = """<mujoco><asset><mesh name="m" file="m.obj" inertia="shell"/></asset>
    <worldbody><geom type="mesh" mesh="m"/></worldbody>
    <deformable><flex name="f" dim="2" body="world" radius=".01" vertex="{0}" element="0 1 2 2 1 3"
        texcoord="{1}"/></deformable></mujoco>"""
OBJ = """v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 .5\nvt 0 0\nvt 1 0\nvt 0 1\nvt {0} 1\nvn 0 0 1\nvn 0 {1}
f {2} 2/2/1 3/3/1\nf 3/3/1 2/2/1 4/4/2"""
DIFFERENT = {
    "": ("0 0 1 1 0 1 0 1 1 1 1 1", "0 0 1 0 0 1 1 1", "1", ".6 .8", "1/1/1"),
    "texture coordinates of the mesh": ("0 0 1 1 0 1 0 1 1 1 1 1", "0 0 1 0 0 1 1 1", ".5", ".6 .8", "1/1/1"),
    "its normals": ("0 0 1 1 0 1 0 1 1 1 1 1", "0 0 1 0 0 1 1 1", "1", ".8 .6", "1/1/1"),
    "which corner wears which coordinate": ("0 0 1 1 0 1 0 1 1 1 1 1", "0 0 1 0 0 1 1 1", "1", ".6 .8", "1/4/1"),
    "vertices of the flex": ("0 0 1 1 0 1 0 1 1 1 1 2", "0 0 1 0 0 1 1 1", "1", ".6 .8", "1/1/1"),
    "its texture coordinates": ("0 0 1 1 0 1 0 1 1 1 1 1", "0 0 1 0 0 1 1 .5", "1", ".6 .8", "1/1/1"),
}


def test_cached_parts_of_a_model_are_not_used_for_another(tmp_path: Path) -> None:
    hashes = set()
    for number, (vertex, texcoord, *obj) in enumerate(DIFFERENT.values()):
        model = mujoco.MjModel.from_xml_string(
            ALIKE.format(vertex, texcoord), assets={"m.obj": OBJ.format(*obj).encode()}
        )
        parsed = parse_mujoco(model, AssetStore(tmp_path / "one for all"))
        assert parsed.spec == parse_mujoco(model, AssetStore(tmp_path / str(number))).spec
        hashes.add(parsed.scene_hash)
    assert len(hashes) == len(DIFFERENT)
