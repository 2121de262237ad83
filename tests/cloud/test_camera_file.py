"""The camera file: its settings, the files that it names, and one line for each mistake."""

from __future__ import annotations

import re
from pathlib import Path
from typing import get_args

import msgspec
import numpy as np
import pytest

from anchors.camera_calibration import calibration_to_toml
from iris_session.cloud.camera_file import (
    CameraFileError,
    CameraPose,
    CameraSettings,
    CloudSettings,
    SourceName,
    load_camera_file,
)

POSE = "{ position_m = [0.0, 0.5, 1.0], quaternion_wxyz = [0.0, 1.0, 0.0, 0.0] }"
INTRINSICS = "{ width = 640, height = 480, fx = 585.0, fy = 585.0, cx = 320.0, cy = 240.0 }"
CAMERA = (
    f'[[cameras]]\nname = "front"\nsource = "folder"\npath = "pictures"\nintrinsics = {INTRINSICS}\npose = {POSE}\n'
)


def write(folder: Path, text: str) -> Path:
    (folder / "pictures").mkdir(exist_ok=True)
    path = folder / "camera.toml"
    path.write_text(text, encoding="utf-8")
    return path


def refuse(folder: Path, text: str) -> CameraFileError:
    """Return the error of a file; its message is one line with the path of the file."""
    path = write(folder, text)
    with pytest.raises(CameraFileError) as caught:
        load_camera_file(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    return caught.value


def test_defaults_paths_and_serialisation(tmp_path: Path) -> None:
    settings = load_camera_file(write(tmp_path, f'stream = "room"\n{CAMERA}'))
    camera = settings.cameras[0]
    assert (settings.title, settings.audience, settings.points) == ("room", "remote", 50_000)
    assert settings.list_streams() == ["room", "room-front"]
    assert camera.path == str(tmp_path / "pictures")
    assert camera.intrinsics is not None
    assert (camera.intrinsics.fx, camera.error_mm, camera.depth_scale_m) == (585.0, None, None)
    assert camera.pose is not None
    expected = [[1, 0, 0, 0], [0, -1, 0, 0.5], [0, 0, -1, 1], [0, 0, 0, 1]]
    assert np.allclose(camera.pose.to_matrix(), expected)
    for coder in (msgspec.json, msgspec.msgpack):
        assert coder.decode(coder.encode(settings), type=CloudSettings) == settings


def test_intrinsics_and_calibration_are_read_from_their_files(tmp_path: Path) -> None:
    (tmp_path / "intrinsics.toml").write_text(
        "width = 320\nheight = 240\nfx = 300.0\nfy = 301.0\ncx = 160.0\ncy = 120.0\ndistortion = [0.1, 0.0, 0.0, 0.0]\n"
    )
    pose = {"position_m": [1.0, 2.0, 3.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
    fit = {"residual_mm_rms": 1.0, "residual_deg_rms": 0.1, "residual_px_rms": 0.2}
    calibrated = {"mode": "sheets-of-known-place", "T_base_camera": pose, "error_mm_p95": 4.5, "sigma_deg": 0.1, **fit}
    (tmp_path / "calibration.toml").write_text(calibration_to_toml(calibrated))
    text = (
        'stream = "room"\n[[cameras]]\nname = "front"\nsource = "realsense"\nintrinsics = "intrinsics.toml"\n'
        'calibration = "calibration.toml"\n'
    )
    camera = load_camera_file(write(tmp_path, text)).cameras[0]
    assert camera.intrinsics is not None
    assert (camera.intrinsics.width, camera.intrinsics.distortion) == (320, (0.1, 0.0, 0.0, 0.0))
    assert camera.pose == CameraPose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0))
    assert camera.error_mm == 4.5
    assert load_camera_file(write(tmp_path, text + "error_mm = 12.0\n")).cameras[0].error_mm == 12.0

    part = {"T_base_camera": pose, "error_mm_p95": 7.0, "sigma_deg": 0.1}
    several = {"mode": "sheets-of-known-place", "cameras": {"front": part, "back": part}, "sheets": {}, **fit}
    (tmp_path / "calibration.toml").write_text(calibration_to_toml(several))
    camera = load_camera_file(write(tmp_path, text)).cameras[0]
    assert (camera.pose, camera.error_mm) == (CameraPose((1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0)), 7.0)
    error = refuse(tmp_path, text.replace('"front"', '"left"'))
    assert (error.key, error.line) == ("calibration", 6)

    on_hand = {"mode": "camera-on-hand", "T_ee_camera": pose, **fit}
    (tmp_path / "calibration.toml").write_text(calibration_to_toml(on_hand))
    assert refuse(tmp_path, text).key == "calibration"
    assert load_camera_file(write(tmp_path, text + 'body = "hand"\n')).cameras[0].body == "hand"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("2.0, 3.0]", "nan, 3.0]", "position_m [1.0, nan, 3.0]"),
        ("[1.0, 0.0,", "[nan, 0.0,", "quaternion_wxyz [nan, 0.0, 0.0, 0.0]"),
        ("2.0, 3.0]", "3.0]", "position_m is [1.0, 3.0]"),
        ("position_m", "position_mm", "'position_mm'"),
        ("= 12", "= nan", "error_mm_p95 is nan"),
        ("= 12", "= '12'", "error_mm_p95 is '12'"),
    ],
)
def test_a_wrong_value_of_a_calibration_is_named_with_its_file(tmp_path: Path, old: str, new: str, said: str) -> None:
    file = tmp_path / "calibration.toml"
    text = "error_mm_p95 = 12\n[T_base_camera]\nposition_m = [1.0, 2.0, 3.0]\nquaternion_wxyz = [1.0, 0.0, 0.0, 0.0]\n"
    camera = f'stream = "room"\n{CAMERA}'.replace(f"pose = {POSE}", 'calibration = "calibration.toml"')
    file.write_text(text)
    assert load_camera_file(write(tmp_path, camera)).cameras[0].error_mm == 12.0
    assert old in text
    file.write_text(text.replace(old, new))
    error = refuse(tmp_path, camera)
    assert (error.key, error.line) == ("calibration", 7)
    assert str(file) in str(error)
    assert said in str(error)


