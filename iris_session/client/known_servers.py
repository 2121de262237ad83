"""Which key of a session is trusted: given, stored before, proved with a join code, or taken at first sight.

Nothing here is overwritten in silence: a key that differs from the trusted one is an error that names both.
"""

from __future__ import annotations

from iris_session.client.address import Address
from iris_session.client.errors import TrustError
from iris_session.security import KeyHome, KeysError, KnownServer, compute_fingerprint, decode_key


class Trust:
    """What this user knows of the session at `address`, called `session` (empty: not asked for by name)."""

    def __init__(self, home: KeyHome, address: Address, session: str = "") -> None:
        self._home = home
        self._address = address
        self._session = session
        self._known = home.known_servers.read()

    @property
    def stored(self) -> str:
        """The key (Z85) stored for the address, empty for none."""
        return next((one.key for one in self._known if one.address == str(self._address)), "")

    def familiar(self, key: str) -> bool:
        """Whether this key is known, by whatever address: the machine has moved, or has several."""
        return any(one.key == key for one in self._known)

    def key(self, offered: str | None, *, loopback: bool) -> str | None:
        """The key to use when the session offers `offered` (empty: it does not encrypt; `None`: it says nothing).

        Empty: without encryption, which is for loopback only. `None`: nothing can be known yet. Raises `TrustError`.
        """
        given, stored = self._address.server_key, self.stored
        if given and stored and given != stored:
            raise self._differs(stored, given, "the key in this URI")
        pinned = given or stored
        if offered is None:
            return pinned or ("" if loopback else None)
        if not offered and not loopback:
            raise TrustError(f"the session at {self._address} is not encrypted: nothing is said to it over a network")
        if not offered and not given:
            return ""  # on this machine the same port may serve with a key today and without tomorrow
        if pinned and offered != pinned:
            raise self._differs(pinned, offered, "what answers there")
        return offered

    def check_name(self, key: str) -> None:
        """A name that is known with another key is not trusted at first sight: anybody can use it in a beacon."""
        named: list[KnownServer] = [one for one in self._known if self._session and one.session == self._session]
        if named and not self.familiar(key):
            raise TrustError(
                f"the session {self._session!r} at {self._address} has another key ({_mark(key)}) than the one known "
                f"by that name ({named[-1].fingerprint}): pair with it by a join code, or give its address if you "
                "trust it"
            )

    def store(self, session: str, key: str) -> None:
        """Keeps `key` for the address. Raises `TrustError` when another one is there."""
        try:
            self._home.known_servers.pin(str(self._address), session, key)
        except KeysError as error:
            raise TrustError(str(error)) from error

    def _differs(self, trusted: str, other: str, what: str) -> TrustError:
        return TrustError(
            f"{self._address} is known with the key {_mark(trusted)}, but {what} has {_mark(other)}: somebody else "
            "answers there, or its keys were made anew; if you know that they were: "
            f"iris-session keys forget {self._address}"
        )


def _mark(key: str) -> str:
    return compute_fingerprint(decode_key(key)) if key else "none"


def known_fingerprints() -> frozenset[str]:
    """Of every session whose key this user has stored. Raises `TrustError` when the file cannot be read."""
    try:
        return frozenset(one.fingerprint for one in KeyHome().known_servers.read())
    except KeysError as error:
        raise TrustError(str(error)) from error
