"""Whole handovers with real physics and control, and recovery of operators from disturbances."""

from __future__ import annotations

import math

import pytest

from anchors.pose import distance
from iris_session.emulator.behaviours import Giver, Idle, Receiver, Wander, make_behaviour
from tests.emulator.handover_rig import DEVICE, Rig, handover, verdict

pytestmark = pytest.mark.usefixtures("untraced")


def _in_phase(robot: str, phase: str):  # type: ignore[no-untyped-def]
    return lambda rig: rig.behaviours[robot].phase == phase


@pytest.mark.long  # without: `tests/rig/test_demos.py`
@pytest.mark.parametrize(
    ("seed", "thing", "giver", "receiver"),
    [
        (1, "hammer", "left", "right"),
        (2, "hammer", "left", "right"),
        (3, "board", "right", "left"),
    ],
)
def test_handover_in_mid_air(seed: int, thing: str, giver: str, receiver: str) -> None:
    """Friction alone holds the object; between the two grips it touches nothing else; it ends on the table."""
    rig = handover(seed, thing, giver, receiver)
    rig.run(25.0)
    assert verdict(rig, giver, receiver) == ""
    assert rig.now_s < 25.0
    assert rig.fastest_hand < 0.5
    side = 1.0 if receiver == "right" else -1.0
    assert side * rig.world.view().object_pose(thing).p[0] > 0.1  # on the receiver's side of the table


def test_idle_operators_hand_nothing_over() -> None:
    """Negative control of the referee."""
    rig = Rig({"left": Idle("left"), "right": Idle("right")}, seed=1)
    before = rig.world.view().object_pose("hammer").p
    rig.run(1.0)
    assert not rig.referee.handed_over("left", "right")
    assert distance(before, rig.world.view().object_pose("hammer").p) < 1e-3


@pytest.mark.long
def test_handover_finishes_after_an_emergency_stop() -> None:
    """While stopped the clutch is open; afterwards the operators engage again and finish."""
    rig = handover(4)
    rig.run(30.0, until=_in_phase("left", "present"))
    rig.run(0.4, until=lambda r: False)
    for view in rig.views.values():
        view.estop = True
    rig.run(0.3, until=lambda r: False)
    tip = rig.world.view().tip_pose("left").p
    rig.run(1.0, until=lambda r: False)
    assert distance(tip, rig.world.view().tip_pose("left").p) < 2e-3
    for view in rig.views.values():
        view.estop = False
    rig.run(30.0)
    assert verdict(rig, "left", "right") == ""


@pytest.mark.long
def test_operator_without_a_lease_waits() -> None:
    rig = handover(5)
    rig.views["left"].lease = None
    rig.run(2.0, until=lambda r: False)
    assert rig.behaviours["left"].phase == "wait"
    rig.views["left"].lease = 2
    rig.run(30.0)
    assert verdict(rig, "left", "right") == ""


@pytest.mark.long
@pytest.mark.parametrize("phase", ["approach", "release"])
def test_giver_clutches_again_after_a_lost_engagement(phase: str) -> None:
    """The session ends the engagement after a gap in the samples."""
    rig = handover(6)
    rig.run(30.0, until=_in_phase("left", phase))
    rig.run(0.1, until=lambda r: False)
    rig.end_engagement("left")
    rig.run(40.0)
    assert verdict(rig, "left", "right") == ""
    assert rig.behaviours["left"].hand.reclutches >= 1  # type: ignore[attr-defined]


@pytest.mark.long
@pytest.mark.parametrize("phase", ["carry", "put"])
def test_receiver_clutches_again_after_a_lost_engagement(phase: str) -> None:
    rig = handover(7)
    rig.run(30.0, until=_in_phase("right", phase))
    rig.run(0.1, until=lambda r: False)
    rig.end_engagement("right")
    rig.run(40.0)
    assert verdict(rig, "left", "right") == ""


