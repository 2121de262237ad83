"""An emulated operator or observer: a client, a headset and a behaviour. Joins, aligns, acquires robots, works.

    join --> look --> acquire --> work --> done          any --> failed (`report.failed` says why)
             ^-- the alignment is void or in doubt --'

The headset reports the sheet ten times a second whenever it is in view and the head keeps still, in every phase.
`step` never waits and takes the time as an argument; the loop around it is in `runner`. All times are local monotonic
nanoseconds unless named session time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from anchors.pose import IDENTITY_POSE, PoseTuple, Vec3, apply, compose, distance, inverse, quat_angle, quat_from_yaw
from iris_session.client import Client, CurveKeys, PoseBuffer, SceneState, ShownPoses
from iris_session.client.core.scene_follower import SceneFollower
from iris_session.client.core.state_stream import Poses
from iris_session.client.deformables import Deformables
from iris_session.client.stream_meter import StreamMeter
from iris_session.emulator.behaviours import Behaviour, CombinedBehaviour, HandInput, make_behaviour
from iris_session.emulator.gaze import Gaze, interpolate_pose
from iris_session.emulator.headset import DelayLine, EmulatedHeadset
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec
from iris_session.protocol.client_messages import Acquire, Observation, Sample
from iris_session.protocol.common import Alignment, Pose
from iris_session.protocol.names import (
    AlarmKind,
    AlignmentKind,
    AnchorKind,
    CommandKind,
    DenialReason,
    Device,
    HoldReason,
    Role,
)
from iris_session.protocol.server_messages import AlignmentAlarmed, AlignmentRun, Event, Handover, Notice, Reply
from iris_session.protocol.status import compute_quantiles

#: Hand at rest, in a frame at the eye that is level and looks where the head looks [m]: right, low, in front.
HAND_AT_REST: Final[Vec3] = (0.40, -0.15, -0.30)
REACT_S: Final = 0.5  # time to correct a hand that is suddenly shown elsewhere
ROUNDS: Final = 2  # around the sheet after an alarm; then the alignment in force is accepted
SETTLE_S: Final = 0.6  # after the last observation, for the estimate to arrive
AGES_KEPT: Final = 4_000  # a minute of frames
RETRY_S: Final = 1.0
LOST_S: Final = 2.0  # without a session at the end for longer: a failure

#: Denials that waiting does not change.
FOR_GOOD: Final = frozenset({DenialReason.UNKNOWN_TARGET, DenialReason.ROLE, DenialReason.UNKNOWN_VALUE})


class EmulatedOperator:
    """One emulated operator or observer; see the module docstring. `report` is kept up to date."""

    def __init__(self, address: str, spec: HeadsetSpec, start_ns: int, join_code: str = "") -> None:
        curve = load_curve_keys(spec)
        self.spec = spec
        self.report = HeadsetReport(name=spec.name, rejected={}, phases={})
        self.headset = EmulatedHeadset(spec.model, spec.seed, start_ns)
        self.observer = spec.observer
        #: The robots to drive; empty until the session's policy has chosen, when the spec names none.
        self.robots = tuple(task.robot for task in spec.tasks if task.robot)
        self.behaviour = make_spec_behaviour(spec, spec.robot)
        hands = tuple(task.device for task in spec.tasks)
        self.client = Client(
            address,
            role=Role.OBSERVER if self.observer else Role.OPERATOR,
            name=spec.name,
            devices=(Device.HEAD, *hands),
            identity=spec.identity_file or None,
            curve=curve,
            join_code="" if curve is not None else join_code,
            software="iris-session emulator",
            on_state=self._on_state,
            on_event=self._on_event,
        )
        self.display = HeadsetDisplay(self.client, spec.display_delay_s)
        self._deformables = Deformables(self.client)
        self._meters: dict[str, StreamMeter] = {}
        #: Samples and observations in flight, and those of the present frame, which are sent together.
        self._uplink: DelayLine[tuple[tuple[Sample, ...], Observation | None]]
        self._uplink = DelayLine(spec.model.link, self.headset.rng)
        self._frame: list[Sample] = []
        self._ages_ns: deque[int] = deque(maxlen=AGES_KEPT)
        self.started_ns = start_ns
        self._joined_ns = 0
        self._lost_ns = 0  # when the connection was lost, 0 while there is one
        self._now_ns = start_ns
        self._phase_ns = start_ns
        self._viewpoint = 0
        self._detections_here = 0
        self._observed_ns = 0
        self._rounds = 0
        self._must_realign = False
        self._doubted_version = -1  # version of the alignment that must be measured again
        self._slip: tuple[PoseTuple, int] = (IDENTITY_POSE, 0)  # displacement of tracked hands by a bump, and its time
        self._request: tuple[int, int] | None = None
        self._retry_ns = 0
        self._refused_because = ""
        self._clutches = {device: HandClutch() for device in hands}
        self._planned = sorted([(s, "recentre") for s in spec.recentre_at_s] + [(s, "bump") for s in spec.bump_at_s])
        self.gaze = Gaze(spec)
        yaw = math.atan2(spec.T_world_anchor[0][1] - spec.eye[1], spec.T_world_anchor[0][0] - spec.eye[0])
        for device in hands:
            x, y, z = HAND_AT_REST
            at_rest = (x, -y if device.endswith("left") else y, z)
            self.display.hands[device] = compose((spec.eye, quat_from_yaw(yaw)), (at_rest, (1.0, 0.0, 0.0, 0.0)))
        self.client.open()

    @property
    def finished(self) -> bool:
        """Done or failed. Observers are never done."""
        return self.report.phase in ("done", "failed")

    @property
    def next_step_ns(self) -> int:
        """Latest time of the next call of `step`."""
        arrival = self._uplink.next_arrival_ns
        return self.headset.next_sample_ns if arrival is None else min(arrival, self.headset.next_sample_ns)

    def step(self, now_ns: int) -> None:
        """Run one round of the loop, after `client.poll`."""
        self._now_ns = now_ns
        self._lost_ns = 0 if self.client.ready or not self._joined_ns else self._lost_ns or now_ns
        if self.display.wants_vertices:
            for name in self._deformables.update():
                shapes = self._deformables
                self.display.add_vertices(name, shapes.vertices[name], shapes.capture_ns[name])
        self._measure_streams(now_ns)
        for samples, seen in self._uplink.pop(now_ns):
            sent = self.client.send_samples(samples) if len(samples) > 1 else self.client.send(samples[0])
            self.report.samples += len(samples) if sent else 0
            if seen is not None and self.client.ready:
                self.client.send(seen)
        if not self.headset.is_sample_due(now_ns) or not self.client.ready:
            return
        if not self._joined_ns:
            self._joined_ns = now_ns
            self.report.joined_s = (now_ns - self.started_ns) / 1e9
            self._enter("look", now_ns)
        self._run_schedule(now_ns)
        self._sample(now_ns)
        timeout = self.report.phase in ("look", "acquire") and now_ns - self._phase_ns > self.spec.phase_timeout_s * 1e9
        if timeout:
            self.fail(f"{self.report.phase} took too long: {self._refused_because or 'no answer'}", now_ns)

    def check_session(self, now_ns: int) -> None:
        """Fail if the session has been lost for `LOST_S`, unless the task is finished."""
        if self.finished or not self._lost_ns or now_ns - self._lost_ns < LOST_S * 1e9:
            return
        text = f"{self.client.describe_failure(f'for {(now_ns - self._lost_ns) * 1e-9:.1f} s')}"
        self.fail(f"no session at {text}", now_ns)

    def fail(self, why: str, now_ns: int) -> None:
        """End with a failure."""
        self.report.failed = why
        self._enter("failed", now_ns)

    def disturb_tracking(self, kind: str, now_ns: int) -> None:
        """Disturb the tracking frame: `recentre`, `bump` (undetected by the headset), or `drift` until `steady`."""
        if kind == "recentre":
            self.headset.recentre_frame(now_ns)
            self.client.alignment.report_tracking_jump()
            for clutch in self._clutches.values():
                clutch.open_briefly()
        elif kind in ("drift", "steady"):
            self.headset.start_drift(self.spec.drift_m_per_min if kind == "drift" else 0.0, now_ns)
        else:
            spec = self.spec
            self._slip = (self.headset.bump_frame(spec.bump_m, spec.bump_yaw_rad, self.gaze.pose[0], now_ns), now_ns)
        self.report.disturbed_ns[kind] = self.client.session_now_ns()

    def glance(self) -> None:
        """Look at the sheet once more, as a notice advises, and go on."""
        self._must_realign = True

    def finish_report(self) -> HeadsetReport:
        """Fill in the fields that are computed at the end, and return the report."""
        report, client = self.report, self.client
        self._update_errors(self._now_ns)
        ages = compute_quantiles(self._ages_ns)
        if ages is not None:
            report.age_ms_p50, report.age_ms_p99 = ages.p50, ages.p99
        report.participant = client.participant_id
        welcome = client.connection.welcome
        if welcome is not None:
            report.session, report.address = welcome.session_name, client.address
        report.lost_s = round((self._now_ns - self._lost_ns) * 1e-9, 3) if self._lost_ns else 0.0
        report.rejected = self._count_rejected()
        report.reclutches = sum(clutch.reclutches for clutch in self._clutches.values())
        report.samples_not_sent = client.connection.counters.samples_not_sent
        report.reconnects = client.connection.counters.reconnects
        report.clock_error_ms = client.clock_error_ns() / 1e6
        report.streams = tuple(
            self._meters[name].measure(self._now_ns) for name in self.spec.streams if name in self._meters
        )
        report.mirror_hash, report.event_seq = client.mirror.mirror_hash(), client.mirror.event_seq
        return report

    def _measure_streams(self, now_ns: int) -> None:
        """Measure the streams of the spec, each from when the session has it."""
        delivery = self.client.media.delivery if len(self._meters) < len(self.spec.streams) else None
        for one in () if delivery is None else delivery.streams:
            if one.stream in self.spec.streams and one.stream not in self._meters:
                self._meters[one.stream] = StreamMeter(self.client, one.stream, now_ns)
        for meter in self._meters.values():
            meter.poll(now_ns)

    # --- one sampling instant -----------------------------------------------------------------------------------------

    def _sample(self, now_ns: int) -> None:
        self.display.refresh(self.client.session_now_ns())
        self._check_losses(now_ns)
        if self.report.phase == "look":
            self._observe_sheet(now_ns)
        elif self.report.phase == "work":
            self.gaze.look_at_work(now_ns)
        else:
            self.gaze.look_at_sheet(now_ns)
        if self.report.phase == "acquire":
            self._acquire(now_ns)
        seen = self._detect(now_ns)
        self._append_sample(Device.HEAD, self.headset.track(self.gaze.pose, now_ns))
        if not self.observer:
            self._sample_hands(now_ns)
        self._uplink.push((tuple(self._frame), seen), now_ns)
        self._frame.clear()

    def _detect(self, now_ns: int) -> Observation | None:
        """Return a detection of the sheet when it is visible."""
        spec, headset = self.spec, self.headset
        if not (headset.worn and self.gaze.is_still(now_ns) and headset.is_detection_due(now_ns)):
            return None
        self._detections_here += 1
        seen = headset.observe(self.gaze.pose, spec.T_world_anchor, now_ns, self.gaze.viewpoint_id)
        if seen is None:
            return None
        self.report.observations += 1
        return Observation(
            anchor_id=spec.anchor_id,
            kind=AnchorKind.QR,
            T_tracking_anchor=Pose(*seen),
            capture_ns=self.client.session_now_ns(),
            tracking_epoch=headset.tracking_epoch,
            viewpoint_id=self.gaze.viewpoint_id,
            size_m=spec.sheet_m,
        )

    def _sample_hands(self, now_ns: int) -> None:
        behaviour, alignment = self.behaviour, self._get_alignment()
        if behaviour is None or alignment is None:
            return
        inputs: Iterable[HandInput] = ()
        if self.report.phase == "work" and self.display.ready:
            inputs = behaviour.update(self.display)
            if behaviour.failed:
                self.fail(f"{behaviour.phase}: {behaviour.failed}", now_ns)
            elif behaviour.done:
                self.report.done = True
                self._enter("done", now_ns)
            else:
                self._note_phase(f"work/{behaviour.phase}", now_ns)
        sent = False
        for hand in inputs:
            sent = True
            self.display.hands[hand.device] = hand.pose_world
            self._send_hand(hand, alignment, now_ns)
        for task in self.spec.tasks if not sent else ():
            robot = task.robot or next(iter(self.robots), "")
            rest = HandInput(task.device, robot, self.display.hands[task.device], False, math.nan)
            self._send_hand(rest, alignment, now_ns)

    def _send_hand(self, hand: HandInput, alignment: Alignment, now_ns: int) -> None:
        """Sample a hand. The operator positions it in the displayed world, so the alignment decides the tracked
        pose."""
        T_world_tracking: PoseTuple = (alignment.T_world_tracking.p, alignment.T_world_tracking.q)
        pose = self.headset.add_noise(self._apply_slip(compose(inverse(T_world_tracking), hand.pose_world), now_ns))
        self._append_sample(
            hand.device,
            pose,
            robots=(hand.robot,) if self.client.lease_version(hand.robot) is not None else (),
            clutch=self._clutches[hand.device].update(hand, self.client, self.display.estop, now_ns),
            gripper=None if math.isnan(hand.gripper) else hand.gripper,
        )

    def _apply_slip(self, T_tracking_hand: PoseTuple, now_ns: int) -> PoseTuple:
        """Displace the hand after a bump, decreasing until the operator has corrected it."""
        T_new_old, since_ns = self._slip
        left = 1.0 - (now_ns - since_ns) / (REACT_S * 1e9)
        return (
            compose(interpolate_pose(IDENTITY_POSE, T_new_old, left), T_tracking_hand)
            if left > 0.0
            else T_tracking_hand
        )

    def _append_sample(self, device: str, pose: PoseTuple, **fields: Any) -> None:
        """Append a sample of one device to the present frame."""
        sample = self.client.make_sample(
            device, pose, tracking_epoch=self.headset.tracking_epoch, worn=self.headset.worn, **fields
        )
        self._frame.append(sample)

    # --- phases -------------------------------------------------------------------------------------------------------

    def _observe_sheet(self, now_ns: int) -> None:
        """Move the head around the sheet, until the session has accepted an alignment after the last viewpoint."""
        spec = self.spec
        if self._viewpoint < spec.viewpoints and self._detections_here >= spec.observations_per_viewpoint:
            self._detections_here = 0
            self._viewpoint += 1
            self._observed_ns = now_ns
        if self._viewpoint < spec.viewpoints:
            self.gaze.move_to_viewpoint(self._viewpoint, now_ns)
        elif now_ns - self._observed_ns > SETTLE_S * 1e9:
            self._rounds += 1
            alignment = self._get_alignment()
            if alignment is None or (alignment.version == self._doubted_version and self._rounds < ROUNDS):
                self._viewpoint = self._detections_here = 0  # another round
                return
            self._must_realign = False
            self.report.aligned_s = (now_ns - self.started_ns) / 1e9
            self._update_errors(now_ns)
            self._enter("watch" if self.observer else "acquire", now_ns)

    def _acquire(self, now_ns: int) -> None:
        if self.robots and self._has_robots():
            self._request = None
            self._enter("work", now_ns)
        elif self._request is None and now_ns >= self._retry_ns:
            number = self.client.submit(Acquire(0, self.robots, wait=True))
            self._request = (self.client.connection.generation, number)
        elif self._request is not None:
            generation, number = self._request
            reply = self.client.answer(number)
            if reply is not None or generation != self.client.connection.generation:
                self._request = None  # answered, or the connection has ended
                self._retry_ns = now_ns + int(RETRY_S * 1e9)
            if reply is not None:
                self._process_reply(reply, now_ns)

    def _process_reply(self, reply: Reply, now_ns: int) -> None:
        """Process a grant, which may name a robot of the policy's choice, or a denial."""
        if reply.denial is not None:
            self._refused_because = f"{reply.denial.reason}: {reply.denial.message}; {reply.denial.advice}"
            if reply.denial.reason in FOR_GOOD:
                self.fail(self._refused_because, now_ns)
        elif not self.robots and reply.leases:
            self.robots = (reply.leases[0].target,)
            self.behaviour = make_spec_behaviour(self.spec, self.robots[0])

    def _has_robots(self) -> bool:
        return all(self.client.lease_version(robot) is not None for robot in self.robots)

    def _check_losses(self, now_ns: int) -> None:
        """Return to an earlier phase after the loss of the alignment or of a robot."""
        if (self._get_alignment() is None or self._must_realign) and self.report.phase in ("watch", "acquire", "work"):
            self._viewpoint = self._detections_here = self._rounds = 0
            self._must_realign = False
            self._enter("look", now_ns)
        elif self.report.phase == "work" and not self._has_robots():
            self._enter("acquire", now_ns)

    def _run_schedule(self, now_ns: int) -> None:
        """Run scheduled events: jumps of the tracking frame, taking the headset off and putting it on."""
        elapsed = (now_ns - self._joined_ns) / 1e9
        if self._planned and elapsed >= self._planned[0][0]:
            self.disturb_tracking(self._planned.pop(0)[1], now_ns)
        doff, don = self.spec.doff_at_s, self.spec.don_at_s
        worn = not (doff is not None and elapsed >= doff and (don is None or elapsed < don))
        if worn != self.headset.worn:
            self.headset.worn = self.client.worn = worn

    def _enter(self, phase: str, now_ns: int) -> None:
        self.report.phase = phase
        self._phase_ns = now_ns
        self._note_phase(phase, now_ns)

    def _note_phase(self, phase: str, now_ns: int) -> None:
        """Record when a phase began first, in seconds since the start."""
        self.report.phases.setdefault(phase, round((now_ns - self.started_ns) / 1e9, 3))

    # --- knowledge ----------------------------------------------------------------------------------------------------

    def _get_alignment(self) -> Alignment | None:
        """Return the own alignment, if it is valid for the present tracking frame."""
        alignment = self.client.alignment.current
        if alignment is None or alignment.kind not in (AlignmentKind.MEASURED, AlignmentKind.PLACED):
            return None
        return alignment if alignment.tracking_epoch == self.headset.tracking_epoch else None

    def _update_errors(self, now_ns: int) -> None:
        """Compare the alignment in force with the true pose. Without one, the last values stay."""
        report, alignment = self.report, self._get_alignment()
        if alignment is None:
            report.T_true_shown = None
            return
        true, p_sheet = self.headset.get_T_world_tracking(now_ns), self.spec.T_world_anchor[0]
        believed: PoseTuple = (alignment.T_world_tracking.p, alignment.T_world_tracking.q)
        shown = report.T_true_shown = compose(true, inverse(believed))
        x, y, z = p_sheet
        around: list[Vec3] = [(x + 1, y, z), (x - 1, y, z), (x, y + 1, z), (x, y - 1, z), (x, y, z + 1)]
        report.alignment_version = alignment.version
        report.alignment_error_mm = 1e3 * distance(apply(shown, p_sheet), p_sheet)
        report.alignment_error_1m_mm = 1e3 * max(distance(apply(shown, p), p) for p in around)
        report.alignment_error_deg = math.degrees(quat_angle(believed[1], true[1]))
        report.stated_error_mm = 1e3 * alignment.error_at_anchor_m

    def _count_rejected(self) -> dict[str, int]:
        total: dict[str, int] = {}
        for feedback in self.client.feedback.values():
            for reason, count in feedback.rejected.items():
                total[reason] = max(total.get(reason, 0), count)
        return total

    def _on_state(self, state: SceneState) -> None:
        self.report.frames += 1
        self._ages_ns.append(state.age_ns)
        self.display.add_state(state)

    def _on_event(self, event: Event) -> None:
        if isinstance(event.body, Handover):
            self.report.handovers += 1
        elif isinstance(event.body, Notice) and event.body.participant == self.client.participant_id:
            self._refused_because = event.body.text  # a notice for another participant is not our reason
        elif isinstance(event.body, AlignmentAlarmed | AlignmentRun):
            self._on_alignment_doubt(event.body)

    def _on_alignment_doubt(self, event: AlignmentAlarmed | AlignmentRun) -> None:
        """Plan another alignment after an alarm or at the start of a run. A jump voids the alignment by itself."""
        alignment = self.client.alignment.current
        if event.participant != self.client.participant_id or alignment is None:
            return
        alarm = isinstance(event, AlignmentAlarmed)
        if event.running if isinstance(event, AlignmentRun) else event.kind != AlarmKind.JUMP and not event.beside:
            self._must_realign, self._doubted_version = True, alignment.version
            self.report.alarms += alarm


