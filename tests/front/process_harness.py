"""A session around a real front process: raw ZeroMQ clients, in one thread."""

from __future__ import annotations

import time
from collections.abc import Callable

import zmq

from iris_session.link import FrontProcess
from iris_session.protocol.steps import Decision
from tests.front.harness import ClientBase, Curve, SessionBase, scene
from tests.loopback import make_loopback_address


class ProcessClient(ClientBase):
    """A DEALER on the control port."""

    def __init__(self, session: ProcessSession, curve: Curve | None = None) -> None:
        super().__init__(session)
        self.socket = session.context.socket(zmq.DEALER)
        self.socket.linger = 0
        if curve:
            self.socket.curve_serverkey, self.socket.curve_publickey, self.socket.curve_secretkey = curve
        self.socket.connect(f"tcp://{session.host}:{session.ports.control}")

    def send_multipart(self, frames: list[bytes]) -> None:
        self.socket.send_multipart(frames)

    def receive(self) -> None:
        while not self.socket.closed and self.socket.poll(0):
            self.deliver(self.socket.recv_multipart())

    def close(self, linger: int = 0) -> None:
        self.socket.close(linger=linger)


class ProcessSession(SessionBase):
    """A front process, and its authority."""

    def __init__(self, **config: object) -> None:
        free = {"host": make_loopback_address(), "control_port": 0, "state_port": 0, "origin_ns": time.monotonic_ns()}
        super().__init__(**{**free, **config})
        #: Address of the session's sockets for clients of this machine.
        self.host = "127.0.0.1" if {"host", "listen"} & config.keys() else self.config.host
        self.context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.process = FrontProcess(self.config, scene())
        self.link = self.process.link
        self.clients: list[ProcessClient] = []
        self.subscribers: list[zmq.Socket[bytes]] = []
        self.ports = self.process.start()

    def client(self, curve: Curve | None = None) -> ProcessClient:
        self.clients.append(ProcessClient(self, curve))
        return self.clients[-1]

    def subscriber(self, curve: Curve | None = None) -> zmq.Socket[bytes]:
        sub = self.context.socket(zmq.SUB)
        sub.linger = 0
        if curve:
            sub.curve_serverkey, sub.curve_publickey, sub.curve_secretkey = curve
        sub.connect(f"tcp://{self.host}:{self.ports.state}")
        sub.subscribe(b"")
        self.subscribers.append(sub)
        return sub

    def once(self, decision: Decision | None = None) -> None:
        super().once(decision)
        for client in self.clients:
            client.receive()

    def pump(self, until: Callable[[], object], what: str = "condition", timeout_s: float = 60.0) -> None:
        deadline = time.monotonic() + timeout_s
        while not until():
            assert time.monotonic() < deadline, f"no {what} within {timeout_s} s; {self.describe(self.clients)}"
            self.once()
            time.sleep(0.001)

    def close(self) -> None:
        for client in self.clients:
            client.close()
        for sub in self.subscribers:
            sub.close()
        self.process.close()
        self.context.destroy(linger=0)
