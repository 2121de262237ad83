"""Random sessions (see `play`): long ones from a seed, short ones that hypothesis shrinks to the failing actions."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.protocol.client_messages import Acquire
from iris_session.protocol.common import Pose

from .play import ACTIONS, Play
from .table import MS

POLICIES = ("join-order", "config", "nearest", "director")


def play_long(seed: int, policy: str = "join-order") -> Play:
    play = Play(Random(seed), policy)
    for _ in range(400):
        play.act()
    play.flush()
    play.replay()
    return play


@pytest.mark.usefixtures("untraced")
@pytest.mark.parametrize("seed", [0, 1, 2, 3, 5, 6, 7, 10, 11, 12, 15, 18, 20, 21, 22, 24])
def test_long_sessions(seed: int) -> None:
    policy = POLICIES[seed % 4] if seed < 8 else "join-order"
    play = play_long(seed, policy)
    assert play.ended > 0 or policy != "join-order", "an episode ends"
    assert play.moved > 20 or policy != "join-order", "a session in which hardly anything moved proves nothing"
    if seed > 13:
        assert play.alignments.came["slid"] + play.alignments.came["announced"] > 1, "nor do books without corrections"


@pytest.mark.usefixtures("untraced")
@settings(max_examples=8)
@given(seed=st.integers(100, 2**32))
def test_long_sessions_of_other_seeds(seed: int) -> None:
    play_long(seed)


@settings(max_examples=80)
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


def test_a_hand_that_jumped_while_its_clutch_was_open_drives_from_where_it_is_then() -> None:
    play = Play(Random(0))
    ann = play.people[0]
    play.say(ann, Acquire(1, ("left",)))
    play.flush()
    kinds = []
    for clutch, x in ((False, 0.0), (True, 0.0), (False, 0.0), (True, 3.0), (True, 3.01), (True, 0.0)):
        play.now_ns += 20 * MS
        pose = Pose((x, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
        play.say(ann, play.sample(ann, ("left",), ann.device, clutch, pose=pose))
        play.flush()
        kinds.append(play.decision.commands[0].hold_reason or "moves")
    assert kinds == ["clutch_open", "moves", "clutch_open", "moves", "moves", "jump"]
