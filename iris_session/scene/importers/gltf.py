"""Reader of glTF 2.0 and GLB files: the container, its accessors and images, meshes, materials, lights and cameras.

trimesh is not used for them: it rounds colours to 8 bits, does not read sparse or normalised accessors, and drops
children of cameras. Everything is checked against the bytes that are present, and only `SceneBuildError` is raised.
Factors in glTF are linear and colours in a specification are sRGB, so factors are converted. Images are not.
"""

from __future__ import annotations

import base64
import binascii
import io
import json
import math
import struct
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import IDENTITY
from iris_session.protocol.names import ColorSpace, LightKind, TextureRole
from iris_session.protocol.scene import Camera, Light, Rgb, Rgba
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import PixelBudget, Pixels, drop_alpha, read_pixels
from iris_session.scene.importers.references import References, read_bounded
from iris_session.scene.mesh_processing import add_back_sides, merge_vertex_color, normalise
from iris_session.scene.meshes import MeshArrays, index_corners
from iris_session.scene.nodes import (
    MAX_FILE_BYTES,
    MAX_NODES,
    MAX_TRIANGLES,
    Appearance,
    LoadedFile,
    Matrix,
    Node,
    Surface,
    TextureImage,
    truncate_name,
)

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_LIGHTS: Final = {
    "directional": LightKind.DIRECTIONAL,
    "point": LightKind.POINT,
    "spot": LightKind.SPOT,
}
#: Lists whose content has no counterpart in the specification.
_STILL: Final = {
    "skins": "skins: drawn as they were modelled, without deformation",
    "animations": "animations: nothing of the file moves by itself",
}
#: Share of a light's colour in specular highlights: MuJoCo's default.
_SPECULAR: Final = 0.3
Floats = NDArray[np.float32]
_TYPES: Final = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_BOM: Final = b"\xef\xbb\xbf"
#: Integer types that stand for 0..1 or -1..1 when normalised, and the integer that stands for 1.
_ONE: Final = {"i1": 127.0, "u1": 255.0, "i2": 32_767.0, "u2": 65_535.0}
#: Maximum number of values of an accessor without bytes: a file of a few hundred bytes can request any number.
_MAX_ZEROS: Final = 1 << 24
#: Extensions that are drawn as intended; others are listed as left out, or rejected when the file requires them.
KNOWN_EXTENSIONS: Final = frozenset(
    {
        "KHR_lights_punctual",
        "KHR_materials_emissive_strength",
        "KHR_mesh_quantization",
        "KHR_texture_transform",
        "EXT_texture_webp",
    }
)
_REPEAT: Final = 10497
Doubles = NDArray[np.float64]


def read_gltf(path: Path, references: References) -> LoadedFile:
    """Read a glTF or GLB file. Raises `SceneBuildError`."""
    return _Reader(GltfData(path, references)).loaded()


