"""Measure the error between headsets: two that observe the same target should place it at the same point of the world.

Every stated error rests on a noise model; this measurement does not. A target is a sheet, which stands still, so the
medians of both headsets' observations within `max_age_ns` are compared; or it moves, such as a controller, and is
compared at the same instants; or it is a point that both wearers touch. Pure: times are passed in.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Collection, Mapping, Set
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

import numpy as np

from anchors.alignment import AlignmentEstimate
from anchors.lie import Array, quat_conjugate, quat_log, quat_multiply, quat_to_matrix, to_vec3
from anchors.pose import PoseTuple, Vec3, apply, compose, distance, is_rigid, is_valid_point
from anchors.uncertainty import NoiseModel, isotropic_covariance, length_p95


class Disagreement(NamedTuple):
    """Difference between headsets `a` and `b` in the pose of one target: distance [m], angle [rad], and the distance
    that 95 % of pairs stay below by their stated errors and the noise of these observations. `p_world`: midpoint."""

    a: str
    b: str
    target: str
    error_m: float
    error_rad: float
    expected_p95_m: float
    p_world: Vec3
    n: int


@dataclass(frozen=True)
class CrossCheckConfig:
    """Bounds of the cross-check.

    `max_age_ns`: age of the oldest observation compared. `max_gap_ns`: between two observations of a moving target that
    are interpolated. `max_observations`: per headset and target; the oldest are discarded first.
    """

    max_age_ns: int = 60 * 1_000_000_000
    max_gap_ns: int = 50_000_000
    min_observations: int = 5
    max_observations: int = 100
    max_targets: int = 64
    max_points: int = 4  # touched, per headset


class _TargetObservation(NamedTuple):
    capture_ns: int
    pose: PoseTuple  # T_tracking_target
    p_head: Vec3 | None
    viewpoint_id: int


class _TouchedPoint(NamedTuple):
    touched_ns: int
    p_tracking: Vec3
    sigma_m: float


@dataclass
class CrossCheck:
    """Buffer of observations by headset and target. Alignments are passed to `compare`, so the newest ones count.

    `unknown_viewpoint_sigma_m`: noise per axis of observations without a head pose.
    """

    noise: NoiseModel = field(default_factory=NoiseModel)
    config: CrossCheckConfig = field(default_factory=CrossCheckConfig)
    unknown_viewpoint_sigma_m: float = 0.005
    _observations: dict[tuple[str, str], deque[_TargetObservation]] = field(default_factory=dict)
    _points: dict[tuple[str, str], _TouchedPoint] = field(default_factory=dict)
    _epochs: dict[str, int] = field(default_factory=dict)

    def add_observation(
        self,
        headset: str,
        target: str,
        T_tracking_target: PoseTuple,
        p_tracking_head: Vec3 | None,
        capture_ns: int,
        tracking_epoch: int,
        viewpoint_id: int = 0,
    ) -> bool:
        """Add a detection of a sheet or a tracked pose of a controller.

        Args:
            headset: Name of the headset that observed it.
            target: Name of the sheet or controller.
            T_tracking_target: Its pose.
            p_tracking_head: Position of the head then; `None`: unknown.
            capture_ns: Session time.
            tracking_epoch: Tracking frame; a newer one discards the observations of the headset.
            viewpoint_id: Observations from one viewpoint have common errors.

        Returns:
            False if it is not used: invalid, late, of an older tracking frame, or of one target too many.
        """
        key = (headset, target)
        if not is_rigid(T_tracking_target) or not is_valid_point(p_tracking_head):
            return False
        if not self.begin_epoch(headset, tracking_epoch):
            return False
        if key not in self._observations and not self._make_room(capture_ns):
            return False
        looks = self._observations.setdefault(key, deque(maxlen=self.config.max_observations))
        if looks and capture_ns <= looks[-1].capture_ns:
            return False  # out of order
        looks.append(_TargetObservation(capture_ns, T_tracking_target, p_tracking_head, viewpoint_id))
        return True

    def add_point(
        self, headset: str, name: str, p_tracking_point: Vec3, sigma_m: float, touched_ns: int, tracking_epoch: int
    ) -> bool:
        """Add a touch of a point that others touch too; only the newest of each name counts.

        Args:
            headset: Name of the headset whose wearer touches it.
            name: Name of the point.
            p_tracking_point: Where the tip was.
            sigma_m: Noise of the touch, per axis.
            touched_ns: Session time.
            tracking_epoch: As of `add_observation`.

        Returns:
            False if it is not used: not finite, or of an older tracking frame.
        """
        if not is_valid_point(p_tracking_point) or not self.begin_epoch(headset, tracking_epoch):
            return False
        self._points.pop((headset, name), None)
        self._points[headset, name] = _TouchedPoint(touched_ns, p_tracking_point, sigma_m)
        own = [key for key in self._points if key[0] == headset]
        if len(own) > self.config.max_points:
            del self._points[own[0]]
        return True

    def begin_epoch(self, headset: str, tracking_epoch: int) -> bool:
        """Discard what a headset observed in an older tracking frame; return false if `tracking_epoch` is older."""
        epoch = self._epochs.get(headset, tracking_epoch)
        if tracking_epoch > epoch:
            self.discard_headset(headset)
        self._epochs[headset] = max(epoch, tracking_epoch)
        return tracking_epoch >= epoch

    def list_targets(self, headset: str) -> set[str]:
        """Return the names of the targets that a headset has observed."""
        return {target for one, target in self._observations if one == headset}

    def _make_room(self, now_ns: int) -> bool:
        """Discard targets not observed for `max_age_ns` if there are too many; return whether one more fits."""
        if len(self._observations) >= self.config.max_targets:
            oldest_ns = now_ns - self.config.max_age_ns
            self._observations = {k: v for k, v in self._observations.items() if v[-1].capture_ns > oldest_ns}
        return len(self._observations) < self.config.max_targets

    def discard_headset(self, headset: str) -> None:
        """Discard the observations of a headset that left or whose tracking frame changed."""
        for kept in (self._observations, self._points):
            for key in [key for key in kept if key[0] == headset]:
                del kept[key]
        self._epochs.pop(headset, None)

    def discard_target(self, thing: str) -> None:
        """Discard the observations of a target that was moved."""
        for key in [key for key in self._observations if key[1] == thing]:
            del self._observations[key]

    def copy_headsets(self, headsets: Collection[str]) -> CrossCheck:
        """Return a copy with the observations of these headsets, to be compared while others are added here."""
        observations = {key: looks.copy() for key, looks in self._observations.items() if key[0] in headsets}
        epochs = {headset: epoch for headset, epoch in self._epochs.items() if headset in headsets}
        points = {key: touch for key, touch in self._points.items() if key[0] in headsets}
        copy = CrossCheck(self.noise, self.config, self.unknown_viewpoint_sigma_m)
        copy._observations, copy._points, copy._epochs = observations, points, epochs
        return copy

    def compare(
        self, alignments: Mapping[str, AlignmentEstimate], now_ns: int, moving: Set[str] = frozenset()
    ) -> list[Disagreement]:
        """Compare all pairs of aligned headsets on all targets that both observed. `moving`: targets that move."""
        out = []
        headsets = sorted(h for h, e in alignments.items() if not e.refused and e.tracking_epoch == self._epochs.get(h))
        for thing in sorted({thing for _, thing in self._observations}):
            for a, b in combinations(headsets, 2):
                looks_a, looks_b = self._select_recent(a, thing, now_ns), self._select_recent(b, thing, now_ns)
                ways = self._pair_simultaneous if thing in moving else self._pair_resting
                pairs = ways(looks_a, looks_b)
                if pairs is not None:
                    out.append(
                        self._compare_pair((a, b, thing), (alignments[a], alignments[b]), (looks_a, looks_b), pairs)
                    )
        return out

    def compare_points(
        self, alignments: Mapping[str, AlignmentEstimate], now_ns: int, since_ns: int = -1
    ) -> list[Disagreement]:
        """Compare the points that both of two aligned headsets have touched, one of them after `since_ns`."""
        out = []
        headsets = sorted(h for h, e in alignments.items() if not e.refused and e.tracking_epoch == self._epochs.get(h))
        for (a, name), touch in self._points.items():
            for b in headsets:
                other = self._points.get((b, name))
                if a not in headsets or a >= b or other is None:
                    continue
                first_ns, last_ns = sorted((touch.touched_ns, other.touched_ns))
                if now_ns - first_ns > self.config.max_age_ns or last_ns <= since_ns:
                    continue
                p_a = apply(alignments[a].T_world_tracking, touch.p_tracking)
                p_b = apply(alignments[b].T_world_tracking, other.p_tracking)
                at = to_vec3(np.add(p_a, p_b) / 2.0)
                S = alignments[a].covariance_at(at) + alignments[b].covariance_at(at)
                S = S + np.eye(3) * (touch.sigma_m**2 + other.sigma_m**2)
                out.append(Disagreement(a, b, name, distance(p_a, p_b), 0.0, length_p95(S), at, 1))
        return out

    def _select_recent(self, headset: str, thing: str, now_ns: int) -> list[_TargetObservation]:
        looks = self._observations.get((headset, thing), ())
        return [k for k in looks if 0 <= now_ns - k.capture_ns <= self.config.max_age_ns]

    def _pair_resting(
        self, a: list[_TargetObservation], b: list[_TargetObservation]
    ) -> list[tuple[PoseTuple, PoseTuple]] | None:
        """Pair observations of a target at rest: the newest n of each; medians are taken later."""
        n = min(len(a), len(b))
        return (
            [(x.pose, y.pose) for x, y in zip(a[-n:], b[-n:], strict=True)]
            if n >= self.config.min_observations
            else None
        )

    def _pair_simultaneous(
        self, a: list[_TargetObservation], b: list[_TargetObservation]
    ) -> list[tuple[PoseTuple, PoseTuple]] | None:
        """Pair observations of a moving target: those of `a`, and those of `b` interpolated to the same instants."""
        times = [k.capture_ns for k in b]
        pairs = []
        for look in a:
            i = bisect_left(times, look.capture_ns)
            if i < len(b) and times[i] == look.capture_ns:
                pairs.append((look.pose, b[i].pose))
            elif 0 < i < len(b) and times[i] - times[i - 1] <= self.config.max_gap_ns:
                share = (look.capture_ns - times[i - 1]) / (times[i] - times[i - 1])
                (p0, q0), (p1, q1) = b[i - 1].pose, b[i].pose
                p = (
                    p0[0] + share * (p1[0] - p0[0]),
                    p0[1] + share * (p1[1] - p0[1]),
                    p0[2] + share * (p1[2] - p0[2]),
                )
                pairs.append((look.pose, (p, q0 if share < 0.5 else q1)))
        return pairs if len(pairs) >= self.config.min_observations else None

    def _compare_pair(
        self,
        names: tuple[str, str, str],
        estimates: tuple[AlignmentEstimate, AlignmentEstimate],
        looks: tuple[list[_TargetObservation], list[_TargetObservation]],
        pairs: list[tuple[PoseTuple, PoseTuple]],
    ) -> Disagreement:
        placed = [
            (compose(estimates[0].T_world_tracking, x), compose(estimates[1].T_world_tracking, y)) for x, y in pairs
        ]
        between = np.median([np.subtract(x[0], y[0]) for x, y in placed], axis=0)
        middle = np.median([np.add(x[0], y[0]) for x, y in placed], axis=0) / 2.0
        at = to_vec3(middle)
        S = estimates[0].covariance_at(at) + estimates[1].covariance_at(at)
        for estimate, seen in zip(estimates, looks, strict=True):
            S = S + self._observation_noise(estimate, seen)
        turns = quat_log(
            quat_multiply(np.array([x[1] for x, _ in placed]), quat_conjugate(np.array([y[1] for _, y in placed])))
        )
        turn = float(np.linalg.norm(np.median(turns, axis=0)))
        return Disagreement(*names, float(np.linalg.norm(between)), turn, length_p95(S), at, len(pairs))

    def _observation_noise(self, estimate: AlignmentEstimate, looks: list[_TargetObservation]) -> Array:
        """Return the covariance (3, 3) of the observed position, world axes; errors common to a viewpoint count once
        each."""
        viewpoints = len({k.viewpoint_id for k in looks})
        heads = [k.p_head for k in looks if k.p_head is not None]
        if heads:
            p = np.median([k.pose[0] for k in looks], axis=0)
            common, each = self.noise.compute_covariances(np.median(heads, axis=0), p)
        else:
            common, each = self.noise.split_covariance(isotropic_covariance(self.unknown_viewpoint_sigma_m, 0.01))
        C = common[:3, :3] / viewpoints + each[:3, :3] * (math.pi / 2.0 / len(looks))
        R = quat_to_matrix(np.array(estimate.T_world_tracking[1]))
        return np.asarray(R @ C @ R.T)
