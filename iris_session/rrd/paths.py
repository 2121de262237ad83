"""Names of entities and timelines in the file, and of the files of a recording, shared by writer and reader."""

from __future__ import annotations

import re
from typing import Final

APPLICATION: Final = "iris-session"
#: Name of the first file of a session in its folder.
FIRST_FILE: Final = "session.rrd"
SUFFIX: Final = ".rrd"
#: Ending of copies for the viewer, see `recording/viewer_export.py`. They lie beside recordings and are none.
VIEW_SUFFIX: Final = ".view.rrd"

HEADER: Final = "/session/header"
#: The header without the model, for files whose header is damaged.
HEADER_COPY: Final = "/session/header/copy"
INFO: Final = "/session"
ROWS: Final = "/journal/rows"
KEYFRAMES: Final = "/journal/keyframes"
MODELS: Final = "/journal/models"
MARKS: Final = "/journal/marks"
END: Final = "/journal/end"
STATE: Final = "/state"
#: Entities of the bodies in the order of the poses in `/state`, empty for those that do not move.
STATE_ENTITIES: Final = "/state/entities"
SAMPLES: Final = "/samples"
EVENTS: Final = "/events"
DENIALS: Final = "/denials"
METRICS: Final = "/metrics"
SCENE: Final = "/scene"
PRESENCE: Final = "/presence"
#: States over time: holders, clutches, e-stop, episodes.
LANES: Final = "/lanes"
#: Labels of robots.
ROBOTS: Final = "/robots"
ANCHORS: Final = "/anchors"
#: Point clouds and pictures of cameras, an entity per stream.
CLOUDS: Final = "/clouds"
PICTURES: Final = "/pictures"
#: Their descriptions.
STREAMS: Final = "/streams"
#: What clients draw the scenes of: the scenes, pieces of their assets, and assets that could not be recorded.
ASSET_SCENES: Final = "/assets/scenes"
ASSETS: Final = "/assets/data"
ASSET_FAULTS: Final = "/assets/faults"

STEP: Final = "step"
SIM_TIME: Final = "sim_time"
SESSION_TIME: Final = "session_time"
WALL_TIME: Final = "wall_time"


def split_part(path: str) -> tuple[str, int]:
    """Split a path made by `part_path` into the path of the first file and the number of the part."""
    return _split_number(path, "part")


def part_path(path: str, part: int) -> str:
    """Return the file of part `part` (1, 2, ...) of the recording `path`: `session.rrd`, `session.part2.rrd`."""
    return _add_number(path, "part", part)


def split_resume(path: str) -> tuple[str, int]:
    """Split a path made by `resume_path` into the first file of the session and the number of the recording."""
    return _split_number(path, "resume")


def resume_path(path: str, number: int) -> str:
    """Return the first file of the `number`-th recording of a session that began with `path`: `session.resume2.rrd`."""
    return _add_number(path, "resume", number)


def _split_number(path: str, kind: str) -> tuple[str, int]:
    found = re.fullmatch(rf"(.*)\.{kind}([1-9][0-9]*)(\.[^./]*)?", path, re.DOTALL)
    return (found[1] + (found[3] or ""), int(found[2])) if found else (path, 1)


def _add_number(path: str, kind: str, number: int) -> str:
    if number == 1:
        return path
    stem, dot, suffix = path.rpartition(".")
    return f"{stem}.{kind}{number}.{suffix}" if dot else f"{path}.{kind}{number}"


def view_path(path: str) -> str:
    """Return the copy for the viewer of the session whose first file is `path`: `session.view.rrd`."""
    return path.removesuffix(SUFFIX) + VIEW_SUFFIX


def is_view_copy(path: str) -> bool:
    """Return whether a file is a copy for the viewer, by its name."""
    return path.endswith(VIEW_SUFFIX)
