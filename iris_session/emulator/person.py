"""One emulated person: a client, a headset, and a behaviour. Joins, looks at the sheet, takes a robot, works.

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

from anchors.pose import IDENTITY_POSE, PoseTuple, Vec3, compose, inverse, quat_from_yaw
from iris_session.client import Client, SceneState
from iris_session.client.deformables import Deformables
from iris_session.emulator.behaviours import HandInput
from iris_session.emulator.clutching import Clutch
from iris_session.emulator.display import Display
from iris_session.emulator.equipment import behaviour_of, curve_of
from iris_session.emulator.gaze import Gaze
from iris_session.emulator.headset import Headset
from iris_session.emulator.judge import judge
from iris_session.emulator.specs import HeadsetReport, HeadsetSpec
from iris_session.emulator.viewpoints import between
from iris_session.netsim.latency import DelayLine
from iris_session.protocol.client_messages import Acquire, Observation, Sample
from iris_session.protocol.common import Alignment, Pose
from iris_session.protocol.names import AlarmKind, AlignmentKind, AnchorKind, DenialReason, Device, Role
from iris_session.protocol.server_messages import AlignmentAlarmed, AlignmentRun, Event, Handover, Notice, Reply

#: Hand at rest, in a frame at the eye that is level and looks where the head looks [m]: right, low, in front.
HAND_AT_REST: Final[Vec3] = (0.40, -0.15, -0.30)
REACT_S: Final = 0.5  # a hand that is suddenly shown elsewhere is brought back to where it should be
ROUNDS: Final = 2  # about the sheet after an alarm; then what is in force evidently stands
SETTLE_S: Final = 0.6  # after the last observation, for the estimate to arrive
AGES_KEPT: Final = 4_000  # a minute of frames
RETRY_S: Final = 1.0

#: Denials that no waiting mends.
FOR_GOOD: Final = frozenset({DenialReason.UNKNOWN_TARGET, DenialReason.ROLE, DenialReason.UNKNOWN_VALUE})


class Person:
    """See the module docstring. `report` is kept up to date."""

    def __init__(self, address: str, spec: HeadsetSpec, start_ns: int) -> None:
        self.spec = spec
        self.report = HeadsetReport(name=spec.name, rejected={}, phases={})
        self.headset = Headset(spec.model, spec.seed, start_ns)
        self.observer = spec.observer
        #: What this person drives; empty until the session's policy has chosen, when the spec names none.
        self.robots = tuple(task.robot for task in spec.tasks if task.robot)
        self.behaviour = behaviour_of(spec, spec.robot)
        hands = tuple(task.device for task in spec.tasks)
        self.client = Client(
            address,
            role=Role.OBSERVER if self.observer else Role.OPERATOR,
            name=spec.name,
            devices=(Device.HEAD, *hands),
            identity=spec.identity_file or None,
            curve=curve_of(spec),
            software="iris-session emulator",
            on_state=self._on_state,
            on_event=self._on_event,
        )
        self.display = Display(self.client, spec.display_delay_s)
        self._deformables = Deformables(self.client)
        #: What is on its way, and what was sampled and seen in the frame that is being taken: they travel together.
        self._uplink: DelayLine[tuple[tuple[Sample, ...], Observation | None]]
        self._uplink = DelayLine(spec.model.link, self.headset.rng)
        self._frame: list[Sample] = []
        self._ages: deque[float] = deque(maxlen=AGES_KEPT)
        self.started_ns = start_ns
        self._joined_ns = 0
        self._now_ns = start_ns
        self._phase_ns = start_ns
        self._viewpoint = 0
        self._looks_here = 0
        self._looked_ns = 0
        self._rounds = 0
        self._look_again = False  # somebody said so
        self._doubted = -1  # version of the alignment that is to be measured anew
        self._slip: tuple[PoseTuple, int] = (IDENTITY_POSE, 0)  # what a bump did to tracked hands, and when
        self._request: tuple[int, int] | None = None
        self._retry_ns = 0
        self._refused_because = ""
        self._clutches = {device: Clutch() for device in hands}
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
    def next_ns(self) -> int:
        """When `step` has something to do at the latest."""
        arrival = self._uplink.next_arrival_ns
        return self.headset.next_sample_ns if arrival is None else min(arrival, self.headset.next_sample_ns)

    def step(self, now_ns: int) -> None:
        """One round of the loop, after `client.poll`."""
        self._now_ns = now_ns
        if self.display.wants_vertices:
            for name in self._deformables.update():
                shapes = self._deformables
                self.display.take_vertices(name, shapes.vertices[name], shapes.capture_ns[name])
        for samples, seen in self._uplink.pop(now_ns):
            sent = self.client.send_samples(samples) if len(samples) > 1 else self.client.send(samples[0])
            self.report.samples += len(samples) if sent else 0
            if seen is not None and self.client.ready:
                self.client.send(seen)
        if not self.headset.sample_due(now_ns) or not self.client.ready:
            return
        if not self._joined_ns:
            self._joined_ns = now_ns
            self.report.joined_s = (now_ns - self.started_ns) / 1e9
            self._enter("look", now_ns)
        self._scheduled(now_ns)
        self._sample(now_ns)
        timeout = self.report.phase in ("look", "acquire") and now_ns - self._phase_ns > self.spec.phase_timeout_s * 1e9
        if timeout:
            self.fail(f"{self.report.phase} took too long: {self._refused_because or 'no answer'}", now_ns)

    def fail(self, why: str, now_ns: int) -> None:
        """Gives up."""
        self.report.failed = why
        self._enter("failed", now_ns)

    def disturb(self, kind: str, now_ns: int) -> None:
        """The tracking frame jumps: `recentre`, or `bump`, which the headset does not notice. Or it begins to `drift`,
        until `steady`."""
        if kind == "recentre":
            self.headset.recentre(now_ns)
            self.client.new_tracking_frame()
            for clutch in self._clutches.values():
                clutch.open()
        elif kind in ("drift", "steady"):
            self.headset.drift(self.spec.drift_m_per_min if kind == "drift" else 0.0, now_ns)
        else:
            spec = self.spec
            self._slip = (self.headset.bump(spec.bump_m, spec.bump_yaw_rad, self.gaze.pose[0], now_ns), now_ns)
        self.report.disturbed_ns[kind] = self.client.session_now_ns()

    def finish_report(self) -> HeadsetReport:
        """Fills in what is computed at the end."""
        report, client = self.report, self.client
        self._judge(self._now_ns)
        ages = sorted(self._ages)
        if ages:
            report.age_ms_p50 = ages[len(ages) // 2]
            report.age_ms_p99 = ages[min(len(ages) - 1, int(0.99 * len(ages)))]
        report.participant = client.participant_id
        report.rejected = self._rejected()
        report.reclutches = sum(clutch.reclutches for clutch in self._clutches.values())
        report.samples_not_sent = client.connection.counters.samples_not_sent
        report.reconnects = client.connection.counters.reconnects
        report.clock_error_ms = client.clock_error_ns() / 1e6
        report.mirror_hash, report.event_seq = client.mirror.mirror_hash(), client.mirror.event_seq
        return report

    # --- one sampling instant -----------------------------------------------------------------------------------------

    def _sample(self, now_ns: int) -> None:
        self.display.refresh(self.client.session_now_ns())
        self._fall_back(now_ns)
        if self.report.phase == "look":
            self._look(now_ns)
        elif self.report.phase == "work":
            self.gaze.work(now_ns)
        else:
            self.gaze.rest(now_ns)
        if self.report.phase == "acquire":
            self._acquire(now_ns)
        seen = self._detect(now_ns)
        self._take(Device.HEAD, self.headset.track(self.gaze.pose, now_ns))
        if not self.observer:
            self._hands(now_ns)
        self._uplink.push((tuple(self._frame), seen), now_ns)
        self._frame.clear()

    def _detect(self, now_ns: int) -> Observation | None:
        """What the cameras make of the sheet, when it is in view."""
        spec, headset = self.spec, self.headset
        if not (headset.worn and self.gaze.still(now_ns) and headset.detection_due(now_ns)):
            return None
        self._looks_here += 1
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

    def _hands(self, now_ns: int) -> None:
        behaviour, alignment = self.behaviour, self._alignment()
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
        """The person puts the hand where the display shows it, so the displayed world decides what is tracked."""
        T_world_tracking: PoseTuple = (alignment.T_world_tracking.p, alignment.T_world_tracking.q)
        pose = self.headset.add_noise(self._slipped(compose(inverse(T_world_tracking), hand.pose_world), now_ns))
        self._take(
            hand.device,
            pose,
            robots=(hand.robot,) if self.client.lease_version(hand.robot) is not None else (),
            clutch=self._clutches[hand.device].sample(hand, self.client, self.display.estop, now_ns),
            gripper=None if math.isnan(hand.gripper) else hand.gripper,
        )

    def _slipped(self, T_tracking_hand: PoseTuple, now_ns: int) -> PoseTuple:
        """After a bump the hand is tracked, and shown, elsewhere, until the person has brought it back."""
        T_new_old, since_ns = self._slip
        left = 1.0 - (now_ns - since_ns) / (REACT_S * 1e9)
        return compose(between(IDENTITY_POSE, T_new_old, left), T_tracking_hand) if left > 0.0 else T_tracking_hand

    def _take(self, device: str, pose: PoseTuple, **fields: Any) -> None:
        """A sample of one device, for the frame that is being taken."""
        sample = self.client.make_sample(
            device, pose, tracking_epoch=self.headset.tracking_epoch, worn=self.headset.worn, **fields
        )
        self._frame.append(sample)

    # --- phases -------------------------------------------------------------------------------------------------------

    def _look(self, now_ns: int) -> None:
        """Walks the head around the sheet; goes on when the session has accepted an alignment after the last look."""
        spec = self.spec
        if self._viewpoint < spec.viewpoints and self._looks_here >= spec.observations_per_viewpoint:
            self._looks_here = 0
            self._viewpoint += 1
            self._looked_ns = now_ns
        if self._viewpoint < spec.viewpoints:
            self.gaze.look(self._viewpoint, now_ns)
        elif now_ns - self._looked_ns > SETTLE_S * 1e9:
            self._rounds += 1
            alignment = self._alignment()
            if alignment is None or (alignment.version == self._doubted and self._rounds < ROUNDS):
                self._viewpoint = self._looks_here = 0  # look again
                return
            self._look_again = False
            self.report.aligned_s = (now_ns - self.started_ns) / 1e9
            self._judge(now_ns)
            self._enter("watch" if self.observer else "acquire", now_ns)

    def _acquire(self, now_ns: int) -> None:
        if self.robots and self._have_robots():
            self._request = None
            self._enter("work", now_ns)
        elif self._request is None and now_ns >= self._retry_ns:
            number = self.client.submit(Acquire(0, self.robots, wait=True))
            self._request = (self.client.connection.generation, number)
        elif self._request is not None:
            generation, number = self._request
            reply = self.client.answer(number)
            if reply is not None or generation != self.client.connection.generation:
                self._request = None  # answered, or asked on a connection that is gone
                self._retry_ns = now_ns + int(RETRY_S * 1e9)
            if reply is not None:
                self._answered(reply, now_ns)

    def _answered(self, reply: Reply, now_ns: int) -> None:
        """A robot of the policy's choice, or a no: for good, or until the next try."""
        if reply.denial is not None:
            self._refused_because = f"{reply.denial.reason}: {reply.denial.message}; {reply.denial.advice}"
            if reply.denial.reason in FOR_GOOD:
                self.fail(self._refused_because, now_ns)
        elif not self.robots and reply.leases:
            self.robots = (reply.leases[0].target,)
            self.behaviour = behaviour_of(self.spec, self.robots[0])

    def _have_robots(self) -> bool:
        return all(self.client.lease_version(robot) is not None for robot in self.robots)

    def _fall_back(self, now_ns: int) -> None:
        """What was won can be lost: the alignment by a jump, an alarm or a new session, the robot to somebody else."""
        if (self._alignment() is None or self._look_again) and self.report.phase in ("watch", "acquire", "work"):
            self._viewpoint = self._looks_here = self._rounds = 0
            self._look_again = False
            self._enter("look", now_ns)
        elif self.report.phase == "work" and not self._have_robots():
            self._enter("acquire", now_ns)

    def _scheduled(self, now_ns: int) -> None:
        """What was planned for this moment: the tracking frame jumps, the headset comes off and on."""
        elapsed = (now_ns - self._joined_ns) / 1e9
        if self._planned and elapsed >= self._planned[0][0]:
            self.disturb(self._planned.pop(0)[1], now_ns)
        doff, don = self.spec.doff_at_s, self.spec.don_at_s
        worn = not (doff is not None and elapsed >= doff and (don is None or elapsed < don))
        if worn != self.headset.worn:
            self.headset.worn = self.client.worn = worn

    def _enter(self, phase: str, now_ns: int) -> None:
        self.report.phase = phase
        self._phase_ns = now_ns
        self._note_phase(phase, now_ns)

    def _note_phase(self, phase: str, now_ns: int) -> None:
        """Remembers when a phase began first, in seconds since the start."""
        self.report.phases.setdefault(phase, round((now_ns - self.started_ns) / 1e9, 3))

    # --- knowledge ----------------------------------------------------------------------------------------------------

    def _alignment(self) -> Alignment | None:
        """Our alignment, if it is one and of the present tracking frame."""
        alignment = self.client.alignment
        if alignment is None or alignment.kind not in (AlignmentKind.MEASURED, AlignmentKind.PLACED):
            return None
        return alignment if alignment.tracking_epoch == self.headset.tracking_epoch else None

    def _judge(self, now_ns: int) -> None:
        """Compares the alignment in force with the truth."""
        judge(self.report, self._alignment(), self.headset.T_world_tracking(now_ns), self.spec.T_world_anchor[0])

    def _rejected(self) -> dict[str, int]:
        total: dict[str, int] = {}
        for feedback in self.client.feedback.values():
            for reason, count in feedback.rejected.items():
                total[reason] = max(total.get(reason, 0), count)
        return total

    def _on_state(self, state: SceneState) -> None:
        self.report.frames += 1
        self._ages.append(state.age_ns / 1e6)
        self.display.take(state)

    def _on_event(self, event: Event) -> None:
        if isinstance(event.body, Handover):
            self.report.handovers += 1
        elif isinstance(event.body, Notice):
            self._refused_because = event.body.text
        elif isinstance(event.body, AlignmentAlarmed | AlignmentRun):
            self._asked_to_look(event.body)

    def _asked_to_look(self, event: AlignmentAlarmed | AlignmentRun) -> None:
        """A jump voids the alignment, which is seen by itself. A sheet that was moved is for others to put right."""
        alignment = self.client.alignment
        if event.participant != self.client.participant_id or alignment is None:
            return
        alarm = isinstance(event, AlignmentAlarmed)
        if event.running if isinstance(event, AlignmentRun) else event.kind != AlarmKind.JUMP and not event.beside:
            self._look_again, self._doubted = True, alignment.version
            self.report.alarms += alarm
