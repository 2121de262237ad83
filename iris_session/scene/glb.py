"""A scene as a GLB file (glTF 2.0, one binary file), which viewers and editors can open.

glTF has y up, so a root node rotates the scene. Every mesh and texture is in the file once, for any number of bodies.
2d textures are kept, with normals, roughness and the like; cubes, which glTF does not have, become one image each
(`cube_maps`); skies are left out, and so are hidden groups. Cameras are included, and lights that are on.
`report.list_glb_differences` lists the content that is not in the file.
"""

from __future__ import annotations

import hashlib
import json
import math
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from anchors.pose import apply, compose, inverse, quat_conj, quat_rotate
from iris_session.assets.store import AssetStore
from iris_session.protocol.common import IDENTITY, Pose, Vec3
from iris_session.protocol.names import ArrayKind, AssetEncoding, Follow, LightKind, TextureKind, TextureRole
from iris_session.protocol.scene import Camera, Deformable, Light, SceneSpec, Visual
from iris_session.scene.arrays import decode_arrays
from iris_session.scene.cube_maps import CUBE_SIDE, CubeMap, CubeMapReader, bake_cube_map, direction_scale
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import decode_image, encode_image, to_linear
from iris_session.scene.meshes import MeshArrays, decode_mesh, index_corners, normalise
from iris_session.scene.nodes import orient, to_vec3
from iris_session.scene.shapes import (
    add_texture_coordinates,
    build_height_field,
    build_primitive,
    repeat_texture_coordinates,
)
from iris_session.system.files import write_output

_FLOAT, _UINT = 5126, 5125
_VERTICES, _INDICES = 34962, 34963
_REPEAT, _LINEAR, _MIPMAPS = 10497, 9729, 9987
_LINES: Final = 1
#: Lengths in a GLB have 32 bits; a margin is left for the headers of its chunks.
_MAX_BYTES: Final = (1 << 32) - 64
#: Rotation from z up to y up: -90 degrees around x, `[x, y, z, w]` as in glTF.
_Y_UP: Final = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]
_LIGHTS: Final = (LightKind.DIRECTIONAL, LightKind.SPOT, LightKind.POINT)
#: Tracking modes that follow a target body by its origin: a specification has no centres of mass.
_WATCHING: Final = (Follow.TARGET_BODY, Follow.TARGET_BODY_COM)
_EXTENSION: Final = "KHR_lights_punctual"
#: Near plane of exported cameras [m].
_NEAR: Final = 0.01
#: Width over height of cameras without a resolution.
_ASPECT: Final = 4 / 3
#: Maximum cone angle in glTF [rad].
_WIDEST: Final = math.pi / 2


def write_glb(spec: SceneSpec, store: AssetStore, path: Path) -> int:
    """Write the file completely or not at all; return its size [bytes].

    Raises `AssetMissingError` when the store lacks an asset of the scene, `SceneBuildError` for a scene that is too
    large, and `OSError`.
    """
    data = _GlbWriter(spec, store).encode()
    write_output(path, data)
    return len(data)


