"""`iris-session anchors print` and `calibrate-camera`: exact sheets, calibration from rendered photographs, errors."""

from __future__ import annotations

import json
import math
import shutil
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from anchors.camera import CameraModel, pose_from_rvec_tvec
from anchors.pose import PoseTuple, compose, distance, inverse, quat_angle, quat_from_rotvec
from anchors.sheet import Sheet
from anchors.sheet_print import to_pdf
from iris_session.cli.main import main

sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from render_sheet import Conditions, Page, photograph

CAMERA = CameraModel(640, 480, 585.0, 585.0, 319.5, 239.5, (0.08, -0.18, 0.0008, -0.0005, 0.0))
INTRINSICS = (
    "width = 640\nheight = 480\nfx = 585.0\nfy = 585.0\ncx = 319.5\ncy = 239.5\n"
    "distortion = [0.08, -0.18, 0.0008, -0.0005, 0.0]\n"
)
T_BASE_CAMERA: PoseTuple = ((1.2, -0.2, 0.8), quat_from_rotvec((-1.8, 0.5, 0.4)))
T_EE_SHEET: PoseTuple = ((0.01, 0.03, 0.12), quat_from_rotvec((0.2, 0.4, -1.0)))
SHEET = ("--sheet", "table=120mm")
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
        picture = photograph([(page, T)], CAMERA, Conditions(rays=2), rng)
        cv2.imwrite(str(folder / f"{number:04}.png"), picture)
    (folder / "intrinsics.toml").write_text(INTRINSICS)
    return folder


def _csv(path: Path, poses: Sequence[PoseTuple]) -> Path:
    lines = [",".join([f"{number:04}.png", *(repr(v) for v in (*p, *q))]) for number, (p, q) in enumerate(poses)]
    path.write_text("\n".join([HEADER, *lines, ""]))
    return path


def _hand(seen: Sequence[PoseTuple] = tuple(SEEN)) -> list[PoseTuple]:
    return [compose(compose(T_BASE_CAMERA, T), inverse(T_EE_SHEET)) for T in seen]


def _text(pose: PoseTuple) -> str:
    return ",".join(repr(v) for v in (*pose[0], *pose[1]))


def _errors(result: dict[str, Any], true: PoseTuple) -> tuple[float, float]:
    """[mm], [deg]"""
    q = result["quaternion_wxyz"]
    angle = quat_angle((q[0], q[1], q[2], q[3]), true[1])
    p = result["position_m"]
    return 1e3 * distance((p[0], p[1], p[2]), true[0]), math.degrees(angle)


