"""Camera processes of real sessions: a drawn camera that is killed, and one by hand whose key is revoked."""

from __future__ import annotations

import json
import os
import subprocess
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest

from iris_session import Client, CurveKeys, Recording, decode_cloud
from iris_session.protocol.media import StreamBudget
from iris_session.security import KeyHome, KeyPair
from tests.e2e.session_process import (
    COMMAND,
    DEADLINE_S,
    END_WITH_PARENT,
    SessionProcess,
    assert_all_end,
    list_descendants,
    run_command,
    wait_until,
)

pytestmark = pytest.mark.e2e

WIDTH, HEIGHT = 160, 120
#: A room with a camera in it.
ROOM = """<mujoco><worldbody><light pos="0 0 3"/><geom type="plane" size="3 3 .1" rgba=".4 .6 .4 1"/>
<geom type="box" size=".2 .2 .2" pos="1 0 .2" rgba=".8 .2 .2 1"/>
<camera name="front" pos="-.5 0 1" xyaxes="0 -1 0 .5 0 .866"/></worldbody></mujoco>"""


@pytest.fixture
def camera_file(tmp_path: Path) -> Path:
    """A camera file with a drawn camera, at a rate that a busy machine keeps."""
    (tmp_path / "room.xml").write_text(ROOM)
    path = tmp_path / "room.toml"
    path.write_text(
        'stream = "room"\ntitle = "Room"\nhz = 5.0\npicture_hz = 2.0\nvoxel_m = 0.03\n'
        '[[cameras]]\nname = "front"\nsource = "mujoco"\nmodel = "room.xml"\ncamera = "front"\n'
        f"width = {WIDTH}\nheight = {HEIGHT}\nhz = 5.0\n"
    )
    return path


def wait_for_frames(client: Client, stream: str, n: int = 1, since_ns: int = 0) -> bytes:
    """Wait for that many frames more, captured after a session time. Return the newest one."""
    feed = client.media.subscribe(stream)
    before = feed.received

    def are_there(_: Client) -> bool:
        newest = feed.newest
        return newest is not None and feed.received >= before + n and newest.header.capture_ns > since_ns

    assert client.wait_for(are_there, DEADLINE_S), f"no frames of {stream}"
    assert feed.newest is not None
    return feed.newest.data


def find_stream(client: Client, stream: str) -> StreamBudget | None:
    """Return what the session says of a stream, `None` when it has none of that name."""
    budget = client.media.delivery
    return next((one for one in budget.streams if one.stream == stream), None) if budget is not None else None


def find_cameras(server: SessionProcess, module: str = "iris_session.cloud.process") -> list[psutil.Process]:
    """Return the camera processes of a session, by the module that they run."""
    found = []
    for child in psutil.Process(server.process.pid).children():
        try:
            line = child.cmdline()
        except psutil.Error:  # it has just ended
            continue
        if module in line and child.status() != psutil.STATUS_ZOMBIE:
            found.append(child)
    return found


