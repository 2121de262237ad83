"""People behind gateways: web identities, their roles, pairing, revocation, lost connections."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

import pytest

from iris_session.front.revocation import CHECK_PERIOD_NS
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Disconnected, Hello, Marker, Pair, RemoveParticipant
from iris_session.protocol.common import Message
from iris_session.protocol.entries import Entry, Join, Lost
from iris_session.protocol.names import AuditKind, FaultCode, RefusalCode, Role
from iris_session.protocol.server_messages import (
    Event,
    Paired,
    ParticipantChanged,
    ParticipantInfo,
    ProtocolFault,
    Refused,
    Welcome,
)
from iris_session.protocol.steps import Decision
from iris_session.security import WEB, KeyPair, compute_fingerprint, encode_key
from tests.front.harness import FrontSession, RawClient
from tests.front.lab import Lab, Open

PERSONAL_ROLES = tuple(sorted(Role.ALL - {Role.GATEWAY}))
CERTIFICATE = hashlib.sha256(b"certificate of the gateway").digest()


class Person:
    """Somebody with a browser: a secret, and so an identity."""

    def __init__(self, name: str = "ada") -> None:
        self.name = name
        self.secret = os.urandom(32)
        self.identity = hashlib.sha256(self.secret).digest()
        self.fingerprint = compute_fingerprint(self.identity)

    def hello(self, role: str = "operator", **fields: bytes) -> Hello:
        return Hello(role, self.name, secret=self.secret, **fields)

    def pair(self, code: str, certificate: bytes = CERTIFICATE) -> Pair:
        stretched = pairing.stretch_code(code, certificate)
        proof = pairing.make_client_proof(stretched, certificate, self.identity)
        return Pair(self.name, proof, identity=self.identity)


class Gateway:
    """A gateway that has joined."""

    def __init__(
        self, session: FrontSession, curve: tuple[bytes, bytes, bytes] | None, certificate: bytes = CERTIFICATE
    ) -> None:
        self.session = session
        self.client: RawClient = session.client(curve=curve)
        self.client.join(role="gateway", name="web", certificate_hash=certificate)

    def received(self, name: str, kind: type[Message]) -> list[Message]:
        """Return the messages of a kind for one behind it."""
        return [m for m, frames in self.client.inbox if frames[-1:] == [name.encode()] and isinstance(m, kind)]

    def ask(self, name: str, message: Hello | Pair, kind: type[Message]) -> Message:
        """Send a message for one behind it, and wait for the answer."""
        n = len(self.received(name, kind))
        self.client.send(message, on_behalf_of=name, epoch=0)
        self.session.pump(lambda: len(self.received(name, kind)) > n, f"{kind.__name__} for {name}")
        return self.received(name, kind)[-1]

    def enter(self, person: Person, role: str = "operator", **fields: bytes) -> tuple[Welcome, Join]:
        """Send a hello that is accepted. Return its answer and the entry of the authority."""
        welcome = self.ask(person.name, person.hello(role, **fields), Welcome)
        assert isinstance(welcome, Welcome)
        return welcome, find_join(self.session, welcome)

    def refused(self, person: Person, message: Hello | Pair | None = None) -> Refused:
        answer = self.ask(person.name, message or person.hello(), Refused)
        assert isinstance(answer, Refused)
        return answer


def find_join(session: FrontSession, welcome: Welcome) -> Join:
    (join,) = (e.message for e in session.entries if e.connection == welcome.connection_epoch and is_join(e))
    assert isinstance(join, Join)
    return join


def is_join(entry: Entry) -> bool:
    return isinstance(entry.message, Join)


def open_gateway(lab: Lab, *roles: str, certificate: bytes = CERTIFICATE) -> Gateway:
    """Join a gateway with a listed key."""
    pair = KeyPair.generate()
    lab.home.clients.allow_key(pair.fingerprint[:8], pair.public, roles)
    return Gateway(lab.session, lab.curve(pair), certificate)


def allow(lab: Lab, person: Person, *roles: str) -> None:
    lab.home.clients.allow_key(person.name, encode_key(person.identity), roles, WEB)


@pytest.fixture
def fast_codes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pairing, "ITERATIONS", 1)


class TestIdentity:
    def test_same_person_is_the_same_identity_behind_two_gateways(self, lab: Lab) -> None:
        ada = Person()
        allow(lab, ada)
        first, second = open_gateway(lab, "gateway", "operator"), open_gateway(lab, "gateway", "operator")
        welcome, join = first.enter(ada)
        assert join.key_id == ada.fingerprint
        again, join = second.enter(ada, resume_token=welcome.resume_token)
        assert join.key_id == ada.fingerprint
        assert join.resume_of == again.participant_id == welcome.participant_id

    def test_unlisted_person_may_only_pair(self, lab: Lab) -> None:
        gateway, ada = open_gateway(lab), Person()
        assert gateway.refused(ada).code == RefusalCode.UNPAIRED
        (audit,) = lab.audits(AuditKind.KEY_REFUSED)
        assert (audit.subject, audit.name, audit.detail) == (ada.fingerprint, "ada", "web")
        gateway.client.send(Marker(1, "x"), on_behalf_of="ada", epoch=0)
        lab.session.pump(lambda: bool(gateway.received("ada", ProtocolFault)), "the fault")
        assert [f.code for f in gateway.received("ada", ProtocolFault)] == [FaultCode.HELLO]  # type: ignore[attr-defined]

    def test_secret_of_another_length_is_refused_behind_a_gateway_with_a_certificate(self, lab: Lab) -> None:
        """Else it would have all roles of the gateway's key, without pairing."""
        gateway, ada = open_gateway(lab), Person()
        for n in (16, 31, 33, 64):
            ada.secret = os.urandom(n)
            assert gateway.refused(ada).code == RefusalCode.IDENTITY, n

    def test_curve_entry_is_no_web_identity_and_the_other_way_round(self, lab: Lab) -> None:
        gateway, ada = open_gateway(lab), Person()
        lab.home.clients.allow_key("ada", encode_key(ada.identity))
        assert gateway.refused(ada).code == RefusalCode.UNPAIRED
        own = KeyPair.generate()
        lab.home.clients.allow_key("web only", own.public, (), WEB)
        client = lab.client(own)
        assert lab.refused(client, Hello("operator", "bob", secret=client.secret)).code == RefusalCode.UNPAIRED


