"""A short run of `tools/soak.py`, and its checks with invalid input. docs/evidence/links.md has the long run."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

TOOLS = Path(__file__).parents[2] / "tools"
sys.path.insert(0, str(TOOLS))

from soak import check_log, check_memory  # noqa: E402

RECORDED = {1: 11, 2: 22, 3: 33, 4: 44, 5: 55}


def test_event_check_finds_gaps_repeats_and_changes() -> None:
    def find_problem(*records: tuple[int, int, int, int]) -> str:
        return check_log("a", list(records), RECORDED)[1][0]

    whole = [(1, 0, 1, 11), (1, 0, 2, 22), (2, 1, 4, 44), (2, 1, 5, 55)]
    assert check_log("a", whole, RECORDED) == (0, [])
    assert check_log("a", [(1, 0, 1, 11), (1, 1, 3, 33), (1, 1, 4, 44)], RECORDED) == (1, [])
    assert "event 4 came after 2" in find_problem((1, 0, 2, 22), (1, 0, 4, 44))
    assert "event 4 came after 2" in find_problem((1, 0, 2, 22), (2, 0, 4, 44))
    assert "event 5 came after 3" in find_problem((1, 0, 1, 11), (1, 1, 3, 33), (1, 1, 5, 55))
    assert "event 2 came after 2" in find_problem((1, 0, 2, 22), (2, 0, 2, 22))
    assert "event 3 " in find_problem((1, 0, 2, 22), (1, 0, 3, 22))
    assert "event 6 " in find_problem((1, 0, 5, 55), (1, 0, 6, 66))


def test_memory_check_finds_only_a_leak() -> None:
    flat = [(float(t), 100.0 + t % 3) for t in range(60)]
    warming = [(float(t), 100.0 + min(t, 20)) for t in range(60)]
    busy = [(float(t), 100.0 + 5.0 * (t % 7) + 20.0 * (t > 50)) for t in range(60)]
    leaking = [(float(t), 100.0 + 0.3 * t) for t in range(60)]
    busy_and_leaking = [(t, a + b) for (t, a), (_, b) in zip(busy, leaking, strict=True)]
    series = {"front": flat, "recorder": warming, "gateway": busy, "authority": leaking, "camera": busy_and_leaking}
    figures, problems = check_memory(series)
    assert [p.split()[2] for p in problems] == ["authority", "camera"]
    assert figures["authority"]["mib_per_hour"] == pytest.approx(1080.0)