@pytest.mark.long
def test_giver_retries_when_the_object_moved_before_the_grasp() -> None:
    """The gripper closes on nothing; the giver sees it, opens and tries again."""
    rig = handover(8)
    rig.run(30.0, until=_in_phase("left", "close"))
    at = rig.world.model.joint("hammer").qposadr[0]
    rig.world.data.qpos[at : at + 2] += (0.02, 0.09)
    rig.moved_by_hand()
    rig.run(50.0)
    assert verdict(rig, "left", "right") == ""
    assert rig.behaviours["left"].attempts == 2  # type: ignore[attr-defined]


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
    assert verdict(rig, "left", "right") == ""
    assert rig.behaviours["left"].attempts >= 2  # type: ignore[attr-defined]


def test_leaning_object_is_left_alone() -> None:
    rig = handover(9, shift=False)
    at = rig.world.model.joint("hammer").qposadr[0]
    rig.world.data.qpos[at + 2] = 0.17
    rig.world.data.qpos[at + 3 : at + 7] = (math.sqrt(0.5), 0.0, -math.sqrt(0.5), 0.0)  # upside down, handle upright
    rig.moved_by_hand()
    rig.run(10.0, until=lambda r: r.behaviours["left"].done)
    assert rig.behaviours["left"].failed.startswith("the hammer ")


@pytest.mark.long
def test_giver_stops_when_no_receiver_comes() -> None:
    rig = Rig({"left": Giver("left", "hammer", "right", patience_s=2.0), "right": Idle("right")}, seed=10)
    rig.run(30.0, until=lambda r: r.behaviours["left"].done)
    giver = rig.behaviours["left"]
    assert giver.phase == "failed"
    assert giver.failed.startswith("right did not take the hammer")
    assert rig.world.view().object_contacts()[0].grippers == ("left",)  # it does not drop it


def test_receiver_stops_when_nothing_is_offered() -> None:
    rig = Rig({"left": Idle("left"), "right": Receiver("right", "hammer", "left", patience_s=1.0)}, seed=11)
    rig.run(5.0, until=lambda r: r.behaviours["right"].done)
    assert rig.behaviours["right"].failed.startswith("left did not offer the hammer")


def test_missing_scene_names_are_reported() -> None:
    rig = Rig({"left": Giver("left", "object1", "third")}, seed=11)
    rig.run(12.0)
    missing = rig.behaviours["left"].failed.partition(": ")[2]
    assert missing.split(", ") == ["object1", "third/finger_left", "third/finger_right", "third/base", "tip third"]


@pytest.mark.long
def test_wander_stays_near_and_cycles_the_clutch() -> None:
    rig = Rig({"left": Wander("left", seed=3), "right": Wander("right", seed=4)}, seed=12)
    home = rig.world.view().tip_pose("left").p
    clutches, farthest = set(), 0.0

    def record(r: Rig) -> bool:
        nonlocal farthest
        farthest = max(farthest, distance(home, r.world.view().tip_pose("left").p))
        clutches.add(r.behaviours["left"].phase)
        return False

    rig.run(12.0, until=record)
    assert clutches == {"wait", "move", "clutch"}
    assert 0.05 < farthest < 0.2
    assert rig.fastest_hand < 0.5


def test_unknown_behaviours_and_objects_are_rejected() -> None:
    assert isinstance(make_behaviour("giver", "left"), Giver)
    assert make_behaviour("receiver", "right", "board").partner == "left"  # type: ignore[attr-defined]
    assert isinstance(make_behaviour("wander", "arm3", seed=5), Wander)
    assert isinstance(make_behaviour("idle", "arm3", device=DEVICE), Idle)
    with pytest.raises(ValueError, match="needs a partner"):
        make_behaviour("giver", "arm1")
    with pytest.raises(ValueError, match=r"giver, receiver, folder, .*idle"):
        make_behaviour("juggler", "left")
    with pytest.raises(ValueError, match="objects: hammer, board"):
        make_behaviour("giver", "left", "teapot")
