"""Turns the observations of one connection into alignment proposals, at a bounded rate. The estimator is `anchors`'."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import numpy as np

from anchors.alignment import AlignmentEstimate, AlignmentEstimator
from anchors.pose import IDENTITY_POSE, PoseTuple
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.common import MAX_TEXT, Pose
from iris_session.protocol.entries import AlignmentProposal

#: What numbers of a stranger can make of linear algebra.
_UNSOLVABLE: Final = (ArithmeticError, ValueError, np.linalg.LinAlgError)
#: The authority tells a wearer of at most one refusal a second: one that follows another sooner may not have been told.
_CLOSE_NS: Final = 1_500_000_000


class AlignmentDesk:
    """Observations in, proposals out: when something new was observed, and at most one per `period_ns`."""

    def __init__(
        self, anchors: dict[str, PoseTuple], period_ns: int, sizes: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        """`anchors`: `T_world_anchor`. `sizes`: edge of the printed sheets [m], of those whose size is known."""
        self._anchors = anchors
        self._period_ns = period_ns
        self._estimator = AlignmentEstimator(anchors, sizes=sizes)
        self._next_ns = 0
        self._pending = False  # something that changes the estimate, or what is told, came since the last one
        self._unknown: tuple[str, int] | None = None  # anchor and tracking epoch, to be told
        self._told: tuple[str, int] | None = None
        self._refused: tuple[int, str] | None = None  # tracking epoch and advice of the last refusal
        self._refused_ns = -_CLOSE_NS
        self._again = False  # the last refusal came too soon after another: it is said once more

    def observe(self, observation: Observation) -> bool:
        """Takes one observation. False: it is of no use (unknown anchor, old tracking epoch, not a rigid transform, a
        sheet of another size than configured)."""
        if observation.anchor_id not in self._anchors:
            unknown = (observation.anchor_id, observation.tracking_epoch)
            if unknown != self._told:
                self._unknown = unknown
            return False
        pose = observation.T_tracking_anchor
        misprints = self._estimator.wrong_size
        try:
            used = self._estimator.add(
                observation.anchor_id,
                (pose.p, pose.q),
                observation.capture_ns,
                observation.tracking_epoch,
                viewpoint_id=observation.viewpoint_id,
                quality=observation.quality,
                size_m=observation.size_m,
                covariance=observation.covariance,
            )
        except _UNSOLVABLE:
            return False
        # A sheet of the wrong size is of no use, but it is to be told.
        self._pending = self._pending or used or self._estimator.wrong_size > misprints
        return used

    def due(self, now_ns: int) -> bool:
        unknown = self._unknown is not None and now_ns - self._refused_ns >= _CLOSE_NS
        return (self._pending or unknown) and now_ns >= self._next_ns

    def propose(self, now_ns: int) -> AlignmentProposal | None:
        """Estimates from everything observed. `None`: the same refusal as before, for the same reason.

        When nothing new is of use, an anchor that is not known is told of, once: it may hang beside one that is.
        """
        self._next_ns = now_ns + self._period_ns
        if not self._pending and self._unknown is not None:
            self._told, self._unknown, self._refused_ns = self._unknown, None, now_ns
            return self._unknown_anchor(*self._told)
        self._pending = False
        try:
            proposal = _proposal(self._estimator.estimate())
        except _UNSOLVABLE:
            text = "the observations of the anchor cannot be solved: look at it from elsewhere"
            proposal = _refusal(self._estimator.tracking_epoch, text)  # the authority ignores older epochs
        refused = (proposal.tracking_epoch, proposal.advice) if proposal.refused else None
        if refused is not None:
            close = now_ns - self._refused_ns < _CLOSE_NS
            if refused == self._refused and (close or not self._again):
                return None
            self._again, self._refused_ns = close, now_ns
        self._refused = refused
        return proposal

    def _unknown_anchor(self, anchor_id: str, tracking_epoch: int) -> AlignmentProposal:
        known = ", ".join(sorted(self._anchors)) or "none"
        return _refusal(tracking_epoch, f"anchor '{anchor_id}' is not of this session; known: {known}")


def _refusal(tracking_epoch: int, advice: str) -> AlignmentProposal:
    p, q = IDENTITY_POSE
    return AlignmentProposal(Pose(p, q), tracking_epoch, (), p, 0.0, refused=True, advice=advice[:MAX_TEXT])


def _proposal(estimate: AlignmentEstimate) -> AlignmentProposal:
    p, q = estimate.T_world_tracking
    return AlignmentProposal(
        Pose(p, q),
        estimate.tracking_epoch,
        tuple(estimate.covariance),
        estimate.pivot_world,
        estimate.error_at_anchor_m,
        residual_tilt_rad=estimate.residual_tilt_rad,
        n_observations=estimate.n_observations,
        n_viewpoints=estimate.n_viewpoints,
        refused=estimate.refused,
        advice=estimate.advice[:MAX_TEXT],  # it may list many sheets
    )
