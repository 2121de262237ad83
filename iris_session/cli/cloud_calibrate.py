"""`iris-session cloud calibrate`: poses of the cameras of a camera file, by sheets that they see, refined by ICP."""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
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
    from anchors.pose import PoseTuple
    from anchors.sheet import Sheet
    from iris_session.cloud.camera_file import CameraSettings, CloudSettings
    from iris_session.cloud.frames import DepthFrame, DepthSource

    Floats = npt.NDArray[np.float64]

#: Time for a camera to give its frames [s].
FRAMES_S: Final = 20.0
#: Time for the session to name its anchors [s].
ANCHORS_S: Final = 5.0
#: Edge of the cells that ICP compares [m]: normals of smaller ones are noise.
_ICP_VOXEL_M: Final = 0.02
#: Points of a camera at which the stated error is computed.
_ERROR_POINTS: Final = 200


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
        "--at. With --icp the cameras are then fitted to each other by what they see. Nothing may move meanwhile.",
        epilog="examples:\n"
        "  iris-session cloud calibrate camera.toml --out calibration.toml             sheets of the session here\n"
        "  iris-session cloud calibrate camera.toml --address 192.168.1.20 --icp --out calibration.toml\n"
        "  iris-session cloud calibrate camera.toml --sheet table=160mm --at table=0,-0.45,0,1,0,0,0",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", type=Path, help="camera file; the poses in it are not used")
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
    parser.add_argument("--out", type=Path, metavar="FILE", help="write the result as TOML, for the camera file")
    add_json_option(parser)
    parser.set_defaults(run=run_calibrate)


def parse_frame_count(text: str) -> int:
    """Parse the number of frames."""
    if not text.isascii() or not text.isdigit() or not 1 <= int(text) <= 200:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number of frames: give 1 to 200, for example 10")
    return int(text)


def run_calibrate(arguments: argparse.Namespace) -> int:
    """Calibrate, print the result, and write it to `--out`. Exit status 1 if the frames do not determine it."""
    from anchors.robot_world import CalibrationError
    from iris_session.cloud.camera_file import load_camera_file

    settings = load_camera_file(arguments.file, calibrated=False)
    if arguments.icp and len(settings.cameras) < 2:
        raise CommandError(f"--icp fits cameras to each other: {arguments.file} has one camera")
    for camera in settings.cameras:
        if camera.body:
            raise CommandError(
                f"camera {camera.name!r} is on body {camera.body!r}: calibrate it with `iris-session anchors "
                "calibrate-camera --camera-on-hand`"
            )
    known = _find_known_sheets(arguments)
    taken = [_take_frames(camera, arguments.frames) for camera in settings.cameras]
    try:
        result = calibrate(settings, taken, known, icp=arguments.icp)
    except CalibrationError as error:
        raise CommandError(str(error), status=1) from error
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


@contextmanager
def open_camera(camera: CameraSettings) -> Iterator[DepthSource]:
    """Open the source of a camera, and close it at the end."""
    from iris_session.cloud.sources import open_source

    source = open_source(camera, time.monotonic_ns)
    try:
        yield source
    finally:
        with suppress(Exception):  # of a device that is gone
            source.close()


def _take_frames(camera: CameraSettings, n: int) -> CameraFrames:
    """Take the next frames of a camera; of a recording that ends, as many as it has."""
    from iris_session.cloud.frames import SourceEndedError
    from iris_session.cloud.sources import read_frame

    frames: list[DepthFrame] = []
    until = time.monotonic() + FRAMES_S
    with open_camera(camera) as source:
        try:
            while len(frames) < n and time.monotonic() < until:
                frame = read_frame(camera, source, 0.5)
                if frame is None:
                    continue
                if frame.T_world_camera is not None and camera.source != "mujoco":
                    raise CommandError(f"camera {camera.name!r}: its frames have poses of their own, which count")
                frames.append(frame)
        except SourceEndedError:
            pass
        if not frames:
            raise CommandError(f"camera {camera.name!r} gave no frame within {FRAMES_S:g} s", status=1)
        return CameraFrames(camera, source.camera, source.depth_scale_m, frames)


# --- solving ----------------------------------------------------------------------------------------------------------


def calibrate(
    settings: CloudSettings, taken: list[CameraFrames], known: KnownSheets, *, icp: bool = False
) -> dict[str, Any]:
    """Solve the poses of cameras by the sheets in their frames. Return the object that `--json` prints.

    Raises:
        CommandError: The frames are not of the size of the intrinsics.
        CalibrationError: The frames do not determine the poses.
    """
    from anchors.camera import pose_to_matrix

    pictures = [picture for one in taken for picture in _detect_sheets(one, known.sheets)]
    result, covariances = solve_from_known_sheets(pictures, known.poses, at_rest=True)
    cameras = result.get("cameras") or {taken[0].settings.name: result}
    seen = {name: error_m for name, error_m in known.errors_m.items() if name in result["sheets"]}
    result["sheets_without_error"] = sorted(name for name, error_m in seen.items() if error_m == 0.0)
    sheet_m = max(seen.values(), default=0.0)
    clouds = {}
    for one in taken:
        part = cameras[one.settings.name]
        T = pose_to_matrix(_read_pose(part["T_base_camera"]))
        clouds[one.settings.name] = _make_cloud(settings, one, T)
        error_m = _state_error(covariances[one.settings.name], T, clouds[one.settings.name])
        part["error_mm_p95"] = 1e3 * math.hypot(error_m, sheet_m)
    if icp:
        result["icp"] = _refine(cameras, clouds, covariances, sheet_m)
    return result


