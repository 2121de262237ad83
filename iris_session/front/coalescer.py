"""What waits for the authority: the newest sample per device, every edge, everything else in order. Bounded. Pure.

A heartbeat and a tracking epoch replace the one before, and so does what the front measured (a proposal, an alarm of
one kind at one anchor, a comparison with one other): only the newest counts. Two samples of one device in a row are
merged into the newer one when nothing but the motion differs. A change of clutch, gripper (open or closed), buttons,
worn, tracked, targets or of any epoch is an edge: both samples stay, so the authority sees every press. Urgent messages
have a lane of their own that is emptied first; a jump of the tracking frame is one of them, for it stops an arm.
"""

from __future__ import annotations

from collections.abc import Hashable

from iris_session.link.config import FrontLimits
from iris_session.protocol.client_messages import Bye, EStop, Heartbeat, RemoveParticipant, Sample, TrackingEpoch
from iris_session.protocol.entries import (
    HOST,
    URGENT,
    AlignmentAlarm,
    AlignmentProposal,
    Audit,
    CrossChecked,
    Entry,
    EntryMessage,
    Join,
    Lost,
)
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import AlarmKind

#: A gripper closed further than this counts as pressed: crossing it is an edge.
GRIPPER_EDGE = 0.5


def _has_edge(old: Entry, new: Entry, a: Sample, b: Sample) -> bool:
    """True when merging sample `a` into `b` would lose more than motion."""
    return (
        a.clutch is not b.clutch
        or a.buttons != b.buttons
        or a.worn is not b.worn
        or a.tracked is not b.tracked
        or a.kind != b.kind
        or a.targets != b.targets
        or b.seq <= a.seq
        or a.scene_epoch != b.scene_epoch
        or a.tracking_epoch != b.tracking_epoch
        or a.alignment_version != b.alignment_version
        or old.connection_epoch != new.connection_epoch
        or (a.gripper is not None and a.gripper > GRIPPER_EDGE)
        is not (b.gripper is not None and b.gripper > GRIPPER_EDGE)
    )


def _replacement_key(message: EntryMessage) -> Hashable:
    """What an entry takes the place of while it waits, `None` for nothing. Names of anchors are the session's own, so
    there are few."""
    if isinstance(message, Heartbeat | TrackingEpoch):
        return type(message)
    if isinstance(message, AlignmentProposal):
        return AlignmentProposal, message.refused
    if isinstance(message, AlignmentAlarm):
        return AlignmentAlarm, message.kind, message.anchor_id
    if isinstance(message, CrossChecked):
        return CrossChecked, message.other
    return None


class _Lane:
    """What waits of one connection. Values are `(arrival number, entry)`."""

    __slots__ = ("messages", "newest", "samples", "urgent")

    def __init__(self) -> None:
        self.urgent: list[tuple[int, Entry]] = []
        self.messages: list[tuple[int, Entry]] = []
        self.samples: dict[str, list[tuple[int, Entry]]] = {}
        self.newest: dict[Hashable, tuple[int, Entry]] = {}  # by what it replaces


