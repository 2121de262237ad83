"""Which vertices of what bends go into the picture: so many a second, and no more bytes than a file should grow by.

Pure, and used where vertices are published, so that what the picture does not take costs nothing but a comparison.
"""

from __future__ import annotations

from typing import Final

#: Frames a second of one deformable, as long as all of them together fit. People see this as smooth.
PERIOD_NS: Final = 50_000_000
#: What vertices may add to the file [bytes/s]: about twice what two people and fifty bodies do.
BYTES_PER_S: Final = 1_000_000
#: Of one vertex of one frame in the file: position and normal, float32.
VERTEX_BYTES: Final = 24


class VertexRateLimit:
    """The frames of one scene. All its deformables have the same rate."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}
        self._due_ns: dict[str, int] = {}
        self._period_ns = PERIOD_NS

    def reset(self) -> None:
        """Another scene, or somebody who has seen none of them."""
        self._counts.clear()
        self._due_ns.clear()
        self._period_ns = PERIOD_NS

    def take(self, stream: str, count: int, session_time: int) -> bool:
        """Whether a frame of `count` vertices goes in."""
        if self._counts.get(stream) != count:
            self._counts[stream] = count
            frame_bytes = sum(self._counts.values()) * VERTEX_BYTES
            self._period_ns = max(PERIOD_NS, frame_bytes * 1_000_000_000 // BYTES_PER_S)
        if session_time < self._due_ns.get(stream, 0):
            return False
        # What comes a little late, as states do, does not delay those after it.
        self._due_ns[stream] = max(self._due_ns.get(stream, 0), session_time - PERIOD_NS // 4) + self._period_ns
        return True
