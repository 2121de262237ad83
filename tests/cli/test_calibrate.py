"""`anchors calibrate-camera` and `cloud calibrate`: photographs and depth pictures by cameras of known pose."""

from __future__ import annotations

import math
import shutil
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import mujoco
import numpy as np
import pytest

from anchors.camera import CameraModel, pose_from_matrix
from anchors.pose import PoseTuple, compose, distance, inverse, quat_angle, quat_from_rotvec
from anchors.sheet import Sheet
from anchors.sheet_print import to_pdf
from iris_session import SceneBuilder, ScenePublisher, SessionConfig
from iris_session.cloud.camera_file import load_camera_file
from iris_session.demo.named_scenes import scene_by_name
from tests.cloud.rays import cast_picture, look_at

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from render_sheet import Conditions, Page, photograph

from tests.cli.conftest import CommandLine


def measure_errors(found: dict[str, Any], true: PoseTuple) -> tuple[float, float]:
    """Return the distance [mm] and angle [deg] from the true pose."""
    (x, y, z), (w, i, j, k) = found["position_m"], found["quaternion_wxyz"]
    return 1e3 * distance((x, y, z), true[0]), math.degrees(quat_angle((w, i, j, k), true[1]))


# --- anchors calibrate-camera -----------------------------------------------------------------------------------------

LENS = CameraModel(640, 480, 585.0, 585.0, 319.5, 239.5, (0.08, -0.18, 0.0008, -0.0005, 0.0))
INTRINSICS = (
    "width = 640\nheight = 480\nfx = 585.0\nfy = 585.0\ncx = 319.5\ncy = 239.5\n"
    "distortion = [0.08, -0.18, 0.0008, -0.0005, 0.0]\n"
)


T_BASE_CAMERA: PoseTuple = ((1.2, -0.2, 0.8), quat_from_rotvec((-1.8, 0.5, 0.4)))
T_EE_SHEET: PoseTuple = ((0.01, 0.03, 0.12), quat_from_rotvec((0.2, 0.4, -1.0)))
CALIBRATE = ("anchors", "calibrate-camera")
SMALL_SHEET = ("--sheet", "table=120mm")
HEADER = "image,x,y,z,qw,qx,qy,qz"


def _facing(x: float, y: float, z: float, r: Sequence[float]) -> PoseTuple:
    facing = quat_from_rotvec((math.pi, 0.0, 0.0))
    turn: PoseTuple = ((0.0, 0.0, 0.0), quat_from_rotvec((r[0], r[1], r[2])))
    return ((x, y, z), compose(turn, ((0.0, 0.0, 0.0), facing))[1])


