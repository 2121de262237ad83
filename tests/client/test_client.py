"""The client against the real front and the real authority, in simulated time."""

from __future__ import annotations

import itertools
import socket
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from zmq.auth import create_certificates

from iris_session.client import (
    Client,
    ClientError,
    CurveKeys,
    IdentityError,
    NotConnectedError,
    RefusedError,
    SceneState,
)
from iris_session.client.core.status import ConnectionPhase
from iris_session.protocol.client_messages import Acquire, EStop, Sample
from iris_session.protocol.names import DenialReason, Device
from tests.client.session import BODIES, ClientSession
from tests.client.threads import ThreadedClient

Join = Callable[..., Client]
HERE = ((0.1, 0.2, 0.3), (1.0, 0.0, 0.0, 0.0))


def test_session_time_is_within_the_stated_error(session: ClientSession, join: Join) -> None:
    ann = join()
    assert ann.wait_for(lambda c: c.clock_error_ns() < 5_000_000)
    assert abs(ann.session_now_ns() - session.now_ns) <= ann.clock_error_ns()


def test_state_is_fresh_decoded_and_aged_at_delivery(join: Join) -> None:
    states: list[SceneState] = []
    ann = join(on_state=states.append)
    assert ann.wait_for(lambda c: len(states) >= 20)
    for state in states:
        assert state.poses.shape == (len(BODIES), 7)
        assert np.abs(state.poses[:, 0] - 0.1 * state.header.session_time / 1e9).max() < 1e-3
    assert all(-2_000_000 < state.age_ns < 30_000_000 for state in states[10:])
    assert all(a.header.state_seq < b.header.state_seq for a, b in itertools.pairwise(states))
    tip, body = ann.scene.tip_pose("left"), ann.scene.body_pose("left/hand")
    assert tip is not None
    assert body is not None
    assert tip[0][2] == pytest.approx(body[0][2] + 0.1)
    assert ann.scene.tip_pose("nobody") is None
    assert ann.scene.body_pose("nothing") is None


def test_refused_clients_raise_and_close_everything(session: ClientSession) -> None:
    chef = session.make_client(role="chef")
    with pytest.raises(RefusedError) as refused, chef:
        pass
    assert refused.value.code == DenialReason.UNKNOWN_VALUE
    assert chef.connection.phase is ConnectionPhase.CLOSED
    with pytest.raises(NotConnectedError):
        session.make_client().request(Acquire(0))


def test_unreachable_session_raises() -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))  # without listening
        client = Client(f"127.0.0.1:{free.getsockname()[1]}")
        with pytest.raises(NotConnectedError):
            client.connect(0.01)
        client.close()


# --- the thread of `start` --------------------------------------------------------------------------------------------


def test_polling_in_a_thread() -> None:
    with ThreadedClient() as ann:
        ann.client.start()
        with pytest.raises(ClientError):
            ann.client.poll()
        assert ann.client.status(30.0).session_name == "lab"
        assert ann.client.send_sample(Device.HEAD, HERE)
        ann.wait_sent(Sample)
    assert ann.client._loop._thread is not None
    assert not ann.client._loop._thread.is_alive(), "close wakes it: an idle one waits for its next heartbeat"


def test_raising_callback_ends_the_thread_and_reaches_every_caller(capfd: pytest.CaptureFixture[str]) -> None:
    def fail(_: Any) -> None:
        raise ZeroDivisionError

    with ThreadedClient(on_event=fail) as ann:
        ann.client.start()
        ann.push_event()
        calls: tuple[Callable[[], object], ...] = (
            lambda: ann.client.wait_for(lambda c: False, 30.0),
            lambda: ann.client.acquire(["left"]),
            lambda: ann.client.marker("x"),
            lambda: ann.client.send_sample(Device.HEAD, HERE),
            lambda: ann.client.estop("nevertheless"),
        )
        for call in calls:
            with pytest.raises(NotConnectedError) as raised:
                call()
            assert isinstance(raised.value.__cause__, ZeroDivisionError)
        assert not ann.client.ready
        ann.wait_sent(EStop)
    assert capfd.readouterr().err.count("Traceback") == 1


def test_only_the_polling_thread_uses_the_media_socket() -> None:
    with ThreadedClient() as ann:
        ann.client.start()
        ann.client.media.subscribe("cloud")
        assert ann.client.wait_for(lambda c: "cloud" in c.media._subscribed, 30.0)
        ann.client.media.unsubscribe("cloud")
        assert ann.client.wait_for(lambda c: not c.media._subscribed, 30.0)
        assert set(ann.sockets.media_threads) == {ann.client._loop._thread}
        assert threading.current_thread() not in ann.sockets.media_threads


# --- keys -------------------------------------------------------------------------------------------------------------


def test_invalid_key_files_are_rejected(tmp_path: Path) -> None:
    public, secret = create_certificates(tmp_path, "ann")
    with pytest.raises(IdentityError, match="chmod 600"):
        CurveKeys.from_files(public, secret)
    Path(secret).chmod(0o600)
    assert CurveKeys.from_files(public, secret).public == CurveKeys.from_files(public, secret).server_public
    for server, own in ((public, public), (tmp_path / "missing.key", public)):
        with pytest.raises(IdentityError):
            CurveKeys.from_files(server, own)
