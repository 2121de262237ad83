"""Mirror of the session: a snapshot and events in any delivery order give the state of the session."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from iris_session.client import SessionMirror
from iris_session.protocol.common import IDENTITY, Alignment, Lease, Pose
from iris_session.protocol.server_messages import (
    AlignmentChanged,
    AnchorInfo,
    AnchorMoved,
    BodyInfo,
    EpisodeChanged,
    EStopChanged,
    Event,
    EventKind,
    LeaseChanged,
    LeasesChanged,
    Notice,
    ParticipantChanged,
    ParticipantInfo,
    ParticipantJoined,
    ParticipantLeft,
    PauseChanged,
    ScaleChanged,
    SceneChanged,
    Snapshot,
)
from iris_session.protocol.session_mirror import MissedEvents

ANCHORS = (AnchorInfo("a", IDENTITY, 0.16, 0.002), AnchorInfo("b", IDENTITY))
BODIES = (BodyInfo(0, "world", False), BodyInfo(3, "hammer", True, True))

names = st.sampled_from(["p1", "p2", "p3", "p4"])
flags = st.booleans()
counts = st.integers(1, 9)
floats = st.sampled_from([0.5, 2.0])
bodies = st.one_of(
    st.builds(lambda p, w: ParticipantJoined(ParticipantInfo(p, "ann", "operator", True, worn=w)), names, flags),
    st.builds(lambda p: ParticipantChanged(ParticipantInfo(p, "bob", "observer", True)), names),
    st.builds(ParticipantLeft, names, st.just("silent"), flags),
    st.builds(lambda p, v: LeaseChanged(Lease("left", "robot", "exclusive", p, v), "acquired"), names, counts),
    st.builds(
        lambda p, v, w: LeasesChanged(
            (Lease("left", "robot", "exclusive", p, v), Lease("right", "robot", "exclusive", p, w)), "released", (p, p)
        ),
        names,
        counts,
        counts,
    ),
    st.builds(lambda p, v: AlignmentChanged(p, Alignment(v, "measured", IDENTITY)), names, counts),
    st.builds(ScaleChanged, st.sampled_from(["left", "gone"]), st.sampled_from([0.1, 1.0]), names),
    st.builds(SceneChanged, counts, counts, st.just("reset"), tick_period_ns=st.sampled_from([0, 1_000_000])),
    st.builds(EStopChanged, flags, names, st.just(""), counts),
    st.builds(PauseChanged, flags),
    st.builds(EpisodeChanged, counts, st.sampled_from(["running", "success"])),
    st.builds(
        lambda name, x: AnchorMoved(name, Pose((x, 0.0, 0.0), IDENTITY.q)), st.sampled_from(["a", "gone"]), floats
    ),
    st.just(Notice("info", "hello")),
)


def event(seq: int, body: EventKind) -> Event:
    return Event(seq, seq, 0, body)


def snapshot(mirror: SessionMirror | None = None) -> Snapshot:
    """Return the snapshot of a session whose state is `mirror`."""
    if mirror is None:
        return Snapshot(0, 0, 1, 0, "hash", 0, 0.0, 0, (), (), bodies=BODIES, anchors=ANCHORS)
    return Snapshot(
        0, mirror.event_seq, mirror.scene_epoch, mirror.scene_revision, mirror.scene_hash, 0, 0.0, 0,
        tuple(mirror.participants.values()), tuple(mirror.leases.values()), tuple(mirror.robots.values()),
        mirror.bodies, mirror.paused, mirror.estop, mirror.episode, tick_period_ns=mirror.tick_period_ns,
        stop_seq=mirror.stop_seq, anchors=tuple(mirror.anchors.values()),
    )  # fmt: skip


def synced() -> SessionMirror:
    mirror = SessionMirror()
    mirror.apply_snapshot(snapshot())
    return mirror


def test_hash_of_a_session_without_anchors_is_as_it_always_was() -> None:
    """Conversations of other implementations hold such hashes."""
    mirror = SessionMirror()
    mirror.apply_snapshot(Snapshot(0, 0, 1, 0, "hash", 0, 0.0, 0, (), (), bodies=BODIES))
    assert mirror.mirror_hash() == "d8a8a047954124722d9537495fc44c92"


@given(st.lists(bodies, max_size=30), st.data())
@settings(max_examples=60, deadline=None)
def test_any_join_time_and_any_loss_give_the_same_state(kinds: list[EventKind], data: st.DataObject) -> None:
    events = [event(i + 1, kind) for i, kind in enumerate(kinds)]
    truth = synced()
    joined_at = data.draw(st.integers(0, len(events)))
    lost = data.draw(st.sets(st.integers(0, max(0, len(events) - 1))))
    late, lossy = SessionMirror(), synced()
    for i, one in enumerate(events):
        if i == joined_at:
            late.apply_snapshot(snapshot(truth))
        truth.apply_event(one)
        late.apply_event(one)
        late.apply_event(one)  # repeated
        if i not in lost:
            lossy.apply_event(one)
    if not late.synced:
        late.apply_snapshot(snapshot(truth))
    if not lossy.synced or lossy.event_seq != truth.event_seq:
        lossy.apply_snapshot(snapshot(truth))
    assert late.mirror_hash() == truth.mirror_hash()
    assert lossy.mirror_hash() == truth.mirror_hash()


@given(st.lists(st.sampled_from(["come", "lost", "twice", "snapshot"]), max_size=60), st.integers(0, 5))
@settings(max_examples=120, deadline=None)
def test_every_event_after_the_first_snapshot_is_delivered_or_reported_missed(fates: list[str], before: int) -> None:
    """In order, at any loss, repetition and timing of snapshots."""
    mirror, truth = SessionMirror(), synced()
    delivered: list[Event | MissedEvents] = []

    def deliver(one: Event) -> None:
        if mirror.apply_event(one):
            delivered.append(one)

    for i, fate in enumerate([*["come"] * before, "snapshot", *fates, "snapshot"]):
        if fate == "snapshot":
            delivered += mirror.apply_snapshot(snapshot(truth))
            continue
        one = event(truth.event_seq + 1, Notice("info", str(i)))
        truth.apply_event(one)
        for _ in range({"come": 1, "twice": 2, "lost": 0}[fate]):
            deliver(one)
    seqs: list[int] = []
    for one in delivered:
        seqs += range(one.first, one.last + 1) if isinstance(one, MissedEvents) else (one.event_seq,)
    assert seqs == list(range(before + 1, truth.event_seq + 1))
    lost = {seq for one in delivered if isinstance(one, MissedEvents) for seq in range(one.first, one.last + 1)}
    numbers = [i for i, fate in enumerate([f for f in fates if f != "snapshot"], before + 1) if fate == "lost"]
    assert lost == set(numbers), "what came is handed out"


def test_older_snapshot_is_discarded() -> None:
    mirror = synced()
    old = snapshot(mirror)
    mirror.apply_event(event(1, EStopChanged(True, "p1")))
    assert mirror.apply_snapshot(old) == []
    assert mirror.estop
    assert mirror.discarded == 1


def test_new_scene_needs_a_snapshot_but_a_reset_does_not() -> None:
    mirror = synced()
    mirror.apply_event(event(1, SceneChanged(2, 0, "reset")))
    assert mirror.synced
    mirror.apply_event(event(2, SceneChanged(3, 0, "new_scene", tick_period_ns=1_000_000)))
    assert not mirror.synced
    assert (mirror.scene_epoch, mirror.tick_period_ns) == (3, 1_000_000)
    mirror.apply_snapshot(Snapshot(0, 2, 3, 0, "other", 0, 0.0, 0, (), (), tick_period_ns=1_000_000))
    mirror.apply_event(event(3, SceneChanged(4, 0, "reset")))
    assert mirror.tick_period_ns == 1_000_000, "0: as it was"


def test_bodies_belong_to_their_epochs() -> None:
    """Poses of an epoch match the bodies of that epoch only; a reset changes none."""
    ball, box = (BodyInfo(1, name, True) for name in ("ball", "box"))
    mirror = synced()
    delivered: list[tuple[int, int]] = []

    def snap(epoch: int, *bodies: BodyInfo) -> None:
        mirror.apply_snapshot(Snapshot(0, mirror.event_seq, epoch, 0, "", 0, 0.0, 0, (), (), bodies=bodies))
        delivered.append((mirror.bodies_since, mirror.bodies_until))

    def change(epoch: int, cause: str) -> None:
        mirror.apply_event(event(mirror.event_seq + 1, SceneChanged(epoch, 0, cause)))
        delivered.append((mirror.bodies_since, mirror.bodies_until))

    snap(3, ball)
    change(4, "reset")
    change(5, "new_scene")
    snap(5, box, ball)
    change(6, "external")
    snap(6, box, ball)
    change(7, "new_scene")
    snap(7, box, ball)
    assert delivered == [(3, 3), (3, 4), (3, 4), (5, 5), (5, 6), (5, 6), (5, 6), (5, 7)]


def test_lease_version_is_visible_to_holders_only() -> None:
    mirror = synced()
    shared = Lease("left", "robot", "shared", "p1", 7, sub_holders=("p1", "p2"), weights=(0.5, 0.5))
    mirror.apply_event(event(1, LeaseChanged(shared, "acquired")))
    assert [mirror.find_lease_version("left", p) for p in ("p1", "p2", "p3")] == [7, 7, None]
    assert mirror.find_lease_version("right", "p1") is None


def test_pending_events_are_bounded() -> None:
    mirror = SessionMirror()
    for i in range(1000):
        mirror.apply_event(event(i + 1, Notice("info", "x")))
    assert mirror.held_overflow == 1000 - 256
