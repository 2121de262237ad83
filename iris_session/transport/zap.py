"""Who may open an encrypted connection: ZeroMQ's authentication protocol (RFC 27), answered in the front's own loop.

The User-Id that a socket then reports for every message is the fingerprint of the client's key.
"""

from __future__ import annotations

from pathlib import Path

import zmq
import zmq.auth
from zmq.utils import z85

from iris_session.transport.limiter import Drops
from iris_session.transport.sockets import fingerprint, readable

_REQUEST_FRAMES = 7  # version, request id, domain, address, routing id, mechanism, client key


class KeyList:
    """Allowed client keys: every `*.key` certificate in a folder, read again when the folder changes."""

    def __init__(self, folder: str) -> None:
        self._folder = Path(folder)
        self._changed_ns = -1
        self._keys: frozenset[bytes] = frozenset()

    def __contains__(self, key: bytes) -> bool:
        try:
            changed_ns = self._folder.stat().st_mtime_ns
        except OSError:
            return False
        if changed_ns != self._changed_ns:
            self._changed_ns = changed_ns
            self._keys = frozenset(self._read())
        return key in self._keys

    def _read(self) -> list[bytes]:
        keys = []
        for path in sorted(self._folder.glob("*.key")):
            try:
                keys.append(z85.decode(zmq.auth.load_certificate(path)[0]))
            except (OSError, ValueError):
                continue  # a damaged certificate lets nobody in, and keeps nobody else out
        return keys


class Authenticator:
    """Answers ZAP requests for one context. Poll `socket` and call `answer` when it is readable."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], keys: KeyList, drops: Drops) -> None:
        self.socket = context.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.bind("inproc://zeromq.zap.01")
        self._keys = keys
        self._drops = drops

    def answer(self) -> None:
        """Answers everything that waits."""
        while readable(self.socket):
            frames = self.socket.recv_multipart()
            split = frames.index(b"") + 1
            route, request = frames[:split], frames[split:]
            allowed = len(request) == _REQUEST_FRAMES and request[5] == b"CURVE" and request[6] in self._keys
            if allowed:
                reply = [b"1.0", request[1], b"200", b"OK", fingerprint(request[6]).encode(), b""]
            else:
                self._drops.count("unknown_key")
                reply = [b"1.0", request[1] if len(request) > 1 else b"", b"400", b"key not on the list", b"", b""]
            self.socket.send_multipart(route + reply)
