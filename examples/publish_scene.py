"""Publish a simulation that is not MuJoCo: a double pendulum and a cloth in the wind, both in numpy.

A part from a file is shown beside them.

python examples/publish_scene.py [SECONDS] [PART.glb]        then join at the address it prints
"""

from __future__ import annotations

import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from iris_session import SceneBuilder, ScenePublisher, SessionConfig

Array = NDArray[np.float64]
G = 9.81  # m/s^2
HZ = 60
STEPS = 10  # of the simulations per published state
HALF = 0.25  # half a link of the pendulum [m]
SIDE, ROWS = 1.0, 20  # of the cloth: [m], vertices
MASS, STIFFNESS = 0.3 / ROWS**2, 100.0  # of a vertex [kg], of a thread between two [N/m]
WIND = np.array([0.0, 0.0015, 0.0])  # on a vertex [N]
TETRAHEDRON = "OFF\n4 4 0\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"


class Pendulum:
    """Two equal links of 2 * HALF with their masses at their ends."""

    def __init__(self) -> None:
        self.state = np.array([2.0, 2.5, 0.0, 0.0])  # two angles from hanging [rad], their velocities

    def step(self, dt: float) -> None:
        k1 = self._rate(self.state)
        k2 = self._rate(self.state + 0.5 * dt * k1)
        k3 = self._rate(self.state + 0.5 * dt * k2)
        k4 = self._rate(self.state + dt * k3)
        self.state = self.state + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)

    @staticmethod
    def _rate(state: Array) -> Array:
        a, b, va, vb = state
        length, sine, cosine = 2.0 * HALF, np.sin(a - b), np.cos(a - b)
        mass = np.array([[2.0, cosine], [cosine, 1.0]]) * length
        force = np.array([-vb * vb * length * sine - 2.0 * G * np.sin(a), va * va * length * sine - G * np.sin(b)])
        return np.concatenate([(va, vb), np.linalg.solve(mass, force)])

    def poses(self, pivot: Array) -> list[tuple[Array, Array]]:
        """Return T_world_link of both, as position and quaternion (w, x, y, z)."""
        found, top = [], pivot
        for angle in self.state[:2]:
            down = np.array([np.sin(angle), 0.0, -np.cos(angle)])
            found.append((top + HALF * down, np.array([np.cos(angle / 2), 0.0, -np.sin(angle / 2), 0.0])))
            top = top + 2.0 * HALF * down
        return found


class Cloth:
    """Vertices of equal mass, joined by threads along, across and diagonally, that hang from the first row."""

    def __init__(self) -> None:
        side = np.linspace(0.0, SIDE, ROWS)
        x, z = np.meshgrid(side, 2.0 - side)
        self.p = np.stack([x.ravel(), np.full(ROWS**2, 1.5), z.ravel()], axis=-1)
        self.v = np.zeros_like(self.p)
        n = np.arange(ROWS**2).reshape(ROWS, ROWS)
        a, b, c, d = n[:-1, :-1].ravel(), n[:-1, 1:].ravel(), n[1:, 1:].ravel(), n[1:, :-1].ravel()
        self.triangles = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
        along, across = np.stack([n[:, :-1].ravel(), n[:, 1:].ravel()]), np.stack([n[:-1].ravel(), n[1:].ravel()])
        self.ends = np.concatenate([along, across, np.stack([a, c]), np.stack([b, d])], axis=1)
        self.rest = np.linalg.norm(self.p[self.ends[1]] - self.p[self.ends[0]], axis=1)

    def step(self, dt: float, t: float) -> None:
        thread = self.p[self.ends[1]] - self.p[self.ends[0]]
        length = np.linalg.norm(thread, axis=1)
        pull = (STIFFNESS * (1.0 - self.rest / length))[:, None] * thread
        force = np.tile(WIND * (1.0 + np.sin(3.0 * t)), (len(self.p), 1))
        force[:, 2] -= MASS * G
        np.add.at(force, self.ends[0], pull)
        np.add.at(force, self.ends[1], -pull)
        self.v = (self.v + dt / MASS * force) * np.exp(-1.5 * dt)
        self.v[:ROWS] = 0.0
        self.p = self.p + dt * self.v


def compose(part: Path, cloth: Cloth) -> SceneBuilder:
    scene = SceneBuilder("pendulum and cloth")
    scene.add_plane("floor", half_size=(3.0, 3.0), rgba=(0.5, 0.5, 0.5, 1.0))
    scene.add_file(part, name="part", position=(-1.0, 1.0, 0.0))
    for link, color in (("upper", (0.9, 0.3, 0.1, 1.0)), ("lower", (0.1, 0.5, 0.9, 1.0))):
        scene.add_capsule(link, radius=0.03, half_length=HALF, movable=True, rgba=color)
    scene.add_deformable("cloth", cloth.p, cloth.triangles, rgba=(0.9, 0.9, 0.7, 1.0))
    return scene


def main(seconds: float, part: Path) -> None:
    pendulum, cloth = Pendulum(), Cloth()
    config = SessionConfig(name="pendulum", record=False)
    with ScenePublisher(compose(part, cloth), config) as session, session.signals():
        print(f"join at {session.address}", flush=True)
        begun, t = time.monotonic(), 0.0
        while t < seconds and not session.stopping:
            for _ in range(STEPS):
                t += 1.0 / (HZ * STEPS)
                pendulum.step(1.0 / (HZ * STEPS))
                cloth.step(1.0 / (HZ * STEPS), t)
            for link, pose in zip(("upper", "lower"), pendulum.poses(np.array([-0.5, 0.0, 1.5])), strict=True):
                session.set_pose(link, *pose)
            session.set_vertices("cloth", cloth.p)
            session.publish(t)  # all of it is one state, that of time t
            time.sleep(max(0.0, begun + t - time.monotonic()))
        print(f"published {t:.1f} s; {session.superseded} states were superseded by newer ones")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        own = Path(folder) / "part.off"
        own.write_text(TETRAHEDRON)
        main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0, Path(sys.argv[2]) if len(sys.argv) > 2 else own)
