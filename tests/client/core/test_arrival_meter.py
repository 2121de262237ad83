"""Reports of a client about arriving state, and the status it can request."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np
import pytest

from iris_session.client import Client, NotConnectedError
from iris_session.client.core.arrival_meter import PERIOD_NS, ArrivalMeter
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.state_stream import SceneState
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.identity import Identity
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.server_messages import StateHeader
from tests.client.session import ClientSession

MS = 1_000_000


@pytest.fixture
def connection() -> ClientConnection:
    """Return a joined connection."""
    connection = ClientConnection(Hello("observer", "ann"), Identity.in_memory())
    connection.phase = ConnectionPhase.READY
    return connection


def frame(seq: int, age_ns: int) -> SceneState:
    return SceneState(StateHeader(1, 0, 0, 0.0, seq * MS, 0, seq, 0), np.zeros((0, 7)), age_ns, age_ns)


def test_repeated_states_are_not_measured(connection: ClientConnection) -> None:
    """Their source is silent and they grow old: no reason to reduce this client's rate or to blame its link."""
    meter = ArrivalMeter()
    meter.poll_report(connection, 0)
    again = frame(2, 0).header
    meter.record(frame(1, 2 * MS))
    meter.record(frame(2, 2 * MS))
    for second in range(1, 5):
        meter.record(
            SceneState(msgspec.structs.replace(again, state_seq=2 + second), np.zeros((0, 7)), 0, second * 10**9)
        )
        report = meter.poll_report(connection, second * PERIOD_NS)
        assert report is not None
        assert (report.age_ms_p50, report.age_ms_p99, report.missed) == (2.0, 2.0, 0)
        assert report.delivered
    meter.record(frame(9, 7 * MS))
    report = meter.poll_report(connection, 6 * PERIOD_NS)
    assert report is not None
    assert report.age_ms_p50 == 7.0


def test_status_of_a_session(session: ClientSession, join: Callable[..., Client]) -> None:
    client = join("ann")
    report = client.status()
    assert (report.session_id, report.connections) == ("s1", 1)
    assert client.status().session_time > report.session_time
    session.paused = True
    late = session.make_client("bob")
    late.open()
    report = late.status()
    assert not late.ready
    assert report.authority_silent_ns > 0
    unopened = session.make_client()
    with pytest.raises(NotConnectedError):
        unopened.status(0.2)
