"""Files that people touch: certificates that cannot be used, and an allow-list that was edited by hand."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
from zmq.auth import create_certificates

from iris_session.security import (
    AllowedKey,
    KeyHome,
    KeyPair,
    KeysBusyError,
    KeysError,
    load_public,
    load_secret,
)


@pytest.fixture
def home(tmp_path: Path) -> KeyHome:
    return KeyHome(tmp_path / "home")


def certificate(folder: Path, **lines: str) -> Path:
    """A certificate with these lines, for its owner only."""
    path = folder / "ann.key_secret"
    path.write_text("curve\n" + "".join(f'    {name}-key = "{key}"\n' for name, key in lines.items()))
    path.chmod(0o600)
    return path


PAIR, OTHER = KeyPair.generate(), KeyPair.generate()


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        ({}, 'it should be a ZeroMQ certificate with a line public-key = "..."'),
        ({"secret": PAIR.secret}, "it should be a ZeroMQ certificate"),
        ({"public": PAIR.public}, "holds no secret key: give the *.key_secret file"),
        ({"public": PAIR.public[:-1], "secret": PAIR.secret}, "its public key has 39 characters, a CURVE key has 40"),
        ({"public": "\N{BULLET}" * 40, "secret": PAIR.secret}, "its public key is not 40 characters of Z85"),
        ({"public": PAIR.public, "secret": PAIR.secret + "x"}, "has 41 characters, a CURVE key has 40 of Z85"),
        ({"public": PAIR.public, "secret": "~" * 40}, "is not 40 characters of Z85: generate a new pair"),
        ({"public": OTHER.public, "secret": PAIR.secret}, "do not belong together"),
    ],
)
def test_a_certificate_that_cannot_be_used_says_what_would_be_right(
    tmp_path: Path, lines: dict[str, str], text: str
) -> None:
    path = certificate(tmp_path, **lines)
    with pytest.raises(KeysError) as error:
        load_secret(path)
    assert text in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    assert PAIR.secret[:20] not in str(error.value)


def test_a_secret_key_that_others_may_read_is_refused_with_the_remedy(tmp_path: Path) -> None:
    public, secret = create_certificates(tmp_path, "ann")
    Path(secret).chmod(0o640)
    with pytest.raises(KeysError, match=rf"can be used by other users of this machine: chmod 600 {secret}$"):
        load_secret(secret)
    Path(public).chmod(0o644)
    assert load_public(public), "a public key is no secret"
    Path(secret).chmod(0o400)
    assert load_secret(secret).public == load_public(public)


def test_a_key_file_that_cannot_be_read_says_why(tmp_path: Path) -> None:
    with pytest.raises(KeysError, match=r"missing.key cannot be used: No such file or directory$"):
        load_public(tmp_path / "missing.key")
    with pytest.raises(KeysError, match="Is a directory"):
        load_public(tmp_path)


def test_a_key_file_without_permission_names_the_command(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def closed(path: Path, *_mode: object) -> None:
        raise PermissionError(13, "Permission denied", str(path))  # root may read everything, so a file cannot show it

    path = certificate(tmp_path, public=PAIR.public)
    monkeypatch.setattr(Path, "open", closed)
    with pytest.raises(KeysError, match=r"cannot be read: its owner has to run chmod u\+r"):
        load_public(path)


def test_the_file_that_is_checked_is_the_one_that_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever may write to the folder of a key file must not get a key of theirs in by swapping files."""
    private = certificate(tmp_path, public=PAIR.public, secret=PAIR.secret).rename(tmp_path / "private")
    path = certificate(tmp_path, public=OTHER.public, secret=OTHER.secret)
    path.chmod(0o644)
    plain = Path.stat

    def swapped(self: Path, **options: bool) -> os.stat_result:
        if private.name in os.listdir(tmp_path):
            os.replace(private, path)
        return plain(self, **options)

    monkeypatch.setattr(Path, "stat", swapped)
    with pytest.raises(KeysError, match="can be used by other users"):
        load_secret(path)


def test_what_surrounds_the_keys_in_a_certificate_does_not_matter(tmp_path: Path) -> None:
    path = tmp_path / "ann.key"
    path.write_bytes(
        b'#   public-key = "in a comment"\r\nmetadata\r\n    name = "\xff"\r\ncurve\r\n'
        + f"\tpublic-key='{PAIR.public}'\r\n    public-key = \"{OTHER.public}\"\r\n".encode()
    )
    assert load_public(path) == PAIR.public


