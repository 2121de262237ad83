"""`iris-session cloud scan`: what the cameras of a camera file see over some seconds, as one PLY file."""

from __future__ import annotations

import argparse
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple

from iris_session.cli.cloud_calibrate import open_camera, print_progress
from iris_session.cli.common import CommandError, add_json_option, parse_length, parse_seconds, print_json, write_file

if TYPE_CHECKING:
    from iris_session.cloud.camera_file import CloudSettings
    from iris_session.cloud.frames import DepthFrame
    from iris_session.cloud.voxels import PointSet, VoxelFilter

#: Cells of a scan at most: at 1 cm some 100 m^2 of surface, 150 MB while it runs.
MAX_CELLS: Final = 2**20


class RoomScan(NamedTuple):
    """Result of a scan: points, frames by camera, and how many points found no cell."""

    points: PointSet
    frames: dict[str, int]
    overflow: int


def register_scan(actions: argparse._SubParsersAction[argparse.ArgumentParser]) -> None:
    """Add the action `scan`."""
    parser = actions.add_parser(
        "scan",
        help="collect what the cameras see for some seconds into a PLY file",
        description="Collect the points of all cameras of a camera file over some seconds, average them in cells, and "
        "write positions (metres, world frame) and colours as binary PLY, which MeshLab, CloudCompare, Blender and "
        "open3d read.",
        epilog="examples:\n"
        "  iris-session cloud scan camera.toml -o room.ply\n"
        "  iris-session cloud scan camera.toml --seconds 20 --voxel 5mm -o room.ply",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("file", type=Path, help="camera file, calibrated")
    parser.add_argument("--seconds", type=parse_seconds, default=5.0, help="time to collect (default: %(default)s)")
    parser.add_argument(
        "--voxel", type=parse_length, default=None, metavar="LENGTH", help="edge of the cells (default: of the file)"
    )
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="FILE", help="*.ply; it is replaced")
    add_json_option(parser)
    parser.set_defaults(run=run_scan)


def run_scan(arguments: argparse.Namespace) -> int:
    """Scan and write the file. Exit status 1 if nothing was seen."""
    from iris_session.cloud.camera_file import load_camera_file
    from iris_session.cloud.voxels import VoxelFilter

    if arguments.out.suffix.lower() != ".ply":
        raise CommandError(f"{arguments.out}: the file must end in .ply")
    settings = load_camera_file(arguments.file)
    for camera in settings.cameras:
        if camera.body:
            raise CommandError(f"camera {camera.name!r} is on body {camera.body!r}: only a session knows where that is")
    voxel_m = settings.voxel_m if arguments.voxel is None else arguments.voxel
    try:
        voxels = VoxelFilter(voxel_m, max_cells=MAX_CELLS, threads=1)
    except ValueError as error:
        raise CommandError(f"--voxel: {error}") from error
    scan = scan_cameras(settings, voxels, arguments.seconds, as_json=arguments.json)
    n = len(scan.points.positions)
    silent = [name for name, frames in scan.frames.items() if not frames]
    if n == 0:
        raise CommandError(
            f"no points: {_join(silent)} gave no frame"
            if silent
            else "no points: is the crop box (low, high) around what the cameras see?",
            status=1,
        )
    write_file(arguments.out, to_ply(scan.points))
    low, high = scan.points.positions.min(axis=0).tolist(), scan.points.positions.max(axis=0).tolist()
    if arguments.json:
        print_json(
            {
                "file": str(arguments.out),
                "points": n,
                "voxel_m": voxel_m,
                "frames": scan.frames,
                "overflow": scan.overflow,
                "low": low,
                "high": high,
            }
        )
        return 0
    frames = ", ".join(f"{name} {count}" for name, count in scan.frames.items())
    size = " x ".join(f"{b - a:.2f}" for a, b in zip(low, high, strict=True))
    print(f"{arguments.out}: {n:,} points of {1e3 * voxel_m:g} mm, {size} m; frames: {frames}")
    if silent:
        print(f"without frames: {_join(silent)}")
    if scan.overflow:
        print(f"{scan.overflow:,} points found no cell: make the crop box smaller, or the cells larger with --voxel")
    return 0


def _join(names: list[str]) -> str:
    return f"camera {', '.join(map(repr, names))}"


def scan_cameras(settings: CloudSettings, voxels: VoxelFilter, seconds: float, *, as_json: bool) -> RoomScan:
    """Collect the frames of all cameras for some seconds, or until all recordings have ended."""
    from iris_session.cloud.frames import SourceEndedError
    from iris_session.cloud.sources import read_frame
    from iris_session.cloud.voxels import DepthLimits, make_rays

    frames = dict.fromkeys((camera.name for camera in settings.cameras), 0)
    with ExitStack() as stack:
        opened = [(camera, stack.enter_context(open_camera(camera))) for camera in settings.cameras]
        rays = {camera.name: make_rays(source.camera) for camera, source in opened}
        print_progress("preparing the filter: the first time takes some seconds", as_json=as_json)
        voxels.warm_up()  # not part of the time to collect
        start = time.monotonic()
        while opened and (passed := time.monotonic() - start) < seconds:
            for camera, source in tuple(opened):
                try:
                    frame: DepthFrame | None = read_frame(camera, source, 0.05)
                except SourceEndedError:
                    opened.remove((camera, source))
                    continue
                if frame is None:
                    continue
                pose = frame.T_world_camera
                if pose is None:
                    assert camera.pose is not None  # the camera file was checked
                    pose = camera.pose.to_matrix()
                limits = DepthLimits(settings.low, settings.high, camera.nearest_m, camera.farthest_m)
                try:
                    voxels.add_depth(
                        frame.depth,
                        frame.color,
                        rays[camera.name],
                        pose,
                        depth_scale_m=source.depth_scale_m,
                        limits=limits,
                    )
                except ValueError as error:
                    raise CommandError(f"camera {camera.name!r}: {error}") from error
                frames[camera.name] += 1
            print_progress(f"{passed:.0f} of {seconds:g} s, {sum(frames.values())} frames", as_json=as_json)
    print_progress("", as_json=as_json)
    return RoomScan(
        voxels.collect(min_points=settings.min_points, min_around=settings.min_around), frames, voxels.overflow
    )


def to_ply(points: PointSet) -> bytes:
    """Return positions and colours as binary PLY, little-endian."""
    import numpy as np

    columns = [(axis, "<f4") for axis in "xyz"] + [(color, "u1") for color in ("red", "green", "blue")]
    rows = np.empty(len(points.positions), columns)
    for k, axis in enumerate("xyz"):
        rows[axis] = points.positions[:, k]
    for k, color in enumerate(("red", "green", "blue")):
        rows[color] = points.colors[:, k]
    properties = [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in columns]
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}", *properties, "end_header", ""]
    return "\n".join(header).encode() + rows.tobytes()
