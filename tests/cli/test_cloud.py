"""`iris-session cloud`: example and inspect of files, its reports, and what cannot be used."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from iris_session.cli.cloud import format_faults, format_inspection, format_report
from iris_session.cloud.camera_file import load_camera_file
from iris_session.cloud.config import CameraReport, SourceReport
from iris_session.cloud.process import OnReport
from iris_session.protocol.names import StreamFault
from tests.cli.conftest import CommandLine


@pytest.fixture(autouse=True)
def _keep_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    """`cloud run` lowers the priority of its process, here that of all tests."""
    monkeypatch.setattr("iris_session.system.priority.lower_thread_priority", lambda: None)


@pytest.fixture
def camera_file(tmp_path: Path) -> Path:
    """A camera file of pictures of a wall with noise."""
    random = np.random.default_rng(1)
    for i in range(3):
        depth = (1500 + random.integers(0, 5, (60, 80))).astype(np.uint16)
        cv2.imwrite(str(tmp_path / f"{i}.depth.png"), depth)
        cv2.imwrite(str(tmp_path / f"{i}.color.png"), np.full((60, 80, 3), 90, np.uint8))
    path = tmp_path / "camera.toml"
    path.write_text(
        'stream = "room"\nhz = 10.0\nvoxel_m = 0.05\n'
        '[[cameras]]\nname = "front"\nsource = "folder"\npath = "."\nhz = 10.0\n'
        "intrinsics = {width = 80, height = 60, fx = 70.0, fy = 70.0, cx = 39.5, cy = 29.5}\n"
        "pose = {position_m = [0.0, 0.0, 1.0], quaternion_wxyz = [0.5, -0.5, 0.5, -0.5]}\nerror_mm = 12.0\n"
    )
    return path


def test_an_example_is_written_once(tmp_path: Path, cli: CommandLine) -> None:
    path = tmp_path / "camera.toml"
    cli.run("cloud", "example", "--source", "mujoco", "-o", path)
    assert load_camera_file(path).cameras[0].source == "mujoco"
    assert "cloud inspect" in cli.out
    assert "exists" in cli.refuse("cloud", "example", "-o", path)
    assert "cannot be written" in cli.refuse("cloud", "example", "-o", tmp_path / "no" / "camera.toml")
    assert 'source = "folder"' in cli.run("cloud", "example")


def test_a_file_is_inspected(camera_file: Path, cli: CommandLine) -> None:
    report = cli.json("cloud", "inspect", camera_file, "--seconds", "1")
    assert report["ok"]
    assert report["hz"] > 0.0
    assert report["points"] > 100
    assert report["error_m"] == pytest.approx(0.012)
    assert report["cameras"]["front"]["fault"] == ""
    del report["ok"]
    text = "\n".join(format_inspection(load_camera_file(camera_file), msgspec.convert(report, CameraReport)))
    assert "camera front: " in text
    assert "12.0 mm" in text
    assert all(f"{stage} " in text for stage in report["stages_ms"])


def test_a_fault_is_shown_and_is_the_exit_status(camera_file: Path, cli: CommandLine) -> None:
    for path in camera_file.parent.glob("*.depth.png"):
        cv2.imwrite(str(path), np.zeros((60, 80), np.uint16))
    text = cli.run("cloud", "inspect", camera_file, "--seconds", "1", status=1)
    assert "no_depth: no pixel has a depth" in text
    assert "cloud room: no points came" in text


def test_a_picture_that_cannot_be_read_is_one_line(camera_file: Path, cli: CommandLine) -> None:
    (camera_file.parent / "0.depth.png").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(4) + b"IHDR" + b"\xff" * 9)
    error = cli.refuse("cloud", "calibrate", camera_file, "--sheet", "a=100mm", "--at", "a=0,0,0,1,0,0,0")
    assert "camera 'front'" in error
    assert "0.depth.png" in error


def test_cameras_that_no_session_admitted_are_a_fault(
    camera_file: Path, cli: CommandLine, monkeypatch: pytest.MonkeyPatch
) -> None:
    connected = False
    now_s = 100.0

    def run(_settings: object, client: Any, on_report: OnReport, is_ending: Callable[[], bool]) -> str:
        nonlocal now_s
        client.close()
        now_s += 5.0  # the filter is prepared: not part of the time to run
        assert not is_ending()
        for seconds in (0.0, 0.09, 0.02):
            now_s += seconds
            on_report(CameraReport("room", connected=connected))
            assert is_ending() == (seconds == 0.02)
        return ""

    monkeypatch.setattr("iris_session.cloud.process.run_cameras", run)
    monkeypatch.setattr("iris_session.cli.common.check_session_reachable", lambda _: None)
    monkeypatch.setattr("iris_session.cli.cloud.time", SimpleNamespace(monotonic=lambda: now_s))
    command = ["cloud", "run", str(camera_file), "--address", "127.0.0.1:1", "--seconds", "0.1"]
    cli.run(*command, status=1)
    assert "no session admitted the cameras within 0.1 s: 127.0.0.1:1" in cli.err
    connected = True
    cli.run(*command)


def test_a_camera_on_a_body_cannot_be_inspected_without_a_session(camera_file: Path, cli: CommandLine) -> None:
    camera_file.write_text(camera_file.read_text() + 'body = "left/hand"\n')
    assert "camera 'front' is on body 'left/hand': only a session knows where that is" in cli.refuse(
        "cloud", "inspect", camera_file
    )


def test_a_report_is_one_line() -> None:
    assert format_report(CameraReport("room")) == "room: no session yet"
    well = CameraReport("room", True, 29.84, 34814, 0.0119, 0.01, 1.25e6, 47.2, cameras={"front": SourceReport(30.0)})
    assert format_report(well) == "room: 29.8 Hz, 34,814 points of 1.2 cm, 10.0 Mbit/s, 47 ms old"
    fault = SourceReport(30.0, StreamFault.FROZEN, "the same picture for 3 s\x1b[2J")
    faulty = CameraReport("room", True, cameras={"front": fault, "back": SourceReport(30.0)})
    assert format_faults(faulty) == "front: frozen (the same picture for 3 s\N{REPLACEMENT CHARACTER}[2J)"
    assert format_report(faulty).endswith(format_faults(faulty))


def test_all_that_cameras_leave_out_is_explained(camera_file: Path) -> None:
    reasons = ["superseded", "pose", "join", "cells", "budget", "unusable", "failed", "send"]
    report = CameraReport("room", drops=dict.fromkeys(reasons, 2))
    text = "\n".join(format_inspection(load_camera_file(camera_file), report))
    for reason in reasons:
        assert f"{reason} 2 (" in text
