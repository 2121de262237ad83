"""A simulated room for `bench alignment --worlds`: headsets, the live alignment service and the real authority.

Simulated time. What a headset reports (`alignment_sources`) goes to `AlignmentService` as the front gives it, its
entries go to `Authority`, whose events come back. `Room.probe` asks at one moment what matters: would this wearer's
hand move a robot now (it opens and closes the clutch), how far off is what the wearer sees, and what is stated.
"""

from __future__ import annotations

import heapq
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import msgspec
import numpy as np

from anchors.lie import Array, quat_conjugate, quat_multiply, quat_to_matrix, to_vec3
from anchors.pose import IDENTITY_QUAT, PoseTuple, Vec3, compose, quat_from_yaw
from anchors.uncertainty import covariance_at_point, length_p95
from iris_session.alignment.service import AlignmentService
from iris_session.authority import Authority, AuthorityConfig
from iris_session.bench.alignment_sources import SHEET_M, HeadsetMotion, SheetSource, to_array_pose
from iris_session.protocol.client_messages import Acquire, Observation, Sample
from iris_session.protocol.common import Alignment, Pose, Target
from iris_session.protocol.entries import Entry, EntryMessage, Join
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import AlarmKind, AnchorKind, CommandKind, Device
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentChanged,
    Notice,
    ParticipantChanged,
    ParticipantJoined,
    Reply,
)
from iris_session.protocol.specs import RobotSpec
from iris_session.protocol.steps import FixedView

MS: Final = 1_000_000
SECOND: Final = 1_000_000_000
#: Head poses per second while a wearer looks (half of what a headset sends), and while it walks about.
HEAD_HZ: Final = 36.0
PAUSE_HEAD_HZ: Final = 2.5
LONG_PAUSE_HEAD_HZ: Final = 1.0
#: The authority steps at least so often, and gets a head pose in so many.
STEP_NS: Final = 500 * MS
HEADS_PER_SAMPLE: Final = 8
WALK_S: Final = 3.0
#: Without head poses, as a wearer turns to something else: paths need not join, and longer gaps than 0.5 s are no jump.
TURN_NS: Final = 600 * MS
#: Time after which a wearer does what a notice advises; assumed.
REACTION_S: Final = 2.0
#: Between two estimates of a headset: twice that of a session, to save time.
PROPOSAL_NS: Final = 400 * MS
#: What a wearer understands as "look at a sheet".
LOOK: Final = re.compile(r"\b(look|glance)\b")
#: Nothing here disconnects, and time passes in larger steps than in a session.
CONFIG: Final = AuthorityConfig(
    gap_ns=3600 * SECOND, heartbeat_timeout_ns=36_000 * SECOND, freshness_ns=2 * SECOND, future_ns=SECOND
)


class ProbeResult(NamedTuple):
    """One headset, or a pair, at one probe: errors and stated p95 [m] by point, both empty without an alignment."""

    who: tuple[int, ...]
    is_allowed: bool
    is_told: bool
    errors: tuple[float, ...] = ()
    stated: tuple[float, ...] = ()

    @property
    def ratio(self) -> float:
        """Largest error of any point over its stated p95."""
        return max((e / max(s, 1e-9) for e, s in zip(self.errors, self.stated, strict=True)), default=0.0)


