"""What fails in a lab, one failure per test: headsets that hang, sleep, die or talk nonsense; processes that are killed
or stopped. Whoever did nothing wrong notices nothing, who comes back has everything. docs/recovery.md lists them."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from anchors.pose import distance
from iris_session.client import Client, DeniedError
from iris_session.client.core.status import ConnectionPhase
from iris_session.protocol.names import DenialReason
from iris_session.protocol.server_messages import EngagementChanged, ParticipantJoined, ParticipantLeft
from tests.e2e.conftest import Hand, Server, Stage, none_left, relatives, verify, wait

pytestmark = pytest.mark.e2e

#: Everything ends within 2 s of Ctrl-C; on a machine that other tests keep busy it may take much longer.
END_S = 30.0


@pytest.fixture
def alone(serve: Callable[..., Server]) -> Iterator[Stage]:
    """A session that the test ends."""
    stage = Stage(serve())
    yield stage
    stage.close()


@pytest.fixture
def stage(visit: Stage) -> Stage:
    """One session for all that leave it as it was."""
    return visit


@pytest.fixture
def driving(stage: Stage) -> Hand:
    """Ann moves the left robot."""
    return moving(stage)


@pytest.fixture
def holding(alone: Stage) -> Hand:
    """The same in a session that the test ends."""
    return moving(alone)


def moving(stage: Stage) -> Hand:
    hand = stage.hand(stage.join("ann"), "left")
    hand.client.acquire(["left"])
    stage.engage(hand)
    hand.velocity = (0.0, 0.02, 0.0)
    return hand


def left(stage: Stage, watcher: str, participant: str) -> list[str]:
    """Why a participant left, as `watcher` heard it."""
    bodies = [event.body for event in stage.events[watcher]]
    return [b.reason for b in bodies if isinstance(b, ParticipantLeft) and b.participant == participant]


# --- clients ----------------------------------------------------------------------------------------------------------


def test_lost_heartbeats_cost_nothing(stage: Stage, driving: Hand) -> None:
    """The reference shows an empty scene for ever. Here: silent for seconds, given up, back with everything."""
    stage.join("watcher", "observer")
    ann = driving.client
    me, bodies, lease = ann.participant_id, ann.mirror.bodies, ann.mirror.leases["left"]
    stage.clients.remove(ann)
    stage.hands.remove(driving)
    stage.run(lambda: left(stage, "watcher", me), "ann is given up")
    assert left(stage, "watcher", me) == ["silent"]
    stage.clients.append(ann)
    stage.hands.append(driving)
    stage.run(lambda: ann.connection.counters.reconnects > 0 and ann.ready, "ann is back")
    assert ann.participant_id == me
    assert ann.mirror.bodies == bodies
    assert ann.mirror.leases["left"].holder == me
    assert ann.mirror.leases["left"].lease_version > lease.lease_version
    stage.engage(driving)


def test_a_headset_that_hangs_in_its_join_does_not_keep_others_out(
    stage: Stage, driving: Hand, emulate: Callable[..., subprocess.Popen[bytes]]
) -> None:
    """Stopped between its hello and its first picture. The next one joins meanwhile, and state goes on."""
    people = emulate(stage.server.address, "name=eve,behaviour=idle")
    log = stage.events["ann"]
    stage.run(lambda: any(_joined(e.body) == "eve" for e in log), "eve has said hello")
    people.send_signal(signal.SIGSTOP)
    try:
        bob = stage.join("bob")
        assert bob.ready
        assert stage.following(driving)
        stage.run(lambda: bob.scene.state is not None, "bob sees the scene")
    finally:
        people.send_signal(signal.SIGCONT)
    eve = next(p for p in bob.mirror.participants.values() if p.name == "eve")
    stage.run(lambda: bob.mirror.participants[eve.id].connected, "eve is in, now or again")
    assert [p.name for p in bob.mirror.participants.values()].count("eve") == 1


def _joined(body: object) -> str:
    return body.participant.name if isinstance(body, ParticipantJoined) else ""


def test_a_headset_that_sleeps_and_wakes(stage: Stage, emulate: Callable[..., subprocess.Popen[bytes]]) -> None:
    """A process stands still for longer than heartbeats may be missing; it wakes as who it was, with its robot."""
    watcher = stage.join("watcher", "observer")
    people = emulate(stage.server.address, "name=ann,behaviour=wander,robot=left")

    def driven() -> bool:
        state = watcher.scene.state
        return state is not None and any(
            a.robot == "left" and watcher.session_now_ns() - a.step_ns < 100_000_000 for a in state.header.applied
        )

    stage.run(driven, "ann moves the left robot")
    me = watcher.mirror.leases["left"].holder
    people.send_signal(signal.SIGSTOP)
    try:
        stage.run(lambda: left(stage, "watcher", me), "ann is given up")
        assert watcher.mirror.leases["left"].holder == me, "the lease waits"
        stage.seconds(1.0)
    finally:
        people.send_signal(signal.SIGCONT)
    stage.run(lambda: watcher.mirror.participants[me].connected, "ann is back as who she was")
    stage.run(driven, "and moves her robot again")
    assert watcher.mirror.leases["left"].holder == me


def test_an_app_that_hangs_but_heartbeats(serve: Callable[..., Server]) -> None:
    """No samples for seconds: its robot holds, its lease stays, and by the mode's rules another may take over."""
    stage = Stage(serve("handover", "--mode", "takeover"))
    try:
        hand = stage.hand(stage.join("ann"), "left")
        ann = hand.client
        ann.acquire(["left"])
        stage.engage(hand)
        hand.velocity = (0.0, 0.05, 0.0)
        bob = stage.join("bob")
        hand.sending = False
        stage.run(lambda: "stale" in _disengaged(stage), "the robot holds")
        stage.seconds(0.7)
        resting = hand.tip
        stage.seconds(3.0)  # longer than heartbeats may be missing
        assert distance(resting[0], hand.tip[0]) < 1e-3
        assert ann.connection.counters.reconnects == 0
        assert bob.mirror.leases["left"].holder == ann.participant_id
        bob.acquire(["left"])
        stage.engage(stage.hand(bob, "left"))
        hand.sending = True
        stage.seconds(0.3)
        assert bob.mirror.leases["left"].holder == bob.participant_id
        stage.server.finish()
    finally:
        stage.close()


