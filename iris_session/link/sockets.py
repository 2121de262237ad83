"""Sockets of the front: opened with CURVE and bounded queues, with errors that say what to do."""

from __future__ import annotations

import contextlib
import resource
import socket
import struct
import sys
from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import msgspec
import zmq
from zmq.utils.monitor import parse_monitor_message

from iris_session.link.config import FrontConfig, FrontError, FrontLimits, PortInUseError
from iris_session.protocol.assets import MAX_ASSET_REQUESTS
from iris_session.protocol.limits import MAX_CONTROL_BYTES, MAX_MEDIA_FRAME_BYTES
from iris_session.security import KeyPair
from iris_session.security.zap import ZAP_ASSETS, ZAP_CONTROL, ZAP_INGEST, ZAP_MEDIA, ZAP_STATE

#: State sockets: what is queued for a slow client; then libzmq drops the newest, not the oldest. A state, its robots
#: and presence come at once. Of what was sent on only every second one is reported, so three need room for four.
STATE_HWM = 4
STATE_BUFFER_BYTES = 32_768
#: Fits a subscription. The handshake of CURVE has messages of up to 600 bytes. Larger ones, which libzmq would keep as
#: topics, close the connection before they come to the front.
STATE_MESSAGE_BYTES = 1024
PLAIN_STATE_MESSAGE_BYTES = 128
STATE_RECEIVE_BYTES = 8192
CONTROL_BUFFER_BYTES = 131_072
#: Media: frames may be large, so few are queued. With a full queue the send fails, and the front sends the newest frame
#: as soon as there is room.
MEDIA_HWM = 2
MEDIA_BUFFER_BYTES = 65_536
INGEST_HWM = 8
#: Assets: chunks queued in libzmq for one reader, all of them mapped files: as many as a reader requests at once,
#: because a chunk that finds no room costs as much work as one that does. The system's send buffer fits a link of
#: 300 Mbit/s and 7 ms and no more: bytes queued there delay the state that shares the link.
ASSET_HWM = 8
ASSET_BUFFER_BYTES = 262_144
ASSET_MESSAGE_BYTES = 1024
#: I/O threads of the front, as bits of ZMQ_AFFINITY: encrypting media must not delay state.
IO_THREADS = 2
MAIN_THREAD = 1
MEDIA_THREAD = 2
#: The name that libzmq gives to the second.
MEDIA_THREAD_NAME: Final = "ZMQbg/IO/1"
#: As plain integers: operations on the enumerations take longer than the query of the socket.
_EVENTS = int(zmq.EVENTS)
_POLLIN = int(zmq.POLLIN)
#: Linux, `struct tcp_info`: `tcpi_bytes_acked`, and `tcpi_bytes_received` after it.
_COUNTS_AT: Final = 120
#: Linux, `asm-generic/socket.h`: TCP sends packets no faster than so many bytes per second (socket(7)). Of a slow link.
_SO_MAX_PACING_RATE: Final = 47
_UNPACED: Final = 0xFFFF_FFFF
#: The kernel closes the connection of a peer that acknowledges no queued data for so long, because it vanished or
#: sleeps. Else the connection and its queue would stay for a quarter of an hour, or for ever.
STUCK_MS: Final = 30_000
#: Open connections that send nothing use a file descriptor each, too: enough for all limits of the front.
FILE_DESCRIPTORS: Final = 8192
#: Descriptors for everything but connections: listeners, files, assets that are being sent.
RESERVED_DESCRIPTORS: Final = 256
#: Channels whose connections are unauthenticated before they have said or subscribed anything: control, state, media,
#: media ingest, assets.
_CHANNELS: Final = 5
_WITH_SUBSCRIBERS: Final = 3  # state, media, assets


def open_control(
    context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: KeyPair | None, port: int
) -> zmq.Socket[bytes]:
    """Open the ROUTER of the control channel."""
    control = context.socket(zmq.ROUTER)
    control.setsockopt(zmq.ROUTER_MANDATORY, 1)
    control.setsockopt(zmq.MAXMSGSIZE, MAX_CONTROL_BYTES)
    control.setsockopt(zmq.SNDHWM, config.limits.send_queue)
    control.setsockopt(zmq.RCVHWM, config.limits.receive_queue)
    control.setsockopt(zmq.SNDBUF, CONTROL_BUFFER_BYTES)
    control.setsockopt(zmq.RCVBUF, CONTROL_BUFFER_BYTES)
    _bind(control, config, key, port, "control")
    return control


