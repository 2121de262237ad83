"""Checks of DAE and 3MF files before they are read: no external entities, no unbounded growth by entities, and no
instances nested so often that memory ends. trimesh and pycollada follow all of that, so it is counted before they read.
"""

from __future__ import annotations

import graphlib
import io
import re
import zipfile
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from iris_session.scene.elements import MAX_FILE_BYTES, MAX_NODES, MAX_TRIANGLES
from iris_session.scene.errors import SceneBuildError

#: Encodings in which what is looked for here has the bytes of ASCII.
_PLAIN: Final = frozenset(
    {"utf-8", "utf8", "us-ascii", "ascii", "iso-8859-1", "iso-8859-15", "latin-1", "windows-1252"}
)
_ENCODING: Final = re.compile(rb"""^<\?xml[^>]{0,200}?encoding\s*=\s*["']([^"']{1,40})["']""")
_BOM: Final = b"\xef\xbb\xbf"
#: Most levels of things within things.
_MAX_DEPTH: Final = 64
#: Characters of a DAE that a triangle takes at least: three numbers of one digit, and what is between them.
_TRIANGLE_CHARACTERS: Final = 6
#: One of a 3MF, whatever the prefix of its name.
_TRIANGLE: Final = re.compile(rb"<(?:[\w.-]+:)?triangle[\s/>]")


def check_dae(name: str, data: bytes) -> None:
    """Raises `SceneBuildError`. What a geometry of the file costs is copied wherever it is placed."""
    check_xml(name, data)
    try:
        links, weights = _dae_places(data)
    except SyntaxError as error:  # as lxml has it
        raise SceneBuildError(no_xml(name, data, "COLLADA", error.lineno or 1, error.msg)) from None
    _check_places(name, links, weights, MAX_TRIANGLES, "triangles")


def check_3mf(name: str, data: bytes) -> None:
    """Raises `SceneBuildError`; for other bytes, what the reader says of them is left to it."""
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise SceneBuildError(f"{name} is cut, or no 3MF, which is a ZIP archive: export or download it again")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_FILE_BYTES:
            raise SceneBuildError(f"{name} unpacks to {size >> 20} MiB, at most {MAX_FILE_BYTES >> 20} are read")
        places: dict[str, list[str]] = {}
        triangles: dict[str, int] = {}
        outside: list[str] = []
        for entry in archive.infolist():
            if entry.filename.lower().endswith(".model"):
                model = archive.read(entry)
                check_xml(name, model)
                triangles[entry.filename] = len(_TRIANGLE.findall(model))
                if "3d/3dmodel.model" in entry.filename.lower():  # the one that says what is where
                    for thing, parts, files in _3mf_places(model):
                        places.setdefault(thing, []).extend(parts)
                        outside += files
    things = {*places, *(part for parts in places.values() for part in parts)}
    _check_places(name, places, dict.fromkeys(sorted(things), 1.0), MAX_NODES, "parts")
    _check_outside(name, sum(triangles.get(file, 0) for file in outside))


def check_xml(name: str, data: bytes) -> None:
    """Raises `SceneBuildError` for a DOCTYPE, whose entities may be other files, or grow, and for encodings that would
    hide one."""
    start = data.removeprefix(_BOM)[:1024].lstrip()
    declared = _ENCODING.match(start)
    if not start.startswith(b"<") or (declared and declared.group(1).decode(errors="replace").lower() not in _PLAIN):
        raise SceneBuildError(f"{name} is no XML in UTF-8: save it as that")
    if b"<!DOCTYPE" in data:
        raise SceneBuildError(f"{name} has a DOCTYPE: remove it")


def no_xml(name: str, data: bytes, root: str, line: int, said: str) -> str:
    """For people: why a document whose outermost element is `root` does not parse. `said`: the parser, in `line`."""
    if f"<{root}".encode() in data and f"</{root}".encode() not in data:
        lines = data.count(b"\n") + 1
        return f"{name} is cut: it ends in line {lines}, without </{root}>; export or download it again"
    what = " ".join(said.partition(", line ")[0].split())
    return f"{name}, line {line}: this is no XML ({what}); mend that line, or export the file again"


