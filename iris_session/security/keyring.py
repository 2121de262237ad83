"""The server's key pair and the allowed client keys, reloaded whenever their files change."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Final

from iris_session.protocol.limits import Drops
from iris_session.protocol.names import Role
from iris_session.security import (
    CURVE,
    DEFAULT_ROLES,
    WEB,
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

#: Roles whose keys may hand in media from other machines.
MEDIA_ROLES: Final = frozenset({Role.CAMERA, Role.SOURCE})
#: How long the file of the list may be missing: an editor or a network disk replaces it by another in between.
ABSENCE_NS: Final = 2_000_000_000
#: Attempts to read a list that is replaced meanwhile; the next check tries again.
READS: Final = 4
#: User-Id of a connection whose key is not listed: this prefix and the key in Z85. Never equal to a fingerprint.
PAIRING_PREFIX: Final = "pair:"

_log = logging.getLogger(__name__)


#: Names of the session's own gateway and camera processes.
GATEWAY_NAME: Final = "web gateway"
CAMERA_NAME: Final = "camera process"
#: Roles in which people behind a gateway may join.
_PERSONAL_ROLES: Final = tuple(sorted(Role.ALL - {Role.GATEWAY}))


def parse_pairing_key(user_id: str) -> str:
    """Return the key (Z85) of a connection that may only pair, empty for any other."""
    return user_id.removeprefix(PAIRING_PREFIX) if user_id.startswith(PAIRING_PREFIX) else ""


def select_gateway_roles(roles: tuple[str, ...]) -> tuple[str, ...]:
    """Return the roles that clients of a gateway may join in, given the `roles` of its key (empty: any).

    These are its other roles, or those of a new key when it has no other.
    """
    return tuple(role for role in roles if role != Role.GATEWAY) or (DEFAULT_ROLES if roles else ())


class Keyring:
    """The keys of a session and their changes, all by fingerprint. A `Service` of the front.

    `key`: key pair of the server, `None` on plain loopback. `home`: the key home where unknown keys may pair, else
    `None`. `files`: the worker that makes every change of its files. `own_gateway`: fingerprint of the session's own
    gateway, which may join in any role without being listed; empty for none. `camera_keys`: public keys (Z85) of its
    own camera processes, which may join as cameras without being listed.

    Collected until the front takes them: `removed`, keys that were removed from the list or got other roles; `added`,
    new keys; `last_seen`, UTC at which keys joined. `pending_revocations`: keys that a director revoked and that are
    still in the file. `state_subscribers`: keys admitted to the state socket since it was opened.
    """

    def __init__(
        self,
        key: KeyPair | None = None,
        home: KeyHome | None = None,
        read: Callable[[], dict[str, AllowedKey]] = dict,
        signature: Callable[[], object] = lambda: None,
        drops: Drops | None = None,
        gateway_key: str = "",
        camera_keys: Sequence[str] = (),
    ) -> None:
        gateway = AllowedKey(GATEWAY_NAME, gateway_key) if gateway_key and key is not None else None
        self.own_gateway = "" if gateway is None else gateway.fingerprint
        cameras = [AllowedKey(CAMERA_NAME, one, (Role.CAMERA,)) for one in camera_keys if key is not None]
        self._own = {one.fingerprint: one for one in (gateway, *cameras) if one is not None}
        self.key = key
        self.home = home
        self._read = read
        self._signature = signature
        self._drops = drops or Drops()
        self._read_signature = signature()
        self._reported: object = None  # the fault of the list that was reported last
        self._now_ns = 0
        self._missing_ns: int | None = None  # since when the file is missing
        self._keys = read()
        self.removed: dict[str, AllowedKey] = {}
        self.added: dict[str, AllowedKey] = {}
        self.last_seen: dict[str, str] = {}
        self.pending_revocations: dict[str, None] = {}
        self.state_subscribers: set[str] = set()
        self.files = FileWorker(KeysError)

    def tick(self, now_ns: int) -> None:
        """Report finished changes of files to their callers."""
        self._now_ns = now_ns
        self.files.tick(now_ns)

    def close(self) -> None:
        """Wait for queued changes of files."""
        self.files.close()

    @property
    def is_missing(self) -> bool:
        """True while the file of the list is missing, and its keys still count: nothing may be written now."""
        return bool(self._keys) and self._signature() is None

    @property
    def fingerprints(self) -> Collection[str]:
        """Fingerprints of all allowed CURVE keys."""
        return [*self._own, *(mark for mark, entry in self._keys.items() if entry.kind == CURVE)]

    def find_entry(self, mark: str) -> AllowedKey | None:
        """Return the entry of the list with that fingerprint, of any kind."""
        return self._keys.get(mark)

    def find_key(self, mark: str) -> AllowedKey | None:
        """Return the allowed CURVE key with that fingerprint."""
        own = self._own.get(mark)
        if own is not None:
            return own
        entry = self._keys.get(mark)
        return entry if entry is not None and entry.kind == CURVE else None

    def find_roles(self, key_id: str, gateway: str = "", *, web: bool = False) -> tuple[str, ...] | None:
        """Return the roles that a key may join in, empty for any; `None` if it is not on the list.

        Args:
            key_id: The key, or the hash of the secret that stands for it.
            gateway: Key of the gateway in front of it, empty for none.
            web: Whether `key_id` is a web identity: then the roles are never `gateway`, and empty for none.
        """
        entry, person = self.find_key(gateway or key_id), self._keys.get(key_id)
        if self.key is None:
            return _PERSONAL_ROLES if web else ()
        if entry is None:
            return None
        roles = select_gateway_roles(entry.roles) if gateway else entry.roles
        if not web:
            return roles
        if person is None or person.kind != WEB:
            return None
        return tuple(role for role in _PERSONAL_ROLES if role in (roles or _PERSONAL_ROLES) and person.allows(role))

    def may_be_gateway(self, mark: str) -> bool:
        """Return whether a key is allowed in the role `gateway`: by name, or because it may join in any role."""
        entry = self.find_key(mark)
        return entry is not None and entry.allows(Role.GATEWAY)

    def may_hand_in_media(self, mark: str) -> bool:
        """Return whether a key is allowed in a role whose frames the session takes: `camera`, `source`, or any."""
        entry = self.find_key(mark)
        return entry is not None and (not entry.roles or not MEDIA_ROLES.isdisjoint(entry.roles))

    def record_join(self, mark: str) -> None:
        """Record that a key has joined."""
        if self.home is not None and mark in self._keys:
            self.last_seen[mark] = format_utc_now()

    def confirm_pairing(self, mark: str) -> bool:
        """Return whether a key that the session itself added is still listed, and forget that it was revoked.

        Also True while the file cannot be read: a later reload decides.
        """
        self.reload_if_changed()  # the file decides: the key may have been removed again since
        entry = self._keys.get(mark)
        if entry is not None:
            self.added[mark] = entry
        return entry is not None or self._signature() != self._read_signature

    def reload_if_changed(self) -> None:
        """Reload the list if its file has changed. A damaged file changes nothing and is reported.

        A file that cannot be opened now (no free descriptor, a network disk) is tried again. A missing one is an empty
        list after `ABSENCE_NS`, with a warning before. One that is replaced while it is read is read again at once: a
        key that waits for the answer may be in it.
        """
        for _ in range(READS):
            if self._reload_once():
                return

    def _reload_once(self) -> bool:
        """Reload the list as `reload_if_changed` does; return false if the file was replaced while it was read."""
        signature = self._signature()
        if signature is not None or not self._keys:
            self._missing_ns = None
        elif not self._has_been_missing():
            return True
        if signature == self._read_signature:
            return True
        try:
            keys = self._read()
        except KeysError as error:
            if not isinstance(error.__cause__, OSError):
                self._read_signature = signature
            if (signature, str(error)) != self._reported:
                self._reported = signature, str(error)
                self._drops.count("allow_list_unreadable")
                _log.error("allow-list unchanged: %s", error)
            return True
        if signature != self._signature():
            return False
        self._read_signature, self._reported = signature, None
        for mark, old in self._keys.items():
            new = keys.get(mark)
            if new is None or (new.roles, new.kind) != (old.roles, old.kind):
                self.removed[mark] = old
        self.added.update((mark, new) for mark, new in keys.items() if mark not in self._keys)
        self._keys = keys
        return True

    def _has_been_missing(self) -> bool:
        """Return whether the file has been missing for `ABSENCE_NS`, and report when it begins."""
        if self._missing_ns is None:
            self._missing_ns = self._now_ns
            self._drops.count("allow_list_missing")
            _log.warning(
                "the allow-list is missing: its %d keys are revoked in %g s unless it comes back "
                "(to revoke all keys at once, write an empty list)",
                len(self._keys),
                ABSENCE_NS * 1e-9,
            )
        return self._now_ns - self._missing_ns >= ABSENCE_NS


def open_keyring(
    key_home: str,
    secret_file: str,
    clients_dir: str,
    drops: Drops,
    gateway_key: str = "",
    camera_keys: Sequence[str] = (),
) -> Keyring:
    """Return the keyring of an encrypted session.

    Args:
        key_home: Folder of the server's key and the allow-list; empty for that of the user.
        secret_file: Certificate of the server (`*.key_secret`) instead of the one in the key home, or empty.
        clients_dir: Folder of public certificates (`*.key`) instead of the allow-list, or empty.
        drops: Counts files that cannot be read.
        gateway_key: Public key (Z85) of the session's own gateway, or empty.
        camera_keys: Public keys (Z85) of its own camera processes.

    Raises:
        KeysError: A key or the allow-list cannot be used.
    """
    home = KeyHome(key_home)
    key = load_secret(secret_file) if secret_file else home.load_server_key()
    if not clients_dir:
        return Keyring(key, home, home.clients.read, lambda: home.clients.signature, drops, gateway_key, camera_keys)
    folder = Path(clients_dir)
    if not folder.is_dir():
        raise KeysError(f"{folder} is not a folder: it has to hold the public keys (*.key) of the allowed clients")
    certificates = _CertificateFolder(folder, drops)
    return Keyring(key, None, certificates.read, certificates.signature, drops, gateway_key, camera_keys)


class _CertificateFolder:
    """A folder of public keys. A damaged certificate admits no key, does not affect others, and is reported once."""

    def __init__(self, folder: Path, drops: Drops) -> None:
        self._folder = folder
        self._drops = drops
        self._reported: dict[str, str] = {}  # fault, by file name

    def read(self) -> dict[str, AllowedKey]:
        """Return the key of every `*.key` certificate by fingerprint. Raises `KeysError`."""
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
                _log.error("certificate %s admits no key: %s", name, text)
        self._reported = wrong
        return keys

    def signature(self) -> object:
        """Return a value that differs after every added, removed or written file, with any modification time."""
        try:
            return tuple(sorted((entry.name, *_get_signature(entry.stat())) for entry in self._folder.iterdir()))
        except OSError:
            return None


def _get_signature(status: os.stat_result) -> tuple[int, ...]:
    return status.st_ino, status.st_ctime_ns, status.st_size, status.st_mode
