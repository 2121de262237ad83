"""The media budget controller: a level per stream and client, lowered when the client's link is congested. Pure.

On a congested link the age of state rises first, because media and state share the link. So the controller judges by
the state that a client reports, and by the frames that its media connection does not take. Levels are lowered quickly,
to less than what came through. They are raised one step at a time, and after every step that failed the next one comes
later. Streams at rest cost nothing, and always have their full level; single frames of theirs are given one after the
other, as fast as the budget carries them.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final, NamedTuple

from iris_session.protocol.media import CLASSES
from iris_session.protocol.names import BudgetClass

MILLISECOND: Final = 1_000_000
SECOND: Final = 1_000_000_000
#: Class of each level. The finest have every frame of their class, the further ones every second, fourth and eighth of
#: `quarter`: on the slowest links media are rare before there are none.
LEVELS: Final = (*CLASSES[:-1], *(BudgetClass.QUARTER,) * 3, BudgetClass.NONE)
NONE_LEVEL: Final = len(LEVELS) - 1

#: State is late if it is so much older than 1.5 times its best age [ms]. A single large frame of media before it makes
#: state tens of milliseconds older, which is no reason yet.
RISE_MS: Final = 80.0
#: State is missed if the share of missed frames is so much above its best. Frames that arrive together behind a large
#: one of media count as missed too, except the newest.
RISE_MISSED: Final = 0.6
#: Reports of which the best counts: a minute.
MAX_REPORTS: Final = 60
#: Share of due frames that a connection did not take, over two measures in a row, from which on the link counts as
#: full: 5 of the 30 frames at 60 Hz.
BLOCKED: Final = 0.15
#: Each of the two has missed so much, 2 of 15 frames: one pause of a client is no reason.
BLOCKED_EACH: Final = 0.1
#: After a change, frames that are under way still have to arrive.
SETTLE_NS: Final = 500 * MILLISECOND
#: After a level was lowered, frames of the level before are in the way of those that are due for so long.
FLUSH_NS: Final = SECOND
#: Reports do not count for so long after a level was lowered: queues on the way have to drain, beside the media that
#: are left, and a report covers the second before it.
DRAIN_NS: Final = 2600 * MILLISECOND
SILENT_NS: Final = 3 * SECOND
#: Levels are lowered to this share of the rate that came through.
LOWER_TO: Final = 0.7
#: The rate at which a connection took its media counts down to one part in so many of what its frames say: a link that
#: comes to a halt for half a second is not slow.
MAX_FALL: Final = 8.0
#: Rates are measured and vary: levels stay until they cost so much more than the budget, or than the client's own
#: limit.
SLACK: Final = 1.5
LIMIT_SLACK: Final = 1.15
#: Frames for a slow link are sent at so many times the rate that they are given: a frame that was sent at once would
#: fill it, and delay the state behind it. `LOWER_TO` times this is less than what came through.
PACE: Final = 1.1
#: The same just after a level was lowered: what fills the link has to drain.
DRAIN_PACE: Final = 0.6
#: Lowest pace [bytes/s]. TCP plans when the next segment may leave by the pace of the last one, and keeps to that when
#: the pace is raised. Between two processes of one computer a segment has up to 64 KiB: a quarter of a second at this
#: pace, but eleven minutes at 100 bytes per second, which a stream that hardly moves may cost.
MIN_PACE: Final = 262_144.0
#: A connection that took this share of its pace is held back by the pace, not by the link: its rates have grown.
PACED: Final = 0.8
#: Time between steps up. To a level that has failed, after a step up or because the link did not take it, it doubles
#: each time, until the level works.
RAISE_NS: Final = 3 * SECOND
RAISE_MAX_NS: Final = 48 * SECOND
#: Rates are measured and vary: levels that cost this share of those that failed are the same ones.
SAME_COST: Final = 0.8
#: Congestion this soon after a step up is blamed on it; without any the step has worked.
PROBE_NS: Final = 3 * SECOND
#: Without any media, congestion that stays so long has other causes: it becomes the new normal of the link.
RELEARN_NS: Final = 5 * SECOND

#: Bytes per second of every stream at each level but the last, as a client would be sent.
Rates = Mapping[str, Sequence[float]]


class StateReport(NamedTuple):
    """A client's report of its state. `age_ms`: median, 0 when none arrived."""

    age_ms: float
    missed_share: float


class LinkMeasure(NamedTuple):
    """One measurement of a client's link.

    Attributes:
        report: Newest report of its state, `None` without one since the last measurement.
        delivered: Media frames that its connection took since then.
        due: Media frames that were due.
        limit: Bytes per second that the client wants at most, 0 for no limit.
        newest: Bytes of the newest frame by stream.
        bytes_per_s: Rate at which its connection was acknowledged what was sent since then, 0 if that is not known.
    """

    report: StateReport | None
    delivered: int = 0
    due: int = 0
    limit: float = 0.0
    newest: Mapping[str, int] = MappingProxyType({})
    bytes_per_s: float = 0.0


