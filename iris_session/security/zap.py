"""ZeroMQ's authentication protocol (ZAP, RFC 27), answered in the front's own loop.

The User-Id that a socket then reports for every message is the fingerprint of the client's key. A key that is not
listed is admitted to the control socket only, with a User-Id that marks it (`keyring.PAIRING_PREFIX`): it may pair.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import zmq
from zmq.utils import z85

from iris_session.protocol.limits import Drops
from iris_session.security import compute_fingerprint
from iris_session.security.keyring import PAIRING_PREFIX, Keyring

ZAP_ENDPOINT: Final = "inproc://zeromq.zap.01"
#: ZAP domains: keys that are not on the list may pair, on the control socket only; the state socket is opened again
#: when a key is revoked that came in there; media are taken from keys of cameras and sources only.
ZAP_CONTROL: Final = b"iris-control"
ZAP_STATE: Final = b"iris-state"
ZAP_MEDIA: Final = b"iris-media"
ZAP_ASSETS: Final = b"iris-assets"
ZAP_INGEST: Final = b"iris-ingest"
#: As plain integers: operations on the enumerations take longer than asking the socket.
_EVENTS: Final = int(zmq.EVENTS)
_POLLIN: Final = int(zmq.POLLIN)
_REQUEST_FRAMES: Final = 7  # version, request id, domain, address, routing id, mechanism, client key


def is_curve_request(request: list[bytes]) -> bool:
    """Return True for a complete ZAP request of the CURVE mechanism, whose last frame is the client's key."""
    return len(request) == _REQUEST_FRAMES and request[5] == b"CURVE"


class TryLaterError(Exception):
    """A key is refused for a time only."""


def answer_zap_requests(socket: zmq.Socket[bytes], authenticate: Callable[[list[bytes]], str]) -> None:
    """Answer every pending ZAP request. `authenticate(request)` returns the User-Id, empty to refuse for good.

    It raises `TryLaterError` to refuse for a time. libzmq then reads nothing more from the connection and closes it
    after `ZMQ_HANDSHAKE_IVL`, and its client connects again, which it never does after a refusal for good.
    """
    while _has_message(socket):
        frames = socket.recv_multipart()
        split = frames.index(b"") + 1
        route, request = frames[:split], frames[split:]
        request_id = request[1] if len(request) > 1 else b""
        try:
            user_id = authenticate(request)
        except TryLaterError:
            reply = [b"1.0", request_id, b"300", b"try again later", b"", b""]
        else:
            status = (b"200", b"OK") if user_id else (b"400", b"key not on the list")
            reply = [b"1.0", request_id, *status, user_id.encode(), b""]
        socket.send_multipart(route + reply)


def _has_message(socket: zmq.Socket[bytes]) -> bool:
    return bool(socket.get(_EVENTS) & _POLLIN)  # type: ignore[operator]


class Authenticator:
    """Answers ZAP requests for one context. Poll `socket` and call `answer_requests` when it is readable.

    Attributes:
        socket: The socket of the requests.
        on_refused: Called with the fingerprint, the address and the channel of every key that was refused.
        is_revoked: Returns True for a key that was revoked in this session, also where the list could not be changed.
        is_rate_limited: Returns True for a listed key that may not connect to a channel (its ZAP domain) from an
            address now; it may try again later.
    """

    def __init__(
        self,
        context: zmq.Context[zmq.Socket[bytes]],
        keyring: Keyring,
        drops: Drops,
        refused: Callable[[str, str, str], None] = lambda _mark, _address, _channel: None,
    ) -> None:
        self.socket = context.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.bind(ZAP_ENDPOINT)
        self._keyring = keyring
        self._drops = drops
        self.on_refused = refused
        self.is_revoked: Callable[[str], bool] = lambda _mark: False
        self.is_rate_limited: Callable[[bytes, str, str], bool] = lambda _domain, _mark, _address: False

    def answer_requests(self) -> None:
        """Answer every pending request."""
        if _has_message(self.socket):
            self._keyring.reload_if_changed()
            answer_zap_requests(self.socket, self._authenticate)

    def _authenticate(self, request: list[bytes]) -> str:
        """Return the User-Id, empty to refuse. Raises `TryLaterError`."""
        if not is_curve_request(request):
            self._drops.count("unknown_key")
            return ""
        mark = compute_fingerprint(request[6])
        address = request[3].decode(errors="replace")
        if self._keyring.find_key(mark) is not None and self.is_rate_limited(request[2], mark, address):
            raise TryLaterError
        if request[2] == ZAP_INGEST and self._keyring.find_key(mark) is not None:
            if self._keyring.may_hand_in_media(mark) and not self.is_revoked(mark):
                return mark
            self._drops.count("media_source_refused")
            self.on_refused(mark, address, "media ingest")
            return ""
        if self._keyring.find_key(mark) is not None and (request[2] == ZAP_CONTROL or not self.is_revoked(mark)):
            if request[2] == ZAP_STATE:
                self._keyring.state_subscribers.add(mark)
            return mark  # a revoked key is refused at hello, with a reason, and gets no state
        self._drops.count("unknown_key")
        if self._keyring.home is not None and request[2] == ZAP_CONTROL:
            return PAIRING_PREFIX + z85.encode(request[6]).decode()
        self.on_refused(mark, address, "media ingest" if request[2] == ZAP_INGEST else "state")
        return ""
