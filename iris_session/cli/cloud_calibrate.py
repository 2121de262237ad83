"""`iris-session cloud calibrate`: poses of the cameras of a camera file, by sheets that they see, refined by ICP.

Or, with `--check`, whether they still fit. The mathematics is in `anchors`.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from iris_session.cli.anchors import (
    CalibrationPicture,
    calibration_to_toml,
    format_calibration,
    make_sheets,
    parse_named_length,
    parse_named_pose,
    solve_from_known_sheets,
)
from iris_session.cli.common import (
    CommandError,
    add_address_options,
    add_json_option,
    check_session_reachable,
    pose_to_dict,
    print_json,
    write_file,
)

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from anchors.camera import CameraModel
    from anchors.depth_calibration import PlacedCamera, PoseCheck
    from anchors.pose import PoseTuple
    from anchors.sheet import Sheet
    from iris_session.cloud.camera_file import CameraSettings, CloudSettings
    from iris_session.cloud.frames import DepthFrame

    Floats = npt.NDArray[np.float64]

#: Time for a camera to give its frames [s].
FRAMES_S: Final = 20.0
#: Time for the session to name its anchors [s].
ANCHORS_S: Final = 5.0
#: Edge of the cells that ICP compares [m]: normals of smaller ones are noise.
_ICP_VOXEL_M: Final = 0.02
#: Error of a calibration that states none, 95 % [mm].
_UNKNOWN_ERROR_MM: Final = 20.0


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


def register_calibrate(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `calibrate`."""
    parser = actions.add_parser(
        "calibrate",
        help="calibrate the cameras of a camera file by sheets that they see",
        description="Take frames from the cameras of a camera file, detect sheets of known pose in them, and write the "
        "poses of the cameras with their stated errors. The poses of the sheets are those of a session, or given with "
        "--at. With --icp the cameras are then fitted to each other by what they see. Nothing may move meanwhile. With "
        "--check nothing is written: the poses are compared with those of the camera file.",
        epilog="examples:\n"
        "  iris-session cloud calibrate camera.toml --out calibration.toml             sheets of the session here\n"
        "  iris-session cloud calibrate camera.toml --address 192.168.1.20 --icp --out calibration.toml\n"
        "  iris-session cloud calibrate camera.toml --sheet table=160mm --at table=0,-0.45,0,1,0,0,0\n"
        "  iris-session cloud calibrate camera.toml --check                            do they still fit?",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", type=Path, help="camera file; without --check the poses in it are not used")
    parser.add_argument(
        "--sheet",
        type=parse_named_length,
        action="append",
        default=[],
        metavar="ID=LENGTH",
        help="id of a sheet and the printed edge of its code: table=160mm; repeatable",
    )
    parser.add_argument(
        "--at",
        type=parse_named_pose,
        action="append",
        default=[],
        metavar="ID=X,Y,Z,QW,QX,QY,QZ",
        help="known pose of a sheet in the world; repeatable; without it the anchors of the session",
    )
    add_address_options(parser, option=True)
    parser.add_argument(
        "--frames", type=parse_frame_count, default=10, metavar="N", help="frames per camera (default: %(default)s)"
    )
    parser.add_argument("--icp", action="store_true", help="then fit several cameras to each other")
    parser.add_argument("--check", action="store_true", help="tell whether the poses of the camera file still fit")
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the result as TOML, for the camera file")
    add_json_option(parser)
    parser.set_defaults(run=run_calibrate)


def parse_frame_count(text: str) -> int:
    """Parse the number of frames."""
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= 200:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of frames: give 1 to 200, for example 10")
    return int(text)


def run_calibrate(arguments: argparse.Namespace) -> int:
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
        return _print_check(settings, placed, as_json=arguments.json)
    if arguments.out is not None:
        write_file(arguments.out, calibration_to_toml(result))
    if arguments.json:
        print_json(result)
        return 0
    print("\n".join([*format_calibration(result), *_format_icp(result)]))
    if result["sheets_without_error"]:
        print(
            f"not in the stated errors: that of the pose of {', '.join(result['sheets_without_error'])}, of which the "
            "session states none (`error_m` in its anchors file)"
        )
    if arguments.out is not None:
        is_beside = arguments.out.absolute().parent == arguments.file.absolute().parent
        name = json.dumps(arguments.out.name if is_beside else str(arguments.out.absolute()), ensure_ascii=False)
        print(f"{arguments.out}: name it in each camera of {arguments.file}: calibration = {name}")
    return 0


def _print_check(settings: CloudSettings, placed: Mapping[str, PlacedCamera], *, as_json: bool) -> int:
    """Print whether the poses of the camera file fit those that were measured. Return 1 if one does not."""
    from anchors.depth_calibration import check_pose

    checks: dict[str, PoseCheck] = {}
    for camera in settings.cameras:
        assert camera.pose is not None  # the camera file was checked
        error_mm = _UNKNOWN_ERROR_MM if camera.error_mm is None else camera.error_mm
        checks[camera.name] = check_pose(camera.pose.to_matrix(), 1e-3 * error_mm, placed[camera.name])
    is_well = all(one.fits for one in checks.values())
    cameras = {
        name: {
            "fits": one.fits,
            "shift_mm": 1e3 * one.shift_m,
            "turn_deg": math.degrees(one.turn_rad),
            "off_mm": 1e3 * one.off_m,
            "limit_mm": 1e3 * one.limit_m,
        }
        for name, one in checks.items()
    }
    if as_json:
        print_json({"ok": is_well, "cameras": cameras})
        return 0 if is_well else 1
    for name, one in cameras.items():
        advice = "fits" if one["fits"] else "was moved: put it back, or calibrate it again"
        print(
            f"{name} {advice}. Off by {one['shift_mm']:.1f} mm, {one['turn_deg']:.2f} deg, its points by "
            f"{one['off_mm']:.1f} mm; stated errors explain {one['limit_mm']:.1f} mm"
        )
    return 0 if is_well else 1


# --- input ------------------------------------------------------------------------------------------------------------


def _find_known_sheets(arguments: argparse.Namespace) -> KnownSheets:
    """Return the sheets of the options, or those of the session."""
    sheets = make_sheets(arguments.sheet)
    if not arguments.at:
        return _ask_session(arguments, sheets)
    unknown = sorted({name for name, _ in arguments.at} - {sheet.anchor_id for sheet in sheets})
    if unknown:
        raise CommandError(f"--at {unknown[0]}: no size is given, add --sheet {unknown[0]}=160mm")
    return KnownSheets(sheets, dict(arguments.at), {})


def _ask_session(arguments: argparse.Namespace, sheets: list[Sheet]) -> KnownSheets:
    """Join as an observer for the poses and sizes of the anchors. `sheets`: further ones, at unknown poses."""
    from iris_session.client import Client

    check_session_reachable(arguments)
    with Client(
        arguments.address, session=arguments.session, join_code=arguments.code, role="observer", name="cloud calibrate"
    ) as client:
        client.wait_for(lambda one: one.mirror.synced, ANCHORS_S)
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


# --- solving ----------------------------------------------------------------------------------------------------------


def calibrate(
    settings: CloudSettings, taken: list[CameraFrames], known: KnownSheets, *, icp: bool = False
) -> tuple[dict[str, Any], dict[str, PlacedCamera]]:
    """Solve the poses of cameras by the sheets in their frames.

    Returns:
        The object that `--json` prints, and the cameras by name, before ICP.

    Raises:
        CommandError: The frames are not of the size of the intrinsics.
        CalibrationError: The frames do not determine the poses.
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
        T, covariance = pose_to_matrix(_read_pose(cameras[name]["T_base_camera"])), covariances[name]
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

    voxels = VoxelFilter(_ICP_VOXEL_M)
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


def _read_pose(value: dict[str, list[float]]) -> PoseTuple:
    (x, y, z), (w, i, j, k) = value["position_m"], value["quaternion_wxyz"]
    return (x, y, z), (w, i, j, k)


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