class _Dae(NamedTuple):
    """`links`: by a thing, those placed in it, as often as they are; `weights`: triangles of each."""

    links: dict[str, list[str]]
    weights: dict[str, float]


#: `library_nodes`: what is in it is drawn where it is referred to, and nowhere else.
_DAE_THINGS: Final = ("node", "geometry", "controller", "library_nodes")


def _dae_places(data: bytes) -> _Dae:
    """Nodes by numbers of their own, geometries, controllers and nodes that are referred to by their ids."""
    links: dict[str, list[str]] = {"": []}
    weights: dict[str, float] = {}
    above: list[str] = [""]
    for event, element in _events(data, recover=False):  # no more does pycollada
        tag = str(element.tag).rpartition("}")[2] if isinstance(element.tag, str) else ""
        if tag in _DAE_THINGS:
            if event == "start":
                own = f"{len(links)}"
                links[own] = []
                if tag == "node":
                    links[above[-1]].append(own)
                if identity := element.get("id"):
                    links.setdefault(f"#{identity}", []).append(own)
                above.append(own)
            else:
                above.pop()
                element.clear()
        elif event == "end":
            if tag.startswith("instance_") or tag == "skin":
                if place := element.get("url") or element.get("source"):
                    links[above[-1]].append(place)
            elif tag == "p":
                weights[above[-1]] = weights.get(above[-1], 1.0) + len(element.text or "") / _TRIANGLE_CHARACTERS
    return _Dae(links, weights)


def _check_outside(name: str, triangles: int) -> None:
    """Of other files of the archive (production extension) all meshes are read, each time that one is referred to."""
    if triangles > MAX_TRIANGLES:
        raise SceneBuildError(
            f"{name} refers to its other files so often that {triangles:,} triangles are read, at most "
            f"{MAX_TRIANGLES:,}: export it as one model, without the production extension"
        )


def _3mf_places(model: bytes) -> Iterator[tuple[str, list[str], list[str]]]:
    """Objects, those that they are put together of, and the files that these are in, where that is another one; what is
    built, as one without a name."""
    for event, element in _events(model, recover=True):
        if event == "end" and isinstance(element.tag, str):
            tag = element.tag.rpartition("}")[2]
            if tag in ("object", "build"):
                parts = [*element.iter("{*}component" if tag == "object" else "{*}item")]
                files = [value.strip("/") for part in parts for key, value in part.items() if key.endswith("path")]
                thing = element.get("id", "") if tag == "object" else ""
                yield thing, [part.get("objectid", "?") for part in parts], files
                element.clear()


def _events(data: bytes, *, recover: bool) -> Iterator[tuple[str, Any]]:
    try:
        from lxml import etree
    except ImportError:
        raise SceneBuildError("DAE and 3MF files need lxml: pip install 'iris-session[files]'") from None
    yield from etree.iterparse(
        io.BytesIO(data),
        events=("start", "end"),
        resolve_entities=False,
        no_network=True,
        huge_tree=True,
        recover=recover,
    )


def _check_places(name: str, links: dict[str, list[str]], weights: dict[str, float], most: int, what: str) -> None:
    """Counts what is drawn of the thing without a name, everything as often as it is placed."""
    try:
        order = [*graphlib.TopologicalSorter(links).static_order()]
    except graphlib.CycleError:
        raise SceneBuildError(f"{name} places something within itself: nobody can draw that") from None
    drawn: dict[str, float] = {}
    depth: dict[str, int] = {}
    for thing in order:  # what is within something comes before it
        below = links.get(thing, ())
        drawn[thing] = weights.get(thing, 0.0) + sum(drawn[one] for one in below)
        depth[thing] = 1 + max((depth[one] for one in below), default=0)
    if drawn.get("", 0.0) > most or depth.get("", 0) > _MAX_DEPTH:
        raise SceneBuildError(
            f"{name} places its parts so often within one another that it draws {drawn.get('', 0.0):,.0f} {what} "
            f"in {depth.get('', 0)} levels, at most {most:,} in {_MAX_DEPTH}: make it simpler"
        )
