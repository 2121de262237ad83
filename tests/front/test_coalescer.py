"""Coalescing: newest pose, every edge, urgent first, bounded."""

from __future__ import annotations

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from iris_session.front.coalescer import Coalescer
from iris_session.link.config import FrontLimits
from iris_session.protocol.client_messages import (
    Acquire,
    EStop,
    Heartbeat,
    Marker,
    Release,
    RemoveParticipant,
    Sample,
    TrackingEpoch,
)
from iris_session.protocol.common import IDENTITY, Target
from iris_session.protocol.entries import (
    HOST,
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

SAMPLE = Sample("controller/right", "pose", 1, 0, 1, 0, 1, pose=IDENTITY, targets=(Target("left", 1),))


def entry(message: EntryMessage, connection: int = 1, epoch: int | None = None) -> Entry:
    return Entry(connection, connection if epoch is None else epoch, 0, message)


def sample(seq: int, **changes: object) -> Sample:
    return msgspec.structs.replace(SAMPLE, seq=seq, **changes)


def coalescer(**limits: int) -> tuple[Coalescer, Drops]:
    drops = Drops()
    return Coalescer(FrontLimits(**limits), drops), drops


def seqs(batch: list[Entry]) -> list[int]:
    return [e.message.seq for e in batch if isinstance(e.message, Sample)]


def test_only_the_newest_pose_of_a_device_is_pending() -> None:
    waiting, _ = coalescer()
    for seq in (1, 2, 3):
        waiting.offer(entry(sample(seq)))
    waiting.offer(entry(sample(9, device="head")))
    assert seqs(waiting.take_batch()) == [3, 9]
    assert waiting.take_batch() == []


@pytest.mark.parametrize(
    "change",
    [
        {"clutch": True},
        {"buttons": 1},
        {"worn": False},
        {"tracked": False},
        {"gripper": 0.9},
        {"scene_epoch": 2},
        {"tracking_epoch": 2},
        {"alignment_version": 2},
        {"targets": (Target("left", 2),)},
        {"kind": "twist"},
    ],
)
def test_every_edge_is_kept(change: dict[str, object]) -> None:
    waiting, _ = coalescer()
    waiting.offer(entry(sample(1)))
    waiting.offer(entry(sample(2, **change)))
    waiting.offer(entry(sample(3)))
    waiting.offer(entry(sample(4)))
    assert seqs(waiting.take_batch()) == [1, 2, 4]


def test_old_sequence_numbers_and_forged_epochs_replace_nothing() -> None:
    waiting, _ = coalescer()
    waiting.offer(entry(sample(5)))
    waiting.offer(entry(sample(4)))
    waiting.offer(entry(sample(6), epoch=99))
    assert seqs(waiting.take_batch()) == [5, 4, 6]


def test_urgent_comes_first_and_alone_when_credit_is_short() -> None:
    waiting, _ = coalescer()
    waiting.offer(entry(sample(1), connection=2))
    waiting.offer(entry(Marker(1, "x"), connection=2))
    waiting.offer(entry(EStop("stop")))
    assert waiting.urgent
    assert [type(e.message) for e in waiting.take_batch(urgent_only=True)] == [EStop]
    assert not waiting.urgent
    assert [type(e.message) for e in waiting.take_batch()] == [Sample, Marker]


def test_release_overtakes_no_acquire_of_its_own() -> None:
    waiting, _ = coalescer()
    waiting.offer(entry(Acquire(1, ("left",))))
    waiting.offer(entry(Release(2)))
    assert [type(e.message) for e in waiting.take_batch(urgent_only=True)] == [Acquire, Release]


def test_disconnect_follows_pending_messages_and_drops_samples() -> None:
    waiting, _ = coalescer()
    waiting.offer(entry(Marker(1, "x")))
    waiting.offer(entry(sample(1)))
    waiting.offer(entry(Heartbeat()))
    waiting.offer(entry(Lost("closed")))
    assert [type(e.message) for e in waiting.take_batch()] == [Marker, Lost]


def test_connection_that_ends_before_its_join_was_sent_leaves_no_entry() -> None:
    waiting, _ = coalescer()
    waiting.offer(entry(Join("key", "operator", "Ann")))
    waiting.offer(entry(Lost("closed")))
    assert not waiting
    assert waiting.take_batch() == []


@pytest.mark.parametrize("how", ["lost before it was let in", "let go by the authority"])
def test_estop_is_sent_although_its_sender_disconnected(how: str) -> None:
    """The headset is switched off after the button, or was disconnected as silent at that moment."""
    waiting, _ = coalescer()
    if how == "lost before it was let in":
        waiting.offer(entry(Join("key", "operator", "Ann")))
    else:
        waiting.offer(entry(Release(1)))
    waiting.offer(entry(EStop()))
    waiting.offer(entry(sample(1)))
    if how == "lost before it was let in":
        waiting.offer(entry(Lost("closed")))
    else:
        waiting.remove_connection(1)
    assert waiting.urgent
    assert [type(e.message) for e in waiting.take_batch()] == [EStop]
    assert not waiting


def test_estop_always_has_room_and_is_sent_once() -> None:
    waiting, drops = coalescer(pending_urgent=2)
    for _ in range(5):
        waiting.offer(entry(Release(1)))
    for _ in range(100):
        waiting.offer(entry(EStop()))
    batch = waiting.take_batch()
    assert [type(e.message) for e in batch] == [Release, Release, EStop]
    assert drops.by_reason == {"urgent_pending": 3}


def test_drops_are_counted_and_the_last_state_is_kept() -> None:
    waiting, drops = coalescer(pending_messages=2, pending_samples=3, pending_devices=2)
    for i in range(4):
        waiting.offer(entry(Marker(i, "x")))
    for seq in range(1, 9):
        waiting.offer(entry(sample(seq, clutch=seq % 2 == 1)))
    waiting.offer(entry(sample(1, device="head")))
    waiting.offer(entry(sample(1, device="hand/left")))
    assert drops.by_reason == {"messages_pending": 2, "samples_pending": 5, "devices_pending": 1}
    assert drops.by_connection == {1: 8}
    assert seqs(waiting.take_batch()) == [1, 2, 8, 1]


def test_full_batch_leaves_entries_for_the_next() -> None:
    waiting, _ = coalescer(batch_entries=4)
    for connection in (1, 2, 3):
        for i in range(3):
            waiting.offer(entry(Marker(i, "x"), connection))
    assert [e.connection for e in waiting.take_batch()] == [1, 1, 1, 2, 2, 2]
    for i in range(3):
        waiting.offer(entry(Marker(i, "x"), 1))
    assert [e.connection for e in waiting.take_batch()] == [3, 3, 3, 1, 1, 1]
    assert not waiting.take_batch()


@given(st.lists(st.tuples(st.booleans(), st.integers(0, 3), st.booleans()), max_size=60))
def test_edges_and_final_state_survive_any_interleaving(steps: list[tuple[bool, int, bool]]) -> None:
    """The sequence of (clutch, buttons) without repeats, and the last sample, are those that were sent."""
    waiting, drops = coalescer(pending_samples=100)
    sent, received = [], []
    for seq, (clutch, buttons, take) in enumerate(steps, 1):
        sent.append((clutch, buttons))
        waiting.offer(entry(sample(seq, clutch=clutch, buttons=buttons)))
        if take:
            received += waiting.take_batch()
    received += waiting.take_batch()
    edges = [s for i, s in enumerate(sent) if i == 0 or s != sent[i - 1]]
    got = [(e.message.clutch, e.message.buttons) for e in received if isinstance(e.message, Sample)]
    assert [s for i, s in enumerate(got) if i == 0 or s != got[i - 1]] == edges
    assert seqs(received) == sorted(seqs(received))
    assert not steps or seqs(received)[-1] == len(steps)
    assert drops.by_reason == {}


def test_tracking_epoch_replaces_the_previous_one_and_is_never_dropped() -> None:
    waiting, drops = coalescer(pending_messages=1)
    waiting.offer(entry(Marker(1, "x")))
    for epoch in range(1, 100):
        assert waiting.offer(entry(TrackingEpoch(epoch)))
    assert [e.message for e in waiting.take_batch()] == [Marker(1, "x"), TrackingEpoch(99)]
    assert not drops.by_reason


def test_removal_is_sent_during_a_flood_of_audits_whose_drops_are_counted() -> None:
    waiting, drops = coalescer(pending_messages=4)
    audits = [Entry(HOST, HOST, 0, Audit("flood", detail=str(i))) for i in range(10)]
    assert [waiting.offer(audit) for audit in audits] == [True] * 4 + [False] * 6
    removals = [Entry(HOST, HOST, 1, RemoveParticipant(0, f"p{i}", reason="key revoked")) for i in range(20)]
    for removal in removals:
        assert waiting.offer(removal)
        assert waiting.offer(removal), "said twice, to be done once"
    assert waiting.urgent
    assert waiting.take_batch(urgent_only=True) == removals
    assert waiting.take_batch() == audits[:4]
    assert drops.by_reason == {"audit_lost": 6}


def test_removals_are_bounded_and_those_of_directors_are_requests() -> None:
    waiting, drops = coalescer(resume_tokens=3)
    for i in range(5):
        waiting.offer(Entry(HOST, HOST, 1, RemoveParticipant(0, f"p{i}")))
    waiting.offer(Entry(7, 7, 1, RemoveParticipant(1, "p9")))
    assert len(waiting.take_batch(urgent_only=True)) == 3
    assert drops.by_reason == {"urgent_pending": 2}
    assert len(waiting.take_batch()) == 1


def proposal(n: int, refused: bool = False) -> AlignmentProposal:
    return AlignmentProposal(IDENTITY, 1, (), (0.0, 0.0, 0.0), 0.0, n_observations=n, refused=refused)


def test_newest_proposal_and_cross_check_are_pending_beside_the_queue() -> None:
    waiting, drops = coalescer(pending_messages=2)
    for n in range(100):
        assert waiting.offer(entry(proposal(n)))
        assert waiting.offer(entry(proposal(n, refused=True)))
        assert waiting.offer(entry(CrossChecked(2 + n % 2, "sheet", 0.01, 0.0, 0.02, (0.0, 0.0, 0.0), n)))
    assert waiting.offer(entry(Acquire(1)))
    assert waiting.offer(entry(Acquire(2)))
    messages = [e.message for e in waiting.take_batch()]
    assert [m for m in messages if isinstance(m, AlignmentProposal)] == [proposal(99), proposal(99, refused=True)]
    assert [m.n for m in messages if isinstance(m, CrossChecked)] == [98, 99]
    assert len(messages) == 6
    assert drops.by_reason == {}


def test_alarms_are_never_dropped_and_precede_later_proposals() -> None:
    waiting, drops = coalescer(pending_messages=1, pending_urgent=1)
    waiting.offer(entry(Acquire(1)))
    for size in (0.01, 0.02):
        assert waiting.offer(entry(AlignmentAlarm("changed", 1, "sheet", size)))
    assert waiting.offer(entry(AlignmentAlarm("changed", 1, "other", 0.01)))
    waiting.offer(entry(proposal(1)))
    alarms = [e.message for e in waiting.take_batch()]
    assert alarms == [
        Acquire(1),
        AlignmentAlarm("changed", 1, "sheet", 0.02),
        AlignmentAlarm("changed", 1, "other", 0.01),
        proposal(1),
    ]
    assert drops.by_reason == {}


def test_jump_is_urgent() -> None:
    waiting, drops = coalescer(pending_urgent=2)
    for request in (1, 2):
        waiting.offer(entry(Release(request)))
    waiting.offer(entry(proposal(1)))
    for size in (0.1, 0.2):
        assert waiting.offer(entry(AlignmentAlarm("jump", 1, "sheet", size)))
    assert waiting.urgent
    batch = [e.message for e in waiting.take_batch(urgent_only=True)]
    assert batch == [Release(1), Release(2), AlignmentAlarm("jump", 1, "sheet", 0.2)]
    assert [e.message for e in waiting.take_batch()] == [proposal(1)]
    assert drops.by_reason == {}
