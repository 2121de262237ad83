"""URDF files: links that fixed joints hold together as one body each, joints with limits and mimics, what is drawn.

XML is read by yourdfpy (`urdf_xml`), the meshes by our own readers, as they stand in their files (no axis of theirs is
turned up, as in ROS). A mesh with colours of its own keeps them; others have the material of the URDF.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from iris_session.protocol.common import Pose
from iris_session.protocol.names import GeometryKind, TextureRole
from iris_session.protocol.scene import Rgba
from iris_session.scene.articulation import Articulation, Part
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.files import ENDINGS, ROBOTS, ending, guarded, load_file, present, xacro_advice
from iris_session.scene.parts import Item, Loaded, Look, Matrix, Picture, cut, pose_of
from iris_session.scene.pictures import PixelBudget, read_pixels
from iris_session.scene.references import References, read_bounded
from iris_session.scene.units import Drawn, colour_question, degrees_question, reach_of, robot_question, side_of
from iris_session.scene.urdf_joints import read_joints, root_link
from iris_session.scene.urdf_xml import parsed

#: Joints that move in more ways than one: their links are moved as bodies, not by positions of joints.
_LOOSE: Final = frozenset({"floating", "planar"})


@dataclass(frozen=True)
class Robot:
    """A URDF: `items` are on `articulation.parts`, by their places. `skipped`: a line for each thing left out;
    `notes`: for each that looks like a mistake."""

    articulation: Articulation
    items: tuple[Item, ...]
    skipped: tuple[str, ...]
    notes: tuple[str, ...] = ()


def read_urdf(
    path: Path,
    name: str,
    T_world_root: Pose,
    package_dirs: Sequence[str | PathLike[str]] = (),
    *,
    collisions: bool = False,
    scale: float = 1.0,
) -> Robot:
    """The robot under `name`: its bodies are called `name/link`. `collisions`: draw these instead of visuals. `scale`:
    how large it is drawn; joints keep their positions, also those that slide.

    Raises `SceneBuildError`.
    """
    present(path)
    if ending(path) == "xacro":
        raise SceneBuildError(f"{path.name}: {xacro_advice(path)}")
    if ending(path) in ENDINGS and ending(path) not in (*ROBOTS, "xml"):
        raise SceneBuildError(f"{path.name} is no URDF: files that end in .{ending(path)} go with add_file, or Session")
    references = References(path, package_dirs)
    data = read_bounded(path)

    def read() -> Robot:  # yourdfpy raises whatever the missing attribute leads to
        robot, skipped = parsed(path, data)
        return _Reader(path, name, robot, references, package_dirs, skipped, collisions).robot(T_world_root, scale)

    found: Robot = guarded(path, "urdf", read)
    return found if scale == 1.0 else _scaled(found, scale)


def _scaled(robot: Robot, scale: float) -> Robot:
    """The same robot in another size."""

    def at(pose: Pose) -> Pose:
        x, y, z = pose.p
        return Pose((scale * x, scale * y, scale * z), pose.q)

    parts = []
    for part in robot.articulation.parts:
        slide = scale if part.sliding else 1.0
        parts.append(
            part._replace(
                T_parent_joint=at(part.T_parent_joint), multiplier=slide * part.multiplier, offset=slide * part.offset
            )
        )
    items = []
    for item in robot.items:
        matrix = item.matrix.copy()
        matrix[:3, 3] *= scale
        if item.mesh is not None:
            matrix[:3, :3] *= scale
        x, y, z = (scale * side for side in item.size)
        items.append(replace(item, matrix=matrix, size=(x, y, z)))
    return replace(robot, articulation=replace(robot.articulation, parts=tuple(parts)), items=tuple(items))


class _Reader:
    def __init__(
        self,
        path: Path,
        name: str,
        robot: Any,
        references: References,
        package_dirs: Sequence[str | PathLike[str]],
        skipped: dict[str, None],
        collisions: bool,
    ) -> None:
        self._path, self._name, self._robot = path, name, robot
        self._references, self._package_dirs = references, package_dirs
        self._skipped = skipped
        self._collisions = collisions
        self._files: dict[Path, Loaded] = {}
        self._notes: dict[str, None] = {}
        self._sizes: list[Drawn] = []
        self._measured: set[tuple[Path, tuple[float, float, float]]] = set()
        self._looks: dict[str, Look | None] = {}
        self._pictures: dict[Path, Picture] = {}
        self._budget = PixelBudget(path.name)
        self._materials: dict[str, Any] = {}
        worn = (visual.material for link in robot.links for visual in link.visuals)
        for material in (*robot.materials, *worn):
            if material is not None and material.name and (material.color is not None or material.texture is not None):
                self._materials.setdefault(material.name, material)

    def robot(self, T_world_root: Pose, scale: float) -> Robot:
        """`scale`: by which it will be drawn."""
        root = root_link(self._path.name, self._robot)
        table = read_joints(self._path.name, self._robot)
        below: dict[str, list[Any]] = {}
        for joint in self._robot.joints:
            below.setdefault(joint.parent, []).append(joint)
        links = {link.name: link for link in self._robot.links}
        parts = [Part(f"{self._name}/{root}")]
        items: list[Item] = []
        loose: dict[str, str] = {}
        waiting: list[tuple[str, int, Matrix]] = [(root, 0, np.eye(4))]
        while waiting:
            name, part, T_part_link = waiting.pop()
            items += self._drawn(links[name], part, T_part_link)
            for joint in reversed(below.get(name, [])):
                T_part_child = T_part_link @ _matrix(self._path.name, joint)
                if joint.type == "fixed":
                    waiting.append((joint.child, part, T_part_child))
                    continue
                body = f"{self._name}/{joint.child}"
                if joint.type in _LOOSE:
                    at = pose_of(T_part_child[:3, :3], T_part_child[:3, 3])
                    parts.append(Part(body, part, at))
                    loose[joint.name] = body
                    waiting.append((joint.child, len(parts) - 1, np.eye(4)))
                    continue
                drive = table.drives[joint.name]
                parts.append(
                    Part(
                        body=body,
                        parent=part,
                        T_parent_joint=pose_of(T_part_child[:3, :3], T_part_child[:3, 3]),
                        axis=drive.axis,
                        sliding=joint.type == "prismatic",
                        joint=drive.joint,
                        multiplier=drive.multiplier,
                        offset=drive.offset,
                    )
                )
                waiting.append((joint.child, len(parts) - 1, np.eye(4)))
        if not items:
            other = "visuals: leave out collisions=True" if self._collisions else "collisions: give collisions=True"
            self._skip(f"nothing of it is drawn; what it may have are {other}")
        articulation = Articulation(self._name, T_world_root, tuple(parts), table.joints, table.mimics, loose)
        units = robot_question(self._path.name, reach_of(self._robot.joints, root), self._sizes, scale)
        notes = (*units, *degrees_question(self._path.name, table.joints), *self._notes)
        return Robot(articulation, tuple(items), tuple(self._skipped), notes)

    # --- what is drawn ------------------------------------------------------------------------------------------------

    def _drawn(self, link: Any, part: int, T_part_link: Matrix) -> list[Item]:
        found: list[Item] = []
        for shape in link.collisions if self._collisions else link.visuals:
            matrix = T_part_link @ (np.eye(4) if shape.origin is None else shape.origin)
            look = None if self._collisions else self._look(shape.material)
            name = cut(shape.name or link.name)
            geometry = shape.geometry
            if geometry.mesh is not None:
                found += self._mesh(geometry.mesh, part, name, matrix, look)
                continue
            kind, size = _shape(self._path.name, geometry)
            self._sizes.append(Drawn(f"shape, a {kind} of {cut(link.name)},", 2.0 * max(size)))
            found.append(Item(part, name, matrix, look or Look(), kind=kind, size=size))
        return found

    def _mesh(self, mesh: Any, part: int, name: str, matrix: Matrix, look: Look | None) -> list[Item]:
        if not mesh.filename:
            raise SceneBuildError(f"{self._path.name}: a mesh of {name} names no file")
        path = self._references.find(mesh.filename)
        if path not in self._files:
            self._files[path] = load_file(path, (*self._package_dirs, *self._references.folders(path)))
            for text in self._files[path].skipped:
                self._skipped[text] = None
            if any(node.lights or node.cameras for node in self._files[path].nodes):
                self._skip(f"lights and cameras in {path.name}")
        loaded = self._files[path]
        x, y, z = (float(v) for v in np.broadcast_to(1.0 if mesh.scale is None else mesh.scale, 3))
        scale = np.diag([loaded.unit * x, loaded.unit * y, loaded.unit * z, 1.0])
        self._measure(path, loaded, (x, y, z), scale)
        return [
            Item(part, name, matrix @ scale @ node.matrix, surface.look or look or Look(), surface.mesh)
            for node in loaded.nodes
            for surface in node.surfaces
        ]

    def _measure(self, path: Path, loaded: Loaded, given: tuple[float, float, float], scale: Matrix) -> None:
        """How large a mesh is, by the scale at its `<mesh>`; once for each that it is drawn with."""
        if (path, given) not in self._measured:
            self._measured.add((path, given))
            placed = [(surface.mesh, scale @ node.matrix) for node in loaded.nodes for surface in node.surfaces]
            self._sizes.append(Drawn(f"mesh, {path.name},", side_of(placed), given))

    def _look(self, material: Any) -> Look | None:
        """Of a material of the URDF; one without colour refers to another of its name."""
        if material is None:
            return None
        known = material
        if material.color is None and material.texture is None:
            known = self._materials.get(material.name or "")
        if known is None:
            self._skip(f"material {material.name!r}, which has neither colour nor texture anywhere")
            return None
        key = f"{known.name} {known.color} {known.texture}"
        if key not in self._looks:
            rgba = self._rgba(known)
            self._looks[key] = Look(rgba=rgba, name=cut(known.name or ""), pictures=self._texture(known.texture))
        return self._looks[key]

    def _rgba(self, material: Any) -> Rgba:
        values = (1.0,) * 4 if material.color is None else tuple(float(v) for v in material.color.rgba)
        if len(values) != 4 or not all(map(math.isfinite, values)):
            raise SceneBuildError(f"{self._path.name}: material {material.name!r} needs rgba of four finite numbers")
        self._notes |= dict.fromkeys(colour_question(self._path.name, cut(material.name or ""), values))
        red, green, blue, alpha = (min(max(v, 0.0), 1.0) for v in values)
        return red, green, blue, alpha

    def _texture(self, texture: Any) -> tuple[tuple[str, Picture], ...]:
        if texture is None or not texture.filename:
            return ()
        path = self._references.find(texture.filename)
        if path not in self._pictures:
            pixels = self._budget.spend(read_pixels(read_bounded(path), str(path)))
            self._pictures[path] = Picture(pixels, cut(path.stem))
        picture = self._pictures[path]
        return ((TextureRole.RGBA if picture.pixels.shape[2] == 4 else TextureRole.RGB, picture),)

    def _skip(self, text: str) -> None:
        self._skipped[f"{self._path.name}: {text}"] = None


def _matrix(file: str, joint: Any) -> Matrix:
    """T_parent_joint, as the file has it."""
    matrix = np.eye(4) if joint.origin is None else np.asarray(joint.origin, np.float64)
    if not np.isfinite(matrix).all():
        raise SceneBuildError(f"{file}: the origin of joint {joint.name} is not finite")
    return matrix


def _shape(file: str, geometry: Any) -> tuple[str, tuple[float, float, float]]:
    """Kind and size of a simple shape, as in `Geometry`."""
    if geometry.box is not None:
        kind, sizes = GeometryKind.BOX, [0.5 * float(v) for v in geometry.box.size]
    elif geometry.cylinder is not None:
        radius = float(geometry.cylinder.radius)
        kind, sizes = GeometryKind.CYLINDER, [radius, radius, 0.5 * float(geometry.cylinder.length)]
    else:
        kind, sizes = GeometryKind.SPHERE, [float(geometry.sphere.radius)] * 3
    if len(sizes) != 3 or not all(math.isfinite(v) and v > 0 for v in sizes):
        raise SceneBuildError(f"{file}: a {kind} of size {sizes}: three positive lengths are needed")
    return kind, (sizes[0], sizes[1], sizes[2])