class _Reader:
    def __init__(self, data: GltfData) -> None:
        self._data = data
        self._skipped: dict[str, None] = {}
        self._materials = GltfMaterials(data, self._skipped)
        self._meshes: dict[object, list[Surface]] = {}
        self._triangles = 0

    def loaded(self) -> LoadedFile:
        document = self._data.json
        for kind, text in _STILL.items():
            if document.get(kind):
                self._skip(f"{len(document[kind])} {text}")
        unknown = {str(name) for name in document.get("extensionsUsed", ())} - KNOWN_EXTENSIONS
        for name in sorted(unknown):
            self._skip(f"extension {name}")
        return LoadedFile(tuple(self._nodes()), "y", 1.0, tuple(self._skipped))

    def _roots(self) -> list[object]:
        """Return the top nodes of the default scene."""
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
        """Return the nodes of the scene, parents first, at any depth."""
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
        node = Node(truncate_name(entry.get("name") or f"node_{index}"), parent, above @ self._matrix(entry))
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
        """Return T_parent_node."""
        if "matrix" in entry:
            return np.array(self._materials.numbers(entry["matrix"], 16)).reshape(4, 4).T
        x, y, z, w = self._materials.numbers(entry.get("rotation", (0, 0, 0, 1)), 4)
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
        matrix[:3, :3] *= self._materials.numbers(entry.get("scale", (1, 1, 1)), 3)
        matrix[:3, 3] = self._materials.numbers(entry.get("translation", (0, 0, 0)), 3)
        return matrix

    # --- meshes -------------------------------------------------------------------------------------------------------

    def _surfaces(self, mesh: object) -> list[Surface]:
        """Return one surface per primitive; nodes that share a mesh get the same objects."""
        entry = self._data.item("meshes", mesh)
        if mesh not in self._meshes:
            found = []
            primitives = entry.get("primitives", ())
            for number, primitive in enumerate(primitives):
                name = truncate_name(entry.get("name") or f"mesh_{mesh}")
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
        used = self._materials.read(primitive.get("material"))
        mesh = self._mesh(attributes, position, index, used)
        mesh, rgba = merge_vertex_color(mesh, used.appearance.rgba)
        look = used.appearance if rgba == used.appearance.rgba else replace(used.appearance, rgba=rgba)
        return Surface(add_back_sides(mesh) if used.both_sides else mesh, look, name)

    def _mesh(
        self, attributes: dict[str, Any], position: Floats, index: NDArray[np.int64], used: PrimitiveMaterial
    ) -> MeshArrays:
        corners = position[index]
        if "NORMAL" in attributes:
            normals = self._of_vertices(attributes["NORMAL"], (3,), len(position)).astype(np.float32)
            length = np.linalg.norm(normals, axis=1)
            off = ~(np.abs(length - 1.0) < 1e-3)
            normals[off] = normalise(np.nan_to_num(normals[off]))
            normal = normals[index]
        else:  # flat, as glTF demands
            flat = normalise(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
            normal = np.repeat(flat[:, None], 3, axis=1).astype(np.float32)
        uv = None
        wanted = f"TEXCOORD_{used.uv_set}"
        if wanted in attributes:
            values = np.nan_to_num(self._of_vertices(attributes[wanted], (2,), len(position)).astype(np.float64))
            if used.uv_matrix is not None:
                values = values @ used.uv_matrix[:2, :2].T + used.uv_matrix[:2, 2]
            uv = values.astype(np.float32)[index]
        color = None
        if "COLOR_0" in attributes:
            color = _bytes(self._of_vertices(attributes["COLOR_0"], (3, 4), len(position)))[index]
            if used.opaque:
                color[..., 3] = 255
        return index_corners(corners, normal, uv, color)

    def _of_vertices(self, accessor: object, widths: tuple[int, ...], count: int) -> NDArray[Any]:
        values = self._data.array(accessor, widths)
        if len(values) != count:
            raise SceneBuildError(f"{self._data.name}: {len(values)} values for {count} vertices")
        return values

    def _index(self, primitive: dict[str, Any], mode: int, count: int) -> NDArray[np.int64]:
        """Return the triangles (m, 3) of a primitive, as vertex numbers."""
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
        red, green, blue = (linear_to_srgb(v) for v in self._materials.numbers(entry.get("color", (1, 1, 1)), 3))
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
            cutoff=math.degrees(self._materials.number(cone.get("outerConeAngle", math.pi / 4))),
            range=max(0.0, self._materials.number(entry.get("range", 0.0))),
            # glTF gives directional lights in lux, which the specification cannot express
            intensity=0.0
            if kind == LightKind.DIRECTIONAL
            else max(0.0, self._materials.number(entry.get("intensity", 1.0))),
        )

    def _camera(self, index: object, node: Node) -> Camera:
        entry = self._data.item("cameras", index)
        flat = entry.get("type") == "orthographic"
        lens = entry.get("orthographic" if flat else "perspective")
        if not isinstance(lens, dict):
            raise SceneBuildError(f"{self._data.name}: camera {index} has no lens")
        fovy = (
            2 * self._materials.number(lens.get("ymag", 1.0)) if flat else self._materials.number(lens.get("yfov", 0.8))
        )
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
    """Convert linear vertex colours (n, 3 or 4) to sRGB in bytes, as `linear_to_srgb`."""
    values = np.clip(np.nan_to_num(color.astype(np.float64)), 0, 1)
    shown = np.where(values <= 0.0031308, values * 12.92, 1.055 * values ** (1 / 2.4) - 0.055)
    if values.shape[1] == 4:
        shown[:, 3] = values[:, 3]
    else:
        shown = np.concatenate([shown, np.ones((len(shown), 1))], axis=1)
    return np.asarray(np.rint(shown * 255), np.uint8)


# --- container --------------------------------------------------------------------------------------------------------


