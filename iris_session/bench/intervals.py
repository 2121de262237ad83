"""Parts of a measured window that differ in what disturbs the clients, and the age of state within them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from iris_session.bench.report import compute_percentile

Log = dict[str, NDArray[Any]]
STALL_S: Final = 3.0
LEAD_S: Final = 0.5  # from the beginning of an interval to the stall
#: Shortest interval with a stall: the lead, the stall, and a second to recover.
SHORTEST_STALL_S: Final = LEAD_S + STALL_S + 1.0
#: A frame is fresh if it is at most this much older than the median of the client before the stall.
FRESH_MS: Final = 20.0


class Interval(NamedTuple):
    """A part of the window, in seconds from its beginning."""

    kind: str
    begin_s: float
    end_s: float

    @property
    def stall_s(self) -> float:
        return self.begin_s + LEAD_S

    @property
    def resume_s(self) -> float:
        return self.stall_s + STALL_S

    @property
    def length_s(self) -> float:
        return self.end_s - self.begin_s

    def contains(self, times_ns: NDArray[Any], begin_ns: int) -> NDArray[np.bool_]:
        """Return which session times lie within, in a window that begins at `begin_ns`."""
        return select_between(times_ns, begin_ns, self.begin_s, self.end_s)


def plan_intervals(kinds: Sequence[str], length_s: float, begin_s: float = 0.0) -> list[Interval]:
    """Return intervals of one length, one after the other."""
    return [Interval(kind, begin_s + i * length_s, begin_s + (i + 1) * length_s) for i, kind in enumerate(kinds)]


def plan_rounds(
    kinds: Sequence[str], seconds: float, rounds: int, shortest_s: float, lead_s: float = 0.0
) -> list[Interval]:
    """Return rounds of the kinds in turn that fill the seconds after the lead: as many as fit, 1 to `rounds`."""
    rounds = max(1, min(rounds, int((seconds - lead_s) / (len(kinds) * shortest_s))))
    length_s = max(shortest_s, (seconds - lead_s) / (len(kinds) * rounds))
    return plan_intervals(list(kinds) * rounds, length_s, lead_s)


def select_between(times_ns: NDArray[Any], begin_ns: int, from_s: float, to_s: float) -> NDArray[np.bool_]:
    """Return which session times lie between two times [s] of a window that begins at `begin_ns`."""
    return np.asarray((times_ns - begin_ns >= from_s * 1e9) & (times_ns - begin_ns < to_s * 1e9))


def compute_age_p99_ms(logs: Iterable[Log], begin_ns: int, from_s: float, to_s: float) -> float:
    """Return the 99th percentile of the age of state when it was handed to applications between two times of a window
    [ms], infinite where none was."""
    ages = [
        (log["handed_ns"] - log["state_ns"])[select_between(log["handed_ns"], begin_ns, from_s, to_s)] for log in logs
    ]
    return compute_percentile(np.concatenate(ages) * 1e-6, 99)


def measure_after_stall(log: Log, begin_ns: int, interval: Interval, resumed_ns: int) -> tuple[float, float]:
    """Return the age of the first frame after the stall, and the time from its end to the first fresh frame [ms].

    Infinite if no frame arrived within the interval.
    """
    handed, ages = log["handed_ns"], log["handed_ns"] - log["state_ns"]
    before = select_between(handed, begin_ns, interval.begin_s, interval.stall_s)
    usual_ns = float(np.median(ages[before])) if before.any() else 0.0
    after = (handed >= resumed_ns) & (handed < begin_ns + interval.end_s * 1e9)
    if not after.any():
        return float("inf"), float("inf")
    fresh = after & (ages <= usual_ns + FRESH_MS * 1e6)
    first_ms = float(ages[after][0]) * 1e-6
    return first_ms, float(handed[fresh][0] - resumed_ns) * 1e-6 if fresh.any() else float("inf")


def summarize_stalls(
    log: Log, begin_ns: int, resumed: dict[Interval, int], kind: str, prefix: str = ""
) -> dict[str, float]:
    """Return the worst of `measure_after_stall` over the stalls of a kind. `resumed`: session times of their ends."""
    after = [measure_after_stall(log, begin_ns, one, at_ns) for one, at_ns in resumed.items() if one.kind == kind]
    names = ("resume_first_age_ms", "resume_fresh_after_ms")
    return {f"{prefix}{name}": round(max(v), 3) for name, v in zip(names, zip(*after, strict=True), strict=True)}


def summarize_runs(key: str, values: Sequence[float]) -> dict[str, Any]:
    """Return the median of the runs of a kind of interval, and the runs by number."""
    runs = {str(i + 1): round(value, 3) for i, value in enumerate(values)}
    return {key: round(float(np.median(values)), 3), f"{key}_runs": runs}
