"""A publisher of a world without MuJoCo, in which everything is a function of time. A program, not a test.

python publisher_program.py RECORDING FOLDER        returns to time 0 when a file `back` appears in FOLDER
"""

from __future__ import annotations

import math
import sys
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from iris_session import SceneBuilder, ScenePublisher, SessionConfig

#: Above the rate of the state, so that some frames are superseded.
HZ = 200.0
NAMES = ("ball", "crate", "arm/base", "arm/upper", "arm/fore")
ARM = """<robot name="arm">
  <link name="base"><visual><geometry><box size="0.1 0.1 0.1"/></geometry></visual></link>
  <link name="upper"><visual><geometry><box size="0.4 0.05 0.05"/></geometry></visual></link>
  <link name="fore"><visual><geometry><cylinder radius="0.03" length="0.3"/></geometry></visual></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="upper"/><origin xyz="0 0 0.1"/>
    <axis xyz="0 0 1"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
  <joint name="lift" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0.4 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/></joint>
</robot>"""
ROWS = 12


def make_grid() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return the vertices of a cloth of 1 m, and its triangles."""
    side = np.linspace(0.0, 1.0, ROWS)
    x, y = np.meshgrid(side, side)
    number = np.arange(ROWS * ROWS).reshape(ROWS, ROWS)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, 1:], number[1:, :-1]
    triangles = np.concatenate([np.stack(corners, -1).reshape(-1, 3) for corners in ((a, b, c), (a, c, d))])
    return np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3), triangles


def make_cloth(t: float) -> NDArray[np.float64]:
    """Return the vertices of the waving cloth at a time [s]."""
    vertices = make_grid()[0]
    vertices[:, 2] += 0.1 * np.sin(2.0 * math.pi * (vertices[:, 0] + t))
    return vertices


def rotate(angle: float, axis: int) -> tuple[float, ...]:
    """Return the quaternion (w, x, y, z) of a rotation about the x, y or z axis."""
    q = [math.cos(angle / 2.0), 0.0, 0.0, 0.0]
    q[axis + 1] = math.sin(angle / 2.0)
    return tuple(q)


def get_ball_position(t: float) -> tuple[float, float, float]:
    return math.cos(t), math.sin(t), 1.0


def get_joint_angle(t: float) -> float:
    return math.sin(t)


def build_scene(folder: Path) -> SceneBuilder:
    """Build the scene, always the same. `folder`: for the files that it is made of."""
    (folder / "arm.urdf").write_text(ARM)
    (folder / "corner.off").write_text("OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n")
    scene = SceneBuilder("lab")
    scene.add_plane("floor", half_size=(3.0, 3.0))
    scene.add_file(folder / "corner.off", position=(-1.0, 0.0, 0.0), scale=0.5)
    scene.add_sphere("ball", radius=0.1, movable=True, rgba=(1.0, 0.5, 0.0, 1.0))
    scene.add_box("crate", half_size=(0.2, 0.2, 0.2), movable=True, position=(0.0, 2.0, 0.2))
    scene.add_urdf(folder / "arm.urdf", name="arm", position=(0.0, -1.0, 0.5))
    scene.add_deformable("cloth", make_cloth(0.0), make_grid()[1], rgba=(0.2, 0.4, 1.0, 1.0))
    return scene


def main() -> None:
    recording, folder = Path(sys.argv[1]), Path(sys.argv[2])
    config = SessionConfig(control_port=0, state_port=0, record=recording, beacon_port=0)
    back = folder / "back"
    with ScenePublisher(build_scene(folder), config) as session, session.signals():
        print(f"session on {session.address}, recording to {session.recording}", flush=True)
        begun = time.monotonic()
        while not session.stopping:
            if back.exists():
                back.unlink()
                begun = time.monotonic()
            t = time.monotonic() - begun
            session.set_pose("ball", get_ball_position(t), rotate(t, 0))
            session.set_joints("arm", {"turn": get_joint_angle(t)})
            session.set_vertices("cloth", make_cloth(t))
            session.publish(t)
            time.sleep(1.0 / HZ)
        print(f"superseded {session.superseded}", flush=True)


if __name__ == "__main__":
    main()
