"""Pairing: a new key gets onto a session's allow-list, by a join code that both sides prove to know."""

from __future__ import annotations

import getpass
import socket
import time
from collections.abc import Generator
from typing import Final

import zmq

from iris_session.client.address import Address
from iris_session.client.errors import ClientError, NotConnectedError, RefusedError, TrustError
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Pair, envelope
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Paired, ProtocolFault, Refused
from iris_session.security import KeyPair, decode_key

ANSWER_S: Final = 5.0
#: Where many pair at once it says so, where its disk is slow it says nothing for a while: the same is asked again, for
#: so long. Who has paired gets the same answer again.
AGAIN_S: Final = 1.0
LOCK_TIMEOUT_S: Final = 20.0
MAX_NAME: Final = 64  # as `protocol.common.Name`
MAX_ANSWER_BYTES: Final = 65_536


def key_name() -> str:
    """Under which the allow-list shows the key of this user and machine."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):  # no such user in the system's files: containers
        user = "user"
    name = f"{user}@{socket.gethostname()}"
    return "".join(c for c in name if c.isprintable())[:MAX_NAME]


def pair_key(address: Address, server_key: str, own: KeyPair, code: str, name: str) -> Generator[None, None, Paired]:
    """Steps towards the allow-list of the session at `address`, whose key (Z85) is `server_key`; yields where it waits.

    The session must prove that it knows the code: only then its key is that of whom gave the code out. Raises
    `RefusedError` (code wrong, used or expired), `TrustError` (it does not know the code), `NotConnectedError`.
    """
    server_public = decode_key(server_key)
    try:
        secret = pairing.stretch(code, server_public)
    except ValueError as error:
        raise ClientError(str(error)) from None
    request = Pair(name, pairing.client_proof(secret, server_public, own.raw_public), "iris-session")
    asking: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
    try:
        asking.linger = 0
        asking.setsockopt(zmq.MAXMSGSIZE, MAX_ANSWER_BYTES)
        asking.setsockopt(zmq.IPV6, int(":" in address.host))
        asking.curve_serverkey = server_key.encode()
        asking.curve_publickey = own.public.encode()
        asking.curve_secretkey = own.secret.encode()
        asking.connect(f"tcp://{address}")
        answer = yield from _ask(asking, encode_client(envelope(request)), address)
    finally:
        asking.close()
    if not pairing.same(answer.proof, pairing.server_proof(secret, server_public, own.raw_public)):
        raise TrustError(
            f"the session at {address} does not know the join code, so it is not the one that gave it out: "
            "nothing was stored; look at the address and the code"
        )
    return answer


def _ask(asking: zmq.Socket[bytes], request: bytes, address: Address) -> Generator[None, None, Paired]:
    """Asks until there is an answer that stays. Raises as `pair_key`."""
    until = time.monotonic() + LOCK_TIMEOUT_S
    while True:
        asking.send(request)
        try:
            return (yield from _answer(asking, address))
        except RefusedError as refused:
            if refused.code != RefusalCode.RATE or time.monotonic() > until:
                raise
        except TimeoutError as silent:
            if time.monotonic() > until:
                raise NotConnectedError(str(silent)) from None
        again = time.monotonic() + AGAIN_S
        while time.monotonic() < again:
            yield


def _answer(asking: zmq.Socket[bytes], address: Address) -> Generator[None, None, Paired]:
    """Raises `TimeoutError` after a while without a word, and as `pair_key`."""
    until = time.monotonic() + ANSWER_S
    while True:
        try:
            message = decode_server(asking.recv_multipart(zmq.NOBLOCK)[0]).message
        except zmq.Again:
            if time.monotonic() > until:
                raise TimeoutError(f"the session at {address} did not answer within {LOCK_TIMEOUT_S:g} s") from None
            yield
            continue
        except ProtocolError as error:
            raise NotConnectedError(f"what answers at {address} is no session: {error}") from None
        if isinstance(message, Paired):
            return message
        if isinstance(message, Refused):
            raise RefusedError(message)
        if isinstance(message, ProtocolFault):
            raise RefusedError(Refused(RefusalCode.CODE, message.message))
