"""Pairing: put the key of this user on the allow-list of a session by a join code."""

from __future__ import annotations

import getpass
import socket
import time
from collections.abc import Generator
from typing import Final

import zmq

from iris_session.client.address import Address
from iris_session.client.errors import ClientError, NotConnectedError, RefusedError, TrustError
from iris_session.client.sockets import CurveKeys, open_socket
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Pair, wrap_message
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Paired, ProtocolFault, Refused
from iris_session.security import KeyPair, decode_key

#: Time to wait for one answer.
ANSWER_S: Final = 5.0
#: Period and duration of repeating a pairing request: a session answers that many clients pair at once, or not at all
#: while its disk is slow. A client that has paired gets the same answer again.
PAIR_RETRY_S: Final = 1.0
PAIR_PATIENCE_S: Final = 20.0
MAX_NAME: Final = 64  # as `protocol.common.Name`
MAX_ANSWER_BYTES: Final = 65_536


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
