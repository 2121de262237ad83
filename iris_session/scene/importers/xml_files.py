"""XML of untrusted files: documents without a DOCTYPE, so without entities, and DAE files without instances nested so
often that memory runs out. pycollada follows all of these, so it gets the document as it was checked here.
"""

from __future__ import annotations

import graphlib
from typing import Any, Final
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.sax import ContentHandler, SAXParseException

from iris_session.scene.errors import SceneBuildError
from iris_session.scene.nodes import MAX_NODES, MAX_TRIANGLES

#: Maximum depth of instances within one another.
_MAX_DEPTH: Final = 64
#: Minimum characters of a triangle in a DAE: three numbers of one digit with separators.
_TRIANGLE_CHARACTERS: Final = 6
#: Elements that hold instances; the content of `library_nodes` is drawn only where it is referred to.
_HOLDERS: Final = ("node", "geometry", "controller", "library_nodes")


class _Element(Element):
    """An element with the `line` of the file in which it begins."""

    line = 0


class _TreeHandler(ContentHandler):
    """Builder of a tree of elements with their lines. Prefixes need no declaration: some exporters leave it out."""

    def __init__(self) -> None:
        super().__init__()
        self._builder = ElementTree.TreeBuilder(element_factory=_Element)
        self._locator: Any = None

    def setDocumentLocator(self, locator: Any) -> None:
        self._locator = locator

    def startElement(self, name: str, attrs: Any) -> None:
        element: Any = self._builder.start(name, dict(attrs))
        element.line = self._locator.getLineNumber()

    def characters(self, content: str) -> None:
        self._builder.data(content)

    def endElement(self, name: str) -> None:
        self._builder.end(name)

    def close(self) -> Any:
        return self._builder.close()


def parse_xml(name: str, data: bytes, root: str) -> Element:
    """Return the outermost element of a document. Names keep their prefixes.

    Args:
        name: Name of the file, for messages.
        data: Bytes of the file.
        root: Tag that the outermost element should have, for messages.

    Raises:
        SceneBuildError: It has a DOCTYPE, whose entities may be other files or expand without bound, or is no XML.
    """
    try:
        from defusedxml import DefusedXmlException, sax
    except ImportError:
        raise SceneBuildError(f"{name}: XML files need defusedxml: pip install 'iris-session[files]'") from None
    handler = _TreeHandler()
    try:
        sax.parseString(data, handler, forbid_dtd=True)
    except DefusedXmlException:
        raise SceneBuildError(f"{name} has a DOCTYPE: remove it") from None
    except (LookupError, ValueError) as error:
        raise SceneBuildError(f"{name} is no XML in UTF-8: save it as that ({error})") from None
    except SAXParseException as error:
        if f"<{root}".encode() in data and f"</{root}".encode() not in data:
            lines = data.count(b"\n") + 1
            raise SceneBuildError(
                f"{name} is cut: it ends in line {lines}, without </{root}>; export or download it again"
            ) from None
        raise SceneBuildError(
            f"{name}, line {error.getLineNumber()}: this is no XML ({error.getMessage()}); mend that line, or export "
            "the file again"
        ) from None
    element: Element = handler.close()
    return element


def check_dae(name: str, data: bytes) -> bytes:
    """Return a DAE for the reader, written again from what was checked.

    A geometry counts wherever it is placed, because it is copied there. Raises `SceneBuildError`.
    """
    root = parse_xml(name, data, "COLLADA")
    links: dict[str, list[str]] = {"": []}  # what is placed in each element, repeated; nodes by serial numbers
    triangles: dict[str, float] = {}
    nodes: set[str] = set()
    waiting = [(root, "")]
    while waiting:
        element, holder = waiting.pop()
        tag = element.tag.rpartition(":")[2]
        if tag in _HOLDERS:
            own = f"{len(links)}"
            links[own] = []
            if tag == "node":
                links[holder].append(own)
                nodes.add(own)
            if identity := element.get("id"):
                links.setdefault(f"#{identity}", []).append(own)
            holder = own
        elif tag.startswith("instance_") or tag == "skin":
            if place := element.get("url") or element.get("source"):
                links[holder].append(place)
        elif tag == "p":
            triangles[holder] = triangles.get(holder, 1.0) + len(element.text or "") / _TRIANGLE_CHARACTERS
        waiting += [(child, holder) for child in element]
    _check_instances(name, links, triangles, nodes)
    checked: bytes = ElementTree.tostring(root, "utf-8")
    return checked


def _check_instances(name: str, links: dict[str, list[str]], triangles: dict[str, float], nodes: set[str]) -> None:
    """Count what the file draws, everything as often as it is placed. Raises `SceneBuildError` for too much."""
    try:
        order = [*graphlib.TopologicalSorter(links).static_order()]
    except graphlib.CycleError:
        raise SceneBuildError(f"{name} contains an instance of itself: remove it") from None
    drawn: dict[str, float] = {}
    parts: dict[str, int] = {}
    depth: dict[str, int] = {}
    for thing in order:  # contained elements come first
        below = links.get(thing, ())
        drawn[thing] = triangles.get(thing, 0.0) + sum(drawn[one] for one in below)
        parts[thing] = (thing in nodes) + sum(parts[one] for one in below)
        depth[thing] = 1 + max((depth[one] for one in below), default=0)
    if drawn[""] > MAX_TRIANGLES or parts[""] > MAX_NODES or depth[""] > _MAX_DEPTH:
        raise SceneBuildError(
            f"{name} places its parts so often within one another that it draws {drawn['']:,.0f} triangles of "
            f"{parts['']:,} parts in {depth['']} levels, at most {MAX_TRIANGLES:,}, {MAX_NODES:,} and {_MAX_DEPTH}: "
            "make it simpler"
        )
