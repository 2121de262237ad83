"""`clients.json`: the keys that may join, under which names and in which roles.

An entry has a kind: `curve`, the public key of a client, or `web`, the SHA-256 of the secret of a browser or app behind
a gateway. Neither counts as the other.
"""

from __future__ import annotations

import datetime
from typing import Final

import msgspec

from iris_session.protocol.names import Role
from iris_session.security.curve import compute_fingerprint, decode_key
from iris_session.security.private_folder import (
    LOCK_TIMEOUT_S,
    KeysBusyError,
    KeysError,
    PrivateFolder,
    find_entry_line,
)

FILE: Final = "clients.json"
MAX_KEYS: Final = 1024
#: Default roles of a new key: everything except commanding other participants or speaking for them.
DEFAULT_ROLES: Final = (Role.OPERATOR, Role.OBSERVER, Role.AGENT, Role.LEADER)
#: Kinds of keys.
CURVE: Final = "curve"
WEB: Final = "web"
KINDS: Final = (CURVE, WEB)
MAX_NAME: Final = 64  # as `protocol.common.Name`


class AllowedKey(msgspec.Struct, frozen=True):
    """One allowed key. `key`: public, Z85. `roles`: roles it may join in, empty for any. Times: UTC, ISO 8601.

    `kind`: of `KINDS`; absent in files of earlier versions.
    """

    name: str
    key: str
    roles: tuple[str, ...] = ()
    added: str = ""
    last_seen: str = ""
    kind: str = CURVE

    @property
    def fingerprint(self) -> str:
        return compute_fingerprint(decode_key(self.key))

    def allows(self, role: str) -> bool:
        """Return whether the key may join in a role."""
        return not self.roles or role in self.roles


