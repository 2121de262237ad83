"""Detect jumps and drift of the alignment of one connection: head poses and observations in, alarms out.

Observations are checked against the alignment in force (`anchors.drift` does the statistics). Three cases raise no
alarm: a correction is pending (then the newest estimate is checked), an alarm was raised already (then nothing is
checked until the next estimate), or the sheet is known to have been moved (it may be moved again, but it is no evidence
against the headset).
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from itertools import pairwise
from typing import Final, NamedTuple

import numpy as np

from anchors.alignment import AlignmentEstimate
from anchors.drift import Alarm, DriftMonitor
from anchors.lie import to_vec3
from anchors.looks import MOVING, REPEATED, ZERO, HeadMotion, Look, LookFilter, is_zero_pose
from anchors.pose import (
    PoseTuple,
    Vec3,
    apply,
    distance,
    inverse,
    is_rigid,
    quat_conj,
    quat_mul,
    quat_to_rotvec,
)
from iris_session.alignment.estimator import NUMERICAL_ERRORS
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.entries import AlignmentAlarm
from iris_session.protocol.limits import TokenBucket
from iris_session.protocol.names import AlarmKind, AnchorKind, Device

#: A jump that follows another before anything was proposed carries no news.
MIN_JUMP_INTERVAL_NS: Final = 1_000_000_000
#: Other alarms per second, and in a burst: an honest headset has one in two seconds per anchor.
_ALARM_RATE: Final = (2.0, 8)
#: Further from the alignment in force, the newest estimate is a pending correction (`DriftConfig.min_difference_m`).
_PENDING_CORRECTION_M: Final = 0.010
_MAX_BESIDE: Final = 32  # names in one message
#: Head poses kept: 1.4 s at 90 Hz, far longer than the detection of a sheet and its transport take.
MAX_HEAD_POSES: Final = 128
#: A head pose further away in time is of no use: at 0.5 m/s a head moves 25 mm meanwhile.
MAX_HEAD_OFFSET_NS: Final = 50_000_000
#: Velocity is measured over so long before and after an observation: with 0.5 mm of noise per pose, to 10 mm/s; of a
#: client with few head samples over longer.
_MOTION_SPAN_NS: Final = 100_000_000
_SPARSE_SPAN_NS: Final = 220_000_000
_MIN_STEPS: Final = 3
_MIN_MOTION_S: Final = 0.01


class _HeadPose(NamedTuple):
    capture_ns: int
    tracking_epoch: int
    T_tracking_head: PoseTuple


class HeadHistory:
    """The newest head poses of one connection, in order of arrival. Poses are validated when they are looked up."""

    __slots__ = ("_heads",)

    def __init__(self) -> None:
        self._heads: deque[_HeadPose] = deque(maxlen=MAX_HEAD_POSES)

    def __len__(self) -> int:
        return len(self._heads)

    def append(self, capture_ns: int, tracking_epoch: int, T_tracking_head: PoseTuple) -> None:
        self._heads.append(_HeadPose(capture_ns, tracking_epoch, T_tracking_head))

    def find_nearest(self, capture_ns: int, tracking_epoch: int) -> PoseTuple | None:
        """Return the `T_tracking_head` nearest in time of the same tracking frame.

        `None` if none lies within `MAX_HEAD_OFFSET_NS`, or if it is not a rigid transform. An observation may arrive
        before the samples around it; only those already received are searched.
        """
        best: _HeadPose | None = None
        best_ns = MAX_HEAD_OFFSET_NS + 1
        for head in reversed(self._heads):
            offset_ns = abs(head.capture_ns - capture_ns)
            if offset_ns < best_ns and head.tracking_epoch == tracking_epoch:
                best, best_ns = head, offset_ns
            elif head.capture_ns < capture_ns - MAX_HEAD_OFFSET_NS:
                break
        if best is None or not is_rigid(best.T_tracking_head):
            return None
        return best.T_tracking_head

    def find_motion(self, capture_ns: int, tracking_epoch: int) -> HeadMotion | None:
        """Return pose and velocity of the head, `None` without a pose (`find_nearest`) or a second one near it.

        The largest step between two samples is left out: a jump of the tracking frame is no motion of the head.
        """
        T = self.find_nearest(capture_ns, tracking_epoch)
        if T is None:
            return None
        steps = self._list_steps(capture_ns, tracking_epoch, _MOTION_SPAN_NS)
        if len(steps) < _MIN_STEPS:
            steps = self._list_steps(capture_ns, tracking_epoch, _SPARSE_SPAN_NS)
        if len(steps) > 1:
            steps.remove(max(steps, key=_Step.measure_size))
        seconds = sum(step.seconds for step in steps)
        if seconds < _MIN_MOTION_S:
            return None
        moved = np.sum([(*step.moved, *step.turned) for step in steps], axis=0) / seconds
        return HeadMotion(T, to_vec3(moved[:3]), to_vec3(moved[3:]))

    def _list_steps(self, capture_ns: int, tracking_epoch: int, span_ns: int) -> list[_Step]:
        around = [
            head
            for head in self._heads
            if abs(head.capture_ns - capture_ns) <= span_ns
            and head.tracking_epoch == tracking_epoch
            and is_rigid(head.T_tracking_head)
        ]
        return [_Step.between(a, b) for a, b in pairwise(around) if b.capture_ns > a.capture_ns]


class _Step(NamedTuple):
    """Motion of a head between two samples."""

    seconds: float
    moved: Vec3
    turned: Vec3

    @classmethod
    def between(cls, a: _HeadPose, b: _HeadPose) -> _Step:
        (p0, q0), (p1, q1) = a.T_tracking_head, b.T_tracking_head
        moved = (p1[0] - p0[0], p1[1] - p0[1], p1[2] - p0[2])
        return cls((b.capture_ns - a.capture_ns) * 1e-9, moved, quat_to_rotvec(quat_mul(q1, quat_conj(q0))))

    def measure_size(self) -> float:
        return (math.hypot(*self.moved) + math.hypot(*self.turned)) / self.seconds


class AlignmentMonitor:
    """Monitor of one connection. `in_force`: the alignment that the authority has put in force, if any."""

    def __init__(self, anchors: Mapping[str, PoseTuple]) -> None:
        """Create a monitor; `anchors`: present `T_world_anchor`, updated by the owner."""
        self._anchors = anchors
        self._bucket = TokenBucket(*_ALARM_RATE)
        self._jump_ns: int | None = None  # time of a reported jump that no alignment has followed
        self.heads = HeadHistory()
        self._filter = LookFilter()
        self._filter_epoch = 0
        self.in_force: AlignmentEstimate | None = None
        self._measured = False
        self.start_run()

    def start_run(self) -> None:
        """Begin a new alignment run: earlier observations no longer count."""
        self._monitor = DriftMonitor(self._anchors)
        self._moved: set[str] = set()  # anchors that moved relative to others in view
        self.mute()

    def mute(self) -> None:
        """Raise no further alarm until the next estimate: the alignment in force is known to be wrong."""
        self._newest: AlignmentEstimate | None = None
        self._muted = True

    def on_anchor_moved(self, anchor_id: str) -> None:
        """Accept a new pose of an anchor, which the alignment in force does not reflect yet."""
        self._moved.discard(anchor_id)
        self.mute()

    def accept_moved(self, anchor_id: str) -> None:
        """Check an anchor no longer against the alignment: others outvote it."""
        self._moved.add(anchor_id)

    def set_estimate(self, estimate: AlignmentEstimate) -> None:
        """Set the newest proposed estimate."""
        self._newest, self._muted, self._jump_ns = estimate, False, None

    def set_alignment(self, alignment: AlignmentEstimate | None, measured: bool, running: bool) -> None:
        """Set the alignment in force.

        `measured`: it is used as estimated, so anchors can contradict it. `running`: estimation goes on; otherwise the
        alignment in force is all there is to check.
        """
        self.in_force, self._measured = alignment, measured
        if alignment is not None:
            self._jump_ns = None
        if not running:
            self._newest, self._muted = None, False

    def add_head_pose(self, T_tracking_head: PoseTuple, capture_ns: int, tracking_epoch: int) -> Alarm | None:
        """Record an unvalidated head pose (up to 90 per second) and return an alarm if it shows a jump."""
        self.heads.append(capture_ns, tracking_epoch, T_tracking_head)
        return _drop_epoch_alarm(self._monitor.add_head_pose(T_tracking_head, capture_ns, tracking_epoch))

    def judge_look(self, observation: Observation) -> Look | str:
        """Return how an observation counts as a look, or why it is none (`anchors.looks`)."""
        pose = (observation.T_tracking_anchor.p, observation.T_tracking_anchor.q)
        if is_zero_pose(pose):
            return ZERO
        if observation.kind in AnchorKind.NOT_SEEN:
            return Look(observation.viewpoint_id)
        if not self._filter.is_new((observation.anchor_id, observation.kind, observation.device), pose):
            return REPEATED
        if observation.tracking_epoch > self._filter_epoch:
            self._filter_epoch = observation.tracking_epoch
            self._filter.forget_viewpoints()
        T_tracking_head = self.heads.find_nearest(observation.capture_ns, observation.tracking_epoch)
        p_tracking_head = None if T_tracking_head is None else T_tracking_head[0]
        viewpoint_id = self._filter.number_viewpoint(p_tracking_head, observation.viewpoint_id)
        if observation.device != Device.HEAD:
            return Look(viewpoint_id)
        motion = self.heads.find_motion(observation.capture_ns, observation.tracking_epoch)
        if motion is None or not is_rigid(pose):
            return Look(viewpoint_id, p_tracking_head)
        if motion.is_fast:
            return MOVING
        return Look(viewpoint_id, p_tracking_head, motion.compute_shift(pose[0]))

    def check_observation(self, observation: Observation, look: Look) -> Alarm | None:
        """Return an alarm if this observation shows that the alignment is wrong."""
        pose = observation.T_tracking_anchor
        if not is_rigid((pose.p, pose.q)):
            return None
        try:
            alarm = self._monitor.add_observation(
                observation.anchor_id,
                (pose.p, pose.q),
                look,
                observation.capture_ns,
                observation.tracking_epoch,
                None if observation.anchor_id in self._moved else self._select_reference(),
            )
        except NUMERICAL_ERRORS:
            return None
        if alarm is not None and alarm.beside:
            self._moved.add(alarm.anchor_id)
        return _drop_epoch_alarm(alarm)

    def _select_reference(self) -> AlignmentEstimate | None:
        """Return the estimate that observations are checked against, `None` while muted."""
        newest, in_force = self._newest, self.in_force if self._measured else None
        if newest is None:
            return None if self._muted else in_force
        if in_force is None:
            return newest
        p_tracking = apply(inverse(newest.T_world_tracking), newest.pivot_world)
        difference_m = distance(apply(in_force.T_world_tracking, p_tracking), newest.pivot_world)
        return in_force if difference_m <= _PENDING_CORRECTION_M else newest

    def is_too_frequent(self, alarm: Alarm, now_ns: int) -> bool:
        """Return whether an alarm would repeat a jump or exceed the alarm rate; else it counts."""
        if alarm.kind != AlarmKind.JUMP:
            return not self._bucket.take(now_ns)
        is_repeat = self._jump_ns is not None and now_ns - self._jump_ns < MIN_JUMP_INTERVAL_NS
        if not is_repeat:
            self._jump_ns = now_ns
        return is_repeat

    def to_message(self, alarm: Alarm) -> AlignmentAlarm:
        """Return the message to the authority."""
        epoch, beside = self._monitor.tracking_epoch, alarm.beside[:_MAX_BESIDE]
        return AlignmentAlarm(alarm.kind, epoch, alarm.anchor_id, alarm.size_m, alarm.capture_ns, beside)


def _drop_epoch_alarm(alarm: Alarm | None) -> Alarm | None:
    """Return the alarm unless it announces a new tracking epoch, which the client's own message does."""
    return alarm if alarm is not None and alarm.kind in AlarmKind.ALL else None
