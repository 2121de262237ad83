"""glTF and GLB files: nodes with their hierarchy, meshes, looks, lights and cameras.

Skins are drawn as they were modelled, animations and morph targets stand still: `Loaded.skipped` says so.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import IDENTITY
from iris_session.protocol.names import LightKind
from iris_session.protocol.scene import Camera, Light, Rgb
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.gltf_data import KNOWN_EXTENSIONS, GltfData
from iris_session.scene.gltf_looks import Dress, GltfLooks, seen
from iris_session.scene.meshes import MeshArrays, index_corners
from iris_session.scene.parts import MAX_NODES, MAX_TRIANGLES, Loaded, Matrix, Node, Surface, cut
from iris_session.scene.references import References
from iris_session.scene.simplify import unit
from iris_session.scene.surfaces import both_sides, recoloured

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_LIGHTS: Final = {
    "directional": LightKind.DIRECTIONAL,
    "point": LightKind.POINT,
    "spot": LightKind.SPOT,
}
#: What these lists hold is not in the specification.
_STILL: Final = {
    "skins": "skins: drawn as they were modelled, they do not bend",
    "animations": "animations: nothing of the file moves by itself",
}
#: Share of a light's colour that shines on glossy surfaces: MuJoCo's default.
_SPECULAR: Final = 0.3
Floats = NDArray[np.float32]


def read_gltf(path: Path, references: References) -> Loaded:
    """The file. Raises `SceneBuildError`."""
    return _Reader(GltfData(path, references)).loaded()


class _Reader:
    def __init__(self, data: GltfData) -> None:
        self._data = data
        self._skipped: dict[str, None] = {}
        self._looks = GltfLooks(data, self._skipped)
        self._meshes: dict[object, list[Surface]] = {}
        self._triangles = 0

    def loaded(self) -> Loaded:
        document = self._data.json
        for kind, text in _STILL.items():
            if document.get(kind):
                self._skip(f"{len(document[kind])} {text}")
        unknown = {str(name) for name in document.get("extensionsUsed", ())} - KNOWN_EXTENSIONS
        for name in sorted(unknown):
            self._skip(f"extension {name}")
        return Loaded(tuple(self._nodes()), "y", 1.0, tuple(self._skipped))

    def _roots(self) -> list[object]:
        """Nodes at the top of the scene that the file shows."""
        document = self._data.json
        scenes = document.get("scenes", ())
        if not scenes:
            below = {child for node in document.get("nodes", ()) for child in self._children(node)}
            return [index for index in range(len(document.get("nodes", ()))) if index not in below]
        if len(scenes) > 1:
            self._skip(f"{len(scenes) - 1} further scenes of the file")
        return list(self._data.item("scenes", document.get("scene", 0)).get("nodes", ()))

    def _children(self, entry: Any) -> list[int]:
        children = entry.get("children", []) if isinstance(entry, dict) else None
        if not isinstance(children, list) or not all(type(child) is int for child in children):
            raise SceneBuildError(f"{self._data.name}: the children of a node are no list of numbers")
        return children

    def _nodes(self) -> list[Node]:
        """Nodes of the scene, parents first, as deep as they are."""
        found: list[Node] = []
        seen_before: set[object] = set()
        waiting = [(index, -1) for index in reversed(self._roots())]
        while waiting:
            index, parent = waiting.pop()
            entry = self._data.item("nodes", index)
            if index in seen_before or len(found) >= MAX_NODES:
                raise SceneBuildError(
                    f"{self._data.name}: node {index} hangs in two places, or there are over {MAX_NODES}"
                )
            seen_before.add(index)
            above = found[parent].matrix if parent >= 0 else np.eye(4)
            found.append(self._node(entry, index, parent, above))
            waiting += [(child, len(found) - 1) for child in reversed(self._children(entry))]
        return found

    def _node(self, entry: dict[str, Any], index: object, parent: int, above: Matrix) -> Node:
        node = Node(cut(entry.get("name") or f"node_{index}"), parent, above @ self._matrix(entry))
        if "mesh" in entry:
            node.surfaces += self._surfaces(entry["mesh"])
        extensions = entry.get("extensions")
        worn = extensions.get("KHR_lights_punctual") if isinstance(extensions, dict) else None
        if isinstance(worn, dict):
            node.lights.append(self._light(worn.get("light"), node))
        if "camera" in entry:
            camera = self._camera(entry["camera"], node)
            if camera.fovy > 0 and (camera.orthographic or camera.fovy < 180):
                node.cameras.append(camera)
            else:
                self._skip(f"camera {node.name!r}: its angle of view is {camera.fovy:g} degrees")
        return node

    def _matrix(self, entry: dict[str, Any]) -> Matrix:
        """T_parent_node."""
        if "matrix" in entry:
            return np.array(self._looks.numbers(entry["matrix"], 16)).reshape(4, 4).T
        x, y, z, w = self._looks.numbers(entry.get("rotation", (0, 0, 0, 1)), 4)
        matrix = np.eye(4)
        length = math.sqrt(x * x + y * y + z * z + w * w)
        if length < 1e-9:
            raise SceneBuildError(f"{self._data.name}: a node is turned by a quaternion of length 0")
        w, x, y, z = (v / length for v in (w, x, y, z))
        matrix[:3, :3] = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        matrix[:3, :3] *= self._looks.numbers(entry.get("scale", (1, 1, 1)), 3)
        matrix[:3, 3] = self._looks.numbers(entry.get("translation", (0, 0, 0)), 3)
        return matrix

    # --- meshes -------------------------------------------------------------------------------------------------------

    def _surfaces(self, mesh: object) -> list[Surface]:
        """One per primitive; of a mesh that many nodes wear, the same objects."""
        entry = self._data.item("meshes", mesh)
        if mesh not in self._meshes:
            found = []
            primitives = entry.get("primitives", ())
            for number, primitive in enumerate(primitives):
                name = cut(entry.get("name") or f"mesh_{mesh}")
                surface = self._surface(primitive, name if len(primitives) == 1 else f"{name[:500]}_{number}")
                if surface is not None:
                    found.append(surface)
            self._meshes[mesh] = found
        return self._meshes[mesh]

    def _surface(self, primitive: Any, name: str) -> Surface | None:
        attributes = primitive.get("attributes") if isinstance(primitive, dict) else None
        if not isinstance(attributes, dict) or "POSITION" not in attributes:
            raise SceneBuildError(f"{self._data.name}: {name} has no positions")
        if primitive.get("targets"):
            self._skip("morph targets: drawn as without")
        mode = primitive.get("mode", _TRIANGLES)
        if mode not in (_TRIANGLES, _STRIP, _FAN):
            self._skip("points and lines")
            return None
        position = self._data.array(attributes["POSITION"], (3,)).astype(np.float32)
        index = self._index(primitive, mode, len(position))
        if not len(index):
            return None
        if not np.isfinite(position).all():
            raise SceneBuildError(f"{self._data.name}: a vertex of {name} is not finite")
        dress = self._looks.dress(primitive.get("material"))
        mesh = self._mesh(attributes, position, index, dress)
        mesh, rgba = recoloured(mesh, dress.look.rgba)
        look = dress.look if rgba == dress.look.rgba else replace(dress.look, rgba=rgba)
        return Surface(both_sides(mesh) if dress.both_sides else mesh, look, name)

    def _mesh(self, attributes: dict[str, Any], position: Floats, index: NDArray[np.int64], dress: Dress) -> MeshArrays:
        corners = position[index]
        if "NORMAL" in attributes:
            normals = self._of_vertices(attributes["NORMAL"], (3,), len(position)).astype(np.float32)
            length = np.linalg.norm(normals, axis=1)
            off = ~(np.abs(length - 1.0) < 1e-3)
            normals[off] = unit(np.nan_to_num(normals[off]))
            normal = normals[index]
        else:  # flat, as glTF asks for
            flat = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
            normal = np.repeat(flat[:, None], 3, axis=1).astype(np.float32)
        uv = None
        wanted = f"TEXCOORD_{dress.uv_set}"
        if wanted in attributes:
            values = np.nan_to_num(self._of_vertices(attributes[wanted], (2,), len(position)).astype(np.float64))
            if dress.uv_matrix is not None:
                values = values @ dress.uv_matrix[:2, :2].T + dress.uv_matrix[:2, 2]
            uv = values.astype(np.float32)[index]
        color = None
        if "COLOR_0" in attributes:
            color = _bytes(self._of_vertices(attributes["COLOR_0"], (3, 4), len(position)))[index]
            if dress.opaque:
                color[..., 3] = 255
        return index_corners(corners, normal, uv, color)

    def _of_vertices(self, accessor: object, widths: tuple[int, ...], count: int) -> NDArray[Any]:
        values = self._data.array(accessor, widths)
        if len(values) != count:
            raise SceneBuildError(f"{self._data.name}: {len(values)} values for {count} vertices")
        return values

    def _index(self, primitive: dict[str, Any], mode: int, count: int) -> NDArray[np.int64]:
        """Triangles (m, 3), vertex numbers."""
        flat = (
            self._data.array(primitive["indices"], (1,))[:, 0].astype(np.int64)
            if "indices" in primitive
            else np.arange(count)
        )
        if len(flat) and not 0 <= int(flat.min()) <= int(flat.max()) < count:
            raise SceneBuildError(f"{self._data.name}: a triangle names vertex {int(flat.max())} of {count}")
        if mode == _TRIANGLES:
            index = flat[: len(flat) // 3 * 3].reshape(-1, 3)
        elif mode == _FAN:
            index = np.stack([flat[1:-1], flat[2:], np.broadcast_to(flat[:1], flat[2:].shape)], axis=1)
        else:
            index = np.stack([flat[:-2], flat[1:-1], flat[2:]], axis=1)
            index[1::2] = index[1::2, [0, 2, 1]]
        self._triangles += len(index)
        if self._triangles > MAX_TRIANGLES:
            raise SceneBuildError(f"{self._data.name} has more than {MAX_TRIANGLES:,} triangles: make it coarser")
        return index

    # --- lights and cameras -------------------------------------------------------------------------------------------

    def _light(self, index: object, node: Node) -> Light:
        everything = self._data.json.get("extensions", {})
        listed = everything.get("KHR_lights_punctual", {}) if isinstance(everything, dict) else {}
        lights = listed.get("lights", ()) if isinstance(listed, dict) else ()
        if type(index) is not int or not 0 <= index < len(lights) or not isinstance(lights[index], dict):
            raise SceneBuildError(f"{self._data.name} refers to light {index!r}, which it does not have")
        entry = lights[index]
        red, green, blue = (seen(v) for v in self._looks.numbers(entry.get("color", (1, 1, 1)), 3))
        color: Rgb = (red, green, blue)
        kind = _LIGHTS.get(entry.get("type", ""), LightKind.POINT)
        cone = entry.get("spot") if isinstance(entry.get("spot"), dict) else {}
        return Light(
            name=node.name,
            kind=kind,
            body=0,
            p_body=(0.0, 0.0, 0.0),
            direction_body=(0.0, 0.0, -1.0),
            ambient=(0.0, 0.0, 0.0),
            diffuse=color,
            specular=(_SPECULAR * red, _SPECULAR * green, _SPECULAR * blue),
            cutoff=math.degrees(self._looks.number(cone.get("outerConeAngle", math.pi / 4))),
            range=max(0.0, self._looks.number(entry.get("range", 0.0))),
            # of directional lights glTF gives lux, which has no place in the specification
            intensity=0.0
            if kind == LightKind.DIRECTIONAL
            else max(0.0, self._looks.number(entry.get("intensity", 1.0))),
        )

    def _camera(self, index: object, node: Node) -> Camera:
        entry = self._data.item("cameras", index)
        flat = entry.get("type") == "orthographic"
        lens = entry.get("orthographic" if flat else "perspective")
        if not isinstance(lens, dict):
            raise SceneBuildError(f"{self._data.name}: camera {index} has no lens")
        fovy = 2 * self._looks.number(lens.get("ymag", 1.0)) if flat else self._looks.number(lens.get("yfov", 0.8))
        return Camera(
            name=node.name,
            body=0,
            T_body_camera=IDENTITY,
            fovy=fovy if flat else math.degrees(fovy),
            orthographic=flat,
        )

    def _skip(self, text: str) -> None:
        self._skipped[f"{self._data.name}: {text}"] = None


def _bytes(color: NDArray[Any]) -> NDArray[np.uint8]:
    """Linear colours of vertices (n, 3 or 4) as they are seen, in bytes."""
    values = np.clip(np.nan_to_num(color.astype(np.float64)), 0, 1)
    shown = np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)
    if values.shape[1] == 4:
        shown[:, 3] = values[:, 3]
    else:
        shown = np.concatenate([shown, np.ones((len(shown), 1))], axis=1)
    return np.asarray(np.rint(shown * 255), np.uint8)
