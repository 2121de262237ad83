"""Sources of depth frames: cameras by their vendors' packages, recordings, pictures in a folder, rendered scenes.

One module each, imported when a camera of that kind is opened, since each needs packages of its own. `playback` has the
parts that recordings share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib import import_module
from typing import Final

from anchors.pose import PoseTuple
from iris_session.cloud.camera_file import CameraSettings, SourceName
from iris_session.cloud.frames import DepthSource, SourceError
from iris_session.protocol.media import MAX_IMAGE_SIZE
from iris_session.system.extras import MissingExtraError

#: Newest poses of bodies of the session's scene by name, as ((x, y, z), (w, x, y, z)), and their session time [ns];
#: `None` before the first.
BodyPoses = Callable[[], tuple[int, Mapping[str, PoseTuple]] | None]

#: Module and class of each kind of source.
_CLASSES: Final[Mapping[SourceName, tuple[str, str]]] = {
    "folder": ("folder", "FolderSource"),
    "mujoco": ("mujoco_camera", "MujocoCamera"),
    "rerun": ("rerun_recording", "RerunSource"),
    "mcap": ("mcap", "McapSource"),
    "realsense": ("realsense", "RealSenseCamera"),
    "orbbec": ("orbbec", "OrbbecCamera"),
}


def open_source(
    settings: CameraSettings, now_ns: Callable[[], int], body_poses: BodyPoses | None = None
) -> DepthSource:
    """Open the source of a camera.

    Args:
        settings: The camera, from `load_camera_file`.
        now_ns: Session time.
        body_poses: Newest poses of bodies, which rendered cameras draw.

    Returns:
        The source. Close it after use.

    Raises:
        SourceError: There is no such device, it or the file cannot be used, or a package is missing; one line that
            starts with the camera.
    """
    try:
        source = _open(settings, now_ns, body_poses)
    except Exception as error:
        raise name_camera(settings, error) from error
    width, height = source.camera.width, source.camera.height
    wrong = ""
    if max(width, height) > MAX_IMAGE_SIZE:  # directions of so many pixels may be more than the memory holds
        wrong = f"intrinsics are of {width} x {height} pixels: at most {MAX_IMAGE_SIZE} x {MAX_IMAGE_SIZE} are possible"
    elif not 0.0 < source.depth_scale_m < 1.0:
        wrong = f"unit of depth is {source.depth_scale_m:g} m: give depth_scale_m, usually 0.001"
    if wrong:
        with suppress(Exception):
            source.close()
        raise SourceError(f"camera {settings.name!r}: the {wrong}")
    return source


def name_camera(settings: CameraSettings, error: Exception) -> SourceError:
    """Return the error of a source, or of a package or a file that it does not expect, as one line with the camera."""
    said = " ".join(str(error).split())
    if not isinstance(error, SourceError | MissingExtraError):
        what = f"source {settings.source!r}" + (f", path {settings.path!r}" if settings.path else "")
        said = f"{what} failed ({type(error).__name__}: {said}): is what it reads damaged?"
    return SourceError(f"camera {settings.name!r}: {said}")


def _open(settings: CameraSettings, now_ns: Callable[[], int], body_poses: BodyPoses | None) -> DepthSource:
    module, kind = _CLASSES[settings.source]
    create = getattr(import_module(f"{__name__}.{module}"), kind)
    given = (settings, now_ns, body_poses) if settings.source == "mujoco" else (settings, now_ns)
    source: DepthSource = create(*given)
    return source
