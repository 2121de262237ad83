"""Files that a geometry file may refer to. All participants see the scene, and files come from untrusted sources: a
reference is followed only into folders that belong to the file.

Those are its own folder with all below; folders beside that one which are called as models call theirs (`SIBLINGS`);
the package it lies in, from the folder with `package.xml`; packages that it names (`package://`), in or beside a folder
above it, if they have a `package.xml` too; and the folders that the caller names. Symbolic links are followed before
this is judged.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from os import PathLike, fspath
from pathlib import Path
from typing import Final

from iris_session.scene.elements import MAX_FILE_BYTES
from iris_session.scene.errors import SceneBuildError

#: How far up from a file a package is searched.
_UP: Final = 8
#: Folders beside the file's own that belong to it: `../meshes/link.stl` is how most models refer to theirs.
SIBLINGS: Final = (
    "assets",
    "collision",
    "collisions",
    "images",
    "materials",
    "media",
    "mesh",
    "meshes",
    "models",
    "texture",
    "textures",
    "visual",
    "visuals",
)
#: Most files that an error text lists.
_LISTED: Final = 8
_PACKAGE: Final = "package.xml"
_files: ContextVar[list[Path] | None] = ContextVar("files that were read", default=None)


@contextmanager
def files_read() -> Iterator[list[Path]]:
    """The files that this thread reads meanwhile: those named, and all that these refer to."""
    found: list[Path] = []
    token = _files.set(found)
    try:
        yield found
    finally:
        _files.reset(token)


def read_bounded(path: Path) -> bytes:
    """The bytes of a file. Raises `SceneBuildError` for one that is missing, unreadable, or too large."""
    try:
        if not path.is_file():
            raise SceneBuildError(f"{path}: no such file")
        size = path.stat().st_size
        if size > MAX_FILE_BYTES:
            raise SceneBuildError(
                f"{path} has {size / 2**20:.0f} MiB, at most {MAX_FILE_BYTES >> 20} MiB are read: make it smaller"
            )
        if (noted := _files.get()) is not None:
            noted.append(path)
        return path.read_bytes()
    except OSError as error:
        raise SceneBuildError(f"{path} cannot be read: {error.strerror or error}") from None


class References:
    """Files that the file at `path` may refer to. `package_dirs`: folders of packages, or packages themselves."""

    def __init__(self, path: Path, package_dirs: Sequence[str | PathLike[str]] = ()) -> None:
        self.path = path.resolve()
        self.given = tuple(Path(fspath(folder)).expanduser().resolve() for folder in package_dirs)
        for folder in self.given:
            if not folder.is_dir():
                raise SceneBuildError(f"{folder}: no such folder, named in package_dirs")
        package = next((up for up in self._above() if (up / _PACKAGE).is_file()), None)
        here = self.path.parent
        beside = (here.parent / name for name in SIBLINGS)  # not resolved: a link in their place leads elsewhere
        self._roots = (here, *beside, *([package] if package else []), *self.given)

    def find(self, reference: str) -> Path:
        """The file that `reference` names. Raises `SceneBuildError` when there is none, or it may not be read."""
        if "$(" in reference or "${" in reference:
            raise SceneBuildError(
                f"{self.path.name} refers to {reference}: xacro must be expanded first: xacro IN.urdf.xacro > OUT.urdf "
                "(ROS has it; else pip install xacro)"
            )
        scheme, found, rest = reference.partition("://")
        if not found:
            plain = self.path.parent / reference.replace("\\", "/")
            return self._allowed(reference, plain if plain.exists() else self.path.parent / _plain(reference))
        if scheme in ("package", "model"):
            package, _, inside = _plain(rest).partition("/")
            return self._in_package(reference, package, inside.lstrip("/"))
        if scheme == "file":
            return self._allowed(reference, Path(_plain(rest)))
        if scheme in ("http", "https", "ftp"):
            raise SceneBuildError(
                f"{self.path.name} refers to {reference}: files are read, not addresses: download it first"
            )
        raise SceneBuildError(f"{self.path.name} refers to {reference}: only files and package:// are read")

    def folders(self, path: Path) -> tuple[Path, ...]:
        """Of the file's own folders those that a file found here lies in: what that refers to may lie there too."""
        return tuple(root for root in self._roots if root.is_dir() and path.is_relative_to(root))

    def _allowed(self, reference: str, path: Path) -> Path:
        found = path.resolve()
        if not any(found.is_relative_to(root) for root in self._roots):
            raise SceneBuildError(
                f"{self.path.name} refers to {reference}, outside of its own folders: name the folder in package_dirs"
            )
        if not found.is_file():
            raise SceneBuildError(
                f"{self.path.name} refers to {reference}: there is no file {found}{_similar(found, 0)}"
            )
        return found

    def _in_package(self, reference: str, package: str, inside: str) -> Path:
        """As ROS has it: the folder of that name; searched in what was given, then upward from the file."""
        if package in ("", ".", ".."):
            raise SceneBuildError(f"{self.path.name} refers to {reference}: no package is named there")
        tried, closed = [], None
        places = (*self.given, *self._above())
        for root in (*places, *(place / package for place in places)):
            if root.name != package and not _is_package(root, package):
                continue
            tried.append(root)
            found = (root / inside).resolve()
            if found.is_relative_to(root.resolve()) and found.is_file():
                if self._may_draw_in(root, found):
                    return found
                closed = closed or root
        lost = [(root / inside).resolve() for root in tried if root.is_dir() and self._may_draw_in(root, root)]
        within = [path for path in lost if any(path.is_relative_to(root.resolve()) for root in tried)]
        if closed is None and within:
            raise SceneBuildError(
                f"{self.path.name} refers to {reference}: package {package} is there, and has no file {within[0]}"
                f"{_similar(within[0])}"
            )
        hint = f"looked in {', '.join(map(str, tried))}" if tried else "no such package above the file"
        if closed is not None:  # any folder has a name: of somebody's pictures, of keys
            hint = f"{closed} has no {_PACKAGE}, so it is no package"
        raise SceneBuildError(
            f"{self.path.name} refers to {reference}: {hint}; name the package's folder in package_dirs"
        )

    def _may_draw_in(self, root: Path, found: Path) -> bool:
        """Return whether `found`, below the folder `root` that was found by its name, belongs to the file."""
        named = root in self.given or root.parent in self.given
        return named or (root / _PACKAGE).is_file() or any(found.is_relative_to(own) for own in self._roots)

    def _above(self) -> tuple[Path, ...]:
        """The file's folder and those above it, without the root of the file system."""
        return tuple(up for up in self.path.parents if up != Path(up.anchor))[:_UP]


def _similar(path: Path, others: int = _LISTED) -> str:
    """For error texts: files that are called nearly so, else so many of the others in its folder."""
    folder = path.parent
    try:
        names = sorted(entry.name for entry in folder.iterdir() if entry.is_file())
    except OSError:
        return f"; there is no folder {folder}"
    near = difflib.get_close_matches(path.name, names, n=3) or names[:others]
    return f"; in {folder}: {', '.join(near)}" if near else ""


def _is_package(root: Path, name: str) -> bool:
    """Return whether a folder of another name is the package: checkouts are often called otherwise."""
    try:
        text = (root / _PACKAGE).read_bytes()[: 1 << 16].decode("utf-8", "replace")
    except OSError:
        return False
    return f"<name>{name}</name>" in text.replace(" ", "")


def _plain(address: str) -> str:
    """An address with its `%20` and the like as the characters that they stand for."""
    data = re.sub(rb"%([0-9a-fA-F]{2})", lambda found: bytes.fromhex(found.group(1).decode()), address.encode())
    return data.decode("utf-8", "replace")
