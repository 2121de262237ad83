"""Random sessions (see `play`): long ones from a seed, short ones that hypothesis shrinks to the failing actions."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from .play import ACTIONS, Play

POLICIES = ("join-order", "config", "nearest", "director")


@pytest.mark.usefixtures("untraced")
@pytest.mark.parametrize("seed", [0, 1, 2, 3, 5, 6, 7, 10, 11, 12, 14, 16, 17, 20, 22, 23])
def test_long_sessions(seed: int) -> None:
    policy = POLICIES[seed % 4] if seed < 8 else "join-order"
    play = Play(Random(seed), policy)
    for _ in range(400):
        play.act()
    play.flush()
    play.replay()
    assert play.ended > 0 or policy != "join-order", "an episode ends"
    assert play.moved > 20 or policy != "join-order", "a session in which hardly anything moved proves nothing"
    if seed > 13:
        assert play.alignments.came["slid"] + play.alignments.came["announced"] > 1, "nor do books without corrections"


@settings(max_examples=80, deadline=None, derandomize=True)
@given(
    actions=st.lists(st.integers(0, len(ACTIONS) - 1), max_size=40),
    rng=st.randoms(use_true_random=False),
    policy=st.sampled_from(POLICIES),
)
def test_short_sessions(actions: list[int], rng: Random, policy: str) -> None:
    play = Play(rng, policy)
    for i in actions:
        ACTIONS[i][1](play)
    play.flush()
    play.swap()
    play.replay()
