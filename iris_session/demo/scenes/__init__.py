"""Scenes of the package: MJCF files for the demos, and generators for demos and benchmarks.

`handover.xml`: two arms, a hammer, a board. `cloud.xml`, `cloud.toml`: what two drawn depth cameras see of it.
`arm.xml`: the arm that every scene here uses. `generators`: N arms around a table, free bodies in a hall. Everything is
drawn from primitives, so no asset files are needed.
"""

from __future__ import annotations

from pathlib import Path

from iris_session.demo.scene_names import list_scene_names
from iris_session.demo.scenes.generators import free_bodies_scene, n_arms_scene

__all__ = ["free_bodies_scene", "n_arms_scene", "scene_path"]

_FOLDER = Path(__file__).parent


def scene_path(name: str) -> Path:
    """Return the path of a scene that comes with the package.

    Args:
        name: Name of the MJCF file without `.xml`, such as `handover`.

    Returns:
        Path of the MJCF file.

    Raises:
        FileNotFoundError: There is no such file; the message lists the available ones, and all names of `serve`.
    """
    path = _FOLDER / f"{name}.xml"
    if path.parent != _FOLDER or not path.is_file():
        available = ", ".join(sorted(p.stem for p in _FOLDER.glob("*.xml")))
        raise FileNotFoundError(
            f"no file of a scene '{name}' in the package. Available files: {available}. "
            f"`iris-session serve` and scene_by_name also build scenes: {list_scene_names()}"
        )
    return path
