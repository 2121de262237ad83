"""Sessions as a lab's own programs run them, one kind each. A program, not a test.

python session_program.py HOST assets FOLDER ADDRESS...      serves assets of its own
python session_program.py HOST media HZ BYTES                publishes the media stream `cloud`
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from iris_session import Session, SessionConfig
from iris_session.demo.scenes import scene_path
from iris_session.link.front_process import FrontProcess


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


if __name__ == "__main__":
    programs: dict[str, Callable[..., None]] = {
        "assets": serve_assets,
        "media": publish_media,
    }
    programs[sys.argv[2]](*sys.argv[3:])
