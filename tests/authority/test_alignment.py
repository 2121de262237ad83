"""The alignment gate: stated error at the robot, placing by hand, jumps of the tracking frame, frozen engagements."""

from __future__ import annotations

import itertools
import math
import random
from typing import Any

import pytest

from anchors.pose import quat_from_rotvec, quat_from_yaw, quat_rotate
from iris_session.authority.alignment import compute_position_p95, widen_covariance
from iris_session.protocol.client_messages import Heartbeat, PlaceAlignment, TrackingEpoch
from iris_session.protocol.common import IDENTITY, Alignment, Pose
from iris_session.protocol.server_messages import AlignmentChanged, Notice, ParticipantChanged, SamplesRejected
from iris_session.protocol.status import AlignmentReport

from .table import MS, SECOND, SMALL, Person, Table, make_view, proposal


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
        for _ in range(4_000):
            turned = quat_rotate(quat_from_rotvec(tuple(rng.gauss(0.0, 0.01) for _ in range(3))), r)  # type: ignore[arg-type]
            moved = [rng.gauss(0.0, 0.004) + a - b for a, b in zip(turned, r, strict=True)]
            lengths.append(math.hypot(*moved))
        measured = sorted(lengths)[3_800]
        assert compute_position_p95(C, pivot, point) == pytest.approx(measured, rel=0.05)


def test_a_good_measurement_is_accepted_with_its_error() -> None:
    t = Table()
    anna = t.operator()
    a = t.last(AlignmentChanged).alignment
    assert (a.version, a.kind, a.T_world_tracking.p, a.offset) == (1, "measured", (1.0, 0.0, 0.0), False)
    assert a.pivot_world == (0.0, -0.5, 0.0)
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


def test_first_refusals_are_progress_and_only_later_ones_a_warning() -> None:
    t = Table()
    anna = t.join(name="anna")
    poor = {"refused": True, "advice": "look at it from a second place", "n_observations": 4}
    t.step(anna.says(proposal(**poor)))
    (notice,) = t.since(Notice)
    assert (notice.level, notice.participant, notice.reason) == ("info", anna.id, "")
    assert "2 more seconds" in notice.text
    for _ in range(95):
        t.step(anna.says(proposal(**poor)), dt_ns=20 * MS)
        assert all(n.level == "info" for n in t.since(Notice))
    t.events.clear()
    for _ in range(10):
        t.step(anna.says(Heartbeat()), dt_ns=20 * MS)
    (notice,) = [e for e in t.events if isinstance(e, Notice)]
    assert (notice.level, notice.reason) == ("warning", "alignment_refused"), "the front repeats no refusal"
    assert "second place" in notice.text
    t.wait(SECOND)
    t.step(anna.says(proposal(**{**poor, "advice": "step closer"})))
    assert t.since(Notice)[0].level == "warning"


def test_a_look_that_has_begun_is_no_refusal() -> None:
    """Also where an alignment is in force; the same without more to look for is a refusal."""
    t = Table()
    anna = t.operator()
    poor = {"refused": True, "advice": "look at the sheet", "n_observations": 1}
    for _ in range(10):
        t.step(anna.says(proposal(**poor, look_s=2.0)), dt_ns=100 * MS)
    t.step(anna.says(proposal(covariance=covariance(0.03, 0.0), look_s=1.0)))
    assert [(e.level, e.reason) for e in t.events if isinstance(e, Notice)] == [("info", "")]
    t.step(anna.says(proposal(**poor)))
    assert [e.reason for e in t.since(Notice)] == ["alignment_refused"]


def test_a_tilt_that_noise_explains_is_no_warning() -> None:
    t = Table()
    anna, bert = t.join(), t.join()
    t.step(anna.says(proposal(residual_tilt_rad=0.03, tilt_noise_rad=0.04)))
    assert t.since(Notice) == []
    t.step(bert.says(proposal(residual_tilt_rad=0.03, tilt_noise_rad=0.02)))
    assert [(e.level, e.participant) for e in t.since(Notice)] == [("warning", bert.id)]


def test_what_is_dropped_is_small_beside_the_stated_error() -> None:
    t = Table()
    anna = t.operator()
    t.step(anna.says(proposal(T_world_tracking=yawed(0.0, 1.001))))
    assert len(t.since(AlignmentChanged)) == 1, "1 mm beside 2 mm stated"
    t.step(anna.says(proposal(T_world_tracking=yawed(0.0, 1.0013))))
    assert t.since(AlignmentChanged) == []


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


def test_twists_turn_with_the_alignment() -> None:
    t = Table()
    anna = t.operator("left")
    t.step(anna.says(proposal(T_world_tracking=yawed(math.pi / 2))))
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
    anna.tracking_epoch = 1
    anna.sends("left", clutch=True)
    assert t.hold() == "unaligned"
    t.step(anna.says(proposal(tracking_epoch=1)))
    anna.alignment_version = 2
    anna.sends("left", clutch=True)
    assert t.hold() == "rearm", "the squeeze is still held"
    anna.engage("left", p=(5.0, 0.0, 0.0))
    assert t.command().kind == "pose"
    anna.sends("left", clutch=True, p=(5.0, 0.0, 0.0), tracking_epoch=0)
    assert (t.hold(), t.since(SamplesRejected)[0].reason) == ("rejected", "tracking_epoch")
    anna.engage("left", p=(5.0, 0.0, 0.0))
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


# --- how corrections come into force ---


def at(x: float, yaw: float = 0.0) -> Any:
    """The tracking frame seen at (x, 0, 0), turned by `yaw` about the anchor."""
    c, s = math.cos(yaw), math.sin(yaw)
    p = (x * c - 0.5 * s, -0.5 + x * s + 0.5 * c, 0.0)
    return proposal(T_world_tracking=Pose(p, quat_from_yaw(yaw)))


