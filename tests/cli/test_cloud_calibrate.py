"""`iris-session cloud calibrate`: computed pictures of a table with a sheet, cameras of unknown pose."""

from __future__ import annotations

import json
import math
import sys
import tomllib
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from anchors.camera import CameraModel, pose_from_matrix
from anchors.pose import PoseTuple, compose, distance, inverse, quat_angle
from anchors.sheet import Sheet
from anchors.sheet_print import to_pdf
from iris_session import SceneBuilder, ScenePublisher, SessionConfig
from iris_session.cli.main import main
from iris_session.cloud.camera_file import load_camera_file
from iris_session.cloud.robot_points import sample_visual
from iris_session.cloud.voxels import DepthLimits, VoxelFilter, make_rays
from iris_session.demo.named_scenes import scene_by_name
from iris_session.physics import find_objects
from iris_session.protocol.names import GeometryKind
from iris_session.scene import AssetStore, EncodeOptions
from iris_session.scene.mujoco_scene import parse_mujoco
from tests.cloud.rays import cast_picture, look_at

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from render_sheet import Conditions, Page, photograph

CAMERA = CameraModel(640, 480, 585.0, 585.0, 319.5, 239.5)
POSES = {
    "front": look_at((0.9, -1.2, 0.8), (0.0, -0.2, 0.05)),
    "left": look_at((-0.8, -1.3, 0.7), (0.1, -0.2, 0.05)),
}
T_WORLD_SHEET: PoseTuple = ((0.0, -0.45, 0.0), (1.0, 0.0, 0.0, 0.0))
SHEET = ("--sheet", "table=160mm", "--at", "table=0,-0.45,0,1,0,0,0")
FLOOR_M = -0.75
HEAD = 'stream = "room"\nlow = [-1.5, -1.5, -0.9]\nhigh = [1.5, 1.5, 1.5]\n'
IDENTITY = "{position_m = [0.0, 0.0, 0.0], quaternion_wxyz = [1.0, 0.0, 0.0, 0.0]}"
INTRINSICS = "{width = 640, height = 480, fx = 585.0, fy = 585.0, cx = 319.5, cy = 239.5}"


class Room(NamedTuple):
    """Folders of pictures by camera below `folder`, and points of the surface of what is in them [m]."""

    folder: Path
    surface: NDArray[np.float64]

    def write(self, *names: str, more: str = "") -> Path:
        """Write a camera file and return its path."""
        cameras = (
            f'[[cameras]]\nname = "{name}"\nsource = "folder"\npath = "{name}"\nintrinsics = {INTRINSICS}\n{more}'
            for name in names
        )
        path = self.folder / f"{'-'.join(names)}{len(more)}.toml"
        path.write_text(HEAD + "\n".join(cameras))
        return path


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> Room:
    """Take three pictures with each camera: depth with a noise of 3 mm, and the sheet in the colours."""
    folder = tmp_path_factory.mktemp("room")
    model = scene_by_name("handover").model
    for body in range(model.nbody):
        if model.body(body).name == "sheet":  # that of the demo is no sheet that a detector knows
            start, n = model.body_geomadr[body], model.body_geomnum[body]
            model.geom_group[start : start + n] = 4
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    page = Page(to_pdf(Sheet("table", 0.160)))
    for name, T_world_camera in POSES.items():
        (folder / name).mkdir()
        T_camera_sheet = compose(inverse(pose_from_matrix(T_world_camera)), T_WORLD_SHEET)
        for number in range(3):
            depth = cast_picture(model, data, CAMERA, T_world_camera, 0.003, seed=number).depth
            color = photograph([(page, T_camera_sheet)], CAMERA, Conditions(rays=2), np.random.default_rng(number))
            cv2.imwrite(str(folder / name / f"{number}.depth.png"), depth)
            cv2.imwrite(str(folder / name / f"{number}.color.png"), cv2.cvtColor(color, cv2.COLOR_GRAY2BGR))
    return Room(folder, _sample_surface(model, data, folder / "assets"))


