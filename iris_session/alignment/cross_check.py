"""Schedule the cross-check of headsets: which pair is compared when, and which disagreement is reported.

One pair at a time, each pair at most once a second; a pair is reported at most every five seconds, and only after new
observations. The mathematics is in `anchors.cross_check`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, KeysView, Mapping, Set
from itertools import combinations
from typing import Final

from anchors.alignment import AlignmentEstimate
from anchors.cross_check import CrossCheck, CrossCheckConfig, Disagreement
from anchors.pose import PoseTuple, Vec3
from iris_session.alignment.estimator import NUMERICAL_ERRORS
from iris_session.protocol.entries import CrossChecked, Entry

REPORT_INTERVAL_NS: Final = 5_000_000_000
SCAN_INTERVAL_NS: Final = 1_000_000_000
#: Moving targets of one headset, such as its controllers; their names are chosen by the client.
MAX_MOVING: Final = 4
#: Targets of all headsets together: 20 MB at a hundred observations each.
_MAX_TARGETS: Final = 512
#: An observation whose time is further from now was not stamped with the clock of this session.
_MAX_CLOCK_OFFSET_NS: Final = 5_000_000_000

Pair = tuple[int, int]
#: A calculation; returns what is to be done with its result.
Job = Callable[[], Callable[[], None]]


class CrossCheckScheduler:
    """Observations of all connections; each job of `begin_comparison` compares one pair.

    A target is what two headsets observe: an anchor, which stands still, or anything else, which may move.
    """

    def __init__(self, anchors: KeysView[str]) -> None:
        """Create a scheduler; `anchors`: names of the targets that stand still."""
        self._anchors = anchors
        self._check = CrossCheck(config=CrossCheckConfig(max_targets=_MAX_TARGETS))
        self._n_observations: dict[int, int] = {}  # by connection
        self._reported: dict[Pair, tuple[int, Pair]] = {}  # time, and number of observations of either then
        self._pending: deque[Pair] = deque()
        self._next_scan_ns = 0
        self._discards = 0  # a comparison that began before the last one does not count

    def add_observation(
        self,
        connection: int,
        target: str,
        T_tracking_target: PoseTuple,
        p_tracking_head: Vec3 | None,
        capture_ns: int,
        tracking_epoch: int,
        viewpoint_id: int,
        now_ns: int,
    ) -> bool:
        """Add one observation; return false if it is dropped (not a pose, too old, out of order, or too many
        targets)."""
        if abs(now_ns - capture_ns) > _MAX_CLOCK_OFFSET_NS:
            return False
        headset = str(connection)
        self._check.begin_epoch(headset, tracking_epoch)
        moving = self._list_moving(connection)
        if target not in self._anchors and target not in moving and len(moving) >= MAX_MOVING:
            return False
        used = self._check.add_observation(
            headset, target, T_tracking_target, p_tracking_head, capture_ns, tracking_epoch, viewpoint_id
        )
        self._n_observations[connection] = self._n_observations.get(connection, 0) + used
        return used

    def add_point(
        self, connection: int, name: str, p_tracking_point: Vec3, sigma_m: float, touched_ns: int, tracking_epoch: int
    ) -> bool:
        """Add a touch of a point that others touch too; return false if it is dropped (`CrossCheck.add_point`)."""
        used = self._check.add_point(str(connection), name, p_tracking_point, sigma_m, touched_ns, tracking_epoch)
        self._n_observations[connection] = self._n_observations.get(connection, 0) + used
        return used

    def _list_moving(self, connection: int) -> set[str]:
        return self._check.list_targets(str(connection)) - self._anchors

    def discard_observations(self, connection: int) -> None:
        """Discard the observations of a connection whose tracking frame has changed."""
        self._discards += 1
        self._check.discard_headset(str(connection))

    def discard_target(self, target: str) -> None:
        """Discard all observations of a target that was moved."""
        self._discards += 1
        self._check.discard_target(target)

    def remove_connection(self, connection: int) -> None:
        """Forget the state of a connection that has ended."""
        self.discard_observations(connection)
        self._n_observations.pop(connection, None)
        for pair in [pair for pair in self._reported if connection in pair]:
            del self._reported[pair]

    def begin_comparison(
        self, in_force: Mapping[int, AlignmentEstimate], now_ns: int, offer: Callable[[Entry], object]
    ) -> Job | None:
        """Return the job that compares the next pair, if one is due.

        Args:
            in_force: Alignment in force by connection.
            now_ns: Session time.
            offer: Takes the entry for the authority, if a result is to be reported.
        """
        if not self._pending and now_ns >= self._next_scan_ns:
            self._next_scan_ns = now_ns + SCAN_INTERVAL_NS
            self._pending.extend(pair for pair in combinations(sorted(in_force), 2) if self._is_due(pair, now_ns))
        if not self._pending:
            return None
        a, b = self._pending.popleft()
        if a not in in_force or b not in in_force:
            return None
        check = self._check.copy_headsets((str(a), str(b)))
        alignments = {str(a): in_force[a], str(b): in_force[b]}
        moving = self._list_moving(a) & self._list_moving(b)
        since_ns = self._reported.get((a, b), (-1, (0, 0)))[0]
        counts, discards = self._count_observations((a, b)), self._discards

        def compare() -> Callable[[], None]:
            found = _compare(check, alignments, now_ns, moving, since_ns)
            return lambda: finish(found)

        def finish(found: list[tuple[Disagreement, bool]]) -> None:
            if discards != self._discards:
                return
            for one, is_touched in found:
                self._reported[a, b] = (now_ns, counts)
                off = (one.error_m, one.error_rad, one.expected_p95_m)
                offer(Entry(a, a, now_ns, CrossChecked(b, one.target, *off, one.p_world, one.n, is_touched)))

        return compare

    def _is_due(self, pair: Pair, now_ns: int) -> bool:
        counts = self._count_observations(pair)
        reported_ns, reported = self._reported.get(pair, (now_ns - REPORT_INTERVAL_NS, (0, 0)))
        return all(counts) and counts != reported and now_ns - reported_ns >= REPORT_INTERVAL_NS

    def _count_observations(self, pair: Pair) -> Pair:
        return self._n_observations.get(pair[0], 0), self._n_observations.get(pair[1], 0)


def _compare(
    check: CrossCheck, alignments: Mapping[str, AlignmentEstimate], now_ns: int, moving: Set[str], since_ns: int
) -> list[tuple[Disagreement, bool]]:
    """Return the disagreement furthest beyond its expected error, of all targets that both observed, and those about
    points that were touched after `since_ns`, with true."""
    try:
        seen = check.compare(alignments, now_ns, moving)
        touched = check.compare_points(alignments, now_ns, since_ns)
    except NUMERICAL_ERRORS:
        return []
    seen = sorted(filter(_is_usable, seen), key=lambda one: one.error_m / one.expected_p95_m)
    return [*((one, False) for one in seen[-1:]), *((one, True) for one in filter(_is_usable, touched))]


def _is_usable(one: Disagreement) -> bool:
    return math.isfinite(one.error_m) and one.expected_p95_m > 0.0
