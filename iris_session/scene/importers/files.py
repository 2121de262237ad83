"""`load_file`: read a file with geometry into nodes, by the reader for its suffix, with clear errors."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np

from iris_session.scene.errors import SceneBuildError
from iris_session.scene.importers.references import (
    GLTF,
    MESHES,
    MODELS,
    ROBOTS,
    References,
    check_present,
    get_ending,
    xacro_advice,
)
from iris_session.scene.nodes import LoadedFile

_logger = logging.getLogger("iris_session.scene")
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
    if kind not in (*GLTF, *MESHES):
        raise SceneBuildError(f"{path.name}: {_suggest_reader(path, kind)}")
    references = References(path, package_dirs)
    found: LoadedFile = read_guarded(path, kind, lambda: _read(path, kind, references, name or path.stem))
    if not any(node.surfaces or node.lights or node.cameras for node in found.nodes):
        raise SceneBuildError(
            f"{path} has nothing that can be drawn" + "".join(f"; {text}" for text in found.skipped[:3])
        )
    return found


def _read(path: Path, kind: str, references: References, name: str) -> LoadedFile:
    if kind in GLTF:
        from iris_session.scene.importers.gltf import read_gltf

        return read_gltf(path, references)
    from iris_session.scene.importers.trimesh_files import read_with_trimesh

    return read_with_trimesh(path, references, name)


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


def _suggest_reader(path: Path, kind: str) -> str:
    if kind in ROBOTS:
        return "a URDF is a robot: use add_urdf"
    if kind == "xacro":
        return xacro_advice(path)
    if kind in MODELS:
        return f"files that end in .{kind} are MuJoCo's: Session({path.name!r}) shares one"
    these = f"{', '.join((*GLTF, *MESHES))}; urdf by add_urdf; {', '.join(MODELS)} by Session"
    return f"files that end in .{kind} are not read. These are: {these}" if kind else f"no ending. Read are {these}"
