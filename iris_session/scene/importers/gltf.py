"""Reader of glTF 2.0 and GLB files into nodes: meshes, materials, lights and cameras.

Factors in glTF are linear and colours in a specification are sRGB, so factors are converted. Images are not.

Numbers are finite, and indices and sizes are checked against what is present; other values of a wrong type make the
reader fail, which `files.read_guarded` reports. trimesh would lose what is read here: colours of more than 8 bits,
sparse and normalised accessors, lights, second sets of texture coordinates, children of cameras.
"""

from __future__ import annotations

import base64
import binascii
import codecs
import io
import json
import math
import struct
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.names import ColorSpace, LightKind, TextureRole
from iris_session.protocol.scene import Camera, Light, Rgba
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import PixelBudget, Pixels, drop_alpha, read_pixels, to_srgb
from iris_session.scene.importers.references import References, read_bounded
from iris_session.scene.meshes import MeshArrays, add_back_sides, index_corners, merge_vertex_color, normalise
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
    color_images,
    to_matrix,
    to_vec3,
    truncate_name,
)

_TRIANGLES, _STRIP, _FAN = 4, 5, 6
_REPEAT: Final = 10497
_LIGHT_EXTENSION: Final = "KHR_lights_punctual"
_LIGHTS: Final = (LightKind.DIRECTIONAL, LightKind.POINT, LightKind.SPOT)
#: Share of a light's colour in specular highlights: MuJoCo's default.
_SPECULAR: Final = 0.3
#: Textures of a primitive: uses, roles and images.
_Uses = list[tuple[dict[str, Any], str, TextureImage]]
_DTYPES: Final = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS: Final = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
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


def read_gltf(path: Path, references: References) -> LoadedFile:
    """Read a glTF or GLB file. Raises `SceneBuildError`."""
    return _Reader(GltfFile(path, references)).read()


@dataclass(frozen=True, eq=False)
class _PrimitiveMaterial:
    """Appearance of a primitive, and the texture coordinates that it uses.

    `uv_set`: number of the set, -1 without textures; transformed by `uv_matrix` (3, 3) unless that is `None`. `opaque`:
    alpha is ignored.
    """

    appearance: Appearance
    both_sides: bool
    uv_set: int
    uv_matrix: NDArray[np.float64] | None
    opaque: bool


