"""Alignment of one headset at any moment of a recording, from the observations before and after it.

Observations before the moment are solved forwards in time, those after it backwards, each by the estimator of the live
session with its model of drift; both are weighted by their covariances (two-filter smoother, Fraser and Potter 1969).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from anchors.alignment import AlignmentConfig, AlignmentEstimate, AlignmentEstimator
from anchors.constellation import Constellation
from anchors.controller import controller_covariance
from anchors.persistent import covariance_at_anchor
from anchors.pose import (
    IDENTITY_QUAT,
    PoseTuple,
    Vec3,
    apply,
    inverse,
    quat_conj,
    quat_from_rotvec,
    quat_mul,
    quat_normalize,
    quat_rotate,
    quat_to_rotvec,
)
from anchors.uncertainty import length_p95
from iris_session.alignment.estimator import NUMERICAL_ERRORS, find_alternative
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.names import AnchorKind
from iris_session.recording import AlignmentHistory, RecordedObservation

Array = NDArray[np.float64]
AROUND_NS: Final = 600_000_000_000
#: Maximum number of observations of one viewpoint, and of viewpoints: the nearest to the moment are used.
MAX_IN_GROUP: Final = 120
MAX_GROUPS: Final = 200
#: Moments closer than this share a solution: tracking frames drift by less than a millimetre meanwhile.
GRAIN_NS: Final = 10_000_000_000
#: 99.9 % quantile of chi-square with 6 degrees of freedom.
CHI2_6_999: Final = 22.458


class AnchorHistory:
    """Poses of anchors over time: as configured, then as moved by directors; or constant, by a file (`given`)."""

    def __init__(
        self, looks: AlignmentHistory, configured: Mapping[str, PoseTuple], given: Constellation | None
    ) -> None:
        self._eras: list[tuple[int, dict[str, PoseTuple]]] = [(0, dict(configured if given is None else given.anchors))]
        for moved in () if given is not None else looks.anchor_moves:
            pose = (moved.T_world_anchor.p, moved.T_world_anchor.q)
            self._eras.append((moved.session_time, {**self._eras[-1][1], moved.anchor_id: pose}))

    def find_period(self, now_ns: int) -> int:
        """Return the index of the period, between two moves of anchors, that contains `now_ns`."""
        return max(i for i, (since, _) in enumerate(self._eras) if i == 0 or since <= now_ns)

    def get_poses(self, era: int) -> dict[str, PoseTuple]:
        return self._eras[era][1]

    @property
    def last_poses(self) -> dict[str, PoseTuple]:
        return self._eras[-1][1]


class AlignmentSmoother:
    """Smoothed alignments of one tracking frame at any moment, each computed once. `looks`: in order of capture."""

    def __init__(
        self, looks: Sequence[RecordedObservation], anchors: AnchorHistory, sizes: Mapping[str, float]
    ) -> None:
        self._looks, self._anchors, self._sizes = looks, anchors, sizes
        self._times = np.array([look.observation.capture_ns for look in looks], dtype=np.int64)
        self._known: dict[tuple[int, int], AlignmentEstimate] = {}

    def estimate_at(self, now_ns: int) -> AlignmentEstimate:
        """Return the alignment from all observations around `now_ns`, with the anchor poses of that time."""
        moment = (now_ns // GRAIN_NS) * GRAIN_NS + GRAIN_NS // 2
        key = (moment, self._anchors.find_period(now_ns))
        if key not in self._known:
            places = self._anchors.get_poses(key[1])
            solved = self._solve(moment, places)
            seen = sorted({look.observation.anchor_id for look in self._looks} & set(places))
            if solved.refused and len(seen) > 2:
                solved = self._without_one(moment, places, seen) or solved
            self._known[key] = solved
        return self._known[key]

    def _without_one(
        self, moment: int, places: Mapping[str, PoseTuple], seen: Sequence[str]
    ) -> AlignmentEstimate | None:
        """Return the best solution without one sheet: of three or more, all but a moved one may agree."""
        tried = []
        for name in seen:
            solved = self._solve(moment, {k: pose for k, pose in places.items() if k != name})
            if not solved.refused:
                advice = f"moved since it was measured: sheet '{name}'; it is not used"
                tried.append(replace(solved, moved=(name,), advice=advice))
        return min(tried, key=lambda one: one.error_at_anchor_m, default=None)

    def count_unused(self) -> dict[str, int]:
        """Return the number of observations that cannot be used, by reason."""
        e = AlignmentEstimator(self._anchors.last_poses, AlignmentConfig(), self._sizes)
        touched = 0
        for look in self._looks:
            if look.observation.kind in AnchorKind.NOT_SEEN:
                touched += look.observation.kind == AnchorKind.TOUCH
            else:
                add_observation(e, look, look.observation.capture_ns)
        counts = {
            "unknown anchor": e.unknown_anchors,
            "wrong size": e.wrong_size,
            "against gravity": e.against_gravity,
            "not a pose": e.invalid,
            "touched points": touched,
        }
        return {why: n for why, n in counts.items() if n}

    def _solve(self, moment: int, places: Mapping[str, PoseTuple]) -> AlignmentEstimate:
        sides = []
        halves = self._sides(moment)
        for looks, sign in zip(halves, (1, -1), strict=True):
            estimator = AlignmentEstimator(places, _config(), self._sizes)
            ages = [sign * (look.observation.capture_ns - moment) for look in looks]
            for look, age_ns in sorted(zip(looks, ages, strict=True), key=lambda one: one[1]):
                add_observation(estimator, look, moment + age_ns)
            sides.append(_later(estimate_or_refuse(estimator), -max(ages, default=0) * 1e-9))
        before, after = sides
        if before.refused and after.refused:
            return before if len(halves[0]) >= len(halves[1]) else after
        if before.refused or after.refused:
            return after if before.refused else before
        return fuse_estimates(before, after)

    def _sides(self, moment: int) -> tuple[list[RecordedObservation], list[RecordedObservation]]:
        """Return the observations used, before and after the moment.

        Observations from one viewpoint stay on one side: their errors are common.
        """
        away = np.abs(self._times - moment)
        groups: dict[tuple[str, int], list[RecordedObservation]] = {}
        for i in np.argsort(away, kind="stable").tolist():
            seen = self._looks[i].observation
            key = (seen.anchor_id, seen.viewpoint_id)
            if away[i] > AROUND_NS or (key not in groups and len(groups) >= MAX_GROUPS):
                break
            if seen.kind not in AnchorKind.NOT_SEEN and len(groups.setdefault(key, [])) < MAX_IN_GROUP:
                groups[key].append(self._looks[i])
        sides: tuple[list[RecordedObservation], list[RecordedObservation]] = ([], [])
        for group in groups.values():
            late = 2 * sum(look.observation.capture_ns > moment for look in group) > len(group)
            sides[late].extend(group)
        return sides


def _config() -> AlignmentConfig:
    return AlignmentConfig(
        max_observations=MAX_IN_GROUP * MAX_GROUPS,
        max_in_group=MAX_IN_GROUP,
        max_groups=MAX_GROUPS,
        max_age_ns=2 * AROUND_NS,
    )


def _later(e: AlignmentEstimate, seconds: float) -> AlignmentEstimate:
    """Return the estimate `seconds` after its newest observation, with the possible drift added to its covariance."""
    if e.refused or seconds <= 0.0:
        return e
    prior = _config().prior
    drifted = (prior.drift_m_per_s * seconds) ** 2 + prior.walk_m_per_sqrt_s**2 * seconds
    return _replace_pose(e, e.T_world_tracking, np.reshape(e.covariance, (6, 6)) + np.diag([drifted] * 3 + [0.0] * 3))


def _replace_pose(e: AlignmentEstimate, T: PoseTuple, C: Array) -> AlignmentEstimate:
    C = 0.5 * (C + C.T)
    return replace(e, T_world_tracking=T, covariance=tuple(C.ravel().tolist()), error_at_anchor_m=length_p95(C[:3, :3]))


def fuse_estimates(a: AlignmentEstimate, b: AlignmentEstimate) -> AlignmentEstimate:
    """Fuse two estimates at the pivot of `a`, weighted by covariances; wider if they differ by more than these."""
    p_tracking = apply(inverse(a.T_world_tracking), a.pivot_world)
    p_b = apply(b.T_world_tracking, p_tracking)
    turn = quat_to_rotvec(quat_mul(b.T_world_tracking[1], quat_conj(a.T_world_tracking[1])))
    x = np.array([*(p_b[i] - a.pivot_world[i] for i in range(3)), *turn])
    C_a = np.reshape(a.covariance, (6, 6))
    C_b = np.reshape(covariance_at_anchor(b.covariance, b.pivot_world, (p_b, IDENTITY_QUAT)), (6, 6))
    gain = C_a @ np.linalg.inv(C_a + C_b)
    step, C = gain @ x, C_a - gain @ C_a
    misfit = float(x @ np.linalg.solve(C_a + C_b, x))
    if misfit > CHI2_6_999:
        C = C * (misfit / 6.0)
    dx, dy, dz, *dr = step.tolist()
    q = quat_normalize(quat_mul(quat_from_rotvec((dr[0], dr[1], dr[2])), a.T_world_tracking[1]))
    lever = quat_rotate(q, p_tracking)
    x0, y0, z0 = a.pivot_world
    p: Vec3 = (x0 + dx - lever[0], y0 + dy - lever[1], z0 + dz - lever[2])
    both = _replace_pose(a, (p, q), C)
    tilt = max(a.residual_tilt_rad, b.residual_tilt_rad)
    return replace(
        both,
        residual_tilt_rad=tilt,
        pivot_world=(x0 + dx, y0 + dy, z0 + dz),
        n_observations=a.n_observations + b.n_observations,
        n_viewpoints=a.n_viewpoints + b.n_viewpoints,
        advice=a.advice or b.advice,
        moved=tuple(sorted({*a.moved, *b.moved})),
    )


def add_observation(estimator: AlignmentEstimator, look: RecordedObservation, capture_ns: int) -> bool:
    """Add an observation like the live session does; return whether it is used."""
    seen = look.observation
    try:
        return estimator.add(
            seen.anchor_id,
            observed_pose(seen),
            capture_ns,
            seen.tracking_epoch,
            viewpoint_id=seen.viewpoint_id,
            quality=seen.quality,
            size_m=seen.size_m,
            covariance=observed_covariance(seen),
            p_tracking_head=None if seen.kind == AnchorKind.CONTROLLER else look.p_tracking_head,
            alternative=find_alternative(seen),
            residuals=seen.residuals_px,
        )
    except NUMERICAL_ERRORS:
        estimator.invalid += 1
        return False


def estimate_or_refuse(estimator: AlignmentEstimator) -> AlignmentEstimate:
    """Return the estimate, a refused one if it fails numerically."""
    try:
        return estimator.estimate()
    except NUMERICAL_ERRORS:
        return AlignmentEstimate.refusal(estimator.tracking_epoch, "what was seen cannot be solved")


def observed_pose(seen: Observation) -> PoseTuple:
    return seen.T_tracking_anchor.p, seen.T_tracking_anchor.q


def observed_covariance(seen: Observation) -> tuple[float, ...]:
    """Return the stated covariance; that of a tracked controller if its client states none."""
    if seen.kind == AnchorKind.CONTROLLER and not seen.covariance:
        return controller_covariance()
    return seen.covariance
