"""The server's key and the keys that may come in, as the front sees them: read anew whenever their files change."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Final

from iris_session.protocol.names import Role
from iris_session.protocol.token_bucket import Drops
from iris_session.security import (
    DEFAULT_ROLES,
    AllowedKey,
    KeyHome,
    KeyPair,
    KeysError,
    compute_fingerprint,
    decode_key,
    load_public,
    load_secret,
)
from iris_session.security.allow_list import format_utc_now
from iris_session.system.file_worker import FileWorker

#: User-Id of a connection whose key is not on the list: this and the key in Z85. Never equal to a fingerprint.
PAIRING_PREFIX: Final = "pair:"


def parse_pairing_key(user_id: str) -> str:
    """The key (Z85) of a connection that may only pair, empty for any other."""
    return user_id.removeprefix(PAIRING_PREFIX) if user_id.startswith(PAIRING_PREFIX) else ""


def select_gateway_roles(roles: tuple[str, ...]) -> tuple[str, ...]:
    """What people may join as behind a gateway whose key has `roles` (empty: any): the others of them; where there is
    no other, what a new key may."""
    return tuple(role for role in roles if role != Role.GATEWAY) or (DEFAULT_ROLES if roles else ())


class Keyring:
    """A `Service`. `key`: the server's, `None` on plain loopback. `home`: where unknown keys may pair, else `None`;
    its files are changed by `files` only.

    Since somebody emptied them: `gone`: keys that were taken off the list, or got other roles; `come`: keys that were
    put on it; `seen`: keys that joined, with the time in UTC. `revoking`: keys that a director revoked and that are
    still in the file. `watching`: keys that were let in to the state socket since it was opened.
    """

    def __init__(
        self,
        key: KeyPair | None = None,
        home: KeyHome | None = None,
        read: Callable[[], dict[str, AllowedKey]] = dict,
        signature: Callable[[], object] = lambda: None,
        drops: Drops | None = None,
    ) -> None:
        self.key = key
        self.home = home
        self._read = read
        self._signature = signature
        self._drops = drops or Drops()
        self._read_signature = signature()
        self._reported: object = None  # what was wrong with the list last
        self._keys = read()
        self.removed: dict[str, AllowedKey] = {}
        self.added: dict[str, AllowedKey] = {}
        self.last_seen: dict[str, str] = {}
        self.pending_revocations: dict[str, None] = {}
        self.state_subscribers: set[str] = set()
        self.files = FileWorker(KeysError)

    def turn(self, now_ns: int) -> None:
        """Tells those who had files changed."""
        self.files.turn(now_ns)

    def close(self) -> None:
        """What was asked for is still written."""
        self.files.close()

    @property
    def fingerprints(self) -> Collection[str]:
        """Fingerprints of all allowed keys."""
        return self._keys.keys()

    def find_key(self, mark: str) -> AllowedKey | None:
        """The allowed key with that fingerprint."""
        return self._keys.get(mark)

    def record_join(self, mark: str) -> None:
        """A key has joined."""
        if self.home is not None and mark in self._keys:
            self.last_seen[mark] = format_utc_now()

    def confirm_pairing(self, mark: str) -> bool:
        """A key was put on the list by the session itself. True: it still is, and may join whatever it was before; also
        where the file cannot be read just now: it is known a moment later."""
        self.reload_if_changed()  # the file decides: somebody may have taken the key off again since
        entry = self._keys.get(mark)
        if entry is not None:
            self.added[mark] = entry
        return entry is not None or self._signature() != self._read_signature

    def reload_if_changed(self) -> None:
        """Reads the list again if its file has changed. One that is damaged changes nothing, and is said.

        One that the system does not let us read just now (no descriptor free, a network disk) is tried again.
        """
        signature = self._signature()
        if signature == self._read_signature:
            return
        try:
            keys = self._read()
        except KeysError as error:
            if not isinstance(error.__cause__, OSError):
                self._read_signature = signature
            if (signature, str(error)) != self._reported:
                self._reported = signature, str(error)
                self._drops.count("allow_list_unreadable")
                print(f"iris-session: the allow-list stays as it was: {error}", file=sys.stderr, flush=True)
            return
        self._read_signature, self._reported = signature, None
        for mark, old in self._keys.items():
            new = keys.get(mark)
            if new is None or new.roles != old.roles:
                self.removed[mark] = old
        self.added.update((mark, new) for mark, new in keys.items() if mark not in self._keys)
        self._keys = keys


def open_keyring(key_home: str, secret_file: str, clients_dir: str, drops: Drops) -> Keyring:
    """Return the keyring of an encrypted session.

    Args:
        key_home: Folder of the server's key and the allow-list; empty for that of the user.
        secret_file: Certificate of the server (`*.key_secret`) instead of the one in the key home, or empty.
        clients_dir: Folder of public certificates (`*.key`) instead of the allow-list, or empty.
        drops: Counts files that cannot be read.

    Raises:
        KeysError: A key or the allow-list cannot be used.
    """
    home = KeyHome(key_home)
    key = load_secret(secret_file) if secret_file else home.load_server_key()
    if not clients_dir:
        return Keyring(key, home, home.clients.read, lambda: home.clients.signature, drops)
    folder = Path(clients_dir)
    if not folder.is_dir():
        raise KeysError(f"{folder} is not a folder: it has to hold the public keys (*.key) of the allowed clients")
    certificates = _CertificateFolder(folder, drops)
    return Keyring(key, None, certificates.read, certificates.signature, drops)


class _CertificateFolder:
    """The public keys of a folder. A certificate that is damaged lets nobody in, keeps nobody else out, and is said."""

    def __init__(self, folder: Path, drops: Drops) -> None:
        self._folder = folder
        self._drops = drops
        self._reported: dict[str, str] = {}  # what is wrong, by file

    def read(self) -> dict[str, AllowedKey]:
        """Every `*.key` certificate by fingerprint. Raises `KeysError`."""
        keys: dict[str, AllowedKey] = {}
        wrong: dict[str, str] = {}
        try:
            paths = sorted(path for path in self._folder.iterdir() if path.suffix == ".key")
        except FileNotFoundError:
            return {}
        except OSError as error:
            raise KeysError(f"{self._folder} cannot be read: {error.strerror}") from error
        for path in paths:
            try:
                public = load_public(path)
            except KeysError as error:
                wrong[path.name] = str(error)
                continue
            keys[compute_fingerprint(decode_key(public))] = AllowedKey(path.stem[:64], public)
        for name, text in wrong.items():
            if self._reported.get(name) != text:
                self._drops.count("certificate_unusable")
                print(f"iris-session: nobody is let in by {name}: {text}", file=sys.stderr, flush=True)
        self._reported = wrong
        return keys

    def signature(self) -> object:
        """Changes with every file that comes, goes or is written, whatever time it is given."""
        try:
            return tuple(sorted((entry.name, *_get_signature(entry.stat())) for entry in self._folder.iterdir()))
        except OSError:
            return None


def _get_signature(status: os.stat_result) -> tuple[int, ...]:
    return status.st_ino, status.st_ctime_ns, status.st_size, status.st_mode
