"""Reader of mesh files by way of trimesh: OBJ with MTL, STL, PLY with colours, OFF, DAE. Not glTF: see `gltf`.

Colours are taken unchanged. Missing normals are computed with creases, as MuJoCo does. What trimesh reads without an
error although it is cut, or reads wrongly, is checked before.
"""

from __future__ import annotations

import codecs
import io
import logging
import math
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from iris_session.protocol.scene import Rgba
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import PixelBudget, to_pixels
from iris_session.scene.importers.references import References, read_bounded
from iris_session.scene.importers.xml_files import check_dae
from iris_session.scene.meshes import (
    compute_creased_normals,
    find_unique_rows,
    index_corners,
    merge_vertex_color,
    normalise,
)
from iris_session.scene.nodes import (
    GREY,
    MAX_NODES,
    MAX_TRIANGLES,
    Appearance,
    LoadedFile,
    Node,
    Surface,
    TextureImage,
    color_images,
    truncate_name,
)

_UP: Final = re.compile(rb"<up_axis>\s*([XYZ])_UP\s*<")
_STL_HEAD: Final = 84
_STL_TRIANGLE: Final = 50
#: Face of an OBJ that counts back.
_RELATIVE_CORNER: Final = re.compile(rb"^[ \t]*f[ \t][^\n#]*[ \t/]-", re.MULTILINE)
#: Names that trimesh gives to geometries without a name in the file.
_MADE_UP: Final = re.compile(r"geometry(_\d+)?")


def read_with_trimesh(path: Path, references: References, name: str) -> LoadedFile:
    """Read a file. `name`: name of content without one in the file.

    Raises `SceneBuildError`, and any error that trimesh raises for damaged files.
    """
    trimesh, kind = _import_trimesh(), path.suffix.lower().lstrip(".")
    data = _CHECKS[kind](path.name, read_bounded(path))
    resolver = _Resolver(references)
    scene = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=resolver, process=False)
    reader = _Reader(trimesh, path.name, name)
    stated = _UP.search(data) if kind == "dae" else None
    up = stated.group(1).decode().lower() if stated else "y" if kind == "dae" else "z"
    nodes = reader.read_nodes(scene)
    unit = float(trimesh.units.unit_conversion(scene.units, "meters")) if scene.units else 1.0
    return LoadedFile(nodes, up, unit, (*resolver.missing, *reader.skipped))


class _Resolver:
    """Reader of the further files that trimesh asks for: `references` decides, and missing ones are recorded."""

    def __init__(self, references: References) -> None:
        self._references = references
        self.missing: list[str] = []

    def get(self, name: str) -> bytes:
        try:
            return read_bounded(self._references.find(str(name).strip()))
        except SceneBuildError as error:
            self.missing.append(str(error))
            raise

    __getitem__ = get


