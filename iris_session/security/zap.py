"""Who may open an encrypted connection: ZeroMQ's authentication protocol (RFC 27), answered in the front's own loop.

The User-Id that a socket then reports for every message is the fingerprint of the client's key. A key that is not on
the list gets through on the control socket only, with a User-Id that says so (`keyring.STRANGER`): it may pair.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import zmq
from zmq.utils import z85

from iris_session.link.sockets import ZAP_CONTROL, ZAP_STATE, readable
from iris_session.protocol.limits import Drops
from iris_session.security import fingerprint
from iris_session.security.keyring import STRANGER, Keyring

ZAP_ENDPOINT: Final = "inproc://zeromq.zap.01"
_REQUEST_FRAMES: Final = 7  # version, request id, domain, address, routing id, mechanism, client key


def asks_with_curve(request: list[bytes]) -> bool:
    """Whether a ZAP request has all its frames, and the client's key as the last."""
    return len(request) == _REQUEST_FRAMES and request[5] == b"CURVE"


def answer_zap(socket: zmq.Socket[bytes], user_id_of: Callable[[list[bytes]], str]) -> None:
    """Answers every ZAP request that waits. `user_id_of(request)`: empty for who is not to be let in."""
    while readable(socket):
        frames = socket.recv_multipart()
        split = frames.index(b"") + 1
        route, request = frames[:split], frames[split:]
        request_id = request[1] if len(request) > 1 else b""
        user_id = user_id_of(request)
        if user_id:
            reply = [b"1.0", request_id, b"200", b"OK", user_id.encode(), b""]
        else:
            reply = [b"1.0", request_id, b"400", b"key not on the list", b"", b""]
        socket.send_multipart(route + reply)


class Authenticator:
    """Answers ZAP requests for one context. Poll `socket` and call `answer` when it is readable.

    `refused`: told the fingerprint and the address of every key that was not let in.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        keyring: Keyring,
        drops: Drops,
        refused: Callable[[str, str], None] = lambda _mark, _address: None,
    ) -> None:
        self.socket = context.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.bind(ZAP_ENDPOINT)
        self._keyring = keyring
        self._drops = drops
        self.refused = refused
        #: Whether a key was revoked in this session, also where the list could not be changed.
        self.banned: Callable[[str], bool] = lambda _mark: False

    def answer(self) -> None:
        """Answers everything that waits."""
        if readable(self.socket):
            self._keyring.look()
            answer_zap(self.socket, self._user_id)

    def _user_id(self, request: list[bytes]) -> str:
        """Empty: not to be let in."""
        if not asks_with_curve(request):
            self._drops.count("unknown_key")
            return ""
        mark = fingerprint(request[6])
        if self._keyring.find(mark) is not None and (request[2] == ZAP_CONTROL or not self.banned(mark)):
            if request[2] == ZAP_STATE:
                self._keyring.watching.add(mark)
            return mark  # a revoked one is told why it may not join, and gets no state
        self._drops.count("unknown_key")
        if self._keyring.home is not None and request[2] == ZAP_CONTROL:
            return STRANGER + z85.encode(request[6]).decode()
        self.refused(mark, request[3].decode(errors="replace"))
        return ""