class _Reader:
    def __init__(self, file: GltfFile) -> None:
        self._file = file
        self._document = file.document
        self._skipped: dict[str, None] = {}
        self._meshes: dict[object, list[Surface]] = {}
        self._materials: dict[object, _PrimitiveMaterial] = {}
        self._images: dict[tuple[object, str, str], TextureImage] = {}
        self._budget = PixelBudget(file.name)
        self._triangles = 0

    def read(self) -> LoadedFile:
        document = self._document
        if skins := document.get("skins"):
            self._skip(f"{len(skins)} skins: drawn as they were modelled, without deformation")
        if animations := document.get("animations"):
            self._skip(f"{len(animations)} animations: nothing of the file moves by itself")
        for name in sorted(set(document.get("extensionsUsed", ())) - KNOWN_EXTENSIONS):
            self._skip(f"extension {name}")
        return LoadedFile(tuple(self._read_nodes()), "y", 1.0, tuple(self._skipped))

    def _read_nodes(self) -> list[Node]:
        """Return the nodes of the default scene, parents first, at any depth."""
        nodes, scenes = (self._document.get(kind, []) for kind in ("nodes", "scenes"))
        if scenes:
            roots = self._file.get("scenes", self._document.get("scene", 0)).get("nodes", [])
        else:
            below = {child for node in nodes for child in node.get("children", [])}
            roots = [index for index in range(len(nodes)) if index not in below]
        if len(scenes) > 1:
            self._skip(f"{len(scenes) - 1} further scenes of the file")
        found: list[Node] = []
        seen_before: set[int] = set()
        waiting = [(index, -1) for index in reversed(roots)]
        while waiting:
            index, parent = waiting.pop()
            entry = self._file.get("nodes", index)
            if index in seen_before or len(found) >= MAX_NODES:
                raise SceneBuildError(
                    f"{self._file.name}: node {index} hangs in two places, or there are over {MAX_NODES}"
                )
            seen_before.add(index)
            above = found[parent].matrix if parent >= 0 else np.eye(4)
            found.append(self._read_node(entry, index, parent, above))
            waiting += [(child, len(found) - 1) for child in reversed(entry.get("children", []))]
        return found

    def _read_node(self, entry: dict[str, Any], index: object, parent: int, above: Matrix) -> Node:
        node = Node(truncate_name(entry.get("name") or f"node_{index}"), parent, above @ self._node_matrix(entry))
        if "mesh" in entry:
            node.surfaces += self._read_mesh(entry["mesh"])
        if light := get_extension(entry, _LIGHT_EXTENSION):
            lights = get_extension(self._document, _LIGHT_EXTENSION).get("lights", [])
            node.lights.append(_to_light(lights[light["light"]], node.name))
        if "camera" in entry:
            camera = _to_camera(self._file.get("cameras", entry["camera"]), node.name)
            if camera.fovy > 0 and (camera.orthographic or camera.fovy < 180):
                node.cameras.append(camera)
            else:
                self._skip(f"camera {node.name!r}: its angle of view is {camera.fovy:g} degrees")
        return node

    def _node_matrix(self, entry: dict[str, Any]) -> Matrix:
        """Return T_parent_node."""
        if "matrix" in entry:
            return np.array(entry["matrix"], np.float64).reshape(4, 4).T
        x, y, z, w = entry.get("rotation", (0.0, 0.0, 0.0, 1.0))
        length = math.hypot(x, y, z, w)
        if length < 1e-9:
            raise SceneBuildError(f"{self._file.name}: a node is turned by a quaternion of length 0")
        T = to_matrix(
            Pose(to_vec3(entry.get("translation", (0.0, 0.0, 0.0))), (w / length, x / length, y / length, z / length))
        )
        return T @ np.diag([*to_vec3(entry.get("scale", (1.0, 1.0, 1.0))), 1.0])

    def _skip(self, text: str) -> None:
        self._skipped[f"{self._file.name}: {text}"] = None

    # --- meshes -------------------------------------------------------------------------------------------------------

    def _read_mesh(self, mesh: object) -> list[Surface]:
        """Return one surface per primitive; nodes that share a mesh get the same objects."""
        entry = self._file.get("meshes", mesh)
        if mesh not in self._meshes:
            name, primitives = truncate_name(entry.get("name") or f"mesh_{mesh}"), entry["primitives"]
            names = [f"{name[:500]}_{k}" for k in range(len(primitives))] if len(primitives) > 1 else [name]
            surfaces = map(self._read_surface, primitives, names)
            self._meshes[mesh] = [surface for surface in surfaces if surface is not None]
        return self._meshes[mesh]

    def _read_surface(self, primitive: dict[str, Any], name: str) -> Surface | None:
        attributes, mode = primitive.get("attributes", {}), primitive.get("mode", _TRIANGLES)
        if "POSITION" not in attributes:
            raise SceneBuildError(f"{self._file.name}: {name} has no positions")
        if primitive.get("targets"):
            self._skip("morph targets: drawn as without")
        if mode not in (_TRIANGLES, _STRIP, _FAN):
            self._skip("points and lines")
            return None
        position = self._file.read_accessor(attributes["POSITION"], (3,)).astype(np.float32)
        index = self._read_triangles(primitive.get("indices"), mode, len(position))
        if not len(index):
            return None
        if not np.isfinite(position).all():
            raise SceneBuildError(f"{self._file.name}: a vertex of {name} is not finite")
        material = self._read_material(primitive.get("material"))
        mesh = self._read_corners(attributes, position, index, material)
        mesh, rgba = merge_vertex_color(mesh, material.appearance.rgba)
        appearance = replace(material.appearance, rgba=rgba)
        return Surface(add_back_sides(mesh) if material.both_sides else mesh, appearance, name)

    def _read_triangles(self, indices: object, mode: int, count: int) -> NDArray[np.int64]:
        """Return the triangles (m, 3) of a primitive, as vertex numbers."""
        flat = np.arange(count) if indices is None else self._file.read_accessor(indices, (1,))[:, 0].astype(np.int64)
        if len(flat) and not 0 <= int(flat.min()) <= int(flat.max()) < count:
            raise SceneBuildError(f"{self._file.name}: a triangle names vertex {int(flat.max())} of {count}")
        if mode == _TRIANGLES:
            index = flat[: len(flat) // 3 * 3].reshape(-1, 3)
        elif mode == _FAN:
            index = np.stack([flat[1:-1], flat[2:], np.broadcast_to(flat[:1], flat[2:].shape)], axis=1)
        else:
            index = np.stack([flat[:-2], flat[1:-1], flat[2:]], axis=1)
            index[1::2] = index[1::2, [0, 2, 1]]
        self._triangles += len(index)
        if self._triangles > MAX_TRIANGLES:
            raise SceneBuildError(f"{self._file.name} has more than {MAX_TRIANGLES:,} triangles: make it coarser")
        return index

    def _read_corners(
        self,
        attributes: dict[str, Any],
        position: NDArray[np.float32],
        index: NDArray[np.int64],
        material: _PrimitiveMaterial,
    ) -> MeshArrays:
        """Return the corners of triangles with their normals, texture coordinates and colours."""
        corners, count, read = position[index], len(position), self._file.read_accessor
        if "NORMAL" in attributes:
            normals = read(attributes["NORMAL"], (3,), count).astype(np.float32)
            off = ~(np.abs(np.linalg.norm(normals, axis=1) - 1.0) < 1e-3)
            normals[off] = normalise(np.nan_to_num(normals[off]))
            normal = normals[index]
        else:  # flat, as glTF demands
            flat = normalise(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
            normal = np.repeat(flat[:, None], 3, axis=1).astype(np.float32)
        uv = color = None
        if (uv_name := f"TEXCOORD_{material.uv_set}") in attributes:
            values = np.nan_to_num(read(attributes[uv_name], (2,), count).astype(np.float64))
            if material.uv_matrix is not None:
                values = values @ material.uv_matrix[:2, :2].T + material.uv_matrix[:2, 2]
            uv = values.astype(np.float32)[index]
        if "COLOR_0" in attributes:
            color = _to_bytes(read(attributes["COLOR_0"], (3, 4), count))[index]
            if material.opaque:
                color[..., 3] = 255
        return index_corners(corners, normal, uv, color)

    # --- materials and textures ---------------------------------------------------------------------------------------

    def _read_material(self, index: object) -> _PrimitiveMaterial:
        """Return the material of a primitive; without one the default of glTF, white and rough."""
        if index not in self._materials:
            entry = {} if index is None else self._file.get("materials", index)
            self._materials[index] = self._to_material(entry)
        return self._materials[index]

    def _to_material(self, entry: dict[str, Any]) -> _PrimitiveMaterial:
        pbr, mode = entry.get("pbrMetallicRoughness", {}), entry.get("alphaMode", "OPAQUE")
        cutoff = float(entry.get("alphaCutoff", 0.5))
        *factors, alpha = pbr.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0))
        red, green, blue = to_srgb(factors).tolist()
        rgba, emission = self._emission(entry, (red, green, blue, 1.0 if mode == "OPAQUE" else _clamp(alpha)))
        uses: _Uses = []
        if base := pbr.get("baseColorTexture"):
            image = self._read_texture(base, f"{mode} {cutoff}", lambda pixels: _apply_alpha(pixels, mode, cutoff))
            uses += [(base, role, image) for role, image in (color_images(image) if image is not None else ())]
        uses += self._read_other_textures(entry)
        roughness = _clamp(pbr.get("roughnessFactor", 1.0))
        appearance = Appearance(
            rgba=rgba,
            name=truncate_name(entry.get("name")),
            emission=emission,
            specular=0.5 * (1.0 - roughness),
            shininess=1.0 - roughness,
            metallic=_clamp(pbr.get("metallicFactor", 1.0)),
            roughness=roughness,
            images=tuple((role, image) for _, role, image in uses),
        )
        uv_set, uv_matrix = self._read_mapping([use for use, _, _ in uses])
        return _PrimitiveMaterial(appearance, bool(entry.get("doubleSided")), uv_set, uv_matrix, mode == "OPAQUE")

    def _emission(self, entry: dict[str, Any], rgba: Rgba) -> tuple[Rgba, float]:
        """Return colour and strength of emission.

        In the specification a material emits its own colour; a black material takes the emitted colour as its own.
        """
        strength = get_extension(entry, "KHR_materials_emissive_strength").get("emissiveStrength", 1.0)
        glow = float(strength) * to_srgb(entry.get("emissiveFactor", (0.0, 0.0, 0.0)))
        if not glow.any():
            return rgba, 0.0
        own = np.array(rgba[:3])
        if own.max() < 0.01:
            red, green, blue = (glow / max(1.0, glow.max())).tolist()
            return (red, green, blue, rgba[3]), float(max(1.0, glow.max()))
        emission = float(glow @ own / (own @ own))
        if np.abs(glow - emission * own).max() > 0.02 * glow.max():
            self._skip(f"the colour in which material {entry.get('name', '')!r} glows: it glows in its own")
        return rgba, emission

    def _read_other_textures(self, entry: dict[str, Any]) -> _Uses:
        """Return the textures other than colour."""
        rough: dict[str, Any] = entry.get("pbrMetallicRoughness", {}).get("metallicRoughnessTexture", {})
        shade: dict[str, Any] = entry.get("occlusionTexture", {})
        packed = bool(rough) and rough["index"] == shade.get("index")
        found = []
        for use, role, change in (
            (rough, TextureRole.ORM, None if packed else _drop_occlusion),
            ({} if packed else shade, TextureRole.OCCLUSION, None),
            (entry.get("normalTexture"), TextureRole.NORMAL, None),
            (entry.get("emissiveTexture"), TextureRole.EMISSIVE, None),
        ):
            space = ColorSpace.AUTO if role == TextureRole.EMISSIVE else ColorSpace.LINEAR
            image = self._read_texture(use, role, change, space) if use else None
            if use and image is not None:
                found.append((use, role, image))
        return found

    def _read_texture(
        self,
        use: dict[str, Any],
        key: str,
        change: Callable[[Pixels], Pixels] | None,
        space: str = ColorSpace.AUTO,
    ) -> TextureImage | None:
        """Return the texture that `use` names, converted by `change`; `None`, with a note, in an unknown format."""
        texture = self._file.get("textures", use["index"])
        source = get_extension(texture, "EXT_texture_webp").get("source", texture.get("source"))
        if source is None:
            self._skip("textures in a compressed form (KTX2): export them as PNG, JPEG or WebP")
            return None
        sampler = self._file.get("samplers", texture["sampler"]) if "sampler" in texture else {}
        if {sampler.get("wrapS", _REPEAT), sampler.get("wrapT", _REPEAT)} != {_REPEAT}:
            self._skip("textures that are not repeated beyond their borders: they are")
        if (source, key, space) not in self._images:
            pixels = read_pixels(self._file.read_image(source), f"image {source} of {self._file.name}")
            self._budget.spend(pixels)
            changed = pixels if change is None else change(pixels)
            name = truncate_name(self._file.get("images", source).get("name") or texture.get("name"))
            self._images[source, key, space] = TextureImage(changed, name, colorspace=space)
        return self._images[source, key, space]

    def _read_mapping(self, uses: list[dict[str, Any]]) -> tuple[int, NDArray[np.float64] | None]:
        """Return texture coordinates: those of the first texture, the colour where there is one."""
        mappings = []
        for use in uses:
            transform = get_extension(use, "KHR_texture_transform")
            uv_set = int(transform.get("texCoord", use.get("texCoord", 0)))
            (x, y), (a, b) = transform.get("offset", (0.0, 0.0)), transform.get("scale", (1.0, 1.0))
            mappings.append((uv_set, x, y, a, b, transform.get("rotation", 0.0)))
        if not mappings:
            return -1, None
        if len(set(mappings)) > 1:
            self._skip("a second set of texture coordinates on one material: all its textures take the first one's")
        uv_set, x, y, a, b, angle = mappings[0]
        if (x, y, a, b, angle) == (0, 0, 1, 1, 0):
            return uv_set, None
        c, s = np.cos(angle), np.sin(angle)
        return uv_set, np.array([[c * a, s * b, x], [-s * a, c * b, y], [0, 0, 1]])