class _GlbWriter:
    def __init__(self, spec: SceneSpec, store: AssetStore) -> None:
        self._spec = spec
        self._store = store
        self._blob = bytearray()
        self._json: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "iris-session"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": spec.name or "scene", "rotation": _Y_UP, "children": []}],
            **{name: [] for name in ("meshes", "materials", "accessors", "bufferViews", "textures", "images")},
            "cameras": [],
        }
        self._meshes: dict[tuple[object, ...], int | None] = {}
        self._materials: dict[str, int] = {}  # by their text
        self._textures: dict[str, int] = {}  # by the address of the asset
        self._bodies = {body.id: body for body in spec.bodies}
        self._cubes = CubeMapReader(spec, store, CUBE_SIDE)
        self._accessors: dict[tuple[object, ...], int] = {}

    def encode(self) -> bytes:
        nodes = {-1: 0}
        for body in self._spec.bodies:  # parents before their children; joints need not be at zero
            T_world_parent = IDENTITY if body.parent < 0 else self._bodies[body.parent].T_world_body
            T = body.T_world_body
            T_parent_body = compose(inverse((T_world_parent.p, T_world_parent.q)), (T.p, T.q))
            nodes[body.id] = self._add_node(nodes[body.parent], body.name or f"body_{body.id}", Pose(*T_parent_body))
        for visual in self._spec.visuals:
            if visual.rgba[3] > 0 and visual.group in self._spec.groups_shown:
                mesh = self._add_visual_mesh(visual)
                if mesh is not None:
                    name = visual.name or f"visual_{visual.id}"
                    self._add_node(nodes[visual.body], name, visual.T_body_visual, mesh=mesh)
        for k, deformable in enumerate(self._spec.deformables):
            if deformable.rgba[3] > 0 and deformable.group in self._spec.groups_shown:
                mesh = self._add_deformable(deformable)
                self._add_node(0, deformable.name or f"deformable_{k}", IDENTITY, mesh=mesh)
        self._add_viewpoints(nodes)
        return self._pack()

    def _add_viewpoints(self, nodes: Mapping[int, int]) -> None:
        """Add cameras, and lights that are on, below the nodes of their bodies. `nodes`: nodes by id of the body."""
        for k, camera in enumerate(self._spec.cameras):
            pose, ahead = camera.T_body_camera, self._find_direction_to_target(camera, camera.T_body_camera.p)
            if ahead is not None:  # upright
                q_world_body = self._bodies[camera.body].T_world_body.q
                pose = Pose(pose.p, orient(-ahead, quat_rotate(quat_conj(q_world_body), (0.0, 0.0, 1.0)), pose.q))
            lens = self._add("cameras", _build_camera(camera))
            self._add_node(nodes[camera.body], camera.name or f"camera_{k}", pose, camera=lens)
        lights = [light for light in self._spec.lights if light.active and light.kind in _LIGHTS]
        if lights:
            self._json["extensionsUsed"] = [_EXTENSION]
            self._json["extensions"] = {_EXTENSION: {"lights": [_build_light(light) for light in lights]}}
        for k, light in enumerate(lights):
            ahead = self._find_direction_to_target(light, light.p_body)
            back = -np.array(light.direction_body if ahead is None else ahead, np.float64)
            back /= np.linalg.norm(back) or 1.0
            up = (0.0, 1.0, 0.0) if abs(back[1]) < 0.9 else (1.0, 0.0, 0.0)
            pose = Pose(light.p_body, orient(back, up, IDENTITY.q))
            name = light.name or f"light_{k}"
            self._add_node(nodes[light.body], name, pose, extensions={_EXTENSION: {"light": k}})

    def _find_direction_to_target(self, watcher: Light | Camera, p_body: Vec3) -> NDArray[np.float64] | None:
        """Return the unit vector from a light or camera to the body that it tracks, in the frame of its own body.

        At the beginning; `None` when it tracks no body.
        """
        if watcher.follow not in _WATCHING or watcher.target < 0:
            return None
        own = self._bodies[watcher.body].T_world_body
        way = np.subtract(self._bodies[watcher.target].T_world_body.p, apply((own.p, own.q), p_body))
        way = np.array(quat_rotate(quat_conj(own.q), to_vec3(way)))
        return np.asarray(way / np.linalg.norm(way)) if way.any() else None

    def _pack(self) -> bytes:
        self._json["buffers"] = [{"byteLength": len(self._blob)}]
        self._json["samplers"] = [{"wrapS": _REPEAT, "wrapT": _REPEAT, "magFilter": _LINEAR, "minFilter": _MIPMAPS}]
        document = {key: value for key, value in self._json.items() if value != []}
        if not self._blob:
            del document["buffers"]
        try:
            text = json.dumps(document, separators=(",", ":"), allow_nan=False).encode()
        except ValueError:
            raise SceneBuildError("the scene has a number that is not finite, which glTF cannot hold") from None
        text += b" " * (-len(text) % 4)
        body = bytes(self._blob) + b"\0" * (-len(self._blob) % 4)
        chunks = struct.pack("<I4s", len(text), b"JSON") + text
        if body:
            if len(chunks) + len(body) > _MAX_BYTES:
                raise SceneBuildError(
                    f"a GLB of {len(body) / 1e9:.1f} GB, they hold {_MAX_BYTES / 1e9:.1f} at most: export its parts"
                )
            chunks += struct.pack("<I4s", len(body), b"BIN\0") + body
        return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks

    def _add_node(self, parent: int, name: str, pose: Pose, **content: Any) -> int:
        w, x, y, z = (v / (math.hypot(*pose.q) or 1.0) for v in pose.q)
        node = self._add("nodes", {"name": name, "translation": list(pose.p), "rotation": [x, y, z, w], **content})
        self._json["nodes"][parent].setdefault("children", []).append(node)
        return node

    def _add(self, kind: str, item: dict[str, Any]) -> int:
        self._json[kind].append(item)
        return len(self._json[kind]) - 1

    # --- geometry -----------------------------------------------------------------------------------------------------

    def _add_visual_mesh(self, visual: Visual) -> int | None:
        """Add one glTF mesh per shape and appearance, shared by all visuals that have it."""
        key = (visual.geometry, visual.material, visual.rgba)
        if key not in self._meshes:
            primitive = self._build_primitive(visual)
            self._meshes[key] = None if primitive is None else self._add("meshes", {"primitives": [primitive]})
        return self._meshes[key]

    def _build_primitive(self, visual: Visual) -> dict[str, Any] | None:
        arrays = self._read_arrays(visual)
        if arrays is None or not arrays.triangles:
            return None
        cube = self._cubes.find(visual.material, visual.geometry)
        if cube is not None and cube.atlas is not None:
            scale = direction_scale(self._spec, visual.geometry, visual.material)
            arrays = bake_cube_map(arrays, visual.geometry, scale, cube.atlas)
        elif visual.material >= 0:
            material = self._spec.materials[visual.material]
            texture = material.find_texture()
            if texture >= 0 and self._spec.textures[texture].kind == TextureKind.IMAGE:
                arrays = add_texture_coordinates(arrays, visual.geometry, material)
        look = self._add_material(
            visual.material,
            visual.rgba,
            mapped=arrays.uv is not None,
            blended=arrays.color is not None and bool((arrays.color[:, 3] < 255).any()),
            cube=cube,
        )
        return {**self._add_attributes(arrays), "material": look}

    def _read_arrays(self, visual: Visual) -> MeshArrays | None:
        geometry = visual.geometry
        if geometry.mesh >= 0:
            return decode_mesh(self._store.get(self._spec.meshes[geometry.mesh].levels[0].address))
        if geometry.hfield >= 0:
            field = self._spec.hfields[geometry.hfield]
            return build_height_field(field, decode_arrays(self._store.get(field.address), ArrayKind.GRID)["elevation"])
        return build_primitive(geometry)

    def _add_deformable(self, deformable: Deformable) -> int:
        """Add the rest shape: surfaces, of cloths with both sides; ropes as lines."""
        arrays = decode_arrays(self._store.get(deformable.address), ArrayKind.DEFORMABLE)
        mapped = deformable.dim > 1 and "uv" in arrays
        look = self._add_material(deformable.material, deformable.rgba, mapped=mapped, both_sides=deformable.dim == 2)
        if deformable.dim == 1:
            attributes = {"POSITION": self._add_accessor(arrays["position"], "VEC3", bounds=True)}
            primitive = {
                "attributes": attributes,
                "indices": self._add_accessor(arrays["elements"], "SCALAR"),
                "mode": _LINES,
            }
        else:
            corners = arrays["position"][arrays["elements"]]
            normal = normalise(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
            worn = None if deformable.material < 0 else self._spec.materials[deformable.material]
            uv = repeat_texture_coordinates(arrays.get("uv"), worn)
            primitive = self._add_attributes(index_corners(corners, np.repeat(normal[:, None], 3, axis=1), uv))
        return self._add("meshes", {"primitives": [{**primitive, "material": look}]})

    def _add_attributes(self, mesh: MeshArrays) -> dict[str, Any]:
        attributes = {
            "POSITION": self._add_accessor(mesh.position, "VEC3", bounds=True),
            "NORMAL": self._add_accessor(mesh.normal, "VEC3"),
        }
        if mesh.uv is not None:
            attributes["TEXCOORD_0"] = self._add_accessor(mesh.uv, "VEC2")
        if mesh.color is not None:
            linear = np.concatenate([to_linear(mesh.color[:, :3] / 255), mesh.color[:, 3:] / 255], axis=1)
            attributes["COLOR_0"] = self._add_accessor(linear.astype(np.float32), "VEC4")
        return {"attributes": attributes, "indices": self._add_accessor(mesh.index, "SCALAR")}

    def _add_accessor(self, values: NDArray[Any], kind: str, *, bounds: bool = False) -> int:
        """Add an accessor, once for equal data: two may not share a view. Whole numbers are indices."""
        index = values.dtype.kind in "iu"
        data = np.ascontiguousarray(values.reshape(-1) if index else values, "<u4" if index else "<f4")
        raw = data.tobytes()
        key = (hashlib.sha256(raw).digest(), kind, index, bounds)
        if key not in self._accessors:
            view = self._add_view(raw, _INDICES if index else _VERTICES)
            accessor: dict[str, Any] = {"bufferView": view, "componentType": _UINT if index else _FLOAT}
            accessor |= {"count": len(data), "type": kind}
            if bounds:
                accessor |= {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
            self._accessors[key] = self._add("accessors", accessor)
        return self._accessors[key]

    def _add_view(self, data: bytes, target: int = 0) -> int:
        self._blob += b"\0" * (-len(self._blob) % 4)
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self._blob), "byteLength": len(data)}
        if target:
            view["target"] = target
        self._blob += data
        return self._add("bufferViews", view)

    # --- materials ----------------------------------------------------------------------------------------------------

    def _add_material(
        self,
        index: int,
        rgba: Sequence[float],
        *,
        mapped: bool,
        both_sides: bool = False,
        blended: bool = False,
        cube: CubeMap | None = None,
    ) -> int:
        """Add a material.

        `mapped`: its meshes have texture coordinates, without which textures are not used. `blended`: the visual is not
        opaque, apart from its own colour and textures. `cube`: cube texture of the visual; without it that of the
        material is not drawn.
        """
        tint = (1.0, 1.0, 1.0) if cube is None else cube.tint
        colour = [float(v) * part for v, part in zip(rgba, tint, strict=False)]
        look: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
        found: dict[str, Any] = {"pbrMetallicRoughness": look}
        if index >= 0:
            material = self._spec.materials[index]
            look["metallicFactor"] = min(max(material.metallic, 0.0), 1.0)
            shine = 1.0 - material.shininess if material.roughness < 0 else material.roughness
            look["roughnessFactor"] = min(max(shine, 0.05), 1.0)
            found["name"] = material.name or f"material_{index}"
            color_texture = material.find_texture()
            blended = blended or (mapped and color_texture >= 0 and self._spec.textures[color_texture].channels == 4)
            for where, key, texture in (
                (look, "baseColorTexture", color_texture),
                (look, "metallicRoughnessTexture", material.find_texture(TextureRole.ORM)),
                (found, "occlusionTexture", material.find_texture(TextureRole.ORM, TextureRole.OCCLUSION)),
                (found, "normalTexture", material.find_texture(TextureRole.NORMAL)),
                (found, "emissiveTexture", material.find_texture(TextureRole.EMISSIVE)),
            ):
                number = self._add_texture(texture, cube if key == "baseColorTexture" else None) if mapped else None
                if number is not None:
                    where[key] = {"index": number}
            if material.emission > 0:  # of the visible colour, including the texture
                found["emissiveFactor"] = to_linear(material.emission * np.array(colour)).tolist()
                if "baseColorTexture" in look:
                    found.setdefault("emissiveTexture", look["baseColorTexture"])
        look["baseColorFactor"] = [*to_linear(colour).tolist(), min(max(float(rgba[3]), 0.0), 1.0)]
        if blended or rgba[3] < 1:
            found["alphaMode"] = "BLEND"
        found["doubleSided"] = both_sides
        known = json.dumps(found)
        if known not in self._materials:
            self._materials[known] = self._add("materials", found)
        return self._materials[known]

    def _add_texture(self, index: int, cube: CubeMap | None) -> int | None:
        """Add a 2d texture, or the atlas of a cube map, once; `None` without a picture that glTF can hold."""
        if cube is not None and cube.atlas is not None:
            address, encoding, pixels = cube.address, cube.encoding, cube.atlas.pixels
        elif index < 0 or self._spec.textures[index].kind != TextureKind.IMAGE:
            return None
        else:
            level, pixels = self._spec.textures[index].levels[0], None
            address, encoding = level.address, level.encoding
        if encoding == AssetEncoding.OPAQUE:
            return None
        if address not in self._textures:
            if encoding == AssetEncoding.ARRAYS:
                pixels, encoding = decode_image(self._store.get(address), encoding), AssetEncoding.PNG
            data = self._store.get(address) if pixels is None else encode_image(pixels, encoding).data
            image = self._add("images", {"bufferView": self._add_view(data), "mimeType": f"image/{encoding}"})
            self._textures[address] = self._add("textures", {"source": image, "sampler": 0})
        return self._textures[address]


