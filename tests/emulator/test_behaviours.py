"""Recovery of operators from disturbances, with real physics and control."""

from __future__ import annotations

import math

import pytest

from iris_session.emulator.behaviours import Giver, Idle, Receiver
from tools.handover_rig import Rig, handover

pytestmark = pytest.mark.usefixtures("untraced")


def _in_phase(robot: str, phase: str):  # type: ignore[no-untyped-def]
    return lambda rig: rig.behaviours[robot].phase == phase


@pytest.mark.long
def test_giver_picks_up_a_dropped_object() -> None:
    """The pads lose their grip for a moment in the air; the giver grasps the object from the table again."""
    rig = handover(9)
    rig.run(30.0, until=_in_phase("left", "present"))
    model = rig.world.model
    pads = [model.geom(f"left/pad_{side}").id for side in ("left", "right")]
    rubber = model.geom_friction[pads].copy()
    model.geom_friction[pads] = 0.001
    rig.run(5.0, until=lambda r: r.world.view().object_pose("hammer").p[2] < 0.06)
    model.geom_friction[pads] = rubber
    rig.run(60.0)
    assert rig.verdict() == ""
    assert rig.behaviours["left"].attempts >= 2  # type: ignore[attr-defined]


def test_leaning_object_is_left_alone() -> None:
    rig = handover(9, shift=False)
    at = rig.world.model.joint("hammer").qposadr[0]
    rig.world.data.qpos[at + 2] = 0.17
    rig.world.data.qpos[at + 3 : at + 7] = (math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0)  # upside down, handle upright
    rig.moved_by_hand()
    rig.run(10.0, until=lambda r: r.behaviours["left"].done)
    assert rig.behaviours["left"].failed.startswith("the hammer ")


def test_receiver_stops_when_nothing_is_offered() -> None:
    rig = Rig({"left": Idle("left"), "right": Receiver("right", "hammer", "left", patience_s=1.0)}, seed=11)
    rig.run(5.0, until=lambda r: r.behaviours["right"].done)
    assert rig.behaviours["right"].failed.startswith("left did not offer the hammer")


def test_missing_scene_names_are_reported() -> None:
    rig = Rig({"left": Giver("left", "object1", "third")}, seed=11)
    rig.run(12.0)
    missing = rig.behaviours["left"].failed.partition(": ")[2]
    assert missing.split(", ") == ["object1", "third/finger_left", "third/finger_right", "third/base", "tip third"]
