"""Exported GLB files, drawn by ray casting, against MuJoCo's picture: cube and 2d textures on every shape."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from iris_session.scene import AssetStore, EncodeOptions
from iris_session.scene.cube_maps import CubeMapReader, bake_cube_map
from iris_session.scene.glb import write_glb
from iris_session.scene.meshes import MeshArrays
from iris_session.scene.mujoco_scene import parse_mujoco
from iris_session.scene.report import list_glb_differences
from iris_session.scene.shapes import build_primitive
from tests.scene.models import QUAD, SHAPES, WEDGE
from tests.scene.pictures import ModelRenderer, graphics
from tests.scene.rays import draw, rays
from tests.scene.rebuild import FACES, png
from tests.scene.test_fidelity import MEAN_DIFFERENCE, VISIBLE, VISIBLE_SHARE
from tests.scene.test_shapes import document

#: Azimuth and elevation [degrees]: together they show all faces except the lower ones; planes from above.
VIEWS = ((30.0, -25.0), (260.0, -40.0))
FROM_BELOW = (70.0, 40.0)
#: A signed distance field is drawn as its mesh.
MAPPED = tuple(shape for shape in SHAPES if shape != "field")
CLOTH = """<flexcomp name="cloth" type="grid" dim="2" count="5 4 1" spacing=".15 .15 .15" radius=".001" material="m">
<edge equality="true"/></flexcomp>"""
#: Mean difference of 255 where three colours are multiplied: linear in glTF, not in MuJoCo.
GLOW_DIFFERENCE = 1.5
#: Only emission: colours without light.
DARK = '<visual><headlight ambient="0 0 0" diffuse="0 0 0" specular="0 0 0"/></visual>'


def painted(shape: str, texture: str, look: str = "", side: int = 16, cloth: str = "") -> mujoco.MjModel:
    """One shape. `texture`: `cube` or `2d`; each face has a colour and a dark corner, which shows its rotation."""
    rng = np.random.default_rng(4)
    pictures = {}
    for face in FACES:
        pixels = np.full((side, side, 3), rng.integers(60, 255, 3), np.uint8)
        pixels[: side // 4, : side // 2] = 0
        pictures[f"{face}.png"] = png(pixels)
    files = 'file="right.png"' if texture == "2d" else " ".join(f'file{face}="{face}.png"' for face in FACES)
    hills = " ".join(f"{v:.3f}" for v in rng.uniform(0, 1, 30))
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><statistic center="0 0 0" extent="1"/>{DARK}<asset>
        <texture name="t" type="{texture}" {files}/><material name="m" texture="t" emission="1" specular="0" {look}/>
        <mesh name="wedge" vertex="{WEDGE}"/><mesh name="quad" file="quad.obj" inertia="shell"/>
        <hfield name="hills" nrow="5" ncol="6" size=".35 .3 .2 .05" elevation="{hills}"/>
        </asset><worldbody><geom {shape} material="m"/>{cloth}</worldbody></mujoco>""",
        {**pictures, "quad.obj": QUAD.encode()},
    )


def views(model: mujoco.MjModel, angles: Iterable[tuple[float, float]]) -> list[mujoco.MjvCamera]:
    found = []
    for azimuth, elevation in angles:
        camera = mujoco.MjvCamera()
        mujoco.mjv_defaultFreeCamera(model, camera)
        camera.azimuth, camera.elevation, camera.distance = azimuth, elevation, 1.1
        found.append(camera)
    return found


def check(model: mujoco.MjModel, store: AssetStore, path: Path, *, emitted: bool = False) -> None:
    """Assert that MuJoCo's picture and the drawing of the exported file agree."""
    write_glb(parse_mujoco(model, store).spec, store, path)
    flat = int(model.geom_type[0]) == int(mujoco.mjtGeom.mjGEOM_PLANE)
    with graphics():
        artist = ModelRenderer(model)
        for camera in views(model, VIEWS if flat else (*VIEWS, FROM_BELOW)):
            exact = artist.colour(camera)
            drawn, shown = draw(path, *rays(model, camera), emitted=emitted)
            assert np.mean(shown >= 0) > 0.02  # the picture is not empty
            difference = np.abs(drawn[:, :, :3] - exact)
            assert difference.mean() <= (GLOW_DIFFERENCE if emitted else MEAN_DIFFERENCE)
            assert np.mean(difference.max(axis=2) > VISIBLE) <= VISIBLE_SHARE
        artist.close()


@pytest.mark.parametrize("uniform", ["false", "true"])
@pytest.mark.parametrize("shape", MAPPED)
@pytest.mark.parametrize(("texture", "look"), [("cube", 'rgba="1 .9 .8 1"'), ("2d", 'texrepeat="1.5 1"')])
def test_texture_is_drawn_as_in_mujoco(
    tmp_path: Path, store: AssetStore, shape: str, uniform: str, texture: str, look: str
) -> None:
    check(painted(SHAPES[shape], texture, f'{look} texuniform="{uniform}"'), store, tmp_path / "a.glb")


