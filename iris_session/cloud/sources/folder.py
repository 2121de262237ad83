"""A folder of pictures: `NAME.depth.png`, `NAME.color.jpg` or `.png`, and if known `NAME.pose.txt`.

The pose is that of the camera's optical frame, 4 x 4 numbers. The names are those of the 7-Scenes data set. A frame
that lacks one of its files is left out and counted.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import DepthFrame, SourceError
from iris_session.cloud.sources.playback import (
    DEFAULT_HZ,
    SECOND,
    RecordingSource,
    decode_picture,
    fit_color,
    to_depth,
    to_rgb,
)
from iris_session.system.extras import require_package


class FolderSource(RecordingSource[str]):
    """Plays the pictures of a folder, in the order of their names.

    `pose` of the camera is the pose of the frame in which the poses of the files are, where there are such files.

    Attributes:
        left_out: Frames that lack a file.
    """

    def __init__(self, settings: CameraSettings, now_ns: Callable[[], int]) -> None:
        require_package("cv2", "a folder of pictures")
        if settings.intrinsics is None:
            raise SourceError("intrinsics are missing: pictures in a folder do not tell them")
        self.camera = settings.intrinsics
        self.depth_scale_m = settings.depth_scale_m or 0.001
        self._folder = Path(settings.path)
        depth, poses = self._list_names(".depth.png"), self._list_names(".pose.txt")
        color = self._list_names(".color.jpg") | self._list_names(".color.png")
        self._has_poses = bool(poses)
        complete = depth & color & poses if poses else depth & color
        if not complete:
            raise SourceError(self._describe_missing())
        self._names = sorted(complete)
        self.left_out = len((depth | color | poses) - complete)
        self._T_world_poses = settings.pose.to_matrix() if settings.pose else np.eye(4)
        self._period_ns = SECOND / (settings.hz or DEFAULT_HZ)
        super().__init__(settings, now_ns)

    def _list_names(self, ending: str) -> set[str]:
        return {path.name.removesuffix(ending) for path in self._folder.glob(f"*{ending}")}

    def _describe_missing(self) -> str:
        """Return what the folder lacks, and the endings of the files that it has."""
        endings = Counter("." + path.name.partition(".")[2] for path in self._folder.iterdir() if path.is_file())
        has = ", ".join(f"{ending} ({n})" for ending, n in endings.most_common(6)) or "no files"
        wanted = "NAME.depth.png with NAME.color.jpg or .png" + (" and NAME.pose.txt" if self._has_poses else "")
        return f"{self._folder} has no frame of {wanted}; its files end in {has}"

    def _decode_frame(self, content: str, capture_ns: int) -> DepthFrame:
        file = self._folder / f"{content}.depth.png"
        depth = to_depth(decode_picture(_read(file), str(file)), self.depth_scale_m, str(file))
        color_file = self._folder / f"{content}.color.jpg"
        if not color_file.exists():
            color_file = color_file.with_suffix(".png")
        color = to_rgb(decode_picture(_read(color_file), str(color_file)), str(color_file))
        pose = self._T_world_poses @ self._read_pose(content) if self._has_poses else None
        return DepthFrame(depth, fit_color(color, depth, str(file)), capture_ns, pose)

    def _list_frames(self) -> Iterator[tuple[int, str]]:
        for number, name in enumerate(self._names):
            yield round(number * self._period_ns), name

    def _read_pose(self, name: str) -> npt.NDArray[np.float64]:
        file = self._folder / f"{name}.pose.txt"
        try:
            pose = np.array([float(word) for word in _read(file).split()])
        except ValueError as error:
            raise SourceError(f"{file}: {error}; a pose is 4 x 4 numbers") from error
        if pose.size != 16:
            raise SourceError(f"{file} has {pose.size} numbers: a pose is 4 x 4")
        return pose.reshape(4, 4)


def _read(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        raise SourceError(f"{file} cannot be read: {error.strerror}") from error
