"""Live anchors: who saw what, what is proposed, what is alarming, and which headsets disagree.

Owns a desk and a watch per connection, where the anchors are now, and the comparison of headsets. It decides nothing:
entries go to the authority, and what that decides comes back as events (`heard`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Final

from anchors.alignment import AlignmentEstimate
from anchors.drift import Alarm
from anchors.pose import PoseTuple, Vec3, is_rigid
from iris_session.alignment.cross_check import Comparisons
from iris_session.alignment.drift import AlignmentWatch
from iris_session.alignment.estimation import AlignmentDesk
from iris_session.front.connections import ConnectionTable, FrontConnection
from iris_session.link.config import FrontConfig
from iris_session.protocol.client_messages import Observation, Sample
from iris_session.protocol.common import Alignment, Pose
from iris_session.protocol.entries import AlignmentProposal, Entry
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import AlarmKind, AlignmentKind, AnchorKind, SampleKind
from iris_session.protocol.server_messages import (
    AlignmentAlarmed,
    AlignmentChanged,
    AlignmentRun,
    AnchorMoved,
    EventKind,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
)
from iris_session.protocol.status import AlignmentReport

_HEAD: Final = "head"
_COVARIANCE: Final = 36
#: Participants whose alignment is remembered while they are away, per connection that there may be.
_REMEMBERED: Final = 4


#: Proposals whose pivot is remembered: of 13 s, so that corrections that are announced or slide in find theirs.
_PIVOTS: Final = 64


class _Person:
    """What is kept of one connection. Alarms and proposals are stamped so that their order shows in their times.

    `jumped`: tracking epoch and time of the last jump: what was seen before it was seen in another frame, though it may
    come later (sheets are found in pictures that are tenths of a second old). `pivots`: where the covariances of the
    last proposals are stated, oldest first.
    """

    __slots__ = ("alarm_ns", "desk", "jumped", "pivots", "proposal_ns", "watch")

    def __init__(self, desk: AlignmentDesk, watch: AlignmentWatch) -> None:
        self.desk = desk
        self.watch = watch
        self.alarm_ns = self.proposal_ns = -1
        self.pivots: dict[tuple[float, ...], Vec3] = {}
        self.jumped: tuple[int, int] | None = None

    def proposed(self, proposal: AlignmentProposal) -> None:
        self.pivots.pop(proposal.covariance, None)
        self.pivots[proposal.covariance] = proposal.pivot_world
        if len(self.pivots) > _PIVOTS:
            del self.pivots[next(iter(self.pivots))]

    def pivot_of(self, covariance: tuple[float, ...]) -> Vec3 | None:
        """Where this covariance is stated: an `Alignment` does not say it, but it was proposed here. One that slides in
        is wider than what was proposed, and is stated where the newest is."""
        return self.pivots.get(covariance) or next(reversed(self.pivots.values()), None)

    def is_of_before(self, observation: Observation) -> bool:
        """Whether it is of the frame before the last jump."""
        if self.jumped is None or observation.tracking_epoch != self.jumped[0]:
            return False
        return observation.capture_ns < self.jumped[1]


class Anchoring:
    """A `Service`. `offer` takes entries for the authority; false: dropped and counted."""

    def __init__(
        self, config: FrontConfig, clients: ConnectionTable, offer: Callable[[Entry], bool], drops: Drops
    ) -> None:
        self._config = config
        self._clients = clients
        self._offer = offer
        self._drops = drops
        #: `T_world_anchor`, as it is now.
        self.anchors: dict[str, PoseTuple] = {name: (pose.p, pose.q) for name, pose in config.anchors.items()}
        self._people: dict[int, _Person] = {}  # by connection, in the order of their turns
        self._comparisons = Comparisons(self.anchors)
        self._in_force: dict[str, Alignment] = {}  # by participant, also of those who will come back
        self._stopped: dict[str, None] = {}  # participants whose run was stopped

    def __len__(self) -> int:
        return len(self._people)

    # --- from clients ------------------------------------------------------------------------------------------------

    def sampled(self, connection: FrontConnection, sample: Sample, now_ns: int) -> None:
        """Every sample: those of a head are kept, and watched for jumps."""
        if sample.device != _HEAD or sample.pose is None or sample.kind != SampleKind.POSE or not sample.tracked:
            return
        person = self._people.get(connection.number) or self._meet(connection)
        pose = sample.pose
        alarm = person.watch.head((pose.p, pose.q), sample.capture_ns, sample.tracking_epoch)
        if alarm is not None:
            self._alarmed(connection.number, person, alarm, sample.tracking_epoch, now_ns)

    def observed(self, connection: FrontConnection, observation: Observation, now_ns: int) -> None:
        """Every observation: for the watch first, then for the estimate."""
        number = connection.number
        person = self._people.get(number) or self._meet(connection)
        if person.is_of_before(observation):
            self._drops.count("observation_before_jump", number)
            return
        p_tracking_head = self._head_of(person, observation)
        known = observation.anchor_id in self.anchors
        touch, tracked = observation.kind == AnchorKind.TOUCH, observation.kind == AnchorKind.CONTROLLER
        if known and not touch:
            alarm = person.watch.observe(observation, p_tracking_head)
            if alarm is not None:
                self._alarmed(number, person, alarm, observation.tracking_epoch, now_ns)
        used = True
        if known or not tracked:
            used = person.desk.observe(observation, p_tracking_head, now_ns)
        if (known and not touch and used) or (tracked and not known):
            kept = self._see(number, observation, p_tracking_head, now_ns)
            used = kept if not known else used
        if not used:
            self._drops.count("observation_unusable", number)

    def _head_of(self, person: _Person, observation: Observation) -> Vec3 | None:
        if observation.device != _HEAD:
            return None
        T_tracking_head = person.watch.heads.nearest(observation.capture_ns, observation.tracking_epoch)
        return None if T_tracking_head is None else T_tracking_head[0]

    def _see(self, number: int, seen: Observation, p_tracking_head: Vec3 | None, now_ns: int) -> bool:
        pose = seen.T_tracking_anchor
        return self._comparisons.see(
            number,
            seen.anchor_id,
            (pose.p, pose.q),
            p_tracking_head,
            seen.capture_ns,
            seen.tracking_epoch,
            seen.viewpoint_id,
            now_ns,
        )

    def _meet(self, connection: FrontConnection) -> _Person:
        config = self._config
        desk = AlignmentDesk(self.anchors, config.proposal_period_ns, config.anchor_sizes)
        person = self._people[connection.number] = _Person(desk, AlignmentWatch(self.anchors))
        desk.running = connection.participant_id not in self._stopped
        self._put_in_force(person, self._in_force.get(connection.participant_id))
        return person

    def _alarmed(self, number: int, person: _Person, alarm: Alarm, tracking_epoch: int, now_ns: int) -> None:
        """Tells, and forgets what holds no more: of the sheet that was moved, else of the headset."""
        if alarm.kind == AlarmKind.JUMP:
            person.jumped = (tracking_epoch, min(alarm.capture_ns, now_ns))
        told = person.watch.told(alarm, now_ns)
        if told is None:
            self._drops.count("alarms_repeated", number)
        else:
            person.alarm_ns = max(now_ns, person.proposal_ns)  # no proposal made before is later
            self._offer(Entry(number, number, person.alarm_ns, told))
        if alarm.beside:
            self._comparisons.forget_thing(alarm.anchor_id)
            return
        person.desk.start_anew()
        person.watch.known_wrong()
        self._comparisons.forget_looks(number)

    def forget(self, number: int) -> None:
        """The connection is gone."""
        self._people.pop(number, None)
        self._comparisons.forget(number)

    # --- from the authority ------------------------------------------------------------------------------------------

    def heard(self, event: EventKind) -> None:
        """Every event, as clients get it."""
        if isinstance(event, AlignmentChanged):
            self._changed(event.participant, event.alignment)
        elif isinstance(event, AlignmentAlarmed):
            if event.kind == AlarmKind.JUMP:
                self._changed(event.participant, None)
        elif isinstance(event, ParticipantJoined | ParticipantChanged):
            if event.participant.alignment is None:
                self._changed(event.participant.id, None)
        elif isinstance(event, AlignmentRun):
            self._ran(event)
        elif isinstance(event, AnchorMoved):
            self._moved(event.anchor_id, event.T_world_anchor)
        elif isinstance(event, ParticipantLeft) and not event.grace:
            self._in_force.pop(event.participant, None)
            self._stopped.pop(event.participant, None)

    def shown(self, participants: Iterable[ParticipantInfo]) -> None:
        """A snapshot: a front that was started anew has heard no events."""
        for one in participants:
            if one.alignment is not None and one.id not in self._in_force:
                self._changed(one.id, one.alignment)

    def _changed(self, participant: str, alignment: Alignment | None) -> None:
        self._in_force.pop(participant, None)
        if alignment is not None:
            self._in_force[participant] = alignment
            _bounded(self._in_force, _REMEMBERED * self._config.limits.connections)
        for person in self._of(participant):
            self._put_in_force(person, alignment)

    def _put_in_force(self, person: _Person, alignment: Alignment | None) -> None:
        measured = alignment is not None and alignment.kind == AlignmentKind.MEASURED and not alignment.offset
        person.watch.put_in_force(self._in_force_of(person, alignment), measured, person.desk.running)

    def _in_force_of(self, person: _Person, alignment: Alignment | None) -> AlignmentEstimate | None:
        """As the estimators write it. `None`: nothing, or nobody knows how far it may be off."""
        if alignment is None or len(alignment.covariance) != _COVARIANCE or not self.anchors:
            return None
        pivot_world = person.pivot_of(alignment.covariance)
        if pivot_world is None:  # a front that was started anew
            pivot_world = next(iter(self.anchors.values()))[0]
        pose = alignment.T_world_tracking
        return AlignmentEstimate(
            (pose.p, pose.q),
            alignment.tracking_epoch,
            alignment.covariance,
            pivot_world,
            alignment.error_at_anchor_m,
            residual_tilt_rad=0.0,
            n_observations=0,
            n_viewpoints=0,
            refused=False,
            advice="",
        )

    def _ran(self, run: AlignmentRun) -> None:
        self._stopped.pop(run.participant, None)
        if not run.running:
            self._stopped[run.participant] = None
            _bounded(self._stopped, _REMEMBERED * self._config.limits.connections)
        for person in self._of(run.participant):
            if run.running:
                person.desk.begin()
                person.watch.begin()
            else:
                person.desk.running = False

    def _moved(self, anchor_id: str, T_world_anchor: Pose) -> None:
        pose = (T_world_anchor.p, T_world_anchor.q)
        if not is_rigid(pose):
            return
        self.anchors[anchor_id] = pose
        self._comparisons.forget_thing(anchor_id)
        for person in self._people.values():
            person.desk.anchors_moved()
            person.watch.anchor_moved(anchor_id)

    def _of(self, participant: str) -> list[_Person]:
        numbers = [c.number for c in self._clients.by_number.values() if c.participant_id == participant]
        return [self._people[number] for number in numbers if number in self._people]

    # --- now and then ------------------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """At most one estimate or comparison: either takes up to milliseconds, and state waits meanwhile."""
        for number, person in self._people.items():
            if person.desk.due(now_ns):
                self._people[number] = self._people.pop(number)  # whoever had a turn is the last to have another
                self._propose(number, person, now_ns)
                return
        in_force = {n: p.watch.in_force for n, p in self._people.items() if p.watch.in_force is not None}
        entry = self._comparisons.turn(in_force, now_ns)
        if entry is not None:
            self._offer(entry)

    def _propose(self, number: int, person: _Person, now_ns: int) -> None:
        proposal = person.desk.propose(now_ns)
        if proposal is None:
            return
        if person.desk.newest is not None and not proposal.refused:
            person.watch.estimated(person.desk.newest)
            person.proposed(proposal)
        person.proposal_ns = max(now_ns, person.alarm_ns + 1)
        self._offer(Entry(number, number, person.proposal_ns, proposal))

    def close(self) -> None:
        """Nothing was opened."""

    def report(self, number: int, half: AlignmentReport | None, now_ns: int) -> AlignmentReport | None:
        """The authority's half of a participant's report with ours."""
        person = self._people.get(number)
        return half if person is None else person.desk.report(half, now_ns)


def _bounded(memory: dict[str, Alignment] | dict[str, None], most: int) -> None:
    while len(memory) > most:
        del memory[next(iter(memory))]
