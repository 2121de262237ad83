"""Failures of clients and of the machine, one per test: programs that hang, sleep or die, a machine that sleeps.

Other clients are not disturbed, and a client that reconnects gets its state back. docs/recovery.md lists the failures.
"""

from __future__ import annotations

import itertools
import time
from pathlib import Path

import pytest

from anchors.pose import distance
from iris_session.authority.config import AuthorityConfig
from iris_session.client import Client, DeniedError
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.identity import Identity
from iris_session.protocol.names import DenialReason, HoldReason
from iris_session.protocol.server_messages import EngagementChanged, Gap, ParticipantLeft
from tests.rig.session import Hand, Rig, is_driven
from tests.rig.simulation import SimulatedTime

MS = 1_000_000
TICK = 0.02  # [s]


def drive_left(rig: Rig) -> tuple[Client, Hand]:
    """Return a watcher, and the hand of ann, who moves the left robot."""
    watcher = rig.join("watcher", "observer")
    return watcher, rig.drive("ann", "left", (0.0, 0.02, 0.0))


def check_resumed(rig: Rig, watcher: Client, me: str, lease_version: int) -> None:
    """Check that a participant is back with the left robot, which holds until its clutch was opened."""
    lease = watcher.mirror.leases["left"]
    assert watcher.mirror.participants[me].connected
    assert (lease.holder, lease.expires_ns) == (me, 0)
    assert lease.lease_version > lease_version
    rig.check_rest(watcher, "left")


# --- clients ----------------------------------------------------------------------------------------------------------


def test_silent_client_resumes_everything() -> None:
    """A program that hangs for three seconds is disconnected after two, and resumes with scene and lease."""
    with Rig(timestep=TICK) as rig:
        watcher, hand = drive_left(rig)
        ann = hand.client
        me, bodies, version = ann.participant_id, ann.mirror.bodies, ann.lease_version("left")
        assert version is not None
        begun_ns = rig.session.clock()
        rig.hang(ann, 3.0)
        rig.run_until(lambda: not watcher.mirror.participants[me].connected, "ann is silent", 2.5)
        ((left_ns, left),) = rig.list_events("watcher", ParticipantLeft)
        assert left.reason == "silent"
        assert 1_500 * MS < left_ns - begun_ns <= 2_020 * MS
        assert watcher.mirror.leases["left"].expires_ns == pytest.approx(left_ns + 30_000 * MS, abs=20 * MS)
        rig.run_until(lambda: ann.connection.counters.reconnects > 0 and ann.ready, "ann has reconnected", 2.0)
        rig.run(0.1)
        assert ann.mirror.bodies == bodies
        check_resumed(rig, watcher, me, version)
        rig.engage(hand)


def test_killed_client_resumes_its_lease() -> None:
    """After SIGKILL the robot holds, the lease stays, and a client with the same identity resumes it."""
    with Rig(timestep=TICK) as rig:
        watcher = rig.join("watcher", "observer")
        identity = Identity.in_memory()  # as the file that its next process reads
        first = rig.join("ann", identity=identity)
        hand = rig.add_hand(first, "left")
        first.acquire(["left"])
        rig.engage(hand)
        lease = watcher.mirror.leases["left"]
        killed_ns = rig.session.clock()
        rig.kill(first)
        rig.run(0.1)
        held_ns, ended = rig.list_events("watcher", EngagementChanged)[-1]
        assert (ended.engaged, ended.reason) == (False, HoldReason.DISCONNECTED)
        assert held_ns - killed_ns <= 20 * MS, "the front is told at once"
        assert not watcher.mirror.participants[lease.holder].connected
        assert watcher.mirror.leases["left"].expires_ns == pytest.approx(killed_ns + 30_000 * MS, abs=20 * MS)
        second = rig.join("ann", identity=identity)
        assert second.participant_id == lease.holder
        rig.run(0.1)
        check_resumed(rig, watcher, lease.holder, lease.lease_version)
        rig.engage(rig.add_hand(second, "left"))


def test_headset_that_hangs_while_joining_does_not_block_others() -> None:
    """It stands still between its hello and its first state; meanwhile another client joins."""
    with Rig(timestep=TICK) as rig:
        watcher, hand = drive_left(rig)
        eve = rig.open("eve")
        rig.run_until(lambda: eve.connection.phase is ConnectionPhase.JOINING, "eve has sent hello")
        rig.hang(eve, 4.0)
        begun = rig.now_s
        bob = rig.join("bob")
        assert rig.now_s - begun < 0.5
        rig.run(0.1)
        assert bob.scene.state is not None
        assert hand.is_following
        rig.run_until(lambda: eve.ready, "eve has joined", 10.0)
        rig.run(0.1)
        assert [p.name for p in watcher.mirror.participants.values() if p.connected].count("eve") == 1
        assert [body.engaged for _, body in rig.list_events("watcher", EngagementChanged)] == [True]


def test_headset_that_sleeps_resumes_its_lease() -> None:
    """An aligned headset stands still for longer than the heartbeat timeout, and drives again by itself."""
    with Rig(timestep=TICK) as rig:
        watcher = rig.join("watcher", "observer")
        ann = rig.emulate(
            name="ann", behaviour="wander", robot="left", viewpoints=3, observations_per_viewpoint=4
        ).client
        rig.run_until(lambda: is_driven(watcher, "left"), "ann moves the left robot")
        me, version = ann.participant_id, watcher.mirror.leases["left"].lease_version
        rig.hang(ann, 4.0)
        rig.run(3.9)
        assert not watcher.mirror.participants[me].connected
        assert watcher.mirror.leases["left"].holder == me, "in the grace period"
        rig.run_until(lambda: is_driven(watcher, "left"), "ann moves the left robot again", 5.0)
        assert watcher.mirror.leases["left"].holder == me
        assert watcher.mirror.leases["left"].lease_version > version
        assert ann.alignment.current is not None


