"""Bad links: a blackout, connections cut during a snapshot, a change of address, latency and jitter."""

from __future__ import annotations

import json
from pathlib import Path

from anchors.pose import distance
from iris_session.client.core.status import ConnectionPhase
from iris_session.protocol.names import HoldReason
from iris_session.protocol.server_messages import EngagementChanged, ParticipantLeft, SamplesRejected
from tests.rig.session import Rig, see_tip

MS = 1_000_000
TICK = 0.01  # [s]


def list_engagements(rig: Rig, robot: str) -> list[tuple[int, EngagementChanged]]:
    """Return session time and body of the events about a robot that the watcher has received."""
    return [(at, body) for at, body in rig.list_events("watcher", EngagementChanged) if body.robot == robot]


def test_blackout_of_five_seconds() -> None:
    """The robot holds and keeps its lease, others go on; then the client resumes, and its clutch must be opened."""
    with Rig(timestep=TICK, profile="good-wifi") as rig:
        watcher = rig.join("watcher", "observer", profile="lan")
        hand, bobs = rig.drive("ann", "left", (0.0, 0.02, 0.0)), rig.drive("bob", "right", (0.0, 0.02, 0.0))
        ann, bobs_before = hand.client, bobs.tip
        me, lease = ann.participant_id, watcher.mirror.leases["left"]
        blackout_ns = rig.session.clock()
        rig.link_of(ann).stall(5.0)
        rig.run(0.5)
        held_ns, ended = list_engagements(rig, "left")[-1]
        assert (ended.engaged, ended.reason) == (False, HoldReason.STALE)
        assert 140 * MS < held_ns - blackout_ns < 180 * MS, "150 ms after the last sample, which was on its way"
        rig.run(0.5)
        resting = see_tip(watcher, "left")
        rig.run_until(lambda: not watcher.mirror.participants[me].connected, "ann is silent", 2.0)
        (left_ns, left), *_ = rig.list_events("watcher", ParticipantLeft)
        assert left.reason == "silent"
        assert 1_450 * MS < left_ns - blackout_ns < 2_100 * MS, "two seconds after her last message"
        rig.run(5.0 - (rig.session.clock() - blackout_ns) * 1e-9)
        assert watcher.mirror.leases["left"].holder == me, "in the grace period"
        assert not [body for _, body in list_engagements(rig, "right") if not body.engaged]
        assert 0.08 < bobs.tip[0][1] - bobs_before[0][1] < 0.12, "5 s at 2 cm/s"
        rig.run_until(lambda: ann.ready and hand.client.scene.state is not None, "ann has reconnected", 1.0)
        assert ann.participant_id == me
        rig.run(0.1)
        resumed = watcher.mirror.leases["left"]
        assert (resumed.holder, resumed.expires_ns) == (me, 0)
        assert resumed.lease_version > lease.lease_version
        rig.run(0.5)
        assert distance(resting[0], see_tip(watcher, "left")[0]) < 1e-4, "the clutch is still closed"
        hand.velocity = (0.0, 0.0, 0.0)
        rig.engage(hand)


def test_connection_cut_during_a_snapshot() -> None:
    """After three cuts in a row the client joins once and has the whole state."""
    with Rig(timestep=TICK, profile="good-wifi") as rig:
        watcher = rig.join("watcher", "observer")
        rig.drive("bob", "right", (0.0, 0.02, 0.0))
        late = rig.open("late", "observer")
        for _ in range(3):
            rig.run_until(lambda: late.connection.phase is ConnectionPhase.SYNCING, "late waits for its snapshot")
            rig.cut(late)
            rig.run_until(lambda: not late.connection.is_joined, "late has disconnected")
            assert late.connection.counters.snapshots == 0
        rig.run_until(lambda: late.ready and late.scene.state is not None, "late has joined", 3.0)
        rig.run(0.1)
        assert late.mirror.mirror_hash() == watcher.mirror.mirror_hash()
        assert [p.name for p in watcher.mirror.participants.values() if p.connected].count("late") == 1
        assert [body.engaged for _, body in list_engagements(rig, "right")] == [True], "bob was not disturbed"


def test_change_of_network_keeps_identity_and_lease() -> None:
    """The headset's address changes, and the session does not learn that the old connection ended."""
    with Rig(timestep=TICK, profile="good-wifi") as rig:
        watcher = rig.join("watcher", "observer")
        hand = rig.drive("ann", "left", (0.0, 0.02, 0.0))
        ann = hand.client
        me, lease = ann.participant_id, watcher.mirror.leases["left"]
        rig.roam(ann, "198.51.100.7")
        rig.run_until(lambda: not ann.connection.is_joined, "ann has disconnected", 0.1)
        rig.run_until(lambda: ann.ready, "ann has reconnected", 1.0)
        assert ann.participant_id == me
        rig.run(0.1)
        assert watcher.mirror.leases["left"].holder == me
        assert watcher.mirror.leases["left"].lease_version > lease.lease_version
        rig.check_rest(watcher, "left")  # the clutch is still closed
        hand.velocity = (0.0, 0.0, 0.0)
        rig.engage(hand)
        rig.run(2.5)  # the heartbeat timeout of the old connection
        assert watcher.mirror.participants[me].connected, "the new connection stays"
        assert hand.is_following


def test_latency_and_jitter_within_bounds_keep_engagement(tmp_path: Path) -> None:
    path = tmp_path / "profile.json"
    path.write_text(json.dumps({"phases": [{"delay_ms": 40.0, "jitter_ms": 15.0}]}))
    with Rig(timestep=TICK, profile=str(path)) as rig:
        watcher = rig.join("watcher", "observer", profile="lan")
        hand = rig.drive("ann", "left")
        hand.velocity = (0.0, 0.02, 0.0)
        begun, before = len(rig.events["watcher"]), hand.tip
        rig.run(4.0)
        log = [event.body for event in rig.events["watcher"][begun:]]
        assert not [body for body in log if isinstance(body, EngagementChanged | SamplesRejected)]
        assert 0.07 < hand.tip[0][1] - before[0][1] < 0.08, "4 s at 2 cm/s, less the delay"
        (mine, theirs) = (client.scene.state for client in (hand.client, watcher))
        assert mine is not None
        assert theirs is not None
        assert 10 * MS < mine.age_ns < 120 * MS
        assert theirs.age_ns < 2 * MS


def test_everyone_joins_over_a_slow_link_also_without_an_introduction() -> None:
    """A second is not enough for one attempt. Without an introduction every attempt begins with asking for one."""
    with Rig(timestep=0.01) as rig:
        rig.profile = "600ms"
        ann = rig.open("ann")
        bob = rig.emulate(name="bob", behaviour="observer")
        rig.run_until(lambda: ann.ready and bob.client.ready, "both have joined", 15.0)
        rig.profile = "lan"
