"""Estimate `T_world_tracking` of one headset from observations of anchors whose world pose is known.

Yaw and translation are free; the tilt is held near zero by gravity, which headsets and worlds share to about 0.2 deg,
and follows the data only as far as rotations or the baselines between several anchors measure it better (`dof` 6: no
gravity). Robust against wrong detections, mirrored poses and moved sheets; the covariance counts what is common to a
viewpoint once. Pure: time and observations are passed in. Mathematics and sources: docs/anchors.md.

Noise models are optimistic, so every stage checks them against the residuals: those larger than stated widen the
covariance (Birge ratio: chi-square per degree of freedom). Without a majority that agrees there is no result.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from anchors.evidence import ScaleError, describe_scale, explain_by_scale, weigh_change, weigh_earlier_looks
from anchors.lie import Array, to_quat, to_vec3
from anchors.pose import (
    IDENTITY_POSE,
    PoseTuple,
    Quat,
    Vec3,
    compose,
    inverse,
    is_rigid,
    is_valid_point,
    quat_mul,
    quat_normalize,
    quat_rotate,
)
from anchors.solver import (
    AlignmentPrior,
    AlignmentProblem,
    AlignmentSolution,
    Mask,
    build_problem,
    count_votes,
    find_fitting_groups,
    list_agreeing_anchors,
    median_tilt,
    select_groups,
    solve_alignment,
    to_world_covariance,
)
from anchors.uncertainty import (
    SOURCE_BIASES,
    Z99,
    NoiseModel,
    SourceBias,
    chi2_quantile,
    covariance_at_point,
    isotropic_covariance,
    length_p95,
    position_error_p95,
    validate_covariance,
)
from anchors.viewpoints import AnchorObservation, GroupKey, MergedObservation, ObservationBuffer, ViewpointGroup

__all__ = [
    "AlignmentConfig",
    "AlignmentEstimate",
    "AlignmentEstimator",
    "mirror_pose",
    "position_error_p95",
]


#: Groups of different eras have viewpoint numbers that differ by multiples of this.
_ERA: Final = 1 << 64
#: Looks at other anchors vouch for the frame for so long [ns]: it may jump between looks.
_JUST_BEFORE_NS: Final = 10_000_000_000
#: A second pose of a flat sheet whose residual is larger by more than this is not as good as the first one.
_ALIKE: Final = 2.0


@dataclass(frozen=True)
class AlignmentConfig:
    """Bounds and noise model of the estimator.

    `noise` is used where it is known from where an anchor was seen, `position_sigma_m` and `rotation_sigma_rad` (per
    axis) where nothing is. `biases`: by source of observations, what all of them share.
    `dof`: 4, or 6 to measure the tilt without gravity. `tilt_sigma_rad`: how far a headset's
    vertical may be off; `max_tilt_rad`: beyond it a single observation is wrong; `follow_tilt_rad`: so far a tilt that
    all anchors show is followed, from `tilt_warning_rad` on (and beyond noise) with a warning. `drift_m_per_s`,
    `walk_m_per_sqrt_s`: how the tracking frame drifts and wanders, per axis, `yaw_rad_per_s`, `yaw_walk_rad_per_sqrt_s`
    about the vertical. `max_error_m`: the stated p95 at the
    anchors above which the estimate is refused. `max_observations`, `max_groups`, and of one viewpoint `max_in_group`:
    the oldest are forgotten (counted in `forgotten`), as are those older than the newest by more than `max_age_ns`
    (`outdated`). `min_agreeing`: share of one viewpoint's observations that must agree. `size_tolerance`: by what share
    a sheet may measure otherwise than it should.
    """

    position_sigma_m: float = 0.005
    rotation_sigma_rad: float = math.radians(0.6)
    noise: NoiseModel = field(default_factory=NoiseModel)
    biases: Mapping[str, SourceBias] = field(default_factory=lambda: SOURCE_BIASES)
    dof: int = 4
    tilt_sigma_rad: float = math.radians(0.2)
    tilt_warning_rad: float = math.radians(1.0)
    follow_tilt_rad: float = math.radians(3.0)
    max_tilt_rad: float = math.radians(15.0)
    drift_m_per_s: float = 0.003 / 60.0 / math.sqrt(3.0)
    walk_m_per_sqrt_s: float = 0.001 / math.sqrt(60.0)
    yaw_rad_per_s: float = math.radians(0.2) / 60.0
    yaw_walk_rad_per_sqrt_s: float = math.radians(0.07) / math.sqrt(60.0)
    max_error_m: float = 0.03
    min_observations: int = 5
    max_observations: int = 600
    max_in_group: int = 120
    max_groups: int = 48
    max_age_ns: int = 600 * 1_000_000_000
    min_agreeing: float = 0.6
    size_tolerance: float = 0.03

    @property
    def prior(self) -> AlignmentPrior:
        tilt = self.tilt_sigma_rad if self.dof == 4 else math.inf
        return AlignmentPrior(
            tilt, self.drift_m_per_s, self.walk_m_per_sqrt_s, self.yaw_rad_per_s, self.yaw_walk_rad_per_sqrt_s
        )


@dataclass(frozen=True)
class AlignmentEstimate:
    """Result, or the reason why there is none (`refused`, with `advice` for the wearer of the headset).

    `covariance`: 36 values, 6x6 row-major, order (x, y, z [m], rx, ry, rz [rad]), world frame, at `pivot_world`.
    `residual_tilt_rad`: tilt of the frame as the anchors alone show it; `tilt_noise_rad`: what noise alone explains of
    it (99.9 %). `moved`: anchors that all others outvote. `supported`: the newest look agrees; an estimate without it
    confirms nothing. `look_s`: for so long the wearer should go on looking: a refusal meanwhile, or a large error, is
    not the last word. `looks`: the anchors that agree, with the times of their first and last look.
    """

    T_world_tracking: PoseTuple
    tracking_epoch: int
    covariance: tuple[float, ...]
    pivot_world: Vec3
    error_at_anchor_m: float
    residual_tilt_rad: float
    n_observations: int
    n_viewpoints: int
    refused: bool
    advice: str
    moved: tuple[str, ...] = ()
    supported: bool = True
    tilt_noise_rad: float = 0.0
    look_s: float = 0.0
    looks: tuple[tuple[str, int, int], ...] = ()

    @classmethod
    def refusal(
        cls, tracking_epoch: int, advice: str, n_observations: int = 0, n_viewpoints: int = 0
    ) -> AlignmentEstimate:
        """Return a refusal with its advice."""
        nothing = (IDENTITY_POSE, tracking_epoch, (0.0,) * 36, IDENTITY_POSE[0], math.inf, 0.0)
        return cls(*nothing, n_observations, n_viewpoints, True, advice)

    def covariance_at(self, point_world: Vec3) -> Array:
        """Return the covariance (3, 3) [m^2] of the position error at a point of the world."""
        return covariance_at_point(self.covariance, self.pivot_world, point_world)

    def error_at(self, point_world: Vec3) -> float:
        """Return the stated p95 [m] of the position error at a point of the world, infinite when refused."""
        return math.inf if self.refused else position_error_p95(self.covariance, self.pivot_world, point_world)


@dataclass
class AlignmentEstimator:
    """Estimator of one headset: `add` observations, `estimate` from all of them. A new `tracking_epoch` resets it.

    `anchors`: `T_world_anchor`. `sizes`: edge length [m] of printed sheets, where known. The counters give the
    reasons why observations were not used as received; `unmirrored` ones were used with the mirrored pose.
    """

    anchors: Mapping[str, PoseTuple]
    config: AlignmentConfig = field(default_factory=AlignmentConfig)
    sizes: Mapping[str, float] = field(default_factory=dict)
    tracking_epoch: int = 0
    unknown_anchors: int = 0
    stale_epochs: int = 0
    invalid: int = 0
    wrong_size: int = 0
    against_gravity: int = 0
    unmirrored: int = 0
    _against_gravity: int = 0  # in this epoch
    _misprints: dict[str, str] = field(default_factory=dict)  # by sheet: what its last measured size says
    _near: tuple[Array, Array] | None = None  # where the last solution was: the next one is not far
    _era: int = 0  # looks since the last contradiction are groups of their own
    _changed: str = ""  # the sheet that contradicted the others since then, while it is not known why
    _left_out: dict[str, int] = field(default_factory=dict)  # sheets that were moved: era since then
    _tested: dict[str, float] = field(default_factory=dict)  # how well the scale of each source is tested, in any frame
    _memory: ObservationBuffer = field(init=False)

    def __post_init__(self) -> None:
        if self.config.dof not in (4, 6):
            raise ValueError(f"dof {self.config.dof}: it is 4 (level headset) or 6 (tilt is measured)")
        c = self.config
        self._memory = ObservationBuffer(c.max_observations, c.max_in_group, c.max_groups, c.max_age_ns)

    @property
    def forgotten(self) -> int:
        return self._memory.forgotten

    @property
    def outdated(self) -> int:
        return self._memory.outdated

    def add(
        self,
        anchor_id: str,
        T_tracking_anchor: PoseTuple,
        capture_ns: int,
        tracking_epoch: int,
        viewpoint_id: int = 0,
        quality: float = 1.0,
        size_m: float = 0.0,
        covariance: tuple[float, ...] = (),
        p_tracking_head: Vec3 | None = None,
        alternative: PoseTuple | None = None,
        source: str = "",
        shift: tuple[float, ...] = (),
        residuals: tuple[float, ...] = (),
    ) -> bool:
        """Add one observation.

        Args:
            anchor_id: Name of the anchor.
            T_tracking_anchor: Observed pose.
            capture_ns: Time of the observation.
            tracking_epoch: Tracking frame of the observation; a newer one resets the estimator.
            viewpoint_id: Observations from one viewpoint have common errors.
            quality: Confidence of the detector, 0 to 1.
            size_m: Measured edge length of the sheet, 0 if not measured.
            covariance: 6x6 row-major (position [m], rotation [rad]) in tracking axes; empty: that of the noise model as
                seen from `p_tracking_head`.
            p_tracking_head: Position of the observer.
            alternative: The other pose that explains the same image; it is used if it is the more upright one. Without
                it the pose mirrored along the line of sight is tried, if `p_tracking_head` is known.
            source: Kind of the source: its biases (`AlignmentConfig.biases`) are in the stated error; empty: none.
            shift: By how much the anchor is displaced [m/s] and turned [rad/s] per second that its picture is late.
            residuals: Of the pose and of the alternative, if known: one that fits worse by far is no alternative.

        Returns:
            False if it is not used: unknown anchor, older epoch, not a rigid transform, a sheet of the wrong size, or
            contradicted by gravity.
        """
        T_world_anchor = self.anchors.get(anchor_id)
        if T_world_anchor is None:
            self.unknown_anchors += 1
            return False
        if tracking_epoch < self.tracking_epoch:
            self.stale_epochs += 1
            return False
        if not is_rigid(T_tracking_anchor) or not math.isfinite(quality) or not is_valid_point(p_tracking_head):
            self.invalid += 1
            return False
        if tracking_epoch > self.tracking_epoch:
            self.tracking_epoch = tracking_epoch
            self.reset()
        if not self._has_expected_size(anchor_id, size_m):
            return False
        if alternative is not None and not is_rigid(alternative):
            alternative = None
        pose = self._resolve_mirror(T_world_anchor, T_tracking_anchor, p_tracking_head, alternative, residuals)
        if pose is None:
            self.against_gravity += 1
            self._against_gravity += 1
            return False
        self._memory.add(
            (anchor_id, viewpoint_id % _ERA + _ERA * self._era),
            AnchorObservation(
                capture_ns,
                pose[0],
                pose[1],
                p_tracking_head,
                validate_covariance(covariance),
                quality,
                size_m,
                source,
                shift,
            ),
        )
        return True

    def reset(self) -> None:
        """Discard all observations: the tracking frame has changed."""
        self._memory.clear()
        self._against_gravity, self._misprints, self._near = 0, {}, None
        self._changed, self._left_out = "", {}

    def weigh_alarm(self, anchor_id: str, since_ns: int) -> tuple[str, ...] | None:
        """Take note that an anchor is seen elsewhere than the alignment in force says.

        Earlier observations are kept: later ones decide what was moved (`anchors.evidence`). Where no other anchor was
        observed, there is nothing to compare with, and the later ones replace them.

        Args:
            anchor_id: Name of the anchor.
            since_ns: Capture time of the first observation that contradicts.

        Returns:
            Two or more anchors that agree with each other, if two of them were seen just before and this one never
            agreed with them: then it is outvoted, and the alignment stays. `None` if an error of scale explains all
            looks. Else empty.
        """
        if self._changed and self._changed != anchor_id:
            return ()  # the first contradiction is still open: what is later than that decides
        # Moved once more: what was seen in between does not count.
        between = {key for key in self._memory.groups if key[0] == self._changed and key[1] // _ERA == self._era}
        self._begin_era(since_ns)
        self._memory.discard_groups(between & self._memory.groups.keys())
        if not self._changed and self._is_explained_by_scale(anchor_id):
            self._undo_era(since_ns)
            return None
        self._left_out.pop(anchor_id, None)
        earlier = {key: one for key, one in self._memory.groups.items() if key[1] // _ERA < self._era}
        keys, merged = self._merge(earlier)
        if not any(name != anchor_id for name, _ in keys):
            self._memory.discard_groups(earlier.keys())
            self._changed, self._near = "", None
            return ()
        prior = self.config.prior
        opinion = weigh_earlier_looks(self._build_problem(keys, merged), anchor_id, prior)
        if len(self._select_recent(earlier, opinion.others, since_ns)) >= 2 and not opinion.fitted:
            return opinion.others
        self._changed = anchor_id
        return ()

    def _select_recent(
        self, groups: Mapping[GroupKey, ViewpointGroup], names: Iterable[str], since_ns: int
    ) -> list[str]:
        """Return the anchors that were seen shortly before `since_ns`: older looks may be of a frame that jumped."""
        last: dict[str, int] = {}
        for key, group in groups.items():
            last[key[0]] = max(last.get(key[0], 0), group.observations[-1].capture_ns)
        return [name for name in names if name in last and since_ns - last[name] <= _JUST_BEFORE_NS]

    def _is_explained_by_scale(self, anchor_id: str) -> bool:
        """Return whether an error of scale makes all looks agree that do not without it."""
        new = {k: one for k, one in self._memory.groups.items() if k[0] == anchor_id and k[1] // _ERA == self._era}
        # The looks that contradict agree with each other, so two of them count.
        keys, merged = self._merge(self._memory.select_mature_groups(self.config.min_observations) | new)
        if not new.keys() & set(keys):
            return False
        b = self._build_problem(keys, merged)
        found = explain_by_scale(b, solve_alignment(b, self.config.prior), merged, self.config.prior)
        return found is not None and bool(found[1].inside.all()) and any(one.is_certain for one in found[2])

    def leave_out(self, anchor_id: str, since_ns: int) -> None:
        """Leave an anchor out that was moved, from `since_ns` on (`weigh_alarm`), until it is seen where it was."""
        self._begin_era(since_ns)
        self._left_out[anchor_id] = self._era

    def on_anchors_moved(self) -> None:
        """Accept new poses of anchors: what was seen of a moved one before it was moved no longer counts."""
        old = {k for k in self._memory.groups if k[1] // _ERA < self._left_out.get(k[0], 0)}
        self._memory.discard_groups(old)
        self._changed, self._left_out, self._near = "", {}, None

    def _begin_era(self, since_ns: int) -> None:
        """Make observations captured at `since_ns` or later groups of their own."""
        self._era += 1
        era = _ERA * self._era
        self._memory.split_groups(since_ns, lambda key: (key[0], key[1] % _ERA + era))

    def _undo_era(self, since_ns: int) -> None:
        """Undo `_begin_era`: looks from one viewpoint have common errors."""
        self._era -= 1
        era = _ERA * self._era
        self._memory.split_groups(since_ns, lambda key: (key[0], key[1] % _ERA + era))

    def _resolve_mirror(
        self,
        T_world_anchor: PoseTuple,
        seen: PoseTuple,
        p_head: Vec3 | None,
        alternative: PoseTuple | None,
        residuals: tuple[float, ...],
    ) -> PoseTuple | None:
        """Return the pose, or its mirrored pose if only that one agrees with gravity, `None` if neither does; of two
        that explain the image alike, the more upright one."""
        pose = (seen[0], quat_normalize(seen[1]))
        tilt, bound = _tilt(T_world_anchor, pose), self.config.max_tilt_rad
        is_open = alternative is not None and (len(residuals) != 2 or residuals[1] <= _ALIKE * residuals[0])
        if self.config.dof == 6 or (tilt <= bound and not is_open):
            return pose
        if alternative is not None:
            other: PoseTuple | None = (alternative[0], quat_normalize(alternative[1]))
        else:
            other = mirror_pose(pose, p_head) if p_head is not None else None
        if other is None or _tilt(T_world_anchor, other) > min(tilt, bound):
            return pose if tilt <= bound else None
        self.unmirrored += 1
        return other

    def _has_expected_size(self, anchor_id: str, size_m: float) -> bool:
        """Return whether the sheet has its configured size: one printed too large appears too near by the same
        share."""
        size = self.sizes.get(anchor_id, 0.0)
        if size <= 0.0 or not size_m > 0.0:
            return True
        if abs(size_m - size) <= self.config.size_tolerance * size:
            self._misprints.pop(anchor_id, None)
            return True
        self.wrong_size += 1
        self._misprints[anchor_id] = (
            f"sheet '{anchor_id}' measures {size_m * 1e3:.0f} mm, not {size * 1e3:.0f} mm: printed at the wrong scale?"
        )
        return False

    def _misprint_advice(self) -> str:
        return next(iter(self._misprints.values()), "")

    def estimate(self) -> AlignmentEstimate:
        """Return the alignment by all observations of the current epoch. Unchanged groups are not merged again."""
        if len(self._memory) < self.config.min_observations:
            wrong = self._misprint_advice() or gravity_advice(self._against_gravity, len(self._memory))
            return self._refuse(wrong or LOOK_ADVICE, 0.0 if wrong else self._remaining_look_s())
        groups = self._memory.select_mature_groups(self.config.min_observations)
        keys, merged = self._merge(groups)
        if not merged:
            return self._refuse(CONTRADICT)
        prior = self.config.prior
        b = self._build_problem(keys, merged)
        if self._changed:
            later = np.array([key[1] // _ERA == self._era for key in keys])
            if not self._decide_change(b, later, keys):
                return self._refuse(change_advice(self._changed, {name for name, _ in self._memory.groups}))
            return self.estimate()
        n_groups = len(groups)
        if self._left_out:
            trusted = self._select_trusted(b, keys)
            if not trusted.any():
                return self._refuse(moved_advice(self._left_out))
            n_groups -= len(keys) - int(trusted.sum())
            b = select_groups(b, trusted)
            keys, merged = (
                [k for k, ok in zip(keys, trusted, strict=True) if ok],
                [m for m, ok in zip(merged, trusted, strict=True) if ok],
            )
        s = solve_alignment(b, prior, self._near)
        against = prior.gravity and not self._is_majority(b, s, n_groups)
        if against and median_tilt(b) > self.config.tilt_warning_rad:  # do they contradict each other, or gravity?
            free = solve_alignment(b, replace(prior, tilt_sigma_rad=math.inf))
            s = free if self._is_majority(b, free, n_groups) else s
        scales: tuple[ScaleError, ...] = ()
        scaled = explain_by_scale(b, s, merged, prior)
        if scaled is not None:
            b, s, scales = scaled
        if not s.inside.any():
            return self._refuse(disagreement_advice(sorted(set(b.anchor))))
        tilt, noise = s.measure_tilt(b, self.config.tilt_sigma_rad)
        is_tilted = prior.gravity and tilt > max(noise, self.config.tilt_warning_rad)
        if is_tilted and tilt > self.config.follow_tilt_rad:
            return self._refuse(tilt_advice(tilt))
        if is_tilted:  # all see the same sheet: follow it, and warn
            s = solve_alignment(b, replace(prior, tilt_sigma_rad=tilt), (s.q, s.t))
        self._near = (s.q, s.t)
        agreeing = sum(m.n for m, ok in zip(merged, s.inside.tolist(), strict=True) if ok)
        if agreeing < self.config.min_observations or not self._is_majority(b, s, n_groups):
            return self._refuse(disagreement_advice(sorted(set(b.anchor))))
        self._tested = {} if scales else self._tested | dict(zip(b.sources, s.tested.tolist(), strict=True))
        newest = self._memory.newest_key
        supported = any(ok and key == newest for key, ok in zip(keys, s.inside.tolist(), strict=True))
        return replace(
            self._to_estimate(b, s, (tilt, noise), supported, scales), looks=self._list_looks(keys, s.inside.tolist())
        )

    def _list_looks(self, keys: list[GroupKey], inside: list[bool]) -> tuple[tuple[str, int, int], ...]:
        """Return the anchors that agree, with the times of the first and the last of those looks."""
        looks: dict[str, tuple[int, int]] = {}
        for key, ok in zip(keys, inside, strict=True):
            if ok:
                seen = self._memory.groups[key].observations
                first, last = looks.get(key[0], (seen[0].capture_ns, seen[-1].capture_ns))
                looks[key[0]] = min(first, seen[0].capture_ns), max(last, seen[-1].capture_ns)
        return tuple((name, *times) for name, times in looks.items())

    def discard_anchor(self, anchor_id: str) -> None:
        """Discard what was seen of an anchor: there are two prints of it."""
        self._memory.discard_groups({key for key in self._memory.groups if key[0] == anchor_id})
        self._left_out.pop(anchor_id, None)
        self._changed, self._near = "" if self._changed == anchor_id else self._changed, None

    def _decide_change(self, b: AlignmentProblem, later: Mask, keys: list[GroupKey]) -> bool:
        """Decide what a contradiction means (`anchors.evidence`), and keep what still counts; false if it is open."""
        verdict = weigh_change(b, later, self._changed, self.config.prior)
        if verdict == "open":
            return False
        if verdict == "sheet":
            self._left_out[self._changed] = self._era
        elif verdict == "frame":
            self._memory.discard_groups({key for key in self._memory.groups if key[1] // _ERA < self._era})
            self._near = None
            self._left_out.clear()
        self._changed = ""
        return True

    def _select_trusted(self, b: AlignmentProblem, keys: list[GroupKey]) -> Mask:
        """Return the groups without those of sheets that were moved, unless they are seen where they were."""
        moved = np.array([key[1] // _ERA >= self._left_out.get(key[0], self._era + 1) for key in keys])
        if moved.any() and not moved.all():
            s = solve_alignment(select_groups(b, ~moved), self.config.prior, self._near)
            back = find_fitting_groups(select_groups(b, moved), s)
            for name in list_agreeing_anchors([n for (n, _), out in zip(keys, moved, strict=True) if out], back):
                del self._left_out[name]
                moved &= np.array([key[0] != name for key in keys])
        return ~moved

    def _merge(self, groups: Mapping[GroupKey, ViewpointGroup]) -> tuple[list[GroupKey], list[MergedObservation]]:
        """Return one merged observation per anchor and viewpoint whose observations agree, with their keys."""
        fallback = isotropic_covariance(self.config.position_sigma_m, self.config.rotation_sigma_rad)
        keys, merged = [], []
        for key, group in groups.items():
            one = group.merge(self.config.noise, fallback, self.config.min_agreeing)
            if one is not None:
                keys.append(key)
                merged.append(one)
        return keys, merged

    def _build_problem(self, keys: list[GroupKey], merged: list[MergedObservation]) -> AlignmentProblem:
        times = [self._memory.groups[key].capture_ns for key in keys]
        newest = max(group.observations[-1].capture_ns for group in self._memory.groups.values())
        poses = [self.anchors[anchor_id] for anchor_id, _ in keys]
        return build_problem(
            [anchor_id for anchor_id, _ in keys],
            np.array([p for p, _ in poses]),
            np.array([q for _, q in poses]),
            merged,
            np.array([min(ns - newest, 0) * 1e-9 for ns in times]),
            self.config.prior,
            self.config.biases,
            self._tested,
        )

    def _is_majority(self, b: AlignmentProblem, s: AlignmentSolution, n_groups: int) -> bool:
        """Return whether a majority agrees: of the anchors if there are three or more (a moved one may have been
        observed most often), else of the viewpoints, counting those whose own observations disagree. Two anchors that
        contradict each other have no majority, however often each was observed."""
        votes = count_votes(b.anchor, s.inside)
        if len(votes) > 2:
            return 2 * sum(1 for n in votes.values() if n > 0) > len(votes)
        return 2 * int(np.count_nonzero(s.inside)) > n_groups and min(votes.values()) >= 0

    def _to_estimate(
        self,
        b: AlignmentProblem,
        s: AlignmentSolution,
        tilt_and_noise: tuple[float, float],
        supported: bool,
        scales: tuple[ScaleError, ...],
    ) -> AlignmentEstimate:
        tilt, noise = tilt_and_noise
        agreeing = {name for name, ok in zip(b.anchor, s.inside.tolist(), strict=True) if ok}
        # No viewpoint of these agrees with the rest, or none since they were moved.
        moved = tuple(sorted(set(b.anchor) - agreeing | self._left_out.keys()))
        wider = s.chi2 / s.freedom if s.freedom > 0.0 and s.chi2 > chi2_quantile(s.freedom, Z99) else 1.0
        pivot = s.inside @ b.p_world / float(s.inside.sum())
        pivot_world = to_vec3(pivot)
        in_the_world = to_world_covariance(s.q, s.covariance, pivot) * wider
        covariance = tuple(in_the_world.ravel().tolist())
        error = length_p95(in_the_world[:3, :3])
        refused = not error <= self.config.max_error_m
        if refused:
            advice = f"the error would be {error * 1e3:.0f} mm: step closer to the sheet, look at it from several sides"
        elif moved:
            advice = f"moved since it was measured: sheet {' and '.join(map(repr, moved))}; it is not used"
        elif tilt > max(noise, self.config.tilt_warning_rad) and self.config.dof == 4:
            advice = f"the headset's vertical is off by {math.degrees(tilt):.1f} deg: is the sheet level as configured?"
        else:
            advice = size_advice(self._memory.groups, self.config.size_tolerance) or self._misprint_advice()
        if not refused:
            advice = "; ".join(filter(None, [advice, describe_scale(scales, self.sizes)]))
        return AlignmentEstimate(
            inverse((to_vec3(s.t), to_quat(s.q))),
            self.tracking_epoch,
            covariance,
            pivot_world,
            error,
            tilt,
            len(self._memory),
            len({viewpoint for _, viewpoint in self._memory.groups}),
            refused,
            advice,
            moved,
            supported,
            tilt_noise_rad=noise,
            look_s=self._remaining_look_s(),
        )

    def _refuse(self, advice: str, look_s: float = 0.0) -> AlignmentEstimate:
        viewpoints = len({viewpoint for _, viewpoint in self._memory.groups})
        refusal = AlignmentEstimate.refusal(self.tracking_epoch, advice, len(self._memory), viewpoints)
        return replace(refusal, look_s=look_s)

    def _remaining_look_s(self) -> float:
        """Return for how long [s] more looks at their present rate sharpen the estimate much: until there are
        `min_observations`, and `LOOK_S` after the first one."""
        groups, n = self._memory.groups.values(), len(self._memory)
        first = min((group.observations[0].capture_ns for group in groups), default=0)
        span_s = max((group.observations[-1].capture_ns - first for group in groups), default=0) * 1e-9
        missing_s = max(0, self.config.min_observations - n) * span_s / max(1, n - 1)
        return min(max(0.0, missing_s, LOOK_S - span_s), MAX_LOOK_S)


def mirror_pose(T_tracking_anchor: PoseTuple, p_tracking_head: Vec3) -> PoseTuple:
    """Return the other pose of a flat sheet that gives nearly the same image: its plane reflected along the line of
    sight.

    Under weak perspective an image does not change when depth is negated: R' = (I - 2 v v^T) R diag(1, 1, -1)
    (Oberkampf, DeMenthon and Davis 1996; Collins and Bartoli 2014). As quaternions: q' = v * q * z.
    """
    p, q = T_tracking_anchor
    x, y, z = (p[i] - p_tracking_head[i] for i in range(3))
    n = math.sqrt(x * x + y * y + z * z)
    if n < 1e-9:
        return T_tracking_anchor
    view: Quat = (0.0, x / n, y / n, z / n)
    return p, quat_normalize(quat_mul(quat_mul(view, q), (0.0, 0.0, 0.0, 1.0)))


def _tilt(T_world_anchor: PoseTuple, T_tracking_anchor: PoseTuple) -> float:
    """Return the angle [rad] between the vertical of the world and of the tracking frame by this one observation."""
    _, q = compose(T_world_anchor, inverse(T_tracking_anchor))
    up = quat_rotate(q, (0.0, 0.0, 1.0))
    return math.atan2(math.hypot(up[0], up[1]), up[2])


# --- advice -----------------------------------------------------------------------------------------------------------

LOOK_S: Final = 2.0
MAX_LOOK_S: Final = 10.0
LOOK_ADVICE: Final = "look at the anchor sheet for a few seconds, from about half a metre"
CONTRADICT: Final = (
    "observations contradict each other: did the sheet move, or the headset lose tracking? hold still, look at the "
    "sheet again"
)


def disagreement_advice(anchor_ids: Sequence[str]) -> str:
    """Return the advice for contradicting observations, with names if several sheets take part."""
    if len(anchor_ids) < 2:
        return CONTRADICT
    return f"{CONTRADICT}; one of these was moved: {', '.join(anchor_ids)}"


def change_advice(anchor_id: str, known: Collection[str]) -> str:
    """Return the advice for a sheet that contradicts others. It names in quotes what is to be looked at."""
    others = " or ".join(f"'{name}'" for name in sorted(set(known) - {anchor_id}))
    return f"sheet {anchor_id} is not where the others say: was it moved, or did tracking jump? look at sheet {others}"


def moved_advice(anchor_ids: Collection[str]) -> str:
    """Return the advice when only moved sheets are in view."""
    names = " and ".join(map(repr, sorted(anchor_ids)))
    return f"sheet {names} was moved: put it back, or set where it lies now (iris-session anchors move)"


def gravity_advice(against_gravity: int, taken: int) -> str:
    """Return the advice if most observations contradict gravity, else an empty text."""
    if against_gravity <= 2 * taken or against_gravity < 5:
        return ""
    return "the sheet is not mounted as configured (lying, or on a wall): its pose contradicts the vertical"


def tilt_advice(tilt_rad: float) -> str:
    """Return the advice for observations that agree with each other, but not with gravity."""
    return (
        f"the sheet is tilted by {math.degrees(tilt_rad):.0f} deg against the headset's vertical: lay it level, or "
        "configure how it lies"
    )


def size_advice(groups: Mapping[GroupKey, ViewpointGroup], tolerance: float) -> str:
    """Return a warning about a sheet measured in several sizes; single wrong measurements do not count."""
    extremes: dict[str, tuple[float, float]] = {}
    for (anchor_id, _), group in groups.items():
        if group.sizes is not None:
            low, high = extremes.get(anchor_id, group.sizes)
            extremes[anchor_id] = (min(low, group.sizes[0]), max(high, group.sizes[1]))
    for anchor_id, (least, most) in extremes.items():
        if most - least <= tolerance * least:
            continue  # then no quantiles are further apart
        seen = sorted(size for (name, _), group in groups.items() if name == anchor_id for size in group.list_sizes())
        low, high = seen[len(seen) // 10], seen[(9 * len(seen)) // 10 if len(seen) > 1 else 0]
        if high - low > tolerance * low:
            return f"sheet '{anchor_id}' is seen in different sizes: is there a second one, printed at another scale?"
    return ""
