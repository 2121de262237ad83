"""Two prints of one id, and what only looks like it."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from anchors.places import PrintWatch

SECOND = 1_000_000_000
HERE, THERE = np.zeros(3), np.array([0.4, 0.0, 0.0])


def watch(places: Iterable[np.ndarray], every_s: float = 0.1, seed: int = 1) -> float:
    """Return the distance of the two prints after looks of 4 mm noise at these places."""
    rng, one, apart = np.random.default_rng(seed), PrintWatch(), 0.0
    for i, p in enumerate(places):
        x, y, z = (p + rng.normal(0.0, 0.004, 3)).tolist()
        apart = one.add_look("a", (x, y, z), round(i * every_s * SECOND), 0)
    return apart


@pytest.mark.parametrize("looks", [1, 4, 20])
def test_an_id_that_is_here_and_there_and_here_again_has_two_prints(looks: int) -> None:
    """One look each: both are in view at once."""
    to_and_fro = [*[HERE] * looks, *[THERE] * looks] * 4
    assert watch(to_and_fro) == pytest.approx(0.4, abs=0.02)


@pytest.mark.parametrize(
    "places",
    [
        [*[HERE] * 50, *[THERE] * 50],  # it was moved
        [*[HERE] * 20, *[THERE] * 20, *[HERE] * 20],  # and put back
        [HERE + i * np.array([0.15, 0.0, 0.0]) for i in range(8) for _ in range(5)],  # and carried about
        [*[HERE] * 5, *[0.2 * THERE] * 5] * 5,  # one print, seen badly from two sides
    ],
)
def test_what_was_moved_has_one_print(places: list[np.ndarray]) -> None:
    assert watch(places) == 0.0


def test_wrong_detections_and_slow_changes_are_no_print() -> None:
    rng = np.random.default_rng(2)
    assert watch([rng.normal(0.0, 0.25, 3) if i % 10 == 0 else HERE for i in range(2000)]) == 0.0
    assert watch([*[HERE] * 4, *[THERE] * 4] * 2, every_s=16.0) == 0.0, "moved by hand, twice in two minutes"


def test_a_new_tracking_frame_begins_anew() -> None:
    one = PrintWatch()
    for i in range(12):
        one.add_look("a", ((0.0, 0.4)[i // 3 % 2], 0.0, 0.0), i * SECOND, i // 3)
    assert one.add_look("a", (0.0, 0.0, 0.0), 12 * SECOND, 3) == 0.0
