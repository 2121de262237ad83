"""Opening the sockets of the front: CURVE, bounded queues, errors that say what to do."""

from __future__ import annotations

import contextlib
import resource
import socket
import struct
from collections.abc import Iterator
from typing import Final, NamedTuple

import zmq
from zmq.utils.monitor import parse_monitor_message

from iris_session.link.config import FrontConfig, FrontError, PortInUseError
from iris_session.protocol.assets import MAX_ASSET_REQUESTS
from iris_session.protocol.limits import MAX_CLIENT_BYTES, MAX_MEDIA_FRAME_BYTES
from iris_session.security import KeyPair
from iris_session.security.zap import ZAP_ASSETS, ZAP_CONTROL, ZAP_MEDIA, ZAP_STATE

#: State sockets: two frames may wait for a client that is slow, then the newest is lost, not the oldest (libzmq).
STATE_HWM = 2
STATE_BUFFER_BYTES = 32_768
#: A subscription. The handshake of CURVE has messages of up to 600 bytes.
STATE_MESSAGE_BYTES = 1024
STATE_RECEIVE_BYTES = 8192
CONTROL_BUFFER_BYTES = 131_072
#: Media: frames may be large, so few wait; more is refused to us, and the newest goes as soon as there is room.
MEDIA_HWM = 2
MEDIA_BUFFER_BYTES = 65_536
INGEST_HWM = 8
#: Assets: chunks that wait in libzmq for one reader, mapped files all of them: as many as a reader asks for at once, as
#: each that finds no room costs as much work as one that does. The system holds no more than a link of 300 Mbit/s and
#: 7 ms: what waits there delays the state that shares the link.
ASSET_HWM = 8
ASSET_BUFFER_BYTES = 262_144
ASSET_MESSAGE_BYTES = 1024
#: I/O threads of the front, as bits of ZMQ_AFFINITY: encrypting media must not delay state.
IO_THREADS = 2
MAIN_THREAD = 1
MEDIA_THREAD = 2
#: As plain integers: operations on the enumerations take longer than asking the socket.
_EVENTS = int(zmq.EVENTS)
_POLLIN = int(zmq.POLLIN)
#: Linux, `struct tcp_info`: `tcpi_bytes_acked`, and `tcpi_bytes_received` after it.
_COUNTS_AT: Final = 120
#: A peer that takes nothing of what waits for it for so long is cut off by the kernel, be it gone without a word or
#: asleep: else its connection, and what waits in it, would stay for a quarter of an hour, or for ever.
STUCK_MS: Final = 30_000
#: Connections that were opened and say nothing take a file descriptor each.
FILE_DESCRIPTORS = 4096


def open_control(
    context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: KeyPair | None, port: int
) -> zmq.Socket[bytes]:
    """ROUTER for hello and everything after it."""
    control = context.socket(zmq.ROUTER)
    control.setsockopt(zmq.ROUTER_MANDATORY, 1)
    control.setsockopt(zmq.MAXMSGSIZE, MAX_CLIENT_BYTES)
    control.setsockopt(zmq.SNDHWM, config.limits.send_queue)
    control.setsockopt(zmq.RCVHWM, config.limits.receive_queue)
    control.setsockopt(zmq.SNDBUF, CONTROL_BUFFER_BYTES)
    control.setsockopt(zmq.RCVBUF, CONTROL_BUFFER_BYTES)
    _bind(control, config, key, port, "control")
    return control


def open_state(context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: KeyPair | None) -> zmq.Socket[bytes]:
    """XPUB, a PUB that tells who subscribes, for rigid state and presence."""
    state = context.socket(zmq.XPUB)
    state.setsockopt(zmq.XPUB_VERBOSER, 1)
    state.setsockopt(zmq.SNDHWM, STATE_HWM)
    state.setsockopt(zmq.SNDBUF, STATE_BUFFER_BYTES)
    # Subscriptions only. libzmq takes all that wait before it sends, in our thread: few may, and small ones.
    state.setsockopt(zmq.MAXMSGSIZE, STATE_MESSAGE_BYTES)
    state.setsockopt(zmq.RCVHWM, STATE_HWM)
    state.setsockopt(zmq.RCVBUF, STATE_RECEIVE_BYTES)
    _bind(state, config, key, config.state_port, "state")
    return state


def open_media(context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: KeyPair | None) -> zmq.Socket[bytes]:
    """XPUB for media. The front decides who gets what, and is told when a connection takes no more."""
    media = context.socket(zmq.XPUB)
    media.setsockopt(zmq.XPUB_MANUAL, 1)
    media.setsockopt(zmq.XPUB_NODROP, 1)
    media.setsockopt(zmq.SNDHWM, MEDIA_HWM)
    media.setsockopt(zmq.SNDBUF, MEDIA_BUFFER_BYTES)
    media.setsockopt(zmq.MAXMSGSIZE, STATE_MESSAGE_BYTES)
    media.setsockopt(zmq.RCVBUF, STATE_RECEIVE_BYTES)
    _bind_or_any(media, config, key, config.media_port, "media")
    return media