def format_utc_now() -> str:
    """Return the present time as written in the files (UTC, ISO 8601)."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def validate_roles(roles: tuple[str, ...]) -> tuple[str, ...]:
    """Return `roles` without duplicates. Raises `KeysError` for an unknown one."""
    for role in roles:
        if role not in Role.ALL:
            raise KeysError(f"unknown role {role!r}: {', '.join(sorted(Role.ALL))}")
    return tuple(dict.fromkeys(roles))


class AllowList:
    """Reads and changes the list. Every change is one locked read-modify-write."""

    def __init__(self, folder: PrivateFolder) -> None:
        self._folder = folder

    @property
    def signature(self) -> tuple[int, ...] | None:
        """A value that differs after every change of the file, for polling."""
        return self._folder.signature(FILE)

    def read(self) -> dict[str, AllowedKey]:
        """Return the allowed keys by fingerprint, in the order in which they were added."""
        entries = self._folder.read_json(FILE, list[AllowedKey]) or []
        if len(entries) > MAX_KEYS:
            raise KeysError(f"{self._folder.path / FILE} has {len(entries)} keys, the limit is {MAX_KEYS}: revoke some")
        keys: dict[str, AllowedKey] = {}
        for index, entry in enumerate(entries):
            wrong = _find_fault(entry, keys)
            if wrong:
                text = (self._folder.read(FILE) or b"").decode(errors="replace")
                where = f"{self._folder.path / FILE} is damaged (line {find_entry_line(text, index)}"
                raise KeysError(f"{where}: {wrong}): repair it or move it away")
            keys[entry.fingerprint] = entry
        return keys

    def allow_key(self, name: str, key: str, roles: tuple[str, ...] = (), kind: str = "") -> AllowedKey:
        """Add `key` (Z85) to the list, or rename it and set its roles. Raises `KeysError` for a taken name.

        `kind`: of `KINDS`; empty: as it is listed, `curve` for a new key.
        """
        with self._folder.lock():
            entry, entries = self.plan_entry(name, key, roles, rename=False, kind=kind)
            self.replace_all(entries)
            return entry

    def replace_all(self, entries: list[AllowedKey]) -> None:
        """Write the whole list. The lock must be held."""
        self._folder.write_json(FILE, entries)

    def plan_entry(
        self, name: str, key: str, roles: tuple[str, ...], *, rename: bool, kind: str = ""
    ) -> tuple[AllowedKey, list[AllowedKey]]:
        """Return the entry that `allow_key` would add, and the list with it. Nothing is written.

        `rename`: a taken name gets a number, `ann-2`.
        """
        if not _is_name(name):
            raise KeysError(f"{name!r} is not a valid key name: expected 1 to {MAX_NAME} printable characters")
        entries = self.read()
        mark = compute_fingerprint(decode_key(key))
        names = {entry.name for other, entry in entries.items() if other != mark}
        if name in names:
            if not rename:
                raise KeysError(f"the name {name!r} is taken by another key: revoke that key or choose another name")
            name = _add_number(name, names)
        if mark not in entries and len(entries) >= MAX_KEYS:
            raise KeysError(f"the allow-list is full ({MAX_KEYS} keys): revoke some")
        old = entries.get(mark)
        kind = kind or (old.kind if old else CURVE)
        if old is not None and old.kind != kind:
            raise KeysError(
                f"this key is listed as {old.name!r}, of kind {old.kind}: revoke it before it becomes {kind}"
            )
        added, last_seen = (old.added, old.last_seen) if old else (format_utc_now(), "")
        entry = AllowedKey(name, key, validate_roles(roles), added, last_seen, kind)
        entries[mark] = entry
        return entry, list(entries.values())

    def revoke_key(self, name_or_fingerprint: str, timeout_s: float = LOCK_TIMEOUT_S) -> AllowedKey | None:
        """Remove one key and return it, `None` when it was not listed. Running sessions notice within half a second."""
        with self._folder.lock(timeout_s):
            entries = self.read()
            named = (mark for mark, entry in entries.items() if entry.name == name_or_fingerprint)
            # Fingerprints first: a key may be listed under a name that looks like one.
            mark = name_or_fingerprint if name_or_fingerprint in entries else next(named, "")
            if mark:
                entry = entries.pop(mark)
                self._folder.write_json(FILE, list(entries.values()))
                return entry
        return None

    def record_last_seen(self, utc_by_fingerprint: dict[str, str], timeout_s: float = LOCK_TIMEOUT_S) -> None:
        """Record when keys last joined. Keys that are not listed any more are skipped."""
        with self._folder.lock(timeout_s):
            before, entries = self.signature, self.read()
            noted = {mark: utc for mark, utc in utc_by_fingerprint.items() if mark in entries}
            for mark, utc in noted.items():
                entries[mark] = msgspec.structs.replace(entries[mark], last_seen=utc)
            if self.signature != before:  # an editor holds no lock: what it removed must stay removed
                raise KeysBusyError(f"{self._folder.path / FILE} was edited meanwhile: try again")
            if noted:
                self._folder.write_json(FILE, list(entries.values()), durable=False)


def _find_fault(entry: AllowedKey, others: dict[str, AllowedKey]) -> str:
    """Return why an entry, which may be written by hand, is invalid; empty when it is valid."""
    try:
        mark = entry.fingerprint
        validate_roles(entry.roles)
    except KeysError as error:
        return str(error)
    if entry.kind not in KINDS:
        return f"{entry.kind[:MAX_NAME]!r} is not a kind of key: expected {' or '.join(KINDS)}"
    if not _is_name(entry.name):
        return f"{entry.name[:MAX_NAME]!r} is not a valid key name: expected 1 to {MAX_NAME} printable characters"
    return f"this key is listed as {others[mark].name!r} already" if mark in others else ""


def _is_name(name: str) -> bool:
    return 0 < len(name) <= MAX_NAME and name.isprintable()


def _add_number(name: str, taken: set[str]) -> str:
    numbers = (f"{name[: MAX_NAME - 5]}-{n}" for n in range(2, MAX_KEYS + 2))
    return next(numbered for numbered in numbers if numbered not in taken)