def test_pictures_with_poses_and_rendered_cameras_need_no_calibration(tmp_path: Path) -> None:
    text = f'stream = "room"\n{CAMERA}'.replace(f"pose = {POSE}\n", "")
    assert refuse(tmp_path, text).key == "calibration"
    (tmp_path / "pictures" / "0.pose.txt").touch()
    assert load_camera_file(write(tmp_path, text)).cameras[0].pose is None
    rendered = 'stream = "room"\n[[cameras]]\nname = "a"\nsource = "mujoco"\nmodel = "a.xml"\ncamera = "top"\n'
    assert load_camera_file(write(tmp_path, rendered)).cameras[0].model == str(tmp_path / "a.xml")


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ("points = 999", "points"),
        ("points = 'many'", "points"),
        ("voxl_m = 0.01", "voxl_m"),
        ("voxel_m = nan", "voxel_m"),
        ("hz = inf", "hz"),
        ("low = [1.0, 2.0]", "low"),
        ("high = [0.0, 0.0, -5.0]", "low"),
        ("audience = 'everyone'", "audience"),
        ("title = 3", "title"),
    ],
)
def test_a_wrong_value_is_named_with_its_line(tmp_path: Path, line: str, key: str) -> None:
    error = refuse(tmp_path, f'stream = "room"\n# low = [0.0]\n{line}\n{CAMERA}')
    assert error.key == key
    assert error.line == (3 if key in line else 0)


