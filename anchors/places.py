"""Two prints of one id: an anchor that is observed in two fixed places, to and fro.

An anchor that is moved once has two places, one after the other; a wrong detection comes to no place twice. So a place
counts after `MIN_LOOKS` looks, and two of them are two prints when the looks have changed between them `MIN_CHANGES`
times. Places are in the tracking frame: forget them when it jumps. Pure.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Final

from anchors.pose import Vec3, distance

TWO_PRINTS: Final = "in two places: print each id once"
MIN_LOOKS: Final = 3
#: There, back, and there again. A sheet may be laid aside and put back.
MIN_CHANGES: Final = 3
#: Looks at one print lie within this [m] of their place: three sigma from 1.3 m away; places are further apart.
SAME_PLACE_M: Final = 0.03
MIN_APART_M: Final = 0.10
#: Older changes do not count, and a place is forgotten [ns].
MEMORY_NS: Final = 120_000_000_000
_MAX_PLACES: Final = 8
_MAX_ANCHORS: Final = 64


@dataclass
class _Place:
    p: Vec3
    n: int
    seen_ns: int


@dataclass
class _Anchor:
    places: list[_Place] = field(default_factory=list)
    present: _Place | None = None
    changes: deque[tuple[int, _Place, _Place]] = field(default_factory=lambda: deque(maxlen=MIN_CHANGES))


@dataclass
class PrintWatch:
    """Places of the anchors that one headset observes."""

    _anchors: dict[str, _Anchor] = field(default_factory=dict)
    _tracking_epoch: int = 0

    def add_look(self, anchor_id: str, p_tracking_anchor: Vec3, capture_ns: int, tracking_epoch: int) -> float:
        """Add one look; return how far two prints are apart [m] if there are two, else 0.

        They are two until the first of the changes between them is `MEMORY_NS` old.
        """
        if tracking_epoch > self._tracking_epoch:
            self._tracking_epoch = tracking_epoch
            self.forget()
        anchor = self._anchors.setdefault(anchor_id, _Anchor())
        if len(self._anchors) > _MAX_ANCHORS:
            del self._anchors[next(iter(self._anchors))]
        anchor.places = [one for one in anchor.places if 0 <= capture_ns - one.seen_ns <= MEMORY_NS]
        place = _find_place(anchor.places, p_tracking_anchor)
        if place is None:
            place = _Place(p_tracking_anchor, 0, capture_ns)
            anchor.places = [*anchor.places[-_MAX_PLACES + 1 :], place]
        place.n, place.seen_ns = place.n + 1, capture_ns
        x, y, z = (a + (b - a) / min(place.n, 20) for a, b in zip(place.p, p_tracking_anchor, strict=True))
        place.p = (x, y, z)
        if place.n < MIN_LOOKS:
            return 0.0
        before, anchor.present = anchor.present, place
        if before is not None and before is not place and distance(before.p, place.p) >= MIN_APART_M:
            anchor.changes.append((capture_ns, before, place))
        return _measure_prints(anchor, capture_ns)

    def forget(self) -> None:
        """Forget all places: the tracking frame has jumped."""
        self._anchors.clear()


def _find_place(places: list[_Place], p: Vec3) -> _Place | None:
    near = min(places, key=lambda one: distance(one.p, p), default=None)
    return near if near is not None and distance(near.p, p) <= SAME_PLACE_M else None


def _measure_prints(anchor: _Anchor, now_ns: int) -> float:
    """Return the distance between the two places of the last changes, 0 unless they are between the same two."""
    changes = anchor.changes
    if len(changes) < MIN_CHANGES or not 0 <= now_ns - changes[0][0] <= MEMORY_NS:
        return 0.0
    _, a, b = changes[-1]
    same = all(one in (a, b) and other in (a, b) for _, one, other in changes)
    return distance(a.p, b.p) if same else 0.0
