"""Which two headsets are compared when, and what is worth telling of it. The mathematics is `anchors.crosscheck`'s.

One pair at a time, each at most once a second; it is told at most once in five, and only after new looks.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Collection, Mapping
from itertools import combinations
from typing import Final

from anchors.alignment import AlignmentEstimate
from anchors.crosscheck import CrossCheck, CrossCheckConfig, Disagreement
from anchors.pose import PoseTuple, Vec3
from iris_session.alignment.estimation import UNSOLVABLE
from iris_session.protocol.entries import CrossChecked, Entry

TELL_NS: Final = 5_000_000_000
SCAN_NS: Final = 1_000_000_000
#: Things of one headset that do not stand still, such as its controllers; the names are the client's own.
MOVING: Final = 4
#: Things of all headsets together: 20 MB when each was looked at a hundred times.
_THINGS: Final = 512
#: A look whose time is further from now is on no clock of this session.
_PLAUSIBLE_NS: Final = 5_000_000_000

Pair = tuple[int, int]


class Comparisons:
    """Looks of all connections; `turn` compares one pair. `anchors`: what stands still, all else moves."""

    def __init__(self, anchors: Collection[str]) -> None:
        self._anchors = anchors
        self._check = CrossCheck(config=CrossCheckConfig(max_things=_THINGS))
        self._looks: dict[int, int] = {}  # by connection: how many were taken
        self._moving: dict[int, set[str]] = {}
        self._epochs: dict[int, int] = {}  # tracking epochs that `_moving` is of
        self._told: dict[Pair, tuple[int, Pair]] = {}  # when, and of how many looks of either
        self._waiting: deque[Pair] = deque()
        self._next_scan_ns = 0

    def see(
        self,
        connection: int,
        thing: str,
        T_tracking_thing: PoseTuple,
        p_tracking_head: Vec3 | None,
        capture_ns: int,
        tracking_epoch: int,
        viewpoint_id: int,
        now_ns: int,
    ) -> bool:
        """One look. False: not kept (no pose, old, out of order, or too many things)."""
        if abs(now_ns - capture_ns) > _PLAUSIBLE_NS:
            return False
        if tracking_epoch > self._epochs.get(connection, tracking_epoch):
            self._moving.pop(connection, None)  # those of the frame before need not be there any more
        moving = self._moving.get(connection, set()) | (set() if thing in self._anchors else {thing})
        if len(moving) > MOVING:
            return False
        dropped = self._check.dropped
        self._check.see(
            str(connection), thing, T_tracking_thing, p_tracking_head, capture_ns, tracking_epoch, viewpoint_id
        )
        if self._check.dropped > dropped:
            return False
        self._moving[connection], self._epochs[connection] = moving, tracking_epoch
        self._looks[connection] = self._looks.get(connection, 0) + 1
        return True

    def forget_looks(self, connection: int) -> None:
        """Its tracking frame is another one: what it saw before is elsewhere now."""
        self._check.forget(str(connection))
        self._moving.pop(connection, None)
        self._epochs.pop(connection, None)

    def forget_thing(self, thing: str) -> None:
        """It was moved: who looked before saw it elsewhere."""
        self._check.forget_thing(thing)

    def forget(self, connection: int) -> None:
        """The connection is gone."""
        self.forget_looks(connection)
        self._looks.pop(connection, None)
        for pair in [pair for pair in self._told if connection in pair]:
            del self._told[pair]

    def turn(self, in_force: Mapping[int, AlignmentEstimate], now_ns: int) -> Entry | None:
        """Compares the pair whose turn it is; the entry that is worth telling, if any."""
        if not self._waiting and now_ns >= self._next_scan_ns:
            self._next_scan_ns = now_ns + SCAN_NS
            self._waiting.extend(pair for pair in combinations(sorted(in_force), 2) if self._due(pair, now_ns))
        if not self._waiting:
            return None
        a, b = self._waiting.popleft()
        if a not in in_force or b not in in_force:
            return None
        worst = self._worst(in_force[a], in_force[b], (a, b), now_ns)
        if worst is None:
            return None
        self._told[a, b] = (now_ns, self._counts((a, b)))
        return Entry(a, a, now_ns, _checked(worst, b))

    def _due(self, pair: Pair, now_ns: int) -> bool:
        counts = self._counts(pair)
        told_ns, told = self._told.get(pair, (now_ns - TELL_NS, (0, 0)))
        return all(counts) and counts != told and now_ns - told_ns >= TELL_NS

    def _counts(self, pair: Pair) -> Pair:
        return self._looks.get(pair[0], 0), self._looks.get(pair[1], 0)

    def _worst(self, of_a: AlignmentEstimate, of_b: AlignmentEstimate, pair: Pair, now_ns: int) -> Disagreement | None:
        """Of all things that both saw: the one that is furthest beyond what is expected."""
        a, b = pair
        moving = frozenset(self._moving.get(a, ())) & frozenset(self._moving.get(b, ()))
        try:
            found = self._check.compare({str(a): of_a, str(b): of_b}, now_ns, moving)
        except UNSOLVABLE:
            return None
        found = [one for one in found if math.isfinite(one.error_m) and one.expected_p95_m > 0.0]
        return max(found, key=lambda one: one.error_m / one.expected_p95_m, default=None)


def _checked(one: Disagreement, other: int) -> CrossChecked:
    return CrossChecked(other, one.thing, one.error_m, one.error_rad, one.expected_p95_m, one.p_world, one.n)
