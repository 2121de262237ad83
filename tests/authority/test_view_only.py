"""Alignments that are good enough to look with: fingertips, and anchors that a device kept. They move nothing."""

from __future__ import annotations

import math
from typing import Any

import pytest

from iris_session.protocol.client_messages import Align, TrackingEpoch
from iris_session.protocol.entries import TipSolved
from iris_session.protocol.names import AlignmentKind, DenialReason, HoldReason, RejectReason
from iris_session.protocol.server_messages import AlignmentChanged, Notice, SamplesRejected, TipCalibrated
from tests.authority.table import Table, proposal
from tests.authority.test_alignment import covariance, rest, yawed

KINDS = sorted(AlignmentKind.VIEW_ONLY)
COARSE = covariance(0.006, 0.03)


def view_only(kind: str, **changes: Any) -> Any:
    return proposal(**{"kind": kind, "covariance": COARSE, "error_at_anchor_m": 0.016, **changes})


@pytest.mark.parametrize("kind", KINDS)
def test_it_shows_the_scene_and_drives_nothing(kind: str) -> None:
    t = Table()
    anna = t.join(name="anna")
    t.step(anna.says(view_only(kind)))
    got = t.last(AlignmentChanged).alignment
    assert got.kind == kind
    assert 0.05 < got.error_at_robot_m < 0.2, "more than may be driven with"
    assert anna.acquire("left").ok
    decision = anna.engage("left")
    assert t.hold() == HoldReason.VIEW_ONLY
    assert not decision.commands[0].sources
    assert t.last(SamplesRejected).reason == RejectReason.VIEW_ONLY
    (notice,) = [n for n in t.events if isinstance(n, Notice) and n.reason]
    assert (notice.level, notice.participant, notice.reason) == ("warning", anna.id, DenialReason.VIEW_ONLY)
    assert "touch" in notice.text
    rest(t, anna, seconds=0.1)
    assert anna.told["left"].hold_reason == HoldReason.VIEW_ONLY
    anna.sends(clutch=False)
    assert [item.device for item in t.decision.presence] == ["controller/right"], "others see the hand"


@pytest.mark.parametrize("kind", KINDS)
def test_a_measurement_replaces_it_at_once_and_drives(kind: str) -> None:
    t = Table()
    anna = t.join(name="anna")
    t.step(anna.says(view_only(kind)))
    rest(t, anna, seconds=20.0)  # long enough for a correction to be announced
    t.step(anna.says(proposal(T_world_tracking=yawed(0.1, 1.1))))
    got = t.last(AlignmentChanged).alignment
    assert got.kind == "measured"
    anna.alignment_version = got.version
    anna.acquire("left")
    anna.engage("left")
    assert t.command().sources


@pytest.mark.parametrize("kind", KINDS)
def test_it_never_replaces_an_alignment_to_drive_with(kind: str) -> None:
    t = Table()
    anna, boss = t.operator("left", name="anna"), t.join("director")
    t.step(anna.says(view_only(kind, T_world_tracking=yawed(0.0, 1.2))))
    boss.asks(Align(1, "start", "anna"))
    t.step(anna.says(view_only(kind, T_world_tracking=yawed(0.0, 1.2))))
    assert t.since(AlignmentChanged) == []
    anna.engage("left")
    assert t.command().sources
    anna.does(TrackingEpoch(1))
    t.step(anna.says(view_only(kind, tracking_epoch=1)))
    assert t.last(AlignmentChanged).alignment.kind == kind, "of another frame nothing else is known"
    assert t.hold() == HoldReason.REARM


def test_kinds_that_are_not_known_are_no_measurement() -> None:
    t = Table()
    anna = t.join(name="anna")
    for kind in ("placed", "not_needed", "none", "better"):
        t.step(anna.says(proposal(kind=kind)))
    assert t.since(AlignmentChanged) == []


def test_a_solved_tip_is_published_to_all_and_invalid_numbers_are_not() -> None:
    t = Table()
    anna = t.join(name="anna")
    right = "controller/right"
    good = TipSolved(right, (0.0, 0.0, -0.1), (1e-6, 0.0, 0.0) * 3, 0.002, 0.001, 60)
    t.step(anna.says(good))
    assert t.last(TipCalibrated) == TipCalibrated(anna.id, right, good.p_grip_tip, good.covariance, 0.002, 0.001, 60)
    t.step(anna.says(TipSolved(right, refused=True, advice="turn it further")))
    assert (t.last(TipCalibrated).refused, t.last(TipCalibrated).advice) == (True, "turn it further")
    for bad in (
        TipSolved(right, (math.nan, 0.0, 0.0), good.covariance),
        TipSolved(right, good.p_grip_tip, (math.inf,) * 9),
        TipSolved(right, good.p_grip_tip, (1.0,) * 4),
    ):
        t.step(anna.says(bad))
        assert t.since(TipCalibrated) == []
