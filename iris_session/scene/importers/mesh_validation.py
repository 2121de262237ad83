"""Checks of mesh files that trimesh reads without an error although they are damaged, such as truncated files.

In OBJ files they also convert corners that trimesh misreads: negative numbers count back from the current line, but
trimesh counts from the end of the file; and some exporters write 0 for an absent texture coordinate or normal. Names
and comments may be in any encoding, numbers are ASCII. Each check takes the name and the bytes of the file, and returns
the bytes to be read.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from typing import Final

from iris_session.scene.errors import SceneBuildError

_STL_HEAD: Final = 84
_STL_TRIANGLE: Final = 50
#: Bytes of a PLY that are searched for the end of its header.
_PLY_HEAD: Final = 1 << 16
#: A corner of an OBJ face with a number that is 0 or negative.
_ODD_CORNER: Final = re.compile(rb"^[ \t]*f(?=[ \t])[^\n]*?[ \t/](?:-|0+(?:[/ \t\r\n]|$))", re.MULTILINE)
_NO_NORMAL: Final = re.compile(rb"^[ \t]*f[ \t][^\n]*?/[^ \t\n/]*/0+(?=[ \t\r\n]|$)", re.MULTILINE)
#: OBJ lines with numbers: those with a comment behind them; those with, or beginning with, bytes that are no numbers;
#: faces with fewer than three corners.
_BEHIND: Final = re.compile(rb"^([ \t]*(?:v[tnp]?|f)[ \t][^\n#]*)#[^\n]*", re.MULTILINE)
_NO_TEXT: Final = re.compile(rb"^[ \t]*(?:(?:v[tnp]?|f)[ \t][^\n]*)?[\x00\x80-\xff]", re.MULTILINE)
_FEW_CORNERS: Final = re.compile(rb"^[ \t]*f(?:[ \t]+\S+){0,2}[ \t]*\r?$", re.MULTILINE)
_BOM: Final = b"\xef\xbb\xbf"
_OBJ_LISTS: Final = (b"v", b"vt", b"vn")
#: Characters of an invalid corner that the error message shows.
_SHOWN: Final = 60
_WHAT: Final = ("vertex", "texture coordinate", "normal")


def check_stl(name: str, data: bytes) -> bytes:
    """Check that a binary STL has as many triangles as its header states, and that a text STL has an end."""
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
    return data[:size]  # some writers pad the last block


def check_ply(name: str, data: bytes) -> bytes:
    """Check that a text PLY has as many lines as its header states."""
    head, found, _ = data[:_PLY_HEAD].partition(b"end_header")
    if not found or b"format ascii" not in head or b"\n" not in head:
        return data
    rows = sum(int(count) for count in re.findall(rb"^element[ \t]+\S+[ \t]+(\d{1,18})", head, re.MULTILINE))
    start = len(head) + len(found)
    lines = data.count(b"\n", start) - data.endswith(b"\n")
    if lines < rows:
        raise SceneBuildError(f"{name} is cut: its head says {rows:,} lines, and it has {lines:,}; export it again")
    return data


def check_off(name: str, data: bytes) -> bytes:
    """Check that an OFF has as many faces as its header states, and that the last face is complete.

    Comments are removed: trimesh reads everything but one line before the first comment twice.
    """
    if b"#" in data:
        data = b"\n".join(line.partition(b"#")[0] for line in data.splitlines())
    if not _is_plain_text(data):
        raise SceneBuildError(f"{name} is damaged, or no OFF: not all of it is text; export or download it again")
    rows = [row for line in data.partition(b"OFF")[2].splitlines() if (row := line.split())]
    try:
        vertices, faces = (int(word) for word in rows[0][:2])
        listed = rows[1 + vertices : 1 + vertices + faces]
        whole = len(listed) == faces and (not faces or len(listed[-1]) > int(listed[-1][0]))
    except (ValueError, IndexError):
        return data  # the reader raises the error
    if not whole:
        raise SceneBuildError(
            f"{name} is cut: its head says {faces:,} faces, and it ends in number {len(listed):,}; "
            "export or download it again"
        )
    return data


def check_obj(name: str, data: bytes) -> bytes:
    """Check that faces have at least three corners and that all numbers are text: trimesh leaves out other lines.

    Comments behind faces are removed, because trimesh reads them as corners; zero and negative numbers are converted.
    """
    data = data.removeprefix(_BOM).removesuffix(b"\0")
    if b"\n" not in data:
        data = data.replace(b"\r", b"\n")
    if b"#" in data:
        data = _BEHIND.sub(rb"\1", data)
    if not _is_plain_text(data) and (found := _NO_TEXT.search(data)):
        where = _format_place(name, data, found.end() - 1)
        raise SceneBuildError(f"{where}: not all of it is text: the file is damaged, or no OBJ; export it again")
    text = _one_line_each(data)
    if few := _FEW_CORNERS.search(text):
        where = _format_place(name, text, few.start())
        raise SceneBuildError(f"{where}: a face with fewer than three corners: the file is cut; export it again")
    if _cut_corner(text):
        where = _format_place(name, text, len(text))
        raise SceneBuildError(f"{where}: its last corner is not whole: the file is cut; export it again")
    return absolute_corners(name, data) if _ODD_CORNER.search(text) else data


CHECKS: Final[Mapping[str, Callable[[str, bytes], bytes]]] = {
    "stl": check_stl,
    "ply": check_ply,
    "off": check_off,
    "obj": check_obj,
}


def absolute_corners(name: str, data: bytes) -> bytes:
    """Return an OBJ whose faces refer to vertices, texture coordinates and normals by numbers from 1.

    A texture coordinate 0 means none: when others exist it becomes one at (0, 0), because trimesh takes all or none.
    One normal 0 drops all normals of the file; they are computed later. Raises `SceneBuildError` for the first number
    out of range.
    """
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


def _is_plain_text(data: bytes) -> bool:
    """Return whether the data are ASCII without zero bytes: a full disk leaves zeros in place of lost data."""
    return data.isascii() and b"\0" not in data


def _format_place(name: str, data: bytes, at: int) -> str:
    number = data.count(b"\n", 0, at) + 1
    return f"{name}, line {number}"


def _cut_corner(text: bytes) -> bool:
    """Return whether an OBJ ends without a newline in a corner of a face that has fewer parts than the others."""
    words = text[text.rfind(b"\n") + 1 :].split()
    kinds = {tuple(map(bool, word.split(b"/"))) for word in words[1:]}
    return words[:1] == [b"f"] and len(kinds) > 1


def _one_line_each(data: bytes) -> bytes:
    """Join continued lines of an OBJ."""
    return data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")


def _corner(where: str, corner: bytes, counts: list[int], total: list[int], parts: int) -> bytes:
    """Return a corner with numbers from 1.

    Args:
        where: File and line, for messages.
        corner: Text of the corner.
        counts: Numbers of vertices, texture coordinates and normals so far; negative numbers count back from them.
        total: The same numbers for the whole file.
        parts: How many of the numbers of the corner are read.
    """
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
