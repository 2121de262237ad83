"""Names of entities, timelines and columns in the file: what the writer and the reader agree on."""

from __future__ import annotations

from typing import Final

APPLICATION: Final = "iris-session"

HEADER: Final = "/session/header"
INFO: Final = "/session"
ROWS: Final = "/journal/rows"
KEYFRAMES: Final = "/journal/keyframes"
MARKS: Final = "/journal/marks"
END: Final = "/journal/end"
STATE: Final = "/state"
SAMPLES: Final = "/samples"
EVENTS: Final = "/events"
DENIALS: Final = "/denials"
METRICS: Final = "/metrics"
SCENE: Final = "/scene"
PRESENCE: Final = "/presence"
TRANSFORMS: Final = "/tf"

STEP: Final = "step"
TICK: Final = "tick"
SIM_TIME: Final = "sim_time"
SESSION_TIME: Final = "session_time"


def part_path(path: str, part: int) -> str:
    """File of part `part` (1, 2, ...) of the recording `path`: `session.rrd`, `session.part2.rrd`."""
    if part == 1:
        return path
    stem, dot, suffix = path.rpartition(".")
    return f"{stem}.part{part}.{suffix}" if dot else f"{path}.part{part}"
