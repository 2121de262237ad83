"""Keys of sessions that this user trusts: which key to use for an address, and when it is stored.

Any machine can send beacons and introductions. A key is trusted because it was given (URI, `CurveKeys`), was stored
before, has proved the join code, or, without any of these, at first sight; then it is stored after the welcome.
"""

from __future__ import annotations

from iris_session.client.address import Address
from iris_session.client.errors import TrustError
from iris_session.security import KeyHome, KeysError, KnownServer, compute_fingerprint, decode_key


class ServerTrust:
    """Keys that this user trusts for one session.

    Nothing is overwritten silently: a key that differs from the trusted one raises an error that names both.

    Args:
        home: The user's keys.
        address: Address of the session.
        session: Its name, empty when it was not requested by name.
    """

    def __init__(self, home: KeyHome, address: Address, session: str = "") -> None:
        self._home = home
        self._address = address
        self._session = session
        self._known = home.known_servers.read()

    @property
    def stored(self) -> str:
        """Key (Z85) stored for the address, empty without one."""
        return next((one.key for one in self._known if one.address == str(self._address)), "")

    def is_known(self, key: str) -> bool:
        """Return whether a key (Z85) is stored, for any address: the machine may have moved, or have several."""
        return any(one.key == key for one in self._known)

    def select_key(self, offered: str | None, *, loopback: bool) -> str | None:
        """Return the key to use.

        Args:
            offered: Key (Z85) that the session offers; empty: it does not encrypt; `None`: it did not answer.
            loopback: The session is on this machine.

        Returns:
            The key; empty: without encryption, on loopback only; `None`: nothing is known yet.

        Raises:
            TrustError: The session does not encrypt, or has another key than the trusted one.
        """
        given, stored = self._address.server_key, self.stored
        if given and stored and given != stored:
            raise self._differs(stored, given, "the key in this URI")
        pinned = given or stored
        if offered is None:
            return pinned or ("" if loopback else None)
        if not offered and not loopback:
            raise TrustError(f"the session at {self._address} is not encrypted: over a network it must be")
        if not offered and not given:
            return ""  # on this machine different sessions may use the port, with or without a key
        if pinned and offered != pinned:
            raise self._differs(pinned, offered, "what answers there")
        return offered

    def check_name(self, key: str) -> None:
        """Check the key (Z85) of a session that was requested by name: any machine can use a name in a beacon.

        Raises:
            TrustError: The name is known with another key.
        """
        named: list[KnownServer] = [one for one in self._known if self._session and one.session == self._session]
        if named and not self.is_known(key):
            raise TrustError(
                f"the session {self._session!r} at {self._address} has another key ({_fingerprint_or_none(key)}) than "
                f"the one known by that name ({named[-1].fingerprint}): pair with it by a join code, or give its "
                "address if you trust it"
            )

    def store(self, session: str, key: str) -> None:
        """Store a key for the address.

        Args:
            session: Name of the session.
            key: Its public key (Z85).

        Raises:
            TrustError: Another key is stored for the address.
        """
        try:
            self._home.known_servers.pin(str(self._address), session, key)
        except KeysError as error:
            raise TrustError(str(error)) from error

    def _differs(self, trusted: str, other: str, what: str) -> TrustError:
        return TrustError(
            f"{self._address} is known with the key {_fingerprint_or_none(trusted)}, but {what} has "
            f"{_fingerprint_or_none(other)}: another machine answers there, or its keys were made anew; if you know "
            f"that they were: iris-session keys forget {self._address}"
        )


def _fingerprint_or_none(key: str) -> str:
    return compute_fingerprint(decode_key(key)) if key else "none"


def known_fingerprints() -> frozenset[str]:
    """Return the fingerprint of every stored key.

    Raises:
        TrustError: The file of known servers cannot be read.
    """
    try:
        return frozenset(one.fingerprint for one in KeyHome().known_servers.read())
    except KeysError as error:
        raise TrustError(str(error)) from error
