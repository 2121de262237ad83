"""The rig itself: the same run every time, eight operators, and a journal that is checked."""

from __future__ import annotations

import msgspec
import pytest

from iris_session.demo.scenes import n_arms_scene
from tests.rig.session import Rig


def run_wandering(seed: int) -> bytes:
    """Let two emulated headsets align and drive over a busy Wi-Fi. Return the chain over the whole journal."""
    with Rig(seed=seed, profile="busy-wifi", timestep=0.02) as rig:
        for robot in ("left", "right"):
            rig.emulate(
                name=robot, behaviour="wander", robot=robot, seed=seed, viewpoints=2, observations_per_viewpoint=3
            )
        rig.run_until(lambda: {one.report.phase for one in rig.operators} == {"work"}, "both drive")
        rig.run(1.0)
    return rig.journal.rows[-1].chain


def test_a_run_depends_on_its_seed_alone() -> None:
    assert run_wandering(3) == run_wandering(3) != run_wandering(4)


def test_eight_operators_drive_eight_arms() -> None:
    with Rig(n_arms_scene(8), profile="good-wifi", timestep=0.02) as rig:
        robots = [robot.name for robot in rig.session.robots]
        hands = [rig.drive(f"operator of {robot}", robot, (0.0, 0.02, 0.0)) for robot in robots]
        before = [hand.tip[0][1] for hand in hands]
        rig.run(4.0)
        assert all(hand.is_following for hand in hands)
        assert all(hand.tip[0][1] - y > 0.05 for hand, y in zip(hands, before, strict=True))


def test_a_journal_that_was_changed_is_noticed() -> None:
    with Rig(timestep=0.01) as rig:
        rig.drive("ann", "left", (0.0, 0.05, 0.0))
        rig.run(1.0)
    assert rig.journal.verify() == len(rig.journal.rows)
    at = next(i for i, row in enumerate(rig.journal.rows) if row.step > 60 and row.entry_lengths)
    rig.journal.rows[at] = msgspec.structs.replace(rig.journal.rows[at], entries=b"\x90", entry_lengths=())
    with pytest.raises(AssertionError, match="differs from the journal"):
        rig.journal.verify()
