"""`load_file`: read a file with geometry into nodes, by the reader for its suffix, with clear errors."""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from iris_session.scene.errors import SceneBuildError
from iris_session.scene.importers.references import References
from iris_session.scene.nodes import LoadedFile

_logger = logging.getLogger("iris_session.scene")
#: Suffixes that `load_file` reads; the others of trimesh are point clouds, general archives, or very rare.
_GLTF: Final = ("glb", "gltf")
MESHES: Final = ("dae", "obj", "off", "ply", "stl")
ROBOTS: Final = ("urdf",)
#: Suffixes of files that MuJoCo reads.
MODELS: Final = ("mjb", "mjcf", "xml")
ENDINGS: Final = tuple(sorted((*_GLTF, *MESHES, *ROBOTS, *MODELS)))
_ADDRESS: Final = re.compile(r"(https?|ftp):[/\\]")
#: Maximum number of files that an error message lists.
_LISTED: Final = 8
#: Errors whose messages are about code, not about the file.
_CODE_ERRORS: Final = (AttributeError, TypeError, NameError, AssertionError, NotImplementedError, RecursionError)


def load_file(path: Path, package_dirs: Sequence[str | PathLike[str]] = (), name: str = "") -> LoadedFile:
    """Return the geometry of a file.

    Args:
        path: Path of the file.
        package_dirs: Folders that `package://` references are searched in.
        name: Name of content without a name in the file, as in STL, PLY and OFF; by default the stem of the file.

    Raises:
        SceneBuildError: The file is missing, damaged, or in another format.
    """
    kind = get_ending(path)
    check_present(path)
    if kind not in (*_GLTF, *MESHES):
        raise SceneBuildError(f"{path.name}: {_suggest_reader(path, kind)}")
    references = References(path, package_dirs)
    found: LoadedFile = read_guarded(path, kind, lambda: _read(path, kind, references, name or path.stem))
    if not any(node.surfaces or node.lights or node.cameras for node in found.nodes):
        raise SceneBuildError(
            f"{path} has nothing that can be drawn" + "".join(f"; {text}" for text in found.skipped[:3])
        )
    return found


def check_present(path: Path) -> None:
    """Check that there is a file that is not empty. Raises `SceneBuildError`."""
    try:
        if _ADDRESS.match(str(path)):  # `Path` merges the two slashes of an address
            raise SceneBuildError(f"{path.name}: files are read, not addresses: download it first")
        if path.is_dir():
            raise SceneBuildError(f"{path} is a folder: name a file{list_readable_files(path, 'in it')}")
        if not path.is_file():
            raise SceneBuildError(
                f"{path}: no such file{list_readable_files(path.parent, 'in its folder', get_ending(path))}"
            )
        if not path.stat().st_size:
            raise SceneBuildError(f"{path} is empty: 0 bytes")
    except (OSError, ValueError) as error:  # not a possible file name
        raise SceneBuildError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None


def read_guarded(path: Path, kind: str, read: Callable[[], Any]) -> Any:
    """Return the result of `read`; every error becomes `SceneBuildError`, as damaged files make libraries raise any
    kind.
    """
    try:
        with np.errstate(all="ignore"):  # readers check for values that are not finite
            return read()
    except SceneBuildError:
        raise
    except MemoryError:
        raise SceneBuildError(f"{path} does not fit into memory: make it smaller") from None
    except (IndexError, KeyError) as error:
        raise SceneBuildError(f"{path} names something that it does not have ({error}): export it again") from error
    except _CODE_ERRORS as error:  # a reader did not find what it needs; the message is about its code
        _logger.debug("%s cannot be read", path, exc_info=True)
        raise SceneBuildError(
            f"{path} is damaged, or no {kind.upper()}: something in it is missing or of another kind; "
            "export or download it again"
        ) from error
    except Exception as error:
        text = " ".join(str(error).split())[:200]  # one line
        raise SceneBuildError(f"{path} is damaged, or no {kind.upper()}: {type(error).__name__}: {text}") from error


def get_ending(path: Path) -> str:
    """Return the suffix in lower case, without the dot."""
    return path.suffix.lower().lstrip(".")


def list_readable_files(folder: Path, where: str, wanted: str = "") -> str:
    """Return, for error messages, the readable files of a folder, those with suffix `wanted` first."""
    try:
        found = [entry for entry in folder.iterdir() if get_ending(entry) in ENDINGS and entry.is_file()]
        names = [entry.name for entry in sorted(found, key=lambda one: (get_ending(one) != wanted, one.name))]
    except OSError:
        return "" if folder.is_dir() else f"; there is no folder {folder} either"
    if not names:
        return f"; none {where} is of a kind that is read ({', '.join(ENDINGS)})"
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"; {where}: {', '.join(names[:_LISTED])}{more}"


def _suggest_reader(path: Path, kind: str) -> str:
    if kind in ROBOTS:
        return "a URDF is a robot: use add_urdf"
    if kind == "xacro":
        return xacro_advice(path)
    if kind in MODELS:
        return f"files that end in .{kind} are MuJoCo's: Session({path.name!r}) shares one"
    these = f"{', '.join((*_GLTF, *MESHES))}; urdf by add_urdf; {', '.join(MODELS)} by Session"
    return f"files that end in .{kind} are not read. These are: {these}" if kind else f"no ending. Read are {these}"


def xacro_advice(path: Path) -> str:
    """Return advice on expanding xacro to URDF."""
    stem = path.name.removesuffix(".xacro").removesuffix(".urdf")
    return f"xacro must be expanded first: xacro {path.name} > {stem}.urdf (ROS has it; else pip install xacro)"


def _read(path: Path, kind: str, references: References, name: str) -> LoadedFile:
    if kind in _GLTF:
        from iris_session.scene.importers.gltf import read_gltf

        return read_gltf(path, references)
    from iris_session.scene.importers.trimesh_files import read_with_trimesh

    return read_with_trimesh(path, references, name)