@dataclass
class Wearer:
    """A wearer as the product sees it.

    `notices`: those that it has not acted on yet; `sheets`: prints that lie elsewhere for it than for the room.
    """

    room: Room
    number: int
    motion: HeadsetMotion
    participant_id: str = ""
    lease_version: int = 0
    alignment: Alignment | None = None
    is_told: bool = False
    false_alarms: int = 0
    notices: list[str] = field(default_factory=list)
    viewpoint: int = 0
    sheets: dict[str, tuple[Array, Array]] = field(default_factory=dict)
    _seq: int = 0
    _last_sheet: str = ""
    _walked: float = 0.0

    @property
    def robot(self) -> str:
        return f"robot{self.number}"

    # --- what wearers do: generators of the time at which each goes on ---

    def look(self, name: str, seconds: float = 0.0, **how: Any) -> Iterator[int]:
        """Look at a sheet from a new place. `seconds`: default 2, or six poses of a slow source."""
        room, source = self.room, self.motion.source
        seconds = seconds or max(2.0, 6.0 / source.hz)
        how.setdefault("print_scale", room.print_scale.get(name, 0.0))
        yield room.now_ns + TURN_NS
        sheet = self.sheets.get(name) or room.sheets[name]
        found = self.motion.look(name, sheet, room.now_s, seconds, head_hz=HEAD_HZ, **how)
        self._last_sheet = name
        self.viewpoint += 1
        events = [(t, "", T) for t, T in zip(found.head_s, found.heads, strict=True)]
        events += [(t, name, T) for t, T in zip(found.seen_s, found.poses, strict=True)]
        for i, (t, seen, T) in enumerate(sorted(events, key=lambda one: one[:2])):  # a head pose before what it saw
            yield round(t * SECOND)
            if seen:
                self.report_sheet(seen, T)
            else:
                self.report_head(T, to_authority=i % HEADS_PER_SAMPLE == 0)

    def survey(self, names: Iterable[str], viewpoints: int = 3, **how: Any) -> Iterator[int]:
        """Look at sheets, one after the other, each from several places."""
        for name in names:
            for _ in range(viewpoints):
                yield from self.look(name, **how)
                yield from self.pause(WALK_S)

    def pause(self, seconds: float, *, heeds: bool = False) -> Iterator[int]:
        """Walk about and look at no sheet; `heeds`: glance at one when a notice asks for it."""
        room = self.room
        end_s = room.now_s + seconds
        hz = PAUSE_HEAD_HZ if seconds <= 30.0 else LONG_PAUSE_HEAD_HZ
        yield room.now_ns + TURN_NS
        while room.now_s + 1.0 / hz <= end_s:
            yield round((room.now_s + 1.0 / hz) * SECOND)
            self.report_head(self.walk(1.0 / hz), to_authority=True)
            asked = [text for text in self.notices if LOOK.search(text)]
            self.notices.clear()
            if heeds and asked:
                yield round((room.now_s + REACTION_S) * SECOND)
                named = [name for name in room.anchors if any(f"'{name}'" in text for text in asked)]
                yield from self.look((named or [self._last_sheet or next(iter(room.anchors))])[0])
                self.notices.clear()
                yield room.now_ns + TURN_NS
        yield round(max(end_s, room.now_s) * SECOND)

    def walk(self, seconds: float) -> PoseTuple:
        """Return the next `T_tracking_head` on a circle of 1.5 m about the origin, at 0.3 m/s (assumed)."""
        self._walked += 0.3 * seconds / 1.5
        p = (1.5 * math.cos(self._walked), 1.5 * math.sin(self._walked), 1.6)
        return self.motion.place(self.room.now_s, (p, quat_from_yaw(self._walked + 0.5 * math.pi)))

    def repeat_last(self, name: str, seconds: float, hz: float) -> Iterator[int]:
        """Let the source repeat its last pose of a sheet while its wearer looks elsewhere."""
        room = self.room
        end_s = room.now_s + seconds
        yield room.now_ns + TURN_NS
        while room.now_s < end_s:
            yield round((room.now_s + 1.0 / hz) * SECOND)
            self.report_head(self.walk(1.0 / hz), to_authority=True)
            self.report_sheet(name, self.motion.last[name])

    # --- messages ---

    def say(self, message: EntryMessage) -> None:
        self.room.entries.append(Entry(self.number, self.number, self.room.now_ns, message))

    def report_head(self, T_tracking_head: PoseTuple, *, to_authority: bool = False) -> None:
        sample = self.build_sample(Device.HEAD, T_tracking_head)
        self.room.service.process_sample(self, sample, self.room.now_ns)
        if to_authority:
            self.say(sample)

    def report_sheet(self, name: str, T_tracking_sheet: PoseTuple, kind: str = AnchorKind.QR, **fields: Any) -> None:
        """Send one observation, with the number of the viewpoint that the source gives it."""
        way = self.motion.source.viewpoints
        if way == "each":
            self.viewpoint += 1
        viewpoint = 0 if way == "zero" else self.viewpoint
        at_ns = self.room.now_ns
        if kind == AnchorKind.QR:
            fields["source"] = self.motion.source.reported_as
        observation = Observation(name, kind, Pose(*T_tracking_sheet), at_ns, 0, viewpoint, **fields)
        self.room.service.process_observation(self, observation, at_ns)

    def build_sample(self, device: str, pose: PoseTuple, **fields: Any) -> Sample:
        self._seq += 1
        version = 0 if self.alignment is None else self.alignment.version
        now_ns = self.room.now_ns
        return Sample(device, "pose", self._seq, now_ns, 1, 0, version, pose=Pose(*pose), **fields)


