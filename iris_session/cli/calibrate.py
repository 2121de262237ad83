"""`iris-session anchors calibrate-camera` and `cloud calibrate`: poses of cameras by sheets that they see.

The first has pictures, of a sheet on a robot's hand or of sheets at known poses; the second the cameras of a camera
file, which it may fit to each other by ICP, or check. The mathematics is in `anchors`.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

from anchors.camera_calibration import (
    CalibrationPicture,
    calibration_to_toml,
    solve_from_known_sheets,
    solve_from_robot_poses,
)
from anchors.pose import pose_to_dict
from iris_session.cli.common import (
    CommandError,
    Commands,
    add_address_options,
    add_command,
    make_client,
    make_number_type,
    parse_length,
    parse_pose,
    print_result,
    write_file,
)

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from anchors.camera import CameraModel
    from anchors.depth_calibration import PlacedCamera
    from anchors.pose import PoseTuple
    from anchors.sheet import Sheet
    from iris_session.cloud.camera_file import CameraSettings, CloudSettings
    from iris_session.cloud.frames import DepthFrame

    Floats = npt.NDArray[np.float64]

T = TypeVar("T")
PICTURES: Final = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm")
COLUMNS: Final = "image,x,y,z,qw,qx,qy,qz"
#: Time for a camera to give its frames [s].
FRAMES_S: Final = 20.0


# --- options of both --------------------------------------------------------------------------------------------------


def _add_sheet_options(parser: argparse.ArgumentParser, *, is_required: bool, at: str) -> None:
    """Add `--sheet` and `--at`. `at`: help of the latter."""
    parser.add_argument(
        "--sheet",
        type=_make_named_type(parse_length),
        action="append",
        required=is_required,
        default=[],
        metavar="ID=LENGTH",
        help="id of a sheet and the printed edge of its code: table=150mm; repeatable",
    )
    pose = _make_named_type(parse_pose)
    parser.add_argument("--at", type=pose, action="append", default=[], metavar="ID=X,Y,Z,QW,QX,QY,QZ", help=at)


def _make_named_type(parse: Callable[[str], T]) -> Callable[[str], tuple[str, T]]:
    """Return a type of options: the id of a sheet, `=`, and what `parse` takes."""

    def parse_named(text: str) -> tuple[str, T]:
        name, _, rest = text.rpartition("=")
        if not name:
            raise argparse.ArgumentTypeError(f"{text!r}: the id of the sheet is missing, for example table=150mm")
        return name, parse(rest)

    return parse_named


def make_sheets(sizes: Iterable[tuple[str, float]]) -> list[Sheet]:
    """Return the sheets of the options `--sheet`: id and edge [m]."""
    from anchors.sheet import Sheet, SheetError

    try:
        sheets = [Sheet(name, edge) for name, edge in sizes]
    except SheetError as error:
        raise CommandError(str(error)) from error
    if len({sheet.anchor_id for sheet in sheets}) != len(sheets):
        raise CommandError("--sheet: the same sheet is given twice")
    return sheets


def _check_known_sheets(at: Iterable[tuple[str, PoseTuple]], sheets: list[Sheet]) -> None:
    """Raise `CommandError` for a pose of a sheet whose size is not given."""
    unknown = sorted({name for name, _ in at} - {sheet.anchor_id for sheet in sheets})
    if unknown:
        raise CommandError(f"--at {unknown[0]}: no size is given, add --sheet {unknown[0]}=150mm")


def format_calibration(result: dict[str, Any]) -> list[str]:
    """Return the result as lines of text."""
    lines = []
    for row in result["pictures"]:
        name = row["file"] if row["camera"] in ("", row["file"]) else f"{row['camera']}/{row['file']}"
        if not row["found"]:
            lines.append(f"{name}  no sheet found")
            continue
        note = "" if row["used"] else "  EXCLUDED: contradicts the others"
        lines.append(
            f"{name}  {row['sheet']}  {row['residual_mm']:.2f} mm  {row['residual_deg']:.3f} deg  "
            f"{row['residual_px']:.2f} px{note}"
        )
    lines.append(
        f"{result['used']} used, {result['left_out']} excluded; residual rms {result['residual_mm_rms']:.2f} mm, "
        f"{result['residual_deg_rms']:.3f} deg, {result['residual_px_rms']:.2f} px"
    )
    for name, value in _list_poses(result):
        p, q = value["position_m"], value["quaternion_wxyz"]
        place = ", ".join(f"{v:.5f}" for v in p)
        lines.append(f"{name}  p = [{place}] m  q = [{', '.join(f'{v:.6f}' for v in q)}]")
    for name, part in [("", result), *result.get("cameras", {}).items()]:
        if "error_mm_p95" in part:
            turn = f", {part['sigma_deg']:.3f} deg (sigma)" if "sigma_deg" in part else ""
            lines.append(f"{name + ': ' if name else ''}stated error {part['error_mm_p95']:.2f} mm (95 %){turn}")
    return lines


def _list_poses(result: dict[str, Any]) -> list[tuple[str, dict[str, list[float]]]]:
    found = [(key, value) for key, value in result.items() if key.startswith("T_")]
    for kind in ("cameras", "sheets"):
        for name, part in result.get(kind, {}).items():
            found += [(f"{key} of {name}", value) for key, value in part.items() if key.startswith("T_")]
    return found


# --- anchors calibrate-camera -----------------------------------------------------------------------------------------


def register_camera(actions: Commands) -> None:
    one = add_command(
        actions,
        "calibrate-camera",
        run_camera,
        help="calibrate the pose of a camera",
        description="Compute T_base_camera from pictures: of a sheet on the robot's hand while the hand moves "
        "(--poses), or of sheets at known poses (--at). Prints residuals, and refuses pictures that do not "
        "determine the result.",
        examples="""
            iris-session anchors calibrate-camera pictures --sheet table=150mm --poses poses.csv
            iris-session anchors calibrate-camera pictures --sheet table=150mm --at table=0,-0.45,0,1,0,0,0
        """,
        notes="poses.csv, metres and unit quaternions, one line per picture:\n"
        "  image,x,y,z,qw,qx,qy,qz\n"
        "  0001.png,0.412,0.031,0.388,0.0012,0.9998,0.0131,0.0021\n\n"
        "Several cameras at once: one folder each below FOLDER, with its own intrinsics.toml.",
    )
    one.add_argument("folder", type=Path, metavar="FOLDER", help="folder of the pictures")
    _add_sheet_options(one, is_required=True, at="known pose of a sheet, T_base_sheet; repeatable")
    text = (
        "TOML with width, height, fx, fy, cx, cy, distortion, or a 3x3 matrix as text "
        "(default: intrinsics.toml or intrinsics.txt beside the pictures)"
    )
    one.add_argument("--intrinsics", type=Path, metavar="FILE", help=text)
    one.add_argument("--poses", type=Path, metavar="CSV", help="T_base_ee, pose of the robot's hand, per picture")
    text = "with --poses: the camera is on the hand, the sheet does not move"
    one.add_argument("--camera-on-hand", action="store_true", help=text)
    text = "with --poses: known pose of the sheet on the hand, T_ee_sheet; one picture is enough"
    one.add_argument("--in-hand", type=parse_pose, metavar="X,Y,Z,QW,QX,QY,QZ", help=text)
    one.add_argument("--out", type=Path, metavar="FILE", help="also write the result as TOML")


def run_camera(arguments: argparse.Namespace) -> int:
    """Calibrate, print the result, and write it to `--out`. Exit status 1 if the pictures do not determine it."""
    from anchors.robot_world import CalibrationError

    try:
        result = calibrate_cameras(arguments)
    except CalibrationError as error:
        raise CommandError(str(error), status=1) from error
    if arguments.out is not None:
        write_file(arguments.out, calibration_to_toml(result))
    return print_result(arguments, result, format_calibration(result))


def calibrate_cameras(arguments: argparse.Namespace) -> dict[str, Any]:
    """Calibrate cameras from pictures. Return the object that `--json` prints. Raises `CalibrationError`."""
    sheets = make_sheets(arguments.sheet)
    _check_options(arguments, sheets)
    if arguments.at:
        pictures = _read_pictures(arguments.folder, arguments.intrinsics, sheets)
        return solve_from_known_sheets(pictures, dict(arguments.at))[0]
    poses = read_poses(arguments.poses)
    pictures = _read_pictures(arguments.folder, arguments.intrinsics, sheets)
    if len({picture.camera_name for picture in pictures}) > 1:
        raise CommandError("--poses calibrates one camera at a time: give the folder of that camera")
    missing = [picture.path.name for picture in pictures if picture.path.name not in poses]
    if missing:
        raise CommandError(f"{arguments.poses} has no line for {missing[0]} ({len(missing)} pictures have no pose)")
    return solve_from_robot_poses(
        pictures, poses, camera_on_hand=arguments.camera_on_hand, T_ee_sheet=arguments.in_hand
    )


def _check_options(arguments: argparse.Namespace, sheets: list[Sheet]) -> None:
    if (arguments.poses is None) == (not arguments.at):
        raise CommandError("give --poses CSV (the robot's hand moves) or --at ID=POSE (sheets at known poses)")
    if arguments.at and (arguments.in_hand or arguments.camera_on_hand):
        raise CommandError("--in-hand and --camera-on-hand need --poses, not --at")
    if arguments.in_hand and arguments.camera_on_hand:
        raise CommandError("--in-hand cannot be combined with --camera-on-hand: it is the pose of a sheet on the hand")
    if arguments.poses is not None and len(sheets) != 1:
        raise CommandError(
            f"{len(sheets)} sheets with --poses: give exactly one --sheet, on the hand, or with "
            "--camera-on-hand in the room"
        )
    _check_known_sheets(arguments.at, sheets)


def read_poses(path: Path) -> dict[str, PoseTuple]:
    """Read `T_base_ee` by name of the picture."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise CommandError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error
    if not lines or lines[0].replace(" ", "") != COLUMNS:
        raise CommandError(f"{path}: the first line must be {COLUMNS}")
    poses: dict[str, PoseTuple] = {}
    for number, line in enumerate(lines[1:], 2):
        if not line.strip():
            continue
        name, _, pose = line.partition(",")
        if name in poses:
            raise CommandError(f"{path}, line {number}: a second pose for {name}")
        try:
            poses[name] = parse_pose(pose)
        except argparse.ArgumentTypeError as error:
            raise CommandError(f"{path}, line {number}: must be the name of a picture and its pose: {error}") from None
    return poses