def _to_light(entry: dict[str, Any], name: str) -> Light:
    red, green, blue = to_srgb(entry.get("color", (1.0, 1.0, 1.0))).tolist()
    kind = entry["type"] if entry.get("type") in _LIGHTS else LightKind.POINT
    return Light(
        name=name,
        kind=kind,
        body=0,
        p_body=(0.0, 0.0, 0.0),
        direction_body=(0.0, 0.0, -1.0),
        ambient=(0.0, 0.0, 0.0),
        diffuse=(red, green, blue),
        specular=(_SPECULAR * red, _SPECULAR * green, _SPECULAR * blue),
        cutoff=math.degrees(entry.get("spot", {}).get("outerConeAngle", math.pi / 4)),
        range=max(0.0, float(entry.get("range", 0.0))),
        # glTF gives directional lights in lux, which the specification cannot express
        intensity=0.0 if kind == LightKind.DIRECTIONAL else max(0.0, float(entry.get("intensity", 1.0))),
    )


def _to_camera(entry: dict[str, Any], name: str) -> Camera:
    orthographic = entry.get("type") == "orthographic"
    lens = entry["orthographic" if orthographic else "perspective"]
    fovy = 2.0 * lens.get("ymag", 1.0) if orthographic else math.degrees(lens.get("yfov", 0.8))
    return Camera(name=name, body=0, T_body_camera=IDENTITY, fovy=fovy, orthographic=orthographic)