def test_a_killed_camera_process_comes_back_and_ends_with_its_session(
    serve: Callable[..., SessionProcess], camera_file: Path
) -> None:
    server = serve("handover", "--camera", str(camera_file))
    with Client(server.address, role="observer", name="ann").connect(DEADLINE_S) as ann:
        cloud = decode_cloud(wait_for_frames(ann, "room", 2))
        assert len(cloud.positions) > 500
        assert (np.abs(cloud.positions[:, 2]) < 0.01).mean() > 0.5, "the floor of the model is where it is"
        picture = cv2.imdecode(np.frombuffer(wait_for_frames(ann, "room-front"), np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        assert picture.shape == (HEIGHT, WIDTH, 3)
        assert ann.wait_for(
            lambda _: (found := find_stream(ann, "room")) is not None and found.title == "Room", DEADLINE_S
        )
        (camera,) = find_cameras(server)
        camera.kill()
        killed_ns = ann.session_now_ns()
        wait_for_frames(ann, "room", since_ns=killed_ns)
        # 2 s on a machine that does nothing else: imports, loading the compiled filter, joining. Shown by `pytest -rP`.
        print(f"{1e-9 * (ann.session_now_ns() - killed_ns):.2f} s from the kill to the next frame")
        assert [one.pid for one in find_cameras(server)] != [camera.pid]
        wait_until(lambda: "the camera process of 'room' ended with status -9" in server.output, "it is announced")
        wait_until(lambda: ann.status().restarts.get("cameras") == 1, "it is counted")
    children = list_descendants(server.process.pid)
    server.kill()
    assert_all_end(children)


def test_pictures_of_the_model_at_an_encrypted_session(serve: Callable[..., SessionProcess]) -> None:
    home = KeyHome()
    pair = KeyPair.generate()
    home.clients.allow_key("ann", pair.public, ("observer",))
    curve = CurveKeys(home.load_server_key().public.encode(), pair.public.encode(), pair.secret.encode())
    options = ("--picture", "operator:160x120@5", "--plain-pictures", "--curve", "--no-beacon")
    server = serve("handover", *options)
    with Client(server.address, role="observer", name="ann", curve=curve).connect(DEADLINE_S) as ann:
        operator = ann.camera("operator", DEADLINE_S)
        picture = operator.wait(DEADLINE_S)
        assert (picture.shape, operator.size, operator.hz) == ((120, 160, 3), (160, 120), 5.0)
        assert picture.std() > 20.0, "there is something in it"
        assert len(find_cameras(server, "iris_session.cameras.process")) == 1
    server.finish()


@pytest.mark.long
def test_a_camera_by_hand_at_an_encrypted_session_until_its_key_is_revoked(
    serve: Callable[..., SessionProcess], tmp_path: Path, camera_file: Path
) -> None:
    home = KeyHome()
    pair = KeyPair.generate()
    home.clients.allow_key("ann", pair.public, ("observer",))
    curve = CurveKeys(home.load_server_key().public.encode(), pair.public.encode(), pair.secret.encode())
    server = serve("handover", "--curve", "--no-beacon")
    shown = run_command("pair", "--address", server.address, "--no-wait", "--json", "--role", "camera", cwd=tmp_path)
    assert shown.returncode == 0, shown.stderr
    options = [str(camera_file), "--address", server.address, "--code", json.loads(shown.stdout)["code"], "--json"]
    out = tmp_path / "camera.out"
    with out.open("wb") as file:
        process = subprocess.Popen(
            [*END_WITH_PARENT, *COMMAND, "cloud", "run", *options],
            stdout=file,
            stderr=file,
            env={**os.environ, "IRIS_HOME": str(tmp_path / "home")},
        )
    try:
        with Client(server.address, role="observer", name="ann", curve=curve).connect(DEADLINE_S) as ann:
            wait_for_frames(ann, "room", 2)
            assert json.loads(out.read_text().splitlines()[-1])["stream"] == "room"
            assert {p.role for p in ann.mirror.participants.values() if p.name == "room"} == {"camera"}
            server.children()["front.main"].kill()
            assert ann.wait_for(lambda _: ann.connection.counters.reconnects > 0 and ann.ready, DEADLINE_S)
            wait_for_frames(ann, "room", 2)
            (entry,) = [one for one in home.clients.read().values() if one.roles == ("camera",)]
            home.clients.revoke_key(entry.fingerprint)
            wait_until(lambda: process.poll() is not None, "the camera whose key was revoked has ended")
            assert process.returncode == 1
            assert "Traceback" not in out.read_text()

            def is_over() -> bool:
                ann.sleep(0.1)
                description = find_stream(ann, "room")
                return description is None or description.stale

            wait_until(is_over, "its stream has ended")
    finally:
        process.kill()
        process.wait()
    server.finish()
    with Recording.open(server.recording) as recording:
        assert list(recording.clouds("room"))
        *_, last = recording.streams("room")
        assert last.info is None, "it ends before the session does"
