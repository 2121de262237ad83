"""Observations of one connection -> proposals at a bounded rate, on change only."""

from __future__ import annotations

import math

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchors.pose import IDENTITY_POSE, PoseTuple, quat_from_rotvec
from iris_session.alignment.estimator import ConnectionEstimator
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import Entry, decode_entry, encode_entry

PERIOD = 200_000_000
ANCHORS: dict[str, PoseTuple] = {"table": ((1.0, 2.0, 0.8), IDENTITY_POSE[1])}


def seen(i: int = 0, anchor: str = "table", epoch: int = 1, pose: Pose = IDENTITY) -> Observation:
    return Observation(anchor, "qr", pose, i, epoch, viewpoint_id=i)


def test_a_misprinted_sheet_is_told_though_none_of_its_observations_is_used() -> None:
    desk = ConnectionEstimator(ANCHORS, PERIOD, {"table": 0.16})
    for i in range(20):
        assert not desk.add_observation(msgspec.structs.replace(seen(i), size_m=0.2))
    assert desk.is_due(0)
    proposal = desk.propose(0)
    assert proposal is not None
    assert proposal.refused
    assert "measures 200 mm, not 160 mm" in proposal.advice
    for i in range(20, 40):
        assert desk.add_observation(msgspec.structs.replace(seen(i), size_m=0.161))
    proposal = desk.propose(PERIOD)
    assert proposal is not None
    assert not proposal.refused


def test_looks_against_gravity_come_with_advice() -> None:
    """A sheet that hangs on a wall where one that lies is configured, and one of which a few were seen wrongly."""
    on_a_wall = Pose((0.0, 0.0, -0.5), quat_from_rotvec((math.pi / 2.0, 0.0, 0.0)))
    desk = ConnectionEstimator(ANCHORS, PERIOD)
    for i in range(8):
        desk.add_observation(seen(i, pose=Pose((0.0, 0.0, -0.5), IDENTITY.q)))
    assert not desk.add_observation(seen(8, pose=on_a_wall))
    desk.propose(0)
    report = desk.complete_report(None, 0)
    assert report is not None
    assert "not used: 1 against gravity (seen wrongly: step closer; if it is most of them, configure" in report.advice


def test_too_few_observations_are_refused_with_advice_once() -> None:
    desk = ConnectionEstimator(ANCHORS, PERIOD)
    assert not desk.is_due(0)
    assert desk.add_observation(seen())
    assert desk.is_due(0)
    proposal = desk.propose(0)
    assert proposal is not None
    assert proposal.refused
    assert proposal.advice
    desk.add_observation(seen(1))
    assert not desk.is_due(PERIOD - 1)
    assert desk.is_due(PERIOD)
    assert desk.propose(PERIOD) is None, "the same refusal again"


def test_enough_observations_align() -> None:
    desk = ConnectionEstimator(ANCHORS, PERIOD)
    for i in range(8):
        desk.add_observation(seen(i, pose=Pose((0.0, 0.0, -0.2), IDENTITY.q)))
    proposal = desk.propose(0)
    assert proposal is not None
    assert not proposal.refused
    assert math.dist(proposal.T_world_tracking.p, (1.0, 2.0, 1.0)) < 1e-6
    assert proposal.n_observations == 8
    assert len(proposal.covariance) == 36


def test_an_unknown_anchor_names_the_known_ones() -> None:
    desk = ConnectionEstimator(ANCHORS, PERIOD)
    assert not desk.add_observation(seen(anchor="door", epoch=3))
    proposal = desk.propose(0)
    assert proposal is not None
    assert proposal.refused
    assert proposal.tracking_epoch == 3
    assert "door" in proposal.advice
    assert "table" in proposal.advice


def test_hostile_numbers_are_of_no_use_and_harm_nothing() -> None:
    desk = ConnectionEstimator(ANCHORS, PERIOD)
    for value in (math.nan, math.inf, 1e308, -1e308):
        for pose in (Pose((value, 0.0, 0.0), IDENTITY.q), Pose((0.0, 0.0, 0.0), (value, 0.0, 0.0, 0.0))):
            assert not desk.add_observation(seen(pose=pose))
    assert not desk.add_observation(seen(pose=Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))))
    assert not desk.is_due(0)