def _to_bytes(color: NDArray[Any]) -> NDArray[np.uint8]:
    """Convert linear vertex colours (n, 3 or 4) to sRGB in bytes; alpha stays as it is."""
    values = np.nan_to_num(color.astype(np.float64))
    alpha = values[:, 3:] if values.shape[1] == 4 else np.ones((len(values), 1))
    shown = np.concatenate([to_srgb(values[:, :3]), np.clip(alpha, 0.0, 1.0)], axis=1)
    return np.asarray(np.rint(shown * 255), np.uint8)


def _apply_alpha(pixels: Pixels, mode: str, cutoff: float) -> Pixels:
    """Apply the alpha mode of the material: opaque, masked, or blended."""
    if mode == "OPAQUE":
        return drop_alpha(pixels, always=True)
    if mode == "MASK" and pixels.shape[2] == 4:
        pixels = pixels.copy()
        pixels[:, :, 3] = np.where(pixels[:, :, 3] >= cutoff * 255, 255, 0)
    return pixels


def _drop_occlusion(pixels: Pixels) -> Pixels:
    """Return roughness and metallic in green and blue, with occlusion in red set to none."""
    packed = np.full((*pixels.shape[:2], 3), 255, np.uint8)
    packed[:, :, 1:] = pixels[:, :, 1:3] if pixels.shape[2] >= 3 else pixels[:, :, :1]
    return packed


