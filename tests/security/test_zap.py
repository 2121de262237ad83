"""Authentication of keys per socket, and the record of keys admitted to the state socket."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest
import zmq

from iris_session.protocol.limits import Drops
from iris_session.security import compute_fingerprint
from iris_session.security.keyring import Keyring
from iris_session.security.zap import ZAP_CONTROL, ZAP_MEDIA, ZAP_STATE, Authenticator

KEY = bytes(range(32))


@pytest.mark.parametrize(("domain", "watches"), [(ZAP_CONTROL, False), (ZAP_MEDIA, False), (ZAP_STATE, True)])
def test_only_keys_admitted_to_the_state_socket_are_recorded(domain: bytes, watches: bool) -> None:
    mark = compute_fingerprint(KEY)
    keyring: Any = SimpleNamespace(
        state_subscribers=set(), home=None, reload_if_changed=lambda: None, find_key={mark: "an entry"}.get
    )
    with zmq.Context() as context:
        authenticator = Authenticator(cast("zmq.Context[zmq.Socket[bytes]]", context), cast(Keyring, keyring), Drops())
        with context.socket(zmq.REQ) as asker:
            asker.connect("inproc://zeromq.zap.01")
            asker.send_multipart([b"1.0", b"1", domain, b"10.0.0.1", b"", b"CURVE", KEY])
            assert authenticator.socket.poll(30_000)
            authenticator.answer_requests()
            assert asker.poll(30_000)
            assert asker.recv_multipart()[2:5] == [b"200", b"OK", mark.encode()]
        authenticator.socket.close()
    assert keyring.state_subscribers == ({mark} if watches else set())
