"""Files of geometry: their kinds, and `References`, which decides which further files one may name.

All participants see the scene, and files come from untrusted sources, so a reference is followed only into folders that
belong to the file:

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

#: Suffixes that `load_file` reads; the others of trimesh are point clouds, general archives, or very rare.
GLTF: Final = ("glb", "gltf")
MESHES: Final = ("dae", "obj", "off", "ply", "stl")
ROBOTS: Final = ("urdf",)
#: Suffixes of files that MuJoCo reads.
MODELS: Final = ("mjb", "mjcf", "xml")
ENDINGS: Final = tuple(sorted((*GLTF, *MESHES, *ROBOTS, *MODELS)))
_ADDRESS: Final = re.compile(r"(https?|ftp):[/\\]")
#: Maximum number of files that an error message lists.
_LISTED: Final = 8
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
_PACKAGE: Final = "package.xml"
_files: ContextVar[list[Path] | None] = ContextVar("files that were read", default=None)


def check_present(path: Path) -> None:
    """Check that there is a file that is not empty. Raises `SceneBuildError`."""
    try:
        if _ADDRESS.match(str(path)):  # `Path` merges the two slashes of an address
            raise SceneBuildError(f"{path.name}: files are read, not addresses: download it first")
        if path.is_dir():
            raise SceneBuildError(
                f"{path} is a folder: name a file ({', '.join(ENDINGS)}){_list_files(path / path.name)}"
            )
        if not path.is_file():
            raise SceneBuildError(f"{path}: no such file{_list_files(path)}")
        if not path.stat().st_size:
            raise SceneBuildError(f"{path} is empty: 0 bytes")
    except (OSError, ValueError) as error:  # not a possible file name
        raise SceneBuildError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None


def get_ending(path: Path) -> str:
    """Return the suffix in lower case, without the dot."""
    return path.suffix.lower().lstrip(".")


def xacro_advice(path: Path) -> str:
    """Return advice on expanding xacro to URDF."""
    stem = path.name.removesuffix(".xacro").removesuffix(".urdf")
    return f"xacro must be expanded first: xacro {path.name} > {stem}.urdf (ROS has it; else pip install xacro)"


def _list_files(path: Path) -> str:
    """Return, for error messages, files beside `path` with similar names, else those of a kind that is read."""
    try:
        names = sorted(entry.name for entry in path.parent.iterdir() if entry.is_file())
    except OSError:
        return f"; there is no folder {path.parent}"
    near = difflib.get_close_matches(path.name, names, n=3)
    near = near or [name for name in names if get_ending(Path(name)) in ENDINGS][:_LISTED]
    return f"; in {path.parent}: {', '.join(near)}" if near else ""


# --- references -------------------------------------------------------------------------------------------------------


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
            raise SceneBuildError(f"{self.path.name} refers to {reference}: {xacro_advice(self.path)}")
        scheme, found, rest = reference.partition("://")
        if not found:
            plain = self.path.parent / reference.replace("\\", "/")
            return self._allowed(reference, plain if plain.exists() else self.path.parent / _decode_percent(reference))
        if scheme in ("package", "model"):
            package, _, inside = _decode_percent(rest).partition("/")
            return self._in_package(reference, package, inside.lstrip("/"))
        if scheme == "file":
            return self._allowed(reference, Path(_decode_percent(rest)))
        raise SceneBuildError(
            f"{self.path.name} refers to {reference}: only files and package:// are read; download it first"
        )

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
                f"{self.path.name} refers to {reference}: there is no file {found}{_list_files(found)}"
            )
        return found

    def _in_package(self, reference: str, package: str, inside: str) -> Path:
        """Find a file of a package by the name of its folder, as ROS does: in `package_dirs`, then upward from the
        file.
        """
        if package in ("", ".", ".."):
            raise SceneBuildError(f"{self.path.name} refers to {reference}: no package is named there")
        places = (*self.given, *self._list_parents())
        tried = [
            root
            for root in (*places, *(place / package for place in places))
            if root.name == package or _is_package(root, package)
        ]
        hint = f"looked in {', '.join(map(str, tried))}" if tried else "no such package above the file"
        for root in tried:
            found = (root / inside).resolve()
            if not found.is_relative_to(root.resolve()):
                continue
            if not self._is_trusted_root(root, found):  # any folder could be named, also one of private images or keys
                if found.is_file():
                    hint = f"{root} has no {_PACKAGE}, so it is no package"
            elif found.is_file():
                return found
            elif root.is_dir():
                hint = f"package {package} is there, and has no file {found}{_list_files(found)}"
        raise SceneBuildError(
            f"{self.path.name} refers to {reference}: name the package's folder in package_dirs: {hint}"
        )

    def _is_trusted_root(self, root: Path, found: Path) -> bool:
        """Return whether `found`, below the folder `root` that was found by name, belongs to the file."""
        named = root in self.given or root.parent in self.given
        return named or (root / _PACKAGE).is_file() or any(found.is_relative_to(own) for own in self._roots)

    def _list_parents(self) -> tuple[Path, ...]:
        """Return the folder of the file and its parents, without the root of the file system."""
        return tuple(up for up in self.path.parents if up != Path(up.anchor))[:_UP]


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
