"""The camera file: cameras of one point cloud, its stream, and the limits of its points, as TOML.

    stream = "room"
    [[cameras]]
    name = "front"
    source = "realsense"
    calibration = "calibration.toml"

Files that it names are read here, so that the settings can be passed on: intrinsics, and the poses that
`iris-session anchors calibrate-camera --out` writes. Every mistake is one line with file, line and key.
"""

from __future__ import annotations

import math
import os
import re
import shlex
import tomllib
from pathlib import Path
from typing import Annotated, Any, Final, Literal, get_args

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from anchors.camera import CameraModel, parse_camera, pose_to_matrix
from anchors.pose import quat_normalize
from iris_session.protocol.common import Name, Quat, Text, Vec3
from iris_session.protocol.errors import IrisError
from iris_session.protocol.media import MAX_IMAGE_SIZE, MAX_STREAMS, describe_bad_stream_name, is_stream_name

SourceName = Literal["folder", "mujoco", "rerun", "mcap", "realsense", "orbbec"]
AudienceName = Literal["remote", "all"]
#: Keys with a choice of values.
_CHOICES: Final = {"source": get_args(SourceName), "audience": get_args(AudienceName)}
_ErrorMm = Annotated[float, Meta(gt=0.0, lt=1e6)]
#: Points of a frame: below, a room cannot be recognised; above, a frame from another process is refused.
_Budget = Annotated[int, Meta(ge=1_000, le=1_000_000)]
_Rate = Annotated[float, Meta(ge=0.0, le=240.0)]
_Size = Annotated[int, Meta(ge=16, le=MAX_IMAGE_SIZE)]
#: Quaternions in hand-written files have few digits.
_UNIT_TOLERANCE: Final = 1e-3
#: Sources whose `path` is a file or folder; of the others it names a device.
_READ_FROM_DISK: Final = ("folder", "rerun", "mcap")
#: What to do about a file that does not exist, by its kind.
_MISSING: Final = {
    "camera file": "; `iris-session cloud example` prints one",
    "calibration": "; `iris-session cloud calibrate` or `iris-session anchors calibrate-camera` writes it with --out, "
    "or give a pose",
}


#: Least focal length, as a share of the width: 157 degrees.
LEAST_FOCAL: Final = 0.1


class CameraFileError(IrisError, ValueError):
    """A camera file, or one that it names, cannot be used. The message is one line.

    Attributes:
        key: Key in the file, empty where the error has none.
        line: Its line, 0 where it is not known.
    """

    def __init__(self, message: str, key: str = "", line: int = 0) -> None:
        super().__init__(message)
        self.key, self.line = key, line


class CameraPose(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Pose of a camera's optical frame (x right, y down, z forward)."""

    position_m: Vec3
    quaternion_wxyz: Quat

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, self.position_m)):
            raise ValueError(f"position_m {list(self.position_m)} must be finite numbers")
        if not abs(math.hypot(*self.quaternion_wxyz) - 1.0) <= _UNIT_TOLERANCE:  # also of NaN
            raise ValueError(f"quaternion_wxyz {list(self.quaternion_wxyz)} must have length 1, w first")

    def to_matrix(self) -> npt.NDArray[np.float64]:
        """Return the transform (4, 4)."""
        return pose_to_matrix((self.position_m, quat_normalize(self.quaternion_wxyz)))


class CameraSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One camera of a cloud.

    Attributes:
        name: Name of the camera.
        source: Kind of the source.
        path: Folder or file of a recording, or serial number of a device; empty: the only one.
        model: Model file of a rendered camera.
        camera: Name of the rendered camera in that model.
        depth: Topic or entity of the depth pictures in a recording; empty: the only one.
        color: Topic or entity of the colour pictures.
        width, height: Size of the depth pictures [px], for devices and rendered cameras.
        hz: Frames per second; 0: as recorded, or 30.
        intrinsics: Of the depth pictures; None: as the source says.
        pose: Of the optical frame in `body`, or in the world; None: each frame has its own.
        body: Name of the body of the scene that carries the camera; empty: the world.
        depth_scale_m: Length of one unit of depth [m]; None: as the source says, 0.001 where it does not.
        nearest_m: Least depth [m].
        farthest_m: Greatest depth [m].
        error_mm: Stated 95 % bound of the error of points [mm]; None: not known.
        loop: Recordings begin anew at their end.
    """

    name: Annotated[str, Meta(min_length=1, max_length=32)]
    source: SourceName
    path: str = ""
    model: str = ""
    camera: str = ""
    depth: str = ""
    color: str = ""
    width: _Size = 640
    height: _Size = 480
    hz: _Rate = 0.0
    intrinsics: CameraModel | None = None
    pose: CameraPose | None = None
    body: Name = ""
    depth_scale_m: Annotated[float, Meta(gt=0.0, lt=1.0)] | None = None
    nearest_m: Annotated[float, Meta(ge=0.0)] = 0.3
    farthest_m: Annotated[float, Meta(gt=0.0, le=100.0)] = 3.5
    error_mm: _ErrorMm | None = None
    loop: bool = True

    def __post_init__(self) -> None:
        if self.nearest_m >= self.farthest_m:
            raise ValueError(f"nearest_m {self.nearest_m:g} must be less than farthest_m {self.farthest_m:g}")


class CloudSettings(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One point cloud: its stream, its cameras, its limits. MessagePack and JSON hold it.

    Attributes:
        stream: Name of the media stream.
        title: Shown to people.
        audience: Who needs it: `remote` (people in the room see it anyway), or `all`.
        hz: Frames per second, at most.
        points: Points of a frame, at most.
        voxel_m: Smallest edge of a cell [m].
        low: Lowest corner of the crop box [m], world frame.
        high: Highest corner.
        remove_robots: Leave out points on the session's robots.
        picture_hz: Rate of the pictures, streams of their own; 0: none.
        cameras: Their frames are joined into one cloud.
    """

    stream: str
    title: Text = ""
    audience: AudienceName = "remote"
    hz: Annotated[float, Meta(gt=0.0, le=240.0)] = 30.0
    points: _Budget = 50_000
    voxel_m: Annotated[float, Meta(ge=0.001, le=10.0)] = 0.01
    low: Vec3 = (-2.0, -2.0, -0.1)
    high: Vec3 = (2.0, 2.0, 3.0)
    remove_robots: bool = False
    picture_hz: _Rate = 10.0
    cameras: Annotated[tuple[CameraSettings, ...], Meta(min_length=1)]

    def __post_init__(self) -> None:
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):  # also of NaN
            raise ValueError(f"low {list(self.low)} must be below high {list(self.high)} in x, y and z")

    def name_picture_stream(self, camera: str) -> str:
        """Return the name of the stream of a camera's pictures."""
        return f"{self.stream}-{camera}"

    def list_streams(self) -> list[str]:
        """Return the names of all streams of the cloud."""
        pictures = [self.name_picture_stream(one.name) for one in self.cameras] if self.picture_hz else []
        return [self.stream, *pictures]


def load_camera_file(path: str | Path, *, calibrated: bool = True) -> CloudSettings:
    """Read a camera file and the files that it names.

    Args:
        path: Path of the file.
        calibrated: Every camera needs a pose. False to calibrate them: poses are left out, and need not be there.

    Returns:
        The settings; paths in them are absolute.

    Raises:
        CameraFileError: The file cannot be read, or a value in it cannot be used.
    """
    return _Reader(Path(os.path.expanduser(path)).absolute(), calibrated).read()