@pytest.fixture
def listed(home: KeyHome) -> Path:
    """The allow-list of ann, bob and cem."""
    for name in ("ann", "bob", "cem"):
        home.clients.allow_key(name, KeyPair.generate().public, ("operator",))
    return home.path / "clients.json"


def complaint(home: KeyHome, path: Path) -> tuple[int, str]:
    """The line that is named, and what is said of it."""
    text = path.read_text()
    with pytest.raises(KeysError) as error:
        home.clients.read()
    assert "\n" not in str(error.value)
    assert path.read_text() == text, "what cannot be read is not replaced"
    found = re.search(r"line (\d+): (.*)\)", str(error.value))
    assert found, error.value
    return int(found[1]), found[2]


@pytest.mark.parametrize(
    ("typed", "below", "wrong"),
    [
        ('"name": "bob"', 1, "Expecting ',' delimiter"),
        ('"name": "bob", "king",', 0, "Expecting ':' delimiter"),
        ('"name: "bob",', 0, "Expecting ':' delimiter"),
    ],
)
def test_a_line_that_is_no_json_is_named(home: KeyHome, listed: Path, typed: str, below: int, wrong: str) -> None:
    lines = listed.read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if '"name": "bob",' in line)
    lines[at] = typed
    listed.write_text("\n".join(lines))
    assert complaint(home, listed) == (at + 1 + below, wrong)


@pytest.mark.parametrize(
    ("changes", "wrong"),
    [
        ({"name": 7}, "Expected `str`, got `int`"),
        ({"name": ""}, "'' is not a valid key name"),
        ({"name": "a\nb"}, "'a\\nb' is not a valid key name"),
        ({"roles": ["king"]}, "unknown role 'king'"),
        ({"roles": "operator"}, "Expected `array`, got `str`"),
        ({"key": "short"}, "'short' is not a CURVE key"),
    ],
)
def test_an_entry_that_cannot_be_is_named_by_its_first_line(
    home: KeyHome, listed: Path, changes: dict[str, object], wrong: str
) -> None:
    rows = json.loads(listed.read_text())
    rows[1].update(changes)
    listed.write_text(json.dumps(rows, indent=2))
    number, text = complaint(home, listed)
    assert wrong in text
    braces = [i for i, line in enumerate(listed.read_text().splitlines(), 1) if line.strip() == "{"]
    assert number == braces[1]


def test_a_key_that_is_listed_twice_is_said(home: KeyHome, listed: Path) -> None:
    rows = json.loads(listed.read_text())
    listed.write_text(json.dumps([*rows, {**rows[0], "name": "eve"}], indent=2))
    assert complaint(home, listed)[1] == "this key is listed as 'ann' already"


def test_a_note_of_the_session_does_not_undo_an_edit(
    home: KeyHome, listed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An editor knows nothing of our lock."""
    read = home.clients.read
    marks = list(read())

    def edited_meanwhile() -> dict[str, AllowedKey]:
        keys = read()
        listed.write_text("[]")
        return keys

    with monkeypatch.context() as patch:
        patch.setattr(home.clients, "read", edited_meanwhile)
        with pytest.raises(KeysBusyError):
            home.clients.record_last_seen({marks[0]: "2026-01-01T00:00:00+00:00"})
    assert read() == {}


def test_new_permissions_are_a_change(home: KeyHome) -> None:
    """Who has mended them as they were told to must be heard."""
    home.clients.allow_key("ann", PAIR.public)
    path = home.path / "clients.json"
    path.chmod(0o644)
    before = home.clients.signature
    with pytest.raises(KeysError, match="chmod 600"):
        home.clients.read()
    path.chmod(0o600)
    assert home.clients.signature != before


@pytest.mark.parametrize("saved", ["", "[", "[{}, nonsense", "[1" + 5000 * "0" + "]"])
def test_a_file_that_an_editor_saves_while_it_is_read_is_still_only_damaged(
    home: KeyHome, listed: Path, monkeypatch: pytest.MonkeyPatch, saved: str
) -> None:
    """The line is looked for in another file than the one that was wrong."""
    entries = json.loads(listed.read_text())
    listed.write_text(json.dumps([*entries, entries[0]]))
    whole, reads = home.folder.read, iter([listed.read_bytes(), saved.encode()])
    monkeypatch.setattr(home.folder, "read", lambda name: next(reads, None) or whole(name))
    with pytest.raises(KeysError, match="is damaged"):
        home.clients.read()


def test_a_number_of_thousands_of_digits_is_damage(home: KeyHome, listed: Path) -> None:
    listed.write_text('[{"name": 1' + 5000 * "0" + "}]")
    with pytest.raises(KeysError, match="is damaged"):
        home.clients.read()
