"""Turn the observations of one connection into alignment proposals at a bounded rate.

By sheets and tracked controllers, whose mathematics is in `anchors.alignment`. Touched marks and kept anchors
(`alignment.touches`) take part in the same proposals.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

import msgspec
import numpy as np

from anchors.alignment import AlignmentEstimate, AlignmentEstimator
from anchors.controller import controller_covariance
from anchors.drift import Alarm
from anchors.looks import Look
from anchors.places import TWO_PRINTS
from anchors.pose import IDENTITY_POSE, PoseTuple, Vec3
from iris_session.alignment.touches import MAX_TIPS, TouchEstimator
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.common import MAX_TEXT, Pose
from iris_session.protocol.entries import AlignmentProposal, AnchorLooks
from iris_session.protocol.names import AlignmentKind, AnchorKind, ObservationSource
from iris_session.protocol.status import AlignmentReport, AnchorSeen

#: Errors that linear algebra raises for extreme input of a client.
NUMERICAL_ERRORS: Final = (ArithmeticError, ValueError, np.linalg.LinAlgError)
AGAINST_GRAVITY: Final = (
    "against gravity (seen wrongly: step closer; if it is most of them, configure how the sheet lies)"
)
#: An observation that is older or newer than this is none of now.
MAX_LATE_NS: Final = 5_000_000_000
LATE: Final = "captured more than 5 s before or after now (capture_ns is session time)"
#: The authority notifies a wearer of at most one refusal a second; one that follows another sooner may be lost.
_CLOSE_NS: Final = 1_500_000_000
#: So many poses in a row that are no looks are reported: a headset at 72 Hz repeats some that its source did not renew.
_MANY_FAULTS: Final = 50
#: How fast a tracking frame may drift (docs/anchors.md).
_DRIFT_M_PER_S: Final = 0.003 / 60.0
_CONTROLLER: Final = controller_covariance()
_MAX_NAMES: Final = 32  # in one message


class ConnectionEstimator:
    """Estimator of one connection: a proposal when something new was observed, at most one per period.

    `running`: false while the participant's run is stopped; observations are then ignored. `newest`: the last estimate
    that was not refused and that may be driven with, `None` after a reset.
    """

    def __init__(
        self,
        anchors: Mapping[str, PoseTuple],
        period_ns: int,
        sizes: Mapping[str, float] = MappingProxyType({}),
        marks: Mapping[str, Mapping[str, Vec3]] = MappingProxyType({}),
    ) -> None:
        """Create an estimator.

        Args:
            anchors: Present `T_world_anchor`, updated by the owner.
            period_ns: Least time between two proposals.
            sizes: Edge length [m] of printed sheets, where known.
            marks: Positions of marks by anchor and id of the mark, in the anchor frame [m].
        """
        self._anchors = anchors
        self._period_ns = period_ns
        self._sizes = sizes
        self._marks = marks
        self._tips: dict[str, tuple[float, ...]] = {}
        self.start_run()

    def start_run(self) -> None:
        """Begin a new run: earlier observations no longer count."""
        self.running = True
        self._estimator = AlignmentEstimator(self._anchors, sizes=self._sizes)
        self._touches = TouchEstimator(self._anchors, self._marks, self._tips)
        self._observed: dict[str, tuple[int, int]] = {}  # anchor -> number of observations, time of the last [ns]
        self._used = self._unusable = 0
        self._looked_ns = 0  # when the newest sheet or controller that was used was received
        self._faults: dict[str, int] = {}  # poses that were no looks, by reason
        self._in_a_row = 0
        self._next_ns = 0
        self._wrong: tuple[int, str] | None = None  # tracking epoch, why an observation was refused; not yet reported
        self._is_wrong_touch = False  # it was a touch: its person waits for the answer
        self._reported_wrong: tuple[int, str] | None = None
        self._refused_ns = -_CLOSE_NS
        self._repeat_refusal = False  # the last refusal came too soon after another: send it once more
        self.reset()

    def reset(self) -> None:
        """Discard the observations of this run: the tracking frame has changed."""
        self._estimator.reset()
        self._touches.reset()
        self._touches_last = False  # the last estimate was by touched marks or a kept anchor
        self._pending = False  # an observation since the last proposal changes the estimate or its advice
        self._refused: tuple[int, str] | None = None  # tracking epoch and advice of the last refusal
        self._touched: tuple[int, float, int] | None = None  # alignment by touch: epoch, stated error [m], time [ns]
        self._last: AlignmentEstimate | None = None  # also when it was refused
        self.newest: AlignmentEstimate | None = None

    def weigh_alarm(self, alarm: Alarm) -> tuple[str, ...] | None:
        """Keep what was seen of other sheets when one contradicts the alignment in force; the next looks decide.

        Returns:
            The sheets that outvote it (`AlignmentEstimator.weigh_alarm`), `None` if it is no contradiction; else empty,
            and nothing is proposed that was seen before.
        """
        beside: tuple[str, ...] | None
        try:
            beside = self._estimator.weigh_alarm(alarm.anchor_id, alarm.since_ns)
        except NUMERICAL_ERRORS:
            beside = ()
            self._estimator.reset()
        if beside == ():
            self._touches.reset()
            self._pending, self._last = False, None
            self._refused = self._touched = self.newest = None
        return beside

    def leave_out(self, alarm: Alarm) -> None:
        """Leave out a sheet that was moved, until it is seen where it was or given a new pose."""
        self._estimator.leave_out(alarm.anchor_id, alarm.since_ns)

    def refuse_prints(self, anchor_id: str, tracking_epoch: int) -> None:
        """Discard what was seen of an anchor of which there are two prints, and report it as refused."""
        self._estimator.discard_anchor(anchor_id)
        self._pending, self._last, self.newest = False, None, None
        self._note_wrong((tracking_epoch, f"sheet '{anchor_id}' is {TWO_PRINTS}"), False)

    def set_tip(self, device: str, covariance: tuple[float, ...]) -> None:
        """Set the covariance of the tip of a device (3x3 row-major, grip frame [m^2]); its earlier touches no longer
        count."""
        self._tips.pop(device, None)
        self._tips[device] = covariance
        self._touches.discard_touches(device)
        if len(self._tips) > MAX_TIPS:
            oldest = next(iter(self._tips))
            self._touches.discard_touches(oldest)
            del self._tips[oldest]

    def on_anchors_moved(self) -> None:
        """Discard estimates, but keep observations: they stay valid when an anchor is given a new pose."""
        self._touches.on_anchors_moved()
        self._estimator.on_anchors_moved()
        self._refused = self._touched = self.newest = None
        self._pending = self._used > 0

    def add_observation(self, observation: Observation, look: Look | None = None, now_ns: int = 0) -> bool:
        """Add one observation; `look`: what is known of it as a look.

        Returns:
            False if it is unusable: unknown anchor, old tracking epoch, not a rigid transform, or a sheet of another
            size than configured.
        """
        anchor_id = observation.anchor_id
        if not self.running:
            return True  # not judged
        wrong = self._describe_wrong(observation)
        if wrong:
            used = False
            self._note_wrong((observation.tracking_epoch, wrong), observation.kind == AnchorKind.TOUCH)
        else:
            used = self._use_observation(observation, look or Look(observation.viewpoint_id), now_ns)
            if used and observation.kind == AnchorKind.TOUCH and self._is_wrong_touch:
                self._wrong = None
        if used:
            self._in_a_row = 0
            self._used += 1
            self._observed[anchor_id] = (self._observed.get(anchor_id, (0, 0))[0] + 1, now_ns)
        else:
            self._unusable += 1
        return used

    def find_touch_sigma(self, observation: Observation) -> float | None:
        """Return the noise of a touch per axis [m], `None` if its covariance is invalid."""
        return self._touches.find_sigma(observation)

    def _note_wrong(self, wrong: tuple[int, str], is_touch: bool) -> None:
        """Note an observation to be reported as refused; unknown sheets do not displace a touch."""
        if wrong == self._reported_wrong or (self._wrong is not None and self._is_wrong_touch and not is_touch):
            return
        self._wrong, self._is_wrong_touch = wrong, is_touch

    def count_fault(self, fault: str, tracking_epoch: int, is_known: bool) -> None:
        """Count a pose that is no look (`anchors.looks`), and report it if many follow each other."""
        if not self.running:
            return
        self._unusable += 1
        self._faults[fault] = self._faults.get(fault, 0) + 1
        self._in_a_row = self._in_a_row + 1 if is_known else 0
        if self._in_a_row >= _MANY_FAULTS:
            self._note_wrong((tracking_epoch, f"poses of the sheet are not used: {fault}"), False)

    def refuse_late(self, observation: Observation) -> None:
        """Count an observation that was not captured just now; of a touch or a kept anchor it is reported at once."""
        is_known = observation.anchor_id in self._anchors
        self.count_fault(LATE, observation.tracking_epoch, is_known)
        if self.running and is_known and observation.kind in AnchorKind.NOT_SEEN:
            text = f"the {observation.kind} observation of '{observation.anchor_id}' is not used: {LATE}"
            self._note_wrong((observation.tracking_epoch, text), observation.kind == AnchorKind.TOUCH)

    def _use_observation(self, observation: Observation, look: Look, now_ns: int) -> bool:
        pose, covariance, p_tracking_head = observation.T_tracking_anchor, observation.covariance, look.p_tracking_head
        if observation.kind == AnchorKind.TOUCH:
            return self._touches.add_touch(observation, now_ns)
        if observation.kind == AnchorKind.PERSISTENT:
            return self._touches.add_persistent(observation, now_ns)
        if observation.kind == AnchorKind.CONTROLLER:  # tracked: neither distance nor mirrored poses matter
            covariance, p_tracking_head = covariance or _CONTROLLER, None
        misprints = self._estimator.wrong_size
        try:
            used = self._estimator.add(
                observation.anchor_id,
                (pose.p, pose.q),
                observation.capture_ns,
                observation.tracking_epoch,
                viewpoint_id=look.viewpoint_id,
                quality=observation.quality,
                size_m=observation.size_m,
                covariance=covariance,
                p_tracking_head=p_tracking_head,
                source=_choose_source(observation),
                shift=look.shift,
                alternative=find_alternative(observation),
                residuals=observation.residuals_px,
            )
        except NUMERICAL_ERRORS:
            return False
        # A sheet of the wrong size is unusable, but the advice must mention it.
        self._pending = self._pending or used or self._estimator.wrong_size > misprints
        if used:
            self._looked_ns = now_ns
        return used

    def is_due(self, now_ns: int) -> bool:
        """Return whether `propose` has something to do."""
        wrong = self._wrong is not None and now_ns - self._refused_ns >= _CLOSE_NS
        return self.running and now_ns >= self._next_ns and (self._pending or self._touches.pending or wrong)

    def propose(self, now_ns: int) -> AlignmentProposal | None:
        """Return a proposal from all observations.

        `None`: the same refusal as before for the same reason, no improvement on marks that were touched, or the
        newest look contradicts the others, so that they alone confirm nothing. An invalid touch is reported first, an
        unknown anchor when nothing usable is new (it may hang beside a known one); once.
        """
        self._next_ns = now_ns + self._period_ns
        is_first = self._is_wrong_touch and now_ns - self._refused_ns >= _CLOSE_NS
        if self._wrong is not None and (is_first or not (self._pending or self._touches.pending)):
            self._reported_wrong, self._wrong, self._refused_ns = self._wrong, None, now_ns
            return _to_refusal(*self._reported_wrong)
        try:
            estimate, kind = self._estimate(now_ns)
        except NUMERICAL_ERRORS:
            text = "the observations of the anchor cannot be solved: look at it from elsewhere"
            return self._filter_refusal(_to_refusal(self._estimator.tracking_epoch, text), now_ns)
        if estimate is None:
            return None
        self._last = estimate
        if estimate.refused:
            return self._filter_refusal(_to_proposal(estimate, kind, 0), now_ns)
        self._refused = None
        if self.newest is not None and not estimate.supported and estimate.moved == self.newest.moved:
            return None
        if kind == AlignmentKind.MEASURED:
            self.newest = estimate
        return _to_proposal(estimate, kind, self._find_look(estimate))

    def _find_look(self, estimate: AlignmentEstimate) -> int:
        """Return when the newest look was received that agrees with the last estimate; capture times are a client's."""
        looked_ns = self._touches.looked_ns if self._touches_last else self._looked_ns
        if estimate.supported:
            return looked_ns
        return max(1, min(looked_ns, max((last_ns for _, _, last_ns in estimate.looks), default=0)))

    def _estimate(self, now_ns: int) -> tuple[AlignmentEstimate | None, str]:
        """Return an estimate by touched marks or a kept anchor if any are new, else by observations, and its
        `AlignmentKind`; `None` if the latter is worse than a former one by touch. They take turns where both are new:
        a kept anchor may be reported in every frame."""
        if self._touches.pending and not (self._pending and self._touches_last):
            self._touches_last = True
            estimate, kind = self._touches.estimate()
            if not estimate.refused and kind == AlignmentKind.MEASURED:
                self._touched = (estimate.tracking_epoch, estimate.error_at_anchor_m, now_ns)
            return estimate, kind
        self._pending = self._touches_last = False
        estimate = self._estimator.estimate()
        if self._touched is not None and self._touched[0] == estimate.tracking_epoch:
            _, error_m, touched_ns = self._touched
            if not estimate.error_at_anchor_m < error_m + _DRIFT_M_PER_S * (now_ns - touched_ns) * 1e-9:
                return None, AlignmentKind.MEASURED
        self._touched = None
        return estimate, AlignmentKind.MEASURED

    def _filter_refusal(self, proposal: AlignmentProposal, now_ns: int) -> AlignmentProposal | None:
        """Return the refusal if it differs from the last one, or if the last one may not have reached the wearer."""
        refused = (proposal.tracking_epoch, proposal.advice)
        close = now_ns - self._refused_ns < _CLOSE_NS
        if refused == self._refused and (close or not self._repeat_refusal):
            return None
        self._repeat_refusal, self._refused_ns, self._refused = close, now_ns, refused
        return proposal

    def _describe_wrong(self, observation: Observation) -> str:
        """Return why an observation is of no kind, anchor or mark, or states an invalid covariance; empty if it does
        not."""
        anchor_id, mark = observation.anchor_id, observation.mark
        if observation.kind not in AnchorKind.ALL:
            return f"there is no kind of observation '{observation.kind}': {', '.join(sorted(AnchorKind.ALL))}"
        if anchor_id not in self._anchors:
            return f"anchor '{anchor_id}' is not of this session; known: {', '.join(sorted(self._anchors)) or 'none'}"
        if not self._touches.has_mark(anchor_id, mark):
            marks = ", ".join(sorted(self._marks.get(anchor_id, ()))) or "none"
            return f"anchor '{anchor_id}' has no mark '{mark}'; known: {marks} (marks_m in the anchors file)"
        if observation.kind == AnchorKind.TOUCH and not self._touches.is_covariance_valid(observation):
            touched = f"'{anchor_id}/{mark}'" if mark else f"'{anchor_id}'"
            return (
                f"the covariance of the touch of {touched} is not 36 values with a finite, symmetric and positive "
                "definite position (rows and columns 0 to 2): send that, or none"
            )
        return ""

    def complete_report(self, report: AlignmentReport | None, now_ns: int) -> AlignmentReport | None:
        """Return the authority's report (`None`: nothing to report) with the counts and advice of this estimator."""
        if not self._used and not self._unusable:
            return report
        last = self._last
        return msgspec.structs.replace(
            report or AlignmentReport(running=self.running),
            observations=self._used,
            viewpoints=0 if last is None else last.n_viewpoints,
            unusable=self._unusable,
            residual_tilt_rad=0.0 if last is None else last.residual_tilt_rad,
            advice=self._advice()[:MAX_TEXT],
            seen=tuple(AnchorSeen(a, n, max(0, now_ns - ns)) for a, (n, ns) in sorted(self._observed.items())),
        )

    def _advice(self) -> str:
        """Return the advice of the last estimate, and why observations were unusable."""
        e = self._estimator
        counted = {"of a void tracking frame": e.stale_epochs, "no poses": e.invalid, "of a wrong size": e.wrong_size}
        counted[AGAINST_GRAVITY] = e.against_gravity
        counted |= self._faults
        unusable = ", ".join(f"{n} {why}" for why, n in counted.items() if n)
        parts = ["" if self._last is None else self._last.advice, self._touches.advice]
        return "; ".join(filter(None, [*parts, f"not used: {unusable}" if unusable else ""]))


