"""Criteria of a folded cloth and a stowed soft body: shape, started before, released, and at rest."""

from __future__ import annotations

import numpy as np
import pytest

from iris_session.demo.goals import STILL_S, FoldGoal, Goal, GoalMonitor, StowGoal, Vertices

TICK_S = 0.005
FOLD = FoldGoal("cloth", ((0, 1), (2, 3)))
STOW = StowGoal("rose", (-0.2, 0.1, 0.0), (0.2, 0.3, 0.07))
FLAT: Vertices = np.array([[-0.2, -0.2, 0.0], [-0.2, 0.2, 0.0], [0.2, -0.2, 0.0], [0.2, 0.2, 0.0]])


def folded(gap: float) -> Vertices:
    """Return both corners brought over, `gap` [m] from the others."""
    there = FLAT.copy()
    there[[0, 2]] = FLAT[[1, 3]] + [0.0, -gap, 0.0]
    return there


def loaf(x: float, y: float, z: float) -> Vertices:
    return np.array([[x - 0.05, y - 0.02, z], [x + 0.05, y + 0.02, z + 0.05]])


def play(watch: GoalMonitor, seconds: float, vertices: Vertices, now_s: float, touching: tuple[str, ...] = ()) -> float:
    """Show the same world for some time; return the time afterwards."""
    for _ in range(round(seconds / TICK_S)):
        now_s += TICK_S
        watch.update(now_s, vertices, touching)
    return now_s


def test_cloth_is_folded_when_both_pairs_of_corners_meet_and_rest() -> None:
    watch = GoalMonitor(FOLD)
    now_s = play(watch, 0.1, FLAT, 0.0)
    now_s = play(watch, 2 * STILL_S, folded(0.049), now_s)
    assert watch.at_s == pytest.approx(0.1 + TICK_S + STILL_S, abs=2 * TICK_S)


@pytest.mark.parametrize(
    ("goal", "first", "then"),
    [
        pytest.param(FOLD, FLAT, folded(0.051), id="corners too far apart"),
        pytest.param(FOLD, FLAT, np.vstack([folded(0.0)[:2], FLAT[2:]]), id="only one pair"),
        pytest.param(FOLD, folded(0.0), folded(0.0), id="never was open"),
        pytest.param(STOW, loaf(0.0, 0.2, 0.01), loaf(0.0, 0.2, 0.01), id="never was lifted"),
        pytest.param(STOW, loaf(0.0, 0.2, 0.099), loaf(0.0, 0.2, 0.01), id="not lifted far enough"),
        pytest.param(STOW, loaf(0.0, 0.2, 0.12), loaf(0.0, 0.29, 0.01), id="over a wall"),
        pytest.param(STOW, loaf(0.0, 0.2, 0.12), loaf(0.0, 0.2, 0.03), id="sticks out above"),
    ],
)
def test_incomplete_goals_are_no_success(goal: Goal, first: Vertices, then: Vertices) -> None:
    watch = GoalMonitor(goal)
    now_s = play(watch, 1.0, first, 0.0, ("left",))
    play(watch, 3.0, then, now_s)
    assert watch.at_s is None


def test_soft_body_is_stowed_when_it_was_lifted_and_lies_in_the_box() -> None:
    watch = GoalMonitor(STOW)
    now_s = play(watch, 0.5, loaf(0.0, 0.0, 0.12), 0.0, ("left",))
    play(watch, 1.0, loaf(0.1, 0.2, 0.01), now_s)
    assert watch.at_s is not None


@pytest.mark.parametrize("hindrance", ["touched", "moving"])
def test_success_waits_for_release_and_rest(hindrance: str) -> None:
    watch = GoalMonitor(FOLD)
    now_s = play(watch, 0.1, FLAT, 0.0)
    for k in range(600):  # a vertex of the folded cloth moves, or a finger rests on it
        now_s += TICK_S
        vertices = folded(0.02)
        if hindrance == "moving":
            vertices[3, 2] += 0.003 * (k // 10)
        watch.update(now_s, vertices, ("right",) if hindrance == "touched" else ())
    assert watch.at_s is None
    now_s = play(watch, 0.9 * STILL_S, vertices, now_s)
    assert watch.at_s is None
    if hindrance == "touched":
        play(watch, 0.2 * STILL_S, vertices, now_s)
        assert watch.at_s is not None
