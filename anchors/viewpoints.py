"""Observations grouped by anchor and viewpoint, bounded in number, and merged robustly.

Errors of observations from one viewpoint are correlated, so each group counts as one observation: the first stage
behind `anchors.alignment`. Wrong detections are a minority and far off: observations outside the 99.9 % ellipsoid about
the median are left out, the others count in full (trimming keeps Gaussian noise efficient). Where observations scatter
more than stated, the ellipsoid grows with their median distance, and the covariance with the residuals. A group is
merged at most once per change.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Set
from dataclasses import dataclass, field, replace
from typing import Final, NamedTuple

import numpy as np

from anchors.lie import Array, quat_conjugate, quat_exp, quat_log, quat_multiply
from anchors.pose import Quat, Vec3
from anchors.uncertainty import Z999, NoiseModel, chi2_quantile

GroupKey = tuple[str, int]
#: How late a picture may be for the head pose it is combined with (assumed), and that as a sigma about 0.
MAX_LATE_S: Final = 0.060
LATE_SIGMA_S: Final = MAX_LATE_S / math.sqrt(3.0)
_MIN_MATURE: Final = 3  # fewer observations cannot outvote one wrong detection among them


class AnchorObservation(NamedTuple):
    """One observation `T_tracking_anchor` (`p`, unit `q`). `p_head`: position of the observer, tracking frame.
    `covariance`: as stated by the observer and validated (36 values), else empty. `shift` (6,): displacement [m/s] and
    turn [rad/s] per second that the picture is late, empty if unknown."""

    capture_ns: int
    p: Vec3
    q: Quat
    p_head: Vec3 | None
    covariance: tuple[float, ...]
    quality: float
    size_m: float
    source: str = ""
    shift: tuple[float, ...] = ()


@dataclass
class ViewpointGroup:
    """Observations of one anchor from one viewpoint, oldest first. `sizes`: smallest and largest measured size [m] as
    of the last `merge`."""

    observations: deque[AnchorObservation] = field(default_factory=deque)
    merged: MergedObservation | None = None
    sizes: tuple[float, float] | None = None
    dirty: bool = True

    def merge(self, noise: NoiseModel, fallback: Array, min_agreeing: float) -> MergedObservation | None:
        """Return the robust mean, computed again only after a change; `None` if too few observations agree."""
        if self.dirty:
            p = np.array([s.p for s in self.observations])
            q = np.array([s.q for s in self.observations])
            common, each = self._noise(p, noise, fallback)
            if any(s.shift for s in self.observations):
                shared, new = compute_lateness([s.shift for s in self.observations if s.shift])
                common, each = common + shared, each + new
            merged, self.dirty = merge_poses(p, q, common, each, min_agreeing), False
            heads = [s.p_head for s in self.observations if s.p_head is not None]
            p_head = fast_median(np.array(heads)) if heads else None
            source = self.observations[-1].source
            self.merged = None if merged is None else replace(merged, p_head=p_head, source=source)
            sizes = self.list_sizes()
            self.sizes = (min(sizes), max(sizes)) if sizes else None
        return self.merged

    def list_sizes(self) -> list[float]:
        """Return the measured sizes [m]; 0 and invalid values mean that none was measured."""
        return [s.size_m for s in self.observations if 0.0 < s.size_m < math.inf]

    def _noise(self, p: Array, noise: NoiseModel, fallback: Array) -> tuple[Array, Array]:
        """Return the noise covariances: as stated by the observers, else by the noise model, else the fallback."""
        given = [s.covariance for s in self.observations if s.covariance]
        if given:
            return noise.split_covariance(np.mean(np.array(given), axis=0).reshape(6, 6))
        heads = [s.p_head for s in self.observations if s.p_head is not None]
        if heads:
            return noise.compute_covariances(fast_median(np.array(heads)), fast_median(p))
        quality = float(np.mean([min(max(s.quality, 0.05), 1.0) for s in self.observations]))
        return noise.split_covariance(fallback / quality)

    @property
    def capture_ns(self) -> int:
        """Middle of the time span of the observations."""
        return (self.observations[0].capture_ns + self.observations[-1].capture_ns) // 2


@dataclass
class ObservationBuffer:
    """Bounded buffer of the groups of one tracking epoch; the oldest observations are discarded first."""

    max_observations: int
    max_in_group: int
    max_groups: int
    max_age_ns: int
    forgotten: int = 0
    outdated: int = 0
    groups: dict[GroupKey, ViewpointGroup] = field(default_factory=dict)
    _order: deque[GroupKey] = field(default_factory=deque)
    _last_ns: int = 0

    def __len__(self) -> int:
        return len(self._order)

    @property
    def newest_key(self) -> GroupKey | None:
        """The group of the newest observation."""
        return self._order[-1] if self._order else None

    def add(self, key: GroupKey, sighting: AnchorObservation) -> None:
        """Add one observation and discard those that are too old or too many."""
        self._discard_outdated(sighting.capture_ns)
        while len(self._order) >= self.max_observations:
            self._pop()
            self.forgotten += 1
        group = self.groups.setdefault(key, ViewpointGroup())
        if (
            len(group.observations) >= self.max_in_group
        ):  # a long observation displaces itself, not the other viewpoints
            group.observations.popleft()
            self._order.remove(key)
            self.forgotten += 1
        group.observations.append(sighting)
        group.dirty = True
        self._order.append(key)
        while len(self.groups) > self.max_groups:
            self._pop()
            self.forgotten += 1

    def clear(self) -> None:
        self.groups.clear()
        self._order.clear()

    def split_groups(self, since_ns: int, rename: Callable[[GroupKey], GroupKey]) -> None:
        """Move observations captured at `since_ns` or later to groups of another name."""
        old = {key: deque(group.observations) for key, group in self.groups.items()}
        order = list(self._order)
        self.clear()
        for key in order:
            one = old[key].popleft()
            new = rename(key) if one.capture_ns >= since_ns else key
            self.groups.setdefault(new, ViewpointGroup()).observations.append(one)
            self._order.append(new)

    def discard_groups(self, keys: Set[GroupKey]) -> None:
        """Discard groups with all their observations."""
        self._order = deque(key for key in self._order if key not in keys)
        self.groups = {key: group for key, group in self.groups.items() if key not in keys}

    def select_mature_groups(self, enough: int) -> dict[GroupKey, ViewpointGroup]:
        """Return the groups to estimate from.

        A group with very few observations must not contradict one that has `enough`: its first detection may be
        wrong.
        """
        if all(len(group.observations) < enough for group in self.groups.values()):
            return self.groups
        return {key: group for key, group in self.groups.items() if len(group.observations) >= _MIN_MATURE}

    def _pop(self) -> None:
        key = self._order.popleft()
        group = self.groups[key]
        group.observations.popleft()
        group.dirty = True
        if not group.observations:
            del self.groups[key]

    def _discard_outdated(self, now_ns: int) -> None:
        """Discard observations older than `max_age_ns` at `now_ns`, also after the sender's clock was set."""
        jumped = abs(now_ns - self._last_ns) > self.max_age_ns
        self._last_ns = now_ns
        if jumped:
            self._keep_recent(now_ns)
        while self._order and abs(now_ns - self.groups[self._order[0]].observations[0].capture_ns) > self.max_age_ns:
            self._pop()
            self.outdated += 1

    def _keep_recent(self, now_ns: int) -> None:
        kept = ObservationBuffer(self.max_observations, self.max_in_group, self.max_groups, self.max_age_ns)
        kept._last_ns = now_ns
        old = {key: deque(group.observations) for key, group in self.groups.items()}
        for key in self._order:
            sighting = old[key].popleft()
            if abs(now_ns - sighting.capture_ns) <= self.max_age_ns:
                kept.add(key, sighting)
            else:
                self.outdated += 1
        self.groups, self._order = kept.groups, kept._order
        self.outdated += kept.outdated