class Coalescer:
    """`offer` what came in, `take` a batch for the authority."""

    def __init__(self, limits: FrontLimits, drops: Drops) -> None:
        self._limits = limits
        self._drops = drops
        self._lanes: dict[int, _Lane] = {}
        self._arrivals = 0
        self._next_connection = 0
        self.urgent = False

    def __bool__(self) -> bool:
        return bool(self._lanes)

    def offer(self, entry: Entry) -> bool:
        """Keeps `entry` for the next batch. False: dropped and counted."""
        lane = self._lanes.get(entry.connection)
        if lane is None:
            lane = self._lanes[entry.connection] = _Lane()
        self._arrivals += 1
        item = (self._arrivals, entry)
        message = entry.message
        if isinstance(message, Sample):
            return self._offer_sample(lane, item, message)
        if entry.connection == HOST and isinstance(message, RemoveParticipant):
            return self._offer_removal(lane, item, message)
        if isinstance(message, URGENT):
            return self._offer_urgent(lane, item)
        if isinstance(message, AlignmentAlarm) and message.kind == AlarmKind.JUMP:
            return self._offer_jump(lane, item)
        replaces = _replacement_key(message)
        if replaces is not None:
            lane.newest[replaces] = item
            return True
        if len(lane.messages) >= self._limits.pending_messages:
            lost = "audit_lost" if isinstance(message, Audit) else "messages_pending"
            self._drops.count(lost, entry.connection)
            return False
        lane.messages.append(item)
        return True

    def _offer_sample(self, lane: _Lane, item: tuple[int, Entry], sample: Sample) -> bool:
        waiting = lane.samples.get(sample.device)
        if waiting is None:
            if len(lane.samples) >= self._limits.pending_devices:
                self._drops.count("devices_pending", item[1].connection)
                return False
            lane.samples[sample.device] = [item]
            return True
        old = waiting[-1][1]
        if not _has_edge(old, item[1], old.message, sample):  # type: ignore[arg-type]
            waiting[-1] = item
            return True
        if len(waiting) >= self._limits.pending_samples:
            self._drops.count("samples_pending", item[1].connection)
            if sample.seq > old.message.seq:  # type: ignore[union-attr]
                waiting[-1] = item  # the newest state of the buttons is the one that must get through
            return False
        waiting.append(item)
        return True

    def _offer_urgent(self, lane: _Lane, item: tuple[int, Entry]) -> bool:
        """An e-stop or loss is never dropped for want of room: a second one of the same connection says nothing new."""
        message = item[1].message
        if isinstance(message, Lost) and any(isinstance(e.message, Join) for _, e in lane.messages):
            self.remove_connection(item[1].connection)  # the authority never heard of this connection
            return True
        if isinstance(message, EStop | Lost) and any(type(e.message) is type(message) for _, e in lane.urgent):
            return True
        if len(lane.urgent) >= self._limits.pending_urgent and not isinstance(message, EStop | Lost):
            self._drops.count("urgent_pending", item[1].connection)
            return False
        if not isinstance(message, EStop):
            # A release must not overtake the acquire before it.
            lane.urgent += lane.messages
            lane.messages = []
        if isinstance(message, Lost | Bye):
            lane.samples.clear()
            lane.newest.clear()
        lane.urgent.append(item)
        self.urgent = True
        return True

    def _offer_jump(self, lane: _Lane, item: tuple[int, Entry]) -> bool:
        """Never dropped for want of room: of several the newest voids all that was proposed before."""
        lane.urgent = [one for one in lane.urgent if not isinstance(one[1].message, AlignmentAlarm)]
        lane.urgent.append(item)
        self.urgent = True
        return True

    def _offer_removal(self, lane: _Lane, item: tuple[int, Entry], message: RemoveParticipant) -> bool:
        """Who lost their key is removed whatever else is to be told: never behind a flood of audits, nor for want of
        room, but once. There are no more participants than resume tokens."""
        waiting = [one.message for _, one in lane.urgent]
        if message in waiting:
            return True
        if len(waiting) >= self._limits.resume_tokens:
            self._drops.count("urgent_pending", item[1].connection)
            return False
        lane.urgent.append(item)
        self.urgent = True
        return True

    def take_batch(self, urgent_only: bool = False) -> list[Entry]:
        """The next batch, at most `batch_entries`: urgent entries first, then connections in turn, each in order of
        arrival. What does not fit stays, and its connection comes first the next time."""
        urgent = [item for lane in self._lanes.values() for item in lane.urgent]
        urgent.sort(key=_arrival)
        for lane in self._lanes.values():
            lane.urgent.clear()
        self.urgent = False
        batch = [entry for _, entry in urgent]
        if urgent_only:
            return batch
        order = sorted(self._lanes)
        start = next((i for i, number in enumerate(order) if number >= self._next_connection), 0)
        rest: list[tuple[int, Entry]] = []
        self._next_connection = 0
        for number in order[start:] + order[:start]:
            if rest and len(batch) + len(rest) >= self._limits.batch_entries:
                self._next_connection = number
                break
            rest += self._list_pending(self._lanes.pop(number))
        rest.sort(key=_arrival)
        return batch + [entry for _, entry in rest]

    @staticmethod
    def _list_pending(lane: _Lane) -> list[tuple[int, Entry]]:
        items = lane.messages
        for waiting in lane.samples.values():
            items += waiting
        items += lane.newest.values()
        return items

    def remove_connection(self, connection: int) -> None:
        """The authority is done with a connection, or never heard of it: nothing that waits of it matters any more, but
        that it stops the session."""
        lane = self._lanes.pop(connection, None)
        stops = [] if lane is None else [item for item in lane.urgent if isinstance(item[1].message, EStop)]
        if stops:
            kept = self._lanes[connection] = _Lane()
            kept.urgent = stops


def _arrival(item: tuple[int, Entry]) -> int:
    return item[0]
