"""Observations of one connection become proposals at a bounded rate, and only on change."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from anchors.alignment import mirror_pose
from anchors.lie import to_vec3
from anchors.looks import Look
from anchors.pose import IDENTITY_POSE, PoseTuple, apply, compose, distance, inverse, quat_angle
from iris_session.alignment.estimator import ConnectionEstimator
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.common import IDENTITY, Pose
from iris_session.protocol.entries import Entry, decode_entry, encode_entry
from tests.anchors.worlds import Viewpoint, tracking_frame

PERIOD = 200_000_000
ANCHORS: dict[str, PoseTuple] = {"table": ((1.0, 2.0, 0.8), IDENTITY_POSE[1])}


def observation(i: int = 0, anchor: str = "table", epoch: int = 1, pose: Pose = IDENTITY) -> Observation:
    return Observation(anchor, "qr", pose, i, epoch, viewpoint_id=i)


def test_size_of_misprinted_sheet_is_reported_when_all_observations_are_excluded() -> None:
    estimator = ConnectionEstimator(ANCHORS, PERIOD, {"table": 0.16})
    for i in range(20):
        assert not estimator.add_observation(msgspec.structs.replace(observation(i), size_m=0.2))
    assert estimator.is_due(0)
    proposal = estimator.propose(0)
    assert proposal is not None
    assert proposal.refused
    assert "200 mm, not 160 mm" in proposal.advice
    for i in range(20, 40):
        assert estimator.add_observation(msgspec.structs.replace(observation(i), size_m=0.161))
    proposal = estimator.propose(PERIOD)
    assert proposal is not None
    assert not proposal.refused


@pytest.mark.parametrize(("reports", "is_solved"), [("both", True), ("one", False), ("one that fits badly", False)])
def test_of_two_poses_that_are_both_upright_the_level_one_is_used(reports: str, is_solved: bool) -> None:
    """From nearly overhead the mirrored pose is tilted by about 10 degrees; a detector returns it first every other
    time."""
    rng = np.random.default_rng(7)
    frame = tracking_frame(rng)
    estimator = ConnectionEstimator(ANCHORS, PERIOD)
    for place, (x, y) in enumerate(((0.05, 0.0), (-0.04, 0.04), (0.0, -0.06))):
        p_head = to_vec3(np.add(ANCHORS["table"][0], (x, y, 0.6)))
        view = Viewpoint(rng, ANCHORS["table"], p_head)
        for i in range(20):
            seen, head = view.observe(frame), view.head_pose(frame)
            first, second = rng.permutation([0, 1])
            poses = [Pose(*seen), Pose(*mirror_pose(seen, head))]
            one = msgspec.structs.replace(observation(20 * place + i, pose=poses[first]), residuals_px=(0.30, 0.31))
            if reports == "both":
                one = msgspec.structs.replace(one, alternative=poses[second])
            elif reports != "one":
                one = msgspec.structs.replace(one, alternative=poses[second], residuals_px=(0.30, 0.70))
            estimator.add_observation(one, Look(place, head))
    proposal = estimator.propose(0)
    assert proposal is not None
    assert proposal.refused is not is_solved
    if is_solved:
        T = proposal.T_world_tracking
        off = compose((T.p, T.q), inverse(frame))
        assert distance(apply(off, ANCHORS["table"][0]), ANCHORS["table"][0]) < 0.005
        assert quat_angle(off[1], IDENTITY.q) < math.radians(1.0)


def test_too_few_observations_are_reported_once() -> None:
    estimator = ConnectionEstimator(ANCHORS, PERIOD)
    assert not estimator.is_due(0)
    assert estimator.add_observation(observation())
    assert estimator.is_due(0)
    proposal = estimator.propose(0)
    assert proposal is not None
    assert proposal.refused
    assert proposal.advice
    estimator.add_observation(observation(1))
    assert not estimator.is_due(PERIOD - 1)
    assert estimator.is_due(PERIOD)
    assert estimator.propose(PERIOD) is None, "the same failure again"


def test_invalid_numbers_are_ignored() -> None:
    estimator = ConnectionEstimator(ANCHORS, PERIOD)
    for value in (math.nan, math.inf, 1e308, -1e308):
        for pose in (Pose((value, 0.0, 0.0), IDENTITY.q), Pose((0.0, 0.0, 0.0), (value, 0.0, 0.0, 0.0))):
            assert not estimator.add_observation(observation(pose=pose))
    assert not estimator.add_observation(observation(pose=Pose((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0))))
    assert not estimator.is_due(0)


FLOAT = st.floats() | st.sampled_from([1e308, -1e308, 1e-308, 0.0, 1.0])


@settings(max_examples=40, deadline=None)
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
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # overflow warning of numpy; the authority judges the result
def test_observations_never_raise(rows: list[tuple[object, ...]]) -> None:
    estimator = ConnectionEstimator(ANCHORS, PERIOD)
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
            alternative=Pose(p, q),  # type: ignore[arg-type]
            residuals_px=(quality, quality),  # type: ignore[arg-type]
        )
        estimator.add_observation(message)
        proposal = estimator.propose(i * PERIOD)
        if proposal is not None:
            decode_entry(encode_entry(Entry(1, 1, 0, proposal)))


def test_unknown_sheet_is_reported_once_and_keeps_the_estimate() -> None:
    estimator = ConnectionEstimator(ANCHORS, PERIOD)
    for i in range(8):
        estimator.add_observation(observation(i, pose=Pose((0.0, 0.0, -0.2), IDENTITY.q)))
        assert not estimator.add_observation(observation(i, anchor="poster"))
    proposal = estimator.propose(0)
    assert proposal is not None
    assert not proposal.refused
    second = estimator.propose(PERIOD)
    assert second is not None
    assert "poster" in second.advice
    estimator.add_observation(observation(9, anchor="poster"))
    assert not estimator.is_due(2 * PERIOD)
    estimator.add_observation(observation(10, anchor="poster", epoch=2))
    assert not estimator.is_due(2 * PERIOD), "the authority drops a second failure within a second"
    assert estimator.is_due(9 * PERIOD), "in a new tracking frame it is reported again"


def test_invalid_touch_is_reported_beside_sheets_in_view() -> None:
    def touch(covariance: tuple[float, ...] = (), mark: str = "") -> Observation:
        return Observation("table", "touch", IDENTITY, 1, 1, covariance=covariance, mark=mark, device="hand/left")

    estimator = ConnectionEstimator(ANCHORS, PERIOD)
    for i in range(8):
        estimator.add_observation(observation(i, pose=Pose((0.0, 0.0, -0.2), IDENTITY.q)))
        assert not estimator.add_observation(touch((0.0,) * 36))
        assert not estimator.add_observation(observation(i, anchor="poster"))
    proposal = estimator.propose(0)
    assert proposal is not None
    assert proposal.advice.startswith("the covariance of the touch of 'table'")
    proposal = estimator.propose(PERIOD)
    assert proposal is not None
    assert not proposal.refused
    assert not estimator.add_observation(touch(mark="9"))
    assert estimator.is_due(9 * PERIOD)
    assert estimator.add_observation(touch())
    proposal = estimator.propose(9 * PERIOD)
    assert proposal is not None
    assert "no mark" not in proposal.advice, "a valid touch came after it"


def test_advice_about_many_sheets_fits_into_a_proposal() -> None:
    names = [f"sheet on the far side of the laboratory, number {k:02}" for k in range(12)]
    estimator = ConnectionEstimator(
        {name: ((float(k), 0.0, 0.8), IDENTITY_POSE[1]) for k, name in enumerate(names)}, PERIOD
    )
    for k, name in enumerate(names):  # each pose contradicts all others
        for i in range(6):
            estimator.add_observation(
                msgspec.structs.replace(observation(i, name, pose=Pose((-2.0 * k, k, 0.8), IDENTITY.q)), viewpoint_id=0)
            )
    proposal = estimator.propose(0)
    assert proposal is not None
    assert proposal.refused
    assert names[0] in proposal.advice
    assert decode_entry(encode_entry(Entry(1, 1, 0, proposal))).message == proposal


def test_second_failure_is_reported_after_the_rate_limit() -> None:
    """The authority sends one reason a second; the second reason must not be lost."""
    estimator = ConnectionEstimator(ANCHORS, PERIOD, {"table": 0.16})
    estimator.add_observation(observation(0))
    assert estimator.propose(0) is not None
    reported = []
    for i in range(1, 40):
        estimator.add_observation(msgspec.structs.replace(observation(i), size_m=0.2))
        proposal = estimator.propose(i * PERIOD)
        if proposal is not None:
            assert "measures 200 mm" in proposal.advice
            reported.append(i)
    assert reported == [1, 9]