SEEN = [
    _facing(0.0, 0.0, 0.7, (0.5, 0.0, 0.0)),
    _facing(0.1, 0.02, 0.8, (-0.5, 0.1, 0.4)),
    _facing(-0.1, 0.05, 0.75, (0.1, 0.6, -0.3)),
    _facing(0.05, -0.05, 0.9, (0.0, -0.5, 0.8)),
    _facing(-0.05, 0.0, 0.65, (0.4, 0.4, 0.2)),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Five pictures of a sheet, taken by a known camera, with its intrinsics."""
    folder = tmp_path_factory.mktemp("pictures")
    page, rng = Page(to_pdf(Sheet("table", 0.120))), np.random.default_rng(1)
    for number, T in enumerate(SEEN):
        picture = photograph([(page, T)], LENS, Conditions(rays=2), rng)
        cv2.imwrite(str(folder / f"{number:04}.png"), picture)
    (folder / "intrinsics.toml").write_text(INTRINSICS)
    return folder


def _csv(path: Path, poses: Sequence[PoseTuple]) -> Path:
    lines = [",".join([f"{number:04}.png", *(repr(v) for v in (*p, *q))]) for number, (p, q) in enumerate(poses)]
    path.write_text("\n".join([HEADER, *lines, ""]))
    return path


def _text(pose: PoseTuple) -> str:
    return ",".join(repr(v) for v in (*pose[0], *pose[1]))


@pytest.mark.parametrize("on_hand", ["sheet", "camera"])
def test_what_is_on_the_hand_is_calibrated(on_hand: str, folder: Path, tmp_path: Path, cli: CommandLine) -> None:
    if on_hand == "sheet":
        hand = [compose(compose(T_BASE_CAMERA, T), inverse(T_EE_SHEET)) for T in SEEN]
        options, names = [], ("T_base_camera", "T_ee_sheet")
    else:  # the same two poses, now of the sheet in the room and of the camera on the hand
        hand = [compose(T_BASE_CAMERA, inverse(compose(T_EE_SHEET, T))) for T in SEEN]
        options, names = ["--camera-on-hand"], ("T_base_sheet", "T_ee_camera")
    poses, out = _csv(tmp_path / "poses.csv", hand), tmp_path / "camera.toml"
    result = cli.json(*CALIBRATE, folder, *SMALL_SHEET, "--poses", poses, *options, "--out", out)
    assert (result["mode"], result["used"], result["left_out"]) == (f"{on_hand}-on-hand", 5, 0)
    for name, true in zip(names, (T_BASE_CAMERA, T_EE_SHEET), strict=True):
        mm, deg = measure_errors(result[name], true)
        assert mm < 2.0
        assert deg < 0.2
        assert tomllib.loads(out.read_text())[name]["position_m"] == result[name]["position_m"]
    assert result["residual_px_rms"] < 0.5


def test_one_picture_is_enough_with_a_known_hand(folder: Path, tmp_path: Path, cli: CommandLine) -> None:
    one = tmp_path / "one"
    one.mkdir()
    shutil.copy(folder / "0000.png", one)
    poses = _csv(tmp_path / "poses.csv", [compose(compose(T_BASE_CAMERA, SEEN[0]), inverse(T_EE_SHEET))])
    options = ("--intrinsics", folder / "intrinsics.toml", "--poses", poses, "--in-hand", _text(T_EE_SHEET))
    result = cli.json(*CALIBRATE, one, *SMALL_SHEET, *options)
    assert measure_errors(result["T_base_camera"], T_BASE_CAMERA)[0] < 3.0


def test_cameras_that_see_a_sheet_on_the_table(folder: Path, tmp_path: Path, cli: CommandLine) -> None:
    T_base_sheet: PoseTuple = ((0.0, -0.45, 0.0), quat_from_rotvec((0.0, 0.0, 0.3)))
    for number, name in enumerate(("front", "left")):
        (tmp_path / name).mkdir()
        shutil.copy(folder / f"{number:04}.png", tmp_path / name)
        (tmp_path / name / "intrinsics.toml").write_text(INTRINSICS)
    command = (*CALIBRATE, str(tmp_path), *SMALL_SHEET, "--at", f"table={_text(T_base_sheet)}")
    result = cli.json(*command)
    for number, name in enumerate(("front", "left")):
        true = compose(T_base_sheet, inverse(SEEN[number]))
        assert measure_errors(result["cameras"][name]["T_base_camera"], true)[0] < 2.0
    assert "T_base_camera of left" in cli.run(*command)


def test_unusable_pictures_are_one_line(folder: Path, tmp_path: Path, cli: CommandLine) -> None:
    poses, small = _csv(tmp_path / "poses.csv", SEEN[:3]), tmp_path / "small"
    small.mkdir()
    cv2.imwrite(str(small / "0000.png"), np.zeros((48, 64), np.uint8))
    for words, said in (
        ((folder, "--poses", poses), "0003.png (2 pictures"),
        ((folder,), "give --poses CSV"),
        ((tmp_path / "no", "--poses", poses), "not a folder"),
        ((tmp_path, "--poses", poses), "no intrinsics at"),
        ((folder, "--at", "door=0,0,0,1,0,0,0"), "add --sheet door=150mm"),
        ((small, "--poses", poses, "--intrinsics", folder / "intrinsics.toml"), "64 x 48"),
    ):
        assert said in cli.refuse(*CALIBRATE, *words, *SMALL_SHEET)
    (small / "0000.png").write_bytes(b"no picture")
    assert "0000.png" in cli.refuse(*CALIBRATE, small, *SMALL_SHEET, "--poses", poses)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("x,y,z\n", "image,x,y,z,qw,qx,qy,qz"),
        ("", "first line"),
        (f"{HEADER}\na.png,0,0,0,1,1,0,0\n", "line 2: must be"),
        (f"{HEADER}\na.png,0,0,nan,1,0,0,0\n", "line 2: must be"),
        (f"{HEADER}\n\na.png,0,0,0,1,0,0,0\na.png,0,0,0,1,0,0,0\n", "line 4: "),
    ],
)
def test_invalid_poses_are_rejected(text: str, error: str, tmp_path: Path, cli: CommandLine) -> None:
    (tmp_path / "poses.csv").write_text(text)
    assert error in cli.refuse(*CALIBRATE, tmp_path, *SMALL_SHEET, "--poses", tmp_path / "poses.csv")


# --- cloud calibrate --------------------------------------------------------------------------------------------------

CAMERA = CameraModel(640, 480, 585.0, 585.0, 319.5, 239.5)
POSES = {
    "front": look_at((0.9, -1.2, 0.8), (0.0, -0.2, 0.05)),
    "left": look_at((-0.8, -1.3, 0.7), (0.1, -0.2, 0.05)),
}
T_WORLD_SHEET: PoseTuple = ((0.0, -0.45, 0.0), (1.0, 0.0, 0.0, 0.0))
SHEET = ("--sheet", "table=150mm", "--at", "table=0,-0.45,0,1,0,0,0")
HEAD = 'stream = "room"\nlow = [-1.5, -1.5, -0.9]\nhigh = [1.5, 1.5, 1.5]\n'
IDENTITY = "{position_m = [0.0, 0.0, 0.0], quaternion_wxyz = [1.0, 0.0, 0.0, 0.0]}"
DEPTH_INTRINSICS = "{width = 640, height = 480, fx = 585.0, fy = 585.0, cx = 319.5, cy = 239.5}"


class Room(NamedTuple):
    """Folders of pictures by camera below `folder`."""

    folder: Path

    def write(self, *names: str, more: str = "") -> Path:
        """Write a camera file and return its path."""
        cameras = (
            f'[[cameras]]\nname = "{name}"\nsource = "folder"\npath = "{name}"\nintrinsics = {DEPTH_INTRINSICS}\n{more}'
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
    page = Page(to_pdf(Sheet("table", 0.150)))
    for name, T_world_camera in POSES.items():
        (folder / name).mkdir()
        T_camera_sheet = compose(inverse(pose_from_matrix(T_world_camera)), T_WORLD_SHEET)
        for number in range(3):
            depth = cast_picture(model, data, CAMERA, T_world_camera, 0.003, seed=number).depth
            color = photograph([(page, T_camera_sheet)], CAMERA, Conditions(rays=2), np.random.default_rng(number))
            cv2.imwrite(str(folder / name / f"{number}.depth.png"), depth)
            cv2.imwrite(str(folder / name / f"{number}.color.png"), cv2.cvtColor(color, cv2.COLOR_GRAY2BGR))
    return Room(folder)


def test_cameras_are_fitted_to_each_other_after_the_sheet(room: Room, cli: CommandLine) -> None:
    out = room.folder / "calibration.toml"
    file = room.write("front", "left")
    result = cli.json("cloud", "calibrate", file, *SHEET, "--frames", 2, "--icp", "--out", out)
    assert result["used"] == 4
    for name, pose in POSES.items():
        mm, deg = measure_errors(result["cameras"][name]["T_base_camera"], pose_from_matrix(pose))
        assert mm < 8.0
        assert deg < 0.4
        assert 0.5 < result["cameras"][name]["error_mm_p95"] < 30.0
    (refined,) = result["icp"]["cameras"].values()
    assert refined.get("rmse_after_mm", 0.0) < 15.0
    assert result["sheets_without_error"] == []
    settings = load_camera_file(room.write("front", "left", more='calibration = "calibration.toml"\n'))
    assert settings.cameras[0].error_mm == result["cameras"]["front"]["error_mm_p95"]
    assert settings.cameras[0].pose is not None


def test_a_check_tells_which_camera_is_not_where_it_was_calibrated(room: Room, cli: CommandLine) -> None:
    def check(shift_m: float, status: int) -> dict[str, Any]:
        p, q = pose_from_matrix(POSES["front"])
        pose = f"pose = {{position_m = [{p[0] + shift_m}, {p[1]}, {p[2]}], quaternion_wxyz = {list(q)}}}\n"
        file = room.write("front", more=f"error_mm = 10.0\n{pose}")
        return cli.json("cloud", "calibrate", file, *SHEET, "--frames", 1, "--check", status=status)

    well = check(0.0, status=0)
    assert (well["ok"], well["cameras"]["front"]["fits"]) == (True, True)
    moved = check(0.06, status=1)
    assert (moved["ok"], moved["cameras"]["front"]["fits"]) == (False, False)
    assert moved["cameras"]["front"]["shift_mm"] == pytest.approx(60.0, abs=8.0)
    file = room.write("front", more=f"pose = {IDENTITY}\n")
    assert "--out" in cli.refuse("cloud", "calibrate", file, *SHEET, "--check", "--out", room.folder / "no.toml")
    assert "calibration" in cli.refuse("cloud", "calibrate", room.write("front"), *SHEET, "--check")


def test_frames_of_a_camera_at_rest_count_as_one(room: Room, cli: CommandLine) -> None:
    """Ten pictures from one place have the errors of that place ten times."""
    one, three = (cli.json("cloud", "calibrate", room.write("left"), *SHEET, "--frames", n) for n in (1, 3))
    assert three["used"] == 3
    assert three["error_mm_p95"] == pytest.approx(one["error_mm_p95"], rel=0.3)


def test_sheets_come_from_the_session(room: Room, cli: CommandLine) -> None:
    scene = SceneBuilder("bench")
    scene.add_plane("floor", half_size=(2.0, 2.0))
    config = SessionConfig(
        name="bench",
        control_port=0,
        state_port=0,
        anchors={"table": T_WORLD_SHEET, "door": ((0.0, 3.0, 0.0), (1.0, 0.0, 0.0, 0.0))},
        anchor_sizes={"table": 0.150, "door": 0.150},
        anchor_errors={"door": 0.5},
    )
    with ScenePublisher(scene, config) as session:
        result = cli.json("cloud", "calibrate", room.write("front"), "--address", session.address, "--frames", 1)
    assert measure_errors(result["T_base_camera"], pose_from_matrix(POSES["front"]))[0] < 10.0
    assert result["error_mm_p95"] < 30.0, "that of a sheet that is not seen does not count"
    assert result["sheets_without_error"] == ["table"]


def test_unusable_input_is_a_one_line_error(room: Room, tmp_path: Path, cli: CommandLine) -> None:
    file = room.write("front")
    assert "--sheet door=150mm" in cli.refuse("cloud", "calibrate", file, "--at", "door=0,0,0,1,0,0,0")
    assert "one camera" in cli.refuse("cloud", "calibrate", file, *SHEET, "--icp")
    assert "cannot be read" in cli.refuse("cloud", "calibrate", tmp_path / "no.toml", *SHEET)
    door = ("--sheet", "door=150mm", "--at", "door=0,0,0,1,0,0,0")
    assert "no sheet was found in 1 picture:" in cli.refuse("cloud", "calibrate", file, *door, "--frames", 1, status=1)
    on_hand = room.write("front", more='body = "hand"\n')
    assert "--camera-on-hand" in cli.refuse("cloud", "calibrate", on_hand, *SHEET)
