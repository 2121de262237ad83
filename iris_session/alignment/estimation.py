"""Turns what one connection observed into alignment proposals, at a bounded rate. The mathematics is `anchors`'."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import msgspec
import numpy as np

from anchors.alignment import AlignmentEstimate, AlignmentEstimator
from anchors.controller import controller_covariance
from anchors.pose import IDENTITY_POSE, PoseTuple, Vec3
from iris_session.alignment.touch import TouchDesk
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.common import MAX_TEXT, Pose
from iris_session.protocol.entries import AlignmentProposal
from iris_session.protocol.names import AnchorKind
from iris_session.protocol.status import AlignmentReport, AnchorSeen

#: What numbers of a stranger can make of linear algebra.
UNSOLVABLE: Final = (ArithmeticError, ValueError, np.linalg.LinAlgError)
AGAINST_GRAVITY: Final = (
    "against gravity (seen wrongly: step closer; if it is most of them, configure how the sheet lies)"
)
#: The authority tells a wearer of at most one refusal a second: one that follows another sooner may not have been told.
_CLOSE_NS: Final = 1_500_000_000
#: How fast a tracking frame may drift (docs/anchors.md).
_DRIFT_M_PER_S: Final = 0.003 / 60.0
_CONTROLLER: Final = controller_covariance()


class AlignmentDesk:
    """Observations in, proposals out: when something new was observed, and at most one per `period_ns`.

    `newest`: the last estimate that was not refused, of what is observed now.
    """

    def __init__(
        self, anchors: Mapping[str, PoseTuple], period_ns: int, sizes: Mapping[str, float] = MappingProxyType({})
    ) -> None:
        """`anchors`: `T_world_anchor`, as it is now. `sizes`: edge of the printed sheets [m], where it is known."""
        self._anchors = anchors
        self._period_ns = period_ns
        self._sizes = sizes
        self.begin()

    def begin(self) -> None:
        """A run begins: nothing that was observed before counts."""
        self.running = True
        self._estimator = AlignmentEstimator(self._anchors, sizes=self._sizes)
        self._touches = TouchDesk(self._anchors)
        self._seen: dict[str, tuple[int, int]] = {}  # anchors: how often, and when last
        self._used = self._unusable = 0
        self._next_ns = 0
        self._unknown: tuple[str, int] | None = None  # anchor and tracking epoch, to be told
        self._told: tuple[str, int] | None = None
        self._refused_ns = -_CLOSE_NS
        self._again = False  # the last refusal came too soon after another: it is said once more
        self.start_anew()

    def start_anew(self) -> None:
        """What was observed in this run holds no more: the tracking frame is another one."""
        self._estimator.start_anew()
        self._touches.forget()
        self._pending = False  # something that changes the estimate, or what is told, came since the last one
        self._refused: tuple[int, str] | None = None  # tracking epoch and advice of the last refusal
        self._touched: tuple[int, float, int] | None = None  # an alignment by touch: epoch, stated error, time
        self._last: AlignmentEstimate | None = None  # also when it was refused
        self.newest: AlignmentEstimate | None = None

    def anchors_moved(self) -> None:
        """Anchors are elsewhere: what was observed holds, what was made of it does not."""
        self._touches.anchors_moved()
        self._refused = self._touched = self.newest = None
        self._pending = self._used > 0

    def observe(self, observation: Observation, p_tracking_head: Vec3 | None = None, now_ns: int = 0) -> bool:
        """Takes one observation. False: it is of no use (unknown anchor, old tracking epoch, not a rigid transform, a
        sheet of another size than configured)."""
        anchor_id = observation.anchor_id
        if not self.running:
            return True  # it would be, were anybody to ask
        if anchor_id in self._anchors:
            used = self._take(observation, p_tracking_head)
        else:
            used = False
            unknown = (anchor_id, observation.tracking_epoch)
            if unknown != self._told:
                self._unknown = unknown
        if used:
            self._used += 1
            self._seen[anchor_id] = (self._seen.get(anchor_id, (0, 0))[0] + 1, now_ns)
        else:
            self._unusable += 1
        return used

    def _take(self, observation: Observation, p_tracking_head: Vec3 | None) -> bool:
        pose, covariance = observation.T_tracking_anchor, observation.covariance
        if observation.kind == AnchorKind.TOUCH:
            return self._touches.touch(observation.anchor_id, pose.p, observation.tracking_epoch)
        if observation.kind == AnchorKind.CONTROLLER:  # tracked, not seen: no distance makes it worse, none mirrors it
            covariance, p_tracking_head = covariance or _CONTROLLER, None
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
                covariance=covariance,
                p_tracking_head=p_tracking_head,
            )
        except UNSOLVABLE:
            return False
        # A sheet of the wrong size is of no use, but it is to be told.
        self._pending = self._pending or used or self._estimator.wrong_size > misprints
        return used

    def due(self, now_ns: int) -> bool:
        unknown = self._unknown is not None and now_ns - self._refused_ns >= _CLOSE_NS
        return self.running and now_ns >= self._next_ns and (self._pending or self._touches.pending or unknown)

    def propose(self, now_ns: int) -> AlignmentProposal | None:
        """Estimates from everything observed. `None`: the same refusal as before, for the same reason, or nothing
        better than marks that were touched.

        When nothing new is of use, an anchor that is not known is told of, once: it may hang beside one that is.
        """
        self._next_ns = now_ns + self._period_ns
        if not self._pending and not self._touches.pending and self._unknown is not None:
            self._told, self._unknown, self._refused_ns = self._unknown, None, now_ns
            return self._unknown_anchor(*self._told)
        try:
            estimate = self._estimated(now_ns)
        except UNSOLVABLE:
            text = "the observations of the anchor cannot be solved: look at it from elsewhere"
            return self._worth_telling(_refusal(self._estimator.tracking_epoch, text), now_ns)
        if estimate is None:
            return None
        self._last = estimate
        if estimate.refused:
            return self._worth_telling(_proposal(estimate), now_ns)
        self._refused, self.newest = None, estimate
        return _proposal(estimate)

    def _estimated(self, now_ns: int) -> AlignmentEstimate | None:
        """By touched marks or by what was seen; `None`: the latter, and it is worse than the former."""
        if self._touches.pending:
            estimate = self._touches.estimate()
            if not estimate.refused:
                self._touched = (estimate.tracking_epoch, estimate.error_at_anchor_m, now_ns)
            return estimate
        self._pending = False
        estimate = self._estimator.estimate()
        if self._touched is not None and self._touched[0] == estimate.tracking_epoch:
            _, error_m, touched_ns = self._touched
            if not estimate.error_at_anchor_m < error_m + _DRIFT_M_PER_S * (now_ns - touched_ns) * 1e-9:
                return None
        self._touched = None
        return estimate

    def _worth_telling(self, proposal: AlignmentProposal, now_ns: int) -> AlignmentProposal | None:
        """A refusal that is another than before, or may not have been told."""
        refused = (proposal.tracking_epoch, proposal.advice)
        close = now_ns - self._refused_ns < _CLOSE_NS
        if refused == self._refused and (close or not self._again):
            return None
        self._again, self._refused_ns, self._refused = close, now_ns, refused
        return proposal

    def _unknown_anchor(self, anchor_id: str, tracking_epoch: int) -> AlignmentProposal:
        known = ", ".join(sorted(self._anchors)) or "none"
        return _refusal(tracking_epoch, f"anchor '{anchor_id}' is not of this session; known: {known}")

    def report(self, half: AlignmentReport | None, now_ns: int) -> AlignmentReport | None:
        """The authority's half of the report (`None`: it says nothing) with ours."""
        if not self._used and not self._unusable:
            return half
        last = self._last
        return msgspec.structs.replace(
            half or AlignmentReport(running=self.running),
            observations=self._used,
            viewpoints=0 if last is None else last.n_viewpoints,
            unusable=self._unusable,
            residual_tilt_rad=0.0 if last is None else last.residual_tilt_rad,
            advice=self._advice()[:MAX_TEXT],
            seen=tuple(AnchorSeen(a, n, max(0, now_ns - ns)) for a, (n, ns) in sorted(self._seen.items())),
        )

    def _advice(self) -> str:
        """What the last estimate advises, and why observations were of no use."""
        e = self._estimator
        counted = {"of a void tracking frame": e.stale_epochs, "no poses": e.invalid, "of a wrong size": e.wrong_size}
        counted[AGAINST_GRAVITY] = e.against_gravity
        useless = ", ".join(f"{n} {why}" for why, n in counted.items() if n)
        told = ["" if self._last is None else self._last.advice, self._touches.advice]
        return "; ".join(filter(None, [*told, f"not used: {useless}" if useless else ""]))


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
