"""A MuJoCo model rebuilt from a decoded scene by MJCF, OBJ and PNG: no code of the parser is used.

Everything comes from the bytes of the specification and the assets. Bodies are at their rest pose, without joints.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from iris_session.protocol.common import Pose
from iris_session.protocol.scene import FIRST_SITE_VISUAL, Geometry, Material, SceneSpec, decode_scene
from iris_session.scene import AssetStore, decode_arrays, decode_image, decode_mesh

FACES = ("right", "left", "up", "down", "front", "back")


def rebuild(data: bytes, store: AssetStore) -> mujoco.MjModel:
    """Return the model of a specification's bytes, with assets from `store`."""
    spec = decode_scene(data)
    assets: dict[str, bytes] = {}
    xml = "".join(
        (
            '<mujoco><compiler angle="radian"/>',
            _visual(spec),
            f"<asset>{''.join(_assets(spec, store, assets))}</asset>",
            f"<worldbody>{_children(spec, 0)}</worldbody></mujoco>",
        )
    )
    return mujoco.MjModel.from_xml_string(xml, assets)


def text(values: Iterable[float]) -> str:
    return " ".join(repr(float(v)) for v in values)


def _visual(spec: SceneSpec) -> str:
    e = spec.environment
    return (
        f'<statistic extent="{e.extent!r}" center="{text(e.center)}"/><visual>'
        f'<headlight active="{int(e.headlight.active)}" ambient="{text(e.headlight.ambient)}" '
        f'diffuse="{text(e.headlight.diffuse)}" specular="{text(e.headlight.specular)}"/>'
        f'<map znear="{e.znear / e.extent!r}" zfar="{e.zfar / e.extent!r}" haze="{e.haze!r}"/>'
        f'<rgba haze="{text(e.haze_rgba)}"/></visual>'
    )


def _assets(spec: SceneSpec, store: AssetStore, assets: dict[str, bytes]) -> Iterable[str]:
    for i, texture in enumerate(spec.textures):
        level = texture.levels[0]
        pixels = decode_image(store.get(level.address), level.encoding)
        space = {"srgb": "sRGB"}.get(texture.colorspace, texture.colorspace)
        if texture.kind == "2d":
            assets[f"t{i}.png"] = png(pixels)
            files = f'file="t{i}.png"'
        else:
            for k, face in enumerate(FACES):
                assets[f"t{i}{face}.png"] = png(pixels[k * level.height : (k + 1) * level.height])
            files = " ".join(f'file{face}="t{i}{face}.png"' for face in FACES)
        yield f'<texture name="t{i}" type="{texture.kind}" colorspace="{space}" {files}/>'
    for i, material in enumerate(spec.materials):
        yield _material(i, material)
    for i, mesh in enumerate(spec.meshes):
        assets[f"m{i}.obj"] = obj(store.get(mesh.levels[0].address))
        yield f'<mesh name="m{i}" file="m{i}.obj"/>'
    for i, field in enumerate(spec.hfields):
        grid = decode_arrays(store.get(field.address), "grid")["elevation"]
        rows = text(grid[::-1].reshape(-1))  # MJCF lists the rows from above, the specification along y
        yield (
            f'<hfield name="h{i}" nrow="{field.rows}" ncol="{field.columns}" size="{text(field.size)}" '
            f'elevation="{rows}"/>'
        )


def _material(index: int, material: Material) -> str:
    worn = material.find_texture()
    texture = f'texture="t{worn}"' if worn >= 0 else ""
    return (
        f'<material name="a{index}" rgba="{text(material.rgba)}" emission="{material.emission!r}" '
        f'specular="{material.specular!r}" shininess="{material.shininess!r}" '
        f'reflectance="{material.reflectance!r}" texrepeat="{text(material.repeat)}" '
        f'texuniform="{str(material.uniform).lower()}" {texture}/>'
    )


def _pose(pose: Pose) -> str:
    return f'pos="{text(pose.p)}" quat="{text(pose.q)}"'


def _children(spec: SceneSpec, parent: int) -> str:
    parts = [_content(spec, parent)]
    for body in spec.bodies:
        if body.parent == parent:
            name = f"b{body.id}"
            parts.append(f'<body name="{name}" {_pose(body.T_parent_body)}>{_children(spec, body.id)}</body>')
    return "".join(parts)


def _content(spec: SceneSpec, body: int) -> str:
    parts = []
    for visual in spec.visuals:
        if visual.body == body:
            material = f'material="a{visual.material}"' if visual.material >= 0 else ""
            kind, rest = ("geom", 'contype="0" conaffinity="0"') if visual.id < FIRST_SITE_VISUAL else ("site", "")
            parts.append(
                f'<{kind} {_shape(visual.geometry)} {_pose(visual.T_body_visual)} group="{visual.group}" '
                f'rgba="{text(visual.rgba)}" {material} {rest}/>'
            )
    for light in spec.lights:
        if light.body == body:
            target = f'target="b{light.target}"' if light.target > 0 else ""
            parts.append(
                f'<light type="{light.kind}" pos="{text(light.p_body)}" dir="{text(light.direction_body)}" '
                f'ambient="{text(light.ambient)}" diffuse="{text(light.diffuse)}" specular="{text(light.specular)}" '
                f'attenuation="{text(light.attenuation)}" cutoff="{light.cutoff!r}" exponent="{light.exponent!r}" '
                f'castshadow="{str(light.castshadow).lower()}" active="{str(light.active).lower()}" '
                f'mode="{light.follow}" {target}/>'
            )
    for camera in spec.cameras:
        if camera.body == body:
            target = f'target="b{camera.target}"' if camera.target > 0 else ""
            projection = 'projection="orthographic"' if camera.orthographic else ""
            view = f'fovy="{camera.fovy!r}"'
            if camera.focal[0]:
                width, height = camera.resolution
                view = (
                    f'resolution="{width} {height}" sensorsize="{width * 1e-6!r} {height * 1e-6!r}" '
                    f'focalpixel="{text(camera.focal)}" principalpixel="{text(camera.principal)}"'
                )
            parts.append(
                f"<camera name={quoteattr(camera.name)} {_pose(camera.T_body_camera)} {view} {projection} "
                f'mode="{camera.follow}" {target}/>'
            )
    return "".join(parts)


def _shape(geometry: Geometry) -> str:
    if geometry.mesh >= 0:
        return f'type="mesh" mesh="m{geometry.mesh}"'
    if geometry.hfield >= 0:
        return f'type="hfield" hfield="h{geometry.hfield}"'
    x, y, z = geometry.size
    size = {"sphere": (x,), "capsule": (x, z), "cylinder": (x, z)}.get(geometry.kind, (x, y, z))
    return f'type="{geometry.kind}" size="{text(size)}"'


def png(pixels: NDArray[np.uint8]) -> bytes:
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "PNG")
    return out.getvalue()


def obj(data: bytes) -> bytes:
    """OBJ has its v axis upwards."""
    mesh = decode_mesh(data)
    out = io.StringIO()
    np.savetxt(out, mesh.position, "v %.9g %.9g %.9g")
    np.savetxt(out, mesh.normal, "vn %.9g %.9g %.9g")
    if mesh.uv is not None:
        np.savetxt(out, mesh.uv * [1, -1] + [0, 1], "vt %.9g %.9g")
    corners = mesh.index.astype(np.int64) + 1
    form = "f %d/%d/%d %d/%d/%d %d/%d/%d" if mesh.uv is not None else "f %d//%d %d//%d %d//%d"
    np.savetxt(out, np.repeat(corners, 3 if mesh.uv is not None else 2, axis=1), form)
    return out.getvalue().encode()
