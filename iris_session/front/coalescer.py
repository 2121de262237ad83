"""Entries pending for the authority: the newest sample per device, every edge, all else in order. Bounded and pure.

A heartbeat and a tracking epoch replace the one before, and so do the front's measurements (a proposal, an alarm of
one kind at one anchor, a cross-check with one other headset): only the newest counts. Two successive samples of one
device are merged into the newer one when nothing but the motion differs. A change of clutch, gripper (open or closed),
buttons, worn, tracked, targets or of any epoch is an edge: both samples stay, so the authority sees every press. Urgent
messages have a queue of their own that is sent first; a jump of the tracking frame is one of them, for it stops an arm.
"""

from __future__ import annotations

from collections.abc import Hashable
from operator import itemgetter

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
    TipSolved,
)
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import AlarmKind

#: A gripper closed further than this counts as pressed: crossing it is an edge.
GRIPPER_EDGE = 0.5


def _has_edge(old: Entry, new: Entry, a: Sample, b: Sample) -> bool:
    """Return whether merging sample `a` into `b` would lose more than motion."""
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
    """Return the key under which a pending entry replaces the one before, `None` if it replaces none.

    Anchor names are the session's own, and a tip is solved twice a second at most, so the keys are few.
    """
    if isinstance(message, Heartbeat | TrackingEpoch):
        return type(message)
    if isinstance(message, AlignmentProposal):
        return AlignmentProposal, message.refused
    if isinstance(message, AlignmentAlarm):
        return AlignmentAlarm, message.kind, message.anchor_id
    if isinstance(message, TipSolved):
        return TipSolved, message.device
    if isinstance(message, CrossChecked):
        return CrossChecked, message.other
    return None


class _ConnectionQueue:
    """Pending entries of one connection. Values are `(arrival number, entry)`."""

    __slots__ = ("messages", "newest", "samples", "urgent")

    def __init__(self) -> None:
        self.urgent: list[tuple[int, Entry]] = []
        self.messages: list[tuple[int, Entry]] = []
        self.samples: dict[str, list[tuple[int, Entry]]] = {}
        self.newest: dict[Hashable, tuple[int, Entry]] = {}  # by replacement key


