"""Share a MuJoCo script that already exists: one line, the script keeps its loop.

    python examples/share_a_script.py            then, elsewhere: iris-session emulate --behaviour wander

The recording is of class `open`: physics belongs to the script.
"""

from __future__ import annotations

import sys
import time

import mujoco

import iris_session


def main(seconds: float) -> None:
    model = mujoco.MjModel.from_xml_path(str(iris_session.scene_path("handover")))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    session = iris_session.share(model, data)  # the one line
    print(f"join at {session.address}", flush=True)
    begun = time.monotonic()
    while data.time < seconds:
        mujoco.mj_step(model, data)
        time.sleep(max(0.0, begun + data.time - time.monotonic()))  # the script paces itself, as before
    print(f"{data.time:.1f} s simulated, recorded to {session.recording}")
    session.close()


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