def open_state(context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: KeyPair | None) -> zmq.Socket[bytes]:
    """Open the XPUB of rigid state and presence. Unlike PUB, it reports subscriptions."""
    state = context.socket(zmq.XPUB)
    state.setsockopt(zmq.XPUB_VERBOSER, 1)
    state.setsockopt(zmq.SNDHWM, STATE_HWM)
    state.setsockopt(zmq.SNDBUF, STATE_BUFFER_BYTES)
    # Subscriptions only. libzmq reads all queued ones before it sends, in this thread: so few and small ones.
    state.setsockopt(zmq.MAXMSGSIZE, STATE_MESSAGE_BYTES if key is not None else PLAIN_STATE_MESSAGE_BYTES)
    state.setsockopt(zmq.RCVHWM, STATE_HWM)
    state.setsockopt(zmq.RCVBUF, STATE_RECEIVE_BYTES)
    _bind(state, config, key, config.state_port, "state")
    return state


def open_media(context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: KeyPair | None) -> zmq.Socket[bytes]:
    """Open the XPUB of media. The front chooses the receivers, and a send to a full connection fails."""
    media = context.socket(zmq.XPUB)
    media.setsockopt(zmq.XPUB_MANUAL, 1)
    media.setsockopt(zmq.XPUB_NODROP, 1)
    media.setsockopt(zmq.SNDHWM, MEDIA_HWM)
    media.setsockopt(zmq.SNDBUF, MEDIA_BUFFER_BYTES)
    media.setsockopt(zmq.MAXMSGSIZE, STATE_MESSAGE_BYTES if key is not None else PLAIN_STATE_MESSAGE_BYTES)
    media.setsockopt(zmq.RCVBUF, STATE_RECEIVE_BYTES)
    _bind_or_any(media, config, key, config.media_port, "media")
    return media


def open_assets(context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: KeyPair | None) -> zmq.Socket[bytes]:
    """Open the ROUTER of assets: small requests, large chunks."""
    assets = context.socket(zmq.ROUTER)
    assets.setsockopt(zmq.ROUTER_MANDATORY, 1)
    assets.setsockopt(zmq.MAXMSGSIZE, ASSET_MESSAGE_BYTES)
    assets.setsockopt(zmq.SNDHWM, ASSET_HWM)
    assets.setsockopt(zmq.RCVHWM, MAX_ASSET_REQUESTS)
    assets.setsockopt(zmq.SNDBUF, ASSET_BUFFER_BYTES)
    assets.setsockopt(zmq.RCVBUF, STATE_RECEIVE_BYTES)
    _bind_or_any(assets, config, key, config.assets_port, "assets")
    return assets


def open_ingest(context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: KeyPair | None) -> zmq.Socket[bytes]:
    """Open the PULL for media of cameras and other sources on other machines."""
    ingest = context.socket(zmq.PULL)
    ingest.setsockopt(zmq.MAXMSGSIZE, MAX_MEDIA_FRAME_BYTES)
    ingest.setsockopt(zmq.RCVHWM, INGEST_HWM)
    _bind_or_any(ingest, config, key, config.media_ingest_port, "media ingest")
    return ingest


def open_local_ingest(context: zmq.Context[zmq.Socket[bytes]], endpoint: str) -> zmq.Socket[bytes]:
    """Open the PULL for media of processes of this session, in its private folder."""
    ingest = context.socket(zmq.PULL)
    ingest.setsockopt(zmq.AFFINITY, MEDIA_THREAD)
    ingest.setsockopt(zmq.MAXMSGSIZE, MAX_MEDIA_FRAME_BYTES)
    ingest.setsockopt(zmq.RCVHWM, INGEST_HWM)
    ingest.bind(endpoint)
    return ingest


def host_in_address(host: str) -> str:
    """Return `host` as written before `:PORT`: IPv6 in brackets."""
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def readable(socket: zmq.Socket[bytes]) -> bool:
    """Return whether a message can be received. Cheaper than a poll, or a receive that raises `Again`."""
    return bool(socket.get(_EVENTS) & _POLLIN)  # type: ignore[operator]


def bound_port(bound: zmq.Socket[bytes]) -> int:
    """Return the TCP port of a bound socket."""
    return int(bound.getsockopt_string(zmq.LAST_ENDPOINT).rsplit(":", 1)[1])


