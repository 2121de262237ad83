"""Detect drift and jumps of the tracking frame of one headset.

A change is found in two ways. (1) Against earlier observations of the same anchor: the last second against the ten
before it; errors common to a viewpoint cancel, so small changes show. (2) Against the alignment in force, also after
the anchor was out of sight; here all uncertainties count, and yaw is watched too. A source that is too slow for these
times has windows of a few looks instead. A jump (the tracking frame moved at once) needs no statistics: a new
`tracking_epoch`, a head faster than people are, or three detections in a row that agree with each other far away. Pure:
times are passed in; every observation must be a look (`anchors.looks`), as a repeated pose agrees with itself.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

import numpy as np

from anchors.alignment import AlignmentEstimate
from anchors.lie import Array, quat_conjugate, quat_log, quat_multiply, quat_to_matrix, to_vec3
from anchors.looks import Look
from anchors.pose import PoseTuple, Quat, Vec3, apply, distance, is_rigid, is_valid_point, quat_angle
from anchors.uncertainty import NoiseModel, isotropic_covariance
from anchors.viewpoints import MAX_LATE_S, fast_median

AlarmKind = Literal["changed", "differs", "jump", "epoch", "two_places"]

_CHI2_3_ONE_IN_A_MILLION: Final = 30.66
_CHI2_1_ONE_IN_A_MILLION: Final = 23.93
_MIN_BESIDE: Final = 2  # detections of another anchor: one alone may be wrong
_MEDIAN_VARIANCE: Final = math.pi / 2.0  # of a median over that of a mean, Gaussian noise
_MIN_AGREEING: Final = 0.6  # share of a window near its median: fewer say nothing
#: Share of a deviation by which the looks that show it may move, and those before it; and noise explains as much.
_MAX_MOVING: Final = 0.15
_MAX_MOVING_BEFORE: Final = 0.3
_MOVING_SIGMAS: Final = 2.0
_MIN_AGREEING_BEFORE: Final = 0.75  # of those before a change: a smeared wrong detection may be among them
_AT_REST: Final = (0.0,) * 6
_AGREEING_M: Final = 0.015  # or three sigma


class Alarm(NamedTuple):
    """A detected change: `changed` and `differs` ask for a new observation, `jump` and `epoch` invalidate the
    alignment.

    `size_m`: distance, of a turn that 1 m away; `capture_ns`: time of detection, of a jump the time of its first
    observation; `since_ns`: that time of the others, about; `beside`: other anchors that did not change meanwhile (then
    this one was moved). `p`: where the anchor is now, tracking frame.
    """

    kind: AlarmKind
    anchor_id: str
    size_m: float
    capture_ns: int
    beside: tuple[str, ...] = ()
    since_ns: int = 0
    p: Vec3 | None = None

    @property
    def invalidates(self) -> bool:
        return self.kind in ("jump", "epoch")


@dataclass(frozen=True)
class DriftConfig:
    """Thresholds of the monitor.

    `window_ns`: length of the present window; `reference_ns`: of the window before it, which is summarized every
    `reference_every_ns`. Where fewer than `min_in_window` looks lie in them, each has its newest so many, not older
    than `max_window_ns` and `max_reference_ns`. `min_change_m`, `min_difference_m`, `min_turn_rad`: smaller changes
    are left to corrections. `same_place_m`: of two viewpoints this far apart half of the common errors does not cancel.
    `drift_m_per_s`: of the tracking frame, per axis. `jump_m`: `jump_count` consecutive detections that far away are a
    jump. `max_speed_m_per_s`, `max_turn_rad_per_s`: upper bounds of a head's motion. `quiet_ns`: time after an alarm in
    which an anchor raises no other. `unknown_viewpoint_sigma_m`: noise per axis of detections without a head pose.
    """

    window_ns: int = 1_000_000_000
    reference_ns: int = 10_000_000_000
    reference_every_ns: int = 500_000_000
    max_window_ns: int = 20_000_000_000
    max_reference_ns: int = 90_000_000_000
    min_in_window: int = 5
    min_change_m: float = 0.006
    min_difference_m: float = 0.010
    min_turn_rad: float = math.radians(1.0)
    same_place_m: float = 0.06
    drift_m_per_s: float = 0.003 / 60.0 / math.sqrt(3.0)
    jump_m: float = 0.03
    jump_count: int = 3
    max_speed_m_per_s: float = 6.0
    max_turn_rad_per_s: float = 20.0
    quiet_ns: int = 2_000_000_000
    max_detections: int = 600
    unknown_viewpoint_sigma_m: float = 0.005


class _Detection(NamedTuple):
    capture_ns: int
    p: Vec3
    q: Quat
    viewpoint_id: int
    p_head: Vec3 | None
    shift: tuple[float, ...]


class _Window(NamedTuple):
    """Median position of some observations of one viewpoint, its own covariance (6, 6), that of `each` of them, and
    that of what they share. `looks` (n, 3): positions of those near it, oldest first. `away`: position of the head from
    the anchor. `shift` (6,): displacement and turn per second of lateness."""

    p: Array
    own: Array
    each: Array
    common: Array
    looks: Array
    viewpoint_id: int
    capture_ns: int
    away: Array | None
    shift: Array
    agreeing: float  # share of the looks near the median


@dataclass
class DriftMonitor:
    """Monitor of one headset. `anchors`: `T_world_anchor`. Add every detection and, as often as known, the head
    pose."""

    anchors: Mapping[str, PoseTuple]
    noise: NoiseModel = field(default_factory=NoiseModel)
    config: DriftConfig = field(default_factory=DriftConfig)
    tracking_epoch: int = 0
    _detections: dict[str, deque[_Detection]] = field(default_factory=dict)
    _quiet_until_ns: dict[str, int] = field(default_factory=dict)
    _references: dict[str, tuple[int, int, _Window | None]] = field(default_factory=dict)
    _steady_ns: dict[str, int] = field(default_factory=dict)
    _head: tuple[int, PoseTuple] | None = None

    def add_head_pose(self, T_tracking_head: PoseTuple, capture_ns: int, tracking_epoch: int) -> Alarm | None:
        """Add a tracked head pose and return an alarm for a new epoch or an impossible speed."""
        if tracking_epoch < self.tracking_epoch or not is_rigid(T_tracking_head):
            return None  # old tracking frame or invalid pose
        alarm = self._update_epoch(capture_ns, tracking_epoch)
        last, self._head = self._head, (capture_ns, T_tracking_head)
        if alarm is not None or last is None or not 0 < capture_ns - last[0] <= 500_000_000:
            return alarm
        seconds = (capture_ns - last[0]) * 1e-9
        moved, turned = distance(last[1][0], T_tracking_head[0]), quat_angle(last[1][1], T_tracking_head[1])
        c = self.config
        if moved > c.jump_m + c.max_speed_m_per_s * seconds or turned > 0.2 + c.max_turn_rad_per_s * seconds:
            self._reset()
            return Alarm("jump", "", moved, capture_ns)
        return None

    def add_observation(
        self,
        anchor_id: str,
        T_tracking_anchor: PoseTuple,
        look: Look,
        capture_ns: int,
        tracking_epoch: int,
        alignment: AlignmentEstimate | None = None,
    ) -> Alarm | None:
        """Add one detection and return at most one alarm. `alignment`: the alignment in force, if any."""
        if not is_rigid(T_tracking_anchor) or not is_valid_point(look.p_tracking_head):
            return None
        alarm = self._update_epoch(capture_ns, tracking_epoch)
        if alarm is not None or tracking_epoch < self.tracking_epoch or anchor_id not in self.anchors:
            return alarm
        seen = self._detections.setdefault(anchor_id, deque(maxlen=self.config.max_detections))
        while seen and not 0 <= capture_ns - seen[0].capture_ns <= self.config.max_reference_ns:
            seen.popleft()
        seen.append(_Detection(capture_ns, *T_tracking_anchor, look.viewpoint_id, look.p_tracking_head, look.shift))
        if 0 < self._quiet_until_ns.get(anchor_id, 0) - capture_ns <= self.config.quiet_ns:
            return None  # more than that: the clock was set back
        return self._check_anchor(anchor_id, capture_ns, alignment)

    def _check_anchor(self, anchor_id: str, now_ns: int, alignment: AlignmentEstimate | None) -> Alarm | None:
        seen = self._detections[anchor_id]
        new = self._select_window(seen)
        reference = self._get_reference(anchor_id, now_ns, new)
        jumped = self._measure_jump(new, reference)
        if jumped:
            since_ns = new[-self.config.jump_count].capture_ns
            beside = self._find_unmoved_anchors(anchor_id, since_ns, jumped)
            if beside:
                return self._raise_alarm("changed", anchor_id, jumped, now_ns, beside, since_ns)
            self._reset()
            p = to_vec3(np.mean([s.p for s in new[-self.config.jump_count :]], axis=0))
            return Alarm("jump", anchor_id, jumped, since_ns, since_ns=since_ns, p=p)
        if len(new) < self.config.min_in_window:
            return None
        now = self._summarize(new)
        if now.agreeing < _MIN_AGREEING:
            return None
        changed = self._measure_change(now, reference)
        differs = 0.0 if changed else self._measure_difference(anchor_id, now, alignment)
        if not self._is_settled(now, changed or differs):
            return None
        if changed:
            since_ns = new[len(new) // 2].capture_ns
            beside = self._find_unmoved_anchors(anchor_id, since_ns, changed)
            return self._raise_alarm("changed", anchor_id, changed, now_ns, beside, since_ns)._replace(p=to_vec3(now.p))
        differs = differs or self._measure_turn(anchor_id, new, now, alignment)
        if differs:
            beside = self._find_steady_anchors(anchor_id, new[0].capture_ns)
            alarm = self._raise_alarm("differs", anchor_id, differs, now_ns, beside, new[0].capture_ns)
            return alarm._replace(p=to_vec3(now.p))
        if alignment is not None and not alignment.refused and alignment.tracking_epoch == self.tracking_epoch:
            self._steady_ns[anchor_id] = now_ns  # what was compared with nothing says nothing of the frame
        return None

    def _select_window(self, seen: deque[_Detection]) -> list[_Detection]:
        """Return the newest detections from the present viewpoint, oldest first: those of the last window, or as many
        as are enough."""
        c = self.config
        new: list[_Detection] = []
        for s in reversed(seen):
            age_ns = seen[-1].capture_ns - s.capture_ns
            if age_ns >= c.max_window_ns or (age_ns >= c.window_ns and len(new) >= c.min_in_window):
                break
            if s.viewpoint_id == seen[-1].viewpoint_id:
                new.append(s)
        return new[::-1]

    def _raise_alarm(
        self, kind: AlarmKind, anchor_id: str, size_m: float, now_ns: int, beside: tuple[str, ...], since_ns: int
    ) -> Alarm:
        """Return an alarm, and start over with the new pose of the anchor."""
        self._quiet_until_ns[anchor_id] = now_ns + self.config.quiet_ns
        self._references.pop(anchor_id, None)
        self._steady_ns.pop(anchor_id, None)
        self._detections[anchor_id].clear()
        return Alarm(kind, anchor_id, size_m, now_ns, beside, since_ns)

    def _find_unmoved_anchors(self, anchor_id: str, since_ns: int, size_m: float) -> tuple[str, ...]:
        """Return other anchors that did not move since this one was off by `size_m`."""
        stayed = []
        for other in sorted(self._detections):
            kept = self._references.get(other)
            later = [s.p for s in self._detections[other] if s.capture_ns >= since_ns]
            if other == anchor_id or kept is None or kept[2] is None or len(later) < _MIN_BESIDE:
                continue
            if float(np.linalg.norm(fast_median(np.array(later)) - kept[2].p)) < 0.5 * size_m:
                stayed.append(other)
        return tuple(stayed)

    def _find_steady_anchors(self, anchor_id: str, since_ns: int) -> tuple[str, ...]:
        """Return other anchors observed where the alignment predicts them."""
        return tuple(o for o, ns in sorted(self._steady_ns.items()) if o != anchor_id and ns >= since_ns)

    def _get_reference(self, anchor_id: str, now_ns: int, new: list[_Detection]) -> _Window | None:
        viewpoint_id = new[-1].viewpoint_id
        kept = self._references.get(anchor_id)
        if kept is not None and 0 < kept[0] - now_ns <= self.config.reference_every_ns and kept[1] == viewpoint_id:
            return kept[2]
        old = self._select_older(self._detections[anchor_id], new[0].capture_ns)
        reference = self._summarize_viewpoint(old, viewpoint_id)
        self._references[anchor_id] = (now_ns + self.config.reference_every_ns, viewpoint_id, reference)
        return reference

    def _select_older(self, seen: deque[_Detection], before_ns: int) -> list[_Detection]:
        """Return the detections before the present window, oldest first: `reference_ns` of them, or enough of one
        viewpoint, with no longer pause between."""
        c = self.config
        old: list[_Detection] = []
        counts: dict[int, int] = {}
        after_ns = before_ns
        for s in reversed(seen):
            if s.capture_ns >= before_ns:
                continue
            is_enough = before_ns - s.capture_ns > c.reference_ns and max(counts.values(), default=0) >= c.min_in_window
            if is_enough or after_ns - s.capture_ns > c.reference_ns:
                break
            after_ns = s.capture_ns
            counts[s.viewpoint_id] = counts.get(s.viewpoint_id, 0) + 1
            old.append(s)
        return old[::-1]

    def _summarize_viewpoint(self, seen: list[_Detection], viewpoint_id: int) -> _Window | None:
        """Summarize the detections of the given viewpoint, else of the one that has most; `None` if too few."""
        counts: dict[int, int] = {}
        for s in seen:
            counts[s.viewpoint_id] = counts.get(s.viewpoint_id, 0) + 1
        if counts.get(viewpoint_id, 0) < self.config.min_in_window:
            viewpoint_id = max(counts, key=lambda v: (counts[v], v), default=viewpoint_id)
        rows = [s for s in seen if s.viewpoint_id == viewpoint_id]
        if len(rows) < self.config.min_in_window:
            return None
        window = self._summarize(rows)
        return window if window.agreeing >= _MIN_AGREEING_BEFORE else None

    def _summarize(self, rows: list[_Detection]) -> _Window:
        every = np.array([s.p for s in rows])
        p = fast_median(every)
        middle = rows[len(rows) // 2]
        if any(s.p_head is None for s in rows):
            away = None
            common, each = self.noise.split_covariance(isotropic_covariance(self.config.unknown_viewpoint_sigma_m, 0.0))
        else:
            away = fast_median(np.array([s.p_head for s in rows]) - every)
            common, each = self.noise.compute_covariances(p + away, p)
        near_m = max(_AGREEING_M, 3.0 * math.sqrt(float(np.trace(each[:3, :3]))))
        looks = every[np.linalg.norm(every - p, axis=1) <= near_m]
        own = each * (_MEDIAN_VARIANCE / len(rows))
        agreeing = len(looks) / len(rows)
        shift = np.mean([s.shift or _AT_REST for s in rows], axis=0)
        return _Window(p, own, each, common, looks, middle.viewpoint_id, middle.capture_ns, away, shift, agreeing)

    def _measure_change(self, now: _Window, before: _Window | None, least_m: float = 0.0) -> float:
        """Return the distance [m] from the reference, 0 if not significant, or if the reference moved by much of it."""
        if before is None:
            return 0.0
        drift_m = self.config.drift_m_per_s * (now.capture_ns - before.capture_ns) * 1e-9
        C = now.own + before.own + self._independent_share(now, before) * (now.common + before.common)
        C = C + _late_covariance(now.shift - before.shift)
        C = C[:3, :3] + drift_m**2 * np.eye(3)
        size = _significant(now.p - before.p, C, least_m or self.config.min_change_m)
        return 0.0 if _is_moving(before.looks, before.each[:3, :3], _MAX_MOVING_BEFORE * size) else size

    def _independent_share(self, a: _Window, b: _Window) -> float:
        """Return the share of the common errors of two windows that does not cancel, by how far apart the head was. A
        client's word for it does not count."""
        if a.viewpoint_id != b.viewpoint_id or a.away is None or b.away is None:
            return 1.0
        apart = a.away - b.away
        return 1.0 - math.exp2(-float(apart @ apart) / self.config.same_place_m**2)

    def _is_settled(self, now: _Window, size_m: float) -> bool:
        """Return whether the newest looks, which are off by `size_m`, stay there: a source that smooths its poses
        smears a wrong detection over many of them, which then go back."""
        newest = now.looks[-self.config.min_in_window :]
        return not size_m or not _is_moving(newest, now.each[:3, :3], _MAX_MOVING * size_m)

    def _measure_difference(self, anchor_id: str, now: _Window, alignment: AlignmentEstimate | None) -> float:
        """Return the distance [m] from the pose that the alignment predicts, 0 if not significant."""
        if alignment is None or alignment.refused or alignment.tracking_epoch != self.tracking_epoch:
            return 0.0
        p_world = self.anchors[anchor_id][0]
        placed = apply(alignment.T_world_tracking, to_vec3(now.p))
        R = quat_to_matrix(np.array(alignment.T_world_tracking[1]))
        C = alignment.covariance_at(p_world)
        C = C + R @ (now.own + now.common + _late_covariance(now.shift))[:3, :3] @ R.T
        return _significant(np.array(placed) - p_world, C, self.config.min_difference_m)

    def _measure_turn(
        self, anchor_id: str, rows: list[_Detection], now: _Window, alignment: AlignmentEstimate | None
    ) -> float:
        """Return by how much the alignment is turned about the vertical [rad], 0 if not significant or unknown."""
        if alignment is None or alignment.refused or alignment.tracking_epoch != self.tracking_epoch:
            return 0.0
        if now.away is None:
            return 0.0
        q_predicted = quat_multiply(
            quat_conjugate(np.array(alignment.T_world_tracking[1])), np.array(self.anchors[anchor_id][1])
        )
        turns = quat_log(quat_multiply(np.array([s.q for s in rows]), quat_conjugate(q_predicted)))
        R = quat_to_matrix(np.array(alignment.T_world_tracking[1]))
        in_order = turns @ R[2]  # about the world's vertical
        yaws = np.sort(in_order)
        yaw = float(0.5 * (yaws[(len(yaws) - 1) // 2] + yaws[len(yaws) // 2]))
        C = (now.own + now.common + _late_covariance(now.shift))[3:, 3:]
        variance = alignment.covariance[35] + float(R[2] @ C @ R[2])
        near = 3.0 * math.sqrt(float(R[2] @ now.common[3:, 3:] @ R[2]))
        if int(np.count_nonzero(np.abs(yaws - yaw) <= near)) < _MIN_AGREEING * len(yaws):
            return 0.0
        sure = yaw * yaw > _CHI2_1_ONE_IN_A_MILLION * variance
        if not sure or abs(yaw) < self.config.min_turn_rad:
            return 0.0
        n, each = self.config.min_in_window, R[2:] @ now.each[3:, 3:] @ R[2:].T
        is_moving = _is_moving(now.looks[-n:], now.each[:3, :3], self.config.min_change_m)
        return 0.0 if is_moving or _is_moving(in_order[-n:, None], each, _MAX_MOVING * abs(yaw)) else abs(yaw)

    def _measure_jump(self, new: list[_Detection], reference: _Window | None) -> float:
        """Return the distance [m] of the last few detections from the reference, 0 unless they agree with each other:
        one alone may be wrong."""
        last = new[-self.config.jump_count :]
        if reference is None or len(last) < self.config.jump_count:
            return 0.0
        before = reference.p.tolist()
        if not min(math.dist(s.p, before) for s in last) > self.config.jump_m:
            return 0.0
        away = np.array([s.p for s in last]) - reference.p
        together = float(np.max(np.linalg.norm(away - away.mean(axis=0), axis=1)))
        if together > max(0.5 * self.config.jump_m, 0.1 * float(np.linalg.norm(away[0]))):
            return 0.0
        now = self._summarize(last)
        size = self._measure_change(now, reference, self.config.jump_m)
        return size if self._is_settled(now, size) else 0.0

    def _update_epoch(self, capture_ns: int, tracking_epoch: int) -> Alarm | None:
        if tracking_epoch <= self.tracking_epoch:
            return None
        self.tracking_epoch = tracking_epoch
        self._reset()
        return Alarm("epoch", "", math.inf, capture_ns)

    def _reset(self) -> None:
        self._detections.clear()
        self._references.clear()
        self._quiet_until_ns.clear()
        self._steady_ns.clear()
        self._head = None


def _is_moving(x: Array, each: Array, least: float) -> bool:
    """Return whether values (n, m), oldest first, move by more than `least` and than their noise, `each` (m, m)."""
    if len(x) < 2:
        return True
    k = len(x) // 2
    by = fast_median(x[-k:]) - fast_median(x[:k])
    far2 = float(by @ by)
    noise2 = float(by @ each @ by) / max(far2, 1e-18) * (2.0 / k)  # along it
    return far2 > max(least**2, _MOVING_SIGMAS**2 * noise2)


def _late_covariance(shift: Array) -> Array:
    """Return the covariance (6, 6) by lateness, with its largest value as sigma: one in a million is far out."""
    return MAX_LATE_S**2 * shift[:, None] * shift


def _significant(d: Array, C: Array, least_m: float) -> float:
    """Return the length of `d` [m] if it is at least `least_m` and chance exceeds it once in a million; else 0."""
    size = float(np.linalg.norm(d))
    return size if size >= least_m and float(d @ np.linalg.solve(C, d)) > _CHI2_3_ONE_IN_A_MILLION else 0.0
