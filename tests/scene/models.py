"""Models for the tests of scenes: one with every shape, mapping and kind of light; a large one; one with flexes."""

from __future__ import annotations

import mujoco
import numpy as np
import trimesh

#: A closed solid without symmetry, so that MuJoCo finds the same inertial frame for it again.
WEDGE = "0 0 0  .5 0 0  0 .35 0  0 0 .2"
#: A bent square from both sides; its corners have other texture coordinates in every triangle (seams).
QUAD = """v -.3 -.3 0\nv .3 -.3 0\nv .3 .3 .1\nv -.3 .3 0
vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvt .2 .4\nvt .9 .3\nvt .5 .6
f 1/1 2/2 3/3\nf 1/5 3/6 4/7\nf 1/2 3/4 2/6\nf 1/7 4/1 3/3
"""
SHAPES = {
    "sphere": "type='sphere' size='.3'",
    "capsule": "type='capsule' size='.15 .25'",
    "ellipsoid": "type='ellipsoid' size='.35 .2 .25'",
    "cylinder": "type='cylinder' size='.25 .2'",
    "box": "type='box' size='.3 .2 .25'",
    "plane": "type='plane' size='.35 .25 .1'",
    "wedge": "type='mesh' mesh='wedge'",
    "quad": "type='mesh' mesh='quad'",
    "hills": "type='hfield' hfield='hills'",
    "field": "type='sdf' mesh='wedge'",
}
LOOKS = ("", "image", "uniform", "cube", "cubeuniform", "plain")


