"""A client with a real thread and clock, for what only threads can break: its sockets answer at once, in memory."""

from __future__ import annotations

import threading
import time
from collections import deque
from types import TracebackType
from typing import Any, Self

import pytest

from iris_session.client import Client, endpoint_resolver
from iris_session.client import client as client_module
from iris_session.protocol.client_messages import ClientMessage, ClockPing, GetSnapshot, GetStatus, Hello
from iris_session.protocol.codec import decode_client, encode_server
from iris_session.protocol.names import PROTOCOL_VERSION
from iris_session.protocol.server_messages import (
    ClockPong,
    Endpoints,
    Event,
    MarkerAdded,
    ServerEnvelope,
    ServerMessage,
    Snapshot,
    Welcome,
)
from iris_session.protocol.status import DeliveryBudget, StatusReport
from tests.client.session import MemoryAssets

SECOND = 1_000_000_000
PATIENCE_S = 30.0


class ScriptedSockets:
    """In place of `ClientSockets`: a session that answers what a client needs in order to join.

    Attributes:
        sent: Messages of the client.
        assets: The assets channel.
        media_threads: Threads that have changed subscriptions.
    """

    has_state = has_media = False

    def __init__(self) -> None:
        self.sent: list[ClientMessage] = []
        self.assets = MemoryAssets()
        self.media_threads: list[threading.Thread] = []
        self._inbox: deque[list[bytes]] = deque()
        self._news = threading.Event()

    def push(self, message: ServerMessage, epoch: int = 1) -> None:
        self._inbox.append([encode_server(ServerEnvelope(PROTOCOL_VERSION, epoch, message))])
        self._news.set()

    def send_control(self, data: bytes) -> bool:
        message = decode_client(data).message
        self.sent.append(message)
        if isinstance(message, Hello):
            ports = Endpoints(state=1, media=2, assets=3)
            period = 10_000_000
            args = ("s1", "lab", "live", "p1", 1, "operator", b"token", False, 0, SECOND, period, period, ports)
            self.push(Welcome(*args))
            self.push(DeliveryBudget("full"))
        elif isinstance(message, ClockPing):
            now_ns = time.monotonic_ns()
            self.push(ClockPong(message.t0_ns, now_ns, now_ns))
        elif isinstance(message, GetSnapshot):
            self.push(Snapshot(0, 0, 1, 0, "hash", 0, 0.0, 0, (), ()))
        elif isinstance(message, GetStatus):
            self.push(StatusReport(0, "s1", "lab", 0))
        return True

    def drain_control(self) -> list[list[bytes]]:
        return [self._inbox.popleft() for _ in range(len(self._inbox))]

    def drain_state(self) -> list[list[bytes]]:
        return []

    drain_media = drain_state

    def wait(self, timeout_ns: int, *, sending: bool) -> None:
        self._news.wait(timeout_ns * 1e-9)
        self._news.clear()

    def wake(self) -> None:
        self._news.set()

    def subscribe_media(self, port: int, topics: object) -> None:
        self.media_threads.append(threading.current_thread())

    def unsubscribe_media(self, topic: bytes) -> None:
        self.media_threads.append(threading.current_thread())

    @property
    def has_assets(self) -> bool:
        return self.assets.is_open

    def open_assets(self, port: int) -> None:
        self.assets.open()

    def close_assets(self) -> None:
        self.assets.close()

    def send_assets(self, data: bytes) -> bool:
        self._news.set()
        return self.assets.send(data)

    def drain_assets(self) -> list[list[memoryview]]:
        return self.assets.drain()

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: False


class ThreadedClient:
    """A connected client of such a session.

    Attributes:
        client: The client.
        sockets: Its sockets.
    """

    def __init__(self, **settings: Any) -> None:
        self._settings = settings

    def __enter__(self) -> Self:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(client_module, "ClientSockets", ScriptedSockets)
            self.client = Client("127.0.0.1:7721", name="ann", **self._settings)
            patch.setattr(endpoint_resolver, "request_introduction", _refuse)
            self.client.connect(PATIENCE_S)
        sockets: Any = self.client._sockets
        self.sockets: ScriptedSockets = sockets
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, _: TracebackType | None) -> None:
        self.client.close()

    def push_event(self) -> None:
        """Let the session report an event."""
        self.sockets.push(Event(1, 0, 0, MarkerAdded("p2", "x")))

    def wait_sent(self, kind: type[ClientMessage]) -> None:
        """Wait until the client's thread has sent a message of a type."""
        until = time.monotonic() + PATIENCE_S
        while not any(isinstance(message, kind) for message in self.sockets.sent):
            assert time.monotonic() < until, self.sockets.sent
            time.sleep(0.001)


def _refuse(*_: object) -> Any:
    raise ConnectionRefusedError
    yield