def settled(*robots: str) -> tuple[Table, Person]:
    """Somebody who has used its alignment, and lets go."""
    t = Table()
    anna = t.operator(*robots or ("left",))
    anna.engage("left")
    anna.sends("left")
    return t, anna


def rest(t: Table, *people: Person, seconds: float = 1.0) -> list[tuple[int, Alignment]]:
    """Alignments that come into force while people only wait, with their times."""
    came = []
    for _ in range(round(seconds * 50)):
        t.step(*(p.says(Heartbeat()) for p in people), dt_ns=20 * MS)
        came += [(t.now_ns, e.alignment) for e in t.since(AlignmentChanged)]
    return came


def notices(t: Table) -> list[str]:
    return [e.text for e in t.events if isinstance(e, Notice)]


def report(t: Table, person: Person) -> AlignmentReport:
    return t.authority.build_alignment_reports()[person.id]


def test_before_use_every_better_measurement_is_in_force_at_once() -> None:
    t = Table()
    anna = t.operator()
    for x in (1.005, 1.2, 3.0):
        t.step(anna.says(at(x)))
        assert [e.alignment.T_world_tracking.p[0] for e in t.since(AlignmentChanged)] == [x]
    assert notices(t) == []


def test_after_a_while_an_alignment_is_in_use_though_nobody_engaged() -> None:
    t = Table()
    anna = t.operator()
    rest(t, anna, seconds=14.9)
    t.step(anna.says(at(1.2)))
    assert len(t.since(AlignmentChanged)) == 1
    rest(t, anna, seconds=0.2)
    t.step(anna.says(at(1.4)))
    assert t.since(AlignmentChanged) == []


def test_a_small_correction_slides_in_and_says_what_is_still_away() -> None:
    t, anna = settled()
    t.step(anna.says(at(1.006)))
    assert report(t, anna).pending_m == pytest.approx(0.006)
    came = rest(t, anna, seconds=3.0)
    assert [a.T_world_tracking.p[0] for _, a in came] == pytest.approx([1.002, 1.004, 1.006])
    assert [round((b[0] - a[0]) / MS) for a, b in itertools.pairwise(came)] == [500, 500]
    assert [a.error_at_anchor_m for _, a in came] == pytest.approx([0.006, 0.004, 0.002])
    assert came[0][1].error_at_robot_m > came[1][1].error_at_robot_m > came[2][1].error_at_robot_m
    assert came[0][1].error_at_robot_m > 0.004
    assert came[2][1].covariance == SMALL
    assert (report(t, anna).pending_m, notices(t)) == (0.0, [])


def test_what_is_still_away_widens_the_stated_error_at_any_lever_arm() -> None:
    away = (0.003, -0.002, 0.0, 0.0, 0.0, 0.02)
    for point in ((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (-1.0, 3.0, 0.5)):
        moved = math.hypot(away[0] - away[5] * point[1], away[1] + away[5] * point[0])
        assert compute_position_p95(widen_covariance(SMALL, away), (0.0, 0.0, 0.0), point) > moved


def test_a_large_correction_is_announced_and_comes_in_one_go() -> None:
    t, anna = settled()
    t.step(anna.says(at(1.05)))
    assert [(e.level, e.participant) for e in t.since(Notice)] == [("info", anna.id)]
    assert "off by 50 mm: the scene moves" in t.since(Notice)[0].text
    told_ns = t.now_ns
    ((when, alignment),) = rest(t, anna, seconds=3.0)
    assert 2 * SECOND <= when - told_ns <= 2 * SECOND + 20 * MS
    assert alignment.T_world_tracking.p[0] == 1.05
    assert len(notices(t)) == 1


def test_while_engaged_a_correction_waits_and_is_told_once() -> None:
    t, anna = settled()
    anna.engage("left")
    for x in (1.05, 1.051, 1.054):
        t.step(anna.says(at(x)))
    for _ in range(150):
        t.step(anna.says(anna.sample("left", clutch=True)), dt_ns=20 * MS)
        assert t.since(AlignmentChanged) == []
        assert t.command().sources[0].pose_world == Pose((1.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
    assert len(notices(t)) == 1
    assert "waits until you let go" in notices(t)[0]
    assert report(t, anna).pending_m == pytest.approx(0.054)
    anna.sends("left")
    assert [e.alignment.T_world_tracking.p[0] for e in t.since(AlignmentChanged)] == [1.054]


def test_a_directors_word_waits_for_the_clutch() -> None:
    t, anna = settled()
    anna.engage("left")
    t.step(anna.says(at(1.05)))
    where = Pose((2.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    t.step(t.host(PlaceAlignment(1, anna.id, where)))
    assert (t.since(AlignmentChanged), t.decision.outgoing[0].message.ok) == ([], True)
    anna.sends("left", clutch=True)
    assert t.command().sources[0].pose_world.p == (1.0, 0.0, 1.0)
    assert report(t, anna).pending_m == pytest.approx(1.0)
    anna.sends("left")
    assert [(e.alignment.kind, e.alignment.T_world_tracking) for e in t.since(AlignmentChanged)] == [("placed", where)]
    assert rest(t, anna, seconds=3.0) == [], "it has replaced the correction that waited"


def test_a_new_frame_forgets_what_waited() -> None:
    t, anna = settled()
    anna.engage("left")
    t.step(anna.says(at(1.05)), t.host(PlaceAlignment(1, anna.id, Pose((2.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))))
    anna.does(TrackingEpoch(1))
    assert rest(t, anna, seconds=3.0) == []
    assert report(t, anna) == AlignmentReport()
    t.step(anna.says(proposal(tracking_epoch=1)))
    assert len(t.since(AlignmentChanged)) == 1, "nobody has used the new one yet"
