"""Limits on TCP connections to media ingest, against real TCP connections."""

from __future__ import annotations

import socket
import struct
import time

import pytest
import zmq

from iris_session.front import channel_guard
from iris_session.front.channel_guard import ChannelBounds, ChannelFlood, ChannelGuard
from iris_session.link.config import SECOND, FrontLimits
from tests.front.control_rig import is_closed


class IngestRig:
    """A guard of media ingest, and TCP connections that it guards."""

    def __init__(self, bounds: ChannelBounds) -> None:
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        monitor, self._events = self.context.socket(zmq.PAIR), self.context.socket(zmq.PAIR)
        monitor.bind("inproc://monitor")
        self._events.connect("inproc://monitor")
        self.guard = ChannelGuard(monitor, FrontLimits(), bounds, curve=True)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._held: list[socket.socket] = [self._listener]

    def open(self, key: str, n_bytes: int) -> socket.socket:
        """Open a connection that has sent so much of a message. `key`: known from an earlier message, or empty."""
        theirs = socket.create_connection(self._listener.getsockname())
        ours, _ = self._listener.accept()
        self._held += [theirs, ours]
        self._events.send_multipart([struct.pack("=HI", zmq.EVENT_ACCEPTED, ours.fileno()), b""])
        assert len(self.guard.read_events(SECOND)) == 1
        if key:
            self.guard.record_message(ours.fileno(), key, (), counts=0)
        theirs.sendall(bytes(n_bytes))
        while len(ours.recv(n_bytes, socket.MSG_PEEK)) < n_bytes:
            time.sleep(0.001)
        return theirs

    def close(self) -> None:
        for one in self._held:
            one.close()
        self.context.destroy(linger=0)


@pytest.mark.parametrize("key", ["camera", ""])
def test_unread_bytes_of_ingest_count_by_key_over_all_connections(key: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """By address where the key is not known yet: there is one if more is unread than a stranger can send."""
    monkeypatch.setattr(channel_guard, "STRANGER_BYTES", 3999 if key else 4000)
    rig = IngestRig(ChannelBounds(8, pending_bytes=8192, owner_bytes=8192))
    mine = [rig.open(key, n) for n in (3000, 4000, 3500)]
    other = rig.open("other", 7000)
    assert rig.guard.tick(SECOND) == ["media_flood"]
    assert [is_closed(one) for one in (*mine, other)] == [False, True, False, False]
    assert sum(one.bytes for one in rig.guard.list_pending() if one.owner == (key or "127.0.0.1")) == 6500
    assert rig.guard.pop_floods() == [ChannelFlood("127.0.0.1", key, SECOND, bool(key))]
    assert rig.guard.tick(2 * SECOND) == [], "each is within the bound, and so is their sum"
    monkeypatch.setattr(channel_guard, "STRANGER_BYTES", 3999)
    rig.open(key, 4000)
    rig.guard.tick(3 * SECOND)
    assert [flood.has_key for flood in rig.guard.pop_floods()] == [True]
    rig.close()


def test_unread_bytes_of_ingest_are_bounded_over_all_keys() -> None:
    rig = IngestRig(ChannelBounds(8, pending_bytes=8192, owner_bytes=8192, total_bytes=12_000))
    sources = [rig.open(key, 3000 + i) for i, key in enumerate(("ann", "bob", "carl", "dana"))]
    assert rig.guard.tick(SECOND) == ["media_flood"]
    assert [is_closed(one) for one in sources] == [False, False, False, True]
    rig.close()
