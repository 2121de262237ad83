"""A session around a real front process: a minimal authority and raw ZeroMQ clients, in one thread."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import TypeVar

import numpy as np
import zmq

from iris_session.link import FrontConfig, FrontProcess, SceneInfo
from iris_session.protocol.client_messages import ClientMessage, GetSnapshot, Hello, wrap_message
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.entries import Entry, Join
from iris_session.protocol.names import FaultCode
from iris_session.protocol.server_messages import BodyInfo, Event, Message, Notice, Snapshot, StateHeader, Welcome
from iris_session.protocol.steps import Admitted, Decision, OutgoingMessage
from tests.loopback import make_loopback_address

N_BODIES = 3
LONG_NS = 600_000_000_000
STALLS = (FaultCode.STALLED, FaultCode.RECOVERED)
T = TypeVar("T", bound=Message)


def scene(n: int = N_BODIES) -> SceneInfo:
    poses = np.zeros((n, 7))
    poses[:, 3] = 1.0
    return SceneInfo("hash", (), tuple(BodyInfo(i, f"body{i}", True) for i in range(n)), poses.tobytes())


class ProcessClient:
    """A DEALER (and a SUB on demand) without any logic."""

    def __init__(
        self, session: ProcessSession, routing_id: bytes = b"", curve: tuple[bytes, bytes, bytes] | None = None
    ) -> None:
        self.session = session
        self.secret = os.urandom(16)
        self.inbox: list[tuple[Message, list[bytes]]] = []
        self.welcome: Welcome | None = None
        self.socket = session.context.socket(zmq.DEALER)
        self.socket.linger = 0
        if routing_id:
            self.socket.setsockopt(zmq.ROUTING_ID, routing_id)
        if curve:
            self.socket.curve_serverkey, self.socket.curve_publickey, self.socket.curve_secretkey = curve
        self.socket.connect(f"tcp://{session.host}:{session.ports.control}")

    @property
    def epoch(self) -> int:
        return self.welcome.connection_epoch if self.welcome else 0

    def send(self, message: ClientMessage, on_behalf_of: str = "", epoch: int | None = None) -> None:
        self.socket.send(encode_client(wrap_message(message, self.epoch if epoch is None else epoch, on_behalf_of)))

    def receive(self) -> None:
        while self.socket.poll(0):
            frames = self.socket.recv_multipart()
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

    def close(self, linger: int = 0) -> None:
        self.socket.close(linger=linger)


class ProcessSession:
    """A front process, and an authority that admits every client and answers snapshots. `entries`: all it received."""

    def __init__(self, *, start: bool = True, bodies: int = N_BODIES, **config: object) -> None:
        settings: dict[str, object] = {
            "host": make_loopback_address(),
            "control_port": 0,
            "state_port": 0,
            "origin_ns": time.monotonic_ns(),
            "session_name": "test",
            # A busy machine stops this process for seconds. Tests of silence and of stalls have their own bounds.
            "silence_ns": LONG_NS,
            "stall_ns": LONG_NS,
        }
        self.config = FrontConfig(**{**settings, **config})  # type: ignore[arg-type]
        #: Address of the session's sockets for clients of this machine.
        self.host = "127.0.0.1" if {"host", "listen"} & config.keys() else self.config.host
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.process = FrontProcess(self.config, scene(bodies))
        self.entries: list[Entry] = []
        self.clients: list[ProcessClient] = []
        self.subscribers: list[zmq.Socket[bytes]] = []
        self.step = 0
        self.event_seq = 0
        self.admits = True
        if start:
            self.ports = self.process.start()

    def client(self, routing_id: bytes = b"", curve: tuple[bytes, bytes, bytes] | None = None) -> ProcessClient:
        client = ProcessClient(self, routing_id, curve)
        self.clients.append(client)
        return client

    def subscriber(
        self, curve: tuple[bytes, bytes, bytes] | None = None, rcvhwm: int = 1000, rcvbuf: int = -1
    ) -> zmq.Socket[bytes]:
        sub = self.context.socket(zmq.SUB)
        sub.linger = 0
        sub.rcvhwm = rcvhwm
        sub.setsockopt(zmq.RCVBUF, rcvbuf)
        if curve:
            sub.curve_serverkey, sub.curve_publickey, sub.curve_secretkey = curve
        sub.connect(f"tcp://{self.host}:{self.ports.state}")
        sub.subscribe(b"")
        self.subscribers.append(sub)
        return sub

    def once(self, decision: Decision | None = None) -> None:
        """Take one step of the authority."""
        entries = self.process.link.poll()
        self.entries += entries
        self.step += 1
        self.process.link.send_decision(self.step, decision or self._answer(entries))
        for client in self.clients:
            if not client.socket.closed:
                client.receive()

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
        return Snapshot(request_id, self.event_seq, 1, 0, "", 0, 0.0, self.process.link.now_ns, (), ())

    def notice(self, text: str = "hello") -> Event:
        self.event_seq += 1
        return Event(self.event_seq, self.step, 0, Notice("info", text))

    def pump(self, until: Callable[[], bool], what: str = "condition", timeout_s: float = 60.0) -> None:
        """Take steps until the condition holds."""
        deadline = time.monotonic() + timeout_s
        while not until():
            assert time.monotonic() < deadline, f"no {what} within {timeout_s} s; {self._seen()}"
            self.once()
            time.sleep(0.001)

    def _seen(self) -> str:
        """Return counters of the front, and the newest messages of authority and clients, for a failure."""
        told = [[message for message, _ in client.inbox[-5:]] for client in self.clients]
        return f"{self.process.link.status}, authority {self.entries[-5:]}, clients {told}"

    def wait_entries(self, kind: type, n: int = 1, connection: int | None = None) -> list[Entry]:
        """Wait for at least `n` entries of a kind. Return all of them."""

        def found() -> list[Entry]:
            return [e for e in self.entries if isinstance(e.message, kind) and connection in (None, e.connection)]

        self.pump(lambda: len(found()) >= n, f"{n} entries {kind.__name__}")
        return found()

    def send_state(self, poses: np.ndarray, epoch: int = 1) -> None:
        self.process.link.send_state(StateHeader(epoch, 0, self.step, 0.0, self.process.link.now_ns, 0, 0, 0), poses)

    def wait_drops(self, reason: str, least: int = 1) -> int:
        """Wait for a status with at least so many drops: those that happened come in the next ones."""
        self.pump(lambda: self.process.link.status.drops.get(reason, 0) >= least, f"{least} drops for {reason}")
        return self.process.link.status.drops[reason]

    def close(self) -> None:
        for client in self.clients:
            client.close()
        for sub in self.subscribers:
            sub.close()
        self.process.close()
        self.context.destroy(linger=0)
