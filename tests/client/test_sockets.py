"""Sockets to a session: the same settings for every address."""

from __future__ import annotations

import pytest
import zmq

from iris_session.client import sockets
from iris_session.security import KeyPair


@pytest.mark.parametrize(("host", "ipv6"), [("10.0.0.1", 0), ("::1", 1), ("fe80::1%eth0", 1)])
def test_sockets_to_a_session_have_the_same_settings(host: str, ipv6: int) -> None:
    session, own = KeyPair.generate(), KeyPair.generate()
    curve = sockets.CurveKeys(session.public.encode(), own.public.encode(), own.secret.encode())
    with zmq.Context() as context, sockets.open_socket(context, zmq.DEALER, host, curve) as sock:
        assert sock.getsockopt(zmq.IPV6) == ipv6
        assert sock.getsockopt(zmq.MAXMSGSIZE) == sockets.MAX_MESSAGE_BYTES
        assert (sock.getsockopt(zmq.TCP_KEEPALIVE), sock.getsockopt(zmq.RECONNECT_IVL_MAX)) == (1, 500)
        assert sock.getsockopt(zmq.MECHANISM) == zmq.CURVE
    with zmq.Context() as context, sockets.open_socket(context, zmq.SUB, host, None) as sock:
        assert sock.getsockopt(zmq.MECHANISM) == zmq.NULL
