"""The alignment gate: stated error at the robot, placing by hand, jumps of the tracking frame, frozen engagements."""

from __future__ import annotations

import math
import random
from typing import Any

import pytest

from anchors.pose import quat_from_rotvec, quat_from_yaw, quat_rotate
from iris_session.authority import AuthorityConfig
from iris_session.authority.alignment import compute_position_p95
from iris_session.protocol.client_messages import Heartbeat, Observation, PlaceAlignment, TrackingEpoch
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.server_messages import AlignmentChanged, Notice, ParticipantChanged, SamplesRejected

from .table import MS, SECOND, SMALL, Table, make_view, proposal


def covariance(position_m: float, rotation_rad: float) -> tuple[float, ...]:
    variances = [position_m**2] * 3 + [rotation_rad**2] * 3
    return tuple(variances[i] if i == j else 0.0 for i in range(6) for j in range(6))


def yawed(yaw: float, x: float = 0.0) -> Pose:
    return Pose((x, 0.0, 0.0), quat_from_yaw(yaw))


def test_stated_error_is_the_95_percent_quantile_at_the_robot() -> None:
    """Against a Monte Carlo of the same error model; the approximation is within 5 %."""
    rng = random.Random(4)
    C, pivot = covariance(0.004, 0.01), (0.0, -0.5, 0.0)
    for point in ((0.0, -0.5, 0.0), (0.5, 0.0, 0.5), (2.0, 0.3, 0.0)):
        r = tuple(a - b for a, b in zip(point, pivot, strict=True))
        lengths = []
        for _ in range(20_000):
            turned = quat_rotate(quat_from_rotvec(tuple(rng.gauss(0.0, 0.01) for _ in range(3))), r)  # type: ignore[arg-type]
            moved = [rng.gauss(0.0, 0.004) + a - b for a, b in zip(turned, r, strict=True)]
            lengths.append(math.hypot(*moved))
        measured = sorted(lengths)[19_000]
        assert compute_position_p95(C, pivot, point) == pytest.approx(measured, rel=0.05)


def test_stated_error_of_degenerate_covariances() -> None:
    zero = (0.0,) * 36
    assert compute_position_p95(zero, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0)) == 0.0
    assert compute_position_p95((1e300,) * 36, (0.0, 0.0, 0.0), (1e9, 0.0, 0.0)) == math.inf
    line = tuple(1e-6 if i == 0 else 0.0 for i in range(36))
    assert compute_position_p95(line, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) == pytest.approx(1.96e-3, rel=0.03)


