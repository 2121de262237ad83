"""ZeroMQ sockets of one client: control and assets (DEALER), state and media (SUB), ingest (PUSH), and their monitors.

No protocol here.
"""

from __future__ import annotations

import contextlib
import functools
import os
import socket
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, TypeGuard

import zmq

from iris_session.client.errors import IdentityError
from iris_session.link.discovery import host_port
from iris_session.protocol.assets import MAX_ASSET_CHUNK_BYTES
from iris_session.protocol.media import MAX_STREAMS
from iris_session.protocol.server_messages import TOPIC_PRESENCE, TOPIC_RIGID, TOPIC_ROBOTS
from iris_session.security import KeysError, load_public, load_secret
from iris_session.system.priority import run_at_low_priority

STATE_HWM: Final = 2
#: Small on purpose: after a stall a client receives only this many old messages, not those of seconds.
STATE_RCVBUF: Final = 16_384
CONTROL_HWM: Final = 64
#: Bytes in flight on a link of 20 Mbit/s and 50 ms: more would only be queued.
MEDIA_RCVBUF: Final = 131_072
MEDIA_HWM: Final = 2
#: More than the maximum number of requests at once.
ASSETS_SEND_HWM: Final = 128
#: Queue of received chunks; further ones wait in the session.
ASSETS_HWM: Final = 16
MAX_MESSAGE_BYTES: Final = 64 * 1024 * 1024
MAX_DRAIN: Final = 64  # messages received in one round; more than the queues hold
LINGER_MS: Final = 200
#: As plain integers: operations on the enumerations take longer than asking the socket.
_EVENTS: Final = int(zmq.EVENTS)
_POLLIN: Final = int(zmq.POLLIN)
_NOBLOCK: Final = int(zmq.NOBLOCK)


@dataclass(frozen=True, slots=True)
class CurveKeys:
    """CURVE keys of a connection, as Z85 text (40 characters) in bytes.

    Attributes:
        server_public: Public key of the session.
        public: Own public key.
        secret: Own secret key.
    """

    server_public: bytes
    public: bytes
    secret: bytes = field(repr=False)  # in no log and no traceback

    @classmethod
    def from_files(cls, server_file: str | os.PathLike[str], own_secret_file: str | os.PathLike[str]) -> CurveKeys:
        """Read keys from ZeroMQ certificates.

        Args:
            server_file: Certificate `*.key` of the session.
            own_secret_file: Own certificate `*.key_secret`.

        Returns:
            The keys.

        Raises:
            IdentityError: A file is missing, damaged, or readable by others.
        """
        try:
            server_public, own = load_public(server_file), load_secret(own_secret_file)
        except KeysError as error:
            raise IdentityError(str(error)) from None
        return cls(server_public.encode(), own.public.encode(), own.secret.encode())


def open_socket(
    context: zmq.Context[zmq.Socket[bytes]], kind: int, host: str, curve: CurveKeys | None
) -> zmq.Socket[bytes]:
    """Return a socket with the settings of all sockets to a session. It is not connected yet."""
    sock: zmq.Socket[bytes] = context.socket(kind)
    sock.setsockopt(zmq.MAXMSGSIZE, MAX_MESSAGE_BYTES)
    sock.setsockopt(zmq.TCP_KEEPALIVE, 1)  # as the session's sockets: a peer that vanished is noticed in 11 s
    sock.setsockopt(zmq.TCP_KEEPALIVE_IDLE, 5)
    sock.setsockopt(zmq.TCP_KEEPALIVE_INTVL, 2)
    sock.setsockopt(zmq.TCP_KEEPALIVE_CNT, 3)
    sock.setsockopt(zmq.RECONNECT_IVL, 50)
    sock.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
    sock.setsockopt(zmq.IPV6, int(":" in host))
    if curve is not None:
        sock.curve_serverkey = curve.server_public
        sock.curve_publickey = curve.public
        sock.curve_secretkey = curve.secret
    return sock


