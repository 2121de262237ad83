"""The home of keys: permissions, atomic changes of several processes, allow-list, join codes, pinned servers."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import pytest

from iris_session.protocol import pairing
from iris_session.security import AllowedKey, KeyHome, KeyPair, KeysError, RegisteredSession, load_secret


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> KeyHome:
    """A home whose codes are stretched once: what they cost is tested with the protocol."""
    monkeypatch.setattr(pairing, "ITERATIONS", 1)
    return KeyHome(tmp_path / "home")


def mode(path: Path) -> int:
    return path.stat().st_mode & 0o777


def proof_of(code: str, server: KeyPair, client: KeyPair) -> bytes:
    secret = pairing.stretch_code(code, server.raw_public)
    return pairing.make_client_proof(secret, server.raw_public, client.raw_public)


def test_home_is_given_by_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("IRIS_HOME", str(tmp_path / "a"))
    assert KeyHome().path == tmp_path / "a"
    monkeypatch.delenv("IRIS_HOME")
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "b"))
    assert KeyHome().path == tmp_path / "b" / "iris-session"
    monkeypatch.delenv("XDG_CONFIG_HOME")
    monkeypatch.setenv("HOME", str(tmp_path / "c"))
    assert KeyHome().path == tmp_path / "c" / ".config" / "iris-session"
    assert not (tmp_path / "c").exists(), "nothing is made before it is needed"


def test_keys_are_made_once_and_readable_by_their_owner_only(home: KeyHome) -> None:
    old = os.umask(0)
    try:
        server, own = home.load_server_key(), home.load_identity()
        home.clients.allow_key("ann", own.public)
        home.join_codes.create(server)
        home.known_servers.pin("lab:7721", "lab", server.public)
    finally:
        os.umask(old)
    assert (home.load_server_key(), home.load_identity()) == (server, own)
    assert server != own
    assert mode(home.path) == 0o700
    assert {p.name: oct(mode(p)) for p in home.path.iterdir() if mode(p) != 0o600} == {}
    assert server.secret not in repr(server)
    assert load_secret(home.path / "server.key_secret") == server


def test_files_readable_by_others_are_refused_with_the_command(home: KeyHome) -> None:
    home.load_server_key()
    (home.path / "server.key_secret").chmod(0o644)
    with pytest.raises(KeysError, match=r"chmod 600 .*server\.key_secret"):
        home.load_server_key()
    (home.path / "server.key_secret").chmod(0o600)
    home.path.chmod(0o755)
    with pytest.raises(KeysError, match="chmod 700"):
        home.clients.allow_key("ann", home.load_identity().public)


@pytest.mark.parametrize("name", ["clients.json", "join_codes.json", "known_servers.json", "server.key_secret"])
def test_damaged_file_is_an_error_and_never_replaced(home: KeyHome, name: str) -> None:
    own = home.load_identity()
    path = home.path / name
    path.write_text("[{half")
    path.chmod(0o600)
    use = {
        "clients.json": lambda: home.clients.allow_key("ann", own.public),
        "join_codes.json": lambda: home.join_codes.create(own),
        "known_servers.json": lambda: home.known_servers.pin("a:1", "a", own.public),
        "server.key_secret": home.load_server_key,
    }[name]
    with pytest.raises(KeysError) as error:
        use()
    assert name in str(error.value)
    assert "\n" not in str(error.value)
    assert path.read_text() == "[{half"


def test_name_belongs_to_one_key(home: KeyHome) -> None:
    ann, eve = KeyPair.generate(), KeyPair.generate()
    home.clients.allow_key("ann", ann.public, ("operator",))
    with pytest.raises(KeysError, match="'ann'"):
        home.clients.allow_key("ann", eve.public)
    first = home.clients.read()[ann.fingerprint]
    home.clients.allow_key("anna", ann.public, ("observer", "observer"))
    assert home.clients.read() == {
        ann.fingerprint: msgspec.structs.replace(first, name="anna", roles=("observer",)),
    }
    with pytest.raises(KeysError, match="'king'"):
        home.clients.allow_key("eve", eve.public, ("king",))
    for key in ("short", "x" * 40 + "y", "\u00e9" * 40, "#" * 40):
        with pytest.raises(KeysError, match="CURVE key"):
            home.clients.allow_key("eve", key)


def test_revoking_by_name_or_fingerprint(home: KeyHome) -> None:
    ann, bob = KeyPair.generate(), KeyPair.generate()
    home.clients.allow_key("ann", ann.public)
    home.clients.allow_key("bob", bob.public)
    home.clients.record_last_seen({ann.fingerprint: "2026-01-01T00:00:00+00:00", "nobody": "x"})
    gone = home.clients.revoke_key("ann")
    assert gone is not None
    assert gone.last_seen == "2026-01-01T00:00:00+00:00"
    assert home.clients.revoke_key("ann") is None
    assert home.clients.revoke_key(bob.fingerprint) is not None
    assert home.clients.read() == {}


def test_name_like_a_fingerprint_does_not_prevent_revocation(home: KeyHome) -> None:
    eve, bob = KeyPair.generate(), KeyPair.generate()
    home.clients.allow_key(bob.fingerprint, eve.public)
    home.clients.allow_key("bob", bob.public)
    gone = home.clients.revoke_key(bob.fingerprint)
    assert gone is not None
    assert gone.name == "bob"
    assert list(home.clients.read()) == [eve.fingerprint]


def test_code_is_valid_for_one_key_and_not_stored_in_clear(home: KeyHome) -> None:
    server, ann, eve = home.load_server_key(), KeyPair.generate(), KeyPair.generate()
    code, made = home.join_codes.create(server, roles=("observer",))
    text = (home.path / "join_codes.json").read_text()
    assert code not in text
    assert code.replace("-", "") not in text
    assert [one.is_open(time.time()) for one in home.join_codes.list_for_server(server.fingerprint)] == [True]
    assert home.join_codes.list_for_server(eve.fingerprint) == ()
    good = home.join_codes.redeem(
        server.raw_public, ann.public, proof_of(code.lower(), server, ann), "ann", home.clients
    )
    assert good.entry is not None
    assert (good.entry.name, good.entry.roles, good.entry.key) == ("ann", ("observer",), ann.public)
    secret = pairing.stretch_code(code, server.raw_public)
    assert good.answer == pairing.make_server_proof(secret, server.raw_public, ann.raw_public)
    again = home.join_codes.redeem(server.raw_public, eve.public, proof_of(code, server, eve), "eve", home.clients)
    assert again.entry is None
    kept = home.join_codes.find_code(made.id)
    assert kept is not None
    assert (kept.secret, kept.paired) == (b"", good.entry)
    assert list(home.clients.read()) == [ann.fingerprint]


def test_proof_is_bound_to_one_key(home: KeyHome) -> None:
    """A man in the middle with own keys cannot use a proof."""
    server, middle, ann, eve = home.load_server_key(), KeyPair.generate(), KeyPair.generate(), KeyPair.generate()
    code, _ = home.join_codes.create(server)
    for stolen in (proof_of(code, server, ann), proof_of(code, middle, eve)):
        attempt = home.join_codes.redeem(server.raw_public, eve.public, stolen, "eve", home.clients)
        assert attempt.entry is None
    assert home.clients.read() == {}


def test_code_is_used_up_before_its_key_is_allowed(home: KeyHome, monkeypatch: pytest.MonkeyPatch) -> None:
    """A power cut between the two writes must not leave a code that allows a second key."""
    server, ann = home.load_server_key(), KeyPair.generate()
    code, made = home.join_codes.create(server)
    proof = proof_of(code, server, ann)

    def power_cut(_entries: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(home.clients, "replace_all", power_cut)
        with pytest.raises(KeyboardInterrupt):
            home.join_codes.redeem(server.raw_public, ann.public, proof, "ann", home.clients)
    assert home.clients.read() == {}
    assert home.join_codes.redeem(server.raw_public, ann.public, proof, "ann", home.clients).entry is None

    def full_disk(_entries: object) -> None:
        raise KeysError("clients.json cannot be written: No space left on device")

    code, made = home.join_codes.create(server)
    with monkeypatch.context() as patch:
        patch.setattr(home.clients, "replace_all", full_disk)
        with pytest.raises(KeysError, match="No space left"):
            home.join_codes.redeem(server.raw_public, ann.public, proof_of(code, server, ann), "ann", home.clients)
    kept = home.join_codes.find_code(made.id)
    assert kept is not None
    assert (kept.secret, kept.paired) == (b"", None), "nobody is said to have paired"


def test_two_codes_and_three_devices_at_once(home: KeyHome) -> None:
    """Two commands `pair` run at once, and three devices use their codes: all but the third are allowed."""
    server = home.load_server_key()
    with ThreadPoolExecutor(3) as pool:
        (code, _), (other, _) = pool.map(
            lambda role: home.join_codes.create(server, roles=(role,)), ("operator", "observer")
        )
        people = {"ann": code, "bob": other, "eve": code}

        def pairs(name: str) -> AllowedKey | None:
            own = KeyPair.generate()
            proof = proof_of(people[name], server, own)
            return home.join_codes.redeem(server.raw_public, own.public, proof, name, home.clients).entry

        entries = dict(zip(people, pool.map(pairs, people), strict=True))
    assert {entry.name: entry.roles for entry in entries.values() if entry} in (
        {"ann": ("operator",), "bob": ("observer",)},
        {"eve": ("operator",), "bob": ("observer",)},
    )
    assert len(home.clients.read()) == 2


def test_five_wrong_attempts_void_every_open_code(home: KeyHome) -> None:
    server, ann = home.load_server_key(), KeyPair.generate()
    codes = [home.join_codes.create(server)[0] for _ in range(2)]
    exhausted = [
        home.join_codes.redeem(server.raw_public, ann.public, b"x" * 32, "ann", home.clients).exhausted
        for _ in range(5)
    ]
    assert exhausted == [0, 0, 0, 0, 2]
    for code in codes:
        late = home.join_codes.redeem(server.raw_public, ann.public, proof_of(code, server, ann), "ann", home.clients)
        assert late.entry is None
    assert [one.secret for one in home.join_codes.read()] == [b"", b""]


def test_expired_code_allows_no_key(home: KeyHome) -> None:
    server, ann = home.load_server_key(), KeyPair.generate()
    code, made = home.join_codes.create(server, minutes=0.0005)
    while time.time() < made.expires:
        time.sleep(0.005)
    late = home.join_codes.redeem(server.raw_public, ann.public, proof_of(code, server, ann), "ann", home.clients)
    assert (late.entry, late.open_codes) == (None, 0)
    home.join_codes.create(server)
    kept = home.join_codes.find_code(made.id)
    assert kept is not None
    assert kept.secret == b"", "what has expired keeps no secret"


def test_clock_set_back_does_not_renew_a_code(home: KeyHome, monkeypatch: pytest.MonkeyPatch) -> None:
    """A laptop without a network sets its clock when it gets one: hours back, after the code was shown."""
    server, ann = home.load_server_key(), KeyPair.generate()
    made_s = time.time()
    code, made = home.join_codes.create(server, minutes=10.0)
    proof = proof_of(code, server, ann)
    for after_s, is_open in ((-7200.0, False), (-30.0, True), (0.0, True), (599.0, True), (601.0, False)):
        assert made.is_open(made_s + after_s) is is_open, after_s
    monkeypatch.setattr("iris_session.security.join_codes.time.time", lambda: made_s - 7200.0)
    assert home.join_codes.redeem(server.raw_public, ann.public, proof, "ann", home.clients).entry is None
    monkeypatch.setattr("iris_session.security.join_codes.time.time", lambda: made_s + 60.0)
    assert home.join_codes.redeem(server.raw_public, ann.public, proof, "ann", home.clients).entry is not None


def test_replaced_file_is_durable_after_a_power_cut(home: KeyHome, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder must be synced, too, for a new file to be durable under its name."""
    synced: list[bool] = []
    plain = os.fsync

    def fsync(descriptor: int) -> None:
        synced.append(stat.S_ISDIR(os.fstat(descriptor).st_mode))
        plain(descriptor)

    monkeypatch.setattr(os, "fsync", fsync)
    home.clients.allow_key("ann", KeyPair.generate().public)
    assert synced == [False, True]


