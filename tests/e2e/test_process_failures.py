"""Each process of a session is killed or suspended in turn: clients resume, recordings verify, no process stays."""

from __future__ import annotations

import signal
import subprocess
from collections.abc import Callable

import pytest

from anchors.pose import distance
from iris_session.protocol.server_messages import Gap, Handover, MarkerAdded
from iris_session.recording.feed import BATCH_ROWS
from tests.e2e.scenario import Hand, Scenario
from tests.e2e.session_process import (
    assert_all_end,
    list_descendants,
)
from tests.e2e.session_time import run_ticks, wait_until_recorded

pytestmark = pytest.mark.e2e


def test_killed_front_is_replaced_and_clients_resume(scenario: Scenario, driving: Hand) -> None:
    """Ports stay, leases are resumed by tokens, and the robot holds until the clutch is opened and closed."""
    watcher = scenario.join("watcher", "observer")
    ann = driving.client
    me, before = ann.participant_id, ann.mirror.leases["left"]
    front = scenario.server.children()["front.main"]
    front.kill()
    scenario.run_until(lambda: not ann.connection.is_joined, "ann has disconnected")
    scenario.run_until(lambda: ann.ready and watcher.ready, "both have reconnected")
    driving.velocity = (0.0, 0.3, 0.0)  # the hand moves on with its clutch closed
    assert ann.participant_id == me
    after = ann.mirror.leases["left"]
    assert after.holder == me
    assert after.lease_version > before.lease_version
    # No client was connected at that moment: it is in the terminal of the owner and in the recording.
    scenario.run_until(lambda: "front process" in scenario.server.output, "the owner is notified")
    assert scenario.server.children()["front.main"].pid != front.pid
    run_ticks(scenario, ann, 0.5)
    resting = driving.tip
    run_ticks(scenario, ann, 0.5)
    assert distance(resting[0], driving.tip[0]) < 1e-3, "the robot must not move before the clutch was opened"
    driving.velocity = (0.0, 0.0, 0.0)
    scenario.engage(driving)
    scenario.server.finish()


def test_killed_recorder_continues_in_a_next_part(scenario: Scenario, driving: Hand) -> None:
    """No step waits, no row is lost, and both parts verify as one recording."""
    watcher = scenario.join("watcher", "observer")
    run_ticks(scenario, watcher, 1.0)
    events, parts = scenario.events["watcher"], 1

    def is_replaced_without_gap() -> bool:
        """Return whether no step waited. Tried again: a busy machine makes gaps of its own."""
        nonlocal parts
        begun, parts = len(events), parts + 1
        scenario.server.children()["recording.process"].kill()

        def is_replaced() -> bool:
            has_marker = any(isinstance(e.body, MarkerAdded) for e in events[begun:])
            return has_marker and "recording.process" in scenario.server.children()

        scenario.run_until(is_replaced, "the recorder is replaced")
        waited = any(isinstance(e.body, Gap) for e in events[begun:])
        part = scenario.server.recording.with_name(f"session.part{parts}.rrd")
        scenario.run_until(lambda: part.exists() and part.stat().st_size > 100_000, "the next part grows")
        return not waited

    assert any(is_replaced_without_gap() for _ in range(3)), "no step waited"
    scenario.keep_engaged(driving)
    report = scenario.server.finish()
    assert report["parts"] == parts
    assert report["finished"]
    assert report["gaps"] == []


@pytest.mark.long
def test_killed_authority_leaves_a_finished_recording_and_no_process(scenario: Scenario, driving: Hand) -> None:
    """The front notifies clients and ends; the recorder finishes the file, which verifies up to its end."""
    run_ticks(scenario, driving.client, 1.0)
    children = list_descendants(scenario.server.process.pid)
    assert len(children) >= 2
    # On a busy machine the recorder may stand still; then rows wait in the authority, and end with it.
    wait_until_recorded(scenario, scenario.server.recording, driving.client.session_now_ns())
    scenario.keep_engaged(driving)
    assert driving.client.scene.state is not None
    tick = driving.client.scene.state.header.tick
    scenario.server.process.kill()
    scenario.server.process.wait()
    driving.sending = False
    scenario.run_until(lambda: not driving.client.connection.is_joined, "ann has disconnected")
    assert_all_end(children)
    assert "session_ended" in driving.client.connection.counters.faults
    report = scenario.server.verify()
    assert report["finished"]
    # Rows that the feed has not handed over end with the process: at most one batch, 20 ms.
    assert report["last_step"] >= tick - 1 - BATCH_ROWS, "steps that the client saw are in the file, except one batch"