def _disengaged(stage: Stage) -> list[str]:
    bodies = [event.body for event in stage.events["bob"]]
    return [b.reason for b in bodies if isinstance(b, EngagementChanged) and not b.engaged]


def test_an_app_that_hangs_keeps_an_exclusive_robot(stage: Stage, driving: Hand) -> None:
    driving.sending = False
    bob = stage.join("bob")
    stage.seconds(0.5)
    with pytest.raises(DeniedError) as denied:
        bob.acquire(["left"])
    assert denied.value.denial.reason == DenialReason.HELD
    assert denied.value.denial.holder_name == "ann"


@pytest.mark.parametrize("phase", [ConnectionPhase.JOINING, ConnectionPhase.SYNCING])
def test_killed_in_mid_transfer_again_and_again(stage: Stage, phase: ConnectionPhase) -> None:
    """Its hello, or its first picture, is on the way when it dies; it comes back as who it was, with its robot."""
    watcher = stage.join("watcher", "observer")
    identity = str(stage.server.folder / f"ann-{phase}.identity")
    first = stage.join("ann", identity=identity)
    first.acquire(["left"])
    me = first.participant_id
    _die(stage, first)
    for _ in range(8):
        dying = Client(stage.server.address, name="ann", identity=identity, alignment="not_needed")
        dying.open()
        deadline = time.monotonic() + 20.0
        while dying.connection.phase is not phase and time.monotonic() < deadline:
            dying.poll(0.0)
        assert dying.connection.phase is phase
        dying.poll(0.0)
        dying._sockets.close()
        stage.step()
    back = stage.join("ann", identity=identity)
    assert back.participant_id == me
    assert back.lease_version("left") is not None
    stage.run(lambda: watcher.mirror.participants[me].connected, "everybody sees her")
    assert [p.name for p in watcher.mirror.participants.values()].count("ann") == 1
    stage.engage(stage.hand(back, "left"))


def _die(stage: Stage, client: Client) -> None:
    """No goodbye: the sockets are closed, as those of a killed process."""
    client._sockets.close()
    stage.clients.remove(client)


# --- nonsense ---------------------------------------------------------------------------------------------------------


@pytest.fixture
def noise(stage: Stage) -> Iterator[list[int]]:
    """Somebody who writes nonsense to every port, as fast as it goes. Counts what was written."""
    host, _, port = stage.server.address.rpartition(":")
    control = int(port)
    sent = [0]
    ended = threading.Event()
    frames = [
        b"\xff\x00\x00\x00\x00\x00\x00\x00\x01\x7f\x03\x00NULL" + bytes(48),  # a greeting of ZMTP, then garbage
        b"GET / HTTP/1.1\r\n\r\n",
        bytes(range(256)) * 16,
    ]

    def shout() -> None:
        n = 0
        while not ended.wait(0.002):
            for offset in (0, -1, 1):
                n += 1
                try:
                    with socket.create_connection((host, control + offset), 0.5) as visitor:
                        visitor.sendall(frames[n % 3] + os.urandom(64))
                        sent[0] += 1
                except OSError:
                    continue

    thread = threading.Thread(target=shout, daemon=True)
    thread.start()
    yield sent
    ended.set()
    thread.join()


