"""`bench stop`: an arm is pressed against a wall through authority, control and physics; every hold lets go of it."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from iris_session.bench import stop
from iris_session.bench.stop import (
    CAUSES,
    KINDS,
    MAX_FORCE_RATIO,
    MAX_LUNGE_RAD,
    Case,
    StopScenario,
    run_case,
    run_stop,
)

#: Each kind of actuator with a third of the causes, each cause with a third of the kinds; all pairs in the long run.
CASES = [
    pytest.param(kind, cause, marks=[pytest.mark.long] if (i + j) % 3 else [])
    for i, kind in enumerate(KINDS)
    for j, cause in enumerate(CAUSES)
]


@pytest.fixture(scope="module")
def pressed(request: pytest.FixtureRequest) -> tuple[StopScenario, Callable[[], None]]:
    """A session whose arm presses against the wall, and what puts it back there."""
    run = StopScenario(request.param, 0.5)
    return run, run.save()


@pytest.mark.parametrize(("pressed", "cause"), CASES, indirect=["pressed"])
def test_every_cause_of_a_hold_lets_go(pressed: tuple[StopScenario, Callable[[], None]], cause: str) -> None:
    run, restore = pressed
    restore()
    case = run_case(run, cause)
    assert case.force_nm > 5.0
    assert case.force_ratio <= MAX_FORCE_RATIO
    assert case.lunge_rad <= MAX_LUNGE_RAD
    assert case.grip_kept


@pytest.mark.parametrize(
    ("last", "passed"),
    [
        (Case(0.1, 0.01, 60.0, 0.0, True), True),
        (Case(0.31, 0.01, 60.0, 0.0, True), False),
        (Case(0.1, 0.031, 60.0, 0.0, True), False),
        (Case(0.1, 0.01, 60.0, 0.0, False), False),
    ],
)
def test_one_case_that_pushes_lunges_or_loses_its_grip_fails_the_report(
    last: Case, passed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = iter([*(Case(0.0, 0.0, 60.0, 0.0, True) for _ in range(len(KINDS) * len(CAUSES) - 1)), last])

    class Still:
        def __init__(self, kind: str, press_s: float) -> None: ...

        def save(self) -> Callable[[], None]:
            return lambda: None

    monkeypatch.setattr(stop, "StopScenario", Still)
    monkeypatch.setattr(stop, "run_case", lambda run, cause: next(cases))
    report = run_stop()
    assert report.results["worst_force_ratio_after_200ms"] == last.force_ratio
    assert report.results["worst_lunge_rad"] == last.lunge_rad
    assert report.ok is passed