def open_listeners(
    hosts: Sequence[str], port: int, backlog: int, send_buffer_bytes: int = 0, *, only_v6: bool = False
) -> list[socket.socket]:
    """Open listening TCP sockets on one port of each host.

    Args:
        hosts: Addresses of this machine, each once.
        port: TCP port; 0 takes any free one.
        backlog: Connections that wait to be accepted.
        send_buffer_bytes: The system's send buffer of each connection, 0 for the usual one.
        only_v6: An address of IPv6 takes no connections of IPv4.

    Returns:
        The sockets, which do not block.

    Raises:
        OSError: One cannot be opened, that of its `filename`; the others were closed.
    """
    opened: list[socket.socket] = []
    try:
        for host in hosts:
            family = socket.AF_INET6 if ":" in host else socket.AF_INET
            listener = socket.socket(family, socket.SOCK_STREAM)
            opened.append(listener)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            if only_v6 and family == socket.AF_INET6:
                listener.setsockopt(socket.IPPROTO_IPV6, socket.IPV6_V6ONLY, 1)
            if send_buffer_bytes:
                listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, send_buffer_bytes)
            listener.bind((host, port))
            listener.listen(backlog)
            listener.setblocking(False)
            port = listener.getsockname()[1]
    except OSError as error:
        for listener in opened:
            listener.close()
        error.filename = host
        raise
    return opened


def read_peer(frame: zmq.Frame, *, encrypted: bool) -> tuple[int, str]:
    """Return the descriptor of the TCP connection by which a frame came, and the CURVE user id of its peer.

    The descriptor is -1 if libzmq does not know it: of a browser, or a ZeroMQ of before 2013. The user id is empty
    without encryption.
    """
    try:
        return int(frame.get(zmq.SRCFD)), str(frame.get("User-Id")) if encrypted else ""
    except zmq.ZMQError:
        return -1, ""


def watch_tcp(
    watched: zmq.Socket[bytes], name: str, events: int = zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED
) -> zmq.Socket[bytes]:
    """Return a socket that reports every opened or closed TCP connection of `watched`; see `next_tcp_event`."""
    address = f"inproc://tcp-events-{name}"
    watched.monitor(address, events)
    monitor: zmq.Socket[bytes] = watched.context.socket(zmq.PAIR)
    monitor.setsockopt(zmq.RCVHWM, 100_000)  # libzmq blocks its own thread when this is full
    monitor.connect(address)
    return monitor


def next_tcp_event(monitor: zmq.Socket[bytes]) -> tuple[int, int]:
    """Return the next event (`zmq.EVENT_*`) and its file descriptor. Call it when `monitor` is readable."""
    event = parse_monitor_message(monitor.recv_multipart())
    return int(event["event"]), int(event["value"])


class TcpCounts(NamedTuple):
    """Bytes of one TCP connection since it was opened: acknowledged by the peer, and received from it."""

    acknowledged: int
    received: int


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """Wrap a file descriptor of libzmq in a Python socket, which does not close it.

    The descriptor is not duplicated: with every descriptor in use that would fail. Raises `OSError` when it is not a
    socket.
    """
    borrowed = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, descriptor)
    try:
        yield borrowed
    finally:
        borrowed.detach()


def close_tcp(descriptor: int, peer: tuple[str, int], *, discard: bool = False) -> bool:
    """Close one TCP connection, for which libzmq has no call.

    Args:
        descriptor: File descriptor of the connection.
        peer: Address and port of the peer at its `hello`. A connection with another peer, which has got the same
            descriptor since, stays open.
        discard: Discard what the system has received and libzmq has not read yet, which it would read first.

    Returns:
        True when the connection was closed.
    """
    try:
        with _borrowed(descriptor) as connection:
            if connection.getpeername()[:2] != peer:
                return False
            if discard:  # before the shutdown: after it libzmq closes the descriptor
                with contextlib.suppress(BlockingIOError):
                    connection.recv(8 * STATE_RECEIVE_BYTES, socket.MSG_DONTWAIT)
            connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        return False
    return True


def pace_tcp(descriptor: int, peer: tuple[str, int], bytes_per_s: float) -> None:
    """Have the system send on one TCP connection no faster than this, 0 for no limit: on a slow link a large message
    that is sent at once delays all that is sent after it. Only Linux can; elsewhere nothing changes.

    Args:
        descriptor: File descriptor of the connection.
        peer: Address and port of its peer. A connection with another one, which has got the descriptor since, is left.
        bytes_per_s: The limit. A segment that was sent delays the next one by the limit at its time, also when that is
            lifted: a low one may stop the connection for long.
    """
    if sys.platform != "linux":
        return
    rate = min(_UNPACED, round(bytes_per_s)) or _UNPACED
    with contextlib.suppress(OSError), _borrowed(descriptor) as connection:
        if connection.getpeername()[:2] == peer:
            connection.setsockopt(socket.SOL_SOCKET, _SO_MAX_PACING_RATE, struct.pack("=I", rate))


