"""Unknown, allowed, paired and revoked keys."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from zmq.auth import create_certificates

from iris_session.link.config import SECOND
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import EStop, Hello, Marker, Pair, RemoveParticipant
from iris_session.protocol.entries import Audit, Join, Lost
from iris_session.protocol.names import AuditKind, FaultCode, RefusalCode
from iris_session.protocol.server_messages import Paired, ProtocolFault, Refused
from iris_session.protocol.steps import Decision, Dropped
from iris_session.security import KeyPair, load_public, load_secret
from tests.front.harness import FrontSession
from tests.front.lab import Lab, Open


def test_unknown_key_can_only_pair(lab: Lab) -> None:
    eve = KeyPair.generate()
    client = lab.client(eve)
    for n, message in enumerate((Hello("operator", "Eve", secret=b"s" * 16), EStop("Eve"), Marker(1, "x")), 1):
        answer = lab.refused(client, message, n)
        assert answer.code == RefusalCode.UNPAIRED
        assert "iris-session pair" in answer.advice
    assert [type(e.message) for e in lab.session.entries if not isinstance(e.message, Audit)] == []
    audits = lab.audits(AuditKind.KEY_REFUSED, 3)
    assert {(a.subject, a.address) for a in audits} == {(eve.fingerprint, "127.0.0.1")}


def test_code_pairs_one_key_with_the_roles_of_the_code(lab: Lab) -> None:
    ann = KeyPair.generate()
    code, _ = lab.home.join_codes.create(lab.server, roles=("operator", "observer"))
    client = lab.client(ann)
    client.send(Pair("ann", lab.proof(code, ann)))
    answer = client.wait_for(Paired)
    secret = pairing.stretch_code(code, lab.server.raw_public)
    assert answer.proof == pairing.make_server_proof(secret, lab.server.raw_public, ann.raw_public)
    assert answer.roles == ("operator", "observer")
    assert lab.refused(client, Hello("operator", "ann")).code == RefusalCode.UNPAIRED  # still an unknown key's
    lab.client(ann).join(name="ann")
    (entry,) = lab.session.wait_entries(Join)
    assert isinstance(entry.message, Join)
    assert (entry.message.key_id, entry.message.roles) == (ann.fingerprint, ("operator", "observer"))
    (audit,) = lab.audits(AuditKind.PAIRED)
    assert (audit.subject, audit.name, audit.detail) == (ann.fingerprint, "ann", "operator, observer")
    eve = KeyPair.generate()
    assert lab.refused(lab.client(eve), Pair("eve", lab.proof(code, eve))).code == RefusalCode.CODE


def test_wrong_codes_void_the_code_and_are_audited_with_their_count(lab: Lab) -> None:
    eve = KeyPair.generate()
    code, _ = lab.home.join_codes.create(lab.server)
    client = lab.client(eve)
    for n in range(1, 6):
        answer = lab.refused(client, Pair("eve", b"x" * 32), n)
        assert (answer.code, answer.message) == (RefusalCode.CODE, "this join code is wrong, used or expired")
    assert lab.refused(client, Pair("eve", lab.proof(code, eve)), 6).message == "no join code can be used now"
    assert lab.home.clients.read() == {}
    assert len(lab.audits(AuditKind.CODE_EXHAUSTED)) == 1
    refused = lab.audits(AuditKind.CODE_REFUSED, 5)
    assert sum(a.count for a in refused) == 5
    assert len(refused) <= 2, "at most once a second"


def test_unencrypted_sessions_refuse_pairing(session: FrontSession) -> None:
    client = session.client()
    client.send(Pair("ann", b"x" * 32))
    assert client.wait_for(Refused).code == RefusalCode.CODE


def test_revoked_key_is_disconnected_and_others_have_state_within_a_second(lab: Lab) -> None:
    ann, ann_client = lab.allowed("ann")
    bob, bob_client = lab.allowed("bob")
    ann_state, bob_state = (lab.session.subscriber(curve=lab.curve(pair)) for pair in (ann, bob))
    lab.session.send_state(np.zeros((3, 7)))
    lab.session.pump(lambda: ann_state.frames and bob_state.frames, "state for both")
    before, revoked_ns = len(lab.session.entries), lab.session.now_ns
    lab.home.clients.revoke_key("ann")
    assert ann_client.wait_for(ProtocolFault).code == FaultCode.REVOKED
    ann_state.frames.clear()
    bob_state.frames.clear()

    def has_state() -> bool:
        lab.session.send_state(np.zeros((3, 7)))
        return bool(bob_state.frames)

    lab.session.pump(has_state, "state for bob again")
    assert lab.session.now_ns - revoked_ns < SECOND
    assert not ann_state.frames
    (lost,) = lab.session.wait_entries(Lost)
    assert lost.message == Lost("revoked")
    assert lab.session.wait_entries(RemoveParticipant)[0].message == RemoveParticipant(0, "p1", reason="key revoked")
    assert [a.name for a in lab.audits(AuditKind.KEY_REVOKED)] == ["ann"]
    bob_client.send(Marker(1, "still here"))
    lab.session.wait_entries(Marker)
    again = lab.client(ann)
    assert lab.refused(again, Hello("operator", "ann")).code == RefusalCode.UNPAIRED
    commands = [e for e in lab.session.entries[before:] if e.connection == 1 and not isinstance(e.message, Lost)]
    assert commands == []


def test_revoked_connection_is_unknown_until_it_is_closed(lab: Lab) -> None:
    """Its TCP connection was authenticated while the key was valid."""
    _, client = lab.allowed("ann")
    lab.home.clients.revoke_key("ann")
    client.wait_for(ProtocolFault)
    client.send(EStop("ann"))
    for _ in range(3):
        client.send(Hello("operator", "ann"))
    assert client.wait_for(Refused).code == RefusalCode.UNPAIRED
    lab.session.pump(lambda: not client.is_connected, "its TCP connection is closed")
    assert len(lab.session.wait_entries(Join)) == 1
    assert not [e for e in lab.session.entries if isinstance(e.message, EStop)]


def test_removed_role_ends_connections_in_that_role(lab: Lab) -> None:
    pair, client = lab.allowed("ann", "operator", "observer")
    lab.home.clients.allow_key("ann", pair.public, ("observer",))
    (lost,) = lab.session.wait_entries(Lost)
    assert lost.message == Lost("role")
    lab.client(pair).join(role="operator", name="ann")  # the authority refuses it, by what the front tells:
    joins = [e.message for e in lab.session.wait_entries(Join, 2)]
    assert isinstance(joins[-1], Join)
    assert joins[-1].roles == ("observer",)
    assert client.got(ProtocolFault) == []


def test_director_revokes_although_the_list_is_read_only(open_session: Open, tmp_path: Path) -> None:
    """A folder of certificates is not changed; the key is refused by this session."""
    folder = tmp_path / "clients"
    folder.mkdir()
    server_file, _ = create_certificates(tmp_path, "server")
    ann_file, _ = create_certificates(folder, "ann")
    for path in (*tmp_path.glob("*.key_secret"), *folder.glob("*.key_secret")):
        path.chmod(0o600)
    secret = server_file.replace(".key", ".key_secret")
    session = open_session(curve_secret_file=secret, curve_clients_dir=str(folder))
    pair = load_secret(ann_file.replace(".key", ".key_secret"))
    curve = (load_public(server_file).encode(), pair.public.encode(), pair.secret.encode())
    session.client(curve=curve).join(name="ann")
    session.once(Decision((), dropped=(Dropped(1, "revoked", pair.fingerprint),)))
    again = session.client(curve=curve)
    again.send(Hello("operator", "ann"))
    assert again.wait_for(Refused).code == RefusalCode.UNPAIRED
    session.process.restart()  # also a front that replaces this one
    late = session.client(curve=curve)
    late.send(Hello("operator", "ann"))
    assert late.wait_for(Refused).code == RefusalCode.UNPAIRED


def test_list_may_be_edited_during_the_session(lab: Lab) -> None:
    _, ann = lab.allowed("ann")
    _, bob = lab.allowed("bob")
    path = lab.home.path / "clients.json"
    lab.session.pump(lambda: any(key.last_seen for key in lab.home.clients.read().values()), "the session's own note")
    rows = json.loads(path.read_text())
    path.write_text(json.dumps(rows[1:]))  # in place
    assert ann.wait_for(ProtocolFault).code == FaultCode.REVOKED
    new = path.with_name("new")  # as editors do
    new.write_text("[]")
    new.chmod(0o644)
    new.replace(path)
    assert lab.session.wait_drops("allow_list_unreadable") >= 1
    bob.send(Marker(1, "still here"))
    lab.session.wait_entries(Marker)
    path.chmod(0o600)  # as the session said
    assert bob.wait_for(ProtocolFault).code == FaultCode.REVOKED