def _read_pictures(folder: Path, intrinsics: Path | None, sheets: list[Sheet]) -> list[CalibrationPicture]:
    """Read the pictures of the folder, or of its subfolders, and detect sheets in them."""
    if not folder.is_dir():
        raise CommandError(f"{folder} is not a folder")
    folders = [folder] if _list_pictures(folder) else [inner for inner in sorted(folder.iterdir()) if inner.is_dir()]
    found = [picture for one in folders for picture in _read_camera_folder(one, intrinsics, sheets)]
    if not found:
        raise CommandError(f"no pictures in {folder}: they must end in {', '.join(PICTURES)}")
    return found


def _list_pictures(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.suffix.lower() in PICTURES)


def _read_camera_folder(folder: Path, intrinsics: Path | None, sheets: list[Sheet]) -> list[CalibrationPicture]:
    import cv2

    from anchors.detection import DetectionError, SheetDetector

    pictures: list[CalibrationPicture] = []
    detectors: dict[tuple[int, int], SheetDetector] = {}
    for path in _list_pictures(folder):
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if image is None:
            raise CommandError(f"{path} is not a readable picture")
        height, width = image.shape
        if (width, height) not in detectors:
            detectors[width, height] = SheetDetector(sheets, _read_camera(folder, intrinsics, width, height))
        detector = detectors[width, height]
        try:
            pictures.append(CalibrationPicture(path, folder.name, detector.camera, tuple(detector.detect(image))))
        except DetectionError as error:
            raise CommandError(f"{path}: {error}") from error
    return pictures


