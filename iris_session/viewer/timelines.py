"""Times of what a recording shows: the timelines of the viewer, and how rows get their places on them."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from typing import Any, Final, NamedTuple

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from iris_session.rrd import paths
from iris_session.rrd.stream import duration_index, sequence_index

#: Number of newest states whose times are kept for rows that arrive later: 4 s at 60 Hz.
KNOWN_MOMENTS: Final = 256
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


def log_at(recording: rr.RecordingStream, moment: Moment, entity: str, *components: Any) -> None:
    """Log components of an entity at a moment."""
    set_moment(recording, moment)
    recording.log(entity, *components, strict=True)
    recording.reset_time()


def to_time_columns(times: NDArray[np.int64]) -> list[Any]:
    """Return the time columns. `times` (4, rows): the fields of `Moment`."""
    step, sim_ns, session_ns, wall_ns = times
    return [
        sequence_index(paths.STEP, step),
        duration_index(paths.SIM_TIME, sim_ns),
        duration_index(paths.SESSION_TIME, session_ns),
        rr.TimeColumn(paths.WALL_TIME, timestamp=np.ascontiguousarray(wall_ns).view("datetime64[ns]")),
    ]


class MomentTable:
    """Moments of the newest states, which give other rows their simulated time, and the places of rows.

    In an entity, Rerun's dataframes have one row per time. So rows of one entity and session time are shown 1 ns apart;
    exact times are in the data of the rows.

    Attributes:
        known: Moments of the newest states.
        origin_utc_ns: See `SessionHeader`.
    """

    def __init__(self) -> None:
        self.known: deque[Moment] = deque(maxlen=KNOWN_MOMENTS)
        self.origin_utc_ns = 0
        self._last: dict[str, int] = {}

    @property
    def newest(self) -> Moment:
        """Moment of the newest state; zero without any."""
        return self.known[-1] if self.known else self.make(0, 0, 0)

    def make(self, step: int, sim_ns: int, session_ns: int) -> Moment:
        """Return a moment with its wall-clock time."""
        return Moment(step, sim_ns, session_ns, session_ns + self.origin_utc_ns)

    def find(self, step: int, session_ns: int) -> Moment:
        """Return the moment of a step: the simulated time is that of the newest state before it."""
        at = max(0, bisect_right(self.known, session_ns, key=lambda moment: moment.session_ns) - 1)
        return self.make(step, self.known[at].sim_ns if self.known else 0, session_ns)

    def to_times(self, entity: str, places: Sequence[tuple[int, int]]) -> list[Any]:
        """Return the time columns of rows of an entity, given their steps and session times."""
        return self.spread(entity, [self.find(*place) for place in places])

    def spread(self, entity: str, moments: Sequence[Moment]) -> list[Any]:
        """Return the time columns of new rows of an entity, no two of which are equal."""
        times = np.array(moments, np.int64).T
        times[2] = [self.spread_one(entity, moment.session_ns) for moment in moments]
        times[3] = times[2] + self.origin_utc_ns
        return to_time_columns(times)

    def spread_one(self, entity: str, exact_ns: int) -> int:
        """Return the session time [ns] at which a new row of an entity is shown."""
        if len(self._last) >= MAX_ENTITIES and entity not in self._last:
            self._last.clear()
        last = self._last.get(entity, -SPREAD_NS)
        shown_ns = last + 1 if last - SPREAD_NS < exact_ns <= last else exact_ns
        self._last[entity] = max(last, shown_ns)
        return shown_ns
