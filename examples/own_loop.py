"""Keep your own loop and mark its ticks: clients see exactly the states that `mj_step` computed.

python examples/own_loop.py            then, elsewhere: iris-session emulate --behaviour wander
"""

from __future__ import annotations

import sys
import time

import mujoco

from iris_session import Session, SessionConfig, scene_path


def main(seconds: float) -> None:
    model = mujoco.MjModel.from_xml_path(str(scene_path("handover")))
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    with Session(model, data, SessionConfig(name="own-loop", record=False)) as session:
        print(f"join at {session.address}", flush=True)
        begun = time.monotonic()
        while data.time < seconds:
            session.begin_tick()  # writes data.ctrl of the robots that participants drive
            mujoco.mj_step(model, data)
            session.end_tick()  # publishes the new state
            time.sleep(max(0.0, begun + data.time - time.monotonic()))
        for person in session.status().participants:
            print(f"{person.name} ({person.role}) drives {', '.join(person.holds) or 'nothing'}")


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 60.0)
