"""Read a recording: participants, events, and the distance that every body travelled.

python examples/read_recording.py sessions/*/session.rrd
"""

from __future__ import annotations

import sys
from collections import Counter
from itertools import groupby

import numpy as np

from iris_session import ParticipantJoined, Recording


def main(path: str) -> None:
    with Recording.open(path) as recording:
        header = recording.header
        print(f"{header.session_name}, {header.created_utc}, class {header.recording_class}")
        print(f"robots: {', '.join(robot.name for robot in header.robots) or 'none'}")
        events = [event.body for event in recording.events()]
        people = {body.participant.name for body in events if isinstance(body, ParticipantJoined)}
        print(f"people: {', '.join(sorted(people)) or 'none'}")
        kinds = Counter(type(body).__name__ for body in events)
        print("events:", ", ".join(f"{n} {name}" for name, n in sorted(kinds.items())) or "none")
        # Scenes have different bodies, so each state names those of its poses.
        for bodies, states in groupby(recording.states(), key=lambda state: state.bodies):
            poses = np.array([state.poses for state in states])  # (frames, bodies, 7), exact float64
            path_m = np.linalg.norm(np.diff(poses[:, :, :3], axis=0), axis=2).sum(axis=0)
            for body, travelled_m in zip(bodies, path_m, strict=True):
                if body.moving:
                    print(f"{body.name}: {len(poses)} frames, travelled {travelled_m:.2f} m")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit("usage: python examples/read_recording.py FILE    (a session.rrd that serve or demo wrote)")
    main(sys.argv[1])
