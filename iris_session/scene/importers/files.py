"""Any file with geometry, as nodes: the reader by the file's ending, and the error of what cannot be read."""

from __future__ import annotations

import re
import traceback
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from iris_session.scene.elements import LoadedFile
from iris_session.scene.errors import SceneBuildError
from iris_session.scene.importers.references import References

#: Endings that `load_file` reads; the others of trimesh are points, archives of anything, or hardly ever met.
_GLTF: Final = ("glb", "gltf")
MESHES: Final = ("3mf", "dae", "obj", "off", "ply", "stl")
ROBOTS: Final = ("urdf",)
#: What MuJoCo reads.
MODELS: Final = ("mjb", "mjcf", "xml")
ENDINGS: Final = tuple(sorted((*_GLTF, *MESHES, *ROBOTS, *MODELS)))
_ADDRESS: Final = re.compile(r"(https?|ftp):[/\\]")
_ROOM: Final = Path(__file__).parents[1]
#: Most files that an error text lists.
_LISTED: Final = 8
#: Errors whose texts say nothing of a file.
_OF_CODE: Final = (AttributeError, TypeError, NameError, AssertionError, NotImplementedError, RecursionError)


def load_file(path: Path, package_dirs: Sequence[str | PathLike[str]] = (), name: str = "") -> LoadedFile:
    """The geometry of a file. `name`: of what the file itself calls nothing, as STL, PLY and OFF do; else as the file.

    Raises `SceneBuildError` for one that is missing, damaged, or of another form."""
    kind = ending(path)
    present(path)
    if kind not in (*_GLTF, *MESHES):
        raise SceneBuildError(f"{path.name}: {_other_reader(path, kind)}")
    references = References(path, package_dirs)
    found: LoadedFile = guarded(path, kind, lambda: _read(path, kind, references, name or path.stem))
    if not any(node.surfaces or node.lights or node.cameras for node in found.nodes):
        raise SceneBuildError(
            f"{path} has nothing that can be drawn" + "".join(f"; {text}" for text in found.skipped[:3])
        )
    return found


def present(path: Path) -> None:
    """Raises `SceneBuildError` unless there is a file with something in it."""
    try:
        if _ADDRESS.match(str(path)):  # a path has made one slash of its two
            raise SceneBuildError(f"{path.name}: files are read, not addresses: download it first")
        if path.is_dir():
            raise SceneBuildError(f"{path} is a folder: name a file{readable_in(path, 'in it')}")
        if not path.is_file():
            raise SceneBuildError(f"{path}: no such file{readable_in(path.parent, 'in its folder', ending(path))}")
        if not path.stat().st_size:
            raise SceneBuildError(f"{path} is empty: 0 bytes")
    except (OSError, ValueError) as error:  # a name that no file can have
        raise SceneBuildError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from None


def guarded(path: Path, kind: str, read: Callable[[], Any]) -> Any:
    """Return the result of `read`. Damaged files make libraries raise anything: all becomes `SceneBuildError`."""
    try:
        with np.errstate(all="ignore"):  # readers look for what is not finite
            return read()
    except SceneBuildError:
        raise
    except MemoryError:
        raise SceneBuildError(f"{path} does not fit into memory: make it smaller") from None
    except (IndexError, KeyError) as error:
        raise SceneBuildError(f"{path} names something that it does not have ({error}): export it again") from error
    except _OF_CODE as error:  # what they say is about the code of a library, which has not found what it needs
        raise SceneBuildError(
            f"{path} is damaged, or no {kind.upper()}: something in it is missing or of another kind; "
            f"export or download it again{_of_ours(error)}"
        ) from error
    except Exception as error:
        text = " ".join(str(error).split())[:200]  # one line
        raise SceneBuildError(f"{path} is damaged, or no {kind.upper()}: {type(error).__name__}: {text}") from error


def _of_ours(error: BaseException) -> str:
    """For error texts: where our own code stopped, if it was not a library; then it may be wrong, not the file."""
    *_, last = traceback.extract_tb(error.__traceback__)
    place = Path(last.filename)
    if _ROOM not in place.parents:
        return ""
    said = " ".join(str(error).split())[:200]  # one line
    return f" (if other programs open it, please report: {type(error).__name__}: {said}, {place.name}:{last.lineno})"


def ending(path: Path) -> str:
    """In lower case, without the dot."""
    return path.suffix.lower().lstrip(".")


def readable_in(folder: Path, where: str, wanted: str = "") -> str:
    """For error texts: the files of a folder that can be read, those that end in `wanted` first."""
    try:
        found = [entry for entry in folder.iterdir() if ending(entry) in ENDINGS and entry.is_file()]
        names = [entry.name for entry in sorted(found, key=lambda one: (ending(one) != wanted, one.name))]
    except OSError:
        return "" if folder.is_dir() else f"; there is no folder {folder} either"
    if not names:
        return f"; none {where} is of a kind that is read ({', '.join(ENDINGS)})"
    more = f" and {len(names) - _LISTED} more" if len(names) > _LISTED else ""
    return f"; {where}: {', '.join(names[:_LISTED])}{more}"


def _other_reader(path: Path, kind: str) -> str:
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
