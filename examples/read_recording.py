"""Reads a recording back: who was there, what happened, how far each free object travelled.

python examples/read_recording.py sessions/*/session.rrd
"""

from __future__ import annotations

import sys

import numpy as np

from iris_session.recording import Recording


def main(path: str) -> None:
    with Recording.open(path) as recording:
        header = recording.header
        print(f"{header.session_name}, {header.created_utc}, class {header.recording_class}")
        print(f"robots: {', '.join(robot.name for robot in header.robots)}")
        kinds: dict[str, int] = {}
        for event in recording.events():
            name = type(event.body).__name__
            kinds[name] = kinds.get(name, 0) + 1
        print("events:", ", ".join(f"{n} {name}" for name, n in sorted(kinds.items())))
        rows = {body.name: i for i, body in enumerate(header.bodies)}
        poses = np.array([state.poses for state in recording.states()])  # (frames, bodies, 7), exact float64
        for spec in header.objects:
            path_m = np.linalg.norm(np.diff(poses[:, rows[spec.body], :3], axis=0), axis=1).sum()
            print(f"{spec.name}: {len(poses)} frames, travelled {path_m:.2f} m")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/read_recording.py FILE    (a session.rrd that serve or demo wrote)")
    main(sys.argv[1])