def test_nonsense_on_every_port_disturbs_nobody(stage: Stage, driving: Hand, noise: list[int]) -> None:
    """Three malformed frames kill the reference's service port for good."""
    import zmq

    front = stage.server.children()["front.main"].pid
    with zmq.Context() as context, context.socket(zmq.DEALER) as raw:
        raw.setsockopt(zmq.LINGER, 0)
        raw.connect(f"tcp://{stage.server.address}")
        for n in range(2000):
            with contextlib.suppress(zmq.Again):  # the front has closed this connection; it is made anew
                raw.send_multipart([os.urandom(1 + n % 300), b"", os.urandom(n % 7)][: 1 + n % 3], zmq.NOBLOCK)
            stage.step()
    stage.run(lambda: noise[0] > 300, "hundreds of broken connections")
    if not stage.following(driving):  # on a busy machine a sample came too late, nonsense or not
        stage.engage(driving)
    assert driving.client.connection.counters.reconnects == 0
    late = stage.join("late", "observer")
    stage.run(lambda: late.scene.state is not None, "who joins now sees the scene")
    assert stage.server.children()["front.main"].pid == front


# --- the machine ------------------------------------------------------------------------------------------------------


def test_a_machine_that_slept(stage: Stage, driving: Hand) -> None:
    """All processes of the session stand still, as in a suspend: a gap, then everybody goes on with what they had."""
    ann = driving.client
    me, gaps = ann.participant_id, stage.server.output.count("kind=stalled")
    everyone = [psutil.Process(stage.server.process.pid), *relatives(stage.server.process.pid)]
    for process in everyone:
        process.suspend()
    try:
        stage.seconds(4.0)
    finally:
        for process in everyone:
            process.resume()
    stage.run(lambda: stage.server.output.count("kind=stalled") > gaps, "the gap is an event")
    stage.run(lambda: ann.ready, "ann is there")
    assert ann.participant_id == me
    assert ann.mirror.leases["left"].holder == me
    driving.velocity = (0.0, 0.0, 0.0)
    stage.engage(driving)


#: Loaded by every Python process of the session: each reading of the wall clock is a year off, either way.
JUMPING = """
import itertools, time
_time, _time_ns, _n = time.time, time.time_ns, itertools.count()
time.time = lambda: _time() + (-1) ** next(_n) * 3.15e7
time.time_ns = lambda: _time_ns() + (-1) ** next(_n) * 31_500_000_000_000_000
"""


def test_a_wall_clock_that_jumps_changes_nothing(
    serve: Callable[..., Server], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text(JUMPING)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    stage = Stage(serve())
    try:
        hand = stage.hand(stage.join("ann"), "left")
        hand.client.acquire(["left"])
        stage.engage(hand)
        before = hand.client.session_now_ns()
        stage.seconds(4.0)  # longer than heartbeats may be missing
        assert hand.client.session_now_ns() - before == pytest.approx(4e9, abs=1e9)
        assert stage.following(hand)
        assert hand.client.connection.counters.reconnects == 0
        report = stage.server.finish()
        assert report["finished"]
    finally:
        stage.close()


# --- Ctrl-C -----------------------------------------------------------------------------------------------------------


def interrupted(server: Server) -> None:
    """Ctrl-C: the process ends soon, whatever the state, and nothing stays behind."""
    children = relatives(server.process.pid)
    began = time.monotonic()
    server.process.send_signal(signal.SIGINT)
    wait(lambda: server.process.poll() is not None, "the session ends", END_S)
    print(f"ended after {time.monotonic() - began:.2f} s")
    none_left(children)


def test_ctrl_c_while_somebody_joins_and_drives(
    alone: Stage, holding: Hand, emulate: Callable[..., subprocess.Popen[bytes]]
) -> None:
    people = emulate(alone.server.address, "name=eve,behaviour=idle")
    alone.run(lambda: any(_joined(e.body) == "eve" for e in alone.events["ann"]), "eve has said hello")
    people.send_signal(signal.SIGSTOP)
    try:
        interrupted(alone.server)
    finally:
        people.send_signal(signal.SIGCONT)
    assert alone.server.process.returncode == 0
    assert alone.server.verify()["finished"]


def test_ctrl_c_while_paused(alone: Stage) -> None:
    director = alone.join("dora", "director")
    director.control("pause")
    alone.run(lambda: director.mirror.paused, "physics stands still")
    interrupted(alone.server)
    assert alone.server.process.returncode == 0
    assert alone.server.verify()["finished"]


def test_ctrl_c_while_the_recorder_hangs(alone: Stage, holding: Hand) -> None:
    """What it did not take is lost, and said; what it wrote verifies."""
    alone.seconds(0.5)
    alone.server.children()["recording.process"].suspend()
    alone.seconds(0.3)
    interrupted(alone.server)
    assert alone.server.process.returncode == 1
    assert "the end of the recording is missing" in alone.server.output
    report = verify(alone.server.recording)
    assert not report["finished"]
    assert report["problems"] == []


def test_ctrl_c_while_the_front_hangs(alone: Stage, holding: Hand) -> None:
    alone.server.children()["front.main"].suspend()
    interrupted(alone.server)
    assert alone.server.process.returncode == 0
    assert alone.server.verify()["finished"]
