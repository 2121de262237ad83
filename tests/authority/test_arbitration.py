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
