"""The client against a real front process and the real authority."""

from __future__ import annotations

import itertools
import os
import signal
import socket
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from zmq.auth import create_certificates

from iris_session.client import (
    Client,
    ClientError,
    CurveKeys,
    DeniedError,
    IdentityError,
    NotConnectedError,
    RefusedError,
    RequestTimeoutError,
    SceneState,
    poll_all,
)
from iris_session.client.address import Address
from iris_session.client.core.status import ConnectionPhase
from iris_session.protocol.client_messages import Acquire, EStop, Sample
from iris_session.protocol.common import IDENTITY
from iris_session.protocol.names import DenialReason, Device, HoldReason
from iris_session.protocol.server_messages import Event, LeaseChanged, PresenceItem
from tests.client.harness import BODIES, LiveSession

Join = Callable[..., Client]
HERE = ((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))
CLOCK_ERROR_NS = 20_000_000


def has_state(client: Client) -> bool:
    return client.scene.state is not None


def has_clock(client: Client) -> bool:
    """Return whether the clock is as exact as on a machine with time to spare: on another one it takes longer."""
    return client.clock_error_ns() < CLOCK_ERROR_NS


def test_client_joins_and_sees_the_session(session: LiveSession, join: Join) -> None:
    ann = join(devices=(Device.CONTROLLER_RIGHT,))
    bob = join("bob", role="observer")
    assert ann.ready
    assert ann.participant_id != bob.participant_id
    assert ann.wait_for(lambda c: bob.participant_id in c.mirror.participants)
    assert set(ann.mirror.robots) == {"left", "right"}
    assert [body.name for body in ann.mirror.bodies] == list(BODIES)
    assert ann.mirror.leases["left"].holder == ""


def test_session_time_is_within_the_stated_error(session: LiveSession, join: Join) -> None:
    ann = join()
    assert ann.wait_for(has_clock)
    before = session.now_ns
    mine = ann.session_now_ns()
    after = session.now_ns
    assert before - ann.clock_error_ns() <= mine <= after + ann.clock_error_ns()