def test_cancelled_code_is_void(home: KeyHome) -> None:
    server, ann = home.load_server_key(), KeyPair.generate()
    code, made = home.join_codes.create(server)
    home.join_codes.cancel(made.id)
    late = home.join_codes.redeem(server.raw_public, ann.public, proof_of(code, server, ann), "ann", home.clients)
    assert (late.entry, home.join_codes.find_code(made.id)) == (None, None)


def test_codes_are_bounded(home: KeyHome) -> None:
    server = home.load_server_key()
    for _ in range(32):
        home.join_codes.create(server)
    with pytest.raises(KeysError, match="32 join codes"):
        home.join_codes.create(server)


def test_changed_server_key_is_an_error(home: KeyHome) -> None:
    old, new = KeyPair.generate(), KeyPair.generate()
    home.known_servers.pin("lab:7721", "lab", old.public)
    home.known_servers.pin("lab:7721", "lab-2", old.public)
    with pytest.raises(KeysError, match=rf"{new.fingerprint}.*lab:7721"):
        home.known_servers.pin("lab:7721", "lab", new.public)
    known = home.known_servers.find_by_address("lab:7721")
    assert known is not None
    assert (known.key, known.session) == (old.public, "lab-2")
    assert home.known_servers.remove("lab:7721") == known
    assert home.known_servers.remove("lab:7721") is None
    home.known_servers.pin("lab:7721", "lab", new.public)
    assert [one.key for one in home.known_servers.read()] == [new.public]