class TestRoles:
    @pytest.mark.parametrize(
        ("own", "through", "left"),
        [
            ((), (), PERSONAL_ROLES),
            (("operator", "director"), (), ("director", "operator")),
            ((), ("gateway", "observer"), ("observer",)),
            (("operator", "observer"), ("gateway", "observer", "director"), ("observer",)),
            (("gateway", "observer"), (), ("observer",)),
        ],
    )
    def test_roles_are_those_of_both(
        self, lab: Lab, own: tuple[str, ...], through: tuple[str, ...], left: tuple[str, ...]
    ) -> None:
        gateway, ada = open_gateway(lab, *through), Person()
        allow(lab, ada, *own)
        assert gateway.enter(ada, "observer")[1].roles == left

    def test_role_taken_from_the_person(self, lab: Lab) -> None:
        gateway, ada, bob = open_gateway(lab), Person(), Person("bob")
        allow(lab, ada, "operator")
        allow(lab, bob, "operator")
        welcome, _ = gateway.enter(ada)
        gateway.enter(bob)
        allow(lab, ada, "observer")
        (lost,) = lab.session.wait_entries(Lost)
        assert (lost.connection, lost.message) == (welcome.connection_epoch, Lost("role"))
        lab.session.pump(lambda: bool(gateway.received("ada", ProtocolFault)), "the fault")
        assert not gateway.received("bob", ProtocolFault)

    def test_director_gives_a_role_that_the_key_has_lost(self, lab: Lab) -> None:
        """The authority knows the roles of a key as they were when it joined; the front as they are."""
        gateway, ada = open_gateway(lab), Person()
        allow(lab, ada, "operator", "observer", "director")
        welcome, _ = gateway.enter(ada)
        allow(lab, ada, "operator", "observer")
        applied_ns = lab.session.now_ns + 5 * CHECK_PERIOD_NS
        lab.session.pump(lambda: lab.session.now_ns > applied_ns, "the list is read, and its change applied")
        ids = welcome.participant_id
        lab.session.once(Decision((), events=(changed(lab, ids, "observer"),)))
        gateway.client.send(Marker(1, "still here"), on_behalf_of="ada", epoch=welcome.connection_epoch)
        lab.session.wait_entries(Marker)
        lab.session.once(Decision((), events=(changed(lab, ids, "director"),)))
        (lost,) = lab.session.wait_entries(Lost)
        assert (lost.connection, lost.message) == (welcome.connection_epoch, Lost("role"))