def _to_refusal(tracking_epoch: int, advice: str) -> AlignmentProposal:
    p, q = IDENTITY_POSE
    return AlignmentProposal(Pose(p, q), tracking_epoch, (), p, 0.0, refused=True, advice=advice[:MAX_TEXT])


def find_alternative(observation: Observation) -> PoseTuple | None:
    """Return the other pose of a sheet; a controller has none."""
    other = observation.alternative
    return None if other is None or observation.kind == AnchorKind.CONTROLLER else (other.p, other.q)


def _choose_source(observation: Observation) -> str:
    """Return the source whose biases count: one that fits the kind, and of an unknown name the one that errs most."""
    if observation.kind == AnchorKind.CONTROLLER:
        return ObservationSource.HOLDER
    is_camera = observation.source in ("", ObservationSource.QR_CAMERA)
    return ObservationSource.QR_CAMERA if is_camera else ObservationSource.QR_SYSTEM


def _to_proposal(estimate: AlignmentEstimate, kind: str, looked_ns: int) -> AlignmentProposal:
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
        kind=kind,
        tilt_noise_rad=estimate.tilt_noise_rad,
        look_s=estimate.look_s,
        looks=tuple(AnchorLooks(name, first, last) for name, first, last in estimate.looks[:_MAX_NAMES]),
        moved=estimate.moved[:_MAX_NAMES],
        looked_ns=looked_ns,
    )
