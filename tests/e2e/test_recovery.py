"""Failures of clients and of the machine, one per test: headsets that hang, sleep or die, garbage on the ports, clocks.

Other clients are not disturbed, and a client that reconnects gets its state back. docs/recovery.md lists the failures;
those of the session's own processes are in test_process_failures.py.
"""

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
from iris_session.protocol.names import DenialReason, HoldReason
from iris_session.protocol.server_messages import EngagementChanged
from tests.e2e.scenario import Hand, Scenario, is_driven
from tests.e2e.session_process import DEADLINE_S, SessionProcess, list_descendants
from tests.e2e.session_time import run_ticks

pytestmark = pytest.mark.e2e


@pytest.fixture
def scenario(shared_scenario: Scenario) -> Scenario:
    """All tests leave the session as it was."""
    return shared_scenario


@pytest.fixture
def driving(scenario: Scenario) -> Hand:
    """Ann moves the left robot."""
    return scenario.drive("ann", "left", (0.0, 0.02, 0.0))


def wait_until_left(scenario: Scenario, watcher: Client, participant: str) -> str:
    """Wait until a participant is disconnected, and return why. On a busy machine `watcher` may miss the event."""
    scenario.run_until(lambda: not watcher.mirror.participants[participant].connected, "the participant has left")
    return next(p.lost for p in watcher.status(DEADLINE_S).participants if p.id == participant)


# --- clients ----------------------------------------------------------------------------------------------------------


def test_silent_client_resumes_everything(scenario: Scenario, driving: Hand) -> None:
    """A client that was silent for seconds is disconnected, and resumes with scene and lease."""
    watcher = scenario.join("watcher", "observer")
    ann = driving.client
    me, bodies, lease = ann.participant_id, ann.mirror.bodies, ann.mirror.leases["left"]
    scenario.clients.remove(ann)
    scenario.hands.remove(driving)
    assert wait_until_left(scenario, watcher, me) == "silent"
    scenario.clients.append(ann)
    scenario.hands.append(driving)
    scenario.run_until(lambda: ann.connection.counters.reconnects > 0 and ann.ready, "ann has reconnected")
    assert ann.participant_id == me
    assert ann.mirror.bodies == bodies
    assert ann.mirror.leases["left"].holder == me
    assert ann.mirror.leases["left"].lease_version > lease.lease_version
    scenario.engage(driving)


def test_headset_that_hangs_while_joining_does_not_block_others(
    scenario: Scenario, driving: Hand, emulate: Callable[..., subprocess.Popen[bytes]]
) -> None:
    """It is suspended between its hello and its first state; meanwhile another client joins."""
    headset = emulate(scenario.server.address, "name=eve,behaviour=idle")
    scenario.run_until(lambda: scenario.has_seen_joining("ann", "eve"), "eve has sent hello")
    headset.send_signal(signal.SIGSTOP)
    try:
        bob = scenario.join("bob")
        assert bob.ready
        scenario.keep_engaged(driving)
        scenario.run_until(lambda: bob.scene.state is not None, "bob sees the scene")
    finally:
        headset.send_signal(signal.SIGCONT)
    eve = next(p for p in bob.mirror.participants.values() if p.name == "eve")
    scenario.run_until(lambda: bob.mirror.participants[eve.id].connected, "eve has joined")
    assert [p.name for p in bob.mirror.participants.values()].count("eve") == 1


def test_headset_that_sleeps_resumes_its_lease(
    scenario: Scenario, emulate: Callable[..., subprocess.Popen[bytes]]
) -> None:
    """Its process is suspended for longer than the heartbeat timeout."""
    watcher = scenario.join("watcher", "observer")
    headset = emulate(scenario.server.address, "name=ann,behaviour=wander,robot=left")

    def is_robot_driven() -> bool:
        state = watcher.scene.state
        return state is not None and any(
            a.robot == "left" and watcher.session_now_ns() - a.step_ns < 100_000_000 for a in state.header.applied
        )

    scenario.run_until(is_robot_driven, "ann moves the left robot")
    me = watcher.mirror.leases["left"].holder
    headset.send_signal(signal.SIGSTOP)
    try:
        wait_until_left(scenario, watcher, me)
        assert watcher.mirror.leases["left"].holder == me, "in the grace period"
        scenario.run_for(1.0)
    finally:
        headset.send_signal(signal.SIGCONT)
    scenario.run_until(lambda: watcher.mirror.participants[me].connected, "ann has reconnected")
    scenario.run_until(is_robot_driven, "ann moves the left robot again")
    assert watcher.mirror.leases["left"].holder == me


