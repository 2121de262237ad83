"""`bench stop`: an arm is pressed against a wall through authority, control and physics; every hold lets go of it."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from iris_session.bench.stop import CAUSES, KINDS, MAX_FORCE_RATIO, MAX_LUNGE_RAD, Rehearsal, run_case


@pytest.fixture(scope="module", params=KINDS)
def pressed(request: pytest.FixtureRequest) -> tuple[Rehearsal, Callable[[], None]]:
    """A session whose arm presses against the wall, and what puts it back there."""
    run = Rehearsal(request.param, 0.5)
    return run, run.save()


@pytest.mark.parametrize("cause", CAUSES)
def test_every_cause_of_a_hold_lets_go(pressed: tuple[Rehearsal, Callable[[], None]], cause: str) -> None:
    run, restore = pressed
    restore()
    case = run_case(run, cause)
    assert case.force_nm > 5.0
    assert case.force_ratio <= MAX_FORCE_RATIO
    assert case.lunge_rad <= MAX_LUNGE_RAD
    assert case.grip_kept
