"""Opening the sockets of the front: CURVE, bounded queues, errors that say what to do."""

from __future__ import annotations

import base64
import hashlib
import resource
import socket
from pathlib import Path

import zmq
import zmq.auth
from zmq.utils import z85

from iris_session.protocol.limits import MAX_CLIENT_BYTES
from iris_session.transport.config import FrontConfig, FrontError

ZAP_DOMAIN = b"iris"
#: State sockets: two frames may wait for a client that is slow, then the newest is lost, not the oldest (libzmq).
STATE_HWM = 2
STATE_BUFFER_BYTES = 32_768
CONTROL_BUFFER_BYTES = 131_072
#: As plain integers: operations on the enumerations take longer than asking the socket.
_EVENTS = int(zmq.EVENTS)
_POLLIN = int(zmq.POLLIN)
#: Connections that were opened and say nothing take a file descriptor each.
FILE_DESCRIPTORS = 4096


def fingerprint(key: bytes, person: bytes = b"iris-key") -> str:
    """Name of a key that tells nothing about it: 128-bit BLAKE2b in base32, lower case."""
    digest = hashlib.blake2b(key, digest_size=16, person=person).digest()
    return base64.b32encode(digest).decode().rstrip("=").lower()


class ServerKey:
    """The server's CURVE key pair (Z85) and its fingerprint."""

    def __init__(self, secret_file: str) -> None:
        try:
            public, secret = zmq.auth.load_certificate(secret_file)
        except (OSError, ValueError) as error:
            raise FrontError(f"server key {secret_file} cannot be read: {error}") from error
        if secret is None:
            raise FrontError(f"server key {secret_file} holds no secret key: give the *.key_secret file")
        self.public = public
        self.secret = secret
        self.fingerprint = fingerprint(z85.decode(public))


def server_key(config: FrontConfig) -> ServerKey | None:
    """The key to serve with, `None` on plain loopback. Raises `FrontError` where a key is required and missing."""
    if config.curve_secret_file:
        if not Path(config.curve_clients_dir).is_dir() or not config.curve_clients_dir:
            raise FrontError("encryption needs a folder with the public keys (*.key) of the clients that may connect")
        return ServerKey(config.curve_secret_file)
    if not config.loopback:
        raise FrontError(f"refusing to listen on {config.host} without encryption: give a server key, or use 127.0.0.1")
    return None


def open_control(
    context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: ServerKey | None
) -> zmq.Socket[bytes]:
    """ROUTER for hello and everything after it."""
    control = context.socket(zmq.ROUTER)
    control.setsockopt(zmq.ROUTER_MANDATORY, 1)
    control.setsockopt(zmq.MAXMSGSIZE, MAX_CLIENT_BYTES)
    control.setsockopt(zmq.SNDHWM, config.limits.send_queue)
    control.setsockopt(zmq.RCVHWM, config.limits.send_queue)
    control.setsockopt(zmq.SNDBUF, CONTROL_BUFFER_BYTES)
    control.setsockopt(zmq.RCVBUF, CONTROL_BUFFER_BYTES)
    _bind(control, config, key, config.control_port, "control")
    return control


def open_state(
    context: zmq.Context[zmq.Socket[bytes]], config: FrontConfig, key: ServerKey | None
) -> zmq.Socket[bytes]:
    """PUB for rigid state and presence."""
    state = context.socket(zmq.PUB)
    state.setsockopt(zmq.SNDHWM, STATE_HWM)
    state.setsockopt(zmq.SNDBUF, STATE_BUFFER_BYTES)
    state.setsockopt(zmq.MAXMSGSIZE, 1024)  # subscriptions only
    _bind(state, config, key, config.state_port, "state")
    return state


def host_in_address(host: str) -> str:
    """`host` as it stands before `:PORT`: IPv6 in brackets."""
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def readable(socket: zmq.Socket[bytes]) -> bool:
    """Whether a message waits. Cheaper than to poll, or to receive and catch `Again`."""
    return bool(socket.get(_EVENTS) & _POLLIN)  # type: ignore[operator]


def bound_port(bound: zmq.Socket[bytes]) -> int:
    """The TCP port of a bound socket."""
    return int(bound.getsockopt_string(zmq.LAST_ENDPOINT).rsplit(":", 1)[1])


def watch_disconnects(control: zmq.Socket[bytes], name: str) -> zmq.Socket[bytes]:
    """Socket that reports every closed TCP connection of `control` by its file descriptor."""
    address = f"inproc://disconnects-{name}"
    control.monitor(address, zmq.EVENT_DISCONNECTED)
    monitor: zmq.Socket[bytes] = control.context.socket(zmq.PAIR)
    monitor.setsockopt(zmq.RCVHWM, 100_000)  # libzmq blocks its own thread when this is full
    monitor.connect(address)
    return monitor


def close_tcp(descriptor: int, peer: tuple[str, int]) -> bool:
    """Closes one peer's TCP connection: libzmq has no call for that. `peer`: its address when it said hello, so that
    a descriptor that was given to somebody else since is left alone."""
    try:
        twin = socket.fromfd(descriptor, socket.AF_INET, socket.SOCK_STREAM)
    except OSError:
        return False
    with twin:
        try:
            if twin.getpeername()[:2] != peer:
                return False
            twin.shutdown(socket.SHUT_RDWR)
        except OSError:
            return False
    return True


def peer_of(descriptor: int) -> tuple[str, int]:
    """Address and port of the other end of a TCP connection, ("", 0) when it is gone."""
    try:
        with socket.fromfd(descriptor, socket.AF_INET, socket.SOCK_STREAM) as twin:
            host, port = twin.getpeername()[:2]
            return (host, port)
    except OSError:
        return ("", 0)


def raise_descriptor_limit() -> None:
    """Lets the front hold more open connections than the usual 1024 files, as far as the system allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = FILE_DESCRIPTORS if hard == resource.RLIM_INFINITY else min(FILE_DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _bind(bound: zmq.Socket[bytes], config: FrontConfig, key: ServerKey | None, port: int, name: str) -> None:
    bound.setsockopt(zmq.LINGER, 200)
    bound.setsockopt(zmq.TCP_KEEPALIVE, 1)
    bound.setsockopt(zmq.TCP_KEEPALIVE_IDLE, 5)
    bound.setsockopt(zmq.TCP_KEEPALIVE_INTVL, 2)
    bound.setsockopt(zmq.TCP_KEEPALIVE_CNT, 3)
    bound.setsockopt(zmq.HANDSHAKE_IVL, 5000)
    bound.setsockopt(zmq.BACKLOG, 512)
    if key is not None:
        bound.setsockopt(zmq.ZAP_DOMAIN, ZAP_DOMAIN)
        bound.setsockopt(zmq.CURVE_SERVER, 1)
        bound.setsockopt(zmq.CURVE_PUBLICKEY, key.public)
        bound.setsockopt(zmq.CURVE_SECRETKEY, key.secret)
    try:
        bound.setsockopt(zmq.IPV6, int(":" in config.host))
        bound.bind(f"tcp://{host_in_address(config.host)}:{port or '*'}")
    except zmq.ZMQError as error:
        if error.errno == zmq.EADDRINUSE:
            advice = f"pass --{name}-port 0 for any free one"
            raise FrontError(f"port {port} is in use (by another session?): {advice}") from error
        raise FrontError(f"cannot listen on {config.host} port {port} ({name}): {error.strerror}") from error