@pytest.mark.long
def test_app_that_hangs_but_sends_heartbeats(serve: Callable[..., SessionProcess]) -> None:
    """Without samples its robot holds and its lease stays; in mode takeover another client may acquire the robot."""
    scenario = Scenario(serve("handover", "--mode", "takeover"))
    try:
        hand = scenario.add_hand(scenario.join("ann"), "left")
        ann = hand.client
        ann.acquire(["left"])
        scenario.engage(hand)
        hand.velocity = (0.0, 0.05, 0.0)
        bob = scenario.join("bob")
        hand.sending = False
        scenario.run_until(
            lambda: {HoldReason.STALE, HoldReason.GAP} & set(list_disengagements(scenario)), "the robot holds"
        )
        run_ticks(scenario, bob, 0.7)
        resting = hand.tip

        def stays_connected() -> bool:
            """Tried again: on a busy machine this process or the front stands still for longer, too."""
            reconnects = ann.connection.counters.reconnects
            run_ticks(scenario, bob, 3.5)  # longer than the heartbeat timeout
            assert distance(resting[0], hand.tip[0]) < 1e-3
            return ann.connection.counters.reconnects == reconnects

        assert any(stays_connected() for _ in range(3))
        assert bob.mirror.leases["left"].holder == ann.participant_id
        bob.acquire(["left"])
        scenario.engage(scenario.add_hand(bob, "left"))
        hand.sending = True
        run_ticks(scenario, bob, 0.3)
        assert bob.mirror.leases["left"].holder == bob.participant_id
        scenario.server.finish()
    finally:
        scenario.close()


def list_disengagements(scenario: Scenario) -> list[str]:
    bodies = [event.body for event in scenario.events["bob"]]
    return [b.reason for b in bodies if isinstance(b, EngagementChanged) and not b.engaged]


def test_app_that_hangs_keeps_an_exclusive_robot(scenario: Scenario, driving: Hand) -> None:
    driving.sending = False
    bob = scenario.join("bob")
    scenario.run_until(lambda: bob.scene.state is not None and not is_driven(bob, "left"), "the robot holds")
    with pytest.raises(DeniedError) as denied:
        bob.acquire(["left"])
    assert denied.value.denial.reason == DenialReason.HELD
    assert denied.value.denial.holder_name == "ann"


@pytest.mark.parametrize("phase", [ConnectionPhase.JOINING, ConnectionPhase.SYNCING])
def test_client_killed_repeatedly_while_joining(scenario: Scenario, phase: ConnectionPhase) -> None:
    """It is killed while its hello or its first state is in transit; afterwards it resumes identity and lease."""
    watcher = scenario.join("watcher", "observer")
    identity = str(scenario.server.folder / f"ann-{phase}.identity")
    first = scenario.join("ann", identity=identity)
    first.acquire(["left"])
    me = first.participant_id
    drop_connection(scenario, first)
    for _ in range(8):
        dying = Client(scenario.server.address, name="ann", identity=identity, alignment="not_needed")
        dying.open()
        deadline = time.monotonic() + 20.0
        while dying.connection.phase is not phase and time.monotonic() < deadline:
            dying.poll(0.0)
        assert dying.connection.phase is phase
        dying.poll(0.0)
        dying._sockets.close()
        scenario.poll()
    back = scenario.join("ann", identity=identity)
    assert back.participant_id == me
    assert back.lease_version("left") is not None
    scenario.run_until(
        lambda: watcher.mirror.participants[me].connected, "ann is connected in the mirror of the watcher"
    )
    assert [p.name for p in watcher.mirror.participants.values()].count("ann") == 1
    scenario.engage(scenario.add_hand(back, "left"))


def drop_connection(scenario: Scenario, client: Client) -> None:
    """Close the sockets without goodbye, like those of a killed process."""
    client._sockets.close()
    scenario.clients.remove(client)