def peer_of(descriptor: int) -> tuple[str, int]:
    """Return address and port of the peer of a TCP connection, ("", 0) when it is closed."""
    try:
        with _borrowed(descriptor) as connection:
            host, port = connection.getpeername()[:2]
            return (host, port)
    except OSError:
        return ("", 0)


def tcp_counts(descriptor: int) -> TcpCounts | None:
    """Return the system's byte counts of a TCP connection; `None` where there are none, or when it is closed."""
    try:
        with _borrowed(descriptor) as connection:
            info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _COUNTS_AT + 16)
    except (OSError, AttributeError):
        return None
    return TcpCounts(*struct.unpack_from("=QQ", info, _COUNTS_AT)) if len(info) >= _COUNTS_AT + 16 else None


def raise_descriptor_limit() -> int:
    """Raise the limit of open files from the usual 1024 to `FILE_DESCRIPTORS`, as far as the system allows.

    Returns the limit in force.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILE_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(FILE_DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
        soft = wanted
    return FILE_DESCRIPTORS if soft == resource.RLIM_INFINITY else soft


def fit_limits(limits: FrontLimits, descriptors: int) -> FrontLimits:
    """Return limits whose connections together fit into a number of file descriptors.

    Participants keep their places; what has less room are connections that have said nothing, subscribers and sources.
    """
    wanted = _CHANNELS * limits.unauthenticated + _WITH_SUBSCRIBERS * limits.subscribers + limits.sources
    room = descriptors - RESERVED_DESCRIPTORS - limits.connections
    if wanted <= room:
        return limits
    share = max(0.0, room / wanted)
    return msgspec.structs.replace(
        limits,
        unauthenticated=max(8, int(share * limits.unauthenticated)),
        subscribers=max(8, int(share * limits.subscribers)),
        sources=max(2, int(share * limits.sources)),
    )


def _bind_or_any(bound: zmq.Socket[bytes], config: FrontConfig, key: KeyPair | None, port: int, name: str) -> None:
    """Bind to `port`, or to any free port when it is in use: clients learn the number in `Welcome`."""
    _prepare(bound, key, name)
    try:
        _listen(bound, config, port, name)
    except PortInUseError:
        _listen(bound, config, 0, name)


def _bind(bound: zmq.Socket[bytes], config: FrontConfig, key: KeyPair | None, port: int, name: str) -> None:
    _prepare(bound, key, name)
    try:
        _listen(bound, config, port, name)
    except FrontError:
        bound.close()
        raise


def _prepare(bound: zmq.Socket[bytes], key: KeyPair | None, name: str) -> None:
    bound.setsockopt(zmq.AFFINITY, MEDIA_THREAD if name.startswith("media") else MAIN_THREAD)
    bound.setsockopt(zmq.LINGER, 200)
    bound.setsockopt(zmq.TCP_KEEPALIVE, 1)
    bound.setsockopt(zmq.TCP_KEEPALIVE_IDLE, 5)
    bound.setsockopt(zmq.TCP_KEEPALIVE_INTVL, 2)
    bound.setsockopt(zmq.TCP_KEEPALIVE_CNT, 3)
    bound.setsockopt(zmq.TCP_MAXRT, STUCK_MS)
    bound.setsockopt(zmq.HANDSHAKE_IVL, 5000)
    bound.setsockopt(zmq.BACKLOG, 512)
    if key is not None:
        domains = {"control": ZAP_CONTROL, "state": ZAP_STATE, "assets": ZAP_ASSETS, "media ingest": ZAP_INGEST}
        bound.setsockopt(zmq.ZAP_DOMAIN, domains.get(name, ZAP_MEDIA))
        bound.setsockopt(zmq.CURVE_SERVER, 1)
        bound.setsockopt(zmq.CURVE_PUBLICKEY, key.public.encode())
        bound.setsockopt(zmq.CURVE_SECRETKEY, key.secret.encode())


def _listen(bound: zmq.Socket[bytes], config: FrontConfig, port: int, name: str) -> None:
    for host in config.hosts:
        try:
            bound.setsockopt(zmq.IPV6, int(":" in host))
            bound.bind(f"tcp://{host_in_address(host)}:{port or '*'}")
        except zmq.ZMQError as error:
            if error.errno == zmq.EADDRINUSE:
                raise PortInUseError(port, name) from error
            raise FrontError(f"cannot listen on {host} port {port} ({name}): {error.strerror}") from error
        port = port or bound_port(bound)  # the same on every address
