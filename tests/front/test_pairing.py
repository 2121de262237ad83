"""The pairing desk and revocation without sockets: shares of an attacker, a slow disk, words that cross."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from iris_session.front import pairing as pairing_desk
from iris_session.front.audit import AuditTrail
from iris_session.front.connections import ConnectionTable, Peer, Route
from iris_session.front.pairing import BURST, MAX_PENDING, PATIENCE_NS, RETRY_S, PairingService
from iris_session.front.revocation import CHECK_PERIOD_NS, RevocationService
from iris_session.link.config import SECOND, FrontConfig
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Pair
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Paired
from iris_session.security import AllowedKey, JoinCode, KeyHome, KeyPair, KeysError
from iris_session.security.keyring import STRANGER, Keyring, open_keyring
from iris_session.security.resume_tokens import ResumeTokens
from tests.front.slow_disk import slow_disk, turns


class Outbox:
    """Keeps what is sent, by routing id."""

    def __init__(self) -> None:
        self.sent: dict[bytes, list[Any]] = {}

    def send_to_route(self, route: Route, message: object) -> None:
        self.sent.setdefault(route.routing_id, []).append(message)


class Publisher:
    """Stands for the state socket."""

    def use_socket(self, state: object) -> None:
        pass


class Desk:
    """Keyring, desk and revocation of a front, in turns that the test takes. Addresses are made of descriptors."""

    def __init__(self, folder: Path) -> None:
        self.home = KeyHome(folder)
        self.server = self.home.server_key()
        self.drops = Drops()
        self.outbox: Any = Outbox()
        clients = self.home.clients
        self.keyring = Keyring(self.server, self.home, clients.read, lambda: clients.signature, self.drops)
        self.tokens = ResumeTokens(16)
        audit = AuditTrail(lambda _entry: True)
        self.desk = PairingService(self.keyring, self.outbox, audit, self.drops)
        publisher: Any = Publisher()
        self.revocation = RevocationService(
            self.keyring,
            ConnectionTable(),
            self.outbox,
            self.tokens,
            audit,
            publisher,
            lambda _entry: True,
            lambda _connection, _reason: None,
            lambda: publisher,
        )
        self.now_ns = 0

    def asks(self, own: KeyPair, proof: bytes = b"x" * 32, descriptor: int = 1) -> None:
        peer = Peer(descriptor, STRANGER + own.public)
        self.desk.handle_pair(Route(own.public.encode()), peer, Pair("ann", proof), self.now_ns)

    def proof(self, code: str, own: KeyPair) -> bytes:
        secret = pairing.stretch_code(code, self.server.raw_public)
        return pairing.make_client_proof(secret, self.server.raw_public, own.raw_public)

    def turn(self, _now_ns: int = 0) -> None:
        self.now_ns += CHECK_PERIOD_NS
        for service in (self.keyring, self.desk, self.revocation):
            service.tick(self.now_ns)

    def answers(self, own: KeyPair) -> list[Any]:
        return list(self.outbox.sent.get(own.public.encode(), []))

    def answer(self, own: KeyPair) -> Any:
        """The one answer that comes."""
        turns(self.turn, lambda: bool(self.answers(own)))
        (message,) = self.answers(own)
        return message


def _no_descriptor(*_args: object, **_more: object) -> None:
    raise OSError(errno.EMFILE, "Too many open files")


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Desk]:
    monkeypatch.setattr(pairing, "ITERATIONS", 1)
    monkeypatch.setattr(pairing_desk, "peer_of", lambda descriptor: (f"10.0.0.{descriptor}", 5))
    desk = Desk(tmp_path / "home")
    yield desk
    desk.keyring.close()


def test_a_disk_that_takes_its_time_keeps_the_loop_from_nothing(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    own = KeyPair.new()
    code, _ = desk.home.codes.make(desk.server)
    desk.asks(own, desk.proof(code, own))
    with slow_disk(monkeypatch) as disk:
        turns(desk.turn, disk.waits.is_set)
        for _ in range(5):
            desk.turn()
        assert desk.answers(own) == [], "the answer comes after the write"
        assert desk.keyring.find(own.fingerprint) is None
    assert isinstance(desk.answer(own), Paired)
    assert desk.keyring.find(own.fingerprint) is not None
    assert list(desk.home.clients.read()) == [own.fingerprint]


def test_a_director_revokes_at_once_whatever_the_disk_does(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    own = KeyPair.new()
    desk.home.clients.allow("ann", own.public)
    desk.turn()
    with slow_disk(monkeypatch) as disk:
        desk.revocation.revoke(own.fingerprint, desk.now_ns)
        assert desk.tokens.revoked(own.fingerprint)
        turns(desk.turn, disk.waits.is_set)
        desk.asks(own)
        assert desk.answer(own).message == "this key was revoked just now", "not let in again by the way"
        assert own.fingerprint in desk.home.clients.read()
    turns(desk.turn, lambda: own.fingerprint not in desk.keyring.revoking)
    assert desk.home.clients.read() == {}
    assert desk.tokens.revoked(own.fingerprint)


@pytest.mark.parametrize("when", ["waiting", "writing", "written"])
def test_a_directors_word_while_the_key_pairs_counts(desk: Desk, monkeypatch: pytest.MonkeyPatch, when: str) -> None:
    own, first = KeyPair.new(), KeyPair.new()
    code, _ = desk.home.codes.make(desk.server)
    with slow_disk(monkeypatch) as disk:
        if when == "waiting":  # behind the attempt of somebody else
            with monkeypatch.context() as patch:
                patch.setattr(os, "fsync", lambda _: None)
                other, _ = desk.home.codes.make(desk.server)
            desk.asks(first, desk.proof(other, first), descriptor=2)
            turns(desk.turn, disk.waits.is_set)
        desk.asks(own, desk.proof(code, own))
        if when != "waiting":
            turns(desk.turn, disk.waits.is_set)
        if when == "written":
            disk.go_on()
            turns(lambda _: None, lambda: bool(desk.home.clients.read()))
        desk.revocation.revoke(own.fingerprint, desk.now_ns)
    answer = desk.answer(own)
    assert (answer.code, answer.message) == (RefusalCode.CODE, "this key was revoked just now")
    turns(desk.turn, lambda: not desk.keyring.revoking)
    desk.turn()
    assert own.fingerprint not in desk.home.clients.read()
    assert desk.keyring.find(own.fingerprint) is None
    assert desk.tokens.revoked(own.fingerprint)


def test_a_key_that_a_command_takes_off_while_it_pairs_is_off(desk: Desk) -> None:
    own = KeyPair.new()
    code, _ = desk.home.codes.make(desk.server)
    desk.asks(own, desk.proof(code, own))
    desk.turn()
    turns(lambda _: None, lambda: bool(desk.home.clients.read()))  # written, and not told yet
    assert desk.home.clients.revoke("ann") is not None
    desk.keyring.look()
    assert desk.answer(own).message == "this key was revoked just now"
    assert desk.keyring.find(own.fingerprint) is None


def test_a_list_that_could_not_be_read_just_then_is_read_again(
    desk: Desk, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Revoked while the system had no descriptor to spare: it counts as soon as there is one."""
    own = KeyPair.new()
    desk.home.clients.allow("ann", own.public)
    desk.keyring.look()
    desk.home.clients.revoke("ann")
    with monkeypatch.context() as patch:
        patch.setattr(Path, "open", _no_descriptor)
        for _ in range(3):
            desk.keyring.look()
    assert desk.keyring.find(own.fingerprint) is not None
    assert capsys.readouterr().err.count("Too many open files") == 1, "said once"
    desk.keyring.look()
    assert desk.keyring.find(own.fingerprint) is None


