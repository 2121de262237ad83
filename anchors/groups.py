"""Observations as they are kept: in groups of one anchor from one viewpoint, whose errors are correlated, and bounded.

Each group is merged (`anchors.robust`) at most once per change; everything can be written down and taken up again.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import numpy as np

from anchors.lie import Array
from anchors.noise import NoiseModel
from anchors.pose import Quat, Vec3
from anchors.robust import MergedObservation, merge_poses, fast_median

GroupKey = tuple[str, int]
_JUST_BEGUN: Final = 3  # fewer sightings cannot outvote one wrong detection among them


class AnchorObservation(NamedTuple):
    """One observation `T_tracking_anchor` (`p`, unit `q`). `p_head`: where the observer was, tracking frame.
    `covariance`: as stated by the observer and found valid (36 values), else empty."""

    capture_ns: int
    p: Vec3
    q: Quat
    p_head: Vec3 | None
    covariance: tuple[float, ...]
    quality: float
    size_m: float


@dataclass
class ViewpointGroup:
    """Sightings of one anchor from one viewpoint, oldest first. `sizes`: the smallest and the largest [m] that was
    measured, as of the last `solve`."""

    observations: deque[AnchorObservation] = field(default_factory=deque)
    merged: MergedObservation | None = None
    sizes: tuple[float, float] | None = None
    dirty: bool = True

    def merge(self, noise: NoiseModel, fallback: Array, min_agreeing: float) -> MergedObservation | None:
        """The robust mean; computed again only after a change."""
        if self.dirty:
            p = np.array([s.p for s in self.observations])
            q = np.array([s.q for s in self.observations])
            common, each = self._noise(p, noise, fallback)
            self.merged, self.dirty = merge_poses(p, q, common, each, min_agreeing), False
            sizes = self.list_sizes()
            self.sizes = (min(sizes), max(sizes)) if sizes else None
        return self.merged

    def list_sizes(self) -> list[float]:
        """Measured sizes [m]; 0 and what is no size stands for none."""
        return [s.size_m for s in self.observations if 0.0 < s.size_m < math.inf]

    def _noise(self, p: Array, noise: NoiseModel, fallback: Array) -> tuple[Array, Array]:
        """What the observers state comes first, then the model from where they stood, then the configured default."""
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
        """Middle of the time in which it was seen."""
        return (self.observations[0].capture_ns + self.observations[-1].capture_ns) // 2


@dataclass
class ObservationBuffer:
    """Groups of one tracking epoch; the oldest observations go first."""

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

    def add(self, key: GroupKey, sighting: AnchorObservation) -> None:
        """Takes one more and forgets what is too old or too much."""
        self._forget_outdated(sighting.capture_ns)
        while len(self._order) >= self.max_observations:
            self._pop()
            self.forgotten += 1
        group = self.groups.setdefault(key, ViewpointGroup())
        if len(group.observations) >= self.max_in_group:  # a long look pushes out itself, not the other viewpoints
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

    def select_mature_groups(self, enough: int) -> dict[GroupKey, ViewpointGroup]:
        """Groups that count: one just begun does not outvote or contradict one that has `enough` sightings, for its
        first detection may be a wrong one."""
        if all(len(group.observations) < enough for group in self.groups.values()):
            return self.groups
        return {key: group for key, group in self.groups.items() if len(group.observations) >= _JUST_BEGUN}

    def _pop(self) -> None:
        key = self._order.popleft()
        group = self.groups[key]
        group.observations.popleft()
        group.dirty = True
        if not group.observations:
            del self.groups[key]

    def _forget_outdated(self, now_ns: int) -> None:
        """What comes last counts, also when the sender's clock was set in between."""
        jumped = abs(now_ns - self._last_ns) > self.max_age_ns
        self._last_ns = now_ns
        if jumped:
            self._keep_only(now_ns)
        while self._order and abs(now_ns - self.groups[self._order[0]].observations[0].capture_ns) > self.max_age_ns:
            self._pop()
            self.outdated += 1

    def _keep_only(self, now_ns: int) -> None:
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

    def snapshot(self) -> dict[str, Any]:
        """Plain data; floats survive JSON exactly."""
        return {
            "counts": [self.forgotten, self.outdated, self._last_ns],
            "order": [list(key) for key in self._order],
            "groups": [[*key, [list(s) for s in group.observations]] for key, group in self.groups.items()],
        }

    def restore(self, data: dict[str, Any]) -> None:
        self.forgotten, self.outdated, self._last_ns = data["counts"]
        self._order = deque((str(a), int(v)) for a, v in data["order"])
        self.groups = {}
        for anchor_id, viewpoint_id, rows in data["groups"]:
            group = ViewpointGroup()
            for capture_ns, p, q, p_head, covariance, quality, size_m in rows:
                head = None if p_head is None else (p_head[0], p_head[1], p_head[2])
                group.observations.append(
                    AnchorObservation(capture_ns, tuple(p), tuple(q), head, tuple(covariance), quality, size_m)
                )
            self.groups[anchor_id, viewpoint_id] = group
