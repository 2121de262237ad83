"""Each process of a session is killed in turn: clients resume, recordings verify, no process stays."""

from __future__ import annotations

import pytest

from anchors.pose import distance
from iris_session.protocol.server_messages import MarkerAdded
from iris_session.recording import Recording
from tests.e2e.scenario import Hand, Scenario
from tests.e2e.session_process import assert_all_end, list_descendants
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


def test_killed_authority_leaves_a_finished_recording_and_no_process(scenario: Scenario, driving: Hand) -> None:
    """The front notifies clients and ends; the recorder finishes the file, which verifies up to its end."""
    children = list_descendants(scenario.server.process.pid)
    assert len(children) >= 2
    recorded_ns = driving.client.session_now_ns()
    wait_until_recorded(scenario, scenario.server.recording, recorded_ns)
    scenario.server.process.kill()
    scenario.server.process.wait()
    scenario.run_until(lambda: not driving.client.connection.is_joined, "ann has disconnected")
    assert_all_end(children)
    assert "session_ended" in driving.client.connection.counters.faults
    assert scenario.server.verify()["finished"]
    with Recording.open(scenario.server.recording) as recording:
        assert max(row.now_ns for row in recording.rows()) >= recorded_ns


def test_killed_recorder_continues_in_a_next_part(scenario: Scenario, driving: Hand) -> None:
    """No row is lost, and both parts verify as one recording."""
    watcher = scenario.join("watcher", "observer")
    scenario.run_until(scenario.server.count_recorded_rows, "rows are in the file")
    scenario.server.children()["recording.process"].kill()

    def is_replaced() -> bool:
        has_marker = any(isinstance(event.body, MarkerAdded) for event in scenario.events["watcher"])
        return has_marker and "recording.process" in scenario.server.children()

    scenario.run_until(is_replaced, "the recorder is replaced")
    run_ticks(scenario, watcher, 0.5)
    report = scenario.server.finish()
    assert (report["parts"], report["finished"], report["gaps"]) == (2, True, [])