# --- cameras and lights -----------------------------------------------------------------------------------------------


def _build_camera(camera: Camera) -> dict[str, Any]:
    width, height = camera.resolution
    aspect = width / height if (width, height) != (1, 1) and height else _ASPECT
    if camera.focal[0] > 0 and camera.focal[1] > 0:  # pixels need not be square
        aspect *= camera.focal[1] / camera.focal[0]
    if camera.orthographic:
        lens = {"xmag": aspect * camera.fovy / 2, "ymag": camera.fovy / 2, "znear": _NEAR, "zfar": 1_000.0}
        return {"type": "orthographic", "orthographic": lens}
    return {
        "type": "perspective",
        "perspective": {"yfov": math.radians(camera.fovy), "aspectRatio": aspect, "znear": _NEAR},
    }


def _build_light(light: Light) -> dict[str, Any]:
    """Return a light as bright as it is drawn: intensity 1 by default, and its sRGB colour converted to linear."""
    lamp: dict[str, Any] = {
        "type": light.kind,
        "color": to_linear(light.diffuse).tolist(),
        "intensity": light.intensity or 1.0,
    }
    if light.range > 0 and light.kind != LightKind.DIRECTIONAL:
        lamp["range"] = light.range
    if light.kind == LightKind.SPOT:
        lamp["spot"] = {"outerConeAngle": min(max(math.radians(light.cutoff), 1e-3), _WIDEST)}
    return lamp
