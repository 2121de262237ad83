"""Choice of vertices for the file: bounded rate, bounded bytes, fair among meshes."""

from __future__ import annotations

import pytest

from iris_session.journal.feed import BYTES_PER_S, PERIOD_NS, VERTEX_BYTES, VertexRateLimit

S = 1_000_000_000


def taken(pace: VertexRateLimit, counts: dict[str, int], seconds: int, hz: float) -> dict[str, int]:
    """Return the number of written frames of meshes that move in every state."""
    found = dict.fromkeys(counts, 0)
    for i in range(round(seconds * hz)):
        for stream, count in counts.items():
            found[stream] += pace.admit_frame(stream, count, round(i * S / hz))
    return found


@pytest.mark.parametrize("hz", [60.0, 59.94, 30.0, 21.0])
def test_small_mesh_is_written_at_its_rate(hz: float) -> None:
    n = taken(VertexRateLimit(), {"a": 1000}, 10, hz)["a"]
    assert 10 * S / PERIOD_NS * 0.75 <= n <= 10 * S / PERIOD_NS + 1


@pytest.mark.parametrize("counts", [{"a": 10_000}, {"a": 20_000, "b": 20_000, "c": 100}, {"a": 262_144}])
def test_large_meshes_share_the_byte_budget(counts: dict[str, int]) -> None:
    found = taken(VertexRateLimit(), counts, 60, 60.0)
    size = sum(found[stream] * count * VERTEX_BYTES for stream, count in counts.items())
    first = sum(counts.values()) * VERTEX_BYTES  # goes in whatever its size
    assert 0.7 * 60 * BYTES_PER_S <= size <= 60 * BYTES_PER_S + 2 * first
    assert max(found.values()) - min(found.values()) <= 1
