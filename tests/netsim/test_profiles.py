"""Conditions of a link by profile, seed and time; profiles and their files."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from iris_session.netsim.profiles import (
    DOWN,
    PROFILES,
    UP,
    Direction,
    LinkConditions,
    Profile,
    ProfileError,
    ProfilePhase,
    load_profile,
    make_latency_profile,
)

SECOND = 1_000_000_000
MS = 1_000_000


def _series(seed: int, profile: str = "busy-wifi", direction: str = DOWN) -> list[tuple[int, bool]]:
    conditions = LinkConditions(load_profile(profile), seed)
    out = []
    for t in range(0, 60 * SECOND, 10 * MS):
        conditions.advance(t)
        out.append((conditions.compute_delay_ns(direction, t), conditions.is_stalled(direction, t)))
    return out


def test_conditions_are_a_function_of_seed_and_time() -> None:
    assert _series(1) == _series(1)
    assert _series(1) != _series(2)
    assert _series(1) != _series(1, direction=UP)
    conditions, sparse = (LinkConditions(PROFILES["busy-wifi"], 1) for _ in range(2))
    dense = {
        t: (conditions.compute_delay_ns(UP, t), conditions.is_stalled(UP, t)) for t in range(0, 20 * SECOND, 5 * MS)
    }
    for t in range(0, 20 * SECOND, 500 * MS):  # queried less often, the conditions are the same
        assert dense[t] == (sparse.compute_delay_ns(UP, t), sparse.is_stalled(UP, t))


def test_profiles_match_their_names() -> None:
    good, busy = _series(0, "good-wifi"), _series(0)
    assert 1.8 < sum(d for d, _ in good) / len(good) / MS < 2.2
    assert max(d for d, _ in good) < 8 * MS
    assert not any(stalled for _, stalled in good)
    assert sum(d > 40 * MS for d, _ in busy) > 10
    assert any(stalled for _, stalled in busy)
    assert all(d >= 0 for d, _ in busy)
    assert all(d == 0 for d, _ in _series(0, "none"))
    blackout = [stalled for _, stalled in _series(0, "blackout")]
    assert blackout == [1000 <= i < 1500 for i in range(6000)]


def test_phases_are_sequential_and_repeat() -> None:
    profile = Profile(
        phases=(
            ProfilePhase(seconds=1.0, delay_ms=1.0),
            ProfilePhase(seconds=2.0, delay_ms=5.0, at_start="cut", up=Direction(delay_ms=9.0, stalled=True)),
        ),
        repeat=True,
    )
    conditions = LinkConditions(profile)
    seen: list[tuple[int, str]] = []
    for t in range(0, 7 * SECOND, SECOND // 2):
        conditions.advance(t, lambda how, t=t: seen.append((t, how)))  # type: ignore[misc]
        late = t % (3 * SECOND) >= SECOND
        assert conditions.compute_delay_ns(DOWN, t) == (5 if late else 1) * MS
        assert conditions.compute_delay_ns(UP, t) == (9 if late else 1) * MS
        assert conditions.is_stalled(UP, t) is late
        assert not conditions.is_stalled(DOWN, t)
        assert conditions.find_next_change_ns(t) == t - t % (3 * SECOND) + (3 * SECOND if late else SECOND)
    assert seen == [(SECOND, "cut"), (4 * SECOND, "cut")]


def test_profiles_are_read_from_files(tmp_path: Path) -> None:
    toml = tmp_path / "lab.toml"
    toml.write_text(
        'repeat = true\n[[phases]]\nseconds = 30\ndelay_ms = 5\njitter_ms = 2\nup = {delay_ms = 9}\n'
        "[[phases]]\nseconds = 2\nstalled = true\n"
    )  # fmt: skip
    profile = load_profile(str(toml))
    assert profile.phases[0].get_direction(UP) == Direction(delay_ms=9.0)
    assert profile.phases[0].get_direction(DOWN).jitter_ms == 2.0
    file = tmp_path / "lab.json"
    file.write_text(json.dumps({"phases": [{"delay_ms": 30}], "window_kib": 1024}))
    assert load_profile(str(file)) == make_latency_profile(30.0) == load_profile("30ms")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("phases = []", "needs a phase"),
        ("[[phases]]\ndelay = 3", "unknown field `delay`"),
        ("[[phases]]\ndelay_ms = -1", "delay_ms -1.0"),
        ("[[phases]]\nloss = 2.0", "loss 2.0"),
        ('[[phases]]\nat_start = "burn"', "'cut' or 'reset'"),
        ("repeat = true\n[[phases]]\ndelay_ms = 3", "last phase"),
        ("window_kib = 1\n[[phases]]", "4 to 16384"),
        ("[[phases", "lab.toml"),
    ],
)
def test_invalid_profiles_are_rejected_with_reason(tmp_path: Path, text: str, expected: str) -> None:
    file = tmp_path / "lab.toml"
    file.write_text(text)
    with pytest.raises(ProfileError) as error:
        load_profile(str(file))
    assert expected in str(error.value)


def test_unknown_profile_lists_the_known() -> None:
    with pytest.raises(ProfileError, match=r"none, lan, .*40ms"):
        load_profile("nice-wifi")