def test_cloth_texture_is_repeated(tmp_path: Path, store: AssetStore) -> None:
    model = painted("size='.01' rgba='0 0 0 0'", "2d", 'texrepeat="1.5 2"', side=8, cloth=CLOTH)
    check(model, store, tmp_path / "a.glb")


@pytest.mark.parametrize("texture", ["cube", "2d"])
def test_emission_is_multiplied_by_the_texture(tmp_path: Path, store: AssetStore, texture: str) -> None:
    model = painted(SHAPES["box"], texture, 'rgba="1 .9 .8 1"')
    model.mat_emission[0] = 0.4
    check(model, store, tmp_path / "a.glb", emitted=True)


def images(path: Path) -> list[Image.Image]:
    """Return the pictures of a GLB."""
    data, found = path.read_bytes(), document(path)
    start = 20 + struct.unpack_from("<I", data, 12)[0] + 8
    pictures = []
    for image in found.get("images", ()):
        view = found["bufferViews"][image["bufferView"]]
        at = start + view["byteOffset"]
        pictures.append(Image.open(io.BytesIO(data[at : at + view["byteLength"]])))
    return pictures


def many() -> mujoco.MjModel:
    """Three balls of two sizes in two colours, and cubes with the same content twice, of one colour, of six."""
    checker = 'type="cube" builtin="checker" rgb1="1 0 0" rgb2="0 0 1" width="64" height="64"'
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><asset><texture name="a" {checker}/><texture name="b" {checker}/>
        <texture name="one" type="cube" builtin="flat" rgb1="1 .5 0" rgb2="1 .5 0" width="64" height="64"/>
        <texture name="six" type="cube" builtin="flat" rgb1="1 .5 0" rgb2="0 0 1" width="64" height="64"/>
        <material name="a" texture="a"/><material name="b" texture="b" rgba="1 0 0 1"/>
        <material name="one" texture="one" rgba=".5 1 1 1"/><material name="six" texture="six"/></asset><worldbody>
        <geom size=".1" material="a"/><geom size=".1" material="b"/><geom size=".2" material="a"/>
        <geom size=".1" material="one"/><geom size=".1" material="six"/></worldbody></mujoco>"""
    )


def test_equal_content_is_in_the_file_once(tmp_path: Path, store: AssetStore) -> None:
    write_glb(parse_mujoco(many(), store).spec, store, tmp_path / "a.glb")
    found = document(tmp_path / "a.glb")
    assert [picture.size for picture in images(tmp_path / "a.glb")] == [(3 * 72, 2 * 72)] * 2
    corners = [mesh["primitives"][0]["attributes"]["POSITION"] for mesh in found["meshes"]]
    assert corners[0] == corners[1]  # of one size, in two colours
    assert len(set(corners)) == 3


def test_large_cubes_are_scaled_down_and_jpeg_is_kept(
    tmp_path: Path, store: AssetStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("iris_session.scene.glb.CUBE_SIDE", 32)
    monkeypatch.setattr("iris_session.scene.report.CUBE_SIDE", 32)
    options = EncodeOptions(texture_encoding="jpeg", levels=False)
    spec = parse_mujoco(painted(SHAPES["box"], "cube", side=64), store, options=options).spec
    write_glb(spec, store, tmp_path / "a.glb")
    (picture,) = images(tmp_path / "a.glb")
    assert (picture.size, picture.format) == ((3 * 36, 2 * 36), "JPEG")
    (difference,) = list_glb_differences(spec)
    assert difference.startswith("1 cube textures of more than 32 pixels")


def ball(store: AssetStore) -> tuple[MeshArrays, MeshArrays]:
    """Return the shape of a painted ball, and the shape with a cube."""
    spec = parse_mujoco(painted(SHAPES["sphere"], "cube"), store).spec
    geometry = spec.visuals[0].geometry
    cube = CubeMapReader(spec, store, 2_048).find(spec.visuals[0].material, geometry)
    before = build_primitive(geometry)
    assert cube is not None
    assert cube.atlas is not None
    assert before is not None
    return before, bake_cube_map(before, geometry, (1.0, 1.0, 1.0), cube.atlas)


def edges(mesh: MeshArrays) -> list[tuple[Any, ...]]:
    corner = [tuple(p) for p in (mesh.position.round(7) + np.float32(0.0)).tolist()]  # -0 is 0, as at poles
    return [(corner[t[k]], corner[t[(k + 1) % 3]]) for t in mesh.index for k in range(3)]


def test_cut_and_split_meshes_have_no_gaps(store: AssetStore) -> None:
    """Every edge occurs once in each direction, bit for bit, and the surface is unchanged."""
    before, after = ball(store)
    there = edges(after)
    assert len(set(there)) == len(there)
    assert {(b, a) for a, b in there} == set(there)

    def area(mesh: MeshArrays) -> float:
        corners: NDArray[np.float64] = mesh.position[mesh.index].astype(np.float64)
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        assert np.einsum("fkc,fc->fk", mesh.normal[mesh.index], across).min() > -1e-9
        return float(np.linalg.norm(across, axis=1).sum() / 2)

    assert area(after) == pytest.approx(area(before), rel=1e-6)
