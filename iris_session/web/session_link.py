"""Sockets of a gateway to its session: one control connection for all browsers, the state, media and assets.

The gateway joins in the role `gateway` by a connection of its own, and speaks on it for all browsers. When that is
lost, the session has lost all of them: they are asked to come again, and resume.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.metadata
import time
from base64 import urlsafe_b64encode
from collections.abc import Callable
from typing import Any, Final

import zmq

from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.identity import Identity
from iris_session.client.sockets import (
    MEDIA_HWM,
    MEDIA_RCVBUF,
    STATE_HWM,
    STATE_RCVBUF,
    ClientSockets,
    CurveKeys,
    open_socket,
)
from iris_session.link.discovery import host_port
from iris_session.link.sockets import readable
from iris_session.protocol.client_messages import Hello
from iris_session.protocol.media import make_topic
from iris_session.protocol.names import PROTOCOL_VERSION, AlignmentKind, FaultCode, Role
from iris_session.protocol.server_messages import TOPIC_PRESENCE, TOPIC_RIGID, TOPIC_ROBOTS
from iris_session.web.config import GatewayConfig
from iris_session.web.hub import Browser, Hub
from iris_session.web.sockets import SocketReader
from iris_session.web.uplink import BrowserUplink
from iris_session.web.wire import CLOSE_ENDED, CLOSE_RESTART, peek_client_message

#: Time for the gateway to be admitted by the session, before a WebSocket is closed with "come again".
READY_S: Final = 5.0
#: Time without browsers after which the state is not subscribed to any more.
STATE_LINGER_S: Final = 5.0
CONTROL_HWM: Final = 2048
#: Messages, and bytes, to the session that libzmq and the system queue: few, because an e-stop cannot go ahead of them.
CONTROL_SEND_HWM: Final = 64
CONTROL_SEND_BYTES: Final = 65_536


class SessionLink:
    """Sockets of a gateway to its session.

    Attributes:
        connection: The gateway's own connection.
    """

    def __init__(self, config: GatewayConfig, hub: Hub) -> None:
        self._config = config
        self._hub = hub
        keys = (config.server_key, config.public_key, config.secret_key)
        self._keys = CurveKeys(*(one.encode() for one in keys)) if config.server_key else None
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(1)
        self._media_context: zmq.Context[zmq.Socket[bytes]] = zmq.Context(1)  # a large frame does not delay state
        hello = Hello(
            Role.GATEWAY,
            "web",
            software=_describe_software(),
            alignment=AlignmentKind.NOT_NEEDED,
            certificate_hash=config.certificate_hash,
        )
        self.connection = ClientConnection(hello, Identity.in_memory())
        self._generation = 0
        self._ended = 0
        self._control: SocketReader | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._state: SocketReader | None = None
        self._newest: dict[bytes, list[zmq.Frame]] = {}
        self._uplink = BrowserUplink()
        self._ready = asyncio.Event()
        self._stateless_since = time.monotonic()

    # --- control ------------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Start to join the session."""
        self.connection.open(time.monotonic_ns())
        self._update()

    def tick(self) -> None:
        """Do what is due: heartbeats, joining again, tickets."""
        connection = self.connection
        if self._monitor is not None and readable(self._monitor):
            while readable(self._monitor):
                self._monitor.recv_multipart(zmq.NOBLOCK)
            connection.handle_disconnect(time.monotonic_ns())
        connection.tick(time.monotonic_ns())
        self._update()
        now = time.monotonic()
        if len(self._hub):
            self._stateless_since = now
        elif self._state is not None and now - self._stateless_since > STATE_LINGER_S:
            self._close_state()

    def _update(self) -> None:
        """Open what the connection asks for, and send what it has to say."""
        connection = self.connection
        connection.inbox.clear()
        if connection.generation != self._generation:
            self._lose("the connection to the session was lost: come again")
            self._generation = connection.generation
            self._open_control()
        if connection.phase in (ConnectionPhase.WAITING, ConnectionPhase.REFUSED) and self._ready.is_set():
            self._lose("the connection to the session was lost: come again")
        if connection.is_joined and not self._ready.is_set():
            self._ready.set()
            if len(self._hub):
                self.watch_state()
        while (outgoing := connection.peek_outgoing()) is not None:
            may_drop, data = outgoing
            sent = self._control is not None and self._control.send([data])
            if not sent and not may_drop:
                break
            connection.pop_outgoing(sent=sent)
        self._flush()

    def _lose(self, reason: str) -> None:
        """Note that the session knows none of the browsers any more."""
        was_ready = self._ready.is_set()
        self._ready.clear()
        self._uplink.clear()
        self._close_state()
        if was_ready:
            ended = self.connection.counters.faults.get(FaultCode.SESSION_ENDED, 0)
            has_ended, self._ended = ended > self._ended, ended
            code, text = (CLOSE_ENDED, "the session has ended") if has_ended else (CLOSE_RESTART, reason)
            self._hub.close_all(code, text)

    def _open_control(self) -> None:
        self._close_control()
        config = self._config
        control = open_socket(self._context, zmq.DEALER, config.host, self._keys)
        control.setsockopt(zmq.IMMEDIATE, 1)
        control.setsockopt(zmq.SNDHWM, CONTROL_SEND_HWM)
        control.setsockopt(zmq.SNDBUF, CONTROL_SEND_BYTES)
        control.setsockopt(zmq.RCVHWM, CONTROL_HWM)
        self._monitor = control.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        control.connect(f"tcp://{host_port(config.host, config.control_port)}")
        self._control = SocketReader(control, self._receive_control, self._update, on_room=self._flush)

    def _close_control(self) -> None:
        if self._control is not None:
            self._control.socket.disable_monitor()
            if self._monitor is not None:
                self._monitor.close(linger=0)
            self._control.close()
        self._control = self._monitor = None

    def _receive_control(self, frames: list[zmq.Frame]) -> None:
        now_ns = time.monotonic_ns()
        data = [frame.bytes for frame in frames]
        if not self._hub.deliver(data, now_ns):
            self.connection.receive(data, now_ns)

    # --- for the server -----------------------------------------------------------------------------------------------

    async def wait_ready(self) -> bool:
        """Return whether the session has admitted the gateway, waiting for it a moment."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(READY_S):
                await self._ready.wait()
        return self._ready.is_set()

    def send(self, browser: Browser, envelope: bytes) -> Browser | None:
        """Send a message of a browser. Return the browser of which too much waits for the session, mostly none."""
        if not self._ready.is_set():
            return None  # the browsers of this connection are being closed
        control = self._control
        if not len(self._uplink) and control is not None and control.send([envelope]):
            return None
        kind = peek_client_message(envelope).type
        excess = self._uplink.push(browser.name, kind, envelope, admitted=browser.is_admitted)
        return self._hub.find(excess) if excess else None

    def _flush(self) -> None:
        uplink, control = self._uplink, self._control
        while (message := uplink.peek()) is not None and control is not None and control.send([message]):
            uplink.pop()

    def watch_state(self) -> None:
        """Subscribe to the state unless it is subscribed to."""
        self._stateless_since = time.monotonic()
        welcome = self.connection.welcome
        if self._state is not None or welcome is None or not self._ready.is_set():
            return
        state = open_socket(self._context, zmq.SUB, self._config.host, self._keys)
        state.setsockopt(zmq.RCVHWM, STATE_HWM)
        state.setsockopt(zmq.RCVBUF, STATE_RCVBUF)
        state.setsockopt(zmq.SUBSCRIBE, TOPIC_RIGID)
        state.setsockopt(zmq.SUBSCRIBE, TOPIC_PRESENCE)
        state.setsockopt(zmq.SUBSCRIBE, TOPIC_ROBOTS)
        state.connect(f"tcp://{host_port(self._config.host, welcome.endpoints.state)}")
        self._state = SocketReader(state, self._receive_state, self._publish_state)

    def _close_state(self) -> None:
        if self._state is not None:
            self._state.close()
            self._state = None
        self._newest.clear()

    def _receive_state(self, frames: list[zmq.Frame]) -> None:
        self._newest[frames[0].bytes] = frames

    def _publish_state(self) -> None:
        newest, self._newest = self._newest, {}
        for frames in newest.values():
            self._hub.publish([frame.buffer for frame in frames])

    def open_media(self, browser: Browser, on_frames: Callable[[list[bytes]], None]) -> MediaFeedSocket:
        """Return a subscription to media for a browser."""
        welcome = self.connection.welcome
        port = 0 if welcome is None else welcome.endpoints.media
        media = open_socket(self._media_context, zmq.SUB, self._config.host, self._keys)
        media.setsockopt(zmq.RCVHWM, MEDIA_HWM)
        media.setsockopt(zmq.RCVBUF, MEDIA_RCVBUF)
        if port:
            media.connect(f"tcp://{host_port(self._config.host, port)}")
        return MediaFeedSocket(media, browser, on_frames)

    def open_assets(self) -> zmq.Socket[bytes] | None:
        """Return a socket connected to the assets channel, `None` while there is none."""
        welcome = self.connection.welcome
        if welcome is None or not welcome.endpoints.assets or not self._ready.is_set():
            return None
        assets = open_socket(self._context, zmq.DEALER, self._config.host, self._keys)
        assets.setsockopt(zmq.IMMEDIATE, 0)
        assets.setsockopt(zmq.SNDHWM, 1024)
        assets.setsockopt(zmq.RCVHWM, 16)
        assets.connect(f"tcp://{host_port(self._config.host, welcome.endpoints.assets)}")
        return assets

    def make_asset_sockets(self) -> ClientSockets:
        """Return sockets with which assets can be fetched, while the gateway is admitted."""
        sockets = ClientSockets()
        sockets.set_target(self._config.host, self._config.control_port, self._keys)
        return sockets

    def find_epoch(self) -> int:
        """Return the connection epoch of the gateway, 0 while it is not admitted."""
        return self.connection.connection_epoch if self._ready.is_set() else 0

    def describe(self) -> dict[str, Any]:
        """Return the content of `/v1/info`."""
        welcome, config = self.connection.welcome, self._config
        return {
            "versions": [PROTOCOL_VERSION],
            "session_name": config.session_name if welcome is None else welcome.session_name,
            "session_id": "" if welcome is None else welcome.session_id,
            "key": urlsafe_b64encode(config.certificate_hash).rstrip(b"=").decode(),
            "pairing": bool(config.server_key),
            "software": _describe_software(),
        }

    @property
    def fault(self) -> str:
        """Reason for which the session does not admit the gateway, empty while it does."""
        if self.connection.phase is ConnectionPhase.REFUSED:
            return str(self.connection.failure or "refused")
        return "" if self._ready.is_set() else self.connection.describe()

    def close(self) -> None:
        """Leave the session and close all sockets."""
        if self.connection.is_joined:
            self.connection.close()
            while (outgoing := self.connection.peek_outgoing()) is not None:
                self.connection.pop_outgoing(sent=self._control is not None and self._control.send([outgoing[1]]))
            time.sleep(0.02)  # libzmq hands it to the system
        self._close_state()
        self._close_control()
        self._context.destroy(linger=0)
        self._media_context.destroy(linger=0)


class MediaFeedSocket:
    """Subscription of one browser: a socket of its own, so that the session sees how fast this browser reads."""

    def __init__(self, media: zmq.Socket[bytes], browser: Browser, on_frames: Callable[[list[bytes]], None]) -> None:
        self._browser = browser
        self._on_frames = on_frames
        self._wanted: frozenset[str] = frozenset()
        self._topics: set[bytes] = set()
        self._reader = SocketReader(media, self._receive, batch=1)
        self._timer: asyncio.TimerHandle | None = None

    def set_subscriptions(self, streams: frozenset[str]) -> None:
        """Subscribe to these streams, and to no others, as soon as the session has sent the browser's budget."""
        self._wanted = streams
        self._subscribe()

    def _subscribe(self) -> None:
        if self._reader.socket.closed:
            return
        browser = self._browser
        if self._wanted and not browser.has_budget:
            self._timer = asyncio.get_running_loop().call_later(0.05, self._subscribe)
            return
        topics = {make_topic(browser.epoch, stream) for stream in self._wanted} if browser.epoch else set()
        for topic in self._topics - topics:
            self._reader.socket.setsockopt(zmq.UNSUBSCRIBE, topic)
        for topic in topics - self._topics:
            self._reader.socket.setsockopt(zmq.SUBSCRIBE, topic)
        self._topics = topics

    def _receive(self, frames: list[zmq.Frame]) -> None:
        self._reader.pause()
        self._on_frames([frame.bytes for frame in frames])

    def resume(self) -> None:
        """Read the next frame."""
        self._reader.resume()

    def close(self) -> None:
        """Close the subscription."""
        if self._timer is not None:
            self._timer.cancel()
        self._reader.close()


def _describe_software() -> str:
    try:
        return f"iris-session {importlib.metadata.version('iris-session')}"
    except importlib.metadata.PackageNotFoundError:
        return "iris-session"
