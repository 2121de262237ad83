"""Identity: in memory, or in a file that only its owner can read."""

from __future__ import annotations

import os
import stat
from pathlib import Path

import pytest

from iris_session.client import Identity, IdentityError


def test_file_keeps_the_newest_token(tmp_path: Path) -> None:
    path = tmp_path / "deep" / "identity.json"
    first = Identity.from_file(path)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    first.resume_token = b"token"
    again = Identity.from_file(path)
    assert (again.secret, again.resume_token) == (first.secret, b"token")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert [p.name for p in path.parent.iterdir()] == ["identity.json"]


def test_file_readable_by_others_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "identity.json"
    Identity.from_file(path)
    path.chmod(0o644)
    with pytest.raises(IdentityError, match="chmod 600"):
        Identity.from_file(path)


def test_prepared_file_is_not_used_for_the_secret(tmp_path: Path) -> None:
    """In a folder writable by others: an existing file, or a link to one of theirs."""
    path, theirs = tmp_path / "identity.json", tmp_path / "theirs"
    theirs.write_text("")
    theirs.chmod(0o666)
    for name in (f"{path.name}.{os.getpid()}.tmp", f"{path.name}.tmp"):
        (tmp_path / name).symlink_to(theirs)
    identity = Identity.from_file(path)
    identity.resume_token = b"token"
    assert theirs.read_text() == ""
    assert stat.S_IMODE(path.lstat().st_mode) == 0o600
    assert not path.is_symlink()


def test_file_of_another_user_is_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "identity.json"
    Identity.from_file(path)
    monkeypatch.setattr(os, "geteuid", lambda: path.stat().st_uid + 1)
    with pytest.raises(IdentityError, match="another user"):
        Identity.from_file(path)


@pytest.mark.parametrize("content", [b"", b"{}", b'{"secret": "AAAA"}', b"\xff"])
def test_damaged_file_is_reported_with_advice(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "identity.json"
    path.write_bytes(content)
    path.chmod(0o600)
    with pytest.raises(IdentityError):
        Identity.from_file(path)
