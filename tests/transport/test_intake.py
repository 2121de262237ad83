"""Intake and admission without a network: who is taken for whom, what is answered, what reaches the authority."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec
import pytest
import zmq

from iris_session.protocol.client_messages import ClientMessage, EStop, Hello, Marker, envelope
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.entries import Entry, Join
from iris_session.protocol.server_messages import Message, ProtocolFault, Refused, Welcome
from iris_session.protocol.steps import Admitted
from iris_session.transport import FrontConfig, Ports
from iris_session.transport.admission import Admission
from iris_session.transport.clients import ClientTable, Outbox, Peer
from iris_session.transport.coalescer import Coalescer
from iris_session.transport.intake import Intake, RawFeed
from iris_session.transport.limiter import Drops
from iris_session.transport.resume_tokens import ResumeTokens

ROUTE = b"headset"
ANN = Peer(5, "")
EVE = Peer(6, "")


class Desk:
    """Intake with an outbox that keeps what it is given."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        config = FrontConfig()
        self.now_ns = 1_000_000_000
        self.drops = Drops()
        self.clients = ClientTable()
        self.sent: list[tuple[bytes, Message, list[bytes]]] = []
        outbox = Outbox(self, config.limits, self.drops)  # type: ignore[arg-type]
        self.coalescer = Coalescer(config.limits, self.drops)
        self.tokens = ResumeTokens(8)
        self.admission = Admission(config, Ports("127.0.0.1", 1, 2), self.clients, outbox, self.drops, self.tokens)
        raw = RawFeed(context, "", self.drops)
        self.intake = Intake(
            config, self.clients, outbox, self.admission, self.coalescer, raw, self.drops, lambda: self.now_ns
        )

    def send_multipart(self, frames: list[bytes], _flags: int) -> None:
        self.sent.append((frames[0], decode_server(frames[1]).message, frames[2:]))

    def take(self, message: ClientMessage, peer: Peer = ANN, epoch: int = 0, behalf: str = "", extra: int = 0) -> None:
        data = encode_client(envelope(message, epoch, behalf))
        self.intake.take(ROUTE, peer, memoryview(data), extra)

    def join(self, peer: Peer = ANN, **hello: object) -> Welcome:
        self.take(msgspec.structs.replace(Hello("operator", "Ann", secret=b"s" * 16), **hello), peer)
        (entry,) = self.coalescer.take()
        assert isinstance(entry.message, Join)
        self.admission.welcome(Admitted(entry.connection, "p1", "operator", False), self.now_ns)
        welcome = self.sent[-1][1]
        assert isinstance(welcome, Welcome)
        return welcome

    def entries(self) -> list[Entry]:
        return self.coalescer.take()

    def last(self) -> Message:
        return self.sent[-1][1]


@pytest.fixture
def desk() -> Iterator[Desk]:
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    yield Desk(context)
    context.destroy(linger=0)


def test_another_tcp_connection_on_the_same_route_is_a_stranger_and_ends_the_first(desk: Desk) -> None:
    epoch = desk.join().connection_epoch
    desk.take(EStop("as Ann"), EVE, epoch)
    assert desk.last() == ProtocolFault("hello", "this connection has not said hello: say hello (again)")
    assert desk.entries() == []
    assert [c.number for c in desk.intake.replaced] == [epoch]


def test_another_key_on_the_same_route_is_a_stranger(desk: Desk) -> None:
    epoch = desk.join(Peer(5, "key-of-ann"), secret=b"").connection_epoch
    desk.take(EStop("as Ann"), Peer(5, "key-of-eve"), epoch)
    assert desk.entries() == []
    assert isinstance(desk.last(), ProtocolFault)


def test_the_curve_key_is_the_identity_whatever_the_secret(desk: Desk) -> None:
    desk.take(Hello("operator", "Ann", secret=b"x" * 16), Peer(5, "fingerprint"))
    (entry,) = desk.entries()
    assert isinstance(entry.message, Join)
    assert entry.message.key_id == "fingerprint"


def test_more_than_one_frame_is_malformed(desk: Desk) -> None:
    epoch = desk.join().connection_epoch
    desk.take(Marker(1, "x"), epoch=epoch, extra=1)
    fault = desk.last()
    assert isinstance(fault, ProtocolFault)
    assert (fault.code, desk.entries()) == ("malformed", [])


def test_what_is_said_before_admission_is_dropped_and_counted(desk: Desk) -> None:
    desk.take(Hello("operator", "Ann", secret=b"s" * 16))
    desk.take(Marker(1, "early"), epoch=1)
    assert [type(e.message) for e in desk.entries()] == [Join]
    assert desk.drops.by_reason == {"not_admitted": 1}


def test_too_many_messages_of_a_type_are_dropped_with_a_fault_now_and_then(desk: Desk) -> None:
    epoch = desk.join().connection_epoch
    for i in range(100):
        desk.take(Marker(i, "x"), epoch=epoch)
    faults = [m for _, m, _ in desk.sent if isinstance(m, ProtocolFault)]
    assert desk.drops.by_reason["rate"] == 60
    assert 1 <= len(faults) <= 6
    assert "marker" in faults[0].message
    desk.take(EStop(), epoch=epoch)
    assert isinstance(desk.entries()[0].message, EStop)


def test_an_estop_is_never_over_its_rate(desk: Desk) -> None:
    epoch = desk.join().connection_epoch
    for _ in range(1000):
        desk.take(EStop(), epoch=epoch)
        (entry,) = desk.entries()
        assert isinstance(entry.message, EStop)


def test_the_hellos_of_one_peer_are_bounded_until_it_is_gone(desk: Desk) -> None:
    for _ in range(12):
        desk.take(Hello("operator", "Ann"))
    assert [m.code for _, m, _ in desk.sent if isinstance(m, Refused)] == ["identity"] * 10 + ["rate"] * 2
    desk.take(Hello("operator", "Eve"), EVE)
    assert desk.last() == desk.sent[0][1]
    desk.admission.forget_peer(ANN.descriptor)
    desk.take(Hello("operator", "Ann"))
    assert desk.last() == desk.sent[0][1]


def test_answers_to_those_behind_a_gateway_name_them(desk: Desk) -> None:
    desk.join(role="gateway")
    desk.take(Hello("operator", "Tab"), behalf="tab1")
    route, refused, bulk = desk.sent[-1]
    assert (route, bulk) == (ROUTE, [b"tab1"])
    assert isinstance(refused, Refused)


def test_two_behind_one_gateway_with_one_secret_are_one_key_but_not_that_of_a_client(desk: Desk) -> None:
    desk.join(role="gateway")
    for tab in ("tab1", "tab2"):
        desk.take(Hello("operator", tab, secret=b"s" * 16), behalf=tab)
    first, second = (e.message.key_id for e in desk.entries() if isinstance(e.message, Join))
    assert first == second != desk.clients.by_number[1].key_id


def test_nobody_speaks_for_a_gateway_of_another_tcp_connection(desk: Desk) -> None:
    desk.join(role="gateway")
    desk.take(Hello("operator", "Tab", secret=b"s" * 16), EVE, behalf="tab1")
    refused = desk.last()
    assert isinstance(refused, Refused)
    assert refused.code == "gateway_only"
    assert desk.entries() == []
