"""`serve --resume`: a session that was killed, stopped or cut off continues with the same participants and leases."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator

import psutil
import pytest

from anchors.pose import distance
from iris_session.client import Client
from iris_session.protocol.entries import SessionResumed, decode_entries
from iris_session.protocol.server_messages import Gap, Handover, ParticipantJoined
from iris_session.recording import Recording
from tests.e2e.scenario import Hand, Scenario
from tests.e2e.session_process import COMMAND, SessionProcess, assert_all_end, kill_all, list_descendants, run_verify
from tests.e2e.session_time import run_ticks, wait_until_recorded

pytestmark = pytest.mark.e2e

Resume = Callable[..., SessionProcess]


@pytest.fixture
def resume() -> Iterator[Resume]:
    """Resume from the recording in the folder of a session that has ended."""
    servers: list[SessionProcess] = []

    def start(ended: SessionProcess, *arguments: str, number: int = 2) -> SessionProcess:
        recording = ended.folder / f"session.resume{number}.rrd"
        server = SessionProcess(ended.folder, recording, [*COMMAND, "serve", "--resume", str(ended.folder), *arguments])
        servers.append(server)
        return server

    yield start
    kill_all(servers)


def kill_authority(server: SessionProcess) -> None:
    """Kill the authority; front and recorder must end by themselves."""
    children = list_descendants(server.process.pid)
    server.kill()
    assert_all_end(children)


def wait_reconnected(scenario: Scenario, server: SessionProcess, *clients: Client) -> None:
    """Wait until the clients are in the session that `server` resumed, and receive new state."""

    def is_back(client: Client) -> bool:
        state = client.scene.state
        fresh = state is not None and client.session_now_ns() - state.header.session_time < 200_000_000
        return client.ready and fresh and f"participant_joined   {client.name}" in server.output

    scenario.run_until(lambda: all(map(is_back, clients)), "all clients have reconnected")


@pytest.mark.long
def test_operators_finish_the_handover_although_the_authority_was_killed(
    scenario: Scenario, emulate: Callable[..., subprocess.Popen[bytes]], resume: Resume
) -> None:
    """It is killed while the hammer is in the air; the same two emulated headsets, never restarted, hand it over."""
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
    scenario.run_until(lambda: get_hammer_height() > table + 0.06, "ann lifts the hammer", 60.0)
    before = dict(watcher.mirror.leases)
    wait_until_recorded(scenario, scenario.server.recording, watcher.session_now_ns())
    kill_authority(scenario.server)
    lifted = get_hammer_height()
    again = resume(scenario.server)
    assert again.address == scenario.server.address
    scenario.run_until(lambda: watcher.ready, "the watcher has reconnected")
    assert get_hammer_height() > table + 0.03, f"the hammer is still in the gripper: {lifted}"
    scenario.run_until(lambda: "Handover" in scenario.list_event_kinds("watcher"), "the hammer changes hands", 60.0)
    (event,) = [e.body for e in scenario.events["watcher"] if isinstance(e.body, Handover)]
    assert {event.giver_participant, event.receiver_participant} == {before["left"].holder, before["right"].holder}
    assert headsets.poll() is None
    assert scenario.server.verify()["finished"]
    report = again.finish()
    assert report["continues"].startswith("session.rrd ")


def test_resume_after_ctrl_c_keeps_participants_leases_estop_and_pause(
    scenario: Scenario, driving: Hand, resume: Resume
) -> None:
    """The two clients are never restarted."""
    dora = scenario.join("dora", "director")
    ann = driving.client
    me, lease = ann.participant_id, ann.mirror.leases["left"]
    dora.estop("test")
    scenario.run_until(lambda: ann.mirror.estop, "e-stop")
    run_ticks(scenario, dora, 0.5)  # an arm paused while it brakes would move by a millimetre afterwards
    dora.control("pause")
    scenario.run_until(lambda: ann.mirror.estop and ann.mirror.paused, "e-stop and pause")
    session_id, tip = get_session_id(ann), driving.tip
    scenario.server.finish()
    now_ns, event_seq = ann.session_now_ns(), ann.mirror.event_seq
    again = resume(scenario.server)
    wait_reconnected(scenario, again, ann, dora)
    assert get_session_id(ann) == session_id
    assert ann.participant_id == me
    assert ann.mirror.leases["left"].holder == me
    assert ann.mirror.leases["left"].lease_version > lease.lease_version
    assert ann.mirror.estop
    assert ann.mirror.paused
    assert ann.session_now_ns() > now_ns
    assert ann.mirror.event_seq > event_seq
    dora.clear_estop()
    dora.control("resume")
    scenario.run_until(lambda: not ann.mirror.paused, "the session continues")
    run_ticks(scenario, ann, 0.3)
    assert distance(tip[0], driving.tip[0]) < 1e-3, "a closed clutch must not move the robot"
    scenario.engage(driving)
    report = again.finish()
    assert report["continues"].startswith("session.rrd ")
    with Recording.open(again.recording) as recording:
        row = next(recording.rows())
        assert isinstance(decode_entries(row.entries)[0].message, SessionResumed)
        events = list(recording.events())
    assert next(event.body.kind for event in events if isinstance(event.body, Gap)) == "resumed"
    joined = [e.body for e in events if isinstance(e.body, ParticipantJoined)]
    assert {(b.participant.name, b.resumed) for b in joined} == {("ann", True), ("dora", True)}


def get_session_id(client: Client) -> str:
    assert client.connection.welcome is not None
    return client.connection.welcome.session_id


def test_resume_after_a_power_cut_continues_at_the_last_readable_row(
    scenario: Scenario, driving: Hand, resume: Resume
) -> None:
    """All processes are killed at once and the file ends within a write; then the resumed session is killed, too."""
    ann = driving.client
    me = ann.participant_id
    engaged_ns = ann.session_now_ns()
    wait_until_recorded(scenario, scenario.server.recording, engaged_ns + 1_000_000_000)  # more than is cut off
    for process in [*list_descendants(scenario.server.process.pid), psutil.Process(scenario.server.process.pid)]:
        process.kill()
    scenario.server.process.wait()
    os.truncate(scenario.server.recording, scenario.server.recording.stat().st_size - 1000)
    again = resume(scenario.server)
    wait_reconnected(scenario, again, ann)
    assert ann.participant_id == me
    assert ann.mirror.leases["left"].holder == me
    scenario.engage(driving)
    wait_until_recorded(scenario, again.recording, ann.session_now_ns())
    kill_authority(again)
    third = resume(scenario.server, number=3)
    wait_reconnected(scenario, third, ann)
    assert ann.participant_id == me
    scenario.engage(driving)
    report = third.finish()
    assert report["continues"].startswith("session.resume2.rrd ")
    assert again.verify()["continues"].startswith("session.rrd ")
    assert run_verify(scenario.server.recording)["cuts"]