@pytest.mark.parametrize("mode", ["exclusive", "takeover"])
def test_app_that_hangs_but_sends_heartbeats(mode: str) -> None:
    """Without samples its robot holds and its lease stays; only in mode takeover may another client acquire it."""
    with Rig(timestep=TICK, authority=AuthorityConfig(default_mode=mode)) as rig:
        hand, bob = rig.drive("ann", "left", (0.0, 0.05, 0.0)), rig.join("bob")
        ann = hand.client
        hand.sending = False
        rig.run(0.7)
        assert [(b.engaged, b.reason) for _, b in rig.list_events("ann", EngagementChanged)][1:] == [
            (False, HoldReason.STALE)
        ]
        rig.check_rest(ann, "left", 3.5)  # longer than the heartbeat timeout
        assert ann.connection.counters.reconnects == 0
        assert bob.mirror.leases["left"].holder == ann.participant_id
        if mode == "exclusive":
            with pytest.raises(DeniedError) as denied:
                bob.acquire(["left"])
            assert (denied.value.denial.reason, denied.value.denial.holder_name) == (DenialReason.HELD, "ann")
            return
        bob.acquire(["left"])
        bobs = rig.add_hand(bob, "left")
        rig.engage(bobs)
        hand.sending = True
        rig.run(0.3)
        assert bob.mirror.leases["left"].holder == bob.participant_id
        assert bobs.is_following


@pytest.mark.parametrize("phase", [ConnectionPhase.JOINING, ConnectionPhase.SYNCING])
def test_client_killed_repeatedly_while_joining(phase: ConnectionPhase) -> None:
    """It is killed while its hello or its first state is in transit; afterwards it resumes identity and lease."""
    with Rig(timestep=TICK, profile="good-wifi") as rig:
        watcher = rig.join("watcher", "observer")
        identity = Identity.in_memory()
        first = rig.join("ann", identity=identity)
        first.acquire(["left"])
        me = first.participant_id
        rig.kill(first)
        for _ in range(8):
            dying = rig.open("ann", identity=identity)
            rig.run_until(lambda dying=dying: dying.connection.phase is phase, "ann joins", 5.0)  # type: ignore[misc]
            rig.kill(dying)
        back = rig.join("ann", identity=identity)
        assert back.participant_id == me
        assert back.lease_version("left") is not None
        rig.run(0.1)
        assert watcher.mirror.participants[me].connected
        assert [p.name for p in watcher.mirror.participants.values()].count("ann") == 1
        rig.engage(rig.add_hand(back, "left"))


# --- the session and its machine --------------------------------------------------------------------------------------


def test_suspended_machine_keeps_leases() -> None:
    """All processes of the session stand still: a gap, then clients continue with their leases."""
    with Rig(timestep=TICK) as rig:
        watcher, hand = drive_left(rig)
        me, version = hand.client.participant_id, watcher.mirror.leases["left"].lease_version
        rig.suspend_machine(4.0)
        rig.run(4.0)
        assert not hand.client.ready, "it has noticed"
        rig.run_until(lambda: hand.client.ready and watcher.ready, "both have reconnected", 5.0)
        rig.run(0.2)
        gaps_ns = [b.now_ns - a.now_ns for a, b in itertools.pairwise(rig.journal.rows)]
        assert max(gaps_ns) == pytest.approx(4_000 * MS, abs=20 * MS)
        assert sum(ns > 40 * MS for ns in gaps_ns) == 1
        check_resumed(rig, watcher, me, version)
        hand.velocity = (0.0, 0.0, 0.0)
        rig.engage(hand)


def test_session_that_stands_still_is_reported_leases_stay_and_robots_hold_until_clutched_again() -> None:
    """Its loop alone stands still: no client is disconnected."""
    with Rig(timestep=0.01) as rig:
        hand = rig.drive("ann", "left", (0.0, 0.05, 0.0))
        ann = hand.client
        reconnects = ann.connection.counters.reconnects
        rig.stop_loop(4.0)  # longer than the heartbeat timeout
        rig.run_until(lambda: ann.connection.stalled, "the front reports it", 2.0)
        before = hand.tip
        rig.run_until(lambda: not ann.connection.stalled, "the front reports that it steps again", 4.5)
        rig.run(1.0)
        assert distance(before[0], hand.tip[0]) < 5e-3
        assert ann.lease_version("left") is not None
        assert ann.connection.counters.reconnects == reconnects
        ((_, gap),) = rig.list_events("ann", Gap)
        assert gap.kind == "stalled"
        assert rig.list_events("ann", EngagementChanged)[-1][1].reason == HoldReason.GAP
        rig.check_rest(ann, "left")
        hand.velocity = (0.0, 0.0, 0.0)
        rig.engage(hand)


def test_wall_clock_jumps_change_nothing(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """The wall clock jumps by a year at each reading; the journal is the same, bit for bit."""

    def run() -> bytes:
        with Rig(timestep=TICK) as rig:
            _watcher, hand = drive_left(rig)
            rig.run(3.0)  # longer than the heartbeat timeout
            assert hand.client.connection.counters.reconnects == 0
            return rig.journal.rows[-1].chain

    usual = run()
    readings = itertools.count()
    monkeypatch.setattr(SimulatedTime, "time", lambda _: time.time() + (-1) ** next(readings) * 3.15e7, raising=False)
    monkeypatch.setattr(
        SimulatedTime, "time_ns", lambda _: time.time_ns() + (-1) ** next(readings) * 31_500_000 * 10**9, raising=False
    )
    assert run() == usual