class Coalescer:
    """Queue entries with `offer`, and send them in batches from `take_batch`.

    Attributes:
        urgent: An urgent entry is pending.
    """

    def __init__(self, limits: FrontLimits, drops: Drops) -> None:
        self._limits = limits
        self._drops = drops
        self._queues: dict[int, _ConnectionQueue] = {}
        self._arrivals = 0
        self._next_connection = 0
        self.urgent = False

    def __bool__(self) -> bool:
        return bool(self._queues)

    def offer(self, entry: Entry) -> bool:
        """Queue an entry for the next batch. Return false if it was dropped and counted."""
        queue = self._queues.get(entry.connection)
        if queue is None:
            queue = self._queues[entry.connection] = _ConnectionQueue()
        self._arrivals += 1
        item = (self._arrivals, entry)
        message = entry.message
        if isinstance(message, Sample):
            return self._offer_sample(queue, item, message)
        if entry.connection == HOST and isinstance(message, RemoveParticipant):
            return self._offer_removal(queue, item, message)
        if isinstance(message, URGENT):
            return self._offer_urgent(queue, item)
        if isinstance(message, AlignmentAlarm) and message.kind == AlarmKind.JUMP:
            return self._offer_jump(queue, item)
        replaces = _replacement_key(message)
        if replaces is not None:
            queue.newest[replaces] = item
            return True
        if len(queue.messages) >= self._limits.pending_messages:
            lost = "audit_lost" if isinstance(message, Audit) else "messages_pending"
            self._drops.count(lost, entry.connection)
            return False
        queue.messages.append(item)
        return True

    def _offer_sample(self, queue: _ConnectionQueue, item: tuple[int, Entry], sample: Sample) -> bool:
        pending = queue.samples.get(sample.device)
        if pending is None:
            if len(queue.samples) >= self._limits.pending_devices:
                self._drops.count("devices_pending", item[1].connection)
                return False
            queue.samples[sample.device] = [item]
            return True
        old = pending[-1][1]
        if not _has_edge(old, item[1], old.message, sample):  # type: ignore[arg-type]
            pending[-1] = item
            return True
        if len(pending) >= self._limits.pending_samples:
            self._drops.count("samples_pending", item[1].connection)
            if sample.seq > old.message.seq:  # type: ignore[union-attr]
                pending[-1] = item  # the newest state of the buttons must get through
            return False
        pending.append(item)
        return True

    def _offer_urgent(self, queue: _ConnectionQueue, item: tuple[int, Entry]) -> bool:
        """Queue an urgent entry. An e-stop or loss is never dropped: a second one of a connection adds nothing."""
        message = item[1].message
        if isinstance(message, Lost) and any(isinstance(e.message, Join) for _, e in queue.messages):
            self.remove_connection(item[1].connection)  # the authority never heard of this connection
            return True
        if isinstance(message, EStop | Lost) and any(type(e.message) is type(message) for _, e in queue.urgent):
            return True
        if len(queue.urgent) >= self._limits.pending_urgent and not isinstance(message, EStop | Lost):
            self._drops.count("urgent_pending", item[1].connection)
            return False
        if not isinstance(message, EStop):
            # A release must not overtake the acquire before it.
            queue.urgent += queue.messages
            queue.messages = []
        if isinstance(message, Lost | Bye):
            queue.samples.clear()
            queue.newest.clear()
        queue.urgent.append(item)
        self.urgent = True
        return True

    def _offer_jump(self, queue: _ConnectionQueue, item: tuple[int, Entry]) -> bool:
        """Queue a jump. It is never dropped: of several the newest voids all earlier proposals."""
        queue.urgent = [one for one in queue.urgent if not isinstance(one[1].message, AlignmentAlarm)]
        queue.urgent.append(item)
        self.urgent = True
        return True

    def _offer_removal(self, queue: _ConnectionQueue, item: tuple[int, Entry], message: RemoveParticipant) -> bool:
        """Queue the removal of a participant whose key was revoked, once. It is neither delayed nor dropped because of
        many audit entries. There are no more participants than resume tokens."""
        pending = [one.message for _, one in queue.urgent]
        if message in pending:
            return True
        if len(pending) >= self._limits.resume_tokens:
            self._drops.count("urgent_pending", item[1].connection)
            return False
        queue.urgent.append(item)
        self.urgent = True
        return True

    def take_batch(self, urgent_only: bool = False) -> list[Entry]:
        """Return the next batch of at most `batch_entries`: urgent entries first, then one connection after the other,
        each in order of arrival. The connection that does not fit comes first in the next batch."""
        urgent = [item for queue in self._queues.values() for item in queue.urgent]
        urgent.sort(key=itemgetter(0))
        for queue in self._queues.values():
            queue.urgent.clear()
        self.urgent = False
        batch = [entry for _, entry in urgent]
        if urgent_only:
            return batch
        order = sorted(self._queues)
        start = next((i for i, number in enumerate(order) if number >= self._next_connection), 0)
        rest: list[tuple[int, Entry]] = []
        self._next_connection = 0
        for number in order[start:] + order[:start]:
            if rest and len(batch) + len(rest) >= self._limits.batch_entries:
                self._next_connection = number
                break
            queue = self._queues.pop(number)
            rest += queue.messages
            for pending in queue.samples.values():
                rest += pending
            rest += queue.newest.values()
        rest.sort(key=itemgetter(0))
        return batch + [entry for _, entry in rest]

    def remove_connection(self, connection: int) -> None:
        """Remove pending entries of a connection that the authority has ended, or never knew, except an e-stop."""
        queue = self._queues.pop(connection, None)
        stops = [] if queue is None else [item for item in queue.urgent if isinstance(item[1].message, EStop)]
        if stops:
            kept = self._queues[connection] = _ConnectionQueue()
            kept.urgent = stops
