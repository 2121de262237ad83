"""Reader of URDF robots as articulations: joints, which must form one tree, and links as drawn items.

Messages name the line of the element that is wrong. Elements that are not drawn, such as inertias, transmissions and
extensions of simulators, are not read.
"""

from __future__ import annotations

import graphlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Final, NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from anchors.pose import quat_from_rotvec, quat_mul
from iris_session.protocol.common import Pose, Vec3
from iris_session.protocol.names import GeometryKind
from iris_session.protocol.scene import Rgba
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import PixelBudget, read_pixels
from iris_session.scene.importers.files import load_file, read_guarded
from iris_session.scene.importers.references import (
    ENDINGS,
    ROBOTS,
    References,
    check_present,
    get_ending,
    read_bounded,
    xacro_advice,
)
from iris_session.scene.importers.xml_files import parse_xml
from iris_session.scene.nodes import (
    Appearance,
    DrawnItem,
    LoadedFile,
    Matrix,
    TextureImage,
    color_images,
    to_matrix,
    to_pose,
    truncate_name,
)
from iris_session.scene.result import ArticulatedBody, Articulation, Joint

_FIXED: Final = "fixed"
#: Joints with several degrees of freedom: their links are moved as bodies, not by joint positions.
_LOOSE: Final = frozenset({"floating", "planar"})
_MOVING: Final = frozenset({"revolute", "continuous", "prismatic"})
_KINDS: Final = _MOVING | _LOOSE | {_FIXED}
_TREE: Final = "a URDF is a tree, leave one of them out (closed chains: in MJCF, one joint as an equality constraint)"


@dataclass(frozen=True)
class Robot:
    """Result of reading a URDF.

    `items` belong to `articulation.parts`, by index. `skipped`: a line for each thing left out.
    """

    articulation: Articulation
    items: tuple[DrawnItem, ...]
    skipped: tuple[str, ...]


def read_urdf(
    path: Path,
    name: str,
    T_world_root: Pose,
    package_dirs: Sequence[str | PathLike[str]] = (),
    *,
    collisions: bool = False,
    scale: float = 1.0,
) -> Robot:
    """Read a URDF file.

    Args:
        path: The file.
        name: Name of the articulation; its bodies are called `name/link`.
        T_world_root: Pose of the root link.
        package_dirs: Folders of packages that it refers to.
        collisions: Draw collision geometry instead of visuals.
        scale: Size factor of the drawing; joints keep their positions, also sliding ones.

    Raises:
        SceneBuildError: The file is missing or damaged, or its joints are no tree.
    """
    check_present(path)
    if get_ending(path) == "xacro":
        raise SceneBuildError(f"{path.name}: {xacro_advice(path)}")
    if get_ending(path) in ENDINGS and get_ending(path) not in (*ROBOTS, "xml"):
        raise SceneBuildError(
            f"{path.name} is no URDF: files that end in .{get_ending(path)} go with add_file, or Session"
        )
    robot: Robot = read_guarded(
        path, "urdf", lambda: _Reader(path, name, package_dirs, collisions, scale).read(T_world_root)
    )
    return robot


class _Mimic(NamedTuple):
    """Joint that is followed: its position times `multiplier` plus `offset`."""

    joint: str
    multiplier: float
    offset: float


class _Joint(NamedTuple):
    """A joint of the file. `axis`: unit vector in its frame. Limits are infinite without any."""

    name: str
    kind: str
    parent: str
    child: str
    T_parent_joint: Matrix
    axis: Vec3
    low: float
    high: float
    mimic: _Mimic | None


