"""The watch over the alignment of one connection: head poses and observations in, alarms out. `anchors.drift` decides.

What observations may contradict is what is in force. Three cases are not worth an alarm: a correction that waits (then
the newest estimate is judged), what an alarm has told already (then nothing is, until there is a new estimate), and a
sheet that is known to have been moved (it may be moved again, but what it says of the headset is nothing).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from anchors.alignment import AlignmentEstimate
from anchors.drift import Alarm, DriftMonitor
from anchors.pose import PoseTuple, Vec3, apply, distance, inverse, is_rigid
from iris_session.alignment.estimation import UNSOLVABLE
from iris_session.alignment.head_history import HeadRing
from iris_session.protocol.client_messages import Observation
from iris_session.protocol.entries import AlignmentAlarm
from iris_session.protocol.limits import TokenBucket
from iris_session.protocol.names import AlarmKind

#: A jump that follows another before anything was proposed says nothing new.
JUMP_AGAIN_NS: Final = 1_000_000_000
#: Other alarms per second, and at once: an honest headset has one in two seconds of each anchor.
_ALARMS: Final = (2.0, 8)
#: Further from what is in force, the newest estimate is a correction that waits (`DriftConfig.min_difference_m`).
_WAITING_M: Final = 0.010
_MAX_BESIDE: Final = 32  # names in one message


class AlignmentWatch:
    """`in_force`: what the authority says holds, if anything. `anchors`: present `T_world_anchor`."""

    def __init__(self, anchors: Mapping[str, PoseTuple]) -> None:
        self._anchors = anchors
        self._bucket = TokenBucket(*_ALARMS)
        self._jump_ns: int | None = None  # when a jump was told that no alignment has followed
        self.heads = HeadRing()
        self.in_force: AlignmentEstimate | None = None
        self._measured = False
        self.begin()

    def begin(self) -> None:
        """A run begins: nothing that was seen before counts."""
        self._monitor = DriftMonitor(self._anchors)
        self._moved: set[str] = set()  # anchors that were seen to be moved beside others
        self.known_wrong()

    def known_wrong(self) -> None:
        """What is in force is wrong, and that was told; until the next estimate there is nothing to contradict."""
        self._newest: AlignmentEstimate | None = None
        self._mute = True

    def anchor_moved(self, anchor_id: str) -> None:
        """It is known again where an anchor is; what is in force does not know yet."""
        self._moved.discard(anchor_id)
        self.known_wrong()

    def estimated(self, estimate: AlignmentEstimate) -> None:
        """Something was proposed."""
        self._newest, self._mute, self._jump_ns = estimate, False, None

    def put_in_force(self, alignment: AlignmentEstimate | None, measured: bool, running: bool) -> None:
        """`measured`: as it stands, so that anchors can contradict it. Of a participant who measures no more
        (`running`), it is all there is to judge."""
        self.in_force, self._measured = alignment, measured
        if alignment is not None:
            self._jump_ns = None
        if not running:
            self._newest, self._mute = None, False

    def head(self, T_tracking_head: PoseTuple, capture_ns: int, tracking_epoch: int) -> Alarm | None:
        """A head pose, many times a second and unchecked."""
        self.heads.put(capture_ns, tracking_epoch, T_tracking_head)
        return _of_interest(self._monitor.head(T_tracking_head, capture_ns, tracking_epoch))

    def observe(self, observation: Observation, p_tracking_head: Vec3 | None) -> Alarm | None:
        """Whether this observation shows that the alignment is wrong."""
        pose = observation.T_tracking_anchor
        if not is_rigid((pose.p, pose.q)):
            return None
        try:
            alarm = self._monitor.observe(
                observation.anchor_id,
                pose.p,
                p_tracking_head,
                observation.capture_ns,
                observation.tracking_epoch,
                observation.viewpoint_id,
                None if observation.anchor_id in self._moved else self._judged(),
            )
        except UNSOLVABLE:
            return None
        if alarm is not None and alarm.beside:
            self._moved.add(alarm.anchor_id)
        return _of_interest(alarm)

    def _judged(self) -> AlignmentEstimate | None:
        newest, in_force = self._newest, self.in_force if self._measured else None
        if newest is None:
            return None if self._mute else in_force
        if in_force is None:
            return newest
        p_tracking = apply(inverse(newest.T_world_tracking), newest.pivot_world)
        away = distance(apply(in_force.T_world_tracking, p_tracking), newest.pivot_world)
        return in_force if away <= _WAITING_M else newest

    def told(self, alarm: Alarm, now_ns: int) -> AlignmentAlarm | None:
        """The alarm as the authority is told. `None`: it says nothing new, or there are too many."""
        if alarm.kind == AlarmKind.JUMP:
            if self._jump_ns is not None and now_ns - self._jump_ns < JUMP_AGAIN_NS:
                return None
            self._jump_ns = now_ns
        elif not self._bucket.take(now_ns):
            return None
        epoch, beside = self._monitor.tracking_epoch, alarm.beside[:_MAX_BESIDE]
        return AlignmentAlarm(alarm.kind, epoch, alarm.anchor_id, alarm.size_m, alarm.capture_ns, beside)


def _of_interest(alarm: Alarm | None) -> Alarm | None:
    """A new tracking epoch needs no alarm: the client's own message says so."""
    return alarm if alarm is not None and alarm.kind in AlarmKind.ALL else None