def _read_camera(folder: Path, intrinsics: Path | None, width: int, height: int) -> CameraModel:
    from anchors.camera import CameraError, parse_camera

    places = [intrinsics] if intrinsics is not None else [folder / "intrinsics.toml", folder / "intrinsics.txt"]
    path = next((place for place in places if place.is_file()), None)
    if path is None:
        raise CommandError(
            f"no intrinsics at {places[0]}: give with --intrinsics a TOML file with width, height, fx, fy, cx, cy "
            "[pixels] and distortion, from the maker of the camera or a calibration"
        )
    try:
        return parse_camera(path.read_text(encoding="utf-8"), width, height)
    except (CameraError, OSError, UnicodeDecodeError) as error:
        raise CommandError(f"{path}: {error}") from error


# --- cloud calibrate --------------------------------------------------------------------------------------------------


class KnownSheets(NamedTuple):
    """Sheets to look for, `T_world_sheet` of those at known poses, and the errors that the session states of them [m],
    0 for those of which it states none. Poses that the user gives are exact: they say where the world is."""

    sheets: list[Sheet]
    poses: dict[str, PoseTuple]
    errors_m: dict[str, float]


class CameraFrames(NamedTuple):
    """Frames of one camera at rest."""

    settings: CameraSettings
    camera: CameraModel
    depth_scale_m: float
    frames: list[DepthFrame]


