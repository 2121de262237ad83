"""A session that serves assets of its own: `python asset_server.py FOLDER ADDRESS...`. A program, not a test."""

from __future__ import annotations

import sys

import msgspec

from iris_session import Session, SessionConfig
from iris_session.demo.scenes import scene_path
from iris_session.link.front_process import FrontProcess


def main() -> None:
    root, addresses = sys.argv[1], tuple(sys.argv[2:])
    begin = FrontProcess.__init__

    def with_assets(self: FrontProcess, config: object, scene: object) -> None:
        begin(self, config, msgspec.structs.replace(scene, asset_root=root, assets=addresses))  # type: ignore

    FrontProcess.__init__ = with_assets  # type: ignore[method-assign,assignment]
    config = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False)
    with Session(scene_path("handover"), config=config) as session:
        print(f"on {session.address}, recording to nothing", flush=True)
        session.run()


if __name__ == "__main__":
    main()