# --- garbage ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def garbage(scenario: Scenario) -> Iterator[list[int]]:
    """Write garbage to every port in the background. Yields the number of messages written."""
    host, _, port = scenario.server.address.rpartition(":")
    control = int(port)
    sent = [0]
    ended = threading.Event()
    frames = [
        b"\xff\x00\x00\x00\x00\x00\x00\x00\x01\x7f\x03\x00NULL" + bytes(48),  # a greeting of ZMTP, then garbage
        b"GET / HTTP/1.1\r\n\r\n",
        bytes(range(256)) * 16,
    ]

    def send() -> None:
        n = 0
        while not ended.wait(0.002):
            for offset in (0, -1, 1):
                n += 1
                try:
                    with socket.create_connection((host, control + offset), 0.5) as peer:
                        peer.sendall(frames[n % 3] + os.urandom(64))
                        sent[0] += 1
                except OSError:
                    continue

    thread = threading.Thread(target=send, daemon=True)
    thread.start()
    yield sent
    ended.set()
    thread.join()


@pytest.mark.long
def test_garbage_on_every_port_disturbs_no_client(scenario: Scenario, driving: Hand, garbage: list[int]) -> None:
    """The service port of the reference implementation dies of three malformed frames."""
    import zmq

    front = scenario.server.children()["front.main"].pid
    with zmq.Context() as context, context.socket(zmq.DEALER) as raw:
        raw.setsockopt(zmq.LINGER, 0)
        raw.connect(f"tcp://{scenario.server.address}")

        def stays_connected() -> bool:
            """Tried again: on a busy machine this process or the front stands still for longer than a heartbeat."""
            reconnects, sent = driving.client.connection.counters.reconnects, garbage[0]
            for n in range(2000):
                with contextlib.suppress(zmq.Again):  # the front has closed this connection; libzmq reconnects
                    raw.send_multipart([os.urandom(1 + n % 300), b"", os.urandom(n % 7)][: 1 + n % 3], zmq.NOBLOCK)
                scenario.poll()
            scenario.run_until(lambda: garbage[0] > sent + 300, "hundreds of broken connections")
            scenario.keep_engaged(driving)
            return driving.client.connection.counters.reconnects == reconnects

        assert any(stays_connected() for _ in range(3))
    late = scenario.join("late", "observer")
    scenario.run_until(lambda: late.scene.state is not None, "a late client receives state")
    assert scenario.server.children()["front.main"].pid == front


# --- the machine ------------------------------------------------------------------------------------------------------


@pytest.mark.long
def test_suspended_machine_keeps_leases(scenario: Scenario, driving: Hand) -> None:
    """All processes of the session are suspended: a gap, then clients continue with their leases."""
    ann = driving.client
    me, gaps = ann.participant_id, scenario.server.output.count("kind=stalled")
    processes = [psutil.Process(scenario.server.process.pid), *list_descendants(scenario.server.process.pid)]
    for process in processes:
        process.suspend()
    try:
        scenario.run_for(4.0)
    finally:
        for process in processes:
            process.resume()
    scenario.run_until(lambda: scenario.server.output.count("kind=stalled") > gaps, "the gap is an event")
    scenario.run_until(lambda: ann.ready, "ann is ready")
    assert ann.participant_id == me
    assert ann.mirror.leases["left"].holder == me
    driving.velocity = (0.0, 0.0, 0.0)
    scenario.engage(driving)


#: Loaded by every Python process of the session: the wall clock jumps by a year at each reading.
JUMPING_CLOCK = """
import itertools, time
_time, _time_ns, _n = time.time, time.time_ns, itertools.count()
time.time = lambda: _time() + (-1) ** next(_n) * 3.15e7
time.time_ns = lambda: _time_ns() + (-1) ** next(_n) * 31_500_000_000_000_000
"""


@pytest.mark.long
def test_wall_clock_jumps_change_nothing(
    serve: Callable[..., SessionProcess], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "sitecustomize.py").write_text(JUMPING_CLOCK)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    scenario = Scenario(serve())
    try:
        hand = scenario.add_hand(scenario.join("ann"), "left")
        hand.client.acquire(["left"])
        scenario.engage(hand)

        def stays_connected() -> bool:
            """Tried again: on a busy machine this process or the front stands still for longer, too."""
            reconnects = hand.client.connection.counters.reconnects
            began_ns, before = time.monotonic_ns(), hand.client.session_now_ns()
            scenario.run_for(4.0)  # longer than the heartbeat timeout
            passed, expected = hand.client.session_now_ns() - before, time.monotonic_ns() - began_ns
            assert passed == pytest.approx(expected, abs=1e9)
            scenario.keep_engaged(hand)
            return hand.client.connection.counters.reconnects == reconnects

        assert any(stays_connected() for _ in range(3))
        report = scenario.server.finish()
        assert report["finished"]
    finally:
        scenario.close()
