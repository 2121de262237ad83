"""A session that loads or paints a scene when a file with that name appears: what a lab's own program would do.

python scene_server.py RECORDING FOLDER
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco

from iris_session import Session, SessionConfig
from iris_session.demo.scenes import n_arms_scene, scene_path
from iris_session.protocol.common import Pose
from iris_session.protocol.scene import AddVisual, Geometry, SetVisual, Visual

RED = (1.0, 0.0, 0.0, 1.0)


def with_timestep(timestep: float, n_arms: int, objects: int = 0) -> mujoco.MjModel:
    """The first scene of the session has 2 ms."""
    spec = n_arms_scene(n_arms, objects=objects)
    spec.option.timestep = timestep
    return spec.compile()


SCENES: dict[str, Callable[[], Any]] = {
    "table": lambda: with_timestep(0.001, 2, 3),
    "three": lambda: with_timestep(0.004, 3),
    "slow": lambda: with_timestep(0.25, 2),
    "missing": lambda: "no/such/scene.xml",
}


def paint(session: Session) -> None:
    """Everything red, and a lamp above the table."""
    assert session.scene is not None
    spec = session.scene
    number = max(visual.id for visual in spec.visuals) + 1
    geometry = Geometry("sphere", (0.1, 0.1, 0.1))
    lamp = Visual(number, 0, "lamp", Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)), 0, geometry, -1, RED)
    session.patch_scene(*(SetVisual(visual.id, rgba=RED) for visual in spec.visuals[:60]))
    session.patch_scene(AddVisual(lamp))


def main() -> None:
    recording, folder = Path(sys.argv[1]), Path(sys.argv[2])
    config = SessionConfig(control_port=0, state_port=0, record=recording, beacon_port=0)
    pending: list[Any] = []

    def look() -> None:
        for name, make in SCENES.items():
            if (folder / name).exists():
                (folder / name).unlink()
                pending.append(session.load_scene(make()))
        if (folder / "paint").exists():
            (folder / "paint").unlink()
            paint(session)
            print("painted", flush=True)
        for future in [future for future in pending if future.done()]:
            pending.remove(future)
            error = future.exception()
            print("loaded" if error is None else f"{type(error).__name__}: {error}", flush=True)

    with Session(str(scene_path("handover")), config=config) as session:
        print(f"session on {session.address}, recording to {session.recording}", flush=True)
        session.run(until=look)


if __name__ == "__main__":
    main()