class GltfData:
    """Document (`json`) of a glTF 2.0 file with its buffers. Raises `SceneBuildError` for other files."""

    def __init__(self, path: Path, references: References) -> None:
        self.name = path.name
        self._references = references
        data = read_bounded(path)
        if path.suffix.lower() == ".glb" and not data.startswith((b"glTF", b"{", _BOM)):
            raise SceneBuildError(
                f"{self.name} is no GLB: it begins with {data[:4]!r} where b'glTF' is needed; export it as glTF binary"
            )
        text, self._chunk = _glb(data, path.name) if data[:4] == b"glTF" else (data, None)
        try:
            self.json: dict[str, Any] = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise SceneBuildError(f"{self.name} is no glTF, or cut: its document is no JSON: {error}") from None
        if not isinstance(self.json, dict) or not str(self._version()).startswith("2."):
            raise SceneBuildError(f"{self.name} is no glTF 2.0: export it again as that")
        unknown = sorted(set(map(str, self.json.get("extensionsRequired", ()))) - KNOWN_EXTENSIONS)
        if unknown:
            raise SceneBuildError(
                f"{self.name} requires {', '.join(unknown)}: export it without (of meshes: uncompressed)"
            )
        self._buffers: dict[int, bytes] = {}
        self._read = len(data)

    def item(self, kind: str, index: object) -> dict[str, Any]:
        """Return entry `index` of the list `kind`."""
        entries = self.json.get(kind, ())
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            raise SceneBuildError(f"{self.name} refers to {kind} {index!r}, which it does not have")
        entry = entries[index]
        if not isinstance(entry, dict):
            raise SceneBuildError(f"{self.name}: entry {index} of {kind} is no map")
        return entry

    def array(self, accessor: object, widths: tuple[int, ...]) -> NDArray[Any]:
        """Return an accessor (count, width): as floats where it is normalised, otherwise in its own type."""
        entry = self.item("accessors", accessor)
        dtype, width = np.dtype(_TYPES.get(entry.get("componentType", 0), "V1")), _WIDTHS.get(entry.get("type", ""), 0)
        count = entry.get("count")
        if dtype.kind == "V" or width not in widths or type(count) is not int or count < 0:
            needed = " or ".join(name for name, n in _WIDTHS.items() if n in widths)
            given = f"{entry.get('type')!r} of componentType {entry.get('componentType')!r}, count {count!r}"
            raise SceneBuildError(f"{self.name}: accessor {accessor}: expected {needed}, got {given}")
        if "bufferView" in entry:
            values = self._view_array(entry["bufferView"], entry.get("byteOffset", 0), dtype, count, width)
        elif count * width > _MAX_ZEROS:
            raise SceneBuildError(f"{self.name}: accessor {accessor} has {count} entries without bytes")
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in entry:
            values = self._sparse(entry["sparse"], values)
        if entry.get("normalized"):
            values = np.maximum(values / _ONE.get(dtype.str[1:], 1.0), -1.0)
        return values

    def picture_bytes(self, image: object) -> bytes:
        """Return the encoded bytes of an image."""
        entry = self.item("images", image)
        if "bufferView" in entry:
            return bytes(self._view(entry["bufferView"])[0])
        return self._uri(entry.get("uri"))

    # --- inside -------------------------------------------------------------------------------------------------------

    def _version(self) -> object:
        asset = self.json.get("asset")
        return asset.get("version", "") if isinstance(asset, dict) else ""

    def _sparse(self, sparse: Any, values: NDArray[Any]) -> NDArray[Any]:
        if not isinstance(sparse, dict):
            raise SceneBuildError(f"{self.name}: a sparse accessor is no map")
        count, where, what = (sparse.get(key) for key in ("count", "indices", "values"))
        if type(count) is not int or count < 0 or not isinstance(where, dict) or not isinstance(what, dict):
            raise SceneBuildError(f"{self.name}: a sparse accessor lacks count, indices or values")
        places_type = np.dtype(_TYPES.get(where.get("componentType", 0), "V1"))
        if places_type.kind != "u":
            raise SceneBuildError(f"{self.name}: places of a sparse accessor are no whole numbers")
        places = self._view_array(where.get("bufferView"), where.get("byteOffset", 0), places_type, count, 1)[:, 0]
        if count and int(places.max()) >= len(values):
            raise SceneBuildError(f"{self.name}: a sparse accessor names entry {int(places.max())} of {len(values)}")
        changed = values.copy()
        changed[places] = self._view_array(
            what.get("bufferView"), what.get("byteOffset", 0), values.dtype, count, values.shape[1]
        )
        return changed

    def _view_array(self, view: object, offset: object, dtype: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        data, stride = self._view(view)
        row = dtype.itemsize * width
        step = stride or row
        if type(offset) is not int or offset < 0 or step < row:
            raise SceneBuildError(f"{self.name}: a place in bufferViews {view} is none")
        if count and offset + (count - 1) * step + row > len(data):
            raise SceneBuildError(f"{self.name}: {count} entries lie beyond the end of bufferViews {view}: it is cut")
        if not count:
            return np.zeros((0, width), dtype)
        return np.ndarray((count, width), dtype, data, offset, (step, dtype.itemsize)).copy()

    def _view(self, index: object) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view, and its stride, 0 when it has none."""
        entry = self.item("bufferViews", index)
        start, length, stride = (entry.get(key, 0) for key in ("byteOffset", "byteLength", "byteStride"))
        whole = self._buffer(entry.get("buffer"))
        if not all(type(n) is int and n >= 0 for n in (start, length, stride)) or start + length > len(whole):
            raise SceneBuildError(f"{self.name}: bufferViews {index} reaches beyond its buffer: the file is cut")
        return memoryview(whole)[start : start + length], stride

    def _buffer(self, index: object) -> bytes:
        entry = self.item("buffers", index)
        assert isinstance(index, int)
        if index not in self._buffers:
            inside = index == 0 and "uri" not in entry and self._chunk is not None
            self._buffers[index] = self._chunk if inside and self._chunk is not None else self._uri(entry.get("uri"))
        return self._buffers[index]

    def _uri(self, uri: object) -> bytes:
        """Return the bytes behind a URI; the total per file is bounded."""
        if not isinstance(uri, str):
            raise SceneBuildError(f"{self.name}: a buffer or image says nowhere where its bytes are")
        if uri.startswith("data:"):
            head, _, body = uri.partition(",")
            try:
                data = base64.b64decode(body, validate=True) if head.endswith(";base64") else b""
            except (binascii.Error, ValueError) as error:
                raise SceneBuildError(f"{self.name}: bytes in a data: address are damaged: {error}") from None
        else:
            data = read_bounded(self._references.find(uri))
        self._read += len(data)
        if self._read > 2 * MAX_FILE_BYTES:
            raise SceneBuildError(f"{self.name} draws in more than {2 * MAX_FILE_BYTES >> 20} MiB: make it smaller")
        return data


def _glb(data: bytes, name: str) -> tuple[bytes, bytes | None]:
    """Return the JSON and the binary chunk of a GLB."""
    stream = io.BytesIO(data)
    _, version, length = struct.unpack("<4sII", stream.read(12).ljust(12, b"\0"))
    if version != 2 or length > len(data):
        raise SceneBuildError(f"{name} is a GLB of version {version} with {len(data)} bytes of {length}: it is cut")
    found: dict[bytes, bytes] = {}
    while len(head := stream.read(8)) == 8:
        size, kind = struct.unpack("<I4s", head)
        body = stream.read(size)
        if len(body) != size:
            raise SceneBuildError(f"{name} is cut: a part of {size} bytes has {len(body)}")
        found.setdefault(kind, body)
    if b"JSON" not in found:
        raise SceneBuildError(f"{name} is a GLB without a document")
    return found[b"JSON"], found.get(b"BIN\0")


# --- materials and textures -------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class PrimitiveMaterial:
    """Appearance of a primitive, and the texture coordinates that it uses.

    `uv_set`: number of the set, -1 without textures; transformed by `uv_matrix` (3, 3) unless that is `None`. `opaque`:
    alpha is ignored.
    """

    appearance: Appearance
    both_sides: bool = False
    uv_set: int = -1
    uv_matrix: Doubles | None = None
    opaque: bool = True


class GltfMaterials:
    """Reader of materials by index; features that have no counterpart are added to `skipped`."""

    def __init__(self, data: GltfData, skipped: dict[str, None]) -> None:
        self._data = data
        self._skipped = skipped
        self._uses: dict[object, PrimitiveMaterial] = {}
        self._pictures: dict[tuple[object, ...], TextureImage] = {}
        self._budget = PixelBudget(data.name)

    def read(self, material: object) -> PrimitiveMaterial:
        """Return the material of a primitive; without one the default of glTF, white and rough."""
        entry = {} if material is None else self._data.item("materials", material)
        if material not in self._uses:
            self._uses[material] = self._read_material(entry)
        return self._uses[material]

    def _read_material(self, entry: dict[str, Any]) -> PrimitiveMaterial:
        pbr = _map(entry.get("pbrMetallicRoughness"))
        factor = self.numbers(pbr.get("baseColorFactor", (1, 1, 1, 1)), 4)
        mode = entry.get("alphaMode", "OPAQUE")
        alpha = 1.0 if mode == "OPAQUE" else factor[3]
        red, green, blue = (linear_to_srgb(v) for v in factor[:3])
        rgba: Rgba = (red, green, blue, min(max(alpha, 0.0), 1.0))
        roughness = self.number(pbr.get("roughnessFactor", 1.0))
        rgba, emission = self._emission(entry, rgba)
        uses: list[tuple[dict[str, Any], str, TextureImage]] = []
        base, cutoff = _map(pbr.get("baseColorTexture")), self.number(entry.get("alphaCutoff", 0.5))
        if base:
            picture = self._picture(base, f"{mode} {cutoff}", lambda pixels: _alpha(pixels, mode, cutoff))
            if picture is not None:
                role = TextureRole.RGBA if picture.pixels.shape[2] == 4 else TextureRole.RGB
                uses.append((base, role, picture))
        uses += self._others(entry, pbr)
        look = Appearance(
            rgba=rgba,
            name=truncate_name(entry.get("name", "")),
            emission=emission,
            specular=0.5 * (1.0 - min(max(roughness, 0.0), 1.0)),
            shininess=1.0 - min(max(roughness, 0.0), 1.0),
            metallic=min(max(self.number(pbr.get("metallicFactor", 1.0)), 0.0), 1.0),
            roughness=min(max(roughness, 0.0), 1.0),
            images=tuple((role, picture) for _, role, picture in uses),
        )
        uv_set, uv_matrix = self._mapping([use for use, _, _ in uses])
        return PrimitiveMaterial(look, bool(entry.get("doubleSided", False)), uv_set, uv_matrix, mode == "OPAQUE")

    def _emission(self, entry: dict[str, Any], rgba: Rgba) -> tuple[Rgba, float]:
        """Return colour and strength of emission.

        In the specification a material emits its own colour; a black material takes the emitted colour as its own.
        """
        strength = _map(_map(entry.get("extensions")).get("KHR_materials_emissive_strength"))
        factor = np.array([linear_to_srgb(v) for v in self.numbers(entry.get("emissiveFactor", (0, 0, 0)), 3)])
        glow = factor * self.number(strength.get("emissiveStrength", 1.0))
        if not glow.any():
            return rgba, 0.0
        own = np.array(rgba[:3])
        if own.max() < 0.01:  # a black material that emits light takes the emitted colour
            red, green, blue = (glow / max(1.0, glow.max())).tolist()
            return (red, green, blue, rgba[3]), float(max(1.0, glow.max()))
        emission = float(glow @ own / (own @ own))
        if np.abs(glow - emission * own).max() > 0.02 * glow.max():
            self._skip(f"the colour in which material {entry.get('name', '')!r} glows: it glows in its own")
        return rgba, emission

    def _others(self, entry: dict[str, Any], pbr: dict[str, Any]) -> list[tuple[dict[str, Any], str, TextureImage]]:
        """Return the textures other than colour."""
        found = []
        rough, shade = _map(pbr.get("metallicRoughnessTexture")), _map(entry.get("occlusionTexture"))
        packed = bool(rough) and rough.get("index") == shade.get("index")
        for use, role, change in (
            (rough, TextureRole.ORM, None if packed else _no_occlusion),
            ({} if packed else shade, TextureRole.OCCLUSION, None),
            (_map(entry.get("normalTexture")), TextureRole.NORMAL, None),
            (_map(entry.get("emissiveTexture")), TextureRole.EMISSIVE, None),
        ):
            space = ColorSpace.AUTO if role == TextureRole.EMISSIVE else ColorSpace.LINEAR
            picture = self._picture(use, role, change, space) if use else None
            if picture is not None:
                found.append((use, role, picture))
        return found

    def _picture(self, use: dict[str, Any], key: str, change: Any, space: str = ColorSpace.AUTO) -> TextureImage | None:
        """Return the texture that `use` names, converted by `change`; `None`, with a note, in an unknown format."""
        texture = self._data.item("textures", use.get("index"))
        webp = _map(_map(texture.get("extensions")).get("EXT_texture_webp"))
        source = webp.get("source", texture.get("source"))
        if source is None:
            self._skip("textures in a compressed form (KTX2): export them as PNG, JPEG or WebP")
            return None
        if "sampler" in texture:
            sampler = self._data.item("samplers", texture["sampler"])
            if {sampler.get("wrapS", _REPEAT), sampler.get("wrapT", _REPEAT)} != {_REPEAT}:
                self._skip("textures that are not repeated beyond their borders: they are")
        image = self._data.item("images", source)
        kept = (source, key, space)
        if kept not in self._pictures:
            name = truncate_name(image.get("name") or texture.get("name") or "")
            pixels = read_pixels(self._data.picture_bytes(source), f"image {source} of {self._data.name}")
            self._budget.spend(pixels)
            self._pictures[kept] = TextureImage(pixels if change is None else change(pixels), name, colorspace=space)
        return self._pictures[kept]

    def _mapping(self, uses: list[dict[str, Any]]) -> tuple[int, Doubles | None]:
        """Return texture coordinates: those of the first texture, the colour where there is one."""
        ways = []
        for use in uses:
            turn = _map(_map(use.get("extensions")).get("KHR_texture_transform"))
            x, y = self.numbers(turn.get("offset", (0, 0)), 2)
            a, b = self.numbers(turn.get("scale", (1, 1)), 2)
            angle = self.number(turn.get("rotation", 0.0))
            uv_set = turn.get("texCoord", use.get("texCoord", 0))
            if type(uv_set) is not int or not 0 <= uv_set < 16:
                raise SceneBuildError(f"{self._data.name}: texture coordinates number {uv_set!r}")
            ways.append((uv_set, x, y, a, b, angle))
        if not ways:
            return -1, None
        if len(set(ways)) > 1:
            self._skip("a second set of texture coordinates on one material: all its textures take the first one's")
        uv_set, x, y, a, b, angle = ways[0]
        if (x, y, a, b, angle) == (0, 0, 1, 1, 0):
            return uv_set, None
        c, s = np.cos(angle), np.sin(angle)
        return uv_set, np.array([[c * a, s * b, x], [-s * a, c * b, y], [0, 0, 1]])

    def number(self, value: object) -> float:
        """Return a finite number. Raises `SceneBuildError`."""
        if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
            raise SceneBuildError(f"{self._data.name}: {value!r} stands where a finite number is needed")
        return float(value)

    def numbers(self, values: object, count: int) -> list[float]:
        """Return `count` finite numbers. Raises `SceneBuildError`."""
        if not isinstance(values, list | tuple) or len(values) != count:
            raise SceneBuildError(f"{self._data.name}: {count} numbers are needed, not {str(values)[:80]}")
        return [self.number(value) for value in values]

    def _skip(self, text: str) -> None:
        self._skipped[f"{self._data.name}: {text}"] = None


def _alpha(pixels: Pixels, mode: object, cutoff: float) -> Pixels:
    """Apply the alpha mode of the material: opaque, masked, or blended."""
    if mode == "OPAQUE":
        return drop_alpha(pixels, always=True)
    if mode == "MASK" and pixels.shape[2] == 4:
        pixels = pixels.copy()
        pixels[:, :, 3] = np.where(pixels[:, :, 3] >= cutoff * 255, 255, 0)
    return pixels


def _no_occlusion(pixels: Pixels) -> Pixels:
    """Return roughness and metallic in green and blue, with occlusion in red set to none."""
    packed = np.full((*pixels.shape[:2], 3), 255, np.uint8)
    packed[:, :, 1:] = pixels[:, :, 1:3] if pixels.shape[2] >= 3 else pixels[:, :, :1]
    return packed


def _map(value: object) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def linear_to_srgb(value: float) -> float:
    """Convert a linear factor of glTF to sRGB."""
    v = min(max(float(value), 0.0), 1.0)
    if v >= 1.0:
        return 1.0  # the formula is off by one bit there
    return v * 12.92 if v <= 0.0031308 else 1.055 * v ** (1 / 2.4) - 0.055
