"""Sources of depth frames: cameras by their vendors' packages, recordings, pictures in a folder, rendered scenes.

One module each, imported when a camera of that kind is opened, since each needs packages of its own. `playback` has the
parts that recordings share.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

from anchors.pose import PoseTuple
from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import DepthSource, SourceError
from iris_session.system.extras import MissingExtraError

#: Newest poses of bodies of the session's scene by name, as ((x, y, z), (w, x, y, z)), and their session time [ns];
#: `None` before the first.
BodyPoses = Callable[[], tuple[int, Mapping[str, PoseTuple]] | None]


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
        SourceError: There is no such device or file, or a package is missing; one line that starts with the camera.
    """
    try:
        return _open(settings, now_ns, body_poses)
    except (MissingExtraError, SourceError) as error:
        raise SourceError(f"camera {settings.name!r}: {error}") from error


def _open(settings: CameraSettings, now_ns: Callable[[], int], body_poses: BodyPoses | None) -> DepthSource:
    if settings.source == "folder":
        from iris_session.cloud.sources.folder import FolderSource

        return FolderSource(settings, now_ns)
    if settings.source == "mujoco":
        from iris_session.cloud.sources.mujoco_camera import MujocoCamera

        return MujocoCamera(settings, now_ns, body_poses)
    if settings.source == "opencv":
        from iris_session.cloud.sources.opencv_capture import OpenCvCamera

        return OpenCvCamera(settings, now_ns)
    if settings.source == "rerun":
        from iris_session.cloud.sources.rerun_recording import RerunSource

        return RerunSource(settings, now_ns)
    if settings.source == "mcap":
        from iris_session.cloud.sources.mcap import McapSource

        return McapSource(settings, now_ns)
    if settings.source == "realsense":
        from iris_session.cloud.sources.realsense import RealSenseCamera

        return RealSenseCamera(settings, now_ns)
    from iris_session.cloud.sources.orbbec import OrbbecCamera

    return OrbbecCamera(settings, now_ns)