class BudgetGrant(NamedTuple):
    """Levels of one client. `levels`: index into `LEVELS` by stream. `bytes_per_s`: bound of all, 0 for none. `pace`:
    bytes per second at which their frames are to be sent, 0 for as fast as the connection takes them."""

    levels: dict[str, int]
    bytes_per_s: float = 0.0
    reason: str = ""
    pace: float = 0.0


def compute_cost(rates: Rates, levels: Mapping[str, int]) -> float:
    """Return bytes per second of all streams at these levels. A coarser class never costs more than a finer one."""
    return sum(_level_rate(rates[stream], levels.get(stream, 0)) for stream in sorted(rates))


def build_ladder(rates: Rates) -> list[dict[str, int]]:
    """Return the levels from full to none. Each step lowers the stream that costs most."""
    levels = dict.fromkeys(sorted(rates), 0)
    steps = [dict(levels)]
    while any(level < NONE_LEVEL for level in levels.values()):
        lowest = max(
            (stream for stream in levels if levels[stream] < NONE_LEVEL),
            key=lambda stream: (_level_rate(rates[stream], levels[stream]), -levels[stream], stream),
        )
        levels[lowest] += 1
        steps.append(dict(levels))
    return steps


def select_levels(rates: Rates, bytes_per_s: float) -> dict[str, int]:
    """Return the best levels that cost no more than `bytes_per_s`; none at all for no budget."""
    steps = build_ladder(rates)
    if bytes_per_s <= 0.0:
        return steps[-1]
    return next(levels for levels in steps if compute_cost(rates, levels) <= bytes_per_s)


def _level_rate(rates: Sequence[float], level: int) -> float:
    return 0.0 if level >= NONE_LEVEL else min(rates[: level + 1])


class _ClientBudget:
    """State of one client."""

    def __init__(self) -> None:
        self.levels: dict[str, int] = {}
        self.budget = math.inf
        self.reason = ""
        self.ages: deque[float] = deque(maxlen=MAX_REPORTS)
        self.missed: deque[float] = deque(maxlen=MAX_REPORTS)
        self.reported_ns = -1
        self.complaint = ""  # what the newest report complains about
        self.missing = 0.0  # share of due frames that were not delivered, in the newest measure
        self.is_blocked = False
        self.pace = 0.0
        self.taken = 0.0  # bytes per second that the connection was acknowledged, in the newest measure
        self.delivered_share = 1.0  # smoothed share of due frames that were delivered
        self.changed_ns = self.lowered_ns = self.raised_ns = self.congested_ns = -SILENT_NS
        self.raise_after_ns = RAISE_NS
        self.failed = math.inf  # cost of the levels that failed
        self.blameless_since_ns = -1  # since when there is congestion without any media
        self.single_until_ns = -1  # until when single frames of streams at rest are under way


