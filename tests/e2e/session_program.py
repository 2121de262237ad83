"""Sessions as a lab's own programs run them, one kind each. A program, not a test.

python session_program.py HOST assets FOLDER ADDRESS...      serves assets of its own
python session_program.py HOST media HZ BYTES                publishes the media stream `cloud`
python session_program.py HOST scenes RECORDING FOLDER       loads or patches a scene when its file appears in FOLDER
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import mujoco

from iris_session import Session, SessionConfig
from iris_session.demo.scenes import n_arms_scene, scene_path
from iris_session.link.front_process import FrontProcess
from iris_session.protocol.common import Pose
from iris_session.protocol.scene import AddVisual, Geometry, SetVisual, Visual

RED = (1.0, 0.0, 0.0, 1.0)


def make_config(record: bool | Path = False) -> SessionConfig:
    return SessionConfig(host=sys.argv[1], control_port=0, state_port=0, beacon_port=0, record=record)


def serve_assets(root: str, *addresses: str) -> None:
    begin = FrontProcess.__init__

    def with_assets(self: FrontProcess, config: object, scene: object) -> None:
        begin(self, config, msgspec.structs.replace(scene, asset_root=root, assets=addresses))  # type: ignore

    FrontProcess.__init__ = with_assets  # type: ignore[method-assign,assignment]
    with Session(scene_path("handover"), config=make_config()) as session:
        print(f"on {session.address}, recording to nothing", flush=True)
        session.run()


def publish_media(hz: str, size: str) -> None:
    with Session(scene_path("handover"), config=make_config()) as session:
        frame = bytes(int(size))

        def publish() -> None:
            while not session.stopping:
                session.publish_media("cloud", frame)
                time.sleep(1.0 / float(hz))

        thread = threading.Thread(target=publish)
        thread.start()
        print(f"on {session.address}, recording to nothing", flush=True)
        session.run()
        thread.join()


def compile_scene(timestep: float, n_arms: int, objects: int = 0) -> mujoco.MjModel:
    """Compile a scene of some arms. The first scene of the session has a timestep of 2 ms."""
    spec = n_arms_scene(n_arms, objects=objects)
    spec.option.timestep = timestep
    return spec.compile()


SCENES: dict[str, Callable[[], Any]] = {
    "table": lambda: compile_scene(0.001, 2, 3),
    "three": lambda: compile_scene(0.004, 3),
    "slow": lambda: compile_scene(0.25, 2),
    "missing": lambda: "no/such/scene.xml",
}


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
        for name, make in SCENES.items():
            if (Path(folder) / name).exists():
                (Path(folder) / name).unlink()
                pending.append(session.load_scene(make()))
        if (Path(folder) / "patch").exists():
            (Path(folder) / "patch").unlink()
            patch(session)
            print("patched", flush=True)
        for future in [future for future in pending if future.done()]:
            pending.remove(future)
            error = future.exception()
            print("loaded" if error is None else f"{type(error).__name__}: {error}", flush=True)

    with Session(str(scene_path("handover")), config=make_config(Path(recording))) as session:
        print(f"session on {session.address}, recording to {session.recording}", flush=True)
        session.run(until=poll)


if __name__ == "__main__":
    programs: dict[str, Callable[..., None]] = {
        "assets": serve_assets,
        "media": publish_media,
        "scenes": change_scenes,
    }
    programs[sys.argv[2]](*sys.argv[3:])