def changed(lab: Lab, participant: str, role: str) -> Event:
    lab.session.event_seq += 1
    body = ParticipantChanged(ParticipantInfo(participant, "ada", role, True))
    return Event(lab.session.event_seq, lab.session.step, 0, body)


@pytest.mark.usefixtures("fast_codes")
class TestPairing:
    def test_pair_and_join_on_the_same_socket(self, lab: Lab) -> None:
        gateway, ada = open_gateway(lab), Person()
        code, made = lab.home.join_codes.create(lab.server, roles=("operator",), web_key=CERTIFICATE)
        paired = gateway.ask("ada", ada.pair(code), Paired)
        assert isinstance(paired, Paired)
        stretched = pairing.stretch_code(code, CERTIFICATE)
        assert paired == Paired(pairing.make_server_proof(stretched, CERTIFICATE, ada.identity), ("operator",))
        entry = lab.home.clients.read()[ada.fingerprint]
        assert (entry.name, entry.kind, entry.key) == ("ada", WEB, encode_key(ada.identity))
        _, join = gateway.enter(ada)
        assert (join.key_id, join.roles) == (ada.fingerprint, ("operator",))
        assert gateway.ask("ada", ada.pair(code), Paired) == paired, "the answer was lost: the same again"
        used = lab.home.join_codes.find_code(made.id)
        assert used is not None
        assert (used.secret, used.web_secret) == (b"", b"")
        (audit,) = lab.audits(AuditKind.PAIRED)
        assert (audit.subject, audit.name) == (ada.fingerprint, "ada")

    def test_code_is_good_for_one_key_of_either_kind(self, lab: Lab) -> None:
        gateway, ada, bob = open_gateway(lab), Person(), KeyPair.generate()
        code, _ = lab.home.join_codes.create(lab.server, web_key=CERTIFICATE)
        client = lab.client(bob)
        client.send(Pair("bob", lab.proof(code, bob)))
        client.wait_for(Paired)
        assert gateway.refused(ada, ada.pair(code)).code == RefusalCode.CODE

    def test_code_made_for_another_certificate(self, lab: Lab) -> None:
        gateway, ada = open_gateway(lab), Person()
        code, made = lab.home.join_codes.create(lab.server, web_key=bytes(32))
        assert gateway.refused(ada, ada.pair(code)).code == RefusalCode.CODE
        assert gateway.refused(ada, ada.pair(code, bytes(32))).code == RefusalCode.CODE
        after = lab.home.join_codes.find_code(made.id)
        assert after is not None
        assert after.attempts_left == made.attempts_left, "it was not meant"

    def test_gateway_without_certificate(self, lab: Lab) -> None:
        gateway, ada = open_gateway(lab, certificate=b""), Person()
        code, _ = lab.home.join_codes.create(lab.server, web_key=CERTIFICATE)
        assert "certificate" in gateway.refused(ada, ada.pair(code)).message

    def test_only_a_gateway_pairs_others(self, lab: Lab) -> None:
        ada = Person()
        code, _ = lab.home.join_codes.create(lab.server, web_key=CERTIFICATE)
        _, bob = lab.allowed("bob", "operator")
        for client in (bob, lab.client(KeyPair.generate())):
            client.send(ada.pair(code), on_behalf_of="ada", epoch=0)
            client.wait_for(ProtocolFault)
        assert not lab.home.clients.read().get(ada.fingerprint)
        assert lab.audits(AuditKind.GATEWAY_REFUSED)