def test_state_is_fresh_decoded_and_aged_at_delivery(session: LiveSession, join: Join) -> None:
    states: list[SceneState] = []
    ann = join(on_state=states.append)
    assert ann.wait_for(has_clock)
    states.clear()
    assert ann.wait_for(lambda c: len(states) >= 10)
    for state in states:
        assert state.poses.shape == (len(BODIES), 7)
        moved = 0.1 * state.header.session_time / 1e9
        assert np.abs(state.poses[:, 0] - moved).max() < 2e-3
        assert state.age_ns > -CLOCK_ERROR_NS, "negative only by the error of the clock"
    assert sorted(state.age_ns for state in states)[len(states) // 2] < 2_000_000_000, "but on a machine that stalls"
    assert all(a.header.state_seq < b.header.state_seq for a, b in itertools.pairwise(states))
    tip, body = ann.scene.tip_pose("left"), ann.scene.body_pose("left/hand")
    assert tip is not None
    assert body is not None
    assert tip[0][2] == pytest.approx(body[0][2] + 0.1)
    assert ann.scene.tip_pose("nobody") is None
    assert ann.scene.body_pose("nothing") is None


def test_leases_pass_between_two_participants(session: LiveSession, join: Join) -> None:
    events: list[Event] = []
    ann, bob = join(on_event=events.append), join("bob")
    (lease,) = ann.acquire(["left"])
    assert lease.holder == ann.participant_id
    assert ann.lease_version("left") == lease.lease_version  # at once, before or after the event
    with pytest.raises(DeniedError, match="ann") as denied:
        bob.acquire(["left", "right"])
    assert denied.value.denial.reason == DenialReason.HELD
    assert denied.value.denial.holder == ann.participant_id
    assert bob.lease_version("right") is None  # all or none
    ann.release("left")
    assert ann.wait_for(lambda c: c.lease_version("left") is None)
    assert bob.acquire(["left"])[0].holder == bob.participant_id
    assert ann.wait_for(lambda c: c.mirror.leases["left"].holder == bob.participant_id)
    assert any(isinstance(event.body, LeaseChanged) for event in events)


def test_samples_engage_the_robot_and_estop_stops_it(session: LiveSession, join: Join) -> None:
    ann = join(role="agent", devices=(Device.TARGET,))
    ann.acquire(["left"])

    def stream(clutch: bool) -> None:
        assert ann.send_sample(Device.TARGET, HERE, robots=["left"], clutch=clutch)
        ann.poll(0.01)

    def until(kind: str) -> None:
        began = time.monotonic()
        while session.commands.get("left") != kind:
            seconds = time.monotonic() - began
            assert seconds < 30.0, session.commands
            stream(seconds % 2.0 < 1.8)  # after a gap, as of a machine that stalls, the clutch must be opened first

    stream(False)
    until("pose")
    assert ann.wait_for(lambda c: "left" in c.feedback)
    ann.estop("test")
    until("hold")
    assert ann.wait_for(lambda c: c.mirror.estop)
    assert ann.wait_for(lambda c: c.feedback["left"].hold_reason == HoldReason.ESTOP)


def test_samples_have_epochs_versions_and_tokens(session: LiveSession, join: Join) -> None:
    ann = join(devices=(Device.HEAD, Device.CONTROLLER_RIGHT))
    first = ann.make_sample(Device.CONTROLLER_RIGHT, HERE, robots=["left"], clutch=True)
    assert first.targets == ()  # not our robot: presence only
    (lease,) = ann.acquire(["left"])
    second = ann.make_sample(Device.CONTROLLER_RIGHT, HERE, robots=["left", "right"], gripper=0.5)
    assert [(t.name, t.lease_version) for t in second.targets] == [("left", lease.lease_version)]
    assert second.seq == first.seq + 1
    assert second.scene_epoch == ann.mirror.scene_epoch
    assert ann.alignment.report_tracking_jump() == 1
    assert ann.make_sample(Device.HEAD, HERE).tracking_epoch == 1


def test_reset_changes_the_epoch_and_state_continues(session: LiveSession, join: Join) -> None:
    ann = join()
    ann.wait_for(has_state)
    session.reset()
    assert ann.wait_for(lambda c: c.mirror.scene_epoch == 2)
    assert ann.wait_for(lambda c: c.scene.state is not None and c.scene.state.header.scene_epoch == 2)
    assert ann.counters()["control"]["snapshots"] == 1


def test_late_joiner_has_the_same_mirror(session: LiveSession, join: Join) -> None:
    early = join()
    early.acquire(["left"])
    leaver = join("gone")
    leaver.close()
    early.acquire(objects=["hammer"]) if early.mirror.leases.get("hammer") else None
    late = join("late", role="observer")
    same = [False]

    def equal(_: Client) -> bool:
        poll_all([early, late])
        same[0] = early.mirror.event_seq == late.mirror.event_seq
        return same[0]

    assert early.wait_for(equal)
    assert early.mirror.mirror_hash() == late.mirror.mirror_hash()


def test_killed_front_is_replaced_and_everything_kept(session: LiveSession, join: Join) -> None:
    ann = join()
    (lease,) = ann.acquire(["left"])
    participant = ann.participant_id
    os.kill(session.front.pid, signal.SIGKILL)
    assert ann.wait_for(lambda c: not c.ready)
    assert not ann.send_sample(Device.HEAD, HERE)
    assert ann.counters()["control"]["samples_not_sent"] == 1
    assert ann.wait_for(lambda c: c.ready)
    assert ann.participant_id == participant
    assert ann.connection.welcome is not None
    assert ann.connection.welcome.resumed
    assert (ann.lease_version("left") or 0) > lease.lease_version  # same holder, new fencing token
    seen = ann.scene.state
    assert ann.wait_for(lambda c: c.scene.state is not seen)


def test_restarted_process_resumes_with_its_identity_file(session: LiveSession, join: Join, tmp_path: Path) -> None:
    path = tmp_path / "identity"
    killed = join(identity=path)
    killed.acquire(["left"])
    participant = killed.participant_id
    killed._sockets.close()  # as if killed: no bye
    again = join(identity=path)
    assert again.participant_id == participant
    assert again.wait_for(lambda c: c.lease_version("left") is not None)
    killed.connection.phase = killed.connection.phase.CLOSED


def test_second_client_with_the_same_identity_takes_over_permanently(
    session: LiveSession, join: Join, tmp_path: Path
) -> None:
    first = join(identity=tmp_path / "identity")
    second = join(identity=tmp_path / "identity")
    with pytest.raises(RefusedError, match="identity"):
        first.wait_for(lambda c: False)
    assert second.participant_id == first.participant_id
    first.close()
    assert second.acquire(["left"])[0].holder == second.participant_id, "it took nothing back"


def test_stalled_session_is_detected_and_recovers(session: LiveSession, join: Join) -> None:
    ann = join()
    session.pause_steps(True)
    assert ann.wait_for(lambda c: c.connection.stalled)
    with pytest.raises(RequestTimeoutError):
        ann.request(Acquire(0, ("left",)), timeout_s=0.2)
    session.pause_steps(False)
    assert ann.wait_for(lambda c: not c.connection.stalled)
    assert ann.ready


@pytest.mark.parametrize("session", [2_000_000_000], indirect=True)
def test_first_state_after_a_client_stall_is_fresh_and_the_lease_is_kept(session: LiveSession, join: Join) -> None:
    states: list[SceneState] = []
    ann = join(on_state=states.append)
    (lease,) = ann.acquire(["left"])
    ann.wait_for(has_state)
    session.wait_lost(ann.participant_id)  # no polls meanwhile
    states.clear()
    assert ann.wait_for(lambda c: len(states) >= 3)
    assert min(state.age_ns for state in states[:3]) < 1_000_000_000, "one may have lain in the socket all the while"
    assert ann.wait_for(lambda c: c.ready and (c.lease_version("left") or 0) > lease.lease_version)
    assert ann.counters()["control"]["reconnects"] == 1


def test_bye_frees_robots_at_once(session: LiveSession, join: Join) -> None:
    ann, bob = join(), join("bob")
    ann.acquire(["left"])
    ann.close()
    assert bob.wait_for(lambda c: c.mirror.leases["left"].holder == "")
    assert bob.wait_for(lambda c: ann.participant_id not in c.mirror.participants)
    with pytest.raises(NotConnectedError):
        ann.connect()


def test_refused_and_unreachable_sessions_raise_with_advice(session: LiveSession, join: Join) -> None:
    with pytest.raises(RefusedError, match="operator") as refused:
        join(role="chef")
    assert refused.value.code == DenialReason.UNKNOWN_VALUE
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        unreachable = Client(f"127.0.0.1:{free.getsockname()[1]}")
        with pytest.raises(NotConnectedError, match="iris-session serve"):
            unreachable.connect(0.2)
        unreachable.close()
    client = Client(session.address)
    with pytest.raises(NotConnectedError, match="connect"):
        client.request(Acquire(0))
    client.close()


def test_polling_in_a_thread(session: LiveSession, join: Join) -> None:
    with join() as ann:
        ann.start()
        with pytest.raises(ClientError, match="thread"):
            ann.poll()
        assert ann.acquire(["right"])[0].target == "right"
        with pytest.raises(DeniedError):
            ann.acquire(["nothing"])
        assert ann.wait_for(has_state)
        assert ann.send_sample(Device.HEAD, HERE)
        deadline = time.monotonic() + 30.0
        while not session.messages_of(Sample):
            assert time.monotonic() < deadline
            time.sleep(0.01)


def test_raising_callback_ends_the_thread_and_reaches_every_caller(
    session: LiveSession, join: Join, capfd: pytest.CaptureFixture[str]
) -> None:
    def fail(_: Event) -> None:
        raise ZeroDivisionError("mine")

    ann = join(on_event=fail)
    ann.start()
    join("bob")
    with pytest.raises(NotConnectedError, match="ZeroDivisionError: mine"):
        ann.wait_for(lambda c: False)
    assert not ann.ready
    for call in (lambda: ann.acquire(["left"]), lambda: ann.marker("x"), lambda: ann.send_sample(Device.HEAD, HERE)):
        with pytest.raises(NotConnectedError, match="ZeroDivisionError: mine"):
            call()
    with pytest.raises(NotConnectedError):
        ann.estop("nevertheless")
    deadline = time.monotonic() + 30.0
    while not session.messages_of(EStop):
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert capfd.readouterr().err.count("ZeroDivisionError: mine") == 1


def test_estop_during_a_restart_of_the_front_arrives(session: LiveSession, join: Join) -> None:
    ann = join()
    os.kill(session.front.pid, signal.SIGKILL)
    assert ann.wait_for(lambda c: not c.ready)
    ann.estop("while the front restarts")
    assert ann.wait_for(lambda c: c.ready and c.mirror.estop)
    assert ann.wait_for(lambda c: c.connection.pending_estop.message is None)


def test_estop_into_a_dead_connection_arrives_after_reconnect(session: LiveSession, join: Join) -> None:
    ann = join()
    ann._sockets._close_control(linger_ms=0)  # the network is cut, and not detected yet
    ann.estop("into the void")
    ann.connection.handle_disconnect(time.monotonic_ns())
    assert ann.wait_for(lambda c: c.mirror.estop)


def test_reconnected_client_reads_state_from_a_new_socket(session: LiveSession, join: Join) -> None:
    ann = join()
    assert ann.wait_for(has_state)
    half_open = ann._sockets._state
    ann.connection.handle_disconnect(time.monotonic_ns())
    seen = ann.scene.state
    assert ann.wait_for(lambda c: c.ready and c.scene.state is not seen)
    assert ann._sockets._state is not half_open


def test_client_that_cannot_join_closes_everything(session: LiveSession) -> None:
    chef = Client(session.address, role="chef")
    with pytest.raises(RefusedError), chef:
        pass
    assert chef.connection.phase is ConnectionPhase.CLOSED


def test_presence_shows_connected_participants_only(session: LiveSession, join: Join) -> None:
    ann = join()
    ghost = PresenceItem("p99", "head", IDENTITY)
    ann.connection.stream._presence["p99", "head"] = ghost
    assert ann.scene.presence == {}
    assert ann.scene.presence is not ann.scene.presence


def test_close_wakes_the_client_thread(session: LiveSession, join: Join) -> None:
    ann = join()
    ann.start()
    ann.close()  # would not come back: an idle thread waits until its next heartbeat, and then again
    assert ann._loop._thread is not None
    assert not ann._loop._thread.is_alive()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("127.0.0.1:7000", ("127.0.0.1", 7000)),
        ("lab.local", ("lab.local", 7721)),
        ("tcp://lab:1/", ("lab", 1)),
        ("[::1]:7000", ("::1", 7000)),
        ("::1", ("::1", 7721)),
        ("[::1]", ("::1", 7721)),
    ],
)
def test_addresses_are_parsed(text: str, expected: tuple[str, int]) -> None:
    address = Address.parse(text)
    assert (address.host, address.port) == expected


