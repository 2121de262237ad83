"""The keyring follows its file: what a missing, replaced or empty list means."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from iris_session.protocol.limits import Drops
from iris_session.security import AllowedKey, KeyHome, KeyPair
from iris_session.security.keyring import ABSENCE_NS, Keyring, open_keyring


class List:
    """An allow-list of two keys and the keyring of a session, with time by the test."""

    def __init__(self, folder: Path) -> None:
        self.home = KeyHome(folder)
        self.home.load_server_key()
        self.marks = [self.home.clients.allow_key(name, KeyPair.generate().public).fingerprint for name in "ab"]
        self.file = folder / "clients.json"
        self.drops = Drops()
        self.keyring = open_keyring(str(folder), "", "", self.drops)
        self.now_ns = 0

    def pass_time(self, ns: int) -> None:
        for _ in range(10):
            self.now_ns += ns // 10
            self.keyring.tick(self.now_ns)
            self.keyring.reload_if_changed()


@pytest.fixture
def listed(tmp_path: Path) -> Iterator[List]:
    listed = List(tmp_path / "home")
    yield listed
    listed.keyring.close()


def test_list_that_is_missing_for_a_moment_revokes_nobody(listed: List, caplog: pytest.LogCaptureFixture) -> None:
    away = listed.file.rename(listed.file.with_name("clients.json~"))
    listed.pass_time(ABSENCE_NS - 100_000_000)
    assert list(listed.keyring.fingerprints) == listed.marks
    assert listed.keyring.is_missing
    away.rename(listed.file)
    listed.pass_time(10 * ABSENCE_NS)
    assert list(listed.keyring.fingerprints) == listed.marks
    assert not listed.keyring.removed
    assert caplog.text.count("allow-list is missing") == 1
    assert listed.drops.by_reason["allow_list_missing"] == 1


@pytest.mark.parametrize("times", [1, 100])
def test_list_that_is_replaced_while_it_is_read_is_read_again_at_once(listed: List, times: int) -> None:
    """A client that joins meanwhile, with a key that was just listed, would be refused."""
    clients, reads = listed.home.clients, 0

    def read_slowly() -> dict[str, AllowedKey]:
        nonlocal reads
        reads += 1
        found = clients.read()
        if reads <= times:
            clients.record_last_seen({listed.marks[0]: f"2026-01-01T00:00:{reads:02}Z"})
        return found

    keyring = Keyring(listed.keyring.key, listed.home, clients.read, lambda: clients.signature, listed.drops)
    keyring._read = read_slowly
    late = clients.allow_key("late", KeyPair.generate().public).fingerprint
    keyring.reload_if_changed()
    assert (late in keyring.fingerprints) == (times == 1)
    assert reads < 10, "one that always changes holds up nothing"
    keyring.close()


@pytest.mark.parametrize("how", ["stays missing", "is empty"])
def test_list_that_stays_missing_or_is_empty_revokes_all(listed: List, how: str) -> None:
    if how == "is empty":
        listed.file.write_text("[]")
        listed.keyring.reload_if_changed()
    else:
        listed.file.unlink()
        listed.pass_time(2 * ABSENCE_NS)
    assert list(listed.keyring.fingerprints) == []
    assert list(listed.keyring.removed) == listed.marks
    assert not listed.keyring.is_missing


def test_own_processes_join_without_the_list_in_their_roles_only(tmp_path: Path) -> None:
    gateway, camera, other = (KeyPair.generate() for _ in range(3))
    KeyHome(tmp_path / "home").load_server_key()
    keyring = open_keyring(str(tmp_path / "home"), "", "", Drops(), gateway.public, (camera.public,))
    try:
        assert sorted(keyring.fingerprints) == sorted([gateway.fingerprint, camera.fingerprint])
        assert keyring.find_roles(gateway.fingerprint) == ()
        assert keyring.find_roles(camera.fingerprint) == ("camera",)
        assert keyring.find_roles(other.fingerprint) is None
        assert keyring.may_hand_in_media(camera.fingerprint)
        assert keyring.may_be_gateway(gateway.fingerprint)
        assert not keyring.may_be_gateway(camera.fingerprint)
        assert keyring.own_gateway == gateway.fingerprint
    finally:
        keyring.close()
