"""What participants see when the front is killed, or when the loop that takes steps stands still."""

from __future__ import annotations

from anchors.pose import distance
from iris_session.protocol.server_messages import Gap
from tests.rig.session import Rig


def test_clients_resume_at_the_next_front_and_the_robot_holds_until_clutched() -> None:
    with Rig(timestep=0.01) as rig:
        hand = rig.drive("ann", "left", (0.0, 0.05, 0.0))
        watcher = rig.join("watcher", "observer")
        ann = hand.client
        me, before = ann.participant_id, ann.mirror.leases["left"]
        rig.kill_front()
        rig.run_until(lambda: not ann.connection.is_joined, "ann is disconnected", 1.0)
        rig.run_until(lambda: ann.ready and watcher.ready, "both are back", 5.0)
        after = ann.mirror.leases["left"]
        assert (ann.participant_id, after.holder) == (me, me)
        assert after.lease_version > before.lease_version
        assert rig.session.status().restarts["front"] == 1
        hand.velocity = (0.0, 0.3, 0.0)  # the hand moves on with its clutch closed
        rig.run(0.5)
        resting = hand.tip
        rig.run(1.0)
        assert distance(resting[0], hand.tip[0]) < 2e-4
        hand.velocity = (0.0, 0.0, 0.0)
        rig.engage(hand)


def test_a_session_that_stands_still_is_reported_and_leases_stay() -> None:
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
        assert any(isinstance(event.body, Gap) for event in rig.events["ann"])
        hand.velocity = (0.0, 0.0, 0.0)
        rig.engage(hand)


def test_the_end_of_a_session_is_said_to_its_clients() -> None:
    with Rig(timestep=0.01) as rig:
        ann = rig.join("ann", "observer")
        rig.session.close()
        rig.run_until(lambda: not ann.connection.is_joined, "ann has heard of it", 1.0)
        assert "session_ended" in ann.connection.counters.faults