@pytest.mark.long
def test_suspended_authority_is_reported_as_stalled(scenario: Scenario, driving: Hand) -> None:
    """The front reports `stalled`, leases stay, and robots hold until the clutch is opened and closed."""
    ann = driving.client

    def stays_connected() -> bool:
        """Return whether ann stays connected. Tried again: front and test of a busy machine stand still, too."""
        reconnects, begun = ann.connection.counters.reconnects, len(scenario.events["ann"])
        scenario.server.process.send_signal(signal.SIGSTOP)
        try:
            scenario.run_until(lambda: ann.connection.stalled, "the front reports stalled")
            before = driving.tip
            scenario.run_for(4.0)  # longer than the heartbeat timeout
        finally:
            scenario.server.process.send_signal(signal.SIGCONT)
        scenario.run_until(lambda: not ann.connection.stalled, "the front reports recovered")
        run_ticks(scenario, ann, 0.5)
        assert distance(before[0], driving.tip[0]) < 5e-3
        assert ann.lease_version("left") is not None
        is_same = ann.connection.counters.reconnects == reconnects
        return is_same and any(isinstance(e.body, Gap) for e in scenario.events["ann"][begun:])

    assert any(stays_connected() for _ in range(3)), "no client reconnects, and the gap is an event"
    driving.velocity = (0.0, 0.0, 0.0)
    scenario.engage(driving)
    scenario.server.finish()


@pytest.mark.long
def test_front_and_recorder_killed_at_once(scenario: Scenario, driving: Hand) -> None:
    for child in scenario.server.children().values():
        child.kill()
    scenario.run_until(lambda: not driving.client.connection.is_joined, "ann has disconnected")
    scenario.run_until(lambda: driving.client.ready, "ann has reconnected")
    scenario.engage(driving)
    scenario.run_until(scenario.server.recording.with_name("session.part2.rrd").exists, "the next part begins")
    assert scenario.server.finish()["parts"] == 2


@pytest.mark.long
def test_operators_finish_although_recorder_and_front_were_killed(
    scenario: Scenario, emulate: Callable[..., subprocess.Popen[bytes]]
) -> None:
    watcher = scenario.join("watcher", "observer")
    headsets = emulate(
        scenario.server.address,
        "name=ann,behaviour=giver,robot=left",
        "name=bob,behaviour=receiver,robot=right",
        seconds=300.0,  # longer than all that is waited for
    )

    def get_hammer_height() -> float:
        return scenario.get_height("watcher", "hammer")

    scenario.run_until(lambda: get_hammer_height() > 0.0, "a first state")
    table = get_hammer_height()
    scenario.run_until(lambda: get_hammer_height() > table + 0.02, "ann begins to lift the hammer", 60.0)
    holders = {name: watcher.mirror.leases[name].holder for name in ("left", "right")}
    scenario.server.children()["recording.process"].kill()
    scenario.run_until(lambda: get_hammer_height() > table + 0.06, "the hammer is in the air")
    scenario.server.children()["front.main"].kill()
    scenario.run_until(
        lambda: watcher.connection.counters.reconnects > 0 and watcher.ready, "the watcher has reconnected"
    )
    scenario.run_until(lambda: "Handover" in scenario.list_event_kinds("watcher"), "the hammer changes hands", 60.0)
    (event,) = [e.body for e in scenario.events["watcher"] if isinstance(e.body, Handover)]
    assert (event.giver_participant, event.receiver_participant) == (holders["left"], holders["right"])
    assert headsets.poll() is None
    report = scenario.server.finish()
    assert report["parts"] == 2
    assert report["gaps"] == []
    assert report["finished"]
