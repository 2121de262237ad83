"""Files that users edit: certificates and the allow-list."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from iris_session.security import AllowedKey, KeyHome, KeyPair, KeysBusyError, KeysError, load_public, load_secret


@pytest.fixture
def home(tmp_path: Path) -> KeyHome:
    return KeyHome(tmp_path / "home")


def certificate(folder: Path, **lines: str) -> Path:
    """Write a certificate with these lines, readable by its owner only."""
    path = folder / "ann.key_secret"
    path.write_text("curve\n" + "".join(f'    {name}-key = "{key}"\n' for name, key in lines.items()))
    path.chmod(0o600)
    return path


PAIR, OTHER = KeyPair.generate(), KeyPair.generate()


@pytest.mark.parametrize(
    ("lines", "text"),
    [
        ({}, "public-key"),
        ({"secret": PAIR.secret}, "public-key"),
        ({"public": PAIR.public}, "key_secret"),
        ({"public": PAIR.public[:-1], "secret": PAIR.secret}, "39 characters"),
        ({"public": "\N{BULLET}" * 40, "secret": PAIR.secret}, "public key"),
        ({"public": PAIR.public, "secret": PAIR.secret + "x"}, "41 characters"),
        ({"public": PAIR.public, "secret": "~" * 40}, "Z85"),
        ({"public": OTHER.public, "secret": PAIR.secret}, "ann.key_secret"),
    ],
)
def test_unusable_certificate_is_named_with_its_fault(tmp_path: Path, lines: dict[str, str], text: str) -> None:
    path = certificate(tmp_path, **lines)
    with pytest.raises(KeysError) as error:
        load_secret(path)
    assert text in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    assert PAIR.secret[:20] not in str(error.value)


def test_checked_file_is_the_one_that_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A user who can write to the folder must not replace the key by swapping files."""
    private = certificate(tmp_path, public=PAIR.public, secret=PAIR.secret).rename(tmp_path / "private")
    path = certificate(tmp_path, public=OTHER.public, secret=OTHER.secret)
    path.chmod(0o644)
    plain = Path.stat

    def swapped(self: Path, **options: bool) -> os.stat_result:
        if private.name in os.listdir(tmp_path):
            os.replace(private, path)
        return plain(self, **options)

    monkeypatch.setattr(Path, "stat", swapped)
    with pytest.raises(KeysError, match="chmod 600"):
        load_secret(path)


def test_other_lines_of_a_certificate_are_ignored(tmp_path: Path) -> None:
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


def read_complaint(home: KeyHome, path: Path) -> tuple[int, str]:
    """Return the number of the line that the error names, and its text."""
    text = path.read_text()
    with pytest.raises(KeysError) as error:
        home.clients.read()
    assert "\n" not in str(error.value)
    assert path.read_text() == text, "what cannot be read is not replaced"
    found = re.search(r"line (\d+): (.*)\)", str(error.value))
    assert found, error.value
    return int(found[1]), found[2]


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
def test_invalid_entry_is_named_by_its_first_line(
    home: KeyHome, listed: Path, changes: dict[str, object], wrong: str
) -> None:
    rows = json.loads(listed.read_text())
    rows[1].update(changes)
    listed.write_text(json.dumps(rows, indent=2))
    number, text = read_complaint(home, listed)
    assert wrong in text
    braces = [i for i, line in enumerate(listed.read_text().splitlines(), 1) if line.strip() == "{"]
    assert number == braces[1]


def test_session_note_does_not_undo_an_edit(home: KeyHome, listed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Editors do not use the lock."""
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