class _Reader:
    """Reads one file; knows its text, for the lines of errors."""

    def __init__(self, path: Path, calibrated: bool) -> None:
        self._path = path
        self._calibrated = calibrated
        self._text = _read_text(path, "camera file")

    def read(self) -> CloudSettings:
        try:
            document = tomllib.loads(self._text)
        except (ValueError, RecursionError) as error:  # also a nesting that Python does not take
            line = re.search(r"line (\d+)", str(error))
            raise CameraFileError(f"{self._path}: {error}", line=int(line[1]) if line else 0) from error
        tables = document.get("cameras")
        if not isinstance(tables, list) or not tables:
            raise self._error("cameras", "no camera: add a table [[cameras]] with name and source")
        document.setdefault("title", document.get("stream", ""))
        document["cameras"] = [
            self._resolve(table, index) if isinstance(table, dict) else table for index, table in enumerate(tables)
        ]
        try:
            settings = msgspec.convert(document, CloudSettings)
        except msgspec.ValidationError as error:
            key, number, text = _explain(error, document)
            raise self._error(key, text, number) from error
        if not is_stream_name(settings.stream):
            raise self._error("stream", describe_bad_stream_name(settings.stream))
        for index, camera in enumerate(settings.cameras):
            if camera.name in {one.name for one in settings.cameras[:index]}:
                raise self._error("name", f"two cameras are named {camera.name!r}: names must differ", index)
            if not is_stream_name(stream := settings.name_picture_stream(camera.name)):
                raise self._error("name", describe_bad_stream_name(stream), index)
            self._check_source(camera, index)
        if (n := len(settings.list_streams())) > MAX_STREAMS:
            raise self._error(
                "cameras", f"{n} streams, one for each camera's pictures: at most {MAX_STREAMS}; picture_hz = 0: none"
            )
        return settings

    def _resolve(self, table: dict[str, Any], index: int) -> dict[str, Any]:
        """Return the table of a camera with the contents of the files that it names."""
        table = dict(table)
        for key in ("path", "model") if table.get("source") in _READ_FROM_DISK else ("model",):
            if isinstance(table.get(key), str):
                table[key] = str(self._locate(table[key]))
        if isinstance(table.get("intrinsics"), str):
            file = self._locate(table["intrinsics"])
            try:
                camera = parse_camera(_read_text(file, "intrinsics"))
            except ValueError as error:
                text = str(error) if isinstance(error, CameraFileError) else f"{file}: {error}"
                raise self._error("intrinsics", text, index) from error
            table["intrinsics"] = {name: getattr(camera, name) for name in CameraModel.__dataclass_fields__}
        if not self._calibrated:
            for key in ("calibration", "pose", "error_mm"):
                table.pop(key, None)
        if (calibration := table.pop("calibration", None)) is None:
            return table
        if "pose" in table:
            raise self._error("pose", "pose and calibration are both given: one of them is enough", index)
        if not isinstance(calibration, str):
            raise self._error("calibration", f"{calibration!r} is not the path of a file", index)
        try:
            pose, error_mm = read_calibration(
                self._locate(calibration), str(table.get("name", "")), on_body=bool(table.get("body"))
            )
        except CameraFileError as error:
            raise self._error("calibration", str(error), index) from error
        table["pose"] = pose
        if error_mm is not None:
            table.setdefault("error_mm", error_mm)
        return table

    def _locate(self, path: str) -> Path:
        """Return the path of a file that a camera names, relative to the camera file."""
        return self._path.parent / os.path.expanduser(path)

    def _check_source(self, camera: CameraSettings, index: int) -> None:
        """Raise the error of what the source of a camera cannot use, or lacks."""
        model, reads = camera.intrinsics, camera.source in _READ_FROM_DISK
        if model is not None and max(model.width, model.height) > MAX_IMAGE_SIZE:
            text = (
                f"intrinsics are of {model.width} x {model.height} pixels: at most {MAX_IMAGE_SIZE} x {MAX_IMAGE_SIZE}"
            )
            raise self._error("intrinsics", f"{text} are possible", index)
        if model is not None and (text := _find_impossible(model)):
            raise self._error("intrinsics", text, index)
        for key in ("model", "camera") if camera.source == "mujoco" else ():
            if not getattr(camera, key):
                raise self._error(key, f"{key} is missing: a rendered camera needs model and camera", index)
        if reads and not camera.path:
            raise self._error("path", f"path is missing: source {camera.source!r} reads a file or folder", index)
        if reads and not Path(camera.path).exists():
            raise self._error("path", f"{camera.path!r} does not exist", index)
        if camera.source == "folder" and model is None:
            text = "intrinsics are missing: a file, or { width, height, fx, fy, cx, cy } in pixels"
            raise self._error("intrinsics", text, index)
        has_poses = camera.source == "folder" and any(Path(camera.path).glob("*.pose.txt"))
        if self._calibrated and camera.pose is None and camera.source != "mujoco" and not has_poses:
            file, out = (shlex.quote(str(one)) for one in (self._path, self._path.with_name("calibration.toml")))
            text = (
                f"no calibration: `iris-session cloud calibrate {file} --out {out}` writes one, "
                'then calibration = "calibration.toml"; or pose = { position_m, quaternion_wxyz }'
            )
            raise self._error("calibration", text, index)

    def _error(self, key: str, message: str, camera: int | None = None) -> CameraFileError:
        """Return the error of a key, of the file or of one of its cameras."""
        line = find_line(self._text, key, camera)
        where = f"{self._path}, line {line}" if line else f"{self._path}"
        which = f"camera {camera + 1}: " if camera is not None else ""
        return CameraFileError(f"{where}: {which}{message}", key, line)