def to_milliseconds(nanoseconds: int) -> int:
    """Convert to milliseconds, rounded up: rounded down, the last millisecond of a wait would be a busy loop."""
    return max(0, -(-nanoseconds // 1_000_000))


class ClientSockets:
    """Sockets of one client. All methods but `wake` belong to one thread."""

    def __init__(self) -> None:
        self._host = ""
        self._control_port = 0
        self._curve: CurveKeys | None = None
        self._control: zmq.Socket[bytes] | None = None
        self._monitor: zmq.Socket[bytes] | None = None
        self._state: zmq.Socket[bytes] | None = None
        self._state_of = (0, 0)
        self._media: zmq.Socket[bytes] | None = None
        self._ingest: zmq.Socket[bytes] | None = None
        self._published: set[str] = set()
        self._assets: zmq.Socket[bytes] | None = None
        self._assets_monitor: zmq.Socket[bytes] | None = None
        self._wakes_anybody = False
        self._wake_out, self._wake_in = socket.socketpair()
        self._wake_out.setblocking(False)
        self._wake_in.setblocking(False)

    def set_target(self, host: str, control_port: int, curve: CurveKeys | None) -> None:
        """Set address and keys of the sockets that are opened from now on."""
        self._host, self._control_port, self._curve = host, control_port, curve
        self.close_media()
        self.close_assets()
        self._close_state()

    # --- control ------------------------------------------------------------------------------------------------------

    def open_control(self) -> None:
        """Open a fresh control socket; the old one is closed at once with everything in it."""
        self._close_control(linger_ms=0)
        control = self._new_socket(zmq.DEALER)
        control.setsockopt(zmq.IMMEDIATE, 1)  # nothing waits for a peer that is not there
        control.setsockopt(zmq.SNDHWM, CONTROL_HWM)
        control.setsockopt(zmq.RCVHWM, 1024)  # events; a slow reader is disconnected by the front, never silently cut
        self._monitor = control.get_monitor_socket(zmq.EVENT_DISCONNECTED)
        self._control = self._connect(control, self._control_port)

    def send_control(self, data: bytes) -> bool:
        """Send without waiting. False: the socket is full."""
        return _send(self._control, (data,))

    def drain_control(self) -> list[list[bytes]]:
        """Return messages of the control channel, in order, at most `MAX_DRAIN`."""
        return _drain(self._control)

    def poll_disconnect(self) -> bool:
        """Return true once after the control socket lost its peer."""
        return _poll_monitor(self._monitor)

    # --- state --------------------------------------------------------------------------------------------------------

    def open_state(self, port: int, generation: int, robots: bool = False) -> None:
        """Subscribe to the state channel, again with every `generation` of the control connection.

        `robots`: subscribe to the states of the robots, too.

        The cause of a disconnect may have left this connection half open, and it would never receive again. Does
        nothing when it is connected already.
        """
        if self._state is not None and self._state_of == (port, generation):
            return
        self._close_state()
        state = self._new_socket(zmq.SUB)
        state.setsockopt(zmq.RCVHWM, STATE_HWM)
        state.setsockopt(zmq.RCVBUF, STATE_RCVBUF)
        state.setsockopt(zmq.SUBSCRIBE, TOPIC_RIGID)
        state.setsockopt(zmq.SUBSCRIBE, TOPIC_PRESENCE)
        if robots:
            state.setsockopt(zmq.SUBSCRIBE, TOPIC_ROBOTS)
        self._state, self._state_of = self._connect(state, port), (port, generation)

    def drain_state(self) -> list[list[bytes]]:
        """Return messages of the state channel, oldest first."""
        return _drain(self._state)

    @property
    def has_state(self) -> bool:
        """True when a message has come on the state channel."""
        return _readable(self._state)

    # --- media --------------------------------------------------------------------------------------------------------

    @property
    def has_media(self) -> bool:
        """True when media of any stream are subscribed to."""
        return self._media is not None

    def subscribe_media(self, port: int, topics: Sequence[bytes]) -> None:
        """Add subscriptions. Port 0: the session has no media."""
        if self._media is None and port:
            media = self._new_socket(zmq.SUB, bulk_context())
            media.setsockopt(zmq.RCVHWM, MEDIA_HWM)
            media.setsockopt(zmq.RCVBUF, MEDIA_RCVBUF)
            self._media = self._connect(media, port)
        for topic in topics:
            if self._media is not None:
                self._media.setsockopt(zmq.SUBSCRIBE, topic)

    def unsubscribe_media(self, topic: bytes) -> None:
        """Remove a subscription; an unknown one is ignored."""
        if self._media is not None:
            with contextlib.suppress(zmq.ZMQError):
                self._media.setsockopt(zmq.UNSUBSCRIBE, topic)

    def drain_media(self) -> list[list[bytes]]:
        """Return messages of the media channel, oldest first."""
        return _drain(self._media)

    def send_media(self, port: int, stream: str, frames: Sequence[bytes]) -> bool:
        """Publish a frame of a source. False: the socket is full. It has room for `MEDIA_HWM` times as many
        frames as it has streams, whichever they are of."""
        ingest = self._ingest
        if ingest is None:
            if not port:
                return False
            ingest = self._new_socket(zmq.PUSH, bulk_context())
            ingest.setsockopt(zmq.IMMEDIATE, 1)
            ingest.setsockopt(zmq.SNDHWM, MEDIA_HWM)
            self._ingest, self._published = self._connect(ingest, port), {stream}
        elif stream not in self._published and len(self._published) < MAX_STREAMS:
            self._published.add(stream)
            ingest.setsockopt(zmq.SNDHWM, MEDIA_HWM * len(self._published))
        return _send(ingest, frames)

    def close_media(self) -> None:
        """Close the subscriptions and the ingest socket, which belong to one connection."""
        for one in (self._media, self._ingest):
            if one is not None:
                one.close(linger=0)
        self._media = self._ingest = None

    # --- assets -------------------------------------------------------------------------------------------------------

    @property
    def has_assets(self) -> bool:
        """True while the assets channel is open."""
        return self._assets is not None

    def open_assets(self, port: int) -> None:
        """Connect to the assets channel unless it is open."""
        if self._assets is None:
            assets = self._new_socket(zmq.DEALER, bulk_context())
            assets.setsockopt(zmq.MAXMSGSIZE, MAX_ASSET_CHUNK_BYTES)
            assets.setsockopt(zmq.SNDHWM, ASSETS_SEND_HWM)
            assets.setsockopt(zmq.RCVHWM, ASSETS_HWM)
            self._assets_monitor = assets.get_monitor_socket(zmq.EVENT_DISCONNECTED)
            self._assets = self._connect(assets, port)

    def send_assets(self, data: bytes) -> bool:
        """Request a chunk without waiting. False: the socket is full."""
        return _send(self._assets, (data,))

    def drain_assets(self) -> list[list[memoryview]]:
        """Return messages of the assets channel, in order, at most `MAX_DRAIN`, without a copy."""
        messages: list[list[memoryview]] = []
        while len(messages) < MAX_DRAIN and _readable(self._assets):
            messages.append([frame.buffer for frame in self._assets.recv_multipart(_NOBLOCK, copy=False)])
        return messages

    def poll_assets_disconnect(self) -> bool:
        """Return true once after the assets channel lost its peer; its pending requests are lost too."""
        return _poll_monitor(self._assets_monitor)

    def close_assets(self) -> None:
        """Close the connection to the assets channel; its pending requests are lost."""
        if self._assets is not None:
            _close_watched(self._assets, self._assets_monitor, linger_ms=0)
            self._assets = self._assets_monitor = None

    # --- all ----------------------------------------------------------------------------------------------------------

    def register(self, poller: zmq.Poller, *, sending: bool) -> zmq.Socket[bytes] | None:
        """Add the sockets that peers can wake to `poller`; `sending`: also wake when the control socket has room.

        Returns the state socket.
        """
        if self._control is not None:
            poller.register(self._control, zmq.POLLIN | (zmq.POLLOUT if sending else 0))
        for sock in (self._monitor, self._state, self._media, self._assets, self._assets_monitor):
            if sock is not None:
                poller.register(sock, zmq.POLLIN)
        if self._wakes_anybody:
            self.register_wake(poller)
        return self._state

    def wait(self, timeout_ns: int, *, sending: bool) -> None:
        """Wait until a socket has something, `wake` is called, or the time is over.

        Args:
            timeout_ns: Time to wait at most [ns].
            sending: Also end when the control socket has room.
        """
        poller = zmq.Poller()
        self.register(poller, sending=sending)
        self.register_wake(poller)
        poller.poll(to_milliseconds(timeout_ns))
        self.clear_wake()

    def register_wake(self, poller: zmq.Poller) -> None:
        """Add the socket of `wake` to `poller`."""
        poller.register(self._wake_in.fileno(), zmq.POLLIN)

    def enable_wake_registration(self) -> None:
        """Let `wake` end waits for our sockets in other loops too, not only in our own `poll`."""
        self._wakes_anybody = True

    def wake(self) -> None:
        """End a wait that includes `register_wake`, from any thread."""
        with contextlib.suppress(OSError):  # full: a wake-up is pending already; closed: there is no wait to end
            self._wake_out.send(b"\0")

    def clear_wake(self) -> None:
        """Clear pending wake-ups."""
        with contextlib.suppress(BlockingIOError):
            while self._wake_in.recv(4096):
                pass

    def disconnect(self, linger_ms: int = 0) -> None:
        """Close all connections, also after a session has refused us: libzmq would reconnect for ever."""
        self.close_media()
        self.close_assets()
        self._close_control(linger_ms)
        self._close_state()

    def close(self) -> None:
        """Close everything; a last bye has `LINGER_MS` to be sent."""
        self.disconnect(LINGER_MS)
        self._wake_out.close()
        self._wake_in.close()

    def _close_control(self, linger_ms: int) -> None:
        if self._control is not None:
            _close_watched(self._control, self._monitor, linger_ms)
            self._control = self._monitor = None

    def _close_state(self) -> None:
        if self._state is not None:
            self._state.close(linger=0)
            self._state = None

    def _new_socket(self, kind: int, context: zmq.Context[zmq.Socket[bytes]] | None = None) -> zmq.Socket[bytes]:
        return open_socket(context or zmq.Context.instance(), kind, self._host, self._curve)

    def _connect(self, sock: zmq.Socket[bytes], port: int) -> zmq.Socket[bytes]:
        sock.connect(f"tcp://{host_port(self._host, port)}")
        return sock


def _readable(sock: zmq.Socket[bytes] | None) -> TypeGuard[zmq.Socket[bytes]]:
    """Return whether a message has come. Asking first costs less than the exception of an empty receive."""
    return sock is not None and bool(sock.get(_EVENTS) & _POLLIN)  # type: ignore[operator]


def _poll_monitor(monitor: zmq.Socket[bytes] | None) -> bool:
    """Return whether a monitor has reported an event since the last call."""
    reported = False
    while _readable(monitor):
        reported = bool(monitor.recv_multipart(_NOBLOCK))
    return reported


def _close_watched(watched: zmq.Socket[bytes], monitor: zmq.Socket[bytes] | None, linger_ms: int) -> None:
    watched.disable_monitor()
    if monitor is not None:
        monitor.close(linger=0)
    watched.close(linger=linger_ms)


def _send(sock: zmq.Socket[bytes] | None, frames: Sequence[bytes]) -> bool:
    """Send without waiting. Return false for a socket that is full, or not open."""
    if sock is None:
        return False
    try:
        sock.send_multipart(frames, _NOBLOCK)
    except zmq.Again:
        return False
    return True


def _drain(sock: zmq.Socket[bytes] | None) -> list[list[bytes]]:
    """Return the messages that have come. Frames are received one by one: `recv_multipart` takes twice as long, as it
    checks again whether more frames follow."""
    messages: list[list[bytes]] = []
    while len(messages) < MAX_DRAIN and _readable(sock):
        frame = sock.recv(_NOBLOCK, copy=False)
        frames = [frame.bytes]
        while frame.more:
            frame = sock.recv(_NOBLOCK, copy=False)
            frames.append(frame.bytes)
        messages.append(frames)
    return messages


def bulk_context() -> zmq.Context[zmq.Socket[bytes]]:
    """Return the ZeroMQ context of assets and media, one per process; a forked child gets its own. State and control
    do not wait in its thread while megabytes are read or deciphered."""
    return _make_bulk_context(os.getpid())


@functools.cache
def _make_bulk_context(_pid: int) -> zmq.Context[zmq.Socket[bytes]]:
    def make() -> zmq.Context[zmq.Socket[bytes]]:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        context.socket(zmq.DEALER).close(linger=0)  # with the first socket libzmq starts its threads
        return context

    return run_at_low_priority(make)
