"""Checks of mesh files that trimesh reads without an error although they are truncated, or reads wrongly.

Each check takes the name and the bytes of the file, and returns the bytes to be read.
"""

from __future__ import annotations

import codecs
import re
from collections.abc import Callable, Mapping
from typing import Final

from iris_session.scene.errors import SceneBuildError

_STL_HEAD: Final = 84
_STL_TRIANGLE: Final = 50
#: Bytes of a PLY that are searched for the end of its header.
_PLY_HEAD: Final = 1 << 16
#: Face of an OBJ that counts back.
_RELATIVE_CORNER: Final = re.compile(rb"^[ \t]*f[ \t][^\n#]*[ \t/]-", re.MULTILINE)


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
    if not data.isascii() or b"\0" in data:  # a full disk leaves zeros in place of lost data
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
    """Check that no face counts back from its own line: trimesh counts from the end of the file."""
    if found := _RELATIVE_CORNER.search(data):
        line = data.count(b"\n", 0, found.start()) + 1
        raise SceneBuildError(f"{name}, line {line}: a face with negative numbers: export it with numbers from 1")
    return data.removeprefix(codecs.BOM_UTF8)


CHECKS: Final[Mapping[str, Callable[[str, bytes], bytes]]] = {
    "stl": check_stl,
    "ply": check_ply,
    "off": check_off,
    "obj": check_obj,
}
