"""Models of real robots, which the package cannot ship: from `models/` in the folder named by `IRIS_DATA`."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, Final

from iris_session.physics.errors import ModelInvalidError, ModelNotFoundError, one_line

VARIABLE: Final = "IRIS_DATA"


def find_model_file(folder: str, name: str) -> Path:
    """Return the absolute path of `models/<folder>/<name>` in the data folder. Raises `ModelNotFoundError` saying what
    to set."""
    source = f"{folder} of MuJoCo Menagerie (github.com/google-deepmind/mujoco_menagerie)"
    value = os.environ.get(VARIABLE, "")
    if not value:
        raise ModelNotFoundError(
            f"this scene needs the robot model {source}: set {VARIABLE} to a folder that has models/{folder}/{name}"
        )
    path = (Path(value).expanduser() / "models" / folder / name).resolve()
    if not path.is_file():
        raise ModelNotFoundError(
            f"{VARIABLE}={value} has no models/{folder}/{name}: this scene needs the robot model {source} there"
        )
    return path


def load_model_spec(path: Path) -> Any:
    """Return an `mujoco.MjSpec` of the model, ready to be attached: absolute asset folders, no keyframes.

    Raises `ModelInvalidError` for a file that MuJoCo cannot read.
    """
    import mujoco

    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ModelInvalidError(f"{path.name}: {one_line(error)}") from error
    for attribute in ("meshdir", "texturedir"):
        setattr(spec, attribute, str(path.parent / getattr(spec, attribute)))
    for key in list(spec.keys):
        spec.delete(key)
    return spec
