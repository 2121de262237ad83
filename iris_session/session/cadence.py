"""How often something comes, and since when it has fallen silent. Pure: times are passed in."""

from __future__ import annotations

from typing import Final

#: Silence that is always heard, and how many of its usual distances are heard of what comes more slowly.
SILENT_NS: Final = 1_000_000_000
USUAL: Final = 10
#: Distances over which the usual one is averaged.
_WEIGHT: Final = 8


class Cadence:
    """What came once has no rhythm yet: it is never silent."""

    def __init__(self) -> None:
        self._came_ns = -1
        self._usual_ns = 0

    def came(self, now_ns: int) -> None:
        if self._came_ns >= 0:
            distance_ns = now_ns - self._came_ns
            self._usual_ns += (distance_ns - self._usual_ns) // (_WEIGHT if self._usual_ns else 1)
            self._usual_ns = max(1, self._usual_ns)
        self._came_ns = now_ns

    def silent_ns(self, now_ns: int) -> int:
        """Since it came last, if that is longer than it usually takes; else 0."""
        silence_ns = now_ns - self._came_ns
        return silence_ns if self._usual_ns and silence_ns > max(SILENT_NS, USUAL * self._usual_ns) else 0