class TestOwnGateway:
    """The session's own gateway has a key made at its start, which is on no list."""

    @pytest.fixture
    def own(self, open_session: Open, tmp_path: Path) -> tuple[Lab, KeyPair]:
        pair = KeyPair.generate()
        lab = Lab(lambda **config: open_session(**config, gateway_key=pair.public), tmp_path / "home")
        return lab, pair

    def test_is_admitted_and_speaks_for_listed_people(self, own: tuple[Lab, KeyPair]) -> None:
        lab, pair = own
        gateway, ada, eve = Gateway(lab.session, lab.curve(pair)), Person(), Person("eve")
        allow(lab, ada, "director")
        assert gateway.enter(ada, "director")[1].roles == ("director",)
        assert gateway.refused(eve).code == RefusalCode.UNPAIRED
        assert pair.fingerprint not in lab.home.clients.read()

    def test_nobody_gets_its_roles_by_another_secret(self, own: tuple[Lab, KeyPair]) -> None:
        lab, pair = own
        gateway, eve = Gateway(lab.session, lab.curve(pair), b""), Person("eve")
        eve.secret = os.urandom(16)
        assert gateway.refused(eve, eve.hello("director")).code == RefusalCode.IDENTITY

    def test_next_front_revokes_keys_that_left_the_list_while_none_ran(self, own: tuple[Lab, KeyPair]) -> None:
        lab, pair = own
        gateway, ada, eva = Gateway(lab.session, lab.curve(pair)), Person("ada"), Person("eva")
        other = KeyPair.generate()
        lab.home.clients.allow_key("other", other.public)
        tabs, tab = Gateway(lab.session, lab.curve(other), b""), Person("tab")
        tab.secret = os.urandom(16)  # no identity of its own: the key of its gateway counts
        for person in (ada, eva):
            allow(lab, person)
        joined = {p.name: g.enter(p)[0].participant_id for g, p in ((gateway, ada), (gateway, eva), (tabs, tab))}
        lab.home.clients.revoke_key("ada")
        lab.session.restart()
        (removed,) = lab.session.wait_entries(RemoveParticipant)
        assert removed.message == RemoveParticipant(0, joined["ada"], reason="key revoked")
        assert [one.subject for one in lab.audits(AuditKind.KEY_REVOKED)] == [ada.fingerprint]
        lab.home.clients.revoke_key("other")
        lab.session.restart()
        lab.session.wait_entries(RemoveParticipant, 3)  # the gateway too
        removals = [one.message for one in lab.session.entries if isinstance(one.message, RemoveParticipant)]
        assert {joined["ada"], joined["tab"]} < {one.participant for one in removals}
        assert joined["eva"] not in {one.participant for one in removals}
        assert {one.subject for one in lab.audits(AuditKind.KEY_REVOKED, 2)} == {ada.fingerprint, other.fingerprint}


class TestDisconnected:
    def test_lost_socket_is_reported_at_once_with_grace(self, lab: Lab) -> None:
        gateway, ada, bob = open_gateway(lab), Person(), Person("bob")
        allow(lab, ada)
        allow(lab, bob)
        welcome, _ = gateway.enter(ada)
        gateway.enter(bob)
        gateway.client.send(Disconnected(), on_behalf_of="ada", epoch=0)
        (lost,) = lab.session.wait_entries(Lost)
        assert (lost.connection, lost.message) == (welcome.connection_epoch, Lost("closed"))
        again, join = gateway.enter(ada, resume_token=welcome.resume_token)
        assert join.resume_of == again.participant_id == welcome.participant_id
        assert len(lab.session.wait_entries(Lost)) == 1

    def test_only_of_a_gateway(self, lab: Lab) -> None:
        _, bob = lab.allowed("bob", "operator")
        bob.send(Disconnected())
        assert bob.wait_for(ProtocolFault).code == FaultCode.HELLO
        gateway, ada = open_gateway(lab), Person()
        allow(lab, ada)
        gateway.enter(ada)
        bob.send(Disconnected(), on_behalf_of="ada", epoch=0)
        bob.wait_for(ProtocolFault, 2)
        assert not [e for e in lab.session.entries if isinstance(e.message, Lost)]


def test_vector_of_the_document() -> None:
    identity = hashlib.sha256(bytes(range(32))).digest()
    text = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text()
    assert f"`{identity.hex()}`" in text
    assert f"`{compute_fingerprint(identity)}`" in text
