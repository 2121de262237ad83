"""Pairing and revocation without sockets: limits of an attacker, a slow disk, and requests that cross."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from iris_session.front import pairing as pairing_service
from iris_session.front.connections import Peer, Route
from iris_session.front.pairing import BURST, MAX_PENDING, PATIENCE_NS, PairingService
from iris_session.front.revocation import CHECK_PERIOD_NS, RevocationService
from iris_session.link.config import SECOND
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Pair
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Paired
from iris_session.security import KeyHome, KeyPair
from iris_session.security.keyring import PAIRING_PREFIX, Keyring
from tests.front.fakes import FakePublisher, make_context
from tests.front.slow_disk import slow_disk, turns


class Outbox:
    """Keeps what is sent, by routing id."""

    def __init__(self) -> None:
        self.sent: dict[bytes, list[Any]] = {}

    def send_to_route(self, route: Route, message: object) -> None:
        self.sent.setdefault(route.routing_id, []).append(message)


class PairingRig:
    """Keyring, pairing and revocation of a front, with ticks by the test. Addresses are made of descriptors."""

    def __init__(self, folder: Path) -> None:
        self.home = KeyHome(folder)
        self.server = self.home.load_server_key()
        self.outbox: Any = Outbox()
        clients = self.home.clients
        self.keyring = Keyring(self.server, self.home, clients.read, lambda: clients.signature)
        publisher: Any = FakePublisher()
        front = make_context(self.outbox, lambda: self.now_ns, keyring=self.keyring, publisher=publisher, max_tokens=16)
        self.tokens, self.drops = front.tokens, front.drops
        self.pairing = PairingService(front)
        disconnects: Any = None  # no key is connected
        self.restart_revocation = lambda: RevocationService(front, disconnects, lambda: publisher)
        self.revocation = self.restart_revocation()
        self.now_ns = 0
        self._jobs = 0  # of the worker of files that are not reported yet
        self._submit, self.keyring.files.submit = self.keyring.files.submit, self._count_job  # type: ignore[method-assign]

    def _count_job(self, job: Callable[[], Any], on_done: Callable[[Any, int], None]) -> bool:
        def finish(outcome: Any, now_ns: int) -> None:
            self._jobs -= 1
            on_done(outcome, now_ns)

        taken = self._submit(job, finish)
        self._jobs += taken
        return taken

    def asks(self, own: KeyPair, proof: bytes = b"x" * 32, descriptor: int = 1) -> None:
        peer = Peer(descriptor, PAIRING_PREFIX + own.public)
        self.pairing.handle_pair(Route(own.public.encode()), peer, Pair("ann", proof), self.now_ns)

    def proof(self, code: str, own: KeyPair) -> bytes:
        secret = pairing.stretch_code(code, self.server.raw_public)
        return pairing.make_client_proof(secret, self.server.raw_public, own.raw_public)

    def turn(self, _now_ns: int = 0) -> None:
        """Let time pass, unless the worker of files is busy: how long that takes is up to the machine."""
        self.now_ns += 0 if self._jobs else CHECK_PERIOD_NS
        for service in (self.keyring, self.pairing, self.revocation):
            service.tick(self.now_ns)

    def answers(self, own: KeyPair) -> list[Any]:
        return list(self.outbox.sent.get(own.public.encode(), []))

    def answer(self, own: KeyPair) -> Any:
        """Wait for the one answer."""
        turns(self.turn, lambda: bool(self.answers(own)))
        (message,) = self.answers(own)
        return message


@pytest.fixture
def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[PairingRig]:
    monkeypatch.setattr(pairing, "ITERATIONS", 1)
    monkeypatch.setattr(pairing_service, "peer_of", lambda descriptor: (f"10.0.0.{descriptor}", 5))
    rig = PairingRig(tmp_path / "home")
    yield rig
    rig.keyring.close()


def test_revocation_by_a_director_does_not_wait_for_the_disk(rig: PairingRig, monkeypatch: pytest.MonkeyPatch) -> None:
    own = KeyPair.generate()
    rig.home.clients.allow_key("ann", own.public)
    rig.turn()
    with slow_disk(monkeypatch) as disk:
        rig.revocation.revoke(own.fingerprint, rig.now_ns)
        assert rig.tokens.is_revoked(own.fingerprint)
        turns(rig.turn, disk.waits.is_set)
        rig.asks(own)
        assert rig.answer(own).message == "this key was revoked just now", "not let in again by the way"
        assert own.fingerprint in rig.home.clients.read()
    turns(rig.turn, lambda: own.fingerprint not in rig.keyring.pending_revocations)
    assert rig.home.clients.read() == {}
    assert rig.tokens.is_revoked(own.fingerprint)


@pytest.mark.parametrize("when", ["waiting", "writing", "written"])
def test_revocation_during_pairing_takes_effect(rig: PairingRig, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    own, first = KeyPair.generate(), KeyPair.generate()
    code, _ = rig.home.join_codes.create(rig.server)
    with slow_disk(monkeypatch) as disk:
        if when == "waiting":  # behind the attempt of somebody else
            with monkeypatch.context() as patch:
                patch.setattr(os, "fsync", lambda _: None)
                other, _ = rig.home.join_codes.create(rig.server)
            rig.asks(first, rig.proof(other, first), descriptor=2)
            turns(rig.turn, disk.waits.is_set)
        rig.asks(own, rig.proof(code, own))
        if when != "waiting":
            turns(rig.turn, disk.waits.is_set)
        if when == "written":
            disk.go_on()
            turns(lambda _: None, lambda: bool(rig.home.clients.read()))
        rig.revocation.revoke(own.fingerprint, rig.now_ns)
    answer = rig.answer(own)
    assert (answer.code, answer.message) == (RefusalCode.CODE, "this key was revoked just now")
    turns(rig.turn, lambda: not rig.keyring.pending_revocations)
    rig.turn()
    assert own.fingerprint not in rig.home.clients.read()
    assert rig.keyring.find_key(own.fingerprint) is None
    assert rig.tokens.is_revoked(own.fingerprint)


def test_lost_pairing_answer_is_sent_again(rig: PairingRig) -> None:
    """The answer was late or its connection broke, while the code is used up and the key allowed."""
    own = KeyPair.generate()
    code, _ = rig.home.join_codes.create(rig.server)
    proof = rig.proof(code, own)
    rig.asks(own, proof)
    first = rig.answer(own)
    assert isinstance(first, Paired)
    _, other = rig.home.join_codes.create(rig.server)
    rig.asks(own, proof)
    assert rig.answers(own) == [first, first], "at once"
    kept = rig.home.join_codes.find_code(other.id)
    assert kept is not None
    assert kept.attempts_left == other.attempts_left, "it is no attempt at another code"
    rig.asks(KeyPair.generate(), proof, descriptor=2)
    rig.asks(own, b"x" * 32)
    turns(rig.turn, lambda: len(rig.answers(own)) == 3)
    assert rig.answers(own)[2].code == RefusalCode.CODE
    rig.home.clients.revoke_key(own.fingerprint)
    turns(rig.turn, lambda: rig.keyring.find_key(own.fingerprint) is None)
    rig.asks(own, proof)
    turns(rig.turn, lambda: len(rig.answers(own)) == 4)
    assert rig.answers(own)[3].code == RefusalCode.CODE, "who was taken off the list needs another code"


def test_pairing_waits_while_the_list_is_missing(rig: PairingRig) -> None:
    """An editor replaces the list: one that is written meanwhile would have the new key alone."""
    ann, bob = KeyPair.generate(), KeyPair.generate()
    rig.home.clients.allow_key("bob", bob.public)
    rig.keyring.reload_if_changed()
    code, _ = rig.home.join_codes.create(rig.server)
    away = (rig.home.path / "clients.json").rename(rig.home.path / "clients.json~")
    rig.asks(ann, rig.proof(code, ann))
    for _ in range(5):
        rig.turn()
    assert rig.answers(ann) == []
    assert not (rig.home.path / "clients.json").exists()
    away.rename(rig.home.path / "clients.json")
    assert isinstance(rig.answer(ann), Paired)
    assert set(rig.home.clients.read()) == {ann.fingerprint, bob.fingerprint}


def test_key_that_a_front_revoked_before_it_was_killed_leaves_the_list(rig: PairingRig) -> None:
    own, bob = KeyPair.generate(), KeyPair.generate()
    rig.home.clients.allow_key("ann", own.public)
    rig.home.clients.allow_key("bob", bob.public)
    rig.turn()
    rig.tokens.revoke_key(own.fingerprint)  # the tokens are what the next front gets
    rig.revocation = rig.restart_revocation()
    turns(rig.turn, lambda: own.fingerprint not in rig.home.clients.read())
    assert bob.fingerprint in rig.home.clients.read()


def test_exhausted_pairing_attempts_do_not_limit_others(rig: PairingRig) -> None:
    eve, ann = KeyPair.generate(), KeyPair.generate()
    for _ in range(2):
        rig.home.join_codes.create(rig.server)
        for _ in range(5):
            before = len(rig.answers(eve))
            rig.asks(eve)
            turns(rig.turn, lambda before=before: len(rig.answers(eve)) > before)
    assert [m.message for m in rig.answers(eve)] == ["this join code is wrong, used or expired"] * 10
    code, _ = rig.home.join_codes.create(rig.server)
    for _ in range(200):
        rig.asks(eve)
    assert rig.drops.by_reason["pair_shut_out"] == 200
    assert len(rig.answers(eve)) < 30, "and few are answered"
    rig.asks(ann, rig.proof(code, ann), descriptor=2)
    assert isinstance(rig.answer(ann), Paired)


def test_pending_attempts_are_bounded_and_time_out(rig: PairingRig, monkeypatch: pytest.MonkeyPatch) -> None:
    code, _ = rig.home.join_codes.create(rig.server)
    first, *others = [KeyPair.generate() for _ in range(MAX_PENDING + 3)]
    rig.asks(first, rig.proof(code, first), descriptor=0)
    with slow_disk(monkeypatch) as disk:
        turns(rig.turn, disk.waits.is_set)
        since_ns = rig.now_ns
        for n, own in enumerate(others, 1):
            rig.now_ns = since_ns + max(0, n - BURST) * SECOND // 10  # as fast as all together may ask
            rig.asks(own, descriptor=n)
        assert rig.now_ns - since_ns < PATIENCE_NS
        *waiting, late, last = others
        assert [rig.answer(own).code for own in (late, last)] == [RefusalCode.RATE] * 2
        rig.now_ns += PATIENCE_NS
        rig.turn()
        assert {rig.answer(own).message for own in waiting} == {"the list of keys is busy"}
        assert {rig.answer(own).code for own in waiting} == {RefusalCode.RATE}, "nothing was tried: ask again"
    assert isinstance(rig.answer(first), Paired)
