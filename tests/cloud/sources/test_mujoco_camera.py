"""A rendered camera: its points lie on the surfaces of the model, its bodies stand where they are told to."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from anchors.pose import PoseTuple
from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.frames import DepthFrame, SourceError
from iris_session.cloud.sources.mujoco_camera import MujocoCamera
from iris_session.cloud.voxels import make_rays

MODEL = """
<mujoco>
  <statistic extent="2"/>
  <worldbody>
    <light pos="0 0 3"/>
    <geom name="floor" type="plane" size="2 2 0.1" rgba="0.2 0.8 0.2 1"/>
    <body name="box" pos="0.1 0.2 0.15">
      <freejoint/>
      <geom name="box" type="box" size="0.2 0.1 0.15" rgba="0.9 0.1 0.1 1"/>
      <body name="lid" pos="0 0 0.2"><geom name="lid" type="sphere" size="0.06" pos="0.02 0 0" rgba="0 0 1 1"/></body>
    </body>
    <body name="hand" pos="0 -1 1.2">
      <joint type="slide"/>
      <geom type="box" size="0.01 0.01 0.01" pos="0 0 0.3"/>
      <camera name="front" pos="0 0 0" xyaxes="1 0 0 0 0.7 0.7" fovy="55"/>
    </body>
  </worldbody>
</mujoco>
"""
SENSOR = 'sensorsize="0.01 0.01" focal="0.01 0.01" resolution="64 48"'


def make_settings(folder: Path, text: str = MODEL, **values: object) -> CameraSettings:
    file = folder / "model.xml"
    file.write_text(text)
    return CameraSettings(**{"name": "a", "source": "mujoco", "model": str(file), "camera": "front", **values})  # type: ignore[arg-type]


class Poses(dict[str, PoseTuple]):
    """Poses of bodies, as a callable, and their session time."""

    at_ns = 7

    def __call__(self) -> tuple[int, Poses] | None:
        return (self.at_ns, self) if self.at_ns else None


@pytest.fixture
def poses() -> Poses:
    return Poses()


@pytest.fixture
def camera(tmp_path: Path, poses: Poses) -> Iterator[MujocoCamera]:
    source = MujocoCamera(make_settings(tmp_path), lambda: 9, poses)
    yield source
    source.close()


def read(camera: MujocoCamera) -> DepthFrame:
    frame = camera.read(1.0)
    assert frame is not None
    return frame


def deproject(camera: MujocoCamera, frame: DepthFrame) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the points (n, 3) of the measured pixels, world frame, and which pixels these are."""
    rays, measured = make_rays(camera.camera), frame.depth > 0
    z = frame.depth[measured] * camera.depth_scale_m
    points = np.stack([rays.x[measured] * z, rays.y[measured] * z, z], axis=1)
    assert frame.T_world_camera is not None
    return points @ frame.T_world_camera[:3, :3].T + frame.T_world_camera[:3, 3], measured


def measure_error(camera: MujocoCamera, frame: DepthFrame, data: mujoco.MjData) -> NDArray[np.float64]:
    """Return the distances along the rays [m] between points of a frame and the surfaces that MuJoCo's rays meet."""
    points, _ = deproject(camera, frame)
    assert frame.T_world_camera is not None
    origin = frame.T_world_camera[:3, 3]
    errors = []
    for point in points[::97]:
        length = np.linalg.norm(point - origin)
        direction = (point - origin) / length
        met = mujoco.mj_ray(data.model, data, origin, direction, None, 1, -1, np.zeros(1, np.int32), None)
        errors.append(abs(met - length))
    return np.array(errors)


def test_points_lie_on_the_surfaces(camera: MujocoCamera, tmp_path: Path) -> None:
    frame = read(camera)
    assert (frame.depth.shape, frame.color.shape, frame.capture_ns) == ((480, 640), (480, 640, 3), 7)
    assert (frame.depth > 0).mean() > 0.9
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    errors = measure_error(camera, frame, data)
    # Pixels at edges belong to one surface in the picture and to another one along the ray of their centre.
    assert np.quantile(errors, 0.99) < 0.002 + 0.001
    assert np.median(errors) < 0.001