# --- robust mean ------------------------------------------------------------------------------------------------------

_CHI2_3_MEDIAN: Final = 2.366
_CHI2_3_999: Final = 16.266
_MAX_SCATTER: Final = 100.0  # variance ratio beyond which it is no longer noise


@dataclass(frozen=True)
class MergedObservation:
    """Observations of one anchor from one viewpoint as one: mean `T_tracking_anchor` (`p`, `q`), its covariance (6, 6)
    in tracking axes, how many agree (`n`) and how many there were (`of`). `p_head`: median position of the observer,
    if known; `source`: whose biases it has."""

    p: Array
    q: Array
    covariance: Array
    n: int
    n_total: int
    p_head: Array | None = None
    source: str = ""


def merge_poses(p: Array, q: Array, common: Array, each: Array, min_agreeing: float) -> MergedObservation | None:
    """Return the robust mean of poses `T_tracking_anchor`, positions (n, 3) and quaternions (n, 4).

    `common`, `each`: covariance (6, 6) of the error that all share, and of the one that is new in each. `None` when
    less than the share `min_agreeing` of them agree.
    """
    count = len(p)
    towards = q @ q[0]
    centre = fast_median(q if float(towards.min()) >= 0.0 else np.where(towards[:, None] < 0.0, -q, q))
    norm = math.sqrt(float(centre @ centre))
    if norm < 0.1:
        return None  # orientations are spread over the whole sphere
    centre = centre / norm
    x = np.empty((2, count, 3))  # positions, and turns from the median
    x[0], x[1] = p, quat_log(quat_multiply(q, quat_conjugate(centre)))
    about = fast_median(x)
    x -= about[:, None, :]
    information = np.linalg.inv(np.array([each[:3, :3], each[3:, 3:]]))
    d2 = np.add.reduce((x @ information) * x, axis=2)  # (2, n)
    bounds = [_CHI2_3_999 * min(max(m / _CHI2_3_MEDIAN, 1.0), _MAX_SCATTER) for m in fast_median(d2.T).tolist()]
    keep = ((d2[0] <= bounds[0]) & (d2[1] <= bounds[1])).astype(np.float64)
    n = int(keep.sum())
    if n == 0 or n < min_agreeing * count:
        return None
    mean = keep @ x / n
    # About the mean, from that about the median.
    chi2 = d2 @ keep - n * np.add.reduce((mean[:, None, :] @ information)[:, 0, :] * mean, axis=1)
    wider = _birge_factors(chi2.tolist(), n)
    covariance = common + each / n
    if wider is not None:
        covariance = covariance * wider[:, None] * wider
    mean += about
    return MergedObservation(mean[0], quat_multiply(quat_exp(mean[1]), centre), covariance, n, count)


