"""How much media each client gets: a class per stream, lowered when its link suffers. Pure: no clock, no sockets.

What suffers first on a crowded link is the age of state, because media and state share one way. So the judge is what
a client reports of its state, beside what its media connection does not take. Lowering is quick and aims below what
came through; rising is one step at a time, and after every step that had to be taken back the next waits longer.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from iris_session.protocol.media import CLASSES

MILLISECOND: Final = 1_000_000
SECOND: Final = 1_000_000_000
#: Index of `BudgetClass.NONE`.
NOTHING: Final = len(CLASSES) - 1

#: State that is so much older than it was at its best counts as late [ms], and half of that best beside it. A single
#: large frame of media before it makes state tens of milliseconds older, which is no reason yet.
RISE_MS: Final = 80.0
#: More frames of state are missed than at best, by this share. Frames that come together behind a large one of media
#: count as missed too, but for the newest.
RISE_MISSED: Final = 0.6
#: Reports among which the best is looked for: a minute.
REMEMBERED: Final = 60
#: Share of due frames that a connection did not take, in two measures in a row, that says that the link is full.
BLOCKED: Final = 0.25
#: After a change what is under way still has to come through.
SETTLE_NS: Final = 500 * MILLISECOND
#: Reports do not count for so long after less was given: a queue on the way has to drain, beside the media that are
#: left, and a report covers the second before it.
DRAIN_NS: Final = 2600 * MILLISECOND
SILENT_NS: Final = 3 * SECOND
#: Share of what came through that is asked for after it was too much.
LESS: Final = 0.7
#: What was given may grow so much before it is more than was asked for (rates are measured, and vary), and how much
#: more than its own limit a client gets at most.
SLACK: Final = 1.5
LIMIT_SLACK: Final = 1.15
#: Distance of steps up. To what has failed it doubles each time, until that works.
CLIMB_NS: Final = 3 * SECOND
CLIMB_MAX_NS: Final = 48 * SECOND
#: Rates are measured, and vary: what costs so much of what has failed is that again.
SAME: Final = 0.8
#: Trouble this soon after a step up is blamed on it; without any it has worked.
PROBE_NS: Final = 3 * SECOND
#: Without any media, trouble that stays so long has other causes: it is how this link is now.
RELEARN_NS: Final = 5 * SECOND

#: Bytes per second of every stream at full, half, quarter: what a client would be sent.
Rates = Mapping[str, Sequence[float]]


class StateReport(NamedTuple):
    """What a client says of its state. `age_ms`: median, 0 when none came."""

    age_ms: float
    missed_share: float


class LinkMeasure(NamedTuple):
    """One look at a client. `report`: its newest, `None` without a new one since the last look. `taken`, `due`: media
    frames that its connection took, of those that were due, since then. `limit`: bytes per second that it wants at
    most, 0 for no limit."""

    report: StateReport | None
    delivered: int = 0
    due: int = 0
    limit: float = 0.0


class BudgetGrant(NamedTuple):
    """`levels`: index into `CLASSES` by stream. `bytes_per_s`: bound of all together, 0 for none."""

    levels: dict[str, int]
    bytes_per_s: float = 0.0
    reason: str = ""


def compute_cost(rates: Rates, levels: Mapping[str, int]) -> float:
    """Bytes per second of all streams at these levels. A coarser class never counts more than a finer one."""
    return sum(_level_rate(rates[stream], levels.get(stream, 0)) for stream in sorted(rates))


def build_ladder(rates: Rates) -> list[dict[str, int]]:
    """From everything to nothing: each step lowers the stream that costs the most."""
    levels = dict.fromkeys(sorted(rates), 0)
    steps = [dict(levels)]
    while any(level < NOTHING for level in levels.values()):
        lowest = max(
            (stream for stream in levels if levels[stream] < NOTHING),
            key=lambda stream: (_level_rate(rates[stream], levels[stream]), -levels[stream], stream),
        )
        levels[lowest] += 1
        steps.append(dict(levels))
    return steps


def select_levels(rates: Rates, bytes_per_s: float) -> dict[str, int]:
    """The first rung of the ladder that costs no more than that; nothing at all for no budget."""
    steps = build_ladder(rates)
    if bytes_per_s <= 0.0:
        return steps[-1]
    return next(levels for levels in steps if compute_cost(rates, levels) <= bytes_per_s)


def _level_rate(rates: Sequence[float], level: int) -> float:
    return 0.0 if level >= NOTHING else min(rates[: level + 1])


class _ClientBudget:
    """What is remembered of one client."""

    def __init__(self) -> None:
        self.levels: dict[str, int] = {}
        self.budget = math.inf
        self.reason = ""
        self.ages: deque[float] = deque(maxlen=REMEMBERED)
        self.missed: deque[float] = deque(maxlen=REMEMBERED)
        self.reported_ns = -1
        self.late = ""  # what the newest report says against us
        self.blocked = 0  # measures in a row
        self.sent = 1.0  # share of what was due that was taken lately
        self.changed_ns = self.lowered_ns = self.climbed_ns = self.troubled_ns = -SILENT_NS
        self.climb_ns = CLIMB_NS
        self.failed = math.inf  # what a step up cost that had to be taken back
        self.innocent_ns = -1  # since when there is trouble without any media


class BudgetController:
    """All clients of a session. `update` is called a few times a second for each."""

    def __init__(self) -> None:
        self._clients: dict[int, _ClientBudget] = {}

    def remove(self, client: int) -> None:
        """A client is gone."""
        self._clients.pop(client, None)

    def update(self, client: int, measure: LinkMeasure, rates: Rates, now_ns: int) -> BudgetGrant:
        """What a client gets of the streams in `rates`, those that it wants. `now_ns` must not go back."""
        line = self._clients.get(client)
        if line is None:
            line = self._clients[client] = _ClientBudget()
        limit = measure.limit or math.inf
        self._sync_streams(line, rates)
        trouble = self._find_trouble(line, measure, now_ns)
        present = compute_cost(rates, line.levels)
        if trouble:
            line.troubled_ns = now_ns
        if trouble and present > 0.0:
            line.innocent_ns = -1
            self._lower_levels(line, rates, LESS * present * line.sent, trouble, now_ns)
        elif trouble:
            self._relearn_best(line, now_ns)
        else:
            line.innocent_ns = -1
            self._raise_levels(line, rates, limit, now_ns)
        allowed = min(line.budget, limit)
        if compute_cost(rates, line.levels) > min(SLACK * line.budget, LIMIT_SLACK * limit):
            line.levels = select_levels(rates, allowed)
            line.reason = line.reason if line.budget <= limit else "the client asked for no more"
        bound = 0.0 if math.isinf(allowed) else allowed
        return BudgetGrant(dict(line.levels), bound, line.reason if bound or any(line.levels.values()) else "")

    # --- what is wrong -----------------------------------------------------------------------------------------------

    def _find_trouble(self, line: _ClientBudget, measure: LinkMeasure, now_ns: int) -> str:
        """Why this client should get less, empty when all is well."""
        if measure.report is not None:
            self._judge_report(line, measure.report, now_ns)
        if measure.due:
            share = measure.delivered / measure.due
            line.sent = (line.sent + share) / 2  # buffers take some before the link is known
            line.blocked = line.blocked + 1 if 1.0 - share > BLOCKED else 0
        if line.reported_ns >= 0 and now_ns - line.reported_ns > SILENT_NS:
            line.sent = 0.0
            return "the client has not reported for 3 s"
        if now_ns - line.changed_ns < SETTLE_NS:
            return ""
        if line.blocked >= 2:
            return "the link does not take all media"
        return line.late

    def _judge_report(self, line: _ClientBudget, report: StateReport, now_ns: int) -> None:
        line.reported_ns = now_ns
        line.late = ""
        if now_ns - line.lowered_ns >= DRAIN_NS:
            best = min(line.ages, default=math.inf)
            if report.age_ms > 1.5 * best + RISE_MS:
                line.late = f"state came {report.age_ms:.0f} ms old, {best:.0f} ms at best"
            elif report.missed_share > min(line.missed, default=1.0) + RISE_MISSED:
                line.late = f"{100 * report.missed_share:.0f} % of state was missed"
        if report.age_ms > 0.0:
            line.ages.append(report.age_ms)
            line.missed.append(report.missed_share)

    def _relearn_best(self, line: _ClientBudget, now_ns: int) -> None:
        if line.innocent_ns < 0:
            line.innocent_ns = now_ns
        elif now_ns - line.innocent_ns > RELEARN_NS and line.ages:
            age, missed = line.ages[-1], line.missed[-1]
            for past, last in ((line.ages, age), (line.missed, missed)):
                past.clear()
                past.append(last)
            line.late, line.innocent_ns = "", -1

    # --- what is done ------------------------------------------------------------------------------------------------

    def _sync_streams(self, line: _ClientBudget, rates: Rates) -> None:
        """A stream that is new to this client begins with everything, or with nothing while there is too much."""
        first = 0 if math.isinf(line.budget) else NOTHING
        line.levels = {stream: line.levels.get(stream, first) for stream in sorted(rates)}

    def _lower_levels(self, line: _ClientBudget, rates: Rates, bytes_per_s: float, reason: str, now_ns: int) -> None:
        if now_ns - line.climbed_ns <= PROBE_NS:
            line.failed = min(line.failed, compute_cost(rates, line.levels))
            line.climb_ns = min(2 * line.climb_ns, CLIMB_MAX_NS)
        levels = select_levels(rates, bytes_per_s)
        line.levels = {stream: max(level, line.levels[stream]) for stream, level in levels.items()}
        line.budget, line.reason = bytes_per_s, reason
        line.changed_ns = line.lowered_ns = now_ns
        line.blocked, line.late = 0, ""

    def _raise_levels(self, line: _ClientBudget, rates: Rates, limit: float, now_ns: int) -> None:
        calm_ns = now_ns - max(line.changed_ns, line.troubled_ns)
        present = compute_cost(rates, line.levels)
        if present >= SAME * line.failed and calm_ns > PROBE_NS:
            line.failed, line.climb_ns = math.inf, CLIMB_NS  # it works now
        if math.isinf(line.budget) and not any(line.levels.values()):
            return
        better = [levels for levels in reversed(build_ladder(rates)) if compute_cost(rates, levels) > present]
        wanted = compute_cost(rates, better[0]) if better else present
        if wanted > limit or calm_ns < (line.climb_ns if wanted >= SAME * line.failed else CLIMB_NS):
            return
        # Where nothing costs more, what is left to give is given.
        line.levels = better[0] if better else dict.fromkeys(rates, 0)
        line.budget = wanted if any(line.levels.values()) else math.inf
        line.changed_ns = line.climbed_ns = now_ns
