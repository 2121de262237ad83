"""The cameras of a session: files that go together, keys, warnings."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from iris_session.cloud.config import CameraReport
from iris_session.cloud.model_camera import ModelCamera, PicturesStart
from iris_session.link import Ports
from iris_session.session.cameras import (
    SILENT_NS,
    SLOW_START_NS,
    SessionCameras,
    find_model_cameras,
    load_camera_files,
)
from iris_session.session.config import SessionConfig
from iris_session.session.errors import StartError
from iris_session.system.supervised import SupervisedProcess


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


MODEL = '<mujoco><worldbody><camera name="top"/><camera name="left/wrist"/><camera/></worldbody></mujoco>'


def test_pictures_of_a_model_name_its_cameras(tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_string(MODEL)
    found = find_model_cameras(("left/wrist:64x48@5", "top"), model)
    assert [(one.stream, one.width, one.hz) for one in found] == [("left_wrist", 64, 5.0), ("top", 320, 30.0)]
    assert find_model_cameras((), None) == ()
    with pytest.raises(StartError, match=r"no camera 'wrist': it has top, left/wrist$"):
        find_model_cameras(("wrist",), model)
    with pytest.raises(StartError, match="none with a name"):
        find_model_cameras(("0",), mujoco.MjModel.from_xml_string("<mujoco><worldbody><camera/></worldbody></mujoco>"))
    with pytest.raises(StartError, match="a MuJoCo model"):
        find_model_cameras(("top",), None)
    with pytest.raises(StartError, match="two cameras have a stream 'top'"):
        find_model_cameras(("top", "top@5"), model)
    config = SessionConfig(cameras=(write_file(tmp_path, "top"),), pictures=("top",))
    with pytest.raises(StartError, match="two cameras have a stream 'top'"):
        SessionCameras(config, model)


def test_pictures_of_a_loaded_scene_begin_when_the_process_before_has_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[PicturesStart] = []
    pids: dict[int, int] = {}

    def start(process: SupervisedProcess[CameraReport], now_ns: int) -> None:
        process._was_started = True
        pids[id(process)] = 4711
        monkeypatch.setattr(process, "poll", lambda _: [])
        monkeypatch.setattr(process, "terminate", lambda: None)
        monkeypatch.setattr(process, "close", lambda _: 0)
        started.append(process._spawn.args[2])  # type: ignore[attr-defined]

    monkeypatch.setattr(SupervisedProcess, "start", start)
    monkeypatch.setattr(SupervisedProcess, "pid", property(lambda process: pids.get(id(process), 0)))
    cameras = SessionCameras(SessionConfig(pictures=("top@5",), curve=True), mujoco.MjModel.from_xml_string(MODEL))
    assert len(cameras.public_keys) == 1
    cameras.follow_model(b"another")
    cameras.start(Ports("127.0.0.1", 1, 2))
    cameras.poll(1)
    first = cameras._processes["model"]
    assert started[0].cameras == (ModelCamera("top", hz=5.0),)
    assert started[0].public_key == cameras.public_keys[0]
    cameras.follow_model(b"another")
    cameras.poll(2)
    assert len(started) == 1, "the one before has the streams"
    pids[id(first)] = 0
    cameras.poll(3)
    cameras.poll(4)
    assert [one.packed_model for one in started[1:]] == [b"another"]
    assert cameras.restarts == 0