def test_who_is_on_the_list_has_paired_though_it_cannot_be_read_just_then(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The code is used up: to be told that one was revoked would be wrong, and of no use."""
    own = KeyPair.new()
    code, _ = desk.home.codes.make(desk.server)

    def unreadable() -> dict[str, AllowedKey]:
        raise KeysError("Too many open files") from OSError(errno.EMFILE, "Too many open files")

    with monkeypatch.context() as patch:
        patch.setattr(desk.keyring, "_read", unreadable)
        desk.asks(own, desk.proof(code, own))
        assert isinstance(desk.answer(own), Paired)
    desk.turn()
    assert desk.keyring.find(own.fingerprint) is not None


def test_who_has_paired_and_did_not_hear_it_is_told_again(desk: Desk) -> None:
    """The answer came too late, or its connection broke: the code is used up, and the key is on the list."""
    own = KeyPair.new()
    code, _ = desk.home.codes.make(desk.server)
    proof = desk.proof(code, own)
    desk.asks(own, proof)
    first = desk.answer(own)
    assert isinstance(first, Paired)
    _, other = desk.home.codes.make(desk.server)
    desk.asks(own, proof)
    assert desk.answers(own) == [first, first], "at once"
    kept = desk.home.codes.find(other.id)
    assert kept is not None
    assert kept.attempts_left == other.attempts_left, "it is no attempt at another code"
    desk.asks(KeyPair.new(), proof, descriptor=2)
    desk.asks(own, b"x" * 32)
    turns(desk.turn, lambda: len(desk.answers(own)) == 3)
    assert desk.answers(own)[2].code == RefusalCode.CODE
    desk.home.clients.revoke(own.fingerprint)
    turns(desk.turn, lambda: desk.keyring.find(own.fingerprint) is None)
    desk.asks(own, proof)
    turns(desk.turn, lambda: len(desk.answers(own)) == 4)
    assert desk.answers(own)[3].code == RefusalCode.CODE, "who was taken off the list needs another code"


def test_a_folder_of_certificates_is_read_again_whatever_time_its_files_are_given(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As by `cp -p` or rsync: a key that is replaced is out at once. A certificate that is damaged is said, once."""
    folder = tmp_path / "clients"
    folder.mkdir()
    first, second = KeyPair.new(), KeyPair.new()
    server = KeyHome(tmp_path / "home")
    server.server_key()
    drops = Drops()
    config = FrontConfig(curve_secret_file=str(server.path / "server.key_secret"), curve_clients_dir=str(folder))
    keyring = open_keyring(config, drops)
    path = folder / "ann.key"

    def write(text: str) -> None:
        path.write_text(text)
        os.utime(path, ns=(0, 0))
        keyring.look()

    write(f'public-key = "{first.public}"')
    assert keyring.find(first.fingerprint) is not None
    write(f'public-key = "{second.public}"')
    assert keyring.find(first.fingerprint) is None
    assert set(keyring.gone) == {first.fingerprint}
    assert keyring.find(second.fingerprint) is not None
    (folder / "bob.key").write_text("nothing")
    for _ in range(3):
        (folder / "other").touch()
        keyring.look()
    said = capsys.readouterr().err
    assert said.count("nobody is let in by bob.key") == 1
    assert "it should be a ZeroMQ certificate" in said
    assert drops.by_reason["certificate_unusable"] == 1
    assert keyring.find(second.fingerprint) is not None
    keyring.close()


def test_a_revoked_key_that_pairs_anew_may_join_though_the_list_looks_the_same(desk: Desk) -> None:
    own = KeyPair.new()
    desk.home.clients.allow("ann", own.public)
    desk.turn()
    desk.revocation.revoke(own.fingerprint, desk.now_ns)
    turns(desk.turn, lambda: not desk.keyring.revoking)
    code, _ = desk.home.codes.make(desk.server)
    desk.asks(own, desk.proof(code, own))
    assert isinstance(desk.answer(own), Paired)
    desk.turn()
    assert not desk.tokens.revoked(own.fingerprint)


def test_who_has_no_attempts_left_takes_nothing_from_others(desk: Desk) -> None:
    eve, ann = KeyPair.new(), KeyPair.new()
    for _ in range(2):
        desk.home.codes.make(desk.server)
        for _ in range(5):
            before = len(desk.answers(eve))
            desk.asks(eve)
            turns(desk.turn, lambda before=before: len(desk.answers(eve)) > before)
    assert [m.message for m in desk.answers(eve)] == ["this join code is wrong, used or expired"] * 10
    code, _ = desk.home.codes.make(desk.server)
    for _ in range(200):
        desk.asks(eve)
    assert desk.drops.by_reason["pair_shut_out"] == 200
    assert len(desk.answers(eve)) < 30, "and few are answered"
    desk.asks(ann, desk.proof(code, ann), descriptor=2)
    assert isinstance(desk.answer(ann), Paired)


def test_one_address_cannot_use_up_what_all_may_ask(desk: Desk) -> None:
    """Not even while there is no code that it could be wrong about."""
    eve, ann = KeyPair.new(), KeyPair.new()
    for _ in range(200):
        desk.asks(eve)
    desk.asks(ann, descriptor=2)
    assert desk.answer(ann).message == "no join code can be used now"
    assert desk.drops.by_reason["pair_rate"] >= 180


def test_attempts_that_wait_are_few_and_do_not_wait_for_ever(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    code, _ = desk.home.codes.make(desk.server)
    first, *others = [KeyPair.new() for _ in range(MAX_PENDING + 3)]
    desk.asks(first, desk.proof(code, first), descriptor=0)
    with slow_disk(monkeypatch) as disk:
        turns(desk.turn, disk.waits.is_set)
        since_ns = desk.now_ns
        for n, own in enumerate(others, 1):
            desk.now_ns = since_ns + max(0, n - BURST) * SECOND // 10  # as fast as all together may ask
            desk.asks(own, descriptor=n)
        assert desk.now_ns - since_ns < PATIENCE_NS
        *waiting, late, last = others
        assert [desk.answer(own).code for own in (late, last)] == [RefusalCode.RATE] * 2
        desk.now_ns += PATIENCE_NS
        desk.turn()
        assert {desk.answer(own).message for own in waiting} == {"the list of keys is busy"}
        assert {desk.answer(own).code for own in waiting} == {RefusalCode.RATE}, "nothing was tried: ask again"
    assert isinstance(desk.answer(first), Paired)


def test_codes_that_could_not_be_read_are_read_again_and_complained_about_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No descriptor is left for a while, and the file does not change meanwhile."""
    desk, now_s, tries = Desk(tmp_path / "home"), 1000.0, 0
    desk.home.codes.make(desk.server)
    with monkeypatch.context() as patch:

        def fails(_server: str) -> tuple[JoinCode, ...]:
            nonlocal tries
            tries += 1
            raise KeysError("Too many open files")

        patch.setattr(desk.home.codes, "of", fails)
        patch.setattr(pairing_desk.time, "monotonic", lambda: now_s)
        for _ in range(3):
            assert not desk.desk.has_open_code
        now_s += RETRY_S
        assert not desk.desk.has_open_code
    assert tries == 2
    assert capsys.readouterr().err.count("Too many open files") == 1
    monkeypatch.setattr(pairing_desk.time, "monotonic", lambda: now_s + RETRY_S)
    assert desk.desk.has_open_code
