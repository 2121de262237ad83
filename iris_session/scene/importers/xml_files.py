"""Checks of DAE and 3MF files before they are read: no external entities, no unbounded expansion of entities, and no
instances nested so often that memory runs out. trimesh and pycollada follow all of these, so they are counted first.
"""

from __future__ import annotations

import graphlib
import io
import re
import zipfile
from collections.abc import Iterator
from typing import Any, Final, NamedTuple

from iris_session.scene.errors import SceneBuildError
from iris_session.scene.nodes import MAX_FILE_BYTES, MAX_NODES, MAX_TRIANGLES

#: Encodings in which the text that is searched for here has the bytes of ASCII.
_PLAIN: Final = frozenset(
    {"utf-8", "utf8", "us-ascii", "ascii", "iso-8859-1", "iso-8859-15", "latin-1", "windows-1252"}
)
_ENCODING: Final = re.compile(rb"""^<\?xml[^>]{0,200}?encoding\s*=\s*["']([^"']{1,40})["']""")
_BOM: Final = b"\xef\xbb\xbf"
#: Maximum depth of nesting.
_MAX_DEPTH: Final = 64
#: Minimum characters of a triangle in a DAE: three numbers of one digit with separators.
_TRIANGLE_CHARACTERS: Final = 6
#: The first file of a 3MF whose name has this in it, in any case, is the one that trimesh reads.
_MAIN_MODEL: Final = "3d/3dmodel.model"
#: A triangle of a 3MF, with any namespace prefix.
_TRIANGLE: Final = re.compile(rb"<(?:[\w.-]+:)?triangle[\s/>]")


def check_dae(name: str, data: bytes) -> None:
    """Check a DAE. Raises `SceneBuildError`. A geometry counts wherever it is placed, because it is copied there."""
    check_xml(name, data)
    try:
        links, weights = _dae_places(data)
    except SyntaxError as error:  # raised by lxml
        raise SceneBuildError(no_xml(name, data, "COLLADA", error.lineno or 1, error.msg)) from None
    _check_places(name, links, weights, MAX_TRIANGLES, "triangles")


def check_3mf(name: str, data: bytes) -> None:
    """Check a 3MF. Raises `SceneBuildError`; bytes that are no archive are left to the reader."""
    if not zipfile.is_zipfile(io.BytesIO(data)):
        raise SceneBuildError(f"{name} is cut, or no 3MF, which is a ZIP archive: export or download it again")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
        if size > MAX_FILE_BYTES:
            raise SceneBuildError(f"{name} unpacks to {size >> 20} MiB, at most {MAX_FILE_BYTES >> 20} are read")
        places: dict[str, list[str]] = {}
        triangles: dict[str, int] = {}
        outside: list[str] = []
        names = archive.namelist()
        if len(set(names)) < len(names):
            raise SceneBuildError(f"{name} holds two files of one name: export it again")
        for file in names:
            if _MAIN_MODEL in file.lower() or file.lower().endswith(".model"):
                model = _read_model(name, archive, file, triangles)
                if _MAIN_MODEL in file.lower():  # the file that places the objects
                    for thing, parts, files in _3mf_places(model):
                        places.setdefault(thing, []).extend(parts)
                        outside += files
        for file in {*outside} & {*names} - {*triangles}:  # files of any name may be referred to
            _read_model(name, archive, file, triangles)
    things = {*places, *(part for parts in places.values() for part in parts)}
    _check_places(name, places, dict.fromkeys(sorted(things), 1.0), MAX_NODES, "parts")
    _check_outside(name, sum(triangles.get(file, 0) for file in outside))


def _read_model(name: str, archive: zipfile.ZipFile, file: str, triangles: dict[str, int]) -> bytes:
    """Return a file of a 3MF after its check, and note its triangles."""
    model = archive.read(file)
    check_xml(name, model)
    triangles[file] = len(_TRIANGLE.findall(model))
    return model


def check_xml(name: str, data: bytes) -> None:
    """Raise `SceneBuildError` for a DOCTYPE or another encoding.

    Entities of a DOCTYPE may be other files or expand without bound, and other encodings could hide one.
    """
    start = data.removeprefix(_BOM)[:1024].lstrip()
    declared = _ENCODING.match(start)
    if not start.startswith(b"<") or (declared and declared.group(1).decode(errors="replace").lower() not in _PLAIN):
        raise SceneBuildError(f"{name} is no XML in UTF-8: save it as that")
    if b"<!DOCTYPE" in data:
        raise SceneBuildError(f"{name} has a DOCTYPE: remove it")


def no_xml(name: str, data: bytes, root: str, line: int, said: str) -> str:
    """Return a message on a document with outermost element `root` that does not parse.

    `said`: message of the parser, at line `line`.
    """
    if f"<{root}".encode() in data and f"</{root}".encode() not in data:
        lines = data.count(b"\n") + 1
        return f"{name} is cut: it ends in line {lines}, without </{root}>; export or download it again"
    what = " ".join(said.partition(", line ")[0].split())
    return f"{name}, line {line}: this is no XML ({what}); mend that line, or export the file again"


class _Dae(NamedTuple):
    """Instances in a DAE. `links`: by each element, those placed in it, repeated; `weights`: triangles of each."""

    links: dict[str, list[str]]
    weights: dict[str, float]


#: `library_nodes`: its content is drawn only where it is referred to.
_DAE_THINGS: Final = ("node", "geometry", "controller", "library_nodes")


def _dae_places(data: bytes) -> _Dae:
    """Return nodes by serial numbers, and geometries, controllers and nodes that are referred to by their ids."""
    links: dict[str, list[str]] = {"": []}
    weights: dict[str, float] = {}
    above: list[str] = [""]
    for event, element in _events(data, recover=False):  # as pycollada
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
    """Raise `SceneBuildError` for too many triangles in other files of the archive (production extension).

    trimesh reads all meshes of such a file each time that one is referred to.
    """
    if triangles > MAX_TRIANGLES:
        raise SceneBuildError(
            f"{name} refers to its other files so often that {triangles:,} triangles are read, at most "
            f"{MAX_TRIANGLES:,}: export it as one model, without the production extension"
        )


def _3mf_places(model: bytes) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yield objects, the objects that they consist of, and the files of these where it is another one.

    The build is yielded as an object without a name.
    """
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
    """Count what is drawn by the element without a name, everything as often as it is placed.

    Raises `SceneBuildError` for too much or too deep nesting.
    """
    try:
        order = [*graphlib.TopologicalSorter(links).static_order()]
    except graphlib.CycleError:
        raise SceneBuildError(f"{name} contains an instance of itself: remove it") from None
    drawn: dict[str, float] = {}
    depth: dict[str, int] = {}
    for thing in order:  # contained elements come first
        below = links.get(thing, ())
        drawn[thing] = weights.get(thing, 0.0) + sum(drawn[one] for one in below)
        depth[thing] = 1 + max((depth[one] for one in below), default=0)
    if drawn.get("", 0.0) > most or depth.get("", 0) > _MAX_DEPTH:
        raise SceneBuildError(
            f"{name} places its parts so often within one another that it draws {drawn.get('', 0.0):,.0f} {what} "
            f"in {depth.get('', 0)} levels, at most {most:,} in {_MAX_DEPTH}: make it simpler"
        )