def _detect_sheets(one: CameraFrames, sheets: list[Sheet]) -> Iterator[CalibrationPicture]:
    from anchors.detection import DetectionError, SheetDetector

    detector = SheetDetector(sheets, one.camera)
    for number, frame in enumerate(one.frames):
        try:
            seen = tuple(detector.detect(frame.color[:, :, ::-1]))  # OpenCV takes blue first
        except DetectionError as error:
            raise CommandError(f"camera {one.settings.name!r}: {error}") from error
        yield CalibrationPicture(Path(one.settings.name, f"frame {number + 1}"), one.settings.name, one.camera, seen)


def _make_cloud(settings: CloudSettings, one: CameraFrames, T_world_camera: Floats) -> Floats:
    """Return the points of a camera within the limits of the camera file, world frame."""
    import numpy as np

    from iris_session.cloud.voxels import DepthLimits, VoxelFilter, make_rays

    voxels = VoxelFilter(_ICP_VOXEL_M)
    limits = DepthLimits(settings.low, settings.high, one.settings.nearest_m, one.settings.farthest_m)
    rays = make_rays(one.camera)
    for frame in one.frames:
        try:
            voxels.add_depth(
                frame.depth, frame.color, rays, T_world_camera, depth_scale_m=one.depth_scale_m, limits=limits
            )
        except ValueError as error:
            raise CommandError(f"camera {one.settings.name!r}: {error}") from error
    found = voxels.collect(min_points=settings.min_points, min_around=settings.min_around)
    return np.asarray(found.positions, np.float64)


def _state_error(covariance: tuple[float, ...], T_world_camera: Floats, points: Floats) -> float:
    """Return the error that 95 % of the camera's points keep, 95 % of the time [m]: rotation counts with distance.

    Without points: of a point on the camera's axis, 1.5 m away.
    """
    import numpy as np

    from anchors.uncertainty import position_error_p95

    x, y, z = T_world_camera[:3, 3].tolist()
    chosen = points[:: max(1, len(points) // _ERROR_POINTS)] if len(points) else (T_world_camera @ (0, 0, 1.5, 1))[None]
    bounds = [position_error_p95(covariance, (x, y, z), (p[0], p[1], p[2])) for p in chosen[:, :3].tolist()]
    return float(np.quantile(bounds, 0.95))


def _refine(
    cameras: dict[str, Any], clouds: dict[str, Floats], covariances: Mapping[str, tuple[float, ...]], sheet_m: float
) -> dict[str, Any]:
    """Fit cameras one by one to those before them, in the order of their stated errors. Change their poses and errors.

    A camera that was fitted has the error of the first one at its own points, and twice what its surfaces are apart
    from those that it was fitted to, as these may be from the first one's.
    """
    import numpy as np

    from anchors.camera import pose_from_matrix, pose_to_matrix
    from iris_session.cloud.icp import RefinementRefusedError, refine_pose

    first, *others = sorted(cameras, key=lambda name: float(cameras[name]["error_mm_p95"]))
    reference = clouds[first]
    T_first = pose_to_matrix(_read_pose(cameras[first]["T_base_camera"]))
    errors_m = [sheet_m]
    found: dict[str, Any] = {}
    for name in others:
        try:
            one = refine_pose(clouds[name], reference)
        except RefinementRefusedError as error:
            found[name] = {"refined": False, "reason": error.reason, "text": str(error)}
            continue
        T = one.T_world_world
        pose = pose_from_matrix(T @ pose_to_matrix(_read_pose(cameras[name]["T_base_camera"])))
        points = clouds[name] @ T[:3, :3].T + T[:3, 3]
        reference = np.concatenate([reference, points])
        errors_m.append(2.0 * one.rmse_after_m)
        error_m = math.hypot(_state_error(covariances[first], T_first, points), *errors_m)
        cameras[name] |= {"T_base_camera": pose_to_dict(pose), "error_mm_p95": 1e3 * error_m}
        del cameras[name]["sigma_deg"]  # of the pose by the sheets
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


def print_progress(text: str, *, as_json: bool) -> None:
    """Write over the last line of a terminal on standard error; nowhere else."""
    if not as_json and sys.stderr.isatty():
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)
