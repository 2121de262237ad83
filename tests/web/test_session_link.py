"""The gateway's side of its session: who is heard first while the session does not read."""

from __future__ import annotations

from iris_session.protocol.client_messages import EStop, Heartbeat, wrap_message
from iris_session.protocol.codec import encode_client
from iris_session.web.config import GatewayConfig
from iris_session.web.hub import Hub
from iris_session.web.session_link import MAX_STOPS, MAX_WAITING, SessionLink


def test_an_estop_goes_ahead_of_what_waits_and_finds_room() -> None:
    link = SessionLink(GatewayConfig(), Hub())
    link._ready.set()  # admitted, and its socket is full
    other, stop = (encode_client(wrap_message(message, 5, "web-1")) for message in (Heartbeat(), EStop()))
    assert all(link.send(other) for _ in range(MAX_WAITING))
    assert not link.send(other)
    assert [link.send(stop) for _ in range(MAX_STOPS + 1)].count(True) == MAX_STOPS
    assert link._waiting[0] == stop
    assert link._waiting[-1] == other
    link.close()
