"""`serve --resume`: a session that was killed, stopped or cut short goes on with the same people and leases."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from anchors.pose import distance
from iris_session.client import Client, CurveKeys
from iris_session.protocol.entries import SessionResumed, decode_entries
from iris_session.protocol.server_messages import Gap, Handover, ParticipantJoined
from iris_session.recording import Recording
from iris_session.security import KeyHome, KeyPair
from tests.e2e.conftest import COMMAND, DEADLINE_S, Hand, Server, Stage, end_all, iris, none_left, relatives, verify

pytestmark = pytest.mark.e2e

Resume = Callable[..., Server]


@pytest.fixture
def resume() -> Iterator[Resume]:
    """Goes on from the recording in the folder of a server that has ended."""
    servers: list[Server] = []

    def start(ended: Server, *arguments: str, number: int = 2) -> Server:
        recording = ended.folder / f"session.resume{number}.rrd"
        server = Server(ended.folder, recording, [*COMMAND, "serve", "--resume", str(ended.folder), *arguments])
        servers.append(server)
        return server

    yield start
    end_all(servers)


def killed(server: Server) -> None:
    """SIGKILL of the authority; front and recorder end by themselves."""
    children = relatives(server.process.pid)
    server.process.kill()
    server.process.wait()
    none_left(children)


def came_back(stage: Stage, server: Server, *clients: Client) -> None:
    """Waits until everyone is in the session that `server` resumed, and sees it move on."""

    def back(client: Client) -> bool:
        state = client.scene.state
        fresh = state is not None and client.session_now_ns() - state.header.session_time < 200_000_000
        return client.ready and fresh and f"name={client.name} " in server.output

    stage.run(lambda: all(map(back, clients)), "everybody is back")


@pytest.fixture
def driving(stage: Stage) -> Hand:
    """Ann moves the left robot."""
    hand = stage.hand(stage.join("ann"), "left")
    hand.client.acquire(["left"])
    stage.engage(hand)
    hand.velocity = (0.0, 0.05, 0.0)
    return hand


def test_operators_finish_the_handover_though_the_authority_was_killed(
    stage: Stage, emulate: Callable[..., subprocess.Popen[bytes]], resume: Resume
) -> None:
    """Killed while the hammer is in the air; the same two emulated people, never restarted, hand it over."""
    watcher = stage.join("watcher", "observer")
    people = emulate(
        stage.server.address, "name=ann,behaviour=giver,robot=left", "name=bob,behaviour=receiver,robot=right"
    )

    def hammer() -> float:
        return stage.height("watcher", "hammer")

    stage.run(lambda: hammer() > 0.0, "a first picture")
    table = hammer()
    stage.run(lambda: hammer() > table + 0.06, "ann lifts the hammer", 60.0)
    before = dict(watcher.mirror.leases)
    killed(stage.server)
    lifted = hammer()
    again = resume(stage.server)
    assert again.address == stage.server.address
    stage.run(lambda: watcher.ready, "the watcher is back")
    assert hammer() > table + 0.03, f"it is still in the gripper: {lifted}"
    stage.run(lambda: "Handover" in stage.bodies("watcher"), "the hammer changes hands", 60.0)
    (event,) = [e.body for e in stage.events["watcher"] if isinstance(e.body, Handover)]
    assert {event.giver_participant, event.receiver_participant} == {before["left"].holder, before["right"].holder}
    assert people.poll() is None
    assert stage.server.verify()["finished"]
    report = again.finish()
    assert report["continues"].startswith("session.rrd after step ")


def test_after_ctrl_c_everybody_is_back_and_what_was_stopped_stays_stopped(
    stage: Stage, driving: Hand, resume: Resume
) -> None:
    """The same two programs, never restarted: same participants, same lease; e-stop and pause are kept."""
    dora = stage.join("dora", "director")
    ann = driving.client
    me, lease = ann.participant_id, ann.mirror.leases["left"]
    dora.estop("to be kept")
    stage.seconds(0.5)  # paused while it brakes, the arm would brake to its end afterwards: a millimetre
    dora.control("pause")
    stage.run(lambda: ann.mirror.estop and ann.mirror.paused, "everything stands still")
    session_id, tip = _session(ann), driving.tip
    stage.server.finish()
    now_ns, event_seq = ann.session_now_ns(), ann.mirror.event_seq
    again = resume(stage.server)
    came_back(stage, again, ann, dora)
    assert _session(ann) == session_id
    assert ann.participant_id == me
    assert ann.mirror.leases["left"].holder == me
    assert ann.mirror.leases["left"].lease_version > lease.lease_version
    assert ann.mirror.estop
    assert ann.mirror.paused
    assert ann.session_now_ns() > now_ns
    assert ann.mirror.event_seq > event_seq
    dora.clear_estop()
    dora.control("resume")
    stage.run(lambda: not ann.mirror.paused, "physics goes on")
    stage.seconds(0.3)
    assert distance(tip[0], driving.tip[0]) < 1e-3, "the hand went on with its clutch closed: it moves nothing"
    stage.engage(driving)
    report = again.finish()
    assert report["continues"].startswith("session.rrd after step ")
    with Recording.open(again.recording) as recording:
        row = next(recording.rows())
        assert isinstance(decode_entries(row.entries)[0].message, SessionResumed)
        events = list(recording.events())
    assert next(event.body.kind for event in events if isinstance(event.body, Gap)) == "resumed"
    back = [e.body for e in events if isinstance(e.body, ParticipantJoined)]
    assert {(b.participant.name, b.resumed) for b in back} == {("ann", True), ("dora", True)}


def _session(client: Client) -> str:
    assert client.connection.welcome is not None
    return client.connection.welcome.session_id


def test_after_a_power_cut_it_goes_on_where_the_file_can_be_read(stage: Stage, driving: Hand, resume: Resume) -> None:
    """Every process dies at once and the file ends in the middle of a write. And once more."""
    ann = driving.client
    me = ann.participant_id
    stage.seconds(1.0)
    for process in [*relatives(stage.server.process.pid), psutil.Process(stage.server.process.pid)]:
        process.kill()
    stage.server.process.wait()
    os.truncate(stage.server.recording, stage.server.recording.stat().st_size - 1000)
    again = resume(stage.server)
    came_back(stage, again, ann)
    assert ann.participant_id == me
    assert ann.mirror.leases["left"].holder == me
    stage.engage(driving)
    killed(again)
    third = resume(stage.server, number=3)
    came_back(stage, third, ann)
    assert ann.participant_id == me
    stage.engage(driving)
    report = third.finish()
    assert report["continues"].startswith("session.resume2.rrd after step ")
    assert again.verify()["continues"].startswith("session.rrd after step ")
    assert verify(stage.server.recording)["cuts"]


def test_what_cannot_be_resumed_is_one_line(stage: Stage) -> None:
    folder = stage.server.folder
    cases: tuple[tuple[list[str], str], ...] = (
        (["--resume", str(folder)], "still runs"),
        (["--resume", str(folder / "nothing.rrd")], "there is no recording"),
        (["--resume", str(folder), "--mode", "takeover"], "--mode cannot be combined with --resume"),
        ([], "no scene is given"),
    )
    for arguments, expected in cases:
        done = iris("serve", *arguments, cwd=folder)
        assert done.returncode == 2, (done.stdout, done.stderr)
        (line,) = done.stderr.strip().splitlines()
        assert expected in line


def test_an_encrypted_session_goes_on_encrypted_with_the_same_keys(
    serve: Callable[..., Server], resume: Resume, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No option says so again: resume tokens are bound to keys, and nobody is let in who was not before."""
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "server-home"))
    home, pair = KeyHome(tmp_path / "server-home"), KeyPair.generate()
    home.clients.allow_key("ann", pair.public, ())
    keys = CurveKeys(home.load_server_key().public.encode(), pair.public.encode(), pair.secret.encode())
    stage = Stage(serve("handover", "--curve", "--no-beacon"))
    try:
        ann = Client(
            stage.server.address, name="ann", devices=("controller/right",), alignment="not_needed", curve=keys
        )  # fmt: skip
        stage.clients.append(ann)
        ann.connect(DEADLINE_S)
        hand = stage.hand(ann, "left")
        ann.acquire(["left"])
        stage.engage(hand)
        me = ann.participant_id
        killed(stage.server)
        again = resume(stage.server)
        came_back(stage, again, ann)
        assert ann.connection.welcome is not None
        assert ann.connection.welcome.key_fingerprint == home.load_server_key().fingerprint
        assert ann.participant_id == me
        assert ann.mirror.leases["left"].holder == me
        again.finish()
    finally:
        stage.close()
