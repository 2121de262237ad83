"""Intake and admission without a network, for tests of what clients send."""

from __future__ import annotations

import msgspec
import zmq

from iris_session.front.admission import Admission
from iris_session.front.connections import Peer
from iris_session.front.intake import Intake
from iris_session.front.pairing import PairingService
from iris_session.front.raw_feed import RawFeed
from iris_session.protocol.client_messages import ClientMessage, Hello, wrap_message
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.entries import Entry, Join
from iris_session.protocol.server_messages import Message, Welcome
from iris_session.protocol.steps import Admitted
from tests.front.fakes import make_alignment, make_context, make_status

ROUTE = b"headset"
ANN = Peer(5, "")
EVE = Peer(6, "")
HELLO = Hello("operator", "Ann", secret=b"s" * 16)


class IntakeRig:
    """Intake and admission with an outbox that keeps sent messages. `recorder`: endpoint of raw samples."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]], recorder: str = "") -> None:
        self.now_ns = 1_000_000_000
        self.sent: list[tuple[bytes, Message, list[bytes]]] = []
        front = make_context(self, lambda: self.now_ns)
        self.limits = front.config.limits
        self.drops, self.clients, self.coalescer = front.drops, front.connections, front.coalescer
        self.tokens, self.guard, self.budgets = front.tokens, front.guard, front.budgets
        self.admission = Admission(front, ())
        alignment = make_alignment(front)
        self.intake = Intake(
            front,
            self.admission,
            PairingService(front),
            make_status(front, alignment),
            alignment,
            RawFeed(context, recorder, front.drops),
        )

    def send_multipart(self, frames: list[bytes], _flags: int) -> None:
        self.sent.append((frames[0], decode_server(frames[1]).message, frames[2:]))

    def take(
        self,
        message: ClientMessage,
        peer: Peer = ANN,
        epoch: int = 0,
        behalf: str = "",
        extra: int = 0,
        *,
        route: bytes = ROUTE,
    ) -> None:
        data = encode_client(wrap_message(message, epoch, behalf))
        self.intake.handle_message(route, peer, memoryview(data), extra)

    def join(self, peer: Peer = ANN, *, route: bytes = ROUTE, **hello: object) -> Welcome:
        self.take(msgspec.structs.replace(HELLO, **hello), peer, route=route)
        (entry,) = self.coalescer.take_batch()
        assert isinstance(entry.message, Join)
        self.admission.send_welcome(Admitted(entry.connection, "p1", "operator", False), self.now_ns, 2_000_000)
        welcome = self.sent[-1][1]
        assert isinstance(welcome, Welcome)
        return welcome

    def entries(self) -> list[Entry]:
        return self.coalescer.take_batch()

    def last(self) -> Message:
        return self.sent[-1][1]
