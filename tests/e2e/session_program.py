"""A session as a lab's own program runs it, which changes its scene. A program, not a test.

python session_program.py HOST RECORDING FOLDER      loads a scene when FOLDER has a file `table`, patches it by `patch`
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import mujoco

from iris_session import Session, SessionConfig
from iris_session.demo.scenes import n_arms_scene, scene_path
from iris_session.protocol.common import Pose
from iris_session.protocol.scene import AddVisual, Geometry, SetVisual, Visual

RED = (1.0, 0.0, 0.0, 1.0)


def compile_table() -> mujoco.MjModel:
    """Compile the scene after the first one."""
    spec = n_arms_scene(2, objects=3)
    spec.option.timestep = 0.001
    return spec.compile()


def patch(session: Session) -> None:
    """Make everything red, and add a lamp above the table."""
    assert session.scene is not None
    spec = session.scene
    number = max(visual.id for visual in spec.visuals) + 1
    geometry = Geometry("sphere", (0.1, 0.1, 0.1))
    lamp = Visual(number, 0, "lamp", Pose((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0)), 0, geometry, -1, RED)
    session.patch_scene(*(SetVisual(visual.id, rgba=RED) for visual in spec.visuals[:60]))
    session.patch_scene(AddVisual(lamp))


def change_scenes(recording: str, folder: str) -> None:
    pending: list[Any] = []

    def poll() -> None:
        if (Path(folder) / "table").exists():
            (Path(folder) / "table").unlink()
            pending.append(session.load_scene(compile_table()))
        if (Path(folder) / "patch").exists():
            (Path(folder) / "patch").unlink()
            patch(session)
            print("patched", flush=True)
        for future in [future for future in pending if future.done()]:
            pending.remove(future)
            error = future.exception()
            print("loaded" if error is None else f"{type(error).__name__}: {error}", flush=True)

    config = SessionConfig(host=sys.argv[1], control_port=0, state_port=0, beacon_port=0, record=Path(recording))
    with Session(str(scene_path("handover")), config=config) as session:
        print(f"session on {session.address}, recording to {session.recording}", flush=True)
        session.run(until=poll)


if __name__ == "__main__":
    change_scenes(*sys.argv[2:])