def _explain(error: msgspec.ValidationError, document: dict[str, Any]) -> tuple[str, int | None, str]:
    """Return the key of a value that msgspec refuses, the number of its camera, and one line with the value."""
    message, _, path = str(error).replace("`", "").partition(" - at $")
    value: Any = document
    key, camera = "", None
    for name, number in re.findall(r"\.(\w+)|\[(\d+)\]", path):
        if number and key == "cameras":
            camera = int(number)
        key = name or key
        value = value[name] if name else value[int(number)]
    if found := re.fullmatch(r"Object contains unknown field (.+)", message):
        kind = {"cameras": CameraSettings, "pose": CameraPose, "T_base_camera": CameraPose, "T_ee_camera": CameraPose}
        keys = [*kind.get(key, CloudSettings).__struct_fields__, *["calibration"][: key == "cameras"]]
        return found[1], camera, f"unknown key {found[1]!r}: known are {', '.join(keys)}"
    if found := re.fullmatch(r"Object missing required field (.+)", message):
        return found[1], camera, f"{found[1]} is missing"
    if key in _CHOICES and isinstance(value, str):
        return key, camera, f"{key} {value!r} is none of {', '.join(_CHOICES[key])}"
    if message.startswith("Expected"):
        return key, camera, f"{key} is {value!r}: e{message[1:]}"
    fields = (*CloudSettings.__struct_fields__, *CameraSettings.__struct_fields__)
    return next((name for name in fields if message.startswith(name)), key), camera, message


class _Calibration(msgspec.Struct, frozen=True):
    """Calibration of a camera, as far as it is read."""

    T_base_camera: CameraPose | None = None
    T_ee_camera: CameraPose | None = None
    error_mm_p95: _ErrorMm | None = None


def read_calibration(path: Path, camera: str, *, on_body: bool) -> tuple[CameraPose, float | None]:
    """Read what `iris-session anchors calibrate-camera --out` writes.

    Args:
        path: Path of the file.
        camera: Name of the camera, for files with several.
        on_body: The camera is fixed to a body of the scene, such as a robot's hand.

    Returns:
        The pose, and the stated 95 % bound of its error [mm], None: not stated.

    Raises:
        CameraFileError: The file cannot be read, or does not have a usable pose of this camera.
    """
    text = _read_text(path, "calibration")
    try:
        document = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise CameraFileError(f"{path}: {error}", "calibration") from error
    cameras = document.get("cameras")
    part = cameras.get(camera) if isinstance(cameras, dict) else document
    if not isinstance(part, dict):
        raise CameraFileError(
            f"{path} has no camera {camera!r}: it has {', '.join(map(repr, cameras or ()))}", "calibration"
        )
    try:
        found = msgspec.convert(part, _Calibration)
    except msgspec.ValidationError as error:
        raise CameraFileError(f"{path}: {_explain(error, part)[2]}", "calibration") from error
    if found.T_base_camera is None and found.T_ee_camera is not None and not on_body:
        text = "is of a camera on the robot's hand: name the body of the scene that carries it, body"
        raise CameraFileError(f"{path} {text}", "calibration")
    pose = found.T_base_camera or found.T_ee_camera
    if pose is None:
        raise CameraFileError(f"{path} has no [T_base_camera]{_MISSING['calibration']}", "calibration")
    return pose, found.error_mm_p95


def find_line(text: str, key: str, camera: int | None = None) -> int:
    """Return the line of a key in a camera file, 0 if it is not found.

    Args:
        text: The file.
        key: The key, or the table, in any notation that has it first on its line.
        camera: Number of the table `[[cameras]]`, from 0; None: above the first one. A key that this table lacks gets
            the line of the table.
    """
    table, at = -1, 0
    for number, line in enumerate(text.splitlines(), 1):
        if re.match(r"\s*\[\[\s*cameras\s*\]\]", line):
            table += 1
            at = number if table == camera else at
            if key == "cameras" and camera is None:
                return number
        elif table == (-1 if camera is None else camera) and re.search(rf"^\s*\[?[\w.]*\b{re.escape(key)}\b", line):
            return number
    return at


def _find_impossible(camera: CameraModel) -> str:
    """Return what is impossible about intrinsics, empty for possible ones."""
    least = LEAST_FOCAL * camera.width
    if min(camera.fx, camera.fy) < least:
        return f"fx {camera.fx:g}, fy {camera.fy:g}: at least a tenth of the width, {least:g} pixels, are possible"
    if not (0.0 <= camera.cx <= camera.width and 0.0 <= camera.cy <= camera.height):
        size = f"{camera.width} x {camera.height} pixels"
        return f"the centre cx {camera.cx:g}, cy {camera.cy:g} is outside the picture of {size}: are they of this size?"
    return ""


def _read_text(path: Path, kind: str) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:  # not UTF-8, or a path with a null byte
        said = getattr(error, "strerror", None) or str(error)
        hint = _MISSING.get(kind, "") if isinstance(error, FileNotFoundError) else ""
        raise CameraFileError(f"{kind} {path} cannot be read: {said}{hint}") from error
