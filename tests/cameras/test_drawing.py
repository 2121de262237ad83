"""Pictures of model cameras: where everything stands, what is due, and that they are those that `export` draws."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from iris_session.cameras.drawing import CameraDrawing, SeenState, place_bodies
from iris_session.cloud.model_camera import ModelCamera
from iris_session.demo.scenes import scene_path
from iris_session.physics import World
from iris_session.physics.names import get_element_name
from iris_session.protocol.media import StreamInfo, find_info_problem
from iris_session.protocol.server_messages import BodyInfo
from iris_session.replay.pictures import Renderer, find_camera, open_gl

MS = 1_000_000
#: Everything that moves with bodies and is drawn.
ROOM = """<mujoco><worldbody><light pos="0 0 3"/><geom type="plane" size="3 3 .1" rgba=".4 .6 .4 1"/>
<body name="base" pos="0 0 .5"><geom type="box" size=".1 .1 .1" pos=".1 0 0" euler="20 30 0" rgba=".8 .2 .2 1"/>
<body name="arm" pos=".2 0 .1"><joint name="turn" axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".04"/>
<site name="tip" pos=".3 0 0" size=".05"/><light pos=".3 0 .1" dir="1 0 -1" mode="fixed"/>
<camera name="left/wrist" pos=".1 0 .3" euler="-30 -40 0"/></body></body>
<body name="ball" pos="-.5 .2 1"><freejoint/><geom size=".1" rgba=".2 .2 .9 1"/></body>
<site name="nail" pos="0 0 1.5"/><camera name="follow" pos="0 -2 1" mode="targetbodycom" target="ball"/></worldbody>
<tendon><spatial width=".01" rgba="1 1 0 1"><site site="nail"/><site site="tip"/></spatial></tendon>
<actuator><motor joint="turn"/></actuator></mujoco>"""


class Sink:
    """Keeps what is published."""

    def __init__(self) -> None:
        self.pictures: list[tuple[str, NDArray[np.uint8], int, StreamInfo | None]] = []

    def publish(self, stream: str, data: bytes, capture_ns: int, encoding: str, info: StreamInfo | None) -> bool:
        assert encoding == "jpeg"
        picture = np.asarray(Image.open(io.BytesIO(data)))
        self.pictures.append((stream, picture, capture_ns, info))
        return True


class Lab:
    """A simulation, and the drawing of its states as a client sees them."""

    def __init__(self, model: mujoco.MjModel, *cameras: ModelCamera, plain: bool = True) -> None:
        self.world = World(model, (), ())
        self.sink: Any = Sink()
        self.drawing = CameraDrawing(model, cameras, self.sink, plain=plain)

    def advance(self, n: int) -> None:
        for _ in range(n):
            mujoco.mj_step(self.world.model, self.world.data)
        mujoco.mj_forward(self.world.model, self.world.data)

    def see(self, time_ns: int, **more: Any) -> SeenState:
        poses = np.zeros((len(self.world.bodies), 7))
        self.world.read_poses(poses)
        return SeenState(time_ns, poses, self.world.bodies, **more)


@pytest.fixture
def room() -> Iterator[Lab]:
    lab = Lab(
        mujoco.MjModel.from_xml_string(ROOM), ModelCamera("left/wrist", 96, 64, 50.0), ModelCamera("follow", 64, 96, 10)
    )
    yield lab
    lab.drawing.close()


def test_all_that_is_drawn_stands_where_the_simulation_has_it() -> None:
    model = mujoco.MjModel.from_xml_string(ROOM)
    there, here = mujoco.MjData(model), mujoco.MjData(model)
    there.ctrl[:] = 1.0
    for _ in range(300):
        mujoco.mj_step(model, there)
    mujoco.mj_forward(model, there)
    mujoco.mj_forward(model, here)
    bodies = np.arange(1, model.nbody)
    place_bodies(model, here, bodies, np.hstack([there.xpos[1:], there.xquat[1:]]))
    kinds = ("geom_xpos", "geom_xmat", "site_xpos", "site_xmat", "cam_xpos", "cam_xmat", "light_xpos", "light_xdir")
    for kind in (*kinds, "wrap_xpos", "xmat"):
        assert getattr(here, kind) == pytest.approx(getattr(there, kind), abs=1e-12), kind
    assert np.abs(here.light_xpos - mujoco.MjData(model).light_xpos).max() > 0.01


def test_a_picture_is_what_export_draws_of_the_state(room: Lab) -> None:
    room.advance(200)
    assert room.drawing.poll(room.see(7 * MS), 100 * MS) == 2
    (name, picture, capture_ns, _), (other, tracking, *_) = room.sink.pictures
    assert (name, other, capture_ns) == ("left_wrist", "follow", 7 * MS)
    model, data = room.world.model, room.world.data
    gl = open_gl(96, 96)
    renderer = Renderer(model, 96, 96, [], plain=True)
    for size, shown, camera in (((96, 64), picture, "left/wrist"), ((64, 96), tracking, "follow")):
        expected = renderer.draw(data, find_camera(model, camera), size=size)
        assert shown.shape == expected.shape
        error = np.abs(shown.astype(int) - expected)
        assert error.mean() < 2.0, "of the JPEG"
        assert expected.std() > 10.0
    renderer.close()
    gl.free()


def test_rates_are_bounded_and_late_pictures_are_left_out(room: Lab) -> None:
    for now_ms in range(0, 1000, 4):
        room.drawing.poll(room.see(now_ms * MS), now_ms * MS)
    counts = [sum(one[0] == name for one in room.sink.pictures) for name in ("left_wrist", "follow")]
    assert counts == [50, 10]
    assert room.drawing.find_wait_s(996 * MS) == pytest.approx(0.004)
    room.drawing.make_report(1000 * MS, connected=True)
    room.drawing.poll(room.see(1500 * MS), 1500 * MS)
    report = room.drawing.make_report(2000 * MS, connected=True)
    assert report.drops == {"superseded": 25 + 5}
    assert report.cameras["left_wrist"].hz == 1.0
    assert "left_wrist at 1.0 of 50 Hz" in report.warning


def test_a_state_is_drawn_once_by_each_camera(room: Lab) -> None:
    state = room.see(0)
    assert [room.drawing.poll(state, at * 200 * MS) for at in range(3)] == [2, 0, 0]
    room.drawing.restart_clock()
    assert room.drawing.poll(room.see(0), 0) == 2


def test_size_rate_and_pose_are_stated_once_a_second(room: Lab) -> None:
    room.advance(50)
    for now_ms in range(0, 2000, 20):
        room.drawing.poll(room.see(now_ms * MS), now_ms * MS)
    infos = [one[3] for one in room.sink.pictures if one[0] == "left_wrist" and one[3] is not None]
    assert len(infos) == 2
    info = infos[0]
    assert (info.title, info.hz, find_info_problem(info)) == ("left/wrist", 50.0, "")
    assert info.camera is not None
    assert (info.camera.width, info.camera.height, info.camera.body) == (96, 64, "arm")
    (tracking,) = {one[3].camera for one in room.sink.pictures[:10] if one[0] == "follow" and one[3] is not None}
    data = room.world.data
    assert tracking.body == ""
    assert tracking.position == pytest.approx(data.camera("follow").xpos)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, np.array(tracking.orientation))
    assert turn.reshape(3, 3)[:, 2] == pytest.approx(-data.camera("follow").xmat.reshape(3, 3)[:, 2]), "z is forward"


def test_states_of_another_scene_are_not_drawn(room: Lab) -> None:
    other = SeenState(0, np.zeros((1, 7)), (BodyInfo(1, "chair", True, False),))
    assert room.drawing.poll(other, 0) == 0
    assert room.drawing.poll(room.see(1), 0) == 2


def test_a_camera_that_the_model_lacks_is_a_warning() -> None:
    lab = Lab(mujoco.MjModel.from_xml_string(ROOM), ModelCamera("top", 32, 32), ModelCamera("follow", 32, 32))
    assert lab.drawing.poll(lab.see(0), 0) == 1
    report = lab.drawing.make_report(0, connected=True)
    assert report.warning == "the scene has no camera 'top': it has follow, left/wrist"
    lab.drawing.close()


def test_cloth_is_drawn_where_its_vertices_are() -> None:
    model = mujoco.MjModel.from_xml_path(str(scene_path("cloth")))
    lab = Lab(model, ModelCamera("operator", 64, 48))
    lab.drawing.poll(lab.see(0), 0)
    vertices = lab.world.data.flexvert_xpos.copy()
    vertices[:, 2] += 0.2
    vertices[0] = np.nan  # it is not transferred
    lab.drawing.poll(lab.see(1, vertices={get_element_name(model, "flex", 0): vertices, "rope": vertices}), 40 * MS)
    before, after = (one[1].astype(int) for one in lab.sink.pictures)
    assert np.abs(after - before).max() > 50
    assert lab.drawing._data.flexvert_xpos[1:] == pytest.approx(vertices[1:])
    lab.drawing.close()