class HeadsetDisplay(SceneFollower):
    """The displayed state in the world frame: `OperatorView` of the behaviours. Its delay is deliberate."""

    def __init__(self, client: Client, delay_s: float) -> None:
        super().__init__(client.connection)
        self.buffer = PoseBuffer(int(delay_s * 1e9))
        self.hands: dict[str, PoseTuple] = {}
        #: Set when a behaviour has asked for a vertex: the caller must then add vertices.
        self.wants_vertices = False
        self.session_time_ns = 0
        self._vertices: dict[str, tuple[NDArray[np.floating], int]] = {}
        self._epoch = 0
        self._shown: ShownPoses | None = None

    def add_state(self, state: SceneState) -> None:
        """Add a new state."""
        if state.header.scene_epoch != self._epoch:
            self._epoch = state.header.scene_epoch
            self.buffer.clear()
            self._vertices.clear()
        self.buffer.add(state.header.session_time, state.poses)

    def add_vertices(self, deformable: str, p_world: NDArray[np.floating], capture_ns: int) -> None:
        """Add positions of all vertices of a deformable [m], in the order of the model, and their session time."""
        self._vertices[deformable] = p_world, capture_ns

    def refresh(self, session_ns: int) -> None:
        """Advance to the frame displayed at `session_ns`."""
        self.session_time_ns = max(self.session_time_ns, session_ns)
        self._shown = self.buffer.poses_at(self.session_time_ns)

    @property
    def ready(self) -> bool:
        return self._shown is not None

    @property
    def estop(self) -> bool:
        return self._connection.mirror.estop

    @property
    def poses(self) -> Poses | None:
        """Displayed poses (n, 7) of the bodies in the mirror."""
        return None if self._shown is None else self._shown.poses

    def vertex(self, deformable: str, index: int) -> Vec3 | None:
        self.wants_vertices = True
        shown = self._vertices.get(deformable)
        if shown is None or not 0 <= index < len(shown[0]):
            return None
        x, y, z = shown[0][index].tolist()
        return (x, y, z)

    def vertices_ns(self, deformable: str) -> int:
        return self._vertices[deformable][1] if deformable in self._vertices else 0

    def lease_version(self, robot: str) -> int | None:
        return self._connection.lease_version(robot)

    def device_pose(self, device: str) -> PoseTuple:
        return self.hands[device]


