"""Samples to commands: engagement, holds, frames, and exactly one command per robot."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import msgspec
import pytest

from iris_session.authority import AuthorityConfig
from iris_session.authority.arbitration import GRIPPER_REPORT_NS
from iris_session.protocol.client_messages import Acquire, Control, Grasp, Release
from iris_session.protocol.common import Pose
from iris_session.protocol.entries import Lost
from iris_session.protocol.server_messages import EngagementChanged, Feedback, Notice, ObjectGrasped
from iris_session.protocol.steps import ControlStatus

from .table import MS, Person, Table, make_view


def test_closing_the_clutch_engages_in_the_same_step_and_opening_it_holds() -> None:
    t = Table()
    op = t.operator("left")
    assert t.hold() == "no_sample"
    op.sends("left")
    assert t.hold() == "clutch_open"
    op.sends("left", clutch=True, gripper=0.5)
    c = t.command()
    assert (c.kind, c.gripper, c.sources[0].new, c.sources[0].engagement) == ("pose", 0.5, True, 1)
    assert c.sources[0].pose_world == Pose((1.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
    t.step()
    assert not t.command().sources[0].new
    kept = t.command()
    t.step()
    assert t.command() is kept
    op.sends("left")
    assert t.hold() == "clutch_open"
    assert t.last(EngagementChanged).reason == "clutch_open"
    assert t.hold("right") == "no_lease"


def test_a_clutch_that_was_never_seen_open_does_not_engage() -> None:
    t = Table()
    op = t.operator("left")
    op.sends("left", clutch=True)
    assert t.hold() == "rearm"
    op.engage("left")
    assert t.command().kind == "pose"


def test_150_ms_without_a_counted_sample_holds_until_clutched_again() -> None:
    t = Table()
    op = t.operator("left")
    op.engage("left")
    t.step(dt_ns=150 * MS)
    assert t.command().kind == "pose"
    t.step(dt_ns=1)
    assert t.hold() == "stale"
    op.sends("left", clutch=True)
    assert t.hold() == "stale"
    op.engage("left")
    assert t.command().sources[0].engagement == 2


def test_any_device_that_says_not_worn_holds_everything_of_its_wearer() -> None:
    t = Table()
    op = t.operator("left")
    op.engage("left")
    op.sends(device="head", worn=False)
    assert t.hold() == "not_worn"
    op.sends(device="head")
    op.sends("left", clutch=True)
    assert t.hold() == "not_worn"
    op.engage("left")
    assert t.command().kind == "pose"


def test_a_latch_opened_before_tracking_was_lost_does_not_fire_after_it() -> None:
    t = Table()
    op = t.operator("left")
    op.sends("left")
    op.sends("left", tracked=False)
    assert t.hold() == "untracked"
    op.sends("left", clutch=True)
    assert t.command().kind == "hold"


def test_two_controllers_drive_two_arms_and_neither_takes_the_others() -> None:
    t = Table()
    op = t.operator("left", "right")
    other = {"device": "controller/left"}
    op.engage("left")
    op.engage("right", **other)
    assert [c.sources[0].device for c in t.decision.commands] == ["controller/right", "controller/left"]
    op.engage("left", **other)
    assert t.command("left").sources[0].device == "controller/right"
    op.sends("left")
    op.sends("left", **other, clutch=True)
    assert t.hold("left") == "rearm"  # it was closed while the first one drove, so it must open first
    op.engage("left", **other)
    assert t.command("left").sources[0].device == "controller/left"


def test_gripper_is_clamped_and_kept_within_an_engagement() -> None:
    t = Table()
    op = t.operator("left")
    op.engage("left", gripper=7.0)
    assert t.command().gripper == 1.0
    op.sends("left", clutch=True, gripper=-3.0)
    assert t.command().gripper == 0.0
    op.sends("left", clutch=True)
    assert t.command().gripper == 0.0
    op.engage("left")
    assert t.command().gripper is None


def test_a_gripper_out_of_range_is_reported_at_once_and_counted_once_a_minute() -> None:
    t = Table()
    op = t.operator("left")
    op.engage("left", gripper=1.0000001)
    assert not [event for event in t.events if isinstance(event, Notice)], "that is rounding"
    for i in range(100):
        op.sends("left", clutch=True, gripper=255.0 if i else -1.0)
    (notice,) = [event for event in t.events if isinstance(event, Notice)]
    assert (notice.level, notice.participant) == ("warning", op.id)
    assert "-1 for left" in notice.text
    t.now_ns += GRIPPER_REPORT_NS
    op.engage("left", gripper=255.0)
    assert "(100 samples)" in t.last(Notice).text


# --- feedback to holders ---


def test_feedback_on_change_and_at_most_every_50_ms() -> None:
    t = Table()
    anna = t.operator("left")
    t.wait(100 * MS)
    assert anna.told["left"] == Feedback("left", "hold", "no_sample")
    seen = []
    for i in range(100):
        anna.sends("left", clutch=i > 0 and i % 2 == 1)
        seen += [t.now_ns for _ in anna.feedback()]
    assert all(b - a >= 50 * MS for a, b in pairwise(seen))
    assert len(seen) >= 1
    t.wait(100 * MS)
    t.step()
    assert anna.feedback() == []


def test_feedback_tells_force_limits_and_rejections() -> None:
    t = Table()
    anna = t.operator("left")
    t.view = msgspec.structs.replace(t.view, forces={"left": 3.3})
    t.control = (ControlStatus("right"), ControlStatus("left", ("left/joint1",)))
    anna.sends("left", scene_epoch=7)
    t.wait(100 * MS)
    assert anna.told["left"] == Feedback("left", "hold", "rejected", 3.5, ("left/joint1",), {"scene_epoch": 1})
    assert anna.told.keys() == {"left"}


@pytest.mark.parametrize("force", [math.nan, math.inf])
def test_forces_of_physics_that_diverged_are_not_felt(force: float) -> None:
    t = Table()
    anna = t.operator("left")
    t.view = msgspec.structs.replace(t.view, forces={"left": force})
    t.wait(100 * MS)
    assert anna.told["left"].contact_n == 0.0


# --- objects held by hands ---


LEFT: dict[str, Any] = {"device": "hand/left", "p": (-1.0, 0.0, 0.0)}
RIGHT: dict[str, Any] = {"device": "hand/right", "p": (-0.5, 0.0, 0.0)}


def holding() -> tuple[Table, Person]:
    t = Table()
    anna = t.operator()
    assert anna.asks(Grasp(1, "hammer", "hand/left")).ok
    anna.engage("hammer", **LEFT)
    return t, anna


def move(anna: Person, hand: dict[str, Any], dx: float, *names: str, clutch: bool = True) -> None:
    x, y, z = hand["p"]
    anna.sends(*names, device=hand["device"], p=(x + dx, y, z), clutch=clutch)


def at(t: Table) -> float:
    return t.decision.objects[0].T_world_object.p[0]


def test_the_object_follows_the_hand_from_where_it_lay() -> None:
    t, anna = holding()
    (command,) = t.decision.objects
    assert command.T_world_object == Pose((0.0, 0.0, 0.2), (1.0, 0.0, 0.0, 0.0))
    assert t.since(ObjectGrasped) == [ObjectGrasped("hammer", anna.id, "hand/left", True)]
    move(anna, LEFT, 0.01, "hammer")
    assert at(t) == pytest.approx(0.01)
    move(anna, LEFT, 0.01, "hammer", clutch=False)
    assert t.decision.objects == ()
    assert not t.last(ObjectGrasped).grasped


def test_the_second_hand_takes_over_without_a_jump() -> None:
    t, anna = holding()
    bert = t.operator()
    assert bert.asks(Grasp(1, "hammer", "hand/right")).leases[0].sub_holders == (anna.id, bert.id)
    bert.engage("hammer", **RIGHT)
    first = t.decision.objects[0].grasp
    move(bert, RIGHT, 0.01, "hammer")
    assert at(t) == pytest.approx(0.0)
    move(anna, LEFT, 0.01, "hammer")
    before = at(t)
    anna.does(Release())
    assert at(t) == pytest.approx(before, abs=1e-12)
    assert t.decision.objects[0].grasp != first
    move(bert, RIGHT, 0.02, "hammer")
    assert at(t) == pytest.approx(before + 0.01)
    t.step(bert.says(Lost()))
    assert t.decision.objects == ()


def test_acquired_objects_take_any_hand_and_a_reset_drops_them() -> None:
    t = Table(AuthorityConfig(max_sub_holders=1))
    anna, bert, boss = t.operator(), t.operator(), t.join("director")
    assert anna.asks(Acquire(1, (), ("hammer", "board"))).ok
    assert bert.denied(Acquire(1, (), ("hammer",))) == "held"
    assert bert.denied(Grasp(1, "hammer", "hand/left")) == "held"
    anna.engage("hammer", "board", **LEFT)
    assert [c.object for c in t.decision.objects] == ["hammer", "board"]
    boss.does(Control(1, "reset"))
    assert t.decision.objects == ()


@pytest.mark.parametrize(
    "pose",
    [
        Pose((math.nan, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        Pose((1e300, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        Pose((0.0, 0.0, 0.0), (math.nan, 0.0, 0.0, 0.0)),
        Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_an_object_that_is_nowhere_is_not_held_and_needs_a_new_clutch(pose: Pose) -> None:
    t = Table()
    anna = t.operator()
    anna.asks(Grasp(1, "hammer", "hand/left"))
    t.view = make_view(objects={"hammer": pose})
    anna.engage("hammer", **LEFT)
    assert t.decision.objects == ()
    assert not t.last(ObjectGrasped).grasped
    t.view = make_view()
    move(anna, LEFT, 0.0, "hammer")
    assert t.decision.objects == ()
    anna.engage("hammer", **LEFT)
    assert t.decision.objects[0].T_world_object.p == pytest.approx((0.0, 0.0, 0.2))