class _Reader:
    def __init__(self, trimesh: Any, name: str, unnamed: str) -> None:
        self._trimesh = trimesh
        self._name = name
        self._unnamed = unnamed
        self._appearances: dict[int, Appearance | None] = {}
        self._images: dict[int, TextureImage] = {}
        self._budget = PixelBudget(name)
        self.skipped: list[str] = []

    def read_nodes(self, scene: Any) -> tuple[Node, ...]:
        """Return the nodes, flat, in the order of the geometries in the file: trimesh keeps no other order."""
        surfaces: dict[str, Surface] = {}
        names = self._name_parts(list(scene.geometry))
        for name, geometry in scene.geometry.items():
            if not isinstance(geometry, self._trimesh.Trimesh):
                self.skipped.append(f"{self._name}: {name}, which is {type(geometry).__name__} and no triangles")
            elif len(geometry.faces):
                surfaces[name] = self._read_surface(geometry, names[name])
        if sum(surface.mesh.triangles for surface in surfaces.values()) > MAX_TRIANGLES:
            raise SceneBuildError(f"{self._name} has more than {MAX_TRIANGLES:,} triangles: make it coarser")
        order = {name: place for place, name in enumerate(surfaces)}
        placed = []
        for node in scene.graph.nodes_geometry:
            matrix, name = scene.graph[node]
            if name in order:
                placed.append((order[name], np.array(matrix, np.float64)))
        if len(placed) > MAX_NODES:
            raise SceneBuildError(f"{self._name} has {len(placed)} parts, at most {MAX_NODES} are read")
        placed.sort(key=lambda entry: (entry[0], entry[1].tolist()))  # not by name: the library may invent names
        listed = list(surfaces.values())
        return tuple(Node(listed[k].name, -1, matrix, [listed[k]]) for k, matrix in placed)

    def _name_parts(self, given: list[str]) -> dict[str, str]:
        """Return the names of the geometries: those in the file, or its own name where trimesh invented them."""
        made_up = [name for name in given if _MADE_UP.fullmatch(name)]
        several = len(made_up) > 1
        ours = {name: f"{self._unnamed}_{k}" if several else self._unnamed for k, name in enumerate(made_up, start=1)}
        return {name: truncate_name(ours.get(name, name)) for name in given}

    def _read_surface(self, geometry: Any, name: str) -> Surface:
        points = np.ascontiguousarray(geometry.vertices, np.float64)
        faces = np.ascontiguousarray(geometry.faces, np.int64)
        if not np.isfinite(points).all():
            raise SceneBuildError(f"{self._name}: a vertex of {name} is not finite")
        if len(faces) and not 0 <= int(faces.min()) <= int(faces.max()) < len(points):
            wrong = int(faces.min()) if faces.min() < 0 else int(faces.max())
            raise SceneBuildError(f"{self._name}: a triangle of {name} names vertex {wrong} of {len(points)}")
        visual = geometry.visual
        uv: NDArray[np.float32] | None = None
        color: NDArray[np.uint8] | None = None
        look: Appearance | None = None
        if visual.kind == "texture":
            look = self._read_appearance(visual.material)
            if visual.uv is not None and len(visual.uv) == len(points):
                downward = np.asarray(visual.uv, np.float64)[:, :2] * [1, -1] + [0, 1]  # v points up in trimesh
                uv = np.ascontiguousarray(np.nan_to_num(downward)[faces], np.float32)
        elif visual.kind == "vertex":
            color = np.asarray(visual.vertex_colors, np.uint8)[faces]
        elif visual.kind == "face":
            color = np.repeat(np.asarray(visual.face_colors, np.uint8)[:, None], 3, axis=1)
        mesh = index_corners(points[faces].astype(np.float32), self._read_normals(geometry, points, faces), uv, color)
        if color is not None:
            mesh, rgba = merge_vertex_color(mesh, (1.0, 1.0, 1.0, 1.0))
            look = Appearance(rgba=rgba)
        return Surface(mesh, look, name)

    def _read_normals(
        self, geometry: Any, points: NDArray[np.float64], faces: NDArray[np.int64]
    ) -> NDArray[np.float32]:
        """Return normals at the corners: those of the file, else computed from the triangles around each point."""
        given = geometry._cache.cache.get("vertex_normals")  # the property would compute normals
        if given is not None and len(given) == len(points):
            return np.asarray(normalise(np.nan_to_num(given))[faces], np.float32)
        first, same = find_unique_rows(np.ascontiguousarray(points.astype(np.float32) + np.float32(0.0)))
        return compute_creased_normals(points[first], same[faces]).astype(np.float32)

    def _read_appearance(self, material: Any) -> Appearance | None:
        if id(material) not in self._appearances:
            pbr = isinstance(material, self._trimesh.visual.material.PBRMaterial)
            self._appearances[id(material)] = (
                self._read_pbr_material(material) if pbr else self._read_mtl_material(material)
            )
        return self._appearances[id(material)]

    def _read_mtl_material(self, material: Any) -> Appearance | None:
        """Return the appearance of an MTL material.

        It is read from `Kd`, `Ks`, `Ns`, `d` or `Tr`, and `map_Kd`, which multiplies the colour. `None` for the
        material that trimesh invents for texture coordinates without one: grey, with an image from no file.
        """
        more = getattr(material, "kwargs", None) or {}
        if not more and getattr(material.image, "format", None) is None:
            return None
        rgba = (1.0, 1.0, 1.0, 1.0) if material.image is not None else GREY
        if "kd" in more:
            rgba = _rgba(material.diffuse)
        alpha = _to_number(more.get("d"), 1.0 - _to_number(more.get("tr"), 0.0))
        pictures = self._read_image(material.image)
        specular, gloss = more.get("ks"), _to_number(more.get("ns"), 64.0)
        shine = 0.5 if specular is None else float(np.mean(specular))
        return Appearance(
            rgba=(*rgba[:3], min(max(alpha, 0.0), 1.0)),
            name=truncate_name(material.name),
            specular=min(max(shine, 0.0), 1.0) if math.isfinite(shine) else 0.5,
            shininess=min(max(gloss / 128.0, 0.0), 1.0),
            images=pictures,
        )

    def _read_pbr_material(self, material: Any) -> Appearance:
        rgba = (1.0, 1.0, 1.0, 1.0) if material.baseColorFactor is None else _rgba(material.baseColorFactor)
        glow = 0.0 if material.emissiveFactor is None else float(np.max(material.emissiveFactor))
        metallic = -1.0 if material.metallicFactor is None else float(material.metallicFactor)
        roughness = -1.0 if material.roughnessFactor is None else float(material.roughnessFactor)
        return Appearance(
            rgba=rgba,
            name=truncate_name(material.name),
            emission=max(0.0, glow),
            shininess=0.5 if roughness < 0 else min(max(1.0 - roughness, 0.0), 1.0),
            metallic=metallic,
            roughness=roughness,
            images=self._read_image(material.baseColorTexture),
        )

    def _read_image(self, image: Any) -> tuple[tuple[str, TextureImage], ...]:
        if image is None:
            return ()
        if id(image) not in self._images:
            pixels = to_pixels(image, f"a picture of {self._name}")
            self._images[id(image)] = TextureImage(self._budget.spend(pixels))
        picture = self._images[id(image)]
        return color_images(picture)


