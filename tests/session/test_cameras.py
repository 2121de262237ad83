"""The cameras of a session: files that go together, keys, warnings."""

from __future__ import annotations

from pathlib import Path

import pytest

from iris_session.cloud.config import CameraReport
from iris_session.link import Ports
from iris_session.session.cameras import SILENT_NS, SLOW_START_NS, SessionCameras, load_camera_files
from iris_session.session.config import SessionConfig
from iris_session.session.errors import StartError


def write_file(folder: Path, name: str, *cameras: str, stream: str = "", picture_hz: float = 10.0) -> Path:
    """Write a camera file whose pictures do not exist: nothing opens them here."""
    path = folder / f"{name}.toml"
    path.write_text(
        f'stream = "{stream or name}"\npicture_hz = {picture_hz}\n'
        + "".join(
            f'[[cameras]]\nname = "{camera}"\nsource = "folder"\npath = "{folder}"\n'
            "intrinsics = {width = 40, height = 30, fx = 35.0, fy = 35.0, cx = 19.5, cy = 14.5}\n"
            "pose = {position_m = [0.0, 0.0, 1.0], quaternion_wxyz = [1.0, 0.0, 0.0, 0.0]}\n"
            for camera in cameras or ("front",)
        )
    )
    return path


def test_files_that_go_together(tmp_path: Path) -> None:
    found = load_camera_files([write_file(tmp_path, "room"), str(write_file(tmp_path, "hall", "a", "b"))])
    assert [settings.stream for settings in found] == ["room", "hall"]
    assert load_camera_files(()) == ()


def test_a_file_that_cannot_be_used_is_one_line_of_text(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    with pytest.raises(StartError, match=r"camera\.toml") as error:
        load_camera_files([path])
    assert "\n" not in str(error.value)
    path.write_text("stream = 3")
    with pytest.raises(StartError, match=r"camera\.toml"):
        load_camera_files([path])


def test_two_streams_of_one_name(tmp_path: Path) -> None:
    first, second = write_file(tmp_path, "room"), write_file(tmp_path, "other", stream="room")
    with pytest.raises(StartError, match=r"'room': .*room\.toml and .*other\.toml"):
        load_camera_files([first, second])
    pictures = write_file(tmp_path, "third", stream="room-front")
    with pytest.raises(StartError, match="'room-front'"):
        load_camera_files([first, pictures])


def test_each_process_of_an_encrypted_session_has_a_key(tmp_path: Path) -> None:
    paths = (write_file(tmp_path, "room"), write_file(tmp_path, "hall"))
    assert SessionCameras(SessionConfig(cameras=paths)).public_keys == ()
    first, second = SessionCameras(SessionConfig(cameras=paths, curve=True)).public_keys
    assert first != second
    assert SessionCameras(SessionConfig(curve=True)).public_keys == ()


def test_a_process_that_is_silent_is_a_warning(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = SessionCameras(SessionConfig(cameras=(write_file(tmp_path, "room"),)))
    cameras.start(Ports("127.0.0.1", 1, 2))
    process = cameras._processes["room"]
    monkeypatch.setattr(type(process), "pid", 4711)
    process.heard_ns = 0
    process._was_started = True
    cameras.poll(SILENT_NS)
    assert cameras.list_warnings() == []
    cameras.poll(SILENT_NS + 1)
    assert cameras.list_warnings() == ["the camera process of 'room' hangs: it is ended after 10 s"]
    process.report = CameraReport("room", starting=True)
    assert cameras.list_warnings() == []
    cameras.poll(SLOW_START_NS + 1)
    (text,) = cameras.list_warnings()
    assert text == "the camera process of 'room' starts, which takes long on a busy machine: it is ended after 120 s"
