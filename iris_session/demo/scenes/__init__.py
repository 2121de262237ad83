"""Scenes that come with the package: the handover demo, and generators for benchmarks.

`handover.xml`: two arms, a hammer, a board. `arm.xml`: the arm that every scene here uses. `generators`: N arms around
a table, free bodies in a hall. Everything is drawn from primitives, so no asset files are needed.
"""

from __future__ import annotations

from pathlib import Path

from iris_session.demo.scenes.generators import free_bodies_scene, n_arms_scene

__all__ = ["free_bodies_scene", "n_arms_scene", "scene_path"]

_FOLDER = Path(__file__).parent


def scene_path(name: str) -> Path:
    """Path of the packaged MJCF file `name` (without `.xml`). Raises `FileNotFoundError` listing the scenes."""
    path = _FOLDER / f"{name}.xml"
    if path.parent != _FOLDER or not path.is_file():
        available = ", ".join(sorted(p.stem for p in _FOLDER.glob("*.xml")))
        raise FileNotFoundError(f"no scene '{name}' comes with the package. Available scenes: {available}")
    return path
