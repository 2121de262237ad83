"""Robots that a camera sees tell whether it was moved: on rendered and computed pictures, in motion, beside things."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from anchors.camera import CameraModel, pose_from_matrix
from anchors.pose import PoseTuple
from iris_session import scene_path
from iris_session.cloud.camera_file import CameraSettings
from iris_session.cloud.icp import measure_turn
from iris_session.cloud.moved import CameraMove, MoveWatch, WatchedFrame
from iris_session.cloud.robot_surface import PlacedSurface, RobotSurface, SurfaceLook, compare_depth
from iris_session.cloud.sources.mujoco_camera import MujocoCamera
from tests.cloud.rays import cast_picture, look_at
from tests.cloud.robot_scene import RobotScene, load_robots

Floats = NDArray[np.float64]
CAMERA = CameraModel(160, 120, 146.0, 146.0, 79.5, 59.5)
POSE = look_at((1.1, -1.0, 0.8), (0.0, 0.0, 0.2))
SECOND_NS = 1_000_000_000
HZ = 5.0
#: A hand, or a box of its size [m].
HAND = (0.02, 0.05, 0.09)


def shift(*metres: float, turn_deg: float = 0.0) -> Floats:
    """Return a motion (4, 4) in the frame of the camera, the rotation about its y axis."""
    p = np.eye(4)
    p[:3, 3] = metres or (0.0, 0.0, 0.0)
    turn = math.radians(turn_deg)
    p[:3, :3] = [[math.cos(turn), 0.0, math.sin(turn)], [0.0, 1.0, 0.0], [-math.sin(turn), 0.0, math.cos(turn)]]
    return p


@lru_cache(maxsize=1)
def load(folder: Path) -> tuple[RobotScene, RobotSurface]:
    scene = load_robots("handover", folder)
    return scene, RobotSurface(scene.spec, scene.meshes, scene.robots, scene.streamed)


@pytest.fixture
def scene(tmp_path_factory: pytest.TempPathFactory) -> RobotScene:
    return load(tmp_path_factory.getbasetemp() / "robots")[0]


@pytest.fixture
def surface(tmp_path_factory: pytest.TempPathFactory) -> RobotSurface:
    return load(tmp_path_factory.getbasetemp() / "robots")[1]


@pytest.fixture
def placed(scene: RobotScene, surface: RobotSurface) -> PlacedSurface:
    found = surface.place(lambda name, at_ns: scene.read_pose(name), 0)
    assert found is not None
    return found


def see(
    scene: RobotScene, T_world_camera: Floats, *, boxes: str = "", camera: CameraModel = CAMERA
) -> NDArray[np.uint16]:
    """Return the depth picture of the scene and of other geoms, with a noise of 3 mm."""
    depth = cast_picture(scene.model, scene.data, camera, T_world_camera, 0.003).depth
    if boxes:
        model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{boxes}</worldbody></mujoco>")
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        beside = cast_picture(model, data, camera, T_world_camera, 0.003, seed=1).depth
        depth = np.where((beside > 0) & ((depth == 0) | (beside < depth)), beside, depth)
    return depth


def compare(placed: PlacedSurface, depth: NDArray[np.uint16], error_m: float = 0.01) -> SurfaceLook:
    return compare_depth(placed, depth, CAMERA, 0.001, POSE, error_m)


@pytest.mark.parametrize(
    "bump",
    [
        shift(0.03, 0.0, 0.0),
        shift(0.0, -0.03, 0.0),
        shift(0.0, 0.0, -0.03),
        shift(0.04, 0.0, 0.06),
        shift(turn_deg=2.0),
    ],
)
def test_a_bump_is_measured(scene: RobotScene, placed: PlacedSurface, bump: Floats) -> None:
    look = compare(placed, see(scene, POSE @ bump))
    assert look.verdict == "off"
    found = look.T_world_world @ POSE
    assert np.linalg.norm(found[:3, 3] - (POSE @ bump)[:3, 3]) < 0.006
    assert measure_turn((POSE @ bump)[:3, :3].T @ found[:3, :3]) < math.radians(0.3)


def test_what_the_calibration_states_is_allowed(scene: RobotScene, placed: PlacedSurface) -> None:
    assert compare(placed, see(scene, POSE)).verdict == "fits"
    off = see(scene, POSE @ shift(0.02, 0.0, 0.0))
    assert compare(placed, off, error_m=0.01).verdict == "fits"
    look = compare(placed, off, error_m=0.0)
    assert look.verdict == "off"
    assert look.shift_m == pytest.approx(0.02, abs=0.002)


def test_a_camera_that_was_moved_far_sees_no_robot_where_it_should(scene: RobotScene, placed: PlacedSurface) -> None:
    assert compare(placed, see(scene, POSE @ shift(0.35, 0.0, 0.0))).verdict == "lost"
    # A picture of a covered camera, or of a person close to it, gives no verdict.
    assert compare(placed, np.zeros((120, 160), np.uint16)).verdict == ""
    assert compare(placed, np.full((120, 160), 400, np.uint16)).verdict == ""
    assert compare(placed, np.full((120, 160), 65_535, np.uint16)).verdict == ""


def test_things_and_people_beside_robots_are_no_bump(scene: RobotScene, placed: PlacedSurface) -> None:
    random = np.random.default_rng(11)
    verdicts = []
    for _ in range(8):
        row = random.integers(len(placed.points))
        way = placed.normals[row] * np.sign((POSE[:3, 3] - placed.points[row]) @ placed.normals[row])
        x, y, z = placed.points[row] + way * random.uniform(0.0, 0.06)
        turn = " ".join(f"{part:.4f}" for part in random.normal(size=4))
        boxes = f'<geom type="box" size="{HAND[0]} {HAND[1]} {HAND[2]}" pos="{x} {y} {z}" quat="{turn}"/>'
        verdicts.append(compare(placed, see(scene, POSE, boxes=boxes)).verdict)
    assert verdicts == ["fits"] * 8
    # A person leans against the left arm, and hides a part of both arms.
    x, y, _ = placed.points[: len(placed.points) // 2].mean(axis=0) + np.array([0.15, -0.15, 0.0])
    person = f'<geom type="capsule" size="0.15 0.8" pos="{x} {y} 0.8"/>'
    assert compare(placed, see(scene, POSE, boxes=person)).verdict in ("fits", "")
    # A bump beside a thing is one.
    assert compare(placed, see(scene, POSE @ shift(0.0, 0.03, 0.0), boxes=boxes)).verdict == "off"


def test_along_what_slides_along_itself_nothing_is_claimed() -> None:
    """A long cylinder: neither its ends nor a mark on it are seen."""
    angle, height = (one.ravel() for one in np.meshgrid(np.arange(0.0, 2.0 * np.pi, 0.1), np.arange(-2.0, 2.0, 0.01)))
    normals = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    points = 0.1 * normals + np.stack([0.0 * height, 0.0 * height, height], axis=1)
    placed = PlacedSurface(points, normals, np.full(len(points), True))
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom type="cylinder" size=".1 3"/></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    pose = look_at((0.0, -1.2, 0.0), (0.0, 0.0, 0.0))
    for bump, verdicts in ((shift(0.0, 0.05, 0.0), ("fits",)), (shift(0.03, 0.0, 0.0), ("", "fits"))):
        depth = cast_picture(model, data, CAMERA, pose @ bump, 0.003).depth
        assert compare_depth(placed, depth, CAMERA, 0.001, pose, 0.01).verdict in verdicts


def test_pictures_are_thinned_out_and_lenses_bend_them(scene: RobotScene, placed: PlacedSurface) -> None:
    camera = CameraModel(320, 240, 292.0, 292.0, 159.5, 119.5, (0.1, -0.2, 0.001, 0.001, 0.0))
    for bump, verdict in ((np.eye(4), "fits"), (shift(0.03, 0.0, 0.0), "off")):
        depth = see(scene, POSE @ bump, camera=camera)
        assert compare_depth(placed, depth, camera, 0.001, POSE, 0.01).verdict == verdict


def test_only_bodies_at_rest_are_compared(scene: RobotScene, surface: RobotSurface) -> None:
    def move(
        name: str, at_ns: int, *, names: tuple[str, ...] = ("left/link6",), speed: float = 0.1
    ) -> PoseTuple | None:
        (x, y, z), q = scene.read_pose(name)
        return (x + (speed * at_ns / SECOND_NS if name in names else 0.0), y, z), q

    placed = surface.place(move, SECOND_NS)
    assert placed is not None
    at_rest = surface.place(lambda name, at_ns: scene.read_pose(name), SECOND_NS)
    assert at_rest is not None
    away = placed.points - at_rest.points
    assert 50 < (~placed.still).sum() < 2000
    assert np.allclose(away[placed.still], 0.0)
    assert np.allclose(away[~placed.still], (0.1, 0.0, 0.0))
    slow = surface.place(lambda name, at_ns: move(name, at_ns, speed=0.01), SECOND_NS)
    assert slow is not None
    assert slow.still.all()
    # What counts is motion as seen from what carries the camera.
    carried = surface.place(move, SECOND_NS, "left/link6")
    assert carried is not None
    assert (carried.still == ~placed.still).all()
    # A body whose pose is not known is left out; without any, or the carrier's, there is nothing.
    part = surface.place(lambda name, at_ns: None if name.startswith("left") else scene.read_pose(name), SECOND_NS)
    assert part is not None
    assert 0 < len(part.points) < len(placed.points)
    assert surface.place(lambda name, at_ns: None, SECOND_NS) is None
    assert surface.place(lambda name, at_ns: scene.read_pose(name) if at_ns else None, SECOND_NS // 10) is None
    assert surface.place(lambda name, at_ns: None if name == "mount" else scene.read_pose(name), 0, "mount") is None


def test_an_arm_whose_state_comes_late_is_no_moved_camera(scene: RobotScene) -> None:
    """An arm that turns as a whole at 1 rad/s looks like a camera that was turned the other way."""
    surface = RobotSurface(scene.spec, scene.meshes, scene.robots[:1], scene.streamed)
    data = mujoco.MjData(scene.model)

    def find_pose(name: str, at_ns: int) -> PoseTuple:
        data.qpos[:] = scene.data.qpos
        data.qpos[scene.model.joint("left/joint1").qposadr] += at_ns / SECOND_NS
        mujoco.mj_kinematics(scene.model, data)
        return RobotScene(scene.model, data, scene.spec, {}, (), ()).read_pose(name)

    placed = surface.place(find_pose, 100_000_000)
    assert placed is not None
    depth = see(scene, POSE)  # as the arm was 100 ms before
    all_compared = placed._replace(still=np.full(len(placed.points), True))
    assert compare(all_compared, depth).verdict == "off"
    assert compare(placed, depth).verdict != "off"


class RenderedRoom:
    """A rendered camera before two arms, which move when told to; the camera's frames are late, and have no pose.

    It is a `SurfaceFinder`, by the state of the arms at the time that frames claim.

    Attributes:
        now_ns: Time of the next frame.
        mount: Where the camera is.
        speed: Highest speed of the joints [rad/s].
    """

    def __init__(self, scene: RobotScene, surface: RobotSurface, folder: Path, *, delay_ns: int = 60_000_000) -> None:
        self._scene, self._surface, self._delay_ns = scene, surface, delay_ns
        spec = mujoco.MjSpec.from_file(str(scene_path("handover")))
        hand = spec.worldbody.add_body(name="bystander", pos=(3.0, 3.0, 3.0))
        hand.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=HAND)
        spec.worldbody.add_body(name="mount").add_camera(name="front", quat=(0.0, 1.0, 0.0, 0.0), fovy=50.0)
        spec.compile()
        (folder / "room.xml").write_text(spec.to_xml())
        model = scene.model
        self._hinges = [j for j in range(model.njnt) if "joint1" in model.joint(j).name]  # each turns an arm as a whole
        self._data = mujoco.MjData(model)
        self._start = scene.data.qpos.copy()
        self._posed: tuple[int, float] | None = None
        self.now_ns, self.speed = SECOND_NS, 0.0
        self.mount, self.hand = POSE, (3.0, 3.0, 3.0)
        settings = CameraSettings(
            name="front",
            source="mujoco",
            model=str(folder / "room.xml"),
            camera="front",
            width=160,
            height=120,
            hz=HZ,
        )
        self.source = MujocoCamera(settings, lambda: self.now_ns, self._place_bodies)
        self.watch = MoveWatch(dict, self)

    def find_pose(self, name: str, at_ns: int) -> PoseTuple:
        """Return `T_world_body` at a time."""
        if self._posed != (at_ns, self.speed):
            self._data.qpos[:] = self._start
            angle = self.speed / 0.5 * math.sin(0.5 * at_ns / SECOND_NS)
            for joint in self._hinges:
                self._data.qpos[self._scene.model.jnt_qposadr[joint]] += angle
            mujoco.mj_kinematics(self._scene.model, self._data)
            self._posed = (at_ns, self.speed)
        x, y, z = self._data.body(name).xpos.tolist()
        w, i, j, k = self._data.body(name).xquat.tolist()
        return (x, y, z), (w, i, j, k)

    def is_ready(self, capture_ns: int) -> bool:
        return True

    def place_surface(self, capture_ns: int, carrier: str) -> PlacedSurface | None:
        return self._surface.place(self.find_pose, capture_ns, carrier)

    def watch_for(self, seconds: float) -> list[CameraMove | None]:
        """Show the watch the frames of that time. Return its verdict after each."""
        verdicts = []
        for _ in range(round(HZ * seconds)):
            self.now_ns += round(SECOND_NS / HZ)
            frame = self.source.read(0.0)
            assert frame is not None
            self.watch.offer("front", WatchedFrame(frame, self.source.camera, 0.001, POSE, 0.01))
            if self.watch._look is not None:
                self.watch._look.result(60.0)
            verdicts.append(self.watch.find_move("front"))
        return verdicts

    def _place_bodies(self) -> tuple[int, dict[str, PoseTuple]]:
        names = [body.name for body in self._scene.streamed if "/" in body.name]
        poses = {name: self.find_pose(name, self.now_ns - self._delay_ns) for name in names}
        others = {"mount": pose_from_matrix(self.mount), "bystander": (self.hand, (1.0, 0.0, 0.0, 0.0))}
        return self.now_ns, {**poses, **others}


@pytest.fixture
def room(scene: RobotScene, surface: RobotSurface, tmp_path: Path) -> Iterator[RenderedRoom]:
    room = RenderedRoom(scene, surface, tmp_path)
    yield room
    room.watch.close()
    room.source.close()


def test_a_rendered_camera_that_is_bumped_by_3_cm_is_found_within_2_seconds(room: RenderedRoom) -> None:
    assert set(room.watch_for(4.0)) == {None}
    room.mount = POSE @ shift(0.02, 0.02, -0.01)
    verdicts = room.watch_for(2.0)
    found = verdicts[-1]
    assert found is not None
    assert found.shift_m == pytest.approx(0.03, abs=0.006)
    assert math.degrees(found.turn_rad) < 0.4
    room.mount = POSE
    assert room.watch_for(2.0)[-1] is None, "it is back"
    room.mount = look_at((1.1, -1.0, 0.8), (0.5, -1.2, 0.0))
    found = room.watch_for(2.0)[-1]
    assert found is not None
    assert str(found) == "by an unknown distance"


def test_neither_arms_in_motion_nor_a_hand_beside_them_are_a_moved_camera(room: RenderedRoom) -> None:
    room.speed = 1.0
    x, y, z = room.find_pose("left/link4", 0)[0]
    room.hand = (x + 0.08, y - 0.06, z + 0.05)
    assert set(room.watch_for(6.0)) == {None}
    room.speed = 0.0
    assert set(room.watch_for(4.0)) == {None}