def register_depth_cameras(actions: Commands) -> None:
    parser = add_command(
        actions,
        "calibrate",
        run_depth_cameras,
        help="calibrate the cameras of a camera file by sheets that they see",
        description="Take frames from the cameras of a camera file, detect sheets of known pose in them, and write the "
        "poses of the cameras with their stated errors. The poses of the sheets are those of a session, or given with "
        "--at. With --icp the cameras are then fitted to each other by what they see. Nothing may move meanwhile. With "
        "--check nothing is written: the poses are compared with those of the camera file.",
        examples="""
            iris-session cloud calibrate camera.toml --out calibration.toml             sheets of the session here
            iris-session cloud calibrate camera.toml --address 192.168.1.20 --icp --out calibration.toml
            iris-session cloud calibrate camera.toml --sheet table=150mm --at table=0,-0.45,0,1,0,0,0
            iris-session cloud calibrate camera.toml --check                            do they still fit?
        """,
    )
    parser.add_argument("file", type=Path, help="camera file; without --check the poses in it are not used")
    at = "known pose of a sheet in the world; repeatable; without it the anchors of the session"
    _add_sheet_options(parser, is_required=False, at=at)
    add_address_options(parser, option=True)
    count = make_number_type(int, "a number of frames: give 1 to 200, for example 10", 1, 200)
    parser.add_argument("--frames", type=count, default=10, metavar="N", help="frames per camera (%(default)s)")
    parser.add_argument("--icp", action="store_true", help="then fit several cameras to each other")
    parser.add_argument("--check", action="store_true", help="tell whether the poses of the camera file still fit")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the result as TOML, for the camera file")


def run_depth_cameras(arguments: argparse.Namespace) -> int:
    """Calibrate, print the result, and write it to `--out`. Or compare it with the camera file, for `--check`.

    Exit status 1 if the frames do not determine it, or a camera is not where it was calibrated.
    """
    from anchors.robot_world import CalibrationError
    from iris_session.cloud.camera_file import load_camera_file

    settings = load_camera_file(arguments.file, calibrated=arguments.check)
    if arguments.check and (arguments.icp or arguments.out is not None):
        raise CommandError("--check writes no poses: leave out --icp and --out")
    if arguments.icp and len(settings.cameras) < 2:
        raise CommandError(f"--icp fits cameras to each other: {arguments.file} has one camera")
    for camera in settings.cameras:
        if camera.body:
            raise CommandError(
                f"camera {camera.name!r} is on body {camera.body!r}: calibrate it with `iris-session anchors "
                "calibrate-camera --camera-on-hand`"
            )
        if arguments.check and camera.pose is None:
            raise CommandError(f"camera {camera.name!r} has no calibration: its frames have poses of their own")
    known = _find_known_sheets(arguments)
    taken = [_take_frames(camera, arguments.frames) for camera in settings.cameras]
    try:
        result, placed = calibrate(settings, taken, known, icp=arguments.icp)
    except CalibrationError as error:
        raise CommandError(str(error), status=1) from error
    if arguments.check:
        return _print_check(arguments, settings, placed)
    if arguments.out is not None:
        write_file(arguments.out, calibration_to_toml(result))
    lines = [*format_calibration(result), *_format_icp(result)]
    if result["sheets_without_error"]:
        lines.append(
            f"not in the stated errors: that of the pose of {', '.join(result['sheets_without_error'])}, of which the "
            "session states none (`error_m` in its anchors file)"
        )
    if arguments.out is not None:
        is_beside = arguments.out.absolute().parent == arguments.file.absolute().parent
        name = json.dumps(arguments.out.name if is_beside else str(arguments.out.absolute()), ensure_ascii=False)
        lines.append(f"{arguments.out}: name it in each camera of {arguments.file}: calibration = {name}")
    return print_result(arguments, result, lines)


