"""Times of what a recording shows: the timelines of the viewer, and how rows get their places on them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from iris_session.recording import paths
from iris_session.recording.rrd_stream import duration_index, sequence_index

#: Rows that are so much earlier than the newest one of their entity are in no row of others [ns].
SPREAD_NS: Final = 100_000
#: Maximum number of entities whose newest time is known.
MAX_ENTITIES: Final = 4096


class Moment(NamedTuple):
    """A place on all timelines.

    `sim_ns`: simulated time since the session began, resets included [ns]. `session_ns`: session time [ns]. `wall_ns`:
    the same since 1970-01-01 UTC [ns].
    """

    step: int
    sim_ns: int
    session_ns: int
    wall_ns: int


def set_moment(recording: rr.RecordingStream, moment: Moment) -> None:
    """Set the times of what is logged next, on all timelines."""
    recording.set_time(paths.STEP, sequence=moment.step)
    recording.set_time(paths.SIM_TIME, duration=np.timedelta64(moment.sim_ns, "ns"))
    recording.set_time(paths.SESSION_TIME, duration=np.timedelta64(moment.session_ns, "ns"))
    recording.set_time(paths.WALL_TIME, timestamp=np.datetime64(moment.wall_ns, "ns"))


def get_session_time(moment: Moment) -> int:
    """Return the session time of a moment [ns]."""
    return moment.session_ns


def to_time_columns(times: NDArray[np.int64]) -> list[Any]:
    """Return the time columns. `times` (4, rows): the fields of `Moment`."""
    step, sim_ns, session_ns, wall_ns = times
    return [
        sequence_index(paths.STEP, step),
        duration_index(paths.SIM_TIME, sim_ns),
        duration_index(paths.SESSION_TIME, session_ns),
        rr.TimeColumn(paths.WALL_TIME, timestamp=np.ascontiguousarray(wall_ns).view("datetime64[ns]")),
    ]


class UniqueTimes:
    """Times of rows that may come at one time: in an entity, Rerun's dataframes have one row per time.

    Rows of one entity and session time are shown 1 ns apart. Exact times are in the data of the rows.
    """

    def __init__(self) -> None:
        self._last: dict[str, int] = {}

    def spread(self, entity: str, session_times: Sequence[int]) -> list[int]:
        """Return the session times [ns] of new rows of an entity, no two of which are equal."""
        if len(self._last) >= MAX_ENTITIES:
            self._last.clear()
        last = self._last.get(entity, -SPREAD_NS)
        spread = []
        for exact_ns in session_times:
            shown_ns = last + 1 if last - SPREAD_NS < exact_ns <= last else exact_ns
            last = max(last, shown_ns)
            spread.append(shown_ns)
        self._last[entity] = last
        return spread
