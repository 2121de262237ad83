"""E-stops of the client: none is lost between connections, none returns after it was acknowledged or withdrawn."""

from __future__ import annotations

import pytest

from iris_session.client.core.status import ConnectionPhase
from iris_session.protocol.client_messages import Acquire, ClearEStop, ClockPing, EStop, Hello, Release
from iris_session.protocol.server_messages import ClockPong, EStopChanged, Event
from tests.client.core.test_connection import MS, SAMPLE, SECOND, Wire

STOP = EStop("now")


@pytest.fixture
def wire() -> Wire:
    one = Wire()
    one.join()
    return one


def stops(wire: Wire) -> int:
    return wire.sent().count(STOP)


def test_stop_lost_with_its_connection_is_sent_after_the_next_hello_and_the_welcome(wire: Wire) -> None:
    assert wire.connection.send(STOP)
    wire.connection.handle_disconnect(2 * SECOND)
    first, second = wire.sent()
    assert isinstance(first, Hello)
    assert second == STOP
    wire.welcome(3 * SECOND)
    assert stops(wire) == 1
    wire.snapshot(3 * SECOND)
    wire.receive(Event(1, 0, 0, EStopChanged(True, "p1", "now", 1)), 3 * SECOND)
    wire.connection.handle_disconnect(6 * SECOND)
    assert stops(wire) == 0, "the session has it"


def test_stop_without_connection_is_kept_and_reported(wire: Wire) -> None:
    wire.connection.handle_disconnect(MS)
    assert wire.connection.phase is ConnectionPhase.WAITING
    assert not wire.connection.send(STOP)
    wire.connection.tick(5 * SECOND)
    assert [type(message) for message in wire.sent()] == [Hello, EStop]
    assert wire.connection.send(STOP)
    assert stops(wire) == 1


def test_withdrawn_stop_does_not_return(wire: Wire) -> None:
    wire.connection.send(STOP)
    wire.connection.request(ClearEStop(0))
    wire.sent()
    wire.connection.handle_disconnect(2 * SECOND)
    assert stops(wire) == 0


def test_the_stop_of_another_is_no_receipt_for_ours(wire: Wire) -> None:
    """It may be cleared before ours has arrived."""
    wire.connection.send(STOP)
    wire.receive(Event(1, 0, 0, EStopChanged(True, "p2", "mine", 1)), MS)
    assert wire.connection.pending_estop.message == STOP
    wire.receive(Event(2, 0, 0, EStopChanged(True, "p1", "now", 2)), MS)
    assert wire.connection.pending_estop.message is None


def test_stop_is_acknowledged_by_the_answer_to_a_later_ping(wire: Wire) -> None:
    wire.receive(Event(1, 0, 0, EStopChanged(True, "p2")), MS)
    wire.connection.send(STOP)
    wire.receive(ClockPong(0, MS, MS), 2 * MS)  # of a ping that was sent before
    assert wire.connection.pending_estop.message == STOP
    wire.connection.tick(SECOND)
    (ping,) = (message for message in wire.sent() if isinstance(message, ClockPing))
    wire.receive(ClockPong(ping.t0_ns, SECOND, SECOND), SECOND + MS)
    assert wire.connection.pending_estop.message is None


def test_release_overtakes_samples_but_not_the_acquire_before_it(wire: Wire) -> None:
    wire.connection.send(SAMPLE)
    number = wire.connection.request(Acquire(0, ("left",)))
    wire.connection.send(SAMPLE)
    wire.connection.send(SAMPLE)
    wire.connection.send(Release(0))
    wire.connection.send(STOP)
    assert wire.sent() == [STOP, SAMPLE, Acquire(number, ("left",)), Release(0), SAMPLE, SAMPLE]