def open_assets(context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: KeyPair | None) -> zmq.Socket[bytes]:
    """ROUTER for requests of assets, which are small, and their chunks, which are not."""
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
    """PULL for frames of cameras and other sources on other machines."""
    ingest = context.socket(zmq.PULL)
    ingest.setsockopt(zmq.MAXMSGSIZE, MAX_MEDIA_FRAME_BYTES)
    ingest.setsockopt(zmq.RCVHWM, INGEST_HWM)
    _bind_or_any(ingest, config, key, config.media_ingest_port, "media ingest")
    return ingest


def open_local_ingest(context: zmq.Context[zmq.Socket[bytes]], endpoint: str) -> zmq.Socket[bytes]:
    """PULL for frames of processes of this session, in its private folder."""
    ingest = context.socket(zmq.PULL)
    ingest.setsockopt(zmq.AFFINITY, MEDIA_THREAD)
    ingest.setsockopt(zmq.MAXMSGSIZE, MAX_MEDIA_FRAME_BYTES)
    ingest.setsockopt(zmq.RCVHWM, INGEST_HWM)
    ingest.bind(endpoint)
    return ingest


def host_in_address(host: str) -> str:
    """`host` as it stands before `:PORT`: IPv6 in brackets."""
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def readable(socket: zmq.Socket[bytes]) -> bool:
    """Whether a message waits. Cheaper than to poll, or to receive and catch `Again`."""
    return bool(socket.get(_EVENTS) & _POLLIN)  # type: ignore[operator]


def bound_port(bound: zmq.Socket[bytes]) -> int:
    """The TCP port of a bound socket."""
    return int(bound.getsockopt_string(zmq.LAST_ENDPOINT).rsplit(":", 1)[1])


def watch_tcp(
    watched: zmq.Socket[bytes], name: str, events: int = zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED
) -> zmq.Socket[bytes]:
    """Socket that reports every TCP connection of `watched` that is opened or closed; see `next_tcp_event`."""
    address = f"inproc://tcp-events-{name}"
    watched.monitor(address, events)
    monitor: zmq.Socket[bytes] = watched.context.socket(zmq.PAIR)
    monitor.setsockopt(zmq.RCVHWM, 100_000)  # libzmq blocks its own thread when this is full
    monitor.connect(address)
    return monitor


def next_tcp_event(monitor: zmq.Socket[bytes]) -> tuple[int, int]:
    """What happened (`zmq.EVENT_*`) to which file descriptor. To be called when `monitor` is readable."""
    event = parse_monitor_message(monitor.recv_multipart())
    return int(event["event"]), int(event["value"])


class TcpCounts(NamedTuple):
    """Bytes of one TCP connection since it was opened: that the other end has acknowledged, and that came from it."""

    acknowledged: int
    received: int


@contextlib.contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """A descriptor of libzmq as a socket of Python. Not a copy of it: with every descriptor in use there is no room for
    one. Raises `OSError` when it is none, or not a socket."""
    borrowed = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, descriptor)
    try:
        yield borrowed
    finally:
        borrowed.detach()


def close_tcp(descriptor: int, peer: tuple[str, int]) -> bool:
    """Closes one peer's TCP connection: libzmq has no call for that. `peer`: its address when it said hello, so that
    a descriptor that was given to somebody else since is left alone."""
    try:
        with _borrowed(descriptor) as connection:
            if connection.getpeername()[:2] != peer:
                return False
            connection.shutdown(socket.SHUT_RDWR)
    except OSError:
        return False
    return True


def peer_of(descriptor: int) -> tuple[str, int]:
    """Address and port of the other end of a TCP connection, ("", 0) when it is gone."""
    try:
        with _borrowed(descriptor) as connection:
            host, port = connection.getpeername()[:2]
            return (host, port)
    except OSError:
        return ("", 0)


def tcp_counts(descriptor: int) -> TcpCounts | None:
    """What the system counts of a TCP connection; `None` where it does not, or the connection is gone."""
    try:
        with _borrowed(descriptor) as connection:
            info = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, _COUNTS_AT + 16)
    except (OSError, AttributeError):
        return None
    return TcpCounts(*struct.unpack_from("=QQ", info, _COUNTS_AT)) if len(info) >= _COUNTS_AT + 16 else None


def raise_descriptor_limit() -> None:
    """Lets the front hold more open connections than the usual 1024 files, as far as the system allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILE_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(FILE_DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _bind_or_any(bound: zmq.Socket[bytes], config: FrontConfig, key: KeyPair | None, port: int, name: str) -> None:
    """On any free port when the wanted one is taken: clients are told which it is."""
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
        domains = {"control": ZAP_CONTROL, "state": ZAP_STATE, "assets": ZAP_ASSETS}
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
