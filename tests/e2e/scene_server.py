"""A session that loads another scene whenever a file named after one appears: what a lab's own program would do.

python scene_server.py RECORDING FOLDER
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco

from iris_session import Session, SessionConfig
from iris_session.physics.scenes import n_arms_scene, scene_path


def slow() -> mujoco.MjModel:
    """A scene with another timestep."""
    spec = n_arms_scene(2)
    spec.option.timestep = 0.004
    return spec.compile()


SCENES: dict[str, Callable[[], Any]] = {
    "table": lambda: n_arms_scene(2, objects=3).compile(),
    "three": lambda: n_arms_scene(3).compile(),
    "slow": slow,
    "missing": lambda: "no/such/scene.xml",
}


def main() -> None:
    recording, folder = Path(sys.argv[1]), Path(sys.argv[2])
    config = SessionConfig(control_port=0, state_port=0, record=recording, beacon_port=0)
    pending: list[Any] = []

    def look() -> None:
        for name, make in SCENES.items():
            if (folder / name).exists():
                (folder / name).unlink()
                pending.append(session.load_scene(make()))
        for future in [future for future in pending if future.done()]:
            pending.remove(future)
            error = future.exception()
            print("loaded" if error is None else f"{type(error).__name__}: {error}", flush=True)

    with Session(str(scene_path("handover")), config=config) as session:
        print(f"session on {session.address}, recording to {session.recording}", flush=True)
        session.run(until=look)


if __name__ == "__main__":
    main()
