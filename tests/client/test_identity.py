"""Identity: in memory, or in a file that only its owner may read."""

from __future__ import annotations

import stat
from pathlib import Path

import pytest

from iris_session.client import Identity, IdentityError


def test_every_identity_in_memory_is_another_one() -> None:
    assert Identity.in_memory().secret != Identity.in_memory().secret
    assert len(Identity.in_memory().secret) == 16


def test_file_survives_with_the_newest_token(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "identity.json"
    first = Identity.from_file(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    first.resume_token = b"token"
    again = Identity.from_file(path)
    assert (again.secret, again.resume_token) == (first.secret, b"token")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert [p.name for p in path.parent.iterdir()] == ["identity.json"]


def test_file_readable_by_others_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "identity.json"
    Identity.from_file(path)
    path.chmod(0o644)
    with pytest.raises(IdentityError, match="chmod 600"):
        Identity.from_file(path)


@pytest.mark.parametrize("content", [b"", b"{}", b'{"secret": "AAAA"}', b"\xff"])
def test_damaged_file_says_what_to_do(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "identity.json"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(IdentityError):
        Identity.from_file(path)


def test_unwritable_place_is_a_typed_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(IdentityError, match="cannot be"):
        Identity.from_file(tmp_path / "file" / "identity.json")
