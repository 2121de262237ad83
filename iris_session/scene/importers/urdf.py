"""Reader of URDF robots as articulations: the document, its joints, and its links as drawn items.

The document is checked for everything that yourdfpy needs and does not check, with the line in the message; elements
that yourdfpy does not know are removed and reported. The joints determine the root link, the joints that are set, and
those that mimic others; together they must form one tree.
"""

from __future__ import annotations

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from iris_session.protocol.common import Pose, Vec3
from iris_session.protocol.names import GeometryKind, TextureRole
from iris_session.protocol.scene import Rgba
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.images import PixelBudget, read_pixels
from iris_session.scene.importers.files import (
    ENDINGS,
    ROBOTS,
    check_present,
    get_ending,
    load_file,
    read_guarded,
    xacro_advice,
)
from iris_session.scene.importers.references import References, read_bounded
from iris_session.scene.importers.units import (
    Drawn,
    colour_question,
    degrees_question,
    measure_reach,
    measure_side,
    robot_question,
)
from iris_session.scene.importers.xml_files import no_xml
from iris_session.scene.nodes import Appearance, DrawnItem, LoadedFile, Matrix, TextureImage, to_pose, truncate_name
from iris_session.scene.result import ArticulatedBody, Articulation, Joint

#: Joints with several degrees of freedom: their links are moved as bodies, not by joint positions.
_LOOSE: Final = frozenset({"floating", "planar"})
_MOVING: Final = frozenset({"revolute", "continuous", "prismatic"})
_TREE: Final = "a URDF is a tree, leave one of them out (closed chains: in MJCF, one joint as an equality constraint)"
_KNOWN: Final = _MOVING | {"fixed", "floating", "planar"}
_SHAPES: Final = frozenset({"box", "cylinder", "sphere", "mesh"})
#: Required attributes by element and, where that matters, its parent element.
_NEEDED: Final = {
    "link": ("name",),
    "joint": ("name", "type"),
    "joint/parent": ("link",),
    "joint/child": ("link",),
    "joint/mimic": ("joint",),
    "geometry/mesh": ("filename",),
    "geometry/box": ("size",),
    "geometry/cylinder": ("radius", "length"),
    "geometry/sphere": ("radius",),
}
#: Required elements of a joint.
_ENDS: Final = ("parent", "child")
#: Numeric attributes, and how many numbers each has.
_NUMBERS: Final[Mapping[str, Mapping[str, int | tuple[int, ...]]]] = {
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "box": {"size": 3},
    "cylinder": {"radius": 1, "length": 1},
    "sphere": {"radius": 1},
    "mesh": {"scale": (1, 3)},
    "limit": {"lower": 1, "upper": 1},
    "mimic": {"multiplier": 1, "offset": 1},
    "color": {"rgba": 4},
}


@dataclass(frozen=True)
class Robot:
    """Result of reading a URDF.

    `items` belong to `articulation.parts`, by index. `skipped`: a line for each thing left out; `notes`: a line for
    each likely mistake.
    """

    articulation: Articulation
    items: tuple[DrawnItem, ...]
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
    """Return the robot of a URDF file. Raises `SceneBuildError`.

    Its bodies are called `name/link`. `collisions`: draw collision geometry instead of visuals. `scale`: size factor of
    the drawing; joints keep their positions, also sliding ones.
    """
    check_present(path)
    if get_ending(path) == "xacro":
        raise SceneBuildError(f"{path.name}: {xacro_advice(path)}")
    if get_ending(path) in ENDINGS and get_ending(path) not in (*ROBOTS, "xml"):
        raise SceneBuildError(
            f"{path.name} is no URDF: files that end in .{get_ending(path)} go with add_file, or Session"
        )
    references = References(path, package_dirs)
    data = read_bounded(path)

    def read() -> Robot:  # yourdfpy raises any kind of error for missing attributes
        robot, skipped = parse_urdf(path, data)
        return _Reader(path, name, robot, references, package_dirs, skipped, collisions).robot(T_world_root, scale)

    found: Robot = read_guarded(path, "urdf", read)
    return found if scale == 1.0 else _scale_robot(found, scale)