class Room:
    """One session with two headsets. `sheets`: true poses; `anchors`: configured ones."""

    def __init__(
        self,
        rng: np.random.Generator,
        anchors: Mapping[str, PoseTuple],
        source: SheetSource,
        *,
        drift_m_per_min: float,
        marks: Mapping[str, Mapping[str, Vec3]],
    ) -> None:
        """Create a room with robots 1 m from the middle of the anchors; everything random comes from `rng`."""
        self.rng = rng
        self.anchors = dict(anchors)
        self.sheets = {name: to_array_pose(T) for name, T in anchors.items()}
        self.print_scale: dict[str, float] = {}
        self.now_ns = SECOND
        self.entries: list[Entry] = []
        self.findings: list[tuple[str, ProbeResult]] = []
        self.has_cause = False
        self.is_absolute = True  # the world is where the configured sheets are
        self.quiet_hours = 0.0  # headset hours without a cause for an alarm
        poses = {name: Pose(*T) for name, T in anchors.items()}
        self.service = AlignmentService(
            self._offer,
            Drops(),
            anchors=poses,
            anchor_sizes=dict.fromkeys(anchors, SHEET_M),
            anchor_marks=marks,
            proposal_period_ns=PROPOSAL_NS,
        )
        centre = np.mean([p for p, _ in self.sheets.values()], axis=0)
        turn = rng.uniform(-math.pi, math.pi)
        way = np.array([math.cos(turn), math.sin(turn), 0.0])
        self.points = (self.sheets[next(iter(anchors))][0], centre + way, centre + 2.0 * way)
        names = ["robot1", "robot2"]
        tip = Pose(to_vec3(centre + way), IDENTITY_QUAT)
        self._view = FixedView(tips=dict.fromkeys(names, tip), q=dict.fromkeys(names, (0.0,)))
        robots = [RobotSpec(n, (f"{n}/j",), (f"{n}/j",), f"{n}/tcp", f"{n}/base") for n in names]
        self.authority = Authority(msgspec.structs.replace(CONFIG, anchors=poses), robots, ())
        self._stepped_ns = 0
        self.people = [Wearer(self, i + 1, HeadsetMotion(rng, source, drift_m_per_min)) for i in range(len(names))]
        for p in self.people:
            p.say(Join(f"key{p.number}", "operator", f"person{p.number}"))
        self.step()
        for p in self.people:
            p.say(Acquire(p.number, (p.robot,)))
        self.step()

    @property
    def now_s(self) -> float:
        return self.now_ns / SECOND

    def _offer(self, entry: Entry) -> bool:
        self.entries.append(entry)
        return True

    # --- time ---

    def run(self, runs: Iterable[Iterator[int]]) -> None:
        """Let wearers do what they do, beside each other, until all are done."""
        start_ns = self.now_ns
        waiting = [(at_ns, i, run) for i, run in enumerate(runs) if (at_ns := next(run, -1)) >= 0]
        heapq.heapify(waiting)
        while waiting:
            at_ns, i, run = heapq.heappop(waiting)
            self._advance(max(at_ns, self.now_ns))
            following = next(run, -1)
            if following >= 0:
                heapq.heappush(waiting, (following, i, run))
            self.service.tick(self.now_ns)
            if self.entries:
                self.step()
        self._advance(self.now_ns + MS)
        if not self.has_cause:
            self.quiet_hours += len(self.people) * (self.now_ns - start_ns) / SECOND / 3600.0

    def _advance(self, to_ns: int) -> None:
        while to_ns - self._stepped_ns > STEP_NS:
            self.now_ns = max(self.now_ns, self._stepped_ns + STEP_NS)
            self.service.tick(self.now_ns)
            self.step()
        self.now_ns = to_ns

    def step(self) -> None:
        """Give what waits to the authority, and its events to everybody."""
        entries, self.entries = self.entries, []
        decision = self.authority.step(self.now_ns, entries, 1, self._view)
        self._stepped_ns = self.now_ns
        by_number = {p.number: p for p in self.people}
        for admitted in decision.admitted:
            by_number[admitted.connection].participant_id = admitted.participant_id
        for out in decision.outgoing:
            if isinstance(out.message, Reply) and out.message.leases:
                by_number[out.connection].lease_version = out.message.leases[0].lease_version
        by_id = {p.participant_id: p for p in self.people}
        for event in decision.events:
            body = event.body
            self.service.process_event(body)
            if isinstance(body, AlignmentChanged):
                by_id[body.participant].alignment = body.alignment
            elif isinstance(body, ParticipantJoined | ParticipantChanged):
                if body.participant.id in by_id:
                    by_id[body.participant.id].alignment = body.participant.alignment
            elif isinstance(body, Notice) and body.participant in by_id:
                by_id[body.participant].notices.append(body.text)
                by_id[body.participant].is_told |= self.has_cause and body.level == "warning"
            elif isinstance(body, AlignmentAlarmed):
                p = by_id[body.participant]
                p.is_told |= self.has_cause
                p.false_alarms += not self.has_cause
                if body.kind == AlarmKind.JUMP:
                    p.alignment = None
        self.commands = {c.robot: c for c in decision.commands}

    def mark_cause(self) -> None:
        """Note that there is a reason from now on: alarms are no longer false, and wearers are to be warned."""
        self.has_cause = True

    # --- what matters ---

    def probe(self, label: str = "") -> None:
        """Record what each headset and each pair would do and see now."""
        allowed = {p.number: self._try_clutch(p) for p in self.people}
        groups = [[p] for p in self.people] if self.is_absolute else []
        self.findings += [(label, self._probe(group, allowed)) for group in [*groups, self.people]]

    def _probe(self, group: Sequence[Wearer], allowed: Mapping[int, bool]) -> ProbeResult:
        """Return how far from the truth one headset places the points, or from each other a pair does."""
        who = tuple(p.number for p in group)
        is_allowed = all(allowed[number] for number in who)
        is_told = not is_allowed or any(p.is_told for p in group)
        if any(p.alignment is None for p in group):
            return ProbeResult(who, is_allowed, is_told)
        errors, stated = [], []
        for X in self.points:
            first, *others = (self.compute_offset(p, X) for p in group)
            errors.append(float(np.linalg.norm(first - sum(others))))
            stated.append(length_p95(sum((self.state_covariance(p, X) for p in group), np.zeros((3, 3)))))
        return ProbeResult(who, is_allowed, is_told, tuple(errors), tuple(stated))

    def compute_offset(self, p: Wearer, X: Array) -> Array:
        """Return by how much this headset displays the point X of the world elsewhere [m]."""
        assert p.alignment is not None
        true_p, true_q = p.motion.T_world_tracking(self.now_s)
        T = p.alignment.T_world_tracking
        q = quat_multiply(np.array(T.q), quat_conjugate(true_q))
        R = quat_to_matrix(q)
        return np.asarray(R @ (X - true_p) + np.array(T.p) - X)

    def state_covariance(self, p: Wearer, X: Array) -> Array:
        """Return the stated covariance (3, 3) at a point: of the alignment in force, as clients know it."""
        assert p.alignment is not None
        return covariance_at_point(p.alignment.covariance, p.alignment.pivot_world, to_vec3(X))

    def _try_clutch(self, p: Wearer) -> bool:
        """Return whether a hand that closes its clutch now would move the robot."""
        at = to_vec3(self.points[1] + np.array([0.0, 0.0, 0.2]))  # near the robot
        pose = p.motion.place(self.now_s, (at, IDENTITY_QUAT))
        is_engaged = False
        for i, clutch in enumerate((False, True, False)):
            self._advance(self.now_ns + 20 * MS)
            moved = compose(pose, ((0.0003 * i, 0.0, 0.0), IDENTITY_QUAT))
            target = Target(p.robot, p.lease_version)
            p.say(p.build_sample(Device.CONTROLLER_RIGHT, moved, targets=(target,), clutch=clutch))
            self.step()
            is_engaged |= clutch and self.commands[p.robot].kind != CommandKind.HOLD
        return is_engaged
