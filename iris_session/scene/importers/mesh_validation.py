"""Checks of mesh files that trimesh reads without an error although they are damaged: truncated files, absent vertices.

Of OBJ also corners that count from the end, which mean another vertex in every line and trimesh takes from the end of
the file, and those with 0 for a texture coordinate or normal that they do not have, as some exporters write. Names and
comments may be in any encoding, numbers are ASCII. Each check is given the file's name and bytes, and returns the bytes
to be read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Final

from iris_session.scene.errors import SceneBuildError

_STL_HEAD: Final = 84
_STL_TRIANGLE: Final = 50
#: Largest head of a PLY that is searched.
_PLY_HEAD: Final = 1 << 16
#: A corner of a face, of an OBJ line, that is 0 or negative.
_ODD_CORNER: Final = re.compile(rb"^[ \t]*f(?=[ \t])[^\n]*?[ \t/](?:-|0+(?:[/ \t\r\n]|$))", re.MULTILINE)
_NO_NORMAL: Final = re.compile(rb"^[ \t]*f[ \t][^\n]*?/[^ \t\n/]*/0+(?=[ \t\r\n]|$)", re.MULTILINE)
#: Lines of an OBJ with numbers. A comment behind them; one with bytes that are no text of numbers, or that begins so;
#: a face with fewer than three corners.
_BEHIND: Final = re.compile(rb"^([ \t]*(?:v[tnp]?|f)[ \t][^\n#]*)#[^\n]*", re.MULTILINE)
_NO_TEXT: Final = re.compile(rb"^[ \t]*(?:(?:v[tnp]?|f)[ \t][^\n]*)?[\x00\x80-\xff]", re.MULTILINE)
_FEW_CORNERS: Final = re.compile(rb"^[ \t]*f(?:[ \t]+\S+){0,2}[ \t]*\r?$", re.MULTILINE)
_BOM: Final = b"\xef\xbb\xbf"
_OBJ_LISTS: Final = (b"v", b"vt", b"vn")
#: Of what is no corner, in the error text [characters].
_SHOWN: Final = 60
_WHAT: Final = ("vertex", "texture coordinate", "normal")


def stl(name: str, data: bytes) -> bytes:
    """A binary one has as many triangles as it says, one of text an end."""
    count = int.from_bytes(data[80:_STL_HEAD], "little")
    size = _STL_HEAD + count * _STL_TRIANGLE
    if len(data) >= _STL_HEAD and len(data) == size:
        return data
    if data[:512].lstrip()[:5].lower() == b"solid" and b"\0" not in data[:512]:
        if b"endsolid" not in data[-4096:].lower():
            raise SceneBuildError(f"{name} is cut: an STL of text ends with endsolid; export or download it again")
        return data
    if len(data) < size or len(data) < _STL_HEAD:
        raise SceneBuildError(
            f"{name} is cut, or no STL: its head says {count:,} triangles, {size:,} bytes, and it has {len(data):,}; "
            "export or download it again"
        )
    return data[:size]  # some writers fill up their last block


def ply(name: str, data: bytes) -> bytes:
    """One of text has as many lines as its head says."""
    head, found, _ = data[:_PLY_HEAD].partition(b"end_header")
    if not found or b"format ascii" not in head or b"\n" not in head:
        return data
    rows = sum(int(count) for count in re.findall(rb"^element[ \t]+\S+[ \t]+(\d{1,18})", head, re.MULTILINE))
    start = len(head) + len(found)
    lines = data.count(b"\n", start) - data.endswith(b"\n")
    if lines < rows:
        raise SceneBuildError(f"{name} is cut: its head says {rows:,} lines, and it has {lines:,}; export it again")
    return data


def off(name: str, data: bytes) -> bytes:
    """As many faces as its head says, the last one with all its corners. Without comments: of what stands before the
    first one trimesh reads all but a line twice."""
    if b"#" in data:
        data = b"\n".join(line.partition(b"#")[0] for line in data.splitlines())
    if not _plain(data):
        raise SceneBuildError(f"{name} is damaged, or no OFF: not all of it is text; export or download it again")
    rows = [row for line in data.partition(b"OFF")[2].splitlines() if (row := line.split())]
    try:
        vertices, faces = (int(word) for word in rows[0][:2])
        listed = rows[1 + vertices : 1 + vertices + faces]
        whole = len(listed) == faces and (not faces or len(listed[-1]) > int(listed[-1][0]))
    except (ValueError, IndexError):
        return data  # whoever reads it says what is wrong
    if not whole:
        raise SceneBuildError(
            f"{name} is cut: its head says {faces:,} faces, and it ends in number {len(listed):,}; "
            "export or download it again"
        )
    return data


def obj(name: str, data: bytes) -> bytes:
    """Faces have at least three corners, which count from 1, and forward. Without comments behind them, which trimesh
    takes for corners. Numbers are text: what is none it leaves out."""
    data = data.removeprefix(_BOM).removesuffix(b"\0")
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    if b"#" in data:
        data = _BEHIND.sub(rb"\1", data)
    if not _plain(data) and (found := _NO_TEXT.search(data)):
        where = _place(name, data, found.end() - 1)
        raise SceneBuildError(f"{where}: not all of it is text: the file is damaged, or no OBJ; export it again")
    text = _one_line_each(data)
    if few := _FEW_CORNERS.search(text):
        where = _place(name, text, few.start())
        raise SceneBuildError(f"{where}: a face with fewer than three corners: the file is cut; export it again")
    if _cut_corner(text):
        where = _place(name, text, len(text))
        raise SceneBuildError(f"{where}: its last corner is not whole: the file is cut; export it again")
    return absolute_corners(name, data) if _ODD_CORNER.search(text) else data


CHECKS: Final[Mapping[str, Callable[[str, bytes], bytes]]] = {"stl": stl, "ply": ply, "off": off, "obj": obj}


def absolute_corners(name: str, data: bytes) -> bytes:
    """An OBJ whose faces name vertices, texture coordinates and normals from 1. Raises `SceneBuildError` for the first
    that names what is not there. A texture coordinate of 0 is none: where the file has some it becomes one at (0, 0),
    as trimesh takes all or none. A normal of 0 leaves out all of them: they are made."""
    counts = [0, 0, 0]
    total = [len(re.findall(rb"^[ \t]*" + kind + rb"[ \t]", data, re.MULTILINE)) for kind in _OBJ_LISTS]
    text = _one_line_each(data)
    parts = 2 if _NO_NORMAL.search(text) else 3
    out = []
    for number, line in enumerate(text.split(b"\n"), start=1):
        words = line.partition(b"#")[0].split()
        if words and words[0] in _OBJ_LISTS:
            counts[_OBJ_LISTS.index(words[0])] += 1
        if words and words[0] == b"f":
            corners = (_corner(f"{name}, line {number}", word, counts, total, parts) for word in words[1:])
            out.append(b"f " + b" ".join(corners))
        else:
            out.append(line)
    return b"\n".join(out) + (b"\nvt 0 0\n" if total[1] else b"")


def _plain(data: bytes) -> bool:
    """Return whether it is ASCII; with zeros a disk that was full has filled up what it had lost."""
    return data.isascii() and b"\0" not in data


def _place(name: str, data: bytes, at: int) -> str:
    number = data.count(b"\n", 0, at) + 1
    return f"{name}, line {number}"


def _cut_corner(text: bytes) -> bool:
    """Return whether an OBJ ends without a newline in a corner of a face that has fewer parts than the others."""
    words = text[text.rfind(b"\n") + 1 :].split()
    kinds = {tuple(map(bool, word.split(b"/"))) for word in words[1:]}
    return words[:1] == [b"f"] and len(kinds) > 1


def _one_line_each(data: bytes) -> bytes:
    """An OBJ without lines that go on in the next one."""
    return data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")


def _corner(where: str, corner: bytes, counts: list[int], total: list[int], parts: int) -> bytes:
    """`counts`: how many there are so far, by which what is negative counts; `total`: in the whole file; `parts`: how
    many of the corner's numbers are read."""
    found = []
    for k, text in enumerate(corner.split(b"/")[:parts]):
        if not text:
            found.append(b"")
            continue
        try:
            place = int(text)
        except ValueError:
            shown = corner[:_SHOWN].decode(errors="replace")
            raise SceneBuildError(f"{where}: {shown!r} is no corner of a face") from None
        if place == 0 and k == 1:
            found.append(b"%d" % (total[1] + 1) if total[1] else b"")
            continue
        at = place if place > 0 else counts[k] + 1 + place
        if place == 0 or not 0 < at <= total[k]:
            raise SceneBuildError(f"{where}: a face names {_WHAT[k]} {place} of {total[k]}: export it again")
        found.append(b"%d" % at)
    return b"/".join(found).rstrip(b"/")