def _rgba(color: Any) -> Rgba:
    """Convert a colour of trimesh in bytes."""
    if color is None:
        return GREY
    red, green, blue, alpha = (float(v) / 255 for v in np.asarray(color).reshape(-1)[:4])
    return red, green, blue, alpha


def _to_number(value: Any, default: float) -> float:
    """Return a finite number of an MTL file, which may be a list of texts."""
    try:
        found = float(value[0] if isinstance(value, list | tuple) else value)
    except (TypeError, ValueError, IndexError):
        return default
    return found if math.isfinite(found) else default


def _import_trimesh() -> Any:
    try:
        import trimesh
    except ImportError:
        raise SceneBuildError("mesh files need trimesh: pip install 'iris-session[files]'") from None
    logger = logging.getLogger("trimesh")
    if not logger.handlers:  # otherwise Python prints its tracebacks although no logging was configured
        logger.addHandler(logging.NullHandler())
    return trimesh


# --- checks of files: each takes the name and the bytes, and returns the bytes to be read -----------------------------


def _check_stl(name: str, data: bytes) -> bytes:
    """Check that a binary STL has as many triangles as its header states, and that a text STL has an end."""
    if data[:512].lstrip()[:5].lower() == b"solid" and b"\0" not in data[:512]:
        if b"endsolid" not in data[-4096:].lower():
            raise SceneBuildError(f"{name} is cut: an STL of text ends with endsolid; export or download it again")
        return data
    count = int.from_bytes(data[80:_STL_HEAD], "little")
    size = _STL_HEAD + count * _STL_TRIANGLE
    if len(data) < size:
        raise SceneBuildError(
            f"{name} is cut, or no STL: its head says {count:,} triangles, {size:,} bytes, and it has {len(data):,}; "
            "export or download it again"
        )
    return data[:size]  # some writers pad the last block


def _check_ply(name: str, data: bytes) -> bytes:
    """Check that a text PLY has as many lines as its header states."""
    head, *bodies = re.split(rb"end_header\r?\n", data, maxsplit=1)
    body = b"".join(bodies)
    rows = sum(int(count) for count in re.findall(rb"^element[ \t]+\S+[ \t]+(\d{1,18})", head, re.MULTILINE))
    if b"format ascii" in head and (lines := len(body.splitlines())) < rows:
        raise SceneBuildError(f"{name} is cut: its head says {rows:,} lines, and it has {lines:,}; export it again")
    return data


def _check_off(name: str, data: bytes) -> bytes:
    """Check that an OFF has as many faces as its header states, and that the last face is complete.

    Comments are removed: trimesh reads everything but one line before the first comment twice.
    """
    data = b"\n".join(line.partition(b"#")[0] for line in data.splitlines())
    rows = [row for line in data.partition(b"OFF")[2].splitlines() if (row := line.split())]
    vertices, faces = (int(word) for word in rows[0][:2])
    listed = rows[1 + vertices : 1 + vertices + faces]
    if len(listed) < faces or (faces and len(listed[-1]) <= int(listed[-1][0])):
        raise SceneBuildError(
            f"{name} is cut: its head says {faces:,} faces, and it ends in number {len(listed):,}; "
            "export or download it again"
        )
    return data


def _check_obj(name: str, data: bytes) -> bytes:
    """Check that no face counts back from its own line: trimesh counts from the end of the file."""
    if found := _RELATIVE_CORNER.search(data):
        line = data.count(b"\n", 0, found.start()) + 1
        raise SceneBuildError(f"{name}, line {line}: a face with negative numbers: export it with numbers from 1")
    return data.removeprefix(codecs.BOM_UTF8)


def _check_dae(name: str, data: bytes) -> bytes:
    try:
        import collada  # noqa: F401
    except ImportError:
        raise SceneBuildError(f"{name}: DAE files need pycollada: pip install 'iris-session[files]'") from None
    return check_dae(name, data)


_CHECKS: Final[Mapping[str, Callable[[str, bytes], bytes]]] = {
    "stl": _check_stl,
    "ply": _check_ply,
    "off": _check_off,
    "obj": _check_obj,
    "dae": _check_dae,
}
