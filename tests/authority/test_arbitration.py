"""Samples to commands: engagement, holds, frames, and exactly one command per robot."""

from __future__ import annotations

from iris_session.protocol.client_messages import Heartbeat
from iris_session.protocol.common import Pose
from iris_session.protocol.server_messages import EngagementChanged

from .table import MS, Table


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


def test_headset_taken_off_holds() -> None:
    t = Table()
    op = t.operator("left")
    op.engage("left")
    op.does(Heartbeat(worn=False))
    assert t.hold() == "not_worn"


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


def test_one_device_may_drive_two_robots() -> None:
    t = Table()
    op = t.operator("left", "right")
    op.engage("left", "right")
    assert [c.kind for c in t.decision.commands] == ["pose", "pose"]
    engagements = [c.sources[0].engagement for c in t.decision.commands]
    assert engagements == [1, 2]


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
