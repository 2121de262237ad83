"""Where a headset was when: the last poses of its head in its tracking frame, for observations to be paired with."""

from __future__ import annotations

from collections import deque
from typing import Final, NamedTuple

from anchors.pose import PoseTuple, is_rigid

#: Poses kept: 1.4 s at 90 Hz, far longer than the detection of a sheet and the way here take.
KEPT: Final = 128
#: A head pose further away in time says nothing: at 0.5 m/s a head moves 25 mm meanwhile.
NEAR_NS: Final = 50_000_000


class _Head(NamedTuple):
    capture_ns: int
    tracking_epoch: int
    T_tracking_head: PoseTuple


class HeadRing:
    """The newest head poses of one connection, as they came: nothing is checked before somebody asks."""

    __slots__ = ("_heads",)

    def __init__(self) -> None:
        self._heads: deque[_Head] = deque(maxlen=KEPT)

    def __len__(self) -> int:
        return len(self._heads)

    def put(self, capture_ns: int, tracking_epoch: int, T_tracking_head: PoseTuple) -> None:
        self._heads.append(_Head(capture_ns, tracking_epoch, T_tracking_head))

    def nearest(self, capture_ns: int, tracking_epoch: int) -> PoseTuple | None:
        """The pose nearest in time, of the same tracking frame. `None`: there is none near enough, or it is no pose.

        An observation may come before the samples around it: those that are here decide.
        """
        best: _Head | None = None
        best_ns = NEAR_NS + 1
        for head in reversed(self._heads):
            away_ns = abs(head.capture_ns - capture_ns)
            if away_ns < best_ns and head.tracking_epoch == tracking_epoch:
                best, best_ns = head, away_ns
            elif head.capture_ns < capture_ns - NEAR_NS:
                break
        if best is None or not is_rigid(best.T_tracking_head):
            return None
        return best.T_tracking_head