def test_a_good_measurement_is_accepted_with_its_error() -> None:
    t = Table()
    anna = t.operator()
    a = t.last(AlignmentChanged).alignment
    assert (a.version, a.kind, a.T_world_tracking.p, a.offset) == (1, "measured", (1.0, 0.0, 0.0), False)
    assert 0.0 < a.error_at_robot_m < 0.001
    assert a.error_at_anchor_m == 0.002
    t.step(anna.says(proposal()))
    assert t.since(AlignmentChanged) == []
    t.step(anna.says(proposal(T_world_tracking=Pose((1.01, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))))
    assert t.last(AlignmentChanged).alignment.version == 2
    t.step(anna.says(proposal(T_world_tracking=yawed(0.01, 1.01))))
    assert t.last(AlignmentChanged).alignment.version == 3
    better = tuple(0.25 * c for c in SMALL)
    t.step(anna.says(proposal(T_world_tracking=yawed(0.01, 1.01), covariance=better)))
    assert t.last(AlignmentChanged).alignment.version == 4


@pytest.mark.parametrize(
    "changes",
    [
        {"refused": True, "advice": "step closer"},
        {"covariance": covariance(0.03, 0.0)},
        {"covariance": covariance(0.001, 0.05)},
        {"covariance": ()},
        {"covariance": (math.nan, *SMALL[1:])},
        {"covariance": (-1.0, *SMALL[1:])},
        {"error_at_anchor_m": math.inf},
        {"T_world_tracking": Pose((0.0, 0.0, math.nan), (1.0, 0.0, 0.0, 0.0))},
        {"T_world_tracking": Pose((0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0))},
    ],
)
def test_refusals_come_with_advice_and_not_too_often(changes: dict[str, Any]) -> None:
    t = Table()
    anna = t.join()
    t.step(anna.says(proposal(**changes)))
    (notice,) = t.since(Notice)
    assert (notice.participant, notice.reason) == (anna.id, "alignment_refused")
    assert "closer" in notice.text
    assert anna.replies() == [], "nobody asked: a reply would look like that to a request without a number"
    t.step(anna.says(proposal(**changes)))
    assert t.since(Notice) == []
    t.wait(SECOND)
    t.step(anna.says(proposal(**changes)))
    assert t.since(Notice) == [notice]
    assert not any(isinstance(e, AlignmentChanged) for e in t.events)


def test_error_counts_at_the_robots_one_holds() -> None:
    lever = covariance(0.001, 0.02)
    t = Table()
    anna = t.operator()
    anna.acquire("left", "right")
    t.step(anna.says(proposal(covariance=lever)))
    near = t.last(AlignmentChanged).alignment
    t.view = make_view(tips={"left": Pose((3.0, 0.0, 0.0), IDENTITY.q), "right": IDENTITY})
    t.step(anna.says(proposal(covariance=lever, T_world_tracking=yawed(0.1))))
    assert t.since(Notice)[0].reason == "alignment_refused"
    assert t.last(AlignmentChanged).alignment is near


def test_engaging_a_far_robot_with_an_alignment_that_was_good_near_the_sheet_is_refused() -> None:
    t = Table()
    anna = t.join()
    t.view = make_view(tips={"left": IDENTITY, "right": Pose((4.0, 0.0, 0.0), IDENTITY.q)})
    t.step(anna.says(proposal(covariance=covariance(0.001, 0.02))))
    anna.acquire("left", "right")
    anna.engage("left")
    assert t.command("left").kind == "pose"
    anna.engage("right", device="controller/left")
    assert t.hold("right") == "unaligned"
    assert t.last(SamplesRejected).reason == "unaligned"
    assert "right" in t.since(Notice)[0].text


def test_a_tilted_anchor_is_a_warning_once() -> None:
    t = Table()
    anna = t.join()
    t.step(anna.says(proposal(residual_tilt_rad=0.02)))
    t.step(anna.says(proposal(residual_tilt_rad=0.02)))
    assert [e.level for e in t.events if isinstance(e, Notice)] == ["warning"]


def test_advice_on_an_accepted_measurement_is_told_once() -> None:
    t = Table()
    anna = t.join()
    for _ in range(3):
        t.step(anna.says(proposal(advice="is the sheet printed at the wrong scale?")))
    assert t.last(AlignmentChanged).participant == anna.id
    notices = [e for e in t.events if isinstance(e, Notice)]
    assert [(n.participant, n.reason) for n in notices] == [(anna.id, "")]
    assert "wrong scale" in notices[0].text


def test_a_sheet_on_the_edge_of_a_bound_is_told_every_five_seconds_and_counted() -> None:
    t = Table()
    anna = t.join()
    for i in range(60):  # 12 s of proposals at 5 Hz
        tilted = proposal(residual_tilt_rad=0.02 if i % 2 else 0.0)
        t.step(anna.says(Heartbeat()), anna.says(tilted), dt_ns=200 * MS)
    notices = [e.text for e in t.events if isinstance(e, Notice)]
    assert len(notices) == 3
    assert "more of these" not in notices[0]
    assert "(12 more of these meanwhile)" in notices[1]


def test_advice_that_changes_with_every_measurement_is_told_every_five_seconds() -> None:
    t = Table()
    anna = t.join()
    for i in range(30):  # 6 s
        t.step(anna.says(Heartbeat()), anna.says(proposal(advice=f"it measures {i} mm")), dt_ns=200 * MS)
    bert = t.join()
    t.step(bert.says(proposal(advice="it measures 7 mm")))
    notices = [(e.participant, e.text) for e in t.events if isinstance(e, Notice)]
    assert [who for who, _ in notices] == [anna.id, anna.id, bert.id]  # everybody's own
    assert "0 mm" in notices[0][1]
    assert "25 mm (24 more of these meanwhile)" in notices[1][1]


def test_alignment_is_frozen_while_engaged() -> None:
    t = Table()
    anna = t.operator("left")
    anna.engage("left")
    t.step(anna.says(proposal(T_world_tracking=yawed(math.pi / 2))))
    for _ in range(2):
        anna.sends("left", clutch=True)
        source = t.command().sources[0]
        assert source.new
        assert source.pose_world.p == (1.0, 0.0, 1.0)
    anna.sends("left")
    assert t.hold() == "clutch_open"
    t.wait(2 * SECOND)
    anna.sends("left")
    assert t.last(SamplesRejected).reason == "alignment_version"
    anna.alignment_version = 2
    anna.engage("left", kind="twist", twist=(1.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    assert t.command().sources[0].twist_world == pytest.approx((0.0, 1.0, 0.0, 0.0, 0.0, 1.0), abs=1e-12)


def test_a_tracking_jump_voids_alignment_and_engagement() -> None:
    t = Table()
    anna = t.operator("left")
    anna.engage("left")
    anna.does(TrackingEpoch(1))
    assert t.hold() == "rearm"
    assert t.since(ParticipantChanged)[0].participant.alignment is None
    anna.does(TrackingEpoch(1))
    assert t.since(ParticipantChanged) == []
    t.step(anna.says(proposal()))
    assert t.since(AlignmentChanged) == []
    t.step(anna.says(proposal(tracking_epoch=1)))
    anna.tracking_epoch, anna.alignment_version = 1, 2
    anna.engage("left", p=(5.0, 0.0, 0.0))
    assert t.command().kind == "pose"
    t.step(anna.says(proposal(tracking_epoch=2)))
    assert (t.hold(), t.last(AlignmentChanged).alignment.tracking_epoch) == ("rearm", 2)


def test_director_places_and_offsets() -> None:
    t = Table()
    boss, anna = t.join("director"), t.join(name="anna")
    agent = t.join("agent", alignment="not_needed")
    where = yawed(0.0, 2.0)

    def place(**fields: Any) -> PlaceAlignment:
        return PlaceAlignment(**{"request_id": 1, "participant": "anna", "T_world_tracking": where, **fields})

    assert anna.denied(place()) == "role"
    assert boss.denied(place(participant="nobody")) == "unknown_participant"
    assert boss.denied(place(participant=agent.id)) == "invalid"
    assert boss.denied(place(T_world_tracking=Pose((0.0, 0.0, 0.0), (9.0, 0.0, 0.0, 0.0)))) == "invalid"
    assert boss.denied(place(offset=True)) == "unaligned"
    assert boss.asks(place()).ok
    a = t.last(AlignmentChanged).alignment
    assert (a.kind, a.T_world_tracking.p, a.covariance) == ("placed", (2.0, 0.0, 0.0), ())
    anna.acquire("left")
    anna.engage("left")
    assert t.command().sources[0].pose_world.p == (2.0, 0.0, 1.0)
    t.step(anna.says(proposal()))
    assert t.since(AlignmentChanged) == []  # a director's word stands until the frame jumps
    anna.does(TrackingEpoch(1))
    t.step(anna.says(proposal(tracking_epoch=1)))
    assert boss.asks(place(offset=True)).ok
    a = t.last(AlignmentChanged).alignment
    assert (a.kind, a.offset, a.T_world_tracking.p, a.error_at_robot_m) == ("measured", True, (3.0, 0.0, 0.0), 0.0)
    t.step(anna.says(proposal(tracking_epoch=1, T_world_tracking=yawed(0.0, 1.5))))
    a = t.last(AlignmentChanged).alignment
    assert (a.offset, a.T_world_tracking.p) == (True, (3.5, 0.0, 0.0))


def test_proposals_for_participants_without_need_and_observations_change_nothing() -> None:
    t = Table(AuthorityConfig())
    agent = t.join("agent", alignment="not_needed")
    t.step(agent.says(proposal()), agent.says(Observation("table", "qr", IDENTITY, t.now_ns, 0)))
    assert t.decision.events == ()
