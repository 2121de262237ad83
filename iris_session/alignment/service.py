"""Live alignment of all headsets of a session: observations and head poses in, entries for the authority out.

The service keeps an estimator and a monitor per connection, the present poses of the anchors, and the cross-check of
headsets. It decides nothing: proposals and alarms go to the authority as entries, and the decisions come back as events
(`process_event`).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import Executor, Future, wait
from functools import partial
from types import MappingProxyType
from typing import Any, Final, Protocol

import msgspec

from anchors.alignment import AlignmentEstimate
from anchors.drift import Alarm
from anchors.looks import Look
from anchors.places import TWO_PRINTS, PrintWatch
from anchors.pose import PoseTuple, Vec3, apply, is_rigid, is_valid_point
from iris_session.alignment.cross_check import CrossCheckScheduler, Job
from iris_session.alignment.estimator import MAX_LATE_NS, NUMERICAL_ERRORS, ConnectionEstimator
from iris_session.alignment.monitor import AlignmentMonitor
from iris_session.alignment.touches import MAX_TIPS, solve_tip
from iris_session.protocol.client_messages import Observation, Sample
from iris_session.protocol.common import Alignment, Pose
from iris_session.protocol.entries import AlignmentProposal, Entry, TipSolved
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import AlarmKind, AlignmentKind, AnchorKind, SampleKind
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentChanged,
    AlignmentRun,
    AnchorInfo,
    AnchorMoved,
    EventKind,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
    TipCalibrated,
)
from iris_session.protocol.status import AlignmentReport

_HEAD: Final = "head"
_COVARIANCE_VALUES: Final = 36
_NO_ANCHORS: Final[Mapping[str, Pose]] = MappingProxyType({})
_NO_SIZES: Final[Mapping[str, float]] = MappingProxyType({})
_NO_MARKS: Final[Mapping[str, Mapping[str, Vec3]]] = MappingProxyType({})
#: Disconnected participants whose alignment is remembered, per possible connection.
_REMEMBERED_PER_CONNECTION: Final = 4
#: Observations that wait while the estimate of their connection is computed: a second of them at the rate limit.
_MAX_WAITING: Final = 64
#: Least time between two calibrations of tips of one connection, each of which takes milliseconds.
TIP_PERIOD_NS: Final = 500_000_000
#: Devices of one connection whose tips wait for their calibration.
MAX_WAITING_TIPS: Final = 4
UNALIGNED_POINT: Final = "points touched without an alignment that states its error"
#: Time for a job that runs when the service is closed [s].
CLOSE_S: Final = 1.0


class Worker:
    """Runs one job at a time: at once, or in a thread beside the loop, which meanwhile sends the state."""

    def __init__(self, executor: Executor | None = None) -> None:
        """Create a worker; `executor`: has the thread."""
        self._executor = executor
        self._running: Future[Callable[[], None]] | None = None

    @property
    def is_busy(self) -> bool:
        """True from `submit` until `poll` has done what the job returned."""
        return self._running is not None

    def submit(self, job: Job) -> None:
        """Begin a job; without a thread, do also what it returns. The worker must not be busy."""
        assert not self.is_busy, "one job at a time"
        if self._executor is None:
            job()()
        else:
            self._running = self._executor.submit(job)

    def poll(self) -> None:
        """Do what a finished job returned. Raises the exception of a job that failed."""
        if self._running is not None and self._running.done():
            finished, self._running = self._running, None
            finished.result()()

    def close(self) -> None:
        """End the thread, whose job has a second to end; its result is discarded."""
        if self._executor is not None:
            wait([self._running] if self._running is not None else [], CLOSE_S)
            self._executor.shutdown(wait=False, cancel_futures=True)


class HeadsetConnection(Protocol):
    """Interface of a connection that the service uses."""

    @property
    def number(self) -> int: ...

    @property
    def participant_id(self) -> str:
        """Empty until the authority has admitted the participant."""
        ...


class _HeadsetState:
    """State of one connection.

    `alarm_ns`, `proposal_ns`: session times of the last alarm and proposal; entries are stamped so that these times
    show their order. `last_jump`: tracking epoch and capture time of the last jump. An observation captured before it
    is in the old tracking frame, though it may arrive later (sheets are detected in pictures that are tenths of a
    second old). While an estimate is computed (`busy`), the estimator belongs to the worker: `waiting` holds what is to
    be done with it afterwards, and `is_outdated` is set when the result will not count. `tips`: the newest observation
    of kind `tip` of each device, calibrated from `next_tip_ns` on. `prints`: the anchors of which there are two prints.
    """

    __slots__ = (
        "alarm_ns",
        "busy",
        "connection",
        "estimator",
        "is_outdated",
        "last_jump",
        "monitor",
        "next_tip_ns",
        "prints",
        "proposal_ns",
        "tips",
        "waiting",
        "watch",
    )

    def __init__(
        self, connection: HeadsetConnection, estimator: ConnectionEstimator, monitor: AlignmentMonitor
    ) -> None:
        self.connection = connection
        self.estimator = estimator
        self.monitor = monitor
        self.alarm_ns = self.proposal_ns = -1
        self.last_jump: tuple[int, int] | None = None
        self.busy = self.is_outdated = False
        self.waiting: deque[Callable[[], object]] = deque()
        self.tips: dict[str, Observation] = {}
        self.next_tip_ns = 0
        self.watch = PrintWatch()
        self.prints: set[str] = set()

    def run_or_defer(self, change: Callable[[], object]) -> None:
        """Run a change of the estimator now, or after the estimate that is being computed, which is then discarded."""
        if self.busy:
            self.is_outdated = True
            self.waiting.append(change)
        else:
            change()

    def is_before_jump(self, observation: Observation) -> bool:
        """Return whether the observation was captured in the tracking frame before the last jump."""
        if self.last_jump is None or observation.tracking_epoch != self.last_jump[0]:
            return False
        return observation.capture_ns < self.last_jump[1]


class AlignmentService:
    """Estimate, monitor and cross-check the alignment of every headset of a session."""

    def __init__(
        self,
        offer: Callable[[Entry], bool],
        drops: Drops,
        *,
        anchors: Mapping[str, Pose] = _NO_ANCHORS,
        anchor_sizes: Mapping[str, float] = _NO_SIZES,
        anchor_marks: Mapping[str, Mapping[str, Vec3]] = _NO_MARKS,
        proposal_period_ns: int = 200_000_000,
        max_connections: int = 64,
        worker: Worker | None = None,
    ) -> None:
        """Create the service of one session.

        Args:
            offer: Takes an entry for the authority; returns false if it was dropped (and counted).
            drops: Counters of what is not used, by reason.
            anchors: `T_world_anchor` at the start of the session.
            anchor_sizes: Edge length [m] of printed sheets, where known.
            anchor_marks: Positions of marks by anchor and id of the mark, in the anchor frame [m].
            proposal_period_ns: Least time between two proposals of one connection.
            max_connections: Most connections of the session; bounds the memory for disconnected participants.
            worker: Computes estimates; by default at once.
        """
        self._offer = offer
        self._drops = drops
        self._worker = worker or Worker()
        self._sizes = anchor_sizes
        self._marks = anchor_marks
        self._proposal_period_ns = proposal_period_ns
        self._max_remembered = _REMEMBERED_PER_CONNECTION * max_connections
        #: `T_world_anchor`, as it is now.
        self.anchors: dict[str, PoseTuple] = {name: (pose.p, pose.q) for name, pose in anchors.items()}
        self._states: dict[int, _HeadsetState] = {}  # by connection; the least recently estimated first
        self._cross_check = CrossCheckScheduler(self.anchors.keys())
        self._in_force: dict[str, Alignment] = {}  # by participant, also of those who may reconnect
        self._stopped: dict[str, None] = {}  # participants whose run was stopped
        self._tips: dict[str, dict[str, tuple[float, ...]]] = {}  # covariance by participant and device
        self._has_snapshot = False

    def __len__(self) -> int:
        return len(self._states)

    # --- messages of clients -----------------------------------------------------------------------------------------

    def process_sample(self, connection: HeadsetConnection, sample: Sample, now_ns: int) -> None:
        """Record a head pose and check it for a jump; samples of other devices are ignored."""
        if sample.device != _HEAD or sample.pose is None or sample.kind != SampleKind.POSE or not sample.tracked:
            return
        state = self._states.get(connection.number) or self._add_connection(connection)
        pose = sample.pose
        alarm = state.monitor.add_head_pose((pose.p, pose.q), sample.capture_ns, sample.tracking_epoch)
        if alarm is not None:
            self._process_alarm(connection.number, state, alarm, sample.tracking_epoch, now_ns)

    def process_observation(self, connection: HeadsetConnection, observation: Observation, now_ns: int) -> None:
        """Check an observation against the present alignment, then add it to the estimate and the cross-check."""
        state = self._states.get(connection.number) or self._add_connection(connection)
        if observation.kind == AnchorKind.TIP:
            self._keep_tip(connection.number, state, observation)
        elif not state.busy:
            self._add_observation(connection.number, state, observation, now_ns)
        elif len(state.waiting) < _MAX_WAITING:
            state.waiting.append(partial(self._add_observation, connection.number, state, observation, now_ns))
        else:
            self._drops.count("observation_waiting", connection.number)

    def _keep_tip(self, number: int, state: _HeadsetState, observation: Observation) -> None:
        """Keep the newest poses of the tip of each device until they are calibrated."""
        if state.tips.pop(observation.device, None) is not None:
            self._drops.count("tip_superseded", number)
        state.tips[observation.device] = observation
        if len(state.tips) > MAX_WAITING_TIPS:
            del state.tips[next(iter(state.tips))]
            self._drops.count("tip_waiting", number)

    def _add_observation(self, number: int, state: _HeadsetState, observation: Observation, now_ns: int) -> None:
        if state.is_before_jump(observation):
            self._drops.count("observation_before_jump", number)
            return
        if abs(now_ns - observation.capture_ns) > MAX_LATE_NS:
            state.estimator.refuse_late(observation)
            self._drops.count("observation_unusable", number)
            return
        known = observation.anchor_id in self.anchors
        seen, tracked = observation.kind not in AnchorKind.NOT_SEEN, observation.kind == AnchorKind.CONTROLLER
        look = state.monitor.judge_look(observation)
        if isinstance(look, str):
            state.estimator.count_fault(look, observation.tracking_epoch, known)
            self._drops.count("observation_unusable", number)
            return
        if observation.kind == AnchorKind.POINT:
            if not self._add_point(number, state, observation, now_ns):
                self._drops.count("observation_unusable", number)
            return
        if known and seen and not tracked and self._has_two_prints(number, state, observation, now_ns):
            state.estimator.count_fault(TWO_PRINTS, observation.tracking_epoch, known)
            self._drops.count("observation_unusable", number)
            return
        if known and seen:
            alarm = state.monitor.check_observation(observation, look)
            if alarm is not None:
                self._process_alarm(number, state, alarm, observation.tracking_epoch, now_ns)
        used = True
        if known or not tracked:
            used = state.estimator.add_observation(observation, look, now_ns)
        if (known and seen and used) or (tracked and not known):
            kept = self._add_to_cross_check(number, observation, look, now_ns)
            used = kept if not known else used
        if not used:
            self._drops.count("observation_unusable", number)

    def _has_two_prints(self, number: int, state: _HeadsetState, observation: Observation, now_ns: int) -> bool:
        """Return whether this headset sees an anchor in two places, to and fro; report it when it begins."""
        name, epoch, pose = observation.anchor_id, observation.tracking_epoch, observation.T_tracking_anchor
        apart_m = state.watch.add_look(name, pose.p, observation.capture_ns, epoch) if is_valid_point(pose.p) else 0.0
        if not apart_m:
            state.prints.discard(name)
        elif name not in state.prints:
            state.prints.add(name)
            state.estimator.refuse_prints(name, epoch)
            self._process_alarm(number, state, Alarm(AlarmKind.TWO_PLACES, name, apart_m, now_ns), epoch, now_ns)
        return apart_m > 0.0

    def _add_to_cross_check(self, number: int, observation: Observation, look: Look, now_ns: int) -> bool:
        pose = observation.T_tracking_anchor
        return self._cross_check.add_observation(
            number,
            observation.anchor_id,
            (pose.p, pose.q),
            look.p_tracking_head,
            observation.capture_ns,
            observation.tracking_epoch,
            look.viewpoint_id,
            now_ns,
        )

    def _add_point(self, number: int, state: _HeadsetState, observation: Observation, now_ns: int) -> bool:
        sigma_m, p = state.estimator.find_touch_sigma(observation), observation.T_tracking_anchor.p
        name, epoch = observation.anchor_id, observation.tracking_epoch
        if state.monitor.in_force is None:
            state.estimator.count_fault(UNALIGNED_POINT, epoch, False)
            return False
        return sigma_m is not None and self._cross_check.add_point(number, name, p, sigma_m, now_ns, epoch)

    def _add_connection(self, connection: HeadsetConnection) -> _HeadsetState:
        estimator = ConnectionEstimator(self.anchors, self._proposal_period_ns, self._sizes, self._marks)
        for device, covariance in self._tips.get(connection.participant_id, {}).items():
            estimator.set_tip(device, covariance)
        state = _HeadsetState(connection, estimator, AlignmentMonitor(self.anchors))
        self._states[connection.number] = state
        estimator.running = connection.participant_id not in self._stopped
        self._apply_alignment(state, self._in_force.get(connection.participant_id))
        return state

    def _process_alarm(self, number: int, state: _HeadsetState, alarm: Alarm, tracking_epoch: int, now_ns: int) -> None:
        """Report an alarm. The estimator is asked first: a sheet that others outvote is no evidence against the
        headset."""
        in_force, is_dropped = state.monitor.in_force, state.monitor.is_too_frequent(alarm, now_ns)
        if is_dropped:
            self._drops.count("alarms_repeated", number)
            if alarm.kind in (AlarmKind.CHANGED, AlarmKind.DIFFERS) and not alarm.beside:
                return  # the next looks raise it again
        if alarm.anchor_id and not alarm.beside and alarm.kind != AlarmKind.TWO_PLACES:
            outvoting = state.estimator.weigh_alarm(alarm)
            if outvoting is None:
                return
            if outvoting:
                alarm = alarm._replace(kind=AlarmKind.CHANGED, beside=outvoting)
                state.monitor.accept_moved(alarm.anchor_id)
        elif alarm.beside:
            state.estimator.leave_out(alarm)
        if alarm.kind == AlarmKind.JUMP:
            state.last_jump = (tracking_epoch, min(alarm.capture_ns, now_ns))
        message = state.monitor.to_message(alarm)
        if in_force is not None and alarm.p is not None and not alarm.beside:
            x, y, z = apply(in_force.T_world_tracking, alarm.p)
            x0, y0, z0 = self.anchors[alarm.anchor_id][0]
            is_known = in_force.tracking_epoch == tracking_epoch
            message = msgspec.structs.replace(message, shift_m=(x - x0, y - y0, z - z0) if is_known else ())
        if not is_dropped:
            state.alarm_ns = max(now_ns, state.proposal_ns)  # no proposal made before is later
            self._offer(Entry(number, number, state.alarm_ns, message))
        if alarm.beside:
            self._cross_check.discard_target(alarm.anchor_id)
            return
        if not alarm.anchor_id:  # the head jumped: nothing of the old tracking frame counts
            state.run_or_defer(state.estimator.reset)
            state.watch.forget()
        state.monitor.mute()
        self._cross_check.discard_observations(number)

    def remove_connection(self, number: int) -> None:
        """Forget the state of a connection that has ended."""
        self._states.pop(number, None)
        self._cross_check.remove_connection(number)

    # --- decisions of the authority ----------------------------------------------------------------------------------

    def process_event(self, event: EventKind) -> None:
        """Apply an event of the authority, as clients receive it."""
        if isinstance(event, AlignmentChanged):
            self._set_alignment(event.participant, event.alignment)
        elif isinstance(event, AlignmentAlarmed):
            if event.kind == AlarmKind.JUMP:
                self._set_alignment(event.participant, None)
        elif isinstance(event, ParticipantJoined | ParticipantChanged):
            if event.participant.alignment is None:
                self._set_alignment(event.participant.id, None)
        elif isinstance(event, AlignmentRun):
            self._process_run(event)
        elif isinstance(event, TipCalibrated):
            if not event.refused:
                self._set_tip(event.participant, event.device, event.covariance)
        elif isinstance(event, AnchorMoved):
            self._move_anchor(event.anchor_id, event.T_world_anchor)
        elif isinstance(event, ParticipantLeft) and not event.grace:
            self._in_force.pop(event.participant, None)
            self._stopped.pop(event.participant, None)
            self._tips.pop(event.participant, None)

    def process_snapshot(self, participants: Iterable[ParticipantInfo], anchors: Iterable[AnchorInfo]) -> None:
        """Apply participants of a snapshot, and anchors of the first: a restarted front has received no events."""
        for anchor in () if self._has_snapshot else anchors:
            if self.anchors.get(anchor.id) != (anchor.T_world_anchor.p, anchor.T_world_anchor.q):
                self._move_anchor(anchor.id, anchor.T_world_anchor)  # while the front was being replaced
        self._has_snapshot = True
        for participant in participants:
            if participant.alignment is not None and participant.id not in self._in_force:
                self._set_alignment(participant.id, participant.alignment)

    def _set_alignment(self, participant: str, alignment: Alignment | None) -> None:
        self._in_force.pop(participant, None)
        if alignment is not None:
            self._in_force[participant] = alignment
            _limit_size(self._in_force, self._max_remembered)
        for state in self._find_states(participant):
            self._apply_alignment(state, alignment)

    def _set_tip(self, participant: str, device: str, covariance: tuple[float, ...]) -> None:
        tips = self._tips.pop(participant, {})
        tips.pop(device, None)
        tips[device] = covariance
        if len(tips) > MAX_TIPS:
            del tips[next(iter(tips))]
        self._tips[participant] = tips
        _limit_size(self._tips, self._max_remembered)
        for state in self._find_states(participant):
            state.run_or_defer(partial(state.estimator.set_tip, device, covariance))

    def _apply_alignment(self, state: _HeadsetState, alignment: Alignment | None) -> None:
        measured = alignment is not None and alignment.kind == AlignmentKind.MEASURED and not alignment.offset
        state.monitor.set_alignment(_to_estimate(alignment), measured, state.estimator.running)

    def _process_run(self, run: AlignmentRun) -> None:
        self._stopped.pop(run.participant, None)
        if not run.running:
            self._stopped[run.participant] = None
            _limit_size(self._stopped, self._max_remembered)
        for state in self._find_states(run.participant):
            if run.running:
                state.run_or_defer(state.estimator.start_run)
                state.monitor.start_run()
            else:
                state.run_or_defer(partial(setattr, state.estimator, "running", False))

    def _move_anchor(self, anchor_id: str, T_world_anchor: Pose) -> None:
        pose = (T_world_anchor.p, T_world_anchor.q)
        if not is_rigid(pose):
            return
        self.anchors[anchor_id] = pose
        self._cross_check.discard_target(anchor_id)
        for state in self._states.values():
            state.run_or_defer(state.estimator.on_anchors_moved)
            state.monitor.on_anchor_moved(anchor_id)

    def _find_states(self, participant: str) -> list[_HeadsetState]:
        return [state for state in self._states.values() if state.connection.participant_id == participant]

    # --- periodic work -----------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Begin at most one estimate, calibration or cross-check: each takes up to milliseconds."""
        self._worker.poll()
        if self._worker.is_busy:
            return
        for number, state in self._states.items():
            if state.tips and now_ns >= state.next_tip_ns:
                self._states[number] = self._states.pop(number)  # round robin
                self._calibrate_tip(number, state, now_ns)
                return
            if state.estimator.is_due(now_ns):
                self._states[number] = self._states.pop(number)  # round robin
                self._propose(number, state, now_ns)
                return
        in_force = {n: s.monitor.in_force for n, s in self._states.items() if s.monitor.in_force is not None}
        comparison = self._cross_check.begin_comparison(in_force, now_ns, self._offer)
        if comparison is not None:
            self._worker.submit(comparison)

    def _propose(self, number: int, state: _HeadsetState, now_ns: int) -> None:
        """Compute a proposal in the worker, and offer it when it is there."""
        state.busy, state.is_outdated = True, False

        def compute() -> Callable[[], None]:
            proposal = state.estimator.propose(now_ns)
            return lambda: self._finish_proposal(number, state, proposal, now_ns)

        self._worker.submit(compute)

    def _calibrate_tip(self, number: int, state: _HeadsetState, now_ns: int) -> None:
        """Calibrate a tip in the worker, and offer the result when it is there."""
        observation = state.tips.pop(next(iter(state.tips)))
        state.next_tip_ns = now_ns + TIP_PERIOD_NS

        def compute() -> Callable[[], None]:
            try:
                solved = solve_tip(observation)
            except NUMERICAL_ERRORS:
                text = "these poses cannot be solved: turn the controller again, in every direction"
                solved = TipSolved(observation.device, refused=True, advice=text)
            return lambda: finish(solved)

        def finish(solved: TipSolved) -> None:
            if self._states.get(number) is state:
                self._offer(Entry(number, number, now_ns, solved))

        self._worker.submit(compute)

    def _finish_proposal(
        self, number: int, state: _HeadsetState, proposal: AlignmentProposal | None, now_ns: int
    ) -> None:
        state.busy = False
        if self._states.get(number) is not state:
            return  # the connection has ended
        if proposal is not None and not state.is_outdated:
            self._offer_proposal(number, state, proposal, now_ns)
        while state.waiting and not state.busy:
            state.waiting.popleft()()

    def _offer_proposal(self, number: int, state: _HeadsetState, proposal: AlignmentProposal, now_ns: int) -> None:
        if state.estimator.newest is not None and not proposal.refused and proposal.kind == AlignmentKind.MEASURED:
            state.monitor.set_estimate(state.estimator.newest)
        state.proposal_ns = max(now_ns, state.alarm_ns + 1)
        self._offer(Entry(number, number, state.proposal_ns, proposal))

    def close(self) -> None:
        """End the worker."""
        self._worker.close()

    def complete_report(self, number: int, report: AlignmentReport | None, now_ns: int) -> AlignmentReport | None:
        """Return the authority's report on a participant, completed by the state of the estimator."""
        state = self._states.get(number)
        return report if state is None else state.estimator.complete_report(report, now_ns)


def _to_estimate(alignment: Alignment | None) -> AlignmentEstimate | None:
    """Return an alignment in the form of an estimate, `None` if there is none or its error is unknown."""
    if alignment is None or len(alignment.covariance) != _COVARIANCE_VALUES:
        return None
    pose = alignment.T_world_tracking
    return AlignmentEstimate(
        (pose.p, pose.q),
        alignment.tracking_epoch,
        alignment.covariance,
        alignment.pivot_world,
        alignment.error_at_anchor_m,
        residual_tilt_rad=0.0,
        n_observations=0,
        n_viewpoints=0,
        refused=False,
        advice="",
    )


def _limit_size(memory: dict[str, Any], max_size: int) -> None:
    """Remove the oldest items until at most `max_size` are left."""
    while len(memory) > max_size:
        del memory[next(iter(memory))]