FLOAT = st.floats() | st.sampled_from([1e308, -1e308, 1e-308, 0.0, 1.0])


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(
            st.tuples(FLOAT, FLOAT, FLOAT),
            st.tuples(FLOAT, FLOAT, FLOAT, FLOAT) | st.just(IDENTITY.q),
            st.integers(0, 2**63 - 1),
            FLOAT,
            st.just(()) | st.lists(FLOAT, min_size=36, max_size=36).map(tuple),
            st.integers(0, 3),
        ),
        max_size=12,
    )
)
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # numpy's word on overflow; the authority judges the result
def test_no_observation_raises(rows: list[tuple[object, ...]]) -> None:
    desk = ConnectionEstimator(ANCHORS, PERIOD)
    for i, (p, q, epoch, quality, covariance, viewpoint) in enumerate(rows):
        message = Observation(
            "table",
            "qr",
            Pose(p, q),  # type: ignore[arg-type]
            epoch,  # type: ignore[arg-type]
            epoch,  # type: ignore[arg-type]
            viewpoint_id=viewpoint,  # type: ignore[arg-type]
            quality=quality,  # type: ignore[arg-type]
            covariance=covariance,  # type: ignore[arg-type]
        )
        desk.add_observation(message)
        proposal = desk.propose(i * PERIOD)
        if proposal is not None:
            decode_entry(encode_entry(Entry(1, 1, 0, proposal)))


def test_an_unknown_sheet_beside_a_known_one_replaces_no_estimate_and_is_told_once() -> None:
    desk = ConnectionEstimator(ANCHORS, PERIOD)
    for i in range(8):
        desk.add_observation(seen(i, pose=Pose((0.0, 0.0, -0.2), IDENTITY.q)))
        assert not desk.add_observation(seen(i, anchor="poster"))
    proposal = desk.propose(0)
    assert proposal is not None
    assert not proposal.refused
    told = desk.propose(PERIOD)
    assert told is not None
    assert "poster" in told.advice
    desk.add_observation(seen(9, anchor="poster"))
    assert not desk.is_due(2 * PERIOD)
    desk.add_observation(seen(10, anchor="poster", epoch=2))
    assert not desk.is_due(2 * PERIOD), "the authority would leave out a second refusal within a second"
    assert desk.is_due(9 * PERIOD), "in a new tracking frame it is worth a word again"


def test_advice_that_names_many_sheets_still_fits_into_a_proposal() -> None:
    names = [f"sheet on the far side of the laboratory, number {k:02}" for k in range(12)]
    desk = ConnectionEstimator({name: ((float(k), 0.0, 0.8), IDENTITY_POSE[1]) for k, name in enumerate(names)}, PERIOD)
    for k, name in enumerate(names):  # each as if it alone were right: none agrees with another
        for i in range(6):
            desk.add_observation(
                msgspec.structs.replace(seen(i, name, pose=Pose((-2.0 * k, k, 0.8), IDENTITY.q)), viewpoint_id=0)
            )
    proposal = desk.propose(0)
    assert proposal is not None
    assert proposal.refused
    assert names[0] in proposal.advice
    assert decode_entry(encode_entry(Entry(1, 1, 0, proposal))).message == proposal


def test_what_cannot_be_solved_is_refused_in_the_epoch_it_was_seen_in(monkeypatch: pytest.MonkeyPatch) -> None:
    """The authority ignores proposals of older epochs: with another number the wearer would never be told."""
    desk = ConnectionEstimator(ANCHORS, PERIOD)
    desk.add_observation(seen(epoch=3))

    def fails(_: object) -> None:
        raise ArithmeticError

    monkeypatch.setattr("anchors.alignment.AlignmentEstimator.estimate", fails)
    proposal = desk.propose(0)
    assert proposal is not None
    assert (proposal.refused, proposal.tracking_epoch) == (True, 3)


def test_a_refusal_soon_after_another_is_said_once_more() -> None:
    """The authority tells one a second: else the second reason would never be told."""
    desk = ConnectionEstimator(ANCHORS, PERIOD, {"table": 0.16})
    desk.add_observation(seen(0))
    assert desk.propose(0) is not None
    said = []
    for i in range(1, 40):
        desk.add_observation(msgspec.structs.replace(seen(i), size_m=0.2))
        proposal = desk.propose(i * PERIOD)
        if proposal is not None:
            assert "measures 200 mm" in proposal.advice
            said.append(i)
    assert said == [1, 9]
