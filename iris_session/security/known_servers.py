"""`known_servers.json`: keys of servers that this user has paired with or has trusted on first use."""

from __future__ import annotations

from typing import Final

import msgspec

from iris_session.security.allow_list import format_utc_now
from iris_session.security.curve import compute_fingerprint, decode_key
from iris_session.security.private_folder import KeysError, PrivateFolder

FILE: Final = "known_servers.json"
MAX_SERVERS: Final = 1024


class KnownServer(msgspec.Struct, frozen=True):
    """One server. `address`: `HOST:PORT` as it was typed or found. `session`: name of its session when it was stored.
    `key`: public, Z85. `added`: UTC, ISO 8601."""

    address: str
    session: str
    key: str
    fingerprint: str
    added: str = ""


class KnownServers:
    """Reads and changes the list. One address has one key."""

    def __init__(self, folder: PrivateFolder) -> None:
        self._folder = folder

    def read(self) -> list[KnownServer]:
        """Return all servers, oldest first. Raises `KeysError` for a key that does not match its fingerprint."""
        servers = self._folder.read_json(FILE, list[KnownServer]) or []
        for server in servers:
            if compute_fingerprint(decode_key(server.key)) != server.fingerprint:
                path = self._folder.path / FILE
                raise KeysError(f"{path} is damaged: key and fingerprint of {server.address} do not match")
        return servers

    def find_by_address(self, address: str) -> KnownServer | None:
        return next((one for one in self.read() if one.address == address), None)

    def pin(self, address: str, session: str, key: str, *, replace: bool = False) -> KnownServer:
        """Store the key (Z85) of an address. Raises `KeysError` when another one is stored, unless `replace`."""
        new = KnownServer(address, session, key, compute_fingerprint(decode_key(key)), format_utc_now())
        with self._folder.lock():
            servers = self.read()
            old = next((one for one in servers if one.address == address), None)
            if old is not None and old.key != key and not replace:
                raise KeysError(
                    f"{address} has another key ({new.fingerprint}) than the one stored ({old.fingerprint}): "
                    "another server answers there, or its keys were regenerated; "
                    f"if you know that they were, run: iris-session keys forget {address}"
                )
            servers = [one for one in servers if one.address != address]
            self._folder.write_json(FILE, [*servers, new][-MAX_SERVERS:])
        return new

    def remove(self, address: str) -> KnownServer | None:
        """Remove the key of an address and return it, `None` when there was none."""
        with self._folder.lock():
            servers = self.read()
            old = next((one for one in servers if one.address == address), None)
            if old is not None:
                self._folder.write_json(FILE, [one for one in servers if one is not old])
        return old