RECLUTCH_AFTER_S: Final = 0.25  # clutch closed but the robot holds: open it ...
RECLUTCH_SAMPLES: Final = 3  # ... for this many samples

#: Reasons of a hold that end after the clutch was opened and closed.
CLUTCH_AGAIN: Final = frozenset(
    {HoldReason.REARM, HoldReason.REJECTED, HoldReason.STALE, HoldReason.GAP, HoldReason.SCENE_CHANGED,
     HoldReason.NO_SAMPLE, HoldReason.DISCONNECTED, HoldReason.ESTOP, HoldReason.UNTRACKED, HoldReason.NOT_WORN,
     HoldReason.UNALIGNED, HoldReason.EMULATED, HoldReason.ZERO_POSE, HoldReason.FROZEN, HoldReason.JUMP,
     HoldReason.UNCONFIRMED}
)  # fmt: skip


class HandClutch:
    """Clutch of one hand: opened and closed again when the robot holds although it is closed. `reclutches`: how
    often."""

    def __init__(self) -> None:
        self.reclutches = 0
        self._open = RECLUTCH_SAMPLES  # samples for which it stays open
        self._holding_since = 0
        self._lease_version: int | None = None

    def open_briefly(self) -> None:
        """Open the clutch for `RECLUTCH_SAMPLES` samples."""
        self._open = RECLUTCH_SAMPLES

    def update(self, hand: HandInput, client: Client, estop: bool, now_ns: int) -> bool:
        """Return True if the clutch is closed in the sample taken now [local ns]."""
        lease_version = client.lease_version(hand.robot)
        if lease_version != self._lease_version:  # a new lease arms only after a sample with an open clutch
            self._lease_version = lease_version
            self.open_briefly()
        if self._open > 0:
            self._open -= 1
            return False
        feedback = client.feedback.get(hand.robot)
        holds = feedback is not None and feedback.state == CommandKind.HOLD and feedback.hold_reason in CLUTCH_AGAIN
        if not (hand.clutch and holds) or estop:
            self._holding_since = 0
        elif not self._holding_since:
            self._holding_since = now_ns
        elif now_ns - self._holding_since > RECLUTCH_AFTER_S * 1e9:
            self._holding_since = 0
            self.open_briefly()
            self.reclutches += 1
        return hand.clutch


def make_spec_behaviour(spec: HeadsetSpec, robot: str) -> Behaviour | None:
    """Return the behaviour of a spec, `None` for an observer. Raises `ValueError` listing the available ones."""
    hands = [
        make_behaviour(
            task.behaviour,
            task.robot or robot,
            task.object,
            task.partner,
            task.device,
            spec.seed,
            task.arm,
            task.place,
            task.plan,
        )
        for task in spec.tasks
    ]
    return None if not hands else hands[0] if len(hands) == 1 else CombinedBehaviour(hands)


def load_curve_keys(spec: HeadsetSpec) -> CurveKeys | None:
    """Return the CURVE keys of a spec. Raises `IdentityError` for invalid files, `ValueError` for half a pair."""
    if bool(spec.curve_server) != bool(spec.curve_key):
        raise ValueError("curve_server (public key of the session) and curve_key (own secret key) go together")
    return CurveKeys.from_files(spec.curve_server, spec.curve_key) if spec.curve_key else None
