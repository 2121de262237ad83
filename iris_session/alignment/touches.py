"""Alignment of one connection by touched marks, and by an anchor that its device kept.

A bounded number of touches is kept and registered together. How well a touch counts depends on the tip: one that was
calibrated in this session, one of which the client states the covariance, or a fingertip. Touches that are too coarse
to drive with make an alignment to look with. The mathematics is in `anchors.touch` and `anchors.persistent`.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from anchors.alignment import AlignmentConfig, AlignmentEstimate
from anchors.controller import calibrate_tip
from anchors.persistent import align_persistent, confirm_alignment
from anchors.pose import (
    IDENTITY_POSE,
    PoseTuple,
    Vec3,
    apply,
    distance,
    is_rigid,
    is_valid_point,
    quat_angle,
    quat_normalize,
)
from anchors.touch import TOUCH_SIGMA_M, Touch, TouchRegistration, register_touches, suggest_point
from anchors.uncertainty import validate_covariance, validate_position_covariance
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.common import MAX_TEXT
from iris_session.protocol.entries import TipSolved
from iris_session.protocol.names import AlignmentKind

#: Newest touches kept per point, and points kept. Eight points that do not fit take 15 ms to analyse.
MAX_TOUCHES_PER_POINT: Final = 5
MAX_POINTS: Final = 8
#: Devices of one participant whose tips are remembered.
MAX_TIPS: Final = 8
#: Noise of a touch per axis: of a fingertip, and of everything that is no calibrated tip and states no covariance.
FINGERTIP_SIGMA_M: Final = 0.010
#: Per axis, of a tip that was not calibrated in this session, of which a client states the noise of its touches:
#: assumed, for a tip that is known to 3 mm.
UNCALIBRATED_TIP_SIGMA_M: Final = 0.003 / math.sqrt(3.0)
#: Coarser touches do not make an alignment to drive with.
MAX_DRIVING_SIGMA_M: Final = 0.004
#: The frame drifts by 3 mm meanwhile: older touches and kept anchors do not count beside a new touch.
MAX_AGE_NS: Final = 60_000_000_000
#: No client can state that its touches are better.
MIN_SIGMA_M: Final = 0.0005
#: A kept anchor that has moved by less is where it was.
_MOVED_M: Final = 0.002
_MOVED_RAD: Final = math.radians(0.2)
_MIN_POINTS: Final = 3
_NOT_USED: Final = "the touched marks contradict the kept anchor: it is not used"
#: Fingertips are less exact than tips at the sheet too.
_FINGERTIP_CONFIG: Final = AlignmentConfig(max_error_m=0.05)

_UNCALIBRATED_TIP: Final = tuple(UNCALIBRATED_TIP_SIGMA_M**2 if i % 4 == 0 else 0.0 for i in range(9))

#: Covariance of the tip of each device (3x3 row-major, grip frame [m^2]).
Tips = Mapping[str, tuple[float, ...]]


class _Point(NamedTuple):
    """A touched point: a mark of an anchor, or (`mark` empty) its origin."""

    anchor_id: str
    mark: str

    @property
    def name(self) -> str:
        return f"{self.anchor_id}/{self.mark}" if self.mark else self.anchor_id


class _Kept(NamedTuple):
    """Pose of an anchor by a place that the device kept; its covariance in the axes of the anchor."""

    anchor_id: str
    T_tracking_anchor: PoseTuple
    covariance: tuple[float, ...]

    def is_like(self, other: _Kept) -> bool:
        """Return whether the other says nothing else."""
        (p, q), (p_other, q_other) = self.T_tracking_anchor, other.T_tracking_anchor
        alike = (self.anchor_id, self.covariance) == (other.anchor_id, other.covariance)
        return alike and distance(p, p_other) < _MOVED_M and quat_angle(q, q_other) < _MOVED_RAD


class TouchEstimator:
    """Touches of one connection and its kept anchor, in one tracking frame.

    `pending`: they suffice for an estimate, and something is new since the last one. `looked_ns`: when the newest that
    counts was received.
    """

    def __init__(
        self,
        anchors: Mapping[str, PoseTuple],
        marks: Mapping[str, Mapping[str, Vec3]],
        tips: dict[str, tuple[float, ...]],
    ) -> None:
        """Create an estimator.

        Args:
            anchors: Present `T_world_anchor`, updated by the owner.
            marks: Positions of marks by anchor and id of the mark, in the anchor frame.
            tips: Calibrated tips of this participant, updated by the owner.
        """
        self._anchors = anchors
        self._marks = marks
        self._tips = tips
        self._touches: dict[_Point, deque[Touch]] = {}
        self._suspects: frozenset[str] = frozenset()
        self._kept: _Kept | None = None
        self._kept_ns = 0  # when it was reported last
        self._tracking_epoch = 0
        self.pending = False
        self.looked_ns = 0

    def has_mark(self, anchor_id: str, mark: str) -> bool:
        """Return whether a known anchor has this mark; every anchor has its origin."""
        return not mark or mark in self._marks.get(anchor_id, {})

    def is_covariance_valid(self, observation: Observation) -> bool:
        """Return whether a touch states no covariance, or one whose position is usable."""
        return self.find_sigma(observation) is not None

    def add_touch(self, observation: Observation, now_ns: int) -> bool:
        """Add one touch of a known anchor; return false if it is of an older tracking frame, no mark of it, or not a
        finite point, or its covariance is invalid."""
        pose = observation.T_tracking_anchor
        point = _Point(observation.anchor_id, observation.mark)
        sigma = self.find_sigma(observation)
        if not self.has_mark(*point) or not is_valid_point(pose.p) or sigma is None:
            return False
        if not self._begin_epoch(observation.tracking_epoch):
            return False
        turned = quat_normalize(pose.q) if is_rigid((pose.p, pose.q)) else IDENTITY_POSE[1]
        touch = Touch(point.name, pose.p, sigma, observation.device, turned, observation.capture_ns)
        if any(replace(t, capture_ns=touch.capture_ns) == touch for t in self._touches.get(point, ())):
            return True  # sent once more
        self._keep_touches(lambda t: observation.capture_ns - t.capture_ns <= MAX_AGE_NS)
        if observation.capture_ns - self._kept_ns > MAX_AGE_NS:
            self._kept = None
        kept = self._touches.pop(point, None) or deque(maxlen=MAX_TOUCHES_PER_POINT)
        if point.name in self._suspects:  # touched again after a refusal: the earlier touches were wrong
            kept.clear()
            self._suspects -= {point.name}
        kept.append(touch)
        self._touches[point] = kept
        while len(self._touches) > MAX_POINTS:
            del self._touches[next(iter(self._touches))]
        self.pending, self.looked_ns = self._suffice(), now_ns
        return True

    def find_sigma(self, observation: Observation) -> float | None:
        """Return the noise of a touch per axis, `None` if its covariance is invalid."""
        is_finger = observation.device.startswith("hand/")
        if not observation.covariance:
            return TOUCH_SIGMA_M if observation.device in self._tips and not is_finger else FINGERTIP_SIGMA_M
        stated = validate_position_covariance(observation.covariance)
        if not stated:
            return None
        largest = float(np.linalg.eigvalsh(np.reshape(stated, (3, 3)))[-1])
        return max(math.sqrt(largest), FINGERTIP_SIGMA_M if is_finger else MIN_SIGMA_M)

    def add_persistent(self, observation: Observation, now_ns: int) -> bool:
        """Set where a known anchor lies by a kept place; return false if that is of an older tracking frame, not a
        pose, or contradicts gravity."""
        pose = observation.T_tracking_anchor
        if not is_rigid((pose.p, pose.q)) or not self._begin_epoch(observation.tracking_epoch):
            return False
        covariance = validate_covariance(observation.covariance)
        kept = _Kept(observation.anchor_id, (pose.p, quat_normalize(pose.q)), covariance)
        if self._kept is not None and kept.is_like(self._kept):
            self._kept_ns = max(self._kept_ns, observation.capture_ns)
            return True
        if self._align_kept(kept) is None:
            return False
        self._kept, self._kept_ns = kept, observation.capture_ns
        self.pending, self.looked_ns = True, now_ns
        return True

    def _align_kept(self, kept: _Kept) -> AlignmentEstimate | None:
        T_world_anchor = self._anchors[kept.anchor_id]
        return align_persistent(T_world_anchor, kept.T_tracking_anchor, kept.covariance, self._tracking_epoch)

    def _begin_epoch(self, tracking_epoch: int) -> bool:
        """Discard everything of an older tracking frame; return false if `tracking_epoch` itself is older."""
        if tracking_epoch < self._tracking_epoch:
            return False
        if tracking_epoch > self._tracking_epoch:
            self.reset()
            self._tracking_epoch = tracking_epoch
        return True

    def _suffice(self) -> bool:
        return len(self._touches) >= _MIN_POINTS or (self._kept is not None and bool(self._touches))

    def _list_precise(self) -> list[Touch]:
        return [t for kept in self._touches.values() for t in kept if t.sigma_m <= MAX_DRIVING_SIGMA_M]

    def _list_tips(self, touches: list[Touch]) -> dict[str, tuple[float, ...]]:
        """Return the covariance of each tip: as calibrated, else the default for precise touches."""
        precise = {t.tip for t in touches if t.sigma_m <= MAX_DRIVING_SIGMA_M}
        return dict.fromkeys(sorted(precise), _UNCALIBRATED_TIP) | self._tips

    @property
    def advice(self) -> str:
        """The marks still to be touched for an estimate, as text; empty if nothing is missing."""
        if not 0 < len(self._touches) < _MIN_POINTS or (self._kept is not None and self._list_precise()):
            return ""
        counted = f"{len(self._touches)} points touched, {_MIN_POINTS} are needed"
        named = suggest_point(self._list_points(), [point.name for point in self._touches])
        return f"{counted}: touch '{named}' next" if named else counted

    def _list_points(self) -> dict[str, Vec3]:
        """Return the world positions of what was touched, and of all other marks of those anchors."""
        points = {point: (0.0, 0.0, 0.0) for point in self._touches if not point.mark}
        for anchor_id in dict.fromkeys(point.anchor_id for point in self._touches):
            points |= {_Point(anchor_id, mark): p for mark, p in self._marks.get(anchor_id, {}).items()}
        return {point.name: apply(self._anchors[point.anchor_id], p) for point, p in points.items()}

    def on_anchors_moved(self) -> None:
        """Estimate again with the new positions of the marks."""
        self.pending = self._suffice() or self._kept is not None

    def discard_touches(self, device: str) -> None:
        """Discard the touches of a device: they were made with another tip."""
        self._keep_touches(lambda t: t.tip != device)
        self.pending = self._suffice() or self._kept is not None

    def _keep_touches(self, is_kept: Callable[[Touch], bool]) -> None:
        for point, touches in list(self._touches.items()):
            left = [t for t in touches if is_kept(t)]
            if left:
                self._touches[point] = deque(left, maxlen=MAX_TOUCHES_PER_POINT)
            else:
                del self._touches[point]

    def reset(self) -> None:
        """Discard all touches and the kept anchor."""
        self._touches.clear()
        self._suspects = frozenset()
        self._kept = None
        self.pending = False

    def estimate(self) -> tuple[AlignmentEstimate, str]:
        """Return the alignment by what is kept, and its `AlignmentKind`. Raises one of `NUMERICAL_ERRORS` where it
        cannot be solved."""
        self.pending = False
        estimate, kind = self._estimate()
        times: dict[str, list[int]] = {}
        for point, touches in self._touches.items():
            times.setdefault(point.anchor_id, []).extend(t.capture_ns for t in touches)
        looks = tuple((name, min(ns), max(ns)) for name, ns in times.items())
        # More of the same would mend no refusal: the wearer is to hear of it at once (0), not to go on looking.
        return replace(estimate, n_viewpoints=0, n_observations=0, looks=looks), kind

    def _estimate(self) -> tuple[AlignmentEstimate, str]:
        precise, points = self._list_precise(), self._list_points()
        if len({t.point for t in precise}) >= _MIN_POINTS:
            return self._register(points, precise, AlignmentConfig()), AlignmentKind.MEASURED
        everything = [t for same in self._touches.values() for t in same]
        kept = None if self._kept is None else self._align_kept(self._kept)
        if kept is None:
            return self._register(points, everything, _FINGERTIP_CONFIG), AlignmentKind.FINGERTIP
        if not everything:
            return kept, AlignmentKind.PERSISTENT
        confirmed = confirm_alignment(kept, points, precise or everything, self._list_tips(precise))
        self._suspects = frozenset()
        if not confirmed.refused:
            return (confirmed, AlignmentKind.MEASURED) if precise else (kept, AlignmentKind.PERSISTENT)
        if len(self._touches) >= _MIN_POINTS:
            found = self._register(points, everything, _FINGERTIP_CONFIG)
            return replace(found, advice=f"{_NOT_USED}; {found.advice}".rstrip("; ")), AlignmentKind.FINGERTIP
        self._suspects = frozenset(t.point for t in precise or everything)
        return confirmed, AlignmentKind.PERSISTENT

    def _register(self, points: Mapping[str, Vec3], touches: list[Touch], config: AlignmentConfig) -> AlignmentEstimate:
        tips = self._list_tips(touches)
        registration = register_touches(points, touches, self._tracking_epoch, tips, config)
        self._suspects = frozenset(registration.suspects)
        return replace(registration.estimate, advice=registration.estimate.advice or _describe_residuals(registration))


def _describe_residuals(registration: TouchRegistration) -> str:
    residuals = ", ".join(f"'{point}' {r * 1e3:.1f} mm" for point, r in sorted(registration.residuals_m.items()))
    return f"touched points miss their marks by: {residuals}" if residuals else ""


def solve_tip(observation: Observation) -> TipSolved:
    """Calibrate the tip of the device of an observation of kind `tip`. Raises one of the numerical errors of linear
    algebra where it cannot be solved."""
    found = calibrate_tip([(pose.p, pose.q) for pose in observation.grip_poses])
    if found.refused:
        return TipSolved(observation.device, refused=True, advice=found.advice[:MAX_TEXT])
    return TipSolved(
        observation.device, found.p_controller_tip, found.covariance, found.error_m, found.residual_m, found.n_used
    )
