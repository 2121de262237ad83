"""Any file with geometry, as nodes: the reader by the file's ending, and the error of what cannot be read."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from typing import Final

from iris_session.scene.errors import SceneBuildError
from iris_session.scene.parts import Loaded
from iris_session.scene.references import References

_GLTF: Final = frozenset({"glb", "gltf"})


def load_file(path: Path, package_dirs: Sequence[str | PathLike[str]] = ()) -> Loaded:
    """The geometry of a file. Raises `SceneBuildError` for one that is missing, damaged, or of another form."""
    kind = path.suffix.lower().lstrip(".")
    references = References(path, package_dirs)
    try:
        found = _read(path, kind, references)
    except SceneBuildError:
        raise
    except MemoryError:
        raise SceneBuildError(f"{path} does not fit into memory: make it smaller") from None
    except Exception as error:  # damaged files make libraries raise anything, AssertionError too
        raise SceneBuildError(f"{path} is damaged, or no {kind.upper()}: {type(error).__name__}: {error}") from error
    if not any(node.surfaces or node.lights or node.cameras for node in found.nodes):
        raise SceneBuildError(
            f"{path} has nothing that can be drawn" + "".join(f"; {text}" for text in found.skipped[:3])
        )
    return found


def _read(path: Path, kind: str, references: References) -> Loaded:
    if kind in _GLTF:
        from iris_session.scene.gltf import read_gltf

        return read_gltf(path, references)
    from iris_session.scene.trimesh_files import formats, read_with_trimesh

    if kind not in formats():
        known = ", ".join(sorted({*formats(), *_GLTF}))
        raise SceneBuildError(f"{path.name}: files that end in .{kind} are not read. These are: {known}")
    return read_with_trimesh(path, references)
