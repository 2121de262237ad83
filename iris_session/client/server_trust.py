"""Keys of sessions that this user trusts, and pairing: put the key of this user on a session's allow-list.

Any machine can send beacons and introductions. A key is trusted because it was given (URI, `CurveKeys`), was stored
before, has proved the join code, or, without any of these, at first sight; then it is stored after the welcome.
"""

from __future__ import annotations

import getpass
import socket
import time
from collections.abc import Generator
from typing import Final

import zmq

from iris_session.client.discovery import Address
from iris_session.client.errors import ClientError, NotConnectedError, RefusedError, TrustError
from iris_session.client.sockets import CurveKeys, open_socket
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Pair, wrap_message
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Paired, ProtocolFault, Refused
from iris_session.security import KeyHome, KeyPair, KeysError, KnownServer, compute_fingerprint, decode_key

#: Time to wait for one answer.
ANSWER_S: Final = 5.0
#: Period and duration of repeating a pairing request: a session answers that many clients pair at once, or not at all
#: while its disk is slow. A client that has paired gets the same answer again.
PAIR_RETRY_S: Final = 1.0
PAIR_PATIENCE_S: Final = 20.0
MAX_NAME: Final = 64  # as `protocol.common.Name`
MAX_ANSWER_BYTES: Final = 65_536


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


# --- pairing ----------------------------------------------------------------------------------------------------------


def default_key_name() -> str:
    """Return `USER@HOST`: the name of this user's key on allow-lists."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # in containers the user may be missing in the system's files
        user = "user"
    name = f"{user}@{socket.gethostname()}"
    return "".join(c for c in name if c.isprintable())[:MAX_NAME]


def pair_key(address: Address, server_key: str, own: KeyPair, code: str, name: str) -> Generator[None, None, Paired]:
    """Put a key on the allow-list of a session by a join code that both sides prove to know; yields where it waits.

    Args:
        address: Address of the session.
        server_key: Public key of the session, Z85.
        own: Key pair to be put on the list.
        code: Join code.
        name: Name of our key on the list.

    Returns:
        The session's answer.

    Raises:
        RefusedError: The code is wrong, used or expired.
        TrustError: The session could not prove that it knows the code, so it did not issue it.
        NotConnectedError: No answer.
    """
    server_public = decode_key(server_key)
    try:
        secret = pairing.stretch_code(code, server_public)
    except ValueError as error:
        raise ClientError(str(error)) from None
    request = Pair(name, pairing.make_client_proof(secret, server_public, own.raw_public), "iris-session")
    curve = CurveKeys(server_key.encode(), own.public.encode(), own.secret.encode())
    sock = open_socket(zmq.Context.instance(), zmq.DEALER, address.host, curve)
    try:
        sock.setsockopt(zmq.MAXMSGSIZE, MAX_ANSWER_BYTES)
        sock.connect(f"tcp://{address}")
        answer = yield from _request_pairing(sock, encode_client(wrap_message(request)), address)
    finally:
        sock.close(linger=0)
    if not pairing.is_same_proof(answer.proof, pairing.make_server_proof(secret, server_public, own.raw_public)):
        raise TrustError(
            f"the session at {address} does not know the join code, so it is not the one that gave it out: "
            "nothing was stored; check the address and the code"
        )
    return answer


def _request_pairing(sock: zmq.Socket[bytes], request: bytes, address: Address) -> Generator[None, None, Paired]:
    """Send the request until there is a final answer. Raises as `pair_key`."""
    until = time.monotonic() + PAIR_PATIENCE_S
    while True:
        sock.send(request)
        answer = yield from _receive_answer(sock, address)
        if isinstance(answer, Paired):
            return answer
        is_late = time.monotonic() > until
        if answer is not None and (answer.code != RefusalCode.RATE or is_late):
            raise RefusedError(answer)
        if is_late:
            text = f"the session at {address} did not answer within {PAIR_PATIENCE_S:g} s"
            raise NotConnectedError(text)
        retry_at = time.monotonic() + PAIR_RETRY_S
        while time.monotonic() < retry_at:
            yield


def _receive_answer(sock: zmq.Socket[bytes], address: Address) -> Generator[None, None, Paired | Refused | None]:
    """Return the next answer, `None` after `ANSWER_S` without one. Raises `NotConnectedError` for what is no answer."""
    until = time.monotonic() + ANSWER_S
    while time.monotonic() <= until:
        try:
            message = decode_server(sock.recv_multipart(zmq.NOBLOCK)[0]).message
        except zmq.Again:
            yield
            continue
        except ProtocolError as error:
            raise NotConnectedError(f"the answer at {address} is not of a session: {error}") from None
        if isinstance(message, Paired | Refused):
            return message
        if isinstance(message, ProtocolFault):
            return Refused(RefusalCode.CODE, message.message)
    return None
