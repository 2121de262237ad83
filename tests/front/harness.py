"""A session around a front in this process: in-memory sockets, simulated time, a minimal authority, raw clients.

The front is the real `Front` with its loop; what it does not have here are libzmq, TCP, threads of media and assets,
and a disk that takes time. `process_harness` has a front process, for tests of those.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeVar

import msgspec
import numpy as np
import pytest
import zmq

from iris_session.front import context as front_context
from iris_session.front import loop as front_loop
from iris_session.front.context import WatchedSocket, open_keyring
from iris_session.front.loop import Front
from iris_session.link import FrontConfig, Ports, SceneInfo
from iris_session.link import messages as link
from iris_session.link.config import MILLISECOND, FrontStart
from iris_session.link.front_link import FrontLink
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import ClientMessage, GetSnapshot, Hello, wrap_message
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.common import Message
from iris_session.protocol.entries import Entry, Join
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import BodyInfo, Event, Notice, Snapshot, StateHeader, Welcome
from iris_session.protocol.steps import Admitted, Decision, OutgoingMessage
from iris_session.security import decode_key, keyring
from iris_session.security.keyring import Keyring
from iris_session.security.zap import ZAP_CONTROL, ZAP_STATE, Authenticator, TryLaterError
from tests.rig.front import RigLink, _links, install_front
from tests.rig.network import FIRST_DESCRIPTOR, Frame, Inbox, Monitor, Network
from tests.rig.simulation import Simulation

N_BODIES = 3
LONG_NS = 600_000_000_000
#: Simulated time of one step of the authority.
STEP_NS = 5 * MILLISECOND
STALLS = (FaultCode.STALLED, FaultCode.RECOVERED)
Curve = tuple[bytes, bytes, bytes]
T = TypeVar("T", bound=Message)


def scene(n: int = N_BODIES) -> SceneInfo:
    poses = np.zeros((n, 7))
    poses[:, 3] = 1.0
    return SceneInfo("hash", (), tuple(BodyInfo(i, f"body{i}", True) for i in range(n)), poses.tobytes())


class InlineFileWorker:
    """In place of `FileWorker`: jobs run at once, and report with the next tick."""

    def __init__(self, expected: type[Exception]) -> None:
        self._expected = expected
        self._reports: list[Callable[[int], None]] = []

    def submit(self, job: Callable[[], Any], on_done: Callable[[Any, int], None]) -> bool:
        try:
            outcome = job()
        except self._expected as error:
            outcome = error
        self._reports.append(lambda now_ns: on_done(outcome, now_ns))
        return True

    def tick(self, now_ns: int) -> None:
        reports, self._reports = self._reports, []
        for report in reports:
            report(now_ns)

    def close(self) -> None: ...


class _UserFrame(Frame):
    """A frame with the user id of its connection."""

    user = ""

    def get(self, option: Any) -> Any:
        return self.user if option == "User-Id" else super().get(option)


class _Router(Inbox):
    """The control socket of the front."""

    def __init__(self, clients: dict[bytes, RawClient]) -> None:
        super().__init__()
        self._clients = clients

    def recv(self, flags: int = 0, *, copy: bool = True) -> Any:
        frame = super().recv(flags, copy=copy)
        if not copy:
            user_frame = _UserFrame(frame.bytes, frame.get(zmq.SRCFD), more=frame.more)
            user_frame.user = next((c.user for c in self._clients.values() if c.descriptor == frame.get(zmq.SRCFD)), "")
            return user_frame
        return frame

    def send_multipart(self, frames: Sequence[bytes], _flags: int = 0) -> None:
        client = self._clients.get(bytes(frames[0]))
        if client is None:
            raise zmq.ZMQError(zmq.EHOSTUNREACH)
        client.deliver([bytes(one) for one in frames[1:]])


class _Publisher(Inbox):
    """The state socket of the front. `subscribers`: those that it admitted."""

    def __init__(self) -> None:
        super().__init__()
        self.subscribers: list[Subscriber] = []

    def send_multipart(self, frames: Sequence[bytes], _flags: int = 0) -> None:
        for one in self.subscribers:
            one.frames.append([bytes(frame) for frame in frames])

    def close(self, linger: int = 0) -> None:
        for one in self.subscribers:
            one.disconnects += 1
        self.subscribers = []


class _Authenticator(Authenticator):
    """Admits connections without a ZAP socket."""

    def __init__(self, keys: Keyring, drops: Drops, on_refused: Callable[[str, str, str], None]) -> None:
        self.socket = Inbox()  # type: ignore[assignment]
        self._keyring = keys
        self._drops = drops
        self.on_refused = on_refused
        self.is_revoked = lambda _mark: False
        self.is_rate_limited = lambda _domain, _mark, _address: False

    def admit(self, domain: bytes, curve: Curve | None) -> str:
        """Return the user id of a connection, empty when it is refused. Raises `TryLaterError`."""
        self._keyring.reload_if_changed()
        request = [b"1.0", b"1", domain, b"127.0.0.1", b"", b"CURVE", decode_key(curve[1].decode()) if curve else b""]
        return self._authenticate(request)


class _Sockets:
    """In place of `FrontSockets`."""

    session: FrontSession

    def __init__(self, start: FrontStart, drops: Drops, on_key_refused: Callable[[str, str, str], None]) -> None:
        session, config = self.session, start.config
        self.context = None
        self.link, self.link_monitor = _links.pop(start.link_endpoint), Inbox()
        session.router, session.monitor = _Router(session.routes), Monitor()
        self.control = WatchedSocket(session.router, session.monitor)  # type: ignore[arg-type]
        self.state = self.open_state(0)
        self.keyring, self.authenticator, self.listeners = Keyring(drops=drops), None, ()
        if config.curve or config.curve_secret_file:
            self.keyring = open_keyring(
                config.key_home, config.curve_secret_file, config.curve_clients_dir, drops, config.gateway_key, ()
            )
            self.authenticator = session.authenticator = _Authenticator(self.keyring, drops, on_key_refused)
        key = self.keyring.key
        self.ports = Ports("127.0.0.1", 7721, 7722, key.fingerprint if key else "", ("127.0.0.1",))

    def open_state(self, _port: int) -> WatchedSocket:
        self.session.publisher = _Publisher()
        return WatchedSocket(self.session.publisher, Monitor())  # type: ignore[arg-type]

    def close(self) -> None: ...


class ClientBase:
    """A client without any logic: keeps what it is sent."""

    def __init__(self, session: SessionBase) -> None:
        self.session = session
        self.secret = os.urandom(16)
        self.inbox: list[tuple[Message, list[bytes]]] = []
        self.welcome: Welcome | None = None

    @property
    def epoch(self) -> int:
        return self.welcome.connection_epoch if self.welcome else 0

    def send(self, message: ClientMessage | bytes, on_behalf_of: str = "", epoch: int | None = None) -> None:
        if not isinstance(message, bytes):
            message = encode_client(wrap_message(message, self.epoch if epoch is None else epoch, on_behalf_of))
        self.send_multipart([message])

    def send_multipart(self, frames: list[bytes]) -> None:
        raise NotImplementedError

    def deliver(self, frames: list[bytes]) -> None:
        message = decode_server(frames[0]).message
        self.inbox.append((message, frames[1:]))
        if isinstance(message, Welcome):
            self.welcome = message

    def got(self, kind: type[T]) -> list[T]:
        return [message for message, _ in self.inbox if isinstance(message, kind)]

    def wait_for(self, kind: type[T], n: int = 1) -> T:
        """Wait for the `n`-th message of a kind, without those about stalls, which a busy machine makes at any time."""

        def came() -> list[T]:
            return [one for one in self.got(kind) if getattr(one, "code", "") not in STALLS]

        self.session.pump(lambda: len(came()) >= n, f"{n} {kind.__name__}")
        return came()[n - 1]

    def join(self, role: str = "operator", name: str = "Ann", **hello: object) -> Welcome:
        before = len(self.got(Welcome))
        self.send(Hello(role, name, secret=self.secret, **hello))  # type: ignore[arg-type]
        return self.wait_for(Welcome, before + 1)


class RawClient(ClientBase):
    """A connection to the control socket; also in place of its socket (`send`, `send_multipart`)."""

    session: FrontSession

    def __init__(self, session: FrontSession, routing_id: bytes = b"", curve: Curve | None = None) -> None:
        super().__init__(session)
        self.socket = self
        self.user = ""
        self.reads = True
        self.descriptor = session.connect(self)
        self.routing_id = routing_id or b"\0%d" % self.descriptor
        self._curve = curve
        self._waiting: list[list[bytes]] = []
        self.is_open, self.is_admitted = True, False
        self.admit()

    def admit(self) -> None:
        """Finish the handshake, unless the key has to wait."""
        if self.is_admitted or not self.is_open:
            return
        if self._curve is not None:
            assert self.session.authenticator is not None
            try:
                self.user = self.session.authenticator.admit(ZAP_CONTROL, self._curve)
            except TryLaterError:
                return
            if not self.user:
                self.is_open = False
                return
        self.is_admitted = True
        self.session.routes.setdefault(self.routing_id, self)
        waiting, self._waiting = self._waiting, []
        for frames in waiting:
            self.send_multipart(frames)

    @property
    def is_connected(self) -> bool:
        return self.is_open and self.descriptor in self.session.network.connections

    def send_multipart(self, frames: list[bytes]) -> None:
        if not self.is_admitted:
            self._waiting.append(frames)
        elif self.is_connected and self.session.routes.get(self.routing_id) is self:
            self.session.router.push([self.routing_id, *frames], self.descriptor)

    def deliver(self, frames: list[bytes]) -> None:
        if not self.reads:
            raise zmq.ZMQError(zmq.EAGAIN)
        super().deliver(frames)

    def close(self, linger: int = 0) -> None:
        self.is_open = False
        self.session.disconnect(self.descriptor)


class Subscriber:
    """A subscriber of the state. `disconnects`: how often its connection was closed."""

    def __init__(self, session: FrontSession, curve: Curve | None = None) -> None:
        self.frames: deque[list[bytes]] = deque()
        self.disconnects = 0
        self._session = session
        self._curve = curve
        self.admit()

    def admit(self) -> None:
        """Connect, or connect again."""
        session = self._session
        if self in session.publisher.subscribers:
            return
        if self._curve is not None:
            assert session.authenticator is not None
            try:
                if not session.authenticator.admit(ZAP_STATE, self._curve):
                    return
            except TryLaterError:
                return
        session.publisher.subscribers.append(self)

    def poll(self, _timeout: int = 0) -> int:
        return len(self.frames)

    def recv_multipart(self) -> list[bytes]:
        return self.frames.popleft()


class SessionBase:
    """An authority that admits every client and answers snapshots. `entries`: all it received."""

    link: FrontLink

    def __init__(self, **config: object) -> None:
        settings: dict[str, object] = {"session_name": "test", "silence_ns": LONG_NS, "stall_ns": LONG_NS}
        self.config = FrontConfig(**{**settings, **config})  # type: ignore[arg-type]
        self.entries: list[Entry] = []
        self.step = self.event_seq = 0
        self.admits = True

    def once(self, decision: Decision | None = None) -> None:
        """Take one step of the authority."""
        entries = self.link.poll()
        self.entries += entries
        self.step += 1
        self.link.send_decision(self.step, decision or self._answer(entries))
        self.run_front()

    def run_front(self) -> None:
        """Let the front work, and time pass."""

    def _answer(self, entries: list[Entry]) -> Decision:
        admitted, outgoing = [], []
        for entry in entries:
            message = entry.message
            if isinstance(message, Join) and self.admits:
                participant = message.resume_of or f"p{entry.connection}"
                admitted.append(Admitted(entry.connection, participant, message.role, bool(message.resume_of)))
            elif isinstance(message, GetSnapshot):
                outgoing.append(OutgoingMessage(entry.connection, self.snapshot(message.request_id)))
        return Decision((), admitted=tuple(admitted), outgoing=tuple(outgoing))

    def snapshot(self, request_id: int) -> Snapshot:
        return Snapshot(request_id, self.event_seq, 1, 0, "", 0, 0.0, self.link.now_ns, (), ())

    def notice(self, text: str = "hello") -> Event:
        self.event_seq += 1
        return Event(self.event_seq, self.step, 0, Notice("info", text))

    def pump(self, until: Callable[[], object], what: str = "condition", timeout_s: float = 20.0) -> None:
        """Take steps until the condition holds."""
        raise NotImplementedError

    def describe(self, clients: Sequence[ClientBase]) -> str:
        """Return counters of the front, and the newest messages of authority and clients, for a failure."""
        newest = [[message for message, _ in client.inbox[-5:]] for client in clients]
        return f"{self.link.status.drops}, authority {self.entries[-5:]}, clients {newest}"

    def wait_entries(self, kind: type, n: int = 1, connection: int | None = None) -> list[Entry]:
        """Wait for at least `n` entries of a kind. Return all of them."""

        def found() -> list[Entry]:
            return [e for e in self.entries if isinstance(e.message, kind) and connection in (None, e.connection)]

        self.pump(lambda: len(found()) >= n, f"{n} entries {kind.__name__}")
        return found()

    def send_state(self, poses: np.ndarray, epoch: int = 1) -> None:
        self.link.send_state(StateHeader(epoch, 0, self.step, 0.0, self.link.now_ns, 0, 0, 0), poses)

    def wait_drops(self, reason: str, least: int = 1) -> int:
        """Wait for a status with at least so many drops: those that happened come in the next ones."""
        self.pump(lambda: self.link.status.drops.get(reason, 0) >= least, f"{least} drops for {reason}")
        return self.link.status.drops[reason]


class FrontSession(SessionBase):
    """A front in this process, and its authority."""

    host = "127.0.0.1"

    def __init__(self, *, bodies: int = N_BODIES, **config: object) -> None:
        super().__init__(**config)
        self.now_ns = 10_000 * MILLISECOND
        self.network = Network(Simulation(0))
        self.routes: dict[bytes, RawClient] = {}
        self.authenticator: _Authenticator | None = None
        self.router: _Router
        self.monitor: Monitor
        self.publisher: _Publisher
        self.clients: list[RawClient] = []
        self.subscribers: list[Subscriber] = []
        self._scene = scene(bodies)
        self._patch = pytest.MonkeyPatch()
        install_front(self.network, self._patch)
        clock = SimpleNamespace(monotonic_ns=lambda: self.now_ns)
        self._patch.setattr(front_context, "time", clock)
        self._patch.setattr(front_context, "FrontSockets", type("Sockets", (_Sockets,), {"session": self}))
        self._patch.setattr(keyring, "FileWorker", InlineFileWorker)
        self._patch.setattr(pairing, "ITERATIONS", 1)
        self._patch.setattr(front_loop, "SessionRegistration", lambda *_: SimpleNamespace(tick=id, close=int))
        self.link: RigLink = RigLink(self.config, lambda: self.now_ns)
        self.process = SimpleNamespace(link=self.link, restart=self.restart)
        self.restarts = 0
        self.restart()

    def restart(self) -> None:
        """Start the front, or another one in its place: every connection ends."""
        for descriptor in list(self.network.connections):
            self.disconnect(descriptor)
        self.restarts += 1
        endpoint = self.link.open(Path(f"/front-{self.restarts}"))
        self.front = Front(FrontStart(self.config, self._scene, endpoint, 0, self.link.handback))
        self.ports = self.front._context.ports
        self.front._link.send_multipart((link.READY, msgspec.msgpack.encode(self.ports)))
        self.link.receive()

    # --- connections ------------------------------------------------------------------------------------------------

    def connect(self, client: RawClient) -> int:
        descriptor = FIRST_DESCRIPTOR + len(self.clients) + 1
        connection: Any = SimpleNamespace(address=("127.0.0.1", 1024 + len(self.clients)), is_open=True)
        connection.front = SimpleNamespace(connections={}, monitor=self.monitor)
        connection.routing_id, connection.descriptor = b"", descriptor
        connection.sockets = SimpleNamespace(link=SimpleNamespace(send=lambda *_: None))
        self.network.connections[descriptor] = connection
        self.clients.append(client)
        self.monitor.report(int(zmq.EVENT_ACCEPTED), descriptor)
        return descriptor

    def disconnect(self, descriptor: int) -> None:
        connection = self.network.connections.get(descriptor)
        if connection is not None:
            self.network.close(connection)

    def client(self, routing_id: bytes = b"", curve: Curve | None = None) -> RawClient:
        return RawClient(self, routing_id, curve)

    def subscriber(self, curve: Curve | None = None) -> Subscriber:
        self.subscribers.append(Subscriber(self, curve))
        return self.subscribers[-1]

    def run_front(self) -> None:
        while self.front._run_once():
            pass
        self.now_ns += STEP_NS
        for route, client in list(self.routes.items()):
            if not client.is_connected:
                del self.routes[route]
        for one in (*self.clients, *self.subscribers):
            one.admit()

    def pump(self, until: Callable[[], object], what: str = "condition", timeout_s: float = 20.0) -> None:
        for _ in range(int(timeout_s * 1000 * MILLISECOND / STEP_NS)):
            if until():
                return
            self.once()
        raise AssertionError(f"no {what} in {timeout_s} s; {self.describe(self.clients)}")

    def close(self) -> None:
        self.front.close()
        self.link.close()
        self._patch.undo()