def test_concurrent_processes_keep_each_others_changes(home: KeyHome) -> None:
    """Three processes at once, each with its own keys: all are on the list in the end."""
    script = (
        "import sys\nfrom iris_session.security import KeyHome, KeyPair\nhome = KeyHome(sys.argv[1])\n"
        "for i in range(10):\n    home.clients.allow_key(f'{sys.argv[2]}-{i}', KeyPair.generate().public)\n"
        "print(home.load_server_key().public)\n"
    )
    workers = [
        subprocess.Popen([sys.executable, "-c", script, str(home.path), str(i)], stdout=subprocess.PIPE, text=True)
        for i in range(3)
    ]
    keys = {worker.communicate(timeout=60)[0] for worker in workers}
    assert [worker.returncode for worker in workers] == [0, 0, 0]
    assert len(home.clients.read()) == 30
    assert len(keys) == 1, "the server key was made once"


def test_notes_of_ended_sessions_are_ignored(home: KeyHome) -> None:
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    home.sessions.add(RegisteredSession("a", "old", gone.pid, ("10.0.0.1",), 7721, "key"))
    home.sessions.add(RegisteredSession("b", "now", os.getpid(), ("10.0.0.1",), 7731, "key"))
    assert [note.name for note in home.sessions.read()] == ["now"]
    home.sessions.remove("b", 1)
    assert len(home.sessions.read()) == 1, "another process has taken the session over"
    home.sessions.remove("b", os.getpid())
    assert home.sessions.read() == []
