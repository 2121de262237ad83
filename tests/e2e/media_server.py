"""A session that publishes one media stream: `python media_server.py HZ BYTES`. A program of its own, not a test."""

from __future__ import annotations

import sys
import threading
import time

from iris_session import Session, SessionConfig
from iris_session.demo.scenes import scene_path


def main() -> None:
    hz, size = float(sys.argv[1]), int(sys.argv[2])
    config = SessionConfig(control_port=0, state_port=0, beacon_port=0, record=False)
    with Session(scene_path("handover"), config=config) as session:
        frame = bytes(size)

        def publish() -> None:
            while not session.stopping:
                session.publish_media("cloud", frame)
                time.sleep(1.0 / hz)

        thread = threading.Thread(target=publish)
        thread.start()
        print(f"on {session.address}, recording to nothing", flush=True)
        session.run()
        thread.join()


if __name__ == "__main__":
    main()
