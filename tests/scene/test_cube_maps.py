"""Exported GLB files, drawn by ray casting, against MuJoCo's picture: cube and 2d textures on every shape."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import mujoco
import numpy as np
import pytest

from iris_session.scene import AssetStore
from iris_session.scene.glb import write_glb
from iris_session.scene.mujoco_scene import parse_mujoco
from tests.scene.models import QUAD, SHAPES, WEDGE
from tests.scene.pictures import ModelRenderer, graphics
from tests.scene.rays import STEP, draw, rays
from tests.scene.rebuild import FACES, png
from tests.scene.test_fidelity import MEAN_DIFFERENCE, VISIBLE, VISIBLE_SHARE

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
            exact = artist.colour(camera)[::STEP, ::STEP]
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