def _scale_robot(robot: Robot, scale: float) -> Robot:
    """Return the robot in another size."""

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
        self._files: dict[Path, LoadedFile] = {}
        self._notes: dict[str, None] = {}
        self._sizes: list[Drawn] = []
        self._measured: set[tuple[Path, tuple[float, float, float]]] = set()
        self._appearances: dict[str, Appearance | None] = {}
        self._pictures: dict[Path, TextureImage] = {}
        self._budget = PixelBudget(path.name)
        self._materials: dict[str, Any] = {}
        worn = (visual.material for link in robot.links for visual in link.visuals)
        for material in (*robot.materials, *worn):
            if material is not None and material.name and (material.color is not None or material.texture is not None):
                self._materials.setdefault(material.name, material)

    def robot(self, T_world_root: Pose, scale: float) -> Robot:
        """Return the robot. `scale`: size factor by which it will be drawn."""
        root = root_link(self._path.name, self._robot)
        table = read_joints(self._path.name, self._robot)
        below: dict[str, list[Any]] = {}
        for joint in self._robot.joints:
            below.setdefault(joint.parent, []).append(joint)
        links = {link.name: link for link in self._robot.links}
        parts = [ArticulatedBody(f"{self._name}/{root}")]
        items: list[DrawnItem] = []
        loose: dict[str, str] = {}
        waiting: list[tuple[str, int, Matrix]] = [(root, 0, np.eye(4))]
        while waiting:
            name, part, T_part_link = waiting.pop()
            items += self._collect_drawn(links[name], part, T_part_link)
            for joint in reversed(below.get(name, [])):
                T_part_child = T_part_link @ _matrix(self._path.name, joint)
                if joint.type == "fixed":
                    waiting.append((joint.child, part, T_part_child))
                    continue
                body = f"{self._name}/{joint.child}"
                if joint.type in _LOOSE:
                    at = to_pose(T_part_child[:3, :3], T_part_child[:3, 3])
                    parts.append(ArticulatedBody(body, part, at))
                    loose[joint.name] = body
                    waiting.append((joint.child, len(parts) - 1, np.eye(4)))
                    continue
                drive = table.drives[joint.name]
                parts.append(
                    ArticulatedBody(
                        body=body,
                        parent=part,
                        T_parent_joint=to_pose(T_part_child[:3, :3], T_part_child[:3, 3]),
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
        units = robot_question(self._path.name, measure_reach(self._robot.joints, root), self._sizes, scale)
        notes = (*units, *degrees_question(self._path.name, table.joints), *self._notes)
        return Robot(articulation, tuple(items), tuple(self._skipped), notes)

    # --- what is drawn ------------------------------------------------------------------------------------------------

    def _collect_drawn(self, link: Any, part: int, T_part_link: Matrix) -> list[DrawnItem]:
        found: list[DrawnItem] = []
        for shape in link.collisions if self._collisions else link.visuals:
            matrix = T_part_link @ (np.eye(4) if shape.origin is None else shape.origin)
            look = None if self._collisions else self._appearance(shape.material)
            name = truncate_name(shape.name or link.name)
            geometry = shape.geometry
            if geometry.mesh is not None:
                found += self._mesh(geometry.mesh, part, name, matrix, look)
                continue
            kind, size = _shape(self._path.name, geometry)
            self._sizes.append(Drawn(f"shape, a {kind} of {truncate_name(link.name)},", 2.0 * max(size)))
            found.append(DrawnItem(part, name, matrix, look or Appearance(), kind=kind, size=size))
        return found

    def _mesh(self, mesh: Any, part: int, name: str, matrix: Matrix, look: Appearance | None) -> list[DrawnItem]:
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
            DrawnItem(
                part, name, matrix @ scale @ node.matrix, surface.appearance or look or Appearance(), surface.mesh
            )
            for node in loaded.nodes
            for surface in node.surfaces
        ]

    def _measure(self, path: Path, loaded: LoadedFile, given: tuple[float, float, float], scale: Matrix) -> None:
        """Record the size of a mesh, with the scale of its `<mesh>`; once for each scale."""
        if (path, given) not in self._measured:
            self._measured.add((path, given))
            placed = [(surface.mesh, scale @ node.matrix) for node in loaded.nodes for surface in node.surfaces]
            self._sizes.append(Drawn(f"mesh, {path.name},", measure_side(placed), given))

    def _appearance(self, material: Any) -> Appearance | None:
        """Return the appearance of a URDF material; one without colour refers to another one by name."""
        if material is None:
            return None
        known = material
        if material.color is None and material.texture is None:
            known = self._materials.get(material.name or "")
        if known is None:
            self._skip(f"material {material.name!r}, which has neither colour nor texture anywhere")
            return None
        key = f"{known.name} {known.color} {known.texture}"
        if key not in self._appearances:
            rgba = self._rgba(known)
            self._appearances[key] = Appearance(
                rgba=rgba, name=truncate_name(known.name or ""), images=self._texture(known.texture)
            )
        return self._appearances[key]

    def _rgba(self, material: Any) -> Rgba:
        values = (1.0,) * 4 if material.color is None else tuple(float(v) for v in material.color.rgba)
        if len(values) != 4 or not all(map(math.isfinite, values)):
            raise SceneBuildError(f"{self._path.name}: material {material.name!r} needs rgba of four finite numbers")
        self._notes |= dict.fromkeys(colour_question(self._path.name, truncate_name(material.name or ""), values))
        red, green, blue, alpha = (min(max(v, 0.0), 1.0) for v in values)
        return red, green, blue, alpha

    def _texture(self, texture: Any) -> tuple[tuple[str, TextureImage], ...]:
        if texture is None or not texture.filename:
            return ()
        path = self._references.find(texture.filename)
        if path not in self._pictures:
            pixels = self._budget.spend(read_pixels(read_bounded(path), str(path)))
            self._pictures[path] = TextureImage(pixels, truncate_name(path.stem))
        picture = self._pictures[path]
        return ((TextureRole.RGBA if picture.pixels.shape[2] == 4 else TextureRole.RGB, picture),)

    def _skip(self, text: str) -> None:
        self._skipped[f"{self._path.name}: {text}"] = None


def _matrix(file: str, joint: Any) -> Matrix:
    """Return T_parent_joint of the file."""
    matrix = np.eye(4) if joint.origin is None else np.asarray(joint.origin, np.float64)
    if not np.isfinite(matrix).all():
        raise SceneBuildError(f"{file}: the origin of joint {joint.name} is not finite")
    return matrix


def _shape(file: str, geometry: Any) -> tuple[str, tuple[float, float, float]]:
    """Return kind and size of a simple shape, as in `Geometry`."""
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


# --- joints -----------------------------------------------------------------------------------------------------------


class Drive(NamedTuple):
    """Drive of one joint: joint `joint` of the table, times `multiplier` plus `offset`, along or around `axis`."""

    joint: int
    multiplier: float
    offset: float
    axis: Vec3


class JointTable(NamedTuple):
    """Joints of a robot.

    `joints`: those that are set, in the order of the file; `drives`: by the names of moving joints; `mimics`: those
    that follow others.
    """

    joints: tuple[Joint, ...]
    drives: Mapping[str, Drive]
    mimics: Mapping[str, str]


def root_link(file: str, robot: Any) -> str:
    """Return the link that no joint moves. Raises `SceneBuildError` unless links and joints form one tree."""
    names = [link.name for link in robot.links]
    if len(set(names)) != len(names) or not names:
        raise SceneBuildError(f"{file}: no link, or two of one name: {_repeated(names)}")
    held: dict[str, str] = {}
    known = set(names)
    for joint in robot.joints:
        for link in (joint.parent, joint.child):
            if link not in known:
                raise SceneBuildError(f"{file}: joint {joint.name} refers to link {link!r}, which is not there")
        if joint.child in held:
            raise SceneBuildError(
                f"{file}: link {joint.child} hangs on two joints, {held[joint.child]} and {joint.name}: {_TREE}"
            )
        held[joint.child] = joint.name
    roots = [name for name in names if name not in held]
    if len(roots) > 1:
        raise SceneBuildError(
            f"{file}: {len(roots)} links hang on no joint ({', '.join(roots[:8])}): in a URDF one does, join the others"
        )
    below: dict[str, list[str]] = {}
    for joint in robot.joints:
        below.setdefault(joint.parent, []).append(joint.child)
    reached, waiting = set(roots), roots.copy()
    while waiting:
        found = below.get(waiting.pop(), [])
        reached.update(found)
        waiting += found
    if len(reached) != len(names):
        joints = _loop(robot, next(name for name in names if name not in reached))
        raise SceneBuildError(f"{file}: the joints {', '.join(joints[:8])} make a loop: {_TREE}")
    return str(roots[0])


def _loop(robot: Any, link: str) -> list[str]:
    """Return the joints of the loop that contains a link or an ancestor of it, from link to link."""
    above = {joint.child: (joint.parent, joint.name) for joint in robot.joints}
    places: dict[str, int] = {}
    joints: list[str] = []
    while link not in places:
        places[link] = len(joints)
        link, name = above[link]
        joints.append(name)
    return joints[places[link] :][::-1]


def read_joints(file: str, robot: Any) -> JointTable:
    """Return the joints of a robot that is a tree. Raises `SceneBuildError`."""
    by_name = {joint.name: joint for joint in robot.joints}
    if len(by_name) != len(robot.joints):
        raise SceneBuildError(f"{file}: two joints of one name: {_repeated([joint.name for joint in robot.joints])}")
    for joint in robot.joints:
        if joint.type not in _KNOWN:
            raise SceneBuildError(
                f"{file}: joint {joint.name} of type {joint.type!r}; types are {', '.join(sorted(_KNOWN))}"
            )
    moving = [joint for joint in robot.joints if joint.type in _MOVING]
    free = [joint for joint in moving if joint.mimic is None]
    places = {joint.name: place for place, joint in enumerate(free)}
    drives, mimics = {}, {}
    for joint in moving:
        source, multiplier, offset = _followed(file, joint, by_name)
        drives[joint.name] = Drive(places[source], multiplier, offset, _axis(file, joint))
        if joint.mimic is not None:
            mimics[joint.name] = source
    return JointTable(tuple(_limits(file, joint) for joint in free), drives, mimics)


def _followed(file: str, joint: Any, by_name: Mapping[str, Any]) -> tuple[str, float, float]:
    """Return the joint that is set, with multiplier and offset of its position, along a chain of mimics."""
    multiplier, offset, seen = 1.0, 0.0, {joint.name}
    while joint.mimic is not None:
        times = 1.0 if joint.mimic.multiplier is None else float(joint.mimic.multiplier)
        plus = 0.0 if joint.mimic.offset is None else float(joint.mimic.offset)
        if not (math.isfinite(times) and math.isfinite(plus)):
            raise SceneBuildError(f"{file}: joint {joint.name} follows by a number that is not finite")
        multiplier, offset = multiplier * times, offset + multiplier * plus
        followed = by_name.get(joint.mimic.joint)
        if followed is None or followed.type not in _MOVING or followed.name in seen:
            raise SceneBuildError(
                f"{file}: joint {joint.name} follows {joint.mimic.joint!r}, which does not move, or follows it in turn"
            )
        seen.add(followed.name)
        joint = followed
    return joint.name, multiplier, offset


def _axis(file: str, joint: Any) -> Vec3:
    axis = np.asarray(joint.axis, np.float64).reshape(-1)
    length = float(np.linalg.norm(axis)) if axis.shape == (3,) else 0.0
    if not math.isfinite(length) or length < 1e-9:
        raise SceneBuildError(f"{file}: the axis of joint {joint.name} is {joint.axis}: three numbers, not all 0")
    x, y, z = (axis / length).tolist()
    return x, y, z


def _limits(file: str, joint: Any) -> Joint:
    """Return a joint with its limits: a missing one counts as 0, as in URDF; without both there are none."""
    low, high = -math.inf, math.inf
    limit = joint.limit
    if joint.type != "continuous" and limit is not None and (limit.lower is not None or limit.upper is not None):
        low, high = float(limit.lower or 0.0), float(limit.upper or 0.0)
    if math.isnan(low) or math.isnan(high) or low > high:
        raise SceneBuildError(f"{file}: joint {joint.name} has limits from {low} to {high}")
    return Joint(joint.name, joint.type, low, high, min(max(0.0, low), high))


def _repeated(names: list[str]) -> str:
    return ", ".join(sorted({name for name in names if names.count(name) > 1})) or "none"


# --- document ---------------------------------------------------------------------------------------------------------


def parse_urdf(path: Path, data: bytes) -> tuple[Any, dict[str, None]]:
    """Return the robot of yourdfpy, and a line for each element that was removed. Raises `SceneBuildError`."""
    try:
        import yourdfpy
        from lxml import etree
    except ImportError:
        raise SceneBuildError("URDF files need yourdfpy: pip install 'iris-session[files]'") from None
    root = _document(etree, path, data)
    if root.getroottree().docinfo.doctype:
        raise SceneBuildError(f"{path} has a DOCTYPE: remove it")
    if root.tag != "robot":
        raise SceneBuildError(f"{path} is no URDF: it begins with <{root.tag}> where <robot> is needed")
    if any("xacro" in str(space) for space in root.nsmap.values()) and b"<xacro:" in data:
        raise SceneBuildError(f"{path}: {xacro_advice(path)}")
    if not root.get("name"):
        root.set("name", path.stem)  # yourdfpy needs a name; it is not used
    skipped = _without_other_shapes(path, root)
    _check(path, root)
    made = yourdfpy.URDF.load(
        io.BytesIO(etree.tostring(root)),
        build_scene_graph=False,
        build_collision_scene_graph=False,
        load_meshes=False,
        load_collision_meshes=False,
    )
    return made.robot, skipped


def _document(etree: Any, path: Path, data: bytes) -> Any:
    """Return the document without elements of undeclared prefixes: these are common extensions for one simulator."""
    safe = {"resolve_entities": False, "no_network": True, "huge_tree": False}
    parser = etree.XMLParser(**safe)
    try:
        return etree.fromstring(data, parser)
    except etree.XMLSyntaxError as error:
        if any(entry.domain_name != "NAMESPACE" for entry in parser.error_log):
            raise SceneBuildError(no_xml(str(path), data, "robot", error.lineno, error.msg)) from None
    root = etree.fromstring(data, etree.XMLParser(recover=True, **safe))
    for element in list(root.iter(etree.Element)):
        if element.prefix is None and ":" in element.tag and not element.tag.startswith("{"):
            element.getparent().remove(element)
            continue
        for name in [name for name in element.attrib if ":" in name and not name.startswith("{")]:
            del element.attrib[name]
    return root


def _without_other_shapes(path: Path, root: Any) -> dict[str, None]:
    skipped: dict[str, None] = {}
    for holder in [*root.iter("visual"), *root.iter("collision")]:
        geometry = holder.find("geometry")
        shape = (
            next((child.tag for child in geometry if isinstance(child.tag, str)), "") if geometry is not None else ""
        )
        if shape not in _SHAPES:
            link = holder.getparent().get("name", "")
            skipped[f"{path.name}: {holder.tag} of link {link}: shape {shape or 'none'!r}"] = None
            holder.getparent().remove(holder)
    return skipped


def _check(path: Path, root: Any) -> None:
    """Raise `SceneBuildError` for missing attributes and invalid numbers.

    Only elements that are drawn are checked: transmissions and sensors have joints and limits of their own, and
    exporters write masses in several ways.
    """
    for part in root:
        if part.tag in ("link", "joint", "material"):
            for element in part.iter():
                if isinstance(element.tag, str) and element.getparent().tag != "inertial":
                    _check_element(path, element)
        if part.tag == "joint":
            for end in _ENDS:
                if part.find(end) is None:
                    raise SceneBuildError(f'{_format_place(path, part)} has no <{end} link="...">')


def _check_element(path: Path, element: Any) -> None:
    above = element.getparent().tag
    needed = _NEEDED.get(f"{above}/{element.tag}", _NEEDED.get(element.tag, ()) if above == "robot" else ())
    for name in needed:
        if not element.get(name):
            raise SceneBuildError(f"{_format_place(path, element)} has no {name}")
    for name, count in _NUMBERS.get(element.tag, {}).items():
        text = element.get(name)
        if text is None:
            continue
        try:
            values = [float(word) for word in text.split()]
        except ValueError:
            values = []
        counts = count if isinstance(count, tuple) else (count,)
        endless = element.tag == "limit" and not any(map(math.isnan, values))
        if len(values) not in counts or not (endless or all(map(math.isfinite, values))):
            wanted = "one finite number" if counts == (1,) else f"{' or '.join(map(str, counts))} finite numbers"
            raise SceneBuildError(f"{_format_place(path, element)}: {name} is {text[:60]!r} where {wanted} must stand")


def _format_place(path: Path, element: Any) -> str:
    """Return the position of an element, for messages."""
    name = element.get("name") or ""
    return f"{path.name}, line {element.sourceline}: <{element.tag}>{f' {name}' if name else ''}"
