"""Pictures in a folder: the real frames make one room; what is missing or damaged is named."""

from __future__ import annotations

import itertools
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from anchors.camera import CameraModel
from iris_session.cloud.camera_file import CameraPose, CameraSettings
from iris_session.cloud.frames import DepthFrame, SourceEndedError, SourceError
from iris_session.cloud.sources.folder import FolderSource
from iris_session.cloud.voxels import DepthLimits, VoxelFilter, make_rays
from tests.cloud.sources.test_rerun_recording import read_source

CAMERA = CameraModel(64, 48, 50.0, 50.0, 31.5, 23.5)


def make_settings(folder: Path, camera: CameraModel = CAMERA, *, loop: bool = False) -> CameraSettings:
    return CameraSettings(name="front", source="folder", path=str(folder), intrinsics=camera, hz=100.0, loop=loop)


def write_frame(folder: Path, name: str, depth: int, color: tuple[int, int, int] = (10, 20, 30)) -> None:
    """Write a frame of one depth and one colour (red, green, blue)."""
    cv2.imwrite(str(folder / f"{name}.depth.png"), np.full((48, 64), depth, np.uint16))
    cv2.imwrite(str(folder / f"{name}.color.png"), np.full((48, 64, 3), color[::-1], np.uint8))


def read_all(settings: CameraSettings) -> list[DepthFrame]:
    return read_source(settings)[1]


def test_frames_are_read_in_order_of_their_names(tmp_path: Path) -> None:
    for k in (1, 0, 2):
        write_frame(tmp_path, f"frame-{k:03d}", 1000 + k, (k, 50, 200))
    frames = read_all(make_settings(tmp_path))
    assert [int(frame.depth[0, 0]) for frame in frames] == [1000, 1001, 1002]
    assert [frame.color[5, 5].tolist() for frame in frames] == [[k, 50, 200] for k in range(3)]
    assert all(frame.T_world_camera is None for frame in frames)
    assert np.diff([frame.capture_ns for frame in frames]).tolist() == [10_000_000] * 2


def test_poses_are_in_the_frame_that_the_camera_file_places(tmp_path: Path) -> None:
    write_frame(tmp_path, "a", 1000)
    pose = np.eye(4)
    pose[:3, 3] = (1.0, 2.0, 3.0)
    np.savetxt(tmp_path / "a.pose.txt", pose)
    placed = CameraPose((0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0))  # half a turn about z
    settings = CameraSettings(name="a", source="folder", path=str(tmp_path), intrinsics=CAMERA, pose=placed, loop=False)
    [frame] = read_all(settings)
    assert frame.T_world_camera is not None
    assert np.allclose(frame.T_world_camera[:3, 3], (-1.0, -2.0, 4.0))


def spoil(folder: Path, how: str) -> None:
    if how == "no frames":
        for file in folder.iterdir():
            file.unlink()
    elif how == "other endings":
        for name in "ab" if (folder / "b.color.png").exists() else "a":
            (folder / f"{name}.color.png").rename(folder / f"{name}.colour.jpeg")
    elif how == "damaged depth":
        (folder / "b.depth.png").write_bytes((folder / "b.depth.png").read_bytes()[:50])
    elif how == "half a pose":
        for name in "ab":
            np.savetxt(folder / f"{name}.pose.txt", np.eye(4)[:2])


@pytest.mark.parametrize("lacking", ["b.color.png", "b.pose.txt", "b.depth.png"])
def test_a_frame_that_lacks_a_file_is_left_out_and_counted(tmp_path: Path, lacking: str) -> None:
    for name in "abc":
        write_frame(tmp_path, name, 1000)
        np.savetxt(tmp_path / f"{name}.pose.txt", np.eye(4))
    (tmp_path / lacking).unlink()
    source, frames = read_source(make_settings(tmp_path))
    assert len(frames) == 2
    assert isinstance(source, FolderSource)
    assert source.left_out == 1


def test_an_error_names_the_endings_that_the_folder_has(tmp_path: Path) -> None:
    write_frame(tmp_path, "a", 1000)
    spoil(tmp_path, "other endings")
    with pytest.raises(SourceError, match=r"\.colour\.jpeg \(1\)"):
        read_all(make_settings(tmp_path))


@pytest.mark.parametrize("how", ["no frames", "other endings", "damaged depth", "half a pose"])
def test_what_is_missing_or_damaged_is_named(tmp_path: Path, how: str) -> None:
    for name in "ab":
        write_frame(tmp_path, name, 1000)
    spoil(tmp_path, how)
    with pytest.raises(SourceError) as caught:
        read_all(make_settings(tmp_path))
    assert not isinstance(caught.value, SourceEndedError)
    assert str(tmp_path) in str(caught.value)


@pytest.mark.long
def test_the_real_frames_make_one_room(rgbd: Path) -> None:
    """Views of a moving camera: surfaces of each lie on those of the view before."""
    matrix = np.loadtxt(rgbd / "camera-intrinsics.txt")
    camera = CameraModel(640, 480, matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])
    frames = read_all(make_settings(rgbd, camera))
    assert len(frames) == 60
    rays, limits = make_rays(camera), DepthLimits(farthest_m=3.5)
    views: list[NDArray[np.float32]] = []
    for frame in frames[::4]:
        assert frame.T_world_camera is not None
        assert frame.color.std() > 10.0
        one = VoxelFilter(0.01)
        one.add_depth(frame.depth, frame.color, rays, frame.T_world_camera, limits=limits)
        views.append(one.collect(min_points=2, min_around=4).positions)
    distances = [cKDTree(first).query(second)[0] for first, second in itertools.pairwise(views)]
    assert min((one < 0.05).mean() for one in distances) > 0.6
    everything = np.concatenate(distances)
    assert (everything < 0.05).mean() > 0.8
    assert everything[everything < 0.05].mean() < 0.015
