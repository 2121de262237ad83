"""The document of a URDF: what yourdfpy needs and does not check, checked, with the line; what it does not know, taken
out and told."""

from __future__ import annotations

import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from iris_session.scene.errors import SceneBuildError
from iris_session.scene.files import xacro_advice
from iris_session.scene.xml_files import no_xml

_SHAPES: Final = frozenset({"box", "cylinder", "sphere", "mesh"})
#: Attributes without which an element says nothing, by the element and, where that matters, what it stands in.
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
#: Elements that a joint needs.
_ENDS: Final = ("parent", "child")
#: Attributes that are numbers, and how many of them.
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


def parsed(path: Path, data: bytes) -> tuple[Any, dict[str, None]]:
    """The robot as yourdfpy has it, and what was taken out of it, a line each. Raises `SceneBuildError`."""
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
        root.set("name", path.stem)  # yourdfpy wants one, and nobody reads it
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
    """The document, without what has a prefix that nobody declared: extensions of one simulator, often found so."""
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
    """Raises `SceneBuildError` for what is missing, and for numbers that are none. Only what the robot is drawn of:
    transmissions and sensors have joints and limits of their own, and exporters write masses as they know them."""
    for part in root:
        if part.tag in ("link", "joint", "material"):
            for element in part.iter():
                if isinstance(element.tag, str) and element.getparent().tag != "inertial":
                    _check_element(path, element)
        if part.tag == "joint":
            for end in _ENDS:
                if part.find(end) is None:
                    raise SceneBuildError(f'{_at(path, part)} has no <{end} link="...">')


def _check_element(path: Path, element: Any) -> None:
    above = element.getparent().tag
    needed = _NEEDED.get(f"{above}/{element.tag}", _NEEDED.get(element.tag, ()) if above == "robot" else ())
    for name in needed:
        if not element.get(name):
            raise SceneBuildError(f"{_at(path, element)} has no {name}")
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
            raise SceneBuildError(f"{_at(path, element)}: {name} is {text[:60]!r} where {wanted} must stand")


def _at(path: Path, element: Any) -> str:
    """Where an element stands, for error texts."""
    name = element.get("name") or ""
    return f"{path.name}, line {element.sourceline}: <{element.tag}>{f' {name}' if name else ''}"