class _Reader:
    def __init__(
        self, path: Path, name: str, package_dirs: Sequence[str | PathLike[str]], collisions: bool, scale: float
    ) -> None:
        self._path, self._name, self._scale = path, name, scale
        self._file = path.name
        self._references, self._package_dirs = References(path, package_dirs), package_dirs
        self._shape_tag = "collision" if collisions else "visual"
        self._skipped: dict[str, None] = {}
        self._loaded: dict[Path, LoadedFile] = {}
        self._textures: dict[Path, TextureImage] = {}
        self._budget = PixelBudget(path.name)
        self._root = self._parse()
        self._links = {self._require(link, "name"): link for link in self._root.findall("link")}
        self._materials: dict[str, Element] = {}
        for material in self._root.iter("material"):
            if _is_defined(material):
                self._materials.setdefault(material.get("name", ""), material)

    def read(self, T_world_root: Pose) -> Robot:
        """Return the robot."""
        joints = [self._read_joint(element) for element in self._root.findall("joint")]
        root = self._find_root(joints)
        below: dict[str, list[_Joint]] = {}
        for joint in joints:
            below.setdefault(joint.parent, []).append(joint)
        by_name = {joint.name: joint for joint in joints}
        set_joints = [joint for joint in joints if joint.kind in _MOVING and joint.mimic is None]
        places = {joint.name: place for place, joint in enumerate(set_joints)}
        parts = [ArticulatedBody(f"{self._name}/{root}")]
        items: list[DrawnItem] = []
        loose: dict[str, str] = {}
        mimics: dict[str, str] = {}
        waiting: list[tuple[str, int, Matrix]] = [(root, 0, np.eye(4))]
        while waiting:
            link, part, T_part_link = waiting.pop()
            items += self._read_items(link, part, T_part_link)
            for joint in reversed(below.get(link, [])):
                T_part_child = T_part_link @ joint.T_parent_joint
                if joint.kind == _FIXED:
                    waiting.append((joint.child, part, T_part_child))
                    continue
                body = ArticulatedBody(
                    f"{self._name}/{joint.child}", part, to_pose(T_part_child[:3, :3], T_part_child[:3, 3])
                )
                if joint.kind in _LOOSE:
                    loose[joint.name] = body.body
                else:
                    source = self._follow(joint, by_name)
                    length = self._scale if joint.kind == "prismatic" else 1.0
                    body = body._replace(
                        axis=joint.axis,
                        sliding=joint.kind == "prismatic",
                        joint=places[source.joint],
                        multiplier=length * source.multiplier,
                        offset=length * source.offset,
                    )
                    if joint.mimic is not None:
                        mimics[joint.name] = source.joint
                parts.append(body)
                waiting.append((joint.child, len(parts) - 1, np.eye(4)))
        if not items:
            other = (
                "visuals: leave out collisions=True (--collisions)"
                if self._shape_tag == "collision"
                else "collisions: give collisions=True (--collisions)"
            )
            self._skip(f"nothing of it is drawn; what it may have are {other}")
        listed = tuple(
            Joint(joint.name, joint.kind, joint.low, joint.high, min(max(0.0, joint.low), joint.high))
            for joint in set_joints
        )
        articulation = Articulation(self._name, T_world_root, tuple(parts), listed, mimics, loose)
        return Robot(articulation, tuple(items), tuple(self._skipped))

    # --- document -----------------------------------------------------------------------------------------------------

    def _parse(self) -> Element:
        root = parse_xml(str(self._path), read_bounded(self._path), "robot")
        if root.tag != "robot":
            raise SceneBuildError(f"{self._path} is no URDF: it begins with <{root.tag}> where <robot> is needed")
        if any(element.tag.startswith("xacro:") for element in root.iter()):
            raise SceneBuildError(f"{self._path}: {xacro_advice(self._path)}")
        names = [link.get("name", "") for link in root.findall("link")]
        if len(set(names)) != len(names) or not names:
            raise SceneBuildError(f"{self._file}: no link, or two of one name: {_repeated(names)}")
        return root

    def _require(self, element: Element, attribute: str) -> str:
        """Return an attribute that must be there."""
        value = element.get(attribute)
        if not value:
            raise SceneBuildError(f"{self._place(element)} has no {attribute}")
        return value

    def _numbers(
        self,
        element: Element | None,
        attribute: str,
        default: Sequence[float],
        counts: tuple[int, ...] = (),
        *,
        endless: bool = False,
    ) -> list[float]:
        """Return the numbers of an attribute: as many as `default` has, or one of `counts`; finite unless `endless`."""
        text = None if element is None else element.get(attribute)
        if element is None or text is None:
            return list(default)
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        counts = counts or (len(default),)
        finite = all(not math.isnan(v) if endless else math.isfinite(v) for v in values)
        if len(values) not in counts or not finite:
            wanted = "one finite number" if counts == (1,) else f"{' or '.join(map(str, counts))} finite numbers"
            raise SceneBuildError(f"{self._place(element)}: {attribute} is {text[:60]!r} where {wanted} must stand")
        return values

    def _origin(self, element: Element) -> Matrix:
        """Return the pose that the `<origin>` of an element states, in the size of the drawing."""
        origin = element.find("origin")
        roll, pitch, yaw = self._numbers(origin, "rpy", (0.0, 0.0, 0.0))
        about_z, about_y, about_x = ((0.0, 0.0, yaw), (0.0, pitch, 0.0), (roll, 0.0, 0.0))
        q = quat_mul(quat_mul(quat_from_rotvec(about_z), quat_from_rotvec(about_y)), quat_from_rotvec(about_x))
        x, y, z = (self._scale * v for v in self._numbers(origin, "xyz", (0.0, 0.0, 0.0)))
        return to_matrix(Pose((x, y, z), q))

    def _place(self, element: Element) -> str:
        """Return the position of an element, for messages."""
        name = element.get("name") or ""
        line = getattr(element, "line", 0)  # of `parse_xml`
        return f"{self._file}, line {line}: <{element.tag}>{f' {name}' if name else ''}"

    def _skip(self, text: str) -> None:
        self._skipped[f"{self._file}: {text}"] = None

    # --- joints -------------------------------------------------------------------------------------------------------

    def _read_joint(self, element: Element) -> _Joint:
        name, kind = self._require(element, "name"), self._require(element, "type")
        if kind not in _KINDS:
            raise SceneBuildError(f"{self._file}: joint {name} of type {kind!r}; types are {', '.join(sorted(_KINDS))}")
        ends = []
        for tag in ("parent", "child"):
            end = element.find(tag)
            if end is None:
                raise SceneBuildError(f'{self._place(element)} has no <{tag} link="...">')
            ends.append(self._require(end, "link"))
        low, high = self._read_limits(element, name, kind)
        mimic, followed = element.find("mimic"), None
        if mimic is not None and kind in _MOVING:
            (multiplier,) = self._numbers(mimic, "multiplier", [1.0])
            (offset,) = self._numbers(mimic, "offset", [0.0])
            followed = _Mimic(self._require(mimic, "joint"), multiplier, offset)
        axis = np.array(self._numbers(element.find("axis"), "xyz", (1.0, 0.0, 0.0)))
        length = float(np.linalg.norm(axis))
        if kind in _MOVING and length < 1e-9:
            raise SceneBuildError(f"{self._file}: the axis of joint {name} is {axis}: three numbers, not all 0")
        x, y, z = (axis / max(length, 1e-9)).tolist()
        return _Joint(name, kind, ends[0], ends[1], self._origin(element), (x, y, z), low, high, followed)

    def _read_limits(self, element: Element, name: str, kind: str) -> tuple[float, float]:
        """Return the limits of a joint: a missing one counts as 0, as in URDF; without both there are none."""
        limit = element.find("limit")
        if kind == "continuous" or limit is None or not {"lower", "upper"}.intersection(limit.keys()):
            return -math.inf, math.inf
        (low,) = self._numbers(limit, "lower", [0.0], endless=True)
        (high,) = self._numbers(limit, "upper", [0.0], endless=True)
        if low > high:
            raise SceneBuildError(f"{self._file}: joint {name} has limits from {low} to {high}")
        return low, high

    def _find_root(self, joints: Sequence[_Joint]) -> str:
        """Return the link that no joint moves. Raises `SceneBuildError` unless links and joints form one tree."""
        if len({joint.name for joint in joints}) != len(joints):
            raise SceneBuildError(
                f"{self._file}: two joints of one name: {_repeated([joint.name for joint in joints])}"
            )
        above: dict[str, _Joint] = {}
        for joint in joints:
            for link in (joint.parent, joint.child):
                if link not in self._links:
                    raise SceneBuildError(
                        f"{self._file}: joint {joint.name} refers to link {link!r}, which is not there"
                    )
            if joint.child in above:
                raise SceneBuildError(
                    f"{self._file}: link {joint.child} hangs on two joints, {above[joint.child].name} and "
                    f"{joint.name}: {_TREE}"
                )
            above[joint.child] = joint
        try:
            graphlib.TopologicalSorter({joint.child: [joint.parent] for joint in joints}).prepare()
        except graphlib.CycleError as error:
            loop = ", ".join(above[link].name for link in error.args[1][1:9])  # from parent to child
            raise SceneBuildError(f"{self._file}: the joints {loop} make a loop: {_TREE}") from None
        roots = [link for link in self._links if link not in above]
        if len(roots) > 1:
            raise SceneBuildError(
                f"{self._file}: {len(roots)} links hang on no joint ({', '.join(roots[:8])}): in a URDF one does, "
                "join the others"
            )
        return roots[0]

    def _follow(self, joint: _Joint, by_name: Mapping[str, _Joint]) -> _Mimic:
        """Return the joint that is set to move this one, along a chain of mimics."""
        multiplier, offset, at = 1.0, 0.0, joint
        for _ in by_name:
            if at.mimic is None:
                return _Mimic(at.name, multiplier, offset)
            multiplier, offset = multiplier * at.mimic.multiplier, offset + multiplier * at.mimic.offset
            followed = by_name.get(at.mimic.joint)
            if followed is None or followed.kind not in _MOVING:
                break
            at = followed
        followed_name = joint.mimic.joint if joint.mimic is not None else ""
        raise SceneBuildError(
            f"{self._file}: joint {joint.name} follows {followed_name!r}, which does not move, or follows it in turn"
        )

    # --- what is drawn ------------------------------------------------------------------------------------------------

    def _read_items(self, link: str, part: int, T_part_link: Matrix) -> list[DrawnItem]:
        found: list[DrawnItem] = []
        for shown in self._links[link].findall(self._shape_tag):
            geometry = shown.find("geometry")
            shape = next(iter(geometry), None) if geometry is not None else None
            matrix = T_part_link @ self._origin(shown)
            name = truncate_name(shown.get("name") or link)
            material = shown.find("material") if self._shape_tag == "visual" else None
            look = None if material is None else self._read_appearance(material)
            if shape is not None and shape.tag == "mesh":
                found += self._read_mesh(shape, part, name, matrix, look)
            elif shape is not None and (size := self._read_size(shape)) is not None:
                found.append(DrawnItem(part, name, matrix, look or Appearance(), kind=shape.tag, size=size))
            else:
                self._skip(f"{self._shape_tag} of link {link}: shape {'none' if shape is None else shape.tag!r}")
        return found

    def _read_size(self, shape: Element) -> Vec3 | None:
        """Return the size of a simple shape, as in `Geometry`; `None` for other elements."""
        if shape.tag == GeometryKind.BOX:
            self._require(shape, "size")
            x, y, z = (0.5 * v for v in self._numbers(shape, "size", (0.0, 0.0, 0.0)))
        elif shape.tag in (GeometryKind.CYLINDER, GeometryKind.CAPSULE):  # the length of a capsule is without its caps
            (x,), (length,) = (self._numbers(shape, key, [math.nan]) for key in ("radius", "length"))
            y, z = x, 0.5 * length
        elif shape.tag == GeometryKind.SPHERE:
            (x,) = self._numbers(shape, "radius", [math.nan])
            y = z = x
        else:
            return None
        if not min(x, y, z) > 0 or math.isnan(z):
            raise SceneBuildError(f"{self._place(shape)} has the half sizes {[x, y, z]}: positive lengths are needed")
        return self._scale * x, self._scale * y, self._scale * z

    def _read_mesh(
        self, mesh: Element, part: int, name: str, matrix: Matrix, look: Appearance | None
    ) -> list[DrawnItem]:
        path = self._references.find(self._require(mesh, "filename"))
        if path not in self._loaded:
            self._loaded[path] = load_file(path, (*self._package_dirs, *self._references.folders(path)))
            self._skipped |= dict.fromkeys(self._loaded[path].skipped)
            if any(node.lights or node.cameras for node in self._loaded[path].nodes):
                self._skip(f"lights and cameras in {path.name}")
        loaded = self._loaded[path]
        factors = np.broadcast_to(self._numbers(mesh, "scale", (1.0,), (1, 3)), 3)
        T_part_file = matrix @ np.diag([*(self._scale * loaded.unit * factors), 1.0])
        return [
            DrawnItem(part, name, T_part_file @ node.matrix, surface.appearance or look or Appearance(), surface.mesh)
            for node in loaded.nodes
            for surface in node.surfaces
        ]

    def _read_appearance(self, material: Element) -> Appearance | None:
        """Return the appearance of a material; one without colour refers to another one by name."""
        name = material.get("name", "")
        known = material if _is_defined(material) else self._materials.get(name)
        if known is None:
            self._skip(f"material {name!r}, which has neither colour nor texture anywhere")
            return None
        red, green, blue, alpha = (
            min(max(v, 0.0), 1.0) for v in self._numbers(known.find("color"), "rgba", (1.0, 1.0, 1.0, 1.0))
        )
        rgba: Rgba = (red, green, blue, alpha)
        texture = known.find("texture")
        file = "" if texture is None else texture.get("filename", "")
        return Appearance(rgba=rgba, name=truncate_name(name), images=self._read_texture(file) if file else ())

    def _read_texture(self, file: str) -> tuple[tuple[str, TextureImage], ...]:
        path = self._references.find(file)
        if path not in self._textures:
            pixels = self._budget.spend(read_pixels(read_bounded(path), str(path)))
            self._textures[path] = TextureImage(pixels, truncate_name(path.stem))
        return color_images(self._textures[path])


def _is_defined(material: Element) -> bool:
    """Return whether a material has a colour or a texture of its own."""
    return material.find("color") is not None or material.find("texture") is not None


def _repeated(names: Sequence[str]) -> str:
    return ", ".join(sorted({name for name in names if names.count(name) > 1})) or "none"