def _clamp(value: float) -> float:
    return min(max(float(value), 0.0), 1.0)


# --- files: the document, and the bytes behind it (buffers, accessors, images) ----------------------------------------


def get_extension(entry: dict[str, Any], name: str) -> dict[str, Any]:
    """Return an extension of an entry of the document, empty without it."""
    found: dict[str, Any] = entry.get("extensions", {}).get(name, {})
    return found


class GltfFile:
    """A glTF 2.0 file: its `document`, and the bytes that it refers to. All methods raise `SceneBuildError`."""

    def __init__(self, path: Path, references: References) -> None:
        self.name = path.name
        self._references = references
        data = read_bounded(path)
        if path.suffix.lower() == ".glb" and not data.startswith((b"glTF", b"{", codecs.BOM_UTF8)):
            raise SceneBuildError(
                f"{self.name} is no GLB: it begins with {data[:4]!r} where b'glTF' is needed; export it as glTF binary"
            )
        text, self._chunk = _split_glb(data, path.name) if data[:4] == b"glTF" else (data, None)
        try:
            self.document: dict[str, Any] = json.loads(text, parse_float=_to_finite, parse_constant=_to_finite)
            version = str(self.document["asset"]["version"])
        except (ValueError, LookupError, TypeError, RecursionError) as error:
            raise SceneBuildError(f"{self.name} is no glTF, or cut: its document cannot be read: {error}") from None
        if not version.startswith("2."):
            raise SceneBuildError(f"{self.name} is no glTF 2.0, but {version!r}: export it again as that")
        unknown = sorted(set(self.document.get("extensionsRequired", ())) - KNOWN_EXTENSIONS)
        if unknown:
            raise SceneBuildError(
                f"{self.name} requires {', '.join(unknown)}: export it without (of meshes: uncompressed)"
            )
        self._buffers: dict[int, bytes] = {}
        self._read = len(data)

    def get(self, kind: str, index: object) -> dict[str, Any]:
        """Return entry `index` of the list `kind` of the document."""
        entries = self.document.get(kind, ())
        if not isinstance(entries, list) or type(index) is not int or not 0 <= index < len(entries):
            raise SceneBuildError(f"{self.name} refers to {kind} {index!r}, which it does not have")
        entry: dict[str, Any] = entries[index]
        return entry

    def read_accessor(self, index: object, widths: tuple[int, ...], count: int | None = None) -> NDArray[Any]:
        """Return an accessor.

        Args:
            index: Index of the accessor.
            widths: Numbers of columns that are possible.
            count: Number of rows that it must have.

        Returns:
            Shape (count, width): as floats where it is normalised, otherwise in its own type.
        """
        entry = self.get("accessors", index)
        dtype, width = self._dtype(entry), _WIDTHS.get(entry["type"], 0)
        n = self._size(entry, "count")
        if width not in widths:
            needed = " or ".join(name for name, n in _WIDTHS.items() if n in widths)
            raise SceneBuildError(f"{self.name}: accessor {index} is a {entry['type']!r} where {needed} is needed")
        if count not in (None, n):
            raise SceneBuildError(f"{self.name}: accessor {index} has {n} entries for {count} vertices")
        if "bufferView" in entry:
            values = self._read_rows(entry, dtype, n, width)
        elif n * width > _MAX_ZEROS:
            raise SceneBuildError(f"{self.name}: accessor {index} has {n} entries without bytes")
        else:
            values = np.zeros((n, width), dtype)
        if "sparse" in entry:
            values = self._replace_rows(values, entry["sparse"])
        if entry.get("normalized"):
            values = np.maximum(values / _ONE.get(dtype.str[1:], 1.0), -1.0)
        return values

    def read_image(self, index: object) -> bytes:
        """Return the encoded bytes of an image."""
        image = self.get("images", index)
        return bytes(self._view(image["bufferView"])[0]) if "bufferView" in image else self._read_uri(image.get("uri"))

    # --- internal -----------------------------------------------------------------------------------------------------

    def _size(self, entry: dict[str, Any], key: str) -> int:
        """Return a number of bytes or entries, 0 by default."""
        value = entry.get(key, 0)
        if type(value) is not int or value < 0:
            raise SceneBuildError(f"{self.name}: {key} is {value!r}: a whole number of 0 or more is needed")
        return value

    def _dtype(self, entry: dict[str, Any]) -> np.dtype[Any]:
        if entry["componentType"] not in _DTYPES:
            raise SceneBuildError(f"{self.name}: componentType is {entry['componentType']!r}, not one of {[*_DTYPES]}")
        return np.dtype(_DTYPES[entry["componentType"]])

    def _replace_rows(self, values: NDArray[Any], sparse: dict[str, Any]) -> NDArray[Any]:
        """Return `values` with the rows that a sparse accessor replaces."""
        n, dtype = self._size(sparse, "count"), self._dtype(sparse["indices"])
        rows = self._read_rows(sparse["indices"], dtype, n, 1)[:, 0]
        if dtype.kind != "u" or int(rows.max(initial=0)) >= max(len(values), 1):
            raise SceneBuildError(f"{self.name}: a sparse accessor names entries beyond its {len(values)}")
        changed = values.copy()
        changed[rows] = self._read_rows(sparse["values"], values.dtype, n, values.shape[1])
        return changed

    def _read_rows(self, place: dict[str, Any], dtype: np.dtype[Any], count: int, width: int) -> NDArray[Any]:
        """Return rows of numbers. `place`: has the `bufferView` and the `byteOffset` in it."""
        data, stride = self._view(place["bufferView"])
        offset, row = self._size(place, "byteOffset"), dtype.itemsize * width
        step = stride or row
        if count and (step < row or offset + (count - 1) * step + row > len(data)):
            raise SceneBuildError(
                f"{self.name}: {count} entries lie beyond the end of bufferViews {place['bufferView']}: it is cut"
            )
        if not count:
            return np.zeros((0, width), dtype)
        return np.ndarray((count, width), dtype, data, offset, (step, dtype.itemsize)).copy()

    def _view(self, index: object) -> tuple[memoryview, int]:
        """Return the bytes of a buffer view, and its stride, 0 when it has none."""
        view = self.get("bufferViews", index)
        start, length, stride = (self._size(view, key) for key in ("byteOffset", "byteLength", "byteStride"))
        whole = self._read_buffer(view["buffer"])
        if start + length > len(whole):
            raise SceneBuildError(f"{self.name}: bufferViews {index} reaches beyond its buffer: the file is cut")
        return memoryview(whole)[start : start + length], stride

    def _read_buffer(self, index: int) -> bytes:
        uri = self.get("buffers", index).get("uri")
        if index not in self._buffers:
            inside = index == 0 and uri is None and self._chunk is not None
            self._buffers[index] = self._chunk if inside and self._chunk is not None else self._read_uri(uri)
        return self._buffers[index]

    def _read_uri(self, uri: object) -> bytes:
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


def _to_finite(text: str) -> float:
    value = float(text)
    if not math.isfinite(value):
        raise ValueError(f"the number {text}, which is not finite")
    return value


def _split_glb(data: bytes, name: str) -> tuple[bytes, bytes | None]:
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
