"""One key against everybody: what it may open, hold and send, over all its connections."""

from __future__ import annotations

from collections.abc import Callable

from iris_session.protocol.client_messages import Hello, Marker, wrap_message
from iris_session.protocol.codec import encode_client
from iris_session.protocol.entries import Lost
from iris_session.protocol.names import AuditKind, RefusalCode
from iris_session.protocol.server_messages import Refused, Welcome
from iris_session.security import KeyPair
from iris_session.security.zap import ZAP_INGEST
from tests.front.harness import FrontSession, RawClient
from tests.front.lab import Lab

OpenSession = Callable[..., FrontSession]


def join_many(lab: Lab, pair: KeyPair, n: int) -> list[RawClient]:
    """Send `n` hellos with one key, each by a connection of its own, and wait for all answers."""
    clients = [lab.client(pair) for _ in range(n)]
    for client in clients:
        client.send(Hello("observer", "Hog"))
        lab.session.pump(lambda c=client: c.got(Welcome) or c.got(Refused), "an answer")  # type: ignore[misc]
    return clients


# --- connections ---


def test_one_key_has_a_handful_of_connections(lab: Lab) -> None:
    pair, first = lab.allowed("hog", "observer")
    clients = [first, *join_many(lab, pair, 13)]
    joined = [client for client in clients if client.got(Welcome)]
    assert len(joined) == 8
    refused = clients[-1].got(Refused)[0]
    assert refused.code in ("full", "rate")
    lab.allowed("ann", "operator")


def test_a_gateways_key_has_connections_for_many(lab: Lab) -> None:
    pair, first = lab.allowed("gateway", "gateway", "operator")
    clients = [first, *join_many(lab, pair, 13)]
    assert all(client.got(Welcome) for client in clients)


def test_one_key_leaves_subscribers_to_others(lab: Lab) -> None:
    pair, _ = lab.allowed("hog", "observer")
    for _ in range(40):
        lab.session.subscriber(curve=lab.curve(pair))
    assert lab.session.wait_drops("key_connections") > 0
    assert len(lab.session.publisher.subscribers) < 20


def test_a_key_without_the_role_is_refused_at_media_ingest(lab: Lab) -> None:
    eve, _ = lab.allowed("eve", "observer")
    camera, _ = lab.allowed("camera", "camera", "observer")
    authenticator = lab.session.authenticator
    assert authenticator is not None
    assert authenticator.admit(ZAP_INGEST, lab.curve(eve)) == ""
    assert authenticator.admit(ZAP_INGEST, lab.curve(camera)) == camera.fingerprint
    assert lab.session.wait_drops("media_source_refused") == 1
    (audit,) = lab.audits(AuditKind.KEY_REFUSED)
    assert (audit.subject, audit.detail) == (eve.fingerprint, "media ingest")


# --- those behind a gateway ---


def test_a_flood_of_one_behind_a_gateway_ends_only_its_participant(open_session: OpenSession) -> None:
    session = open_session()
    gateway = session.client()
    gateway.join("gateway", "Gate")
    for name in ("Ann", "Mallory"):
        gateway.send(Hello("observer", name, secret=name.ljust(16).encode()), name)
        gateway.wait_for(Welcome, 2 if name == "Ann" else 3)
    ann, mallory = (w.connection_epoch for w in gateway.got(Welcome)[1:])
    data = encode_client(wrap_message(Marker(1, "x"), mallory, "Mallory"))
    for i in range(12_000):
        gateway.socket.send(data)
        if i % 1000 == 0:
            session.once()
    lost = session.wait_entries(Lost)
    assert [(entry.connection, entry.message) for entry in lost] == [(mallory, Lost("flood"))]
    assert session.wait_drops("flood_cut") == 1
    gateway.send(Marker(7, "still here"), "Ann", ann)
    session.wait_entries(Marker, connection=ann)
    gateway.send(Hello("observer", "Mallory", secret=b"Mallory".ljust(16)), "Mallory", 0)
    assert gateway.wait_for(Refused).code == RefusalCode.RATE, "it may come back in a moment"
