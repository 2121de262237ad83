"""Files that a geometry file may refer to. All participants see the scene, and files come from untrusted sources, so a
reference is followed only into folders that belong to the file:

- its own folder with all subfolders;
- sibling folders with the usual names for models (`SIBLINGS`);
- the package that contains it, from the folder with `package.xml`;
- packages that it names (`package://`), in or beside one of its parent folders, if they have a `package.xml` too;
- the folders that the caller names.

Symbolic links are resolved before this check.
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

from iris_session.scene.errors import SceneBuildError
from iris_session.scene.nodes import MAX_FILE_BYTES

#: Number of parent folders that are searched for a package.
_UP: Final = 8
#: Sibling folders that belong to a file in one of `MODEL_FOLDERS`: most models refer to their meshes as
#: `../meshes/link.stl`.
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
#: Names, or parts of names, of folders that hold the models of a robot and nothing else. What lies beside another
#: folder, such as one of downloads, need not belong to the file: it could be the user's own images.
MODEL_FOLDERS: Final = ("urdf", "xacro", "robot", "sdf", "mjcf", "xml", "model", "description", "gltf", "scene", "mesh")
#: Maximum number of files that an error message lists.
_LISTED: Final = 8
_PACKAGE: Final = "package.xml"
_files: ContextVar[list[Path] | None] = ContextVar("files that were read", default=None)


@contextmanager
def files_read() -> Iterator[list[Path]]:
    """Yield a list that collects the files read by this thread meanwhile, including referenced ones."""
    found: list[Path] = []
    token = _files.set(found)
    try:
        yield found
    finally:
        _files.reset(token)


def read_bounded(path: Path) -> bytes:
    """Return the bytes of a file. Raises `SceneBuildError` when it is missing, unreadable, or too large."""
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
    """Resolver of the references in the file at `path`. `package_dirs`: folders of packages, or packages themselves."""

    def __init__(self, path: Path, package_dirs: Sequence[str | PathLike[str]] = ()) -> None:
        self.path = path.resolve()
        self.given = tuple(Path(fspath(folder)).expanduser().resolve() for folder in package_dirs)
        for folder in self.given:
            if not folder.is_dir():
                raise SceneBuildError(f"{folder}: no such folder, named in package_dirs")
        package = next((up for up in self._list_parents() if (up / _PACKAGE).is_file()), None)
        here = self.path.parent
        names = SIBLINGS if any(part in here.name.lower() for part in MODEL_FOLDERS) else ()
        beside = (here.parent / name for name in names)  # not resolved: a link of that name leads elsewhere
        self._roots = (here, *beside, *([package] if package else []), *self.given)

    def find(self, reference: str) -> Path:
        """Return the file that `reference` names. Raises `SceneBuildError` when it is missing or may not be read."""
        if "$(" in reference or "${" in reference:
            raise SceneBuildError(
                f"{self.path.name} refers to {reference}: xacro must be expanded first: xacro IN.urdf.xacro > OUT.urdf "
                "(ROS has it; else pip install xacro)"
            )
        scheme, found, rest = reference.partition("://")
        if not found:
            plain = self.path.parent / reference.replace("\\", "/")
            return self._allowed(reference, plain if plain.exists() else self.path.parent / _decode_percent(reference))
        if scheme in ("package", "model"):
            package, _, inside = _decode_percent(rest).partition("/")
            return self._in_package(reference, package, inside.lstrip("/"))
        if scheme == "file":
            return self._allowed(reference, Path(_decode_percent(rest)))
        if scheme in ("http", "https", "ftp"):
            raise SceneBuildError(
                f"{self.path.name} refers to {reference}: files are read, not addresses: download it first"
            )
        raise SceneBuildError(f"{self.path.name} refers to {reference}: only files and package:// are read")

    def folders(self, path: Path) -> tuple[Path, ...]:
        """Return the allowed folders that contain a found file: its own references may lead there too."""
        return tuple(root for root in self._roots if root.is_dir() and path.is_relative_to(root))

    def _allowed(self, reference: str, path: Path) -> Path:
        found = path.resolve()
        if not any(found.is_relative_to(root) for root in self._roots):
            raise SceneBuildError(
                f"{self.path.name} refers to {reference}, outside of its own folders: name the folder in package_dirs"
            )
        if not found.is_file():
            raise SceneBuildError(
                f"{self.path.name} refers to {reference}: there is no file {found}{_list_similar(found, 0)}"
            )
        return found

    def _in_package(self, reference: str, package: str, inside: str) -> Path:
        """Find a file of a package by the name of its folder, as ROS does: in `package_dirs`, then upward from the
        file.
        """
        if package in ("", ".", ".."):
            raise SceneBuildError(f"{self.path.name} refers to {reference}: no package is named there")
        tried, closed = [], None
        places = (*self.given, *self._list_parents())
        for root in (*places, *(place / package for place in places)):
            if root.name != package and not _is_package(root, package):
                continue
            tried.append(root)
            found = (root / inside).resolve()
            if found.is_relative_to(root.resolve()) and found.is_file():
                if self._is_trusted_root(root, found):
                    return found
                closed = closed or root
        lost = [(root / inside).resolve() for root in tried if root.is_dir() and self._is_trusted_root(root, root)]
        within = [path for path in lost if any(path.is_relative_to(root.resolve()) for root in tried)]
        if closed is None and within:
            raise SceneBuildError(
                f"{self.path.name} refers to {reference}: package {package} is there, and has no file {within[0]}"
                f"{_list_similar(within[0])}"
            )
        hint = f"looked in {', '.join(map(str, tried))}" if tried else "no such package above the file"
        if closed is not None:  # any folder could be named as a package, also one of private images or keys
            hint = f"{closed} has no {_PACKAGE}, so it is no package"
        raise SceneBuildError(
            f"{self.path.name} refers to {reference}: {hint}; name the package's folder in package_dirs"
        )

    def _is_trusted_root(self, root: Path, found: Path) -> bool:
        """Return whether `found`, below the folder `root` that was found by name, belongs to the file."""
        named = root in self.given or root.parent in self.given
        return named or (root / _PACKAGE).is_file() or any(found.is_relative_to(own) for own in self._roots)

    def _list_parents(self) -> tuple[Path, ...]:
        """Return the folder of the file and its parents, without the root of the file system."""
        return tuple(up for up in self.path.parents if up != Path(up.anchor))[:_UP]


def _list_similar(path: Path, others: int = _LISTED) -> str:
    """Return, for error messages, files with similar names, else at most `others` other files of that folder."""
    folder = path.parent
    try:
        names = sorted(entry.name for entry in folder.iterdir() if entry.is_file())
    except OSError:
        return f"; there is no folder {folder}"
    near = difflib.get_close_matches(path.name, names, n=3) or names[:others]
    return f"; in {folder}: {', '.join(near)}" if near else ""


def _is_package(root: Path, name: str) -> bool:
    """Return whether a folder of another name is the package: checkouts often have another name."""
    try:
        text = (root / _PACKAGE).read_bytes()[: 1 << 16].decode("utf-8", "replace")
    except OSError:
        return False
    return f"<name>{name}</name>" in text.replace(" ", "")


def _decode_percent(address: str) -> str:
    """Decode percent-encoding (`%20`)."""
    data = re.sub(rb"%([0-9a-fA-F]{2})", lambda found: bytes.fromhex(found.group(1).decode()), address.encode())
    return data.decode("utf-8", "replace")
