"""The server's key and the keys that may come in, as the front sees them: read anew whenever their files change."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Final

from iris_session.link.config import FrontConfig, FrontError
from iris_session.protocol.limits import Drops
from iris_session.protocol.names import Role
from iris_session.security import (
    DEFAULT_ROLES,
    AllowedKey,
    KeyHome,
    KeyPair,
    KeysError,
    fingerprint,
    load_public,
    load_secret,
    raw_key,
)
from iris_session.security.allow_list import utc_now
from iris_session.security.file_worker import FileWorker

#: User-Id of a connection whose key is not on the list: this and the key in Z85. Never equal to a fingerprint.
STRANGER: Final = "pair:"


def stranger_key(user_id: str) -> str:
    """The key (Z85) of a connection that may only pair, empty for any other."""
    return user_id.removeprefix(STRANGER) if user_id.startswith(STRANGER) else ""


def roles_behind(roles: tuple[str, ...]) -> tuple[str, ...]:
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
        self._seen = signature()
        self._said: object = None  # what was wrong with the list last
        self._keys = read()
        self.gone: dict[str, AllowedKey] = {}
        self.come: dict[str, AllowedKey] = {}
        self.seen: dict[str, str] = {}
        self.revoking: dict[str, None] = {}
        self.watching: set[str] = set()
        self.files = FileWorker()

    def tick(self, now_ns: int) -> None:
        """Tells those who had files changed."""
        self.files.turn(now_ns)

    def close(self) -> None:
        """What was asked for is still written."""
        self.files.close()

    @property
    def marks(self) -> Collection[str]:
        """Fingerprints of all allowed keys."""
        return self._keys.keys()

    def find(self, mark: str) -> AllowedKey | None:
        """The allowed key with that fingerprint."""
        return self._keys.get(mark)

    def welcomed(self, mark: str) -> None:
        """A key has joined."""
        if self.home is not None and mark in self._keys:
            self.seen[mark] = utc_now()

    def paired(self, mark: str) -> bool:
        """A key was put on the list by the session itself. True: it still is, and may join whatever it was before; also
        where the file cannot be read just now: it is known a moment later."""
        self.look()  # the file decides: somebody may have taken the key off again since
        entry = self._keys.get(mark)
        if entry is not None:
            self.come[mark] = entry
        return entry is not None or self._signature() != self._seen

    def look(self) -> None:
        """Reads the list again if its file has changed. One that is damaged changes nothing, and is said.

        One that the system does not let us read just now (no descriptor free, a network disk) is tried again.
        """
        signature = self._signature()
        if signature == self._seen:
            return
        try:
            keys = self._read()
        except KeysError as error:
            if not isinstance(error.__cause__, OSError):
                self._seen = signature
            if (signature, str(error)) != self._said:
                self._said = signature, str(error)
                self._drops.count("allow_list_unreadable")
                print(f"iris-session: the allow-list stays as it was: {error}", file=sys.stderr, flush=True)
            return
        self._seen, self._said = signature, None
        for mark, old in self._keys.items():
            new = keys.get(mark)
            if new is None or new.roles != old.roles:
                self.gone[mark] = old
        self.come.update((mark, new) for mark, new in keys.items() if mark not in self._keys)
        self._keys = keys


def open_keyring(config: FrontConfig, drops: Drops) -> Keyring:
    """The keyring of a session. Off loopback everything is encrypted. Raises `FrontError`."""
    if not (config.curve or config.curve_secret_file or not config.loopback):
        return Keyring(drops=drops)
    home = KeyHome(config.key_home)
    try:
        key = load_secret(config.curve_secret_file) if config.curve_secret_file else home.server_key()
        if not config.curve_clients_dir:
            return Keyring(key, home, home.clients.read, lambda: home.clients.signature, drops)
        folder = Path(config.curve_clients_dir)
        if not folder.is_dir():
            raise FrontError(f"{folder} is no folder with the public keys (*.key) of the clients that may connect")
        certificates = _Certificates(folder, drops)
        return Keyring(key, None, certificates.read, certificates.signature, drops)
    except KeysError as error:
        raise FrontError(str(error)) from error


class _Certificates:
    """The public keys of a folder. A certificate that is damaged lets nobody in, keeps nobody else out, and is said."""

    def __init__(self, folder: Path, drops: Drops) -> None:
        self._folder = folder
        self._drops = drops
        self._said: dict[str, str] = {}  # what is wrong, by file

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
            keys[fingerprint(raw_key(public))] = AllowedKey(path.stem[:64], public)
        for name, text in wrong.items():
            if self._said.get(name) != text:
                self._drops.count("certificate_unusable")
                print(f"iris-session: nobody is let in by {name}: {text}", file=sys.stderr, flush=True)
        self._said = wrong
        return keys

    def signature(self) -> object:
        """Changes with every file that comes, goes or is written, whatever time it is given."""
        try:
            return tuple(sorted((entry.name, *_identity(entry.stat())) for entry in self._folder.iterdir()))
        except OSError:
            return None


def _identity(status: os.stat_result) -> tuple[int, ...]:
    return status.st_ino, status.st_ctime_ns, status.st_size, status.st_mode