def test_a_frame_is_of_the_time_of_the_state_that_it_shows(tmp_path: Path, poses: Poses) -> None:
    now = [10**9]
    source = MujocoCamera(make_settings(tmp_path, width=64, height=48), lambda: now[0], poses)
    captured = []
    for at_ns in (0, now[0] - 20, now[0] + 80, now[0] + 80):  # no state yet; one from before; then a later one, twice
        poses.at_ns = at_ns
        captured.append(read(source).capture_ns)
        now[0] += 100_000_000
    source.close()
    assert captured == [10**9, 10**9, 10**9 + 80, 10**9 + 80]


def test_bodies_and_the_camera_stand_where_they_are_told_to(camera: MujocoCamera, poses: Poses) -> None:
    poses["box"] = ((-0.2, 0.3, 0.4), (0.9238795325112867, 0.0, 0.0, 0.3826834323650898))
    poses["hand"] = ((0.1, -0.9, 1.3), (0.9961946980917455, 0.0, 0.08715574274765817, 0.0))
    poses["stranger"] = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    frame = read(camera)
    model = mujoco.MjModel.from_xml_string(MODEL)
    data = mujoco.MjData(model)
    # The same by MuJoCo's own kinematics: the box by its joint, the hand by its place in the model.
    data.qpos[:7] = (*poses["box"][0], *poses["box"][1])
    hand = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "hand")
    model.body_pos[hand], model.body_quat[hand] = poses["hand"]
    mujoco.mj_forward(model, data)
    assert frame.T_world_camera is not None
    assert np.allclose(frame.T_world_camera[:3, 3], data.cam_xpos[0])
    assert np.allclose(frame.T_world_camera[:3, 2], -data.cam_xmat[0].reshape(3, 3)[:, 2])
    assert np.quantile(measure_error(camera, frame, data), 0.99) < 0.003
    # The lid has no joint: it moved with the box, and is drawn where it is now.
    points, measured = deproject(camera, frame)
    blue = (frame.color[measured].astype(int) @ (-1, -1, 2)) > 40
    lid = data.geom_xpos[mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "lid")]
    assert blue.sum() > 200
    assert np.abs(np.linalg.norm(points[blue] - lid, axis=1) - 0.06).max() < 0.01


def test_frames_come_at_the_rate_and_at_its_multiples(tmp_path: Path) -> None:
    """So those of two cameras that were opened at different times are captured together."""
    times = [60]
    source = MujocoCamera(make_settings(tmp_path, hz=10.0, width=64, height=48), lambda: times[0] * 1_000_000)
    taken = []
    for times[0] in (60, 70, 99, 100, 170, 210, 299, 300, 399, 420, 700, 799, 800):
        if source.read(0.0) is not None:
            taken.append(times[0])
    source.close()
    assert taken == [100, 210, 300, 420, 700, 800]


@pytest.mark.parametrize(
    ("text", "camera", "named"),
    [
        (MODEL, "rear", "front"),
        ("<mujoco><worldbody/></mujoco>", "front", "no camera"),
        ("<mujoco>", "front", "model.xml"),
        (MODEL.replace('fovy="55"', SENSOR), "front", "sensorsize"),
    ],
)
def test_a_wrong_model_or_camera_is_named(tmp_path: Path, text: str, camera: str, named: str) -> None:
    with pytest.raises(SourceError) as caught:
        MujocoCamera(make_settings(tmp_path, text, camera=camera), lambda: 0)
    assert named in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_missing_driver_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise mujoco.FatalError("gladLoadGL error")

    monkeypatch.setattr(mujoco, "MjrContext", fail)
    with pytest.raises(SourceError) as caught:
        MujocoCamera(make_settings(tmp_path), lambda: 0)
    assert "gladLoadGL" in str(caught.value)