def _print_check(arguments: argparse.Namespace, settings: CloudSettings, placed: Mapping[str, PlacedCamera]) -> int:
    """Print whether the poses of the camera file fit those that were measured. Return 1 if one does not."""
    from anchors.depth_calibration import check_pose

    cameras: dict[str, dict[str, Any]] = {}
    for camera in settings.cameras:
        assert camera.pose is not None  # the camera file was checked
        error_mm = 20.0 if camera.error_mm is None else camera.error_mm  # 95 %
        one = check_pose(camera.pose.to_matrix(), 1e-3 * error_mm, placed[camera.name])
        cameras[camera.name] = {
            "fits": one.fits,
            "shift_mm": 1e3 * one.shift_m,
            "turn_deg": math.degrees(one.turn_rad),
            "off_mm": 1e3 * one.off_m,
            "limit_mm": 1e3 * one.limit_m,
        }
    is_well = all(found["fits"] for found in cameras.values())
    lines = (
        f"{name} {'fits' if found['fits'] else 'was moved: put it back, or calibrate it again'}. Off by "
        f"{found['shift_mm']:.1f} mm, {found['turn_deg']:.2f} deg, its points by {found['off_mm']:.1f} mm; stated "
        f"errors explain {found['limit_mm']:.1f} mm"
        for name, found in cameras.items()
    )
    return print_result(arguments, {"ok": is_well, "cameras": cameras}, lines, ok=is_well)


def _find_known_sheets(arguments: argparse.Namespace) -> KnownSheets:
    """Return the sheets of the options; without `--at` also the anchors of the session, where it joins as observer."""
    sheets = make_sheets(arguments.sheet)
    if arguments.at:
        _check_known_sheets(arguments.at, sheets)
        return KnownSheets(sheets, dict(arguments.at), {})
    with make_client(arguments, "observer", "cloud calibrate") as client:
        client.wait_for(lambda one: one.mirror.synced, 5.0)
        anchors = [one for one in client.mirror.anchors.values() if one.size_m > 0.0]
    if not anchors:
        raise CommandError(
            "the session has no sheet of known size: `iris-session serve --anchors FILE`, or give --sheet and --at"
        )
    named = {one.id for one in anchors}
    return KnownSheets(
        [*make_sheets((one.id, one.size_m) for one in anchors), *(s for s in sheets if s.anchor_id not in named)],
        {one.id: (one.T_world_anchor.p, one.T_world_anchor.q) for one in anchors},
        {one.id: one.error_m for one in anchors},
    )


def _take_frames(camera: CameraSettings, n: int) -> CameraFrames:
    """Take the next frames of a camera; of a recording that ends, as many as it has."""
    from iris_session.cloud.frames import SourceEndedError
    from iris_session.cloud.sources import name_camera, open_source

    frames: list[DepthFrame] = []
    until = time.monotonic() + FRAMES_S
    with closing(open_source(camera, time.monotonic_ns)) as source:
        try:
            while len(frames) < n and time.monotonic() < until:
                frame = source.read(0.5)
                if frame is not None:
                    frames.append(frame)
        except SourceEndedError:
            pass
        except Exception as error:  # also of a vendor's package
            raise name_camera(camera, error) from error
        if camera.source != "mujoco" and any(one.T_world_camera is not None for one in frames):
            raise CommandError(f"camera {camera.name!r}: its frames have poses of their own, which count")
        if not frames:
            raise CommandError(f"camera {camera.name!r} gave no frame within {FRAMES_S:g} s", status=1)
        return CameraFrames(camera, source.camera, source.depth_scale_m, frames)