class BudgetController:
    """Control the levels of all clients of a session. `update` is called a few times a second for each."""

    def __init__(self) -> None:
        self._clients: dict[int, _ClientBudget] = {}

    def remove(self, client: int) -> None:
        """Remove a client that has left."""
        self._clients.pop(client, None)

    def update(self, client: int, measure: LinkMeasure, rates: Rates, now_ns: int) -> BudgetGrant:
        """Return the levels of the streams in `rates`, which the client subscribed to. `now_ns` must not decrease."""
        state = self._clients.get(client)
        if state is None:
            state = self._clients[client] = _ClientBudget()
        limit = measure.limit or math.inf
        resting = [stream for stream in sorted(rates) if stream in state.levels and not rates[stream][0]]
        self._sync_streams(state, rates)
        reason = self._find_congestion(state, measure, now_ns)
        present = compute_cost(rates, state.levels)
        if reason:
            state.congested_ns = now_ns
        if reason and present > 0.0:
            state.blameless_since_ns = -1
            passed = present * state.delivered_share
            if state.is_blocked and measure.bytes_per_s:  # of frames, buffers take some first
                passed = min(passed, max(measure.bytes_per_s, passed / MAX_FALL))
                state.failed = min(state.failed, passed / SAME_COST)
            self._lower_levels(state, rates, LOWER_TO * passed, reason, now_ns)
        elif reason:
            if now_ns >= state.single_until_ns:
                self._relearn_best(state, now_ns)
        else:
            state.blameless_since_ns = -1
            self._raise_levels(state, rates, limit, now_ns)
        allowed = min(state.budget, limit)
        if compute_cost(rates, state.levels) > min(SLACK * state.budget, LIMIT_SLACK * limit):
            state.levels = select_levels(rates, allowed)
            state.reason = state.reason if state.budget <= limit else "the client asked for no more"
        if not reason:
            self._give_singles(state, resting, measure.newest, allowed, now_ns)
        bound = 0.0 if math.isinf(allowed) else allowed
        reason = state.reason if bound or any(state.levels.values()) else ""
        drains = now_ns - state.lowered_ns < SETTLE_NS
        pace = (DRAIN_PACE if drains else PACE) * max(bound, compute_cost(rates, state.levels))
        state.pace = max(pace, MIN_PACE) if bound else 0.0
        return BudgetGrant(dict(state.levels), bound, reason, state.pace)

    # --- congestion --------------------------------------------------------------------------------------------------

    def _find_congestion(self, state: _ClientBudget, measure: LinkMeasure, now_ns: int) -> str:
        """Return why this client should get less, empty if there is no reason."""
        if measure.report is not None:
            self._judge_report(state, measure.report, now_ns)
        if measure.due:
            share = measure.delivered / measure.due
            state.delivered_share = (state.delivered_share + share) / 2
            flushes = now_ns - state.lowered_ns < FLUSH_NS
            before, state.missing = state.missing, 0.0 if flushes else 1.0 - share
            state.is_blocked = min(before, state.missing) > BLOCKED_EACH and before + state.missing > 2 * BLOCKED
            state.is_blocked = state.is_blocked and not self._is_paced(state, measure)
        state.taken = measure.bytes_per_s
        if state.reported_ns >= 0 and now_ns - state.reported_ns > SILENT_NS:
            state.delivered_share = 0.0
            return "the client has not reported for 3 s"
        if now_ns - state.changed_ns < SETTLE_NS:
            return ""
        if state.is_blocked:
            return "the link does not take all media"
        return state.complaint

    @staticmethod
    def _is_paced(state: _ClientBudget, measure: LinkMeasure) -> bool:
        """Return whether frames are missing because of the pace: over two measures, as large segments are rare."""
        return 0.0 < PACED * state.pace <= (state.taken + measure.bytes_per_s) / 2

    def _judge_report(self, state: _ClientBudget, report: StateReport, now_ns: int) -> None:
        state.reported_ns = now_ns
        state.complaint = ""
        if now_ns - state.lowered_ns >= DRAIN_NS:
            best = min(state.ages, default=math.inf)
            if report.age_ms > 1.5 * best + RISE_MS:
                state.complaint = f"state came {report.age_ms:.0f} ms old, {best:.0f} ms at best"
            elif report.missed_share > min(state.missed, default=1.0) + RISE_MISSED:
                state.complaint = f"{100 * report.missed_share:.0f} % of state was missed"
        if report.age_ms > 0.0:
            state.ages.append(report.age_ms)
            state.missed.append(report.missed_share)

    def _relearn_best(self, state: _ClientBudget, now_ns: int) -> None:
        if state.blameless_since_ns < 0:
            state.blameless_since_ns = now_ns
        elif now_ns - state.blameless_since_ns > RELEARN_NS and state.ages:
            age, missed = state.ages[-1], state.missed[-1]
            for past, last in ((state.ages, age), (state.missed, missed)):
                past.clear()
                past.append(last)
            state.complaint, state.blameless_since_ns = "", -1

    # --- levels ------------------------------------------------------------------------------------------------------

    def _sync_streams(self, state: _ClientBudget, rates: Rates) -> None:
        """Start a new stream with its full level, or with none while the client's budget is limited."""
        first = 0 if math.isinf(state.budget) else NONE_LEVEL
        state.levels = {stream: state.levels.get(stream, first) for stream in sorted(rates)}

    def _give_singles(
        self, state: _ClientBudget, resting: Sequence[str], newest: Mapping[str, int], bytes_per_s: float, now_ns: int
    ) -> None:
        """Give streams at rest their full level. A single frame counts as under way while the budget carries it."""
        for stream in resting:
            if state.levels[stream] and bytes_per_s > 0.0 and now_ns >= state.single_until_ns:
                state.levels[stream] = 0
                state.single_until_ns = now_ns + round(newest.get(stream, 0) / bytes_per_s * SECOND)

    def _lower_levels(self, state: _ClientBudget, rates: Rates, bytes_per_s: float, reason: str, now_ns: int) -> None:
        if state.is_blocked or now_ns - state.raised_ns <= PROBE_NS:
            state.failed = min(state.failed, compute_cost(rates, state.levels))
            state.raise_after_ns = min(2 * state.raise_after_ns, RAISE_MAX_NS)
        levels = select_levels(rates, bytes_per_s)
        state.levels = {stream: max(level, state.levels[stream]) for stream, level in levels.items()}
        state.budget, state.reason = bytes_per_s, reason
        state.changed_ns = state.lowered_ns = now_ns
        state.missing, state.is_blocked, state.complaint = 0.0, False, ""

    def _raise_levels(self, state: _ClientBudget, rates: Rates, limit: float, now_ns: int) -> None:
        calm_ns = now_ns - max(state.changed_ns, state.congested_ns)
        present = compute_cost(rates, state.levels)
        if present >= SAME_COST * state.failed and calm_ns > PROBE_NS:
            state.failed, state.raise_after_ns = math.inf, RAISE_NS  # the levels work now
        if math.isinf(state.budget) and not any(state.levels.values()):
            return
        better = [levels for levels in reversed(build_ladder(rates)) if compute_cost(rates, levels) > present]
        wanted = compute_cost(rates, better[0]) if better else present
        if wanted > limit or calm_ns < (state.raise_after_ns if wanted >= SAME_COST * state.failed else RAISE_NS):
            return
        # If no step costs more, every stream gets its full level.
        state.levels = better[0] if better else dict.fromkeys(rates, 0)
        state.budget = wanted if any(state.levels.values()) else math.inf
        state.changed_ns = state.raised_ns = now_ns
