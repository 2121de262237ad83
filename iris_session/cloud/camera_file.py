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

import difflib
import math
import re
import shlex
import tomllib
from pathlib import Path
from typing import Annotated, Any, Final, Literal, TypeVar, get_args

import msgspec
import numpy as np
import numpy.typing as npt
from msgspec import Meta

from anchors.camera import CameraError, CameraModel, parse_camera, pose_to_matrix
from anchors.pose import quat_normalize
from iris_session.protocol.common import Name, Quat, Text, Vec3
from iris_session.protocol.media import MAX_IMAGE_SIZE, MAX_STREAMS, describe_bad_stream_name, is_stream_name

SourceName = Literal["folder", "mujoco", "rerun", "mcap", "realsense", "orbbec"]
AudienceName = Literal["remote", "all"]
#: Keys with a choice of values.
_CHOICES: Final = {"source": get_args(SourceName), "audience": get_args(AudienceName)}
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
_T = TypeVar("_T")


class CameraFileError(ValueError):
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
    error_mm: Annotated[float, Meta(gt=0.0)] | None = None
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
        min_points: Points of a cell, at least.
        min_around: Occupied cells around a cell, at least.
        low: Lowest corner of the crop box [m], world frame.
        high: Highest corner.
        remove_robots: Leave out points on the session's robots.
        picture_hz: Rate of the pictures, streams of their own; 0: none.
        picture_quality: Quality of their JPEG, 1 to 100.
        cameras: Their frames are joined into one cloud.
    """

    stream: str
    title: Text = ""
    audience: AudienceName = "remote"
    hz: Annotated[float, Meta(gt=0.0, le=240.0)] = 30.0
    points: _Budget = 50_000
    voxel_m: Annotated[float, Meta(ge=0.001, le=10.0)] = 0.01
    min_points: Annotated[int, Meta(ge=1)] = 2
    min_around: Annotated[int, Meta(ge=0, le=26)] = 4
    low: Vec3 = (-2.0, -2.0, -0.1)
    high: Vec3 = (2.0, 2.0, 3.0)
    remove_robots: bool = False
    picture_hz: _Rate = 10.0
    picture_quality: Annotated[int, Meta(ge=1, le=100)] = 80
    cameras: Annotated[tuple[CameraSettings, ...], Meta(min_length=1)]

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
    try:
        found = Path(path).expanduser().absolute()
    except RuntimeError as error:  # the home of an unknown user
        raise CameraFileError(f"camera file {path}: {error}") from error
    return _Reader(found, calibrated).read()


class _Reader:
    """Reads one file; knows its text, for the lines of errors."""

    def __init__(self, path: Path, calibrated: bool) -> None:
        self._path = path
        self._calibrated = calibrated
        self._text = _read_text(path, "camera file")

    def read(self) -> CloudSettings:
        try:
            document = tomllib.loads(self._text)
        except (ValueError, RecursionError) as error:  # also a number or a nesting that Python does not take
            line = re.search(r"line (\d+)", str(error))
            raise CameraFileError(f"{self._path}: {error}", line=int(line[1]) if line else 0) from error
        self._check_finite(document)
        given = document.get("cameras")
        if not isinstance(given, list) or not given:
            raise self._error("cameras", "no camera: add a table [[cameras]] with name and source")
        document.setdefault("title", document.get("stream", ""))
        document["cameras"] = [
            self._resolve(table, index) if isinstance(table, dict) else table for index, table in enumerate(given)
        ]
        settings = self._convert(document, CloudSettings)
        self._check(settings)
        return settings

    # --- files that the tables name ---

    def _resolve(self, table: dict[str, Any], index: int) -> dict[str, Any]:
        """Return the table of a camera with the contents of the files that it names."""
        table = dict(table)
        source = table.get("source")
        if isinstance(table.get("path"), str) and source in _READ_FROM_DISK:
            table["path"] = str(self._locate("path", table["path"], index))
        if isinstance(table.get("model"), str):
            table["model"] = str(self._locate("model", table["model"], index))
        if isinstance(table.get("intrinsics"), str):
            file = self._locate("intrinsics", table["intrinsics"], index)
            try:
                table["intrinsics"] = _to_table(parse_camera(_read_text(file, "intrinsics")))
            except ValueError as error:
                raise self._error("intrinsics", _name_file(file, error), index) from error
        if not self._calibrated:
            for key in ("calibration", "pose", "error_mm"):
                table.pop(key, None)
        if (calibration := table.pop("calibration", None)) is None:
            return table
        if "pose" in table:
            raise self._error("pose", "pose and calibration are both given: one of them is enough", index)
        if not isinstance(calibration, str):
            raise self._error("calibration", f"{calibration!r} is not the path of a file", index)
        file = self._locate("calibration", calibration, index)
        try:
            pose, error_mm = read_calibration(file, str(table.get("name", "")), on_body=bool(table.get("body")))
        except CameraFileError as error:
            raise self._error("calibration", str(error), index) from error
        table["pose"] = pose
        if error_mm is not None:
            table.setdefault("error_mm", error_mm)
        return table

    def _locate(self, key: str, given: str, index: int) -> Path:
        """Return the path of a file that a camera names, relative to the camera file."""
        try:
            return self._path.parent / Path(given).expanduser()
        except RuntimeError as error:  # the home of an unknown user
            raise self._error(key, f"{given!r}: {error}", index) from error

    # --- checks ---

    def _check(self, settings: CloudSettings) -> None:
        if not is_stream_name(settings.stream):
            raise self._error("stream", describe_bad_stream_name(settings.stream))
        if any(low >= high for low, high in zip(settings.low, settings.high, strict=True)):
            raise self._error("low", f"low {list(settings.low)} must be below high {list(settings.high)} in x, y and z")
        names: set[str] = set()
        for index, camera in enumerate(settings.cameras):
            if camera.name in names:
                raise self._error("name", f"two cameras are named {camera.name!r}: names must differ", index)
            names.add(camera.name)
            stream = settings.name_picture_stream(camera.name)
            if not is_stream_name(stream):
                raise self._error("name", describe_bad_stream_name(stream), index)
            self._check_source(camera, index)
        if (n := len(settings.list_streams())) > MAX_STREAMS:
            raise self._error(
                "cameras", f"{n} streams, one for each camera's pictures: at most {MAX_STREAMS}; picture_hz = 0: none"
            )

    def _check_source(self, camera: CameraSettings, index: int) -> None:
        model = camera.intrinsics
        if model is not None and max(model.width, model.height) > MAX_IMAGE_SIZE:
            wrong = f"intrinsics are of {model.width} x {model.height} pixels"
            raise self._error("intrinsics", f"{wrong}: at most {MAX_IMAGE_SIZE} x {MAX_IMAGE_SIZE} are possible", index)
        if camera.source == "mujoco":
            for key in ("model", "camera"):
                if not getattr(camera, key):
                    raise self._error(key, f"{key} is missing: a rendered camera needs model and camera", index)
            return
        if camera.source in _READ_FROM_DISK:
            if not camera.path:
                raise self._error("path", f"path is missing: source {camera.source!r} reads a file or folder", index)
            if not Path(camera.path).exists():
                raise self._error("path", f"{camera.path!r} does not exist", index)
        if camera.source == "folder" and camera.intrinsics is None:
            wanted = "a file, or { width, height, fx, fy, cx, cy } in pixels"
            raise self._error("intrinsics", f"intrinsics are missing: {wanted}", index)
        has_poses = camera.source == "folder" and any(Path(camera.path).glob("*.pose.txt"))
        if camera.pose is None and not has_poses and self._calibrated:
            file, out = (shlex.quote(str(one)) for one in (self._path, self._path.with_name("calibration.toml")))
            raise self._error(
                "calibration",
                f"no calibration: `iris-session cloud calibrate {file} --out {out}` writes one, "
                'then calibration = "calibration.toml"; or pose = { position_m, quaternion_wxyz }',
                index,
            )

    def _check_finite(self, value: Any, key: str = "", camera: int | None = None) -> None:
        """Refuse inf and nan, which TOML has and JSON has not."""
        if isinstance(value, dict):
            for name, inner in value.items():
                self._check_finite(inner, str(name), camera)
        elif isinstance(value, list):
            for index, inner in enumerate(value):
                self._check_finite(inner, key, index if key == "cameras" else camera)
        elif isinstance(value, float) and not math.isfinite(value):
            raise self._error(key, f"{key} is {value}: a finite number is needed", camera)

    # --- errors ---

    def _convert(self, document: dict[str, Any], kind: type[_T]) -> _T:
        try:
            return msgspec.convert(document, kind)
        except msgspec.ValidationError as error:
            raise self._explain(str(error), document) from error

    def _explain(self, said: str, document: dict[str, Any]) -> CameraFileError:
        """Return msgspec's error with line, key and value."""
        message, _, path = said.partition(" - at `$")
        steps = re.findall(r"\.(\w+)|\[(\d+)\]", path)
        value: Any = document
        key, camera = "", None
        for name, number in steps:
            if number and key == "cameras":
                camera = int(number)
            key = name or key
            value = value[name] if name else value[int(number)]
        message = message.replace("`", "")
        if found := re.fullmatch(r"Object contains unknown field (.+)", message):
            known = _list_keys(key if isinstance(value, dict) else "")
            near = difflib.get_close_matches(found[1], known, n=1)
            right = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}"
            return self._error(found[1], f"unknown key {found[1]!r}: {right}", camera)
        if found := re.fullmatch(r"Object missing required field (.+)", message):
            return self._error(found[1], f"{found[1]} is missing", camera)
        if key in _CHOICES and isinstance(value, str):
            return self._error(key, f"{key} {value!r} is none of {', '.join(_CHOICES[key])}", camera)
        if message.startswith("Expected"):
            return self._error(key, f"{key} is {value!r}: e{message[1:]}", camera)
        named = next((name for name in CameraSettings.__struct_fields__ if message.startswith(name)), key)
        return self._error(named, message, camera)

    def _error(self, key: str, message: str, camera: int | None = None) -> CameraFileError:
        """Return the error of a key, of the file or of one of its cameras."""
        line = find_line(self._text, key, camera)
        where = f"{self._path}, line {line}" if line else f"{self._path}"
        which = f"camera {camera + 1}: " if camera is not None else ""
        return CameraFileError(f"{where}: {which}{message}", key, line)


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
    part = document if not isinstance(cameras, dict) else cameras.get(camera)
    if not isinstance(part, dict):
        raise CameraFileError(
            f"{path} has no camera {camera!r}: it has {', '.join(map(repr, cameras or ()))}", "calibration"
        )
    if "T_ee_camera" in part and not on_body:
        raise CameraFileError(
            f"{path} is of a camera on the robot's hand: name the body of the scene that carries it, body",
            "calibration",
        )
    table = "T_base_camera" if "T_base_camera" in part else "T_ee_camera"
    if not isinstance(part.get(table), dict):
        raise CameraFileError(
            f"{path} has no [T_base_camera]: `iris-session cloud calibrate` or `iris-session anchors calibrate-camera` "
            "writes one with --out",
            "calibration",
        )
    try:
        pose = msgspec.convert(part[table], CameraPose)
    except msgspec.ValidationError as error:
        message = re.sub(r" - at `\$\.?(.*)`$", r" in \1", str(error)).replace("`", "")
        raise CameraFileError(f"{path}, [{table}]: {message}", "calibration") from error
    error_mm = part.get("error_mm_p95")
    if error_mm is None:
        return pose, None
    if isinstance(error_mm, bool) or not isinstance(error_mm, int | float) or not 0.0 < error_mm < 1e6:
        raise CameraFileError(
            f"{path}: error_mm_p95 is {error_mm!r}: a number above 0 is needed; leave it out where it is not known",
            "calibration",
        )
    return pose, float(error_mm)


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


def _list_keys(key: str) -> list[str]:
    """Return the keys of a table of the file, named by the key that holds it."""
    if key == "cameras":
        return [*CameraSettings.__struct_fields__, "calibration"]
    return list((CameraPose if key == "pose" else CloudSettings).__struct_fields__)


def _read_text(path: Path, kind: str) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, ValueError) as error:  # not UTF-8, or a path with a null byte
        said = getattr(error, "strerror", None) or str(error)
        hint = _MISSING.get(kind, "") if isinstance(error, FileNotFoundError) else ""
        raise CameraFileError(f"{kind} {path} cannot be read: {said}{hint}") from error


def _name_file(path: Path, error: ValueError) -> str:
    if not isinstance(error, CameraError):
        return str(error)
    hint = "; a matrix has no size of the pictures, write width, height, fx, fy, cx, cy" if "size" in str(error) else ""
    return f"{path}: {error}{hint}"


def _to_table(camera: CameraModel) -> dict[str, Any]:
    return {name: getattr(camera, name) for name in CameraModel.__dataclass_fields__}