def calibrate(
    settings: CloudSettings, taken: list[CameraFrames], known: KnownSheets, *, icp: bool = False
) -> tuple[dict[str, Any], dict[str, PlacedCamera]]:
    """Solve the poses of cameras by the sheets in their frames. Raises `CalibrationError`.

    Return the object that `--json` prints, and the cameras by name, before ICP.
    """
    from anchors.camera import pose_to_matrix
    from anchors.depth_calibration import PlacedCamera, compute_points_error

    pictures = [picture for one in taken for picture in _detect_sheets(one, known.sheets)]
    result, covariances = solve_from_known_sheets(pictures, known.poses, at_rest=True)
    cameras = result.get("cameras") or {taken[0].settings.name: result}
    seen = {name: error_m for name, error_m in known.errors_m.items() if name in result["sheets"]}
    result["sheets_without_error"] = sorted(name for name, error_m in seen.items() if error_m == 0.0)
    sheet_m = max(seen.values(), default=0.0)
    placed = {}
    for one in taken:
        name = one.settings.name
        pose, covariance = cameras[name]["T_base_camera"], covariances[name]
        T = pose_to_matrix((tuple(pose["position_m"]), tuple(pose["quaternion_wxyz"])))
        points = _make_points(settings, one, T)
        error_m = math.hypot(compute_points_error(covariance, T, points), sheet_m)
        cameras[name]["error_mm_p95"] = 1e3 * error_m
        placed[name] = PlacedCamera(T, covariance, points, error_m)
    if icp:
        result["icp"] = _fit_cameras(cameras, placed, sheet_m)
    return result, placed


def _detect_sheets(one: CameraFrames, sheets: list[Sheet]) -> Iterator[CalibrationPicture]:
    from anchors.detection import DetectionError, SheetDetector

    detector = SheetDetector(sheets, one.camera)
    for number, frame in enumerate(one.frames):
        try:
            seen = tuple(detector.detect(frame.color[:, :, ::-1]))  # OpenCV takes blue first
        except DetectionError as error:
            raise CommandError(f"camera {one.settings.name!r}: {error}") from error
        yield CalibrationPicture(Path(one.settings.name, f"frame {number + 1}"), one.settings.name, one.camera, seen)


def _make_points(settings: CloudSettings, one: CameraFrames, T_world_camera: Floats) -> Floats:
    """Return the points of a camera within the limits of the camera file, world frame."""
    import numpy as np

    from iris_session.cloud.pipeline import make_limits
    from iris_session.cloud.voxels import MIN_AROUND, MIN_POINTS, VoxelFilter, make_rays

    voxels = VoxelFilter(0.02)  # ICP compares their normals; those of smaller cells are noise
    limits = make_limits(settings, one.settings)
    rays = make_rays(one.camera)
    for frame in one.frames:
        try:
            voxels.add_depth(
                frame.depth, frame.color, rays, T_world_camera, depth_scale_m=one.depth_scale_m, limits=limits
            )
        except ValueError as error:
            raise CommandError(f"camera {one.settings.name!r}: {error}") from error
    found = voxels.collect(min_points=MIN_POINTS, min_around=MIN_AROUND)
    return np.asarray(found.positions, np.float64)


def _fit_cameras(cameras: dict[str, Any], placed: Mapping[str, PlacedCamera], sheet_m: float) -> dict[str, Any]:
    """Fit cameras to each other. Change their poses and errors in the result."""
    from anchors.camera import pose_from_matrix
    from anchors.depth_calibration import CameraFit, fit_cameras

    first, fits = fit_cameras(placed, sheet_m)
    found: dict[str, Any] = {}
    for name, fit in fits.items():
        if not isinstance(fit, CameraFit):
            found[name] = {"refined": False, "reason": fit.reason, "text": str(fit)}
            continue
        pose = pose_to_dict(pose_from_matrix(fit.camera.T_world_camera))
        cameras[name] |= {"T_base_camera": pose, "error_mm_p95": 1e3 * fit.camera.error_m}
        del cameras[name]["sigma_deg"]  # of the pose by the sheets
        one = fit.refinement
        found[name] = {
            "refined": True,
            "shift_mm": 1e3 * one.shift_m,
            "turn_deg": math.degrees(one.turn_rad),
            "rmse_before_mm": 1e3 * one.rmse_before_m,
            "rmse_after_mm": 1e3 * one.rmse_after_m,
            "overlap": one.overlap,
            "condition": one.condition,
        }
    return {"reference": first, "cameras": found}


def _format_icp(result: dict[str, Any]) -> Iterator[str]:
    if "icp" not in result:
        return
    for name, one in result["icp"]["cameras"].items():
        if one["refined"]:
            yield (
                f"{name}: fitted to {result['icp']['reference']} by {one['shift_mm']:.1f} mm, "
                f"{one['turn_deg']:.2f} deg; {one['rmse_before_mm']:.1f} mm apart before, "
                f"{one['rmse_after_mm']:.1f} mm after"
            )
        else:
            yield f"{name}: not fitted: {one['text']}"