@pytest.mark.parametrize(
    ("line", "key", "at"),
    [
        ("neerest_m = 0.3", "neerest_m", 16),
        ("nearest_m = 9.0", "nearest_m", 16),
        ("depth_scale_m = 1.0", "depth_scale_m", 16),
        ("height = 4097", "height", 16),
        ("intrinsics = { width = 640, height = 4097, fx = 9.0, fy = 1.0, cx = 1.0, cy = 1.0 }", "intrinsics", 16),
        ("intrinsics = { width = 640, height = 480, fx = 60.0, fy = 585.0, cx = 320.0, cy = 9.0 }", "intrinsics", 16),
        ("intrinsics = { width = 640, height = 480, fx = 585.0, fy = 585.0, cx = 960.0, cy = 9.0 }", "intrinsics", 16),
        ("calibration = 'calibration.toml'", "pose", 15),
        ("intrinsics = 'nowhere.toml'", "intrinsics", 16),
        ("intrinsics = { width = 640 }", "height", 9),
        ("intrinsics = { width = 640, height = 480, fx = 0.0, fy = 1.0, cx = 1.0, cy = 1.0 }", "intrinsics", 16),
    ],
)
def test_a_wrong_value_of_a_camera_is_named_with_its_line(tmp_path: Path, line: str, key: str, at: int) -> None:
    second = f'[[cameras]]\nname = "back"\nsource = "realsense"\nhz = 30.0\nbody = ""\nloop = true\npose = {POSE}\n'
    error = refuse(tmp_path, f'stream = "room"\n\n{CAMERA}{second}{line}\n')
    assert (error.key, error.line) == (key, at)


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("", "cameras"),
        ('stream = "room"\n[[cameras]]\nname = "a"\n', "source"),
        ('stream = "room"\n[[cameras]]\nname = "a"\nsource = "kinect"\n', "source"),
        (CAMERA, "stream"),
        (f'stream = "a room"\n{CAMERA}', "stream"),
        (f'stream = "room"\n{CAMERA}'.replace('"front"', '"the front"'), "name"),
        (f'stream = "room"\n{CAMERA}{CAMERA}', "name"),
        (f'stream = "room"\n{CAMERA}'.replace('"pictures"', '"nothing"'), "path"),
        (f'stream = "room"\n{CAMERA}'.replace('path = "pictures"\n', ""), "path"),
        (f'stream = "room"\n{CAMERA}'.replace(f"intrinsics = {INTRINSICS}\n", ""), "intrinsics"),
        (f'stream = "room"\n{CAMERA}'.replace("[0.0, 1.0,", "[0.5, 1.0,"), "pose"),
        ('stream = "room"\n[[cameras]]\nname = "a"\nsource = "mujoco"\nmodel = "a.xml"\n', "camera"),
        ('stream = "room"\n[[cameras]]\nname = "a"\nsource = "orbbec"\n', "calibration"),
        ("stream = ", ""),
        ("stream = 'room'\ncameras = [3]", "cameras"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, text: str, key: str) -> None:
    assert refuse(tmp_path, text).key == key


def test_at_most_16_streams(tmp_path: Path) -> None:
    many = "".join(CAMERA.replace('"front"', f'"c{k}"') for k in range(16))
    assert refuse(tmp_path, f'stream = "room"\n{many}').key == "cameras"
    assert len(load_camera_file(write(tmp_path, f'stream = "room"\npicture_hz = 0.0\n{many}')).cameras) == 16


def test_the_line_of_a_bad_value_is_that_of_toml(tmp_path: Path) -> None:
    assert refuse(tmp_path, 'stream = "room"\n\npoints = = 3\n').line == 3
    with pytest.raises(CameraFileError):
        load_camera_file(tmp_path / "none.toml")


def test_the_page_has_every_key_and_its_files_load(tmp_path: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "clouds.md").read_text(encoding="utf-8")
    missing = {
        key
        for kind in (CloudSettings, CameraSettings)
        for key in kind.__struct_fields__
        if key != "cameras" and not re.search(rf"^\| [^|]*`{key}`", page, re.MULTILINE)
    }
    assert not missing
    pose = "[T_base_camera]\nposition_m = [0.0, 0.0, 1.0]\nquaternion_wxyz = [1.0, 0.0, 0.0, 0.0]\n"
    (tmp_path / "calibration.toml").write_text(pose)
    (tmp_path / "hand.toml").write_text(pose.replace("base", "ee"))
    (tmp_path / "intrinsics.toml").write_text("width = 640\nheight = 480\nfx = 1.0\nfy = 1.0\ncx = 1.0\ncy = 1.0\n")
    for name in ("rgbd", "session.rrd", "robot.mcap"):
        (tmp_path / name).touch()
    files = re.findall(r"```toml\n(stream.*?)```", page, re.DOTALL)
    cameras = [one for text in files for one in load_camera_file(write(tmp_path, text)).cameras]
    assert {one.source for one in cameras} == set(get_args(SourceName))