def every_shape() -> mujoco.MjModel:
    """Return every shape in every look, on an infinite floor, below a sky, lit by spots and a sun."""
    rng = np.random.default_rng(4)
    hills = " ".join(f"{v:.3f}" for v in rng.uniform(0, 1, 30))
    faces = " ".join(f'file{face}="{face}.png"' for face in ("right", "left", "up", "down", "front", "back"))
    geoms = []
    for row, shape in enumerate(SHAPES.values()):
        for column, look in enumerate(LOOKS):
            wears = f'material="{look}"' if look else f'rgba=".{row} .{column + 3} .7 1"'
            geoms.append(
                f'<body pos="{0.9 * column} {0.9 * row} .5" euler="{20 * column} {10 * row} {30 * column}">'
                f"<geom {shape} {wears}/></body>"
            )
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler angle="degree"/><statistic center="2.2 3.6 .5" extent="4"/><asset>
        <texture name="sky" type="skybox" builtin="gradient" rgb1=".2 .4 .8" rgb2="1 1 .8" width="64" height="64"/>
        <texture name="image" type="2d" file="image.png"/>
        <texture name="dice" type="cube" {faces}/>
        <material name="image" texture="image" texrepeat="2 3" specular=".2" shininess=".9"/>
        <material name="uniform" texture="image" texrepeat="4 2" texuniform="true" emission=".3"/>
        <material name="cube" texture="dice" rgba="1 .9 .8 1"/>
        <material name="cubeuniform" texture="dice" texuniform="true"/>
        <material name="plain" rgba=".9 .4 .1 .6" specular="1" shininess=".1"/>
        <mesh name="wedge" vertex="{WEDGE}"/><mesh name="quad" file="quad.obj" inertia="shell"/>
        <hfield name="hills" nrow="5" ncol="6" size=".35 .3 .2 .05" elevation="{hills}"/>
        </asset><worldbody>
        <light type="directional" dir="-.3 .2 -1" diffuse=".4 .4 .3" castshadow="false"/>
        <light pos="2 2 4" dir="0 0 -1" cutoff="50" exponent="3" attenuation=".5 .1 .02" specular=".8 .2 .2"/>
        <light type="point" pos="4 4 3" diffuse=".2 .2 .6"/>
        <geom type="plane" size="0 0 1" material="image"/>
        <geom type="box" size="9 9 9" rgba="1 0 0 0"/><geom type="box" size="9 9 9" group="4"/>
        <body name="seen" pos="2 3 1"><geom size=".1"/></body>
        <light mode="targetbody" target="seen" pos="5 5 2" diffuse=".1 .3 .1"/>
        <camera name="chaser" mode="targetbody" target="seen" pos="6 -3 3"/>
        <camera name="top" pos="2 4 12" xyaxes="1 0 0 0 1 0" fovy="50"/>
        <camera name="flat" pos="2 4 9" xyaxes="1 0 0 0 1 0" fovy="9" projection="orthographic"/>
        <camera name="real" pos="2 -6 5" xyaxes="1 0 0 0 .6 .8" resolution="240 180" sensorsize=".004 .0036"
                focalpixel="200 210" principalpixel="9 -7"/>
        {"".join(geoms)}</worldbody></mujoco>""",
        _pictures(rng),
    )


def _pictures(rng: np.random.Generator) -> dict[str, bytes]:
    from tests.scene.rebuild import png

    image = np.zeros((48, 64, 3), np.uint8)
    image[:24, :32] = (200, 30, 30)
    image[24:, 32:] = (30, 200, 60)
    image[:24, 32:, 2] = np.linspace(0, 255, 32).astype(np.uint8)
    files = {"image.png": png(image), "quad.obj": QUAD.encode()}
    for face in ("right", "left", "up", "down", "front", "back"):
        side = np.full((32, 32, 3), rng.integers(60, 255, 3), np.uint8)
        side[:8, :16] = 0  # distinguishes up from down and left from right
        files[f"{face}.png"] = png(side)
    return files


def many_objects(n: int, assets: int, triangles: int, side: int, seed: int = 0) -> mujoco.MjModel:
    """Return `n` free objects that share `assets` meshes of about `triangles` and as many noisy textures of `side`
    pixels."""
    from tests.scene.rebuild import png

    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    files: dict[str, bytes] = {}
    rings = max(3, int((triangles / 2) ** 0.5))
    for k in range(assets):
        ball = trimesh.creation.uv_sphere(0.1, count=[rings, rings])
        dents = 1 + 0.1 * rng.normal(size=(len(ball.vertices), 1))
        spec.add_mesh(name=f"m{k}", uservert=(dents * ball.vertices).reshape(-1), userface=ball.faces.reshape(-1))
        noise = rng.integers(0, 255, (side, side, 3), dtype=np.uint8)
        files[f"t{k}.png"] = png(noise)
        spec.add_texture(name=f"t{k}", type=int(mujoco.mjtTexture.mjTEXTURE_2D), file=f"t{k}.png")
        material = spec.add_material(name=f"a{k}")
        material.textures[int(mujoco.mjtTextureRole.mjTEXROLE_RGB)] = f"t{k}"
    for i in range(n):
        body = spec.worldbody.add_body(pos=rng.uniform(-3, 3, 3))
        body.add_freejoint()
        k = i % assets
        body.add_geom(type=int(mujoco.mjtGeom.mjGEOM_MESH), meshname=f"m{k}", material=f"a{k}")
    spec.assets = files
    return spec.compile()


def flexes() -> mujoco.MjModel:
    """Return a rope, a cloth with texture coordinates, and a soft body."""
    return mujoco.MjModel.from_xml_string(
        """<mujoco><option timestep="0.005" integrator="discrete" solver="CG"/><asset>
        <texture name="t" type="2d" builtin="checker" width="8" height="8" rgb1="1 0 0"/>
        <material name="m" texture="t"/></asset><worldbody>
        <flexcomp name="cloth" type="grid" dim="2" count="5 4 1" spacing=".1 .1 .1" pos="0 0 1" radius=".01"
                  material="m"><edge equality="true"/></flexcomp>
        <flexcomp name="rope" type="grid" dim="1" count="6 1 1" spacing=".1 .1 .1" pos="0 1 1" radius=".02">
          <edge equality="true"/></flexcomp>
        <flexcomp name="soft" type="grid" dim="3" count="4 4 4" spacing=".1 .1 .1" pos="0 2 1" radius=".005"
                  dof="trilinear"><elasticity young="1e4" damping=".01"/></flexcomp>
        <body name="box" pos="1 0 1"><freejoint/><geom size=".1"/></body>
        </worldbody></mujoco>"""
    )