@pytest.mark.parametrize("text", ["", ":7721", "host:", "host:x", "host:70000", "[]:1"])
def test_invalid_addresses_are_rejected(text: str) -> None:
    with pytest.raises(ClientError, match="HOST:PORT"):
        Address.parse(text)


def test_listed_keys_join_and_others_do_not(tmp_path: Path) -> None:
    allowed = tmp_path / "clients"
    allowed.mkdir()
    server_public, server_secret = create_certificates(tmp_path, "server")
    _, ann_secret = create_certificates(allowed, "ann")
    _, eve_secret = create_certificates(tmp_path, "eve")
    for secret in (server_secret, ann_secret, eve_secret):
        Path(secret).chmod(0o600)
    session = LiveSession(curve_secret_file=server_secret, curve_clients_dir=str(allowed))
    try:
        with Client(session.address, name="ann", curve=CurveKeys.from_files(server_public, ann_secret)) as ann:
            assert ann.wait_for(lambda c: c.scene.state is not None)
        eve = Client(session.address, name="eve", curve=CurveKeys.from_files(server_public, eve_secret))
        plain = Client(session.address, name="plain")
        for unlisted in (eve, plain):
            with pytest.raises(NotConnectedError):
                unlisted.connect(0.5)
            unlisted.close()
    finally:
        session.close()


def test_invalid_key_files_are_rejected(tmp_path: Path) -> None:
    public, secret = create_certificates(tmp_path, "ann")
    with pytest.raises(IdentityError, match=r"chmod 600 .*ann.key_secret"):
        CurveKeys.from_files(public, secret)
    Path(secret).chmod(0o600)
    assert CurveKeys.from_files(public, secret).public == CurveKeys.from_files(public, secret).server_public
    with pytest.raises(IdentityError, match="key_secret"):
        CurveKeys.from_files(public, public)
    with pytest.raises(IdentityError, match="cannot be used"):
        CurveKeys.from_files(tmp_path / "missing.key", public)