def _sample_surface(model: Any, data: Any, assets: Path) -> NDArray[np.float64]:
    """Return points of all shown surfaces but the floor."""
    spec = parse_mujoco(model, AssetStore(assets), options=EncodeOptions(levels=False)).spec
    surface = []
    for visual in spec.visuals:
        if visual.group <= 2 and visual.geometry.kind != GeometryKind.PLANE:
            turn = data.xmat[visual.body].reshape(3, 3)
            surface.append(sample_visual(visual, {}) @ turn.T + data.xpos[visual.body])
    assert len(find_objects(model)) == 2
    points = np.concatenate(surface)
    cells = np.floor(points / 0.002).astype(np.int64) + 2**20
    return points[np.unique((cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2], return_index=True)[1]]


def _run(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    status = main(["cloud", *map(str, arguments), "--json"])
    out, err = capsys.readouterr()
    assert status == 0, err
    result: dict[str, Any] = json.loads(out)
    return result


def _refused(capsys: pytest.CaptureFixture[str], status: int, *arguments: object) -> str:
    assert main(["cloud", *map(str, arguments)]) == status
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    return err


def _errors(found: dict[str, Any], name: str) -> tuple[float, float]:
    """[mm], [deg]"""
    true = pose_from_matrix(POSES[name])
    (x, y, z), (w, i, j, k) = found["position_m"], found["quaternion_wxyz"]
    return 1e3 * distance((x, y, z), true[0]), math.degrees(quat_angle((w, i, j, k), true[1]))


@pytest.mark.long
def test_points_lie_on_the_surface_after_calibration_by_a_sheet(
    room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = room.folder / "calibration.toml"
    result = _run(capsys, "calibrate", room.write("front", "left"), *SHEET, "--frames", 3, "--icp", "--out", out)
    assert result["used"] == 6
    for name in POSES:
        mm, deg = _errors(result["cameras"][name]["T_base_camera"], name)
        assert mm < 8.0
        assert deg < 0.4
        assert 0.5 < result["cameras"][name]["error_mm_p95"] < 30.0
    (refined,) = result["icp"]["cameras"].values()
    assert refined.get("rmse_after_mm", 0.0) < 15.0
    assert result["sheets_without_error"] == []
    saved = tomllib.loads(out.read_text())
    assert saved["cameras"]["front"]["error_mm_p95"] == result["cameras"]["front"]["error_mm_p95"]

    settings = load_camera_file(room.write("front", "left", more='calibration = "calibration.toml"\n'))
    voxels = VoxelFilter(settings.voxel_m)
    for camera in settings.cameras:
        assert camera.pose is not None
        color = cv2.cvtColor(cv2.imread(f"{camera.path}/0.color.png"), cv2.COLOR_BGR2RGB)
        depth = cv2.imread(f"{camera.path}/0.depth.png", cv2.IMREAD_UNCHANGED)
        limits = DepthLimits(settings.low, settings.high)
        voxels.add_depth(depth, color, make_rays(CAMERA), camera.pose.to_matrix(), limits=limits)
    points, colors, _ = voxels.collect(min_points=2, min_around=4)
    assert len(points) > 10_000
    some = points[::5]
    from_surface, _ = cKDTree(room.surface, balanced_tree=False).query(some, distance_upper_bound=0.05)
    off = np.minimum(np.minimum(from_surface, 0.05), np.abs(some[:, 2] - FLOOR_M))
    assert np.quantile(off, 0.95) < 0.010
    assert off.mean() < 0.005
    on_sheet = (np.abs(points - T_WORLD_SHEET[0]) < (0.09, 0.13, 0.02)).all(axis=1)
    assert np.ptp(colors[on_sheet].astype(int)) > 60


def test_a_check_tells_which_camera_is_not_where_it_was_calibrated(
    room: Room, capsys: pytest.CaptureFixture[str]
) -> None:
    def check(shift_m: float) -> tuple[int, dict[str, Any]]:
        p, q = pose_from_matrix(POSES["front"])
        pose = f"pose = {{position_m = [{p[0] + shift_m}, {p[1]}, {p[2]}], quaternion_wxyz = {list(q)}}}\n"
        file = room.write("front", more=f"error_mm = 10.0\n{pose}")
        command = ["cloud", "calibrate", str(file), *SHEET, "--frames", "1", "--check"]
        status = main([*command, "--json"])
        result: dict[str, Any] = json.loads(capsys.readouterr().out)
        assert main(command) == status
        assert capsys.readouterr().out.startswith("front ")
        return status, result

    status, well = check(0.0)
    assert (status, well["ok"], well["cameras"]["front"]["fits"]) == (0, True, True)
    status, moved = check(0.06)
    assert (status, moved["ok"], moved["cameras"]["front"]["fits"]) == (1, False, False)
    assert moved["cameras"]["front"]["shift_mm"] == pytest.approx(60.0, abs=8.0)
    file = room.write("front", more=f"pose = {IDENTITY}\n")
    assert "--out" in _refused(capsys, 2, "calibrate", file, *SHEET, "--check", "--out", room.folder / "no.toml")
    assert "calibration" in _refused(capsys, 2, "calibrate", room.write("front"), *SHEET, "--check")


def test_one_camera_is_calibrated_and_the_next_step_is_named(
    room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "calibration.toml"
    assert main(["cloud", "calibrate", str(room.write("left")), *SHEET, "--frames", "1", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert "left/frame 1  table" in text
    assert "stated error" in text
    assert f'calibration = "{out}"' in text  # in another folder than the camera file
    saved = tomllib.loads(out.read_text())
    assert _errors(saved["T_base_camera"], "left")[0] < 10.0
    assert saved["error_mm_p95"] > 0.5


def test_frames_of_a_camera_at_rest_count_as_one(room: Room, capsys: pytest.CaptureFixture[str]) -> None:
    """Ten pictures from one place have the errors of that place ten times."""
    one, three = (_run(capsys, "calibrate", room.write("left"), *SHEET, "--frames", n) for n in (1, 3))
    assert three["used"] == 3
    assert three["error_mm_p95"] == pytest.approx(one["error_mm_p95"], rel=0.3)


def test_sheets_come_from_the_session(room: Room, capsys: pytest.CaptureFixture[str]) -> None:
    scene = SceneBuilder("bench")
    scene.add_plane("floor", half_size=(2.0, 2.0))
    config = SessionConfig(
        name="bench",
        control_port=0,
        state_port=0,
        anchors={"table": T_WORLD_SHEET, "door": ((0.0, 3.0, 0.0), (1.0, 0.0, 0.0, 0.0))},
        anchor_sizes={"table": 0.160, "door": 0.160},
        anchor_errors={"door": 0.5},
    )
    with ScenePublisher(scene, config) as session:
        result = _run(capsys, "calibrate", room.write("front"), "--address", session.address, "--frames", 1)
    assert _errors(result["T_base_camera"], "front")[0] < 10.0
    assert result["error_mm_p95"] < 30.0, "that of a sheet that is not seen does not count"
    assert result["sheets_without_error"] == ["table"]


def test_unusable_input_is_a_one_line_error(room: Room, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = room.write("front")
    assert "--sheet door=160mm" in _refused(capsys, 2, "calibrate", file, "--at", "door=0,0,0,1,0,0,0")
    assert "one camera" in _refused(capsys, 2, "calibrate", file, *SHEET, "--icp")
    assert "cannot be read" in _refused(capsys, 2, "calibrate", tmp_path / "no.toml", *SHEET)
    door = ("--sheet", "door=160mm", "--at", "door=0,0,0,1,0,0,0")
    assert "no sheet was found in 1 picture:" in _refused(capsys, 1, "calibrate", file, *door, "--frames", 1)
    on_hand = room.write("front", more='body = "hand"\n')
    assert "--camera-on-hand" in _refused(capsys, 2, "calibrate", on_hand, *SHEET)