def _calibrate(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    status = main(["anchors", "calibrate-camera", *map(str, arguments), *SHEET, "--json"])
    out, err = capsys.readouterr()
    assert status == 0, err
    result: dict[str, Any] = json.loads(out)
    return result


def _refused(capsys: pytest.CaptureFixture[str], status: int, *arguments: object) -> str:
    assert main(["anchors", "calibrate-camera", *map(str, arguments)]) == status
    return capsys.readouterr().err


# --- print ---


def test_print_writes_pdf_and_svg(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for name, begin in (("a.pdf", b"%PDF-1.4"), ("a.svg", b"<?xml")):
        out = tmp_path / name
        assert main(["anchors", "print", "--size", "12cm", "--id", "door", "--out", str(out), "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        assert (result["file"], result["id"], result["size_m"], result["paper"]) == (str(out), "door", 0.12, "a4")
        assert out.read_bytes().startswith(begin)


def test_printed_marks_are_those_of_the_anchors_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "table.pdf")
    assert main(["anchors", "print", "--marks", "--out", out, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["size_m"], set(result["marks_m"])) == (0.14, set("1234"))
    assert main(["anchors", "print", "--marks", "--out", out]) == 0
    lines = capsys.readouterr().out
    printed = tomllib.loads(lines[lines.index("[anchors") :])["anchors"]["table"]["marks_m"]
    assert main(["anchors", "example", "--marks"]) == 0
    anchors = tomllib.loads(capsys.readouterr().out)["anchors"]["table"]
    assert anchors["marks_m"] == printed == result["marks_m"]
    assert anchors["size_m"] == 0.14
    assert main(["anchors", "print", "--marks", "--size", "150mm", "--out", out]) == 2
    assert "at most 143 mm" in capsys.readouterr().err
    assert main(["anchors", "print", "--marks", "--size", "200mm", "--paper", "a3", "--out", out]) == 0


def test_print_names_the_file_after_the_anchor(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["anchors", "print", "--id", "cell 1/door"]) == 0
    assert (tmp_path / "cell_1_door.pdf").is_file()
    assert "code: 160 mm" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "error"),
    [
        (["--size", "170mm"], "at most 160 mm"),
        (["--paper", "a9"], "no paper 'a9'"),
        (["--id", ""], "id of a sheet"),
        (["--out", "sheet.png"], ".pdf or .svg"),
        (["--out", "/nowhere/sheet.pdf"], "cannot be written"),
    ],
)
def test_print_rejects_invalid_arguments(
    arguments: list[str],
    error: str,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["anchors", "print", *arguments]) == 2
    assert error in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_size_needs_its_unit(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["anchors", "print", "--size", "160"])
    assert "for example 160mm" in capsys.readouterr().err


# --- calibrate-camera ---


@pytest.mark.long
def test_sheet_on_the_hand_is_calibrated(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses, out = _csv(tmp_path / "poses.csv", _hand()), tmp_path / "camera.toml"
    result = _calibrate(capsys, folder, "--poses", poses, "--out", out)
    assert (result["mode"], result["used"], result["left_out"]) == ("sheet-on-hand", 5, 0)
    mm, deg = _errors(result["T_base_camera"], T_BASE_CAMERA)
    assert mm < 2.0
    assert deg < 0.1
    assert mm < 2.0 * result["error_mm_p95"] < 20.0
    assert _errors(result["T_ee_sheet"], T_EE_SHEET)[0] < 2.0
    assert result["residual_px_rms"] < 0.5
    assert result["residual_mm_rms"] < 1.0
    assert [row["used"] for row in result["pictures"]] == [True] * 5
    assert tomllib.loads(out.read_text())["T_base_camera"]["position_m"] == result["T_base_camera"]["position_m"]
    assert main(["anchors", "calibrate-camera", str(folder), *SHEET, "--poses", str(poses)]) == 0
    assert "5 used, 0 excluded" in capsys.readouterr().out


def test_one_picture_is_enough_with_a_known_hand(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = tmp_path / "one"
    one.mkdir()
    shutil.copy(folder / "0000.png", one)
    poses = _csv(tmp_path / "poses.csv", _hand())
    result = _calibrate(
        capsys, one, "--intrinsics", folder / "intrinsics.toml", "--poses", poses, "--in-hand", _text(T_EE_SHEET)
    )
    assert _errors(result["T_base_camera"], T_BASE_CAMERA)[0] < 3.0


def test_camera_on_the_hand_is_calibrated(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    T_base_sheet, T_ee_camera = T_BASE_CAMERA, T_EE_SHEET
    hand = [compose(T_base_sheet, inverse(compose(T_ee_camera, T))) for T in SEEN]
    result = _calibrate(capsys, folder, "--poses", _csv(tmp_path / "poses.csv", hand), "--camera-on-hand")
    assert result["mode"] == "camera-on-hand"
    assert _errors(result["T_ee_camera"], T_ee_camera)[0] < 2.0
    assert _errors(result["T_base_sheet"], T_base_sheet)[0] < 2.0


def test_cameras_that_see_a_sheet_on_the_table(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    T_base_sheet: PoseTuple = ((0.0, -0.45, 0.0), quat_from_rotvec((0.0, 0.0, 0.3)))
    for number, name in enumerate(("front", "left")):
        (tmp_path / name).mkdir()
        shutil.copy(folder / f"{number:04}.png", tmp_path / name)
        (tmp_path / name / "intrinsics.toml").write_text(INTRINSICS)
    result = _calibrate(capsys, tmp_path, "--at", f"table={_text(T_base_sheet)}")
    for number, name in enumerate(("front", "left")):
        true = compose(T_base_sheet, inverse(SEEN[number]))
        assert _errors(result["cameras"][name]["T_base_camera"], true)[0] < 2.0
    assert main(["anchors", "calibrate-camera", str(tmp_path), *SHEET, "--at", f"table={_text(T_base_sheet)}"]) == 0
    assert "T_base_camera of left" in capsys.readouterr().out


@pytest.mark.long
def test_underdetermined_calibration_is_refused(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    still = [pose_from_rvec_tvec(np.array([0.02 * k, 0.0, 0.0]), np.array([0.4, 0.1 * k, 0.3])) for k in range(5)]
    poses = _csv(tmp_path / "poses.csv", still)
    error = _refused(capsys, 1, folder, *SHEET, "--poses", poses)
    assert "30 degrees" in error
    mixed = _csv(tmp_path / "mixed.csv", _hand([SEEN[k] for k in (2, 0, 4, 1, 3)]))
    assert "agree" in _refused(capsys, 1, folder, *SHEET, "--poses", mixed)
    error = _refused(capsys, 1, folder, "--sheet", "door=120mm", "--at", "door=0,0,0,1,0,0,0")
    assert "5 pictures" in error


def test_unusable_input_is_a_one_line_error(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    poses = _csv(tmp_path / "poses.csv", _hand()[:3])
    assert "0003.png (2 pictures" in _refused(capsys, 2, folder, *SHEET, "--poses", poses)
    assert "give --poses CSV" in _refused(capsys, 2, folder, *SHEET)
    assert "not a folder" in _refused(capsys, 2, tmp_path / "no", *SHEET, "--poses", poses)
    assert "no pictures in" in _refused(capsys, 2, tmp_path, *SHEET, "--poses", poses)
    assert "add --sheet door=160mm" in _refused(capsys, 2, folder, *SHEET, "--at", "door=0,0,0,1,0,0,0")
    (tmp_path / "small").mkdir()
    cv2.imwrite(str(tmp_path / "small" / "0000.png"), np.zeros((48, 64), np.uint8))
    assert "no intrinsics at" in _refused(capsys, 2, tmp_path / "small", *SHEET, "--poses", poses)
    error = _refused(
        capsys, 2, tmp_path / "small", *SHEET, "--poses", poses, "--intrinsics", folder / "intrinsics.toml"
    )
    assert "64 x 48" in error
    (tmp_path / "small" / "0000.png").write_bytes(b"no picture")
    assert "0000.png" in _refused(capsys, 2, tmp_path / "small", *SHEET, "--poses", poses)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("x,y,z\n", "image,x,y,z,qw,qx,qy,qz"),
        ("", "first line"),
        (f"{HEADER}\na.png,0,0,0,1,1,0,0\n", "line 2: "),
        (f"{HEADER}\na.png,0,0,nan,1,0,0,0\n", "line 2: must be"),
        (f"{HEADER}\na.png,0,0\n", "line 2: must be"),
        (f"{HEADER}\n\na.png,0,0,0,1,0,0,0\na.png,0,0,0,1,0,0,0\n", "line 4: "),
    ],
)
def test_invalid_poses_are_rejected(text: str, error: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "poses.csv").write_text(text)
    assert error in _refused(capsys, 2, tmp_path, *SHEET, "--poses", tmp_path / "poses.csv")


def test_pose_on_the_command_line_is_checked(capsys: pytest.CaptureFixture[str]) -> None:
    for given in ("table=0,0,0", "table=0,0,0,2,0,0,0", "0,0,0,1,0,0,0"):
        with pytest.raises(SystemExit):
            main(["anchors", "calibrate-camera", "pictures", *SHEET, "--at", given])
    assert "id of the sheet" in capsys.readouterr().err