def compute_lateness(shifts: list[tuple[float, ...]]) -> tuple[Array, Array]:
    """Return covariances (6, 6) of observations whose pictures are late by an unknown, constant time: of what is common
    to them, and of what is new in each. `shifts`: displacement and turn per second."""
    rows = LATE_SIGMA_S * np.array(shifts)
    mean = rows.mean(axis=0)
    rows = rows - mean
    return mean[:, None] * mean, rows.T @ rows / len(rows)


def fast_median(x: Array) -> Array:
    """Return the median over the last but one axis (numpy's own costs more than everything else here)."""
    n = x.shape[-2]
    x = np.sort(x, axis=-2)
    return np.asarray(0.5 * (x[..., (n - 1) // 2, :] + x[..., n // 2, :]))


def _birge_factors(chi2: list[float], n: int) -> Array | None:
    """Return the factors (6,) by which standard deviations exceed the stated ones, `None` unless chi-square is beyond
    its 99.9 % quantile.

    Never below 1: small residuals of so few observations prove nothing (Birge ratio, one-sided).
    """
    freedom = 3.0 * (n - 1)
    if freedom < 1.0:
        return None
    bound = chi2_quantile(freedom, Z999)
    if max(chi2) <= bound:
        return None
    return np.repeat([math.sqrt(c / freedom) if c > bound else 1.0 for c in chi2], 3)


def circular_median(angles: Array) -> float:
    """Return the angle among `angles` (n,) [rad] with the least sum of absolute differences, robust to outliers."""
    differences = np.abs((angles[:, None] - angles[None, :] + math.pi) % (2.0 * math.pi) - math.pi)
    return float(angles[int(np.argmin(np.sum(differences, axis=1)))])
