"""Resolver of a session's endpoint: from an address, a name, a URI or a join code to a host, a port and keys.

    name --beacons--> address --introduction--> key --known?--> (join code: pair, store the key) --> hello

Any machine can send beacons and introductions. A key is trusted because it was given (URI, `CurveKeys`), was stored
before, has proved the join code, or, without any of these, at first sight; then it is stored after the welcome.
`EndpointResolver` takes these steps, `ServerTrust` decides on keys, `pair_key` pairs, and `SessionJoiner` drives a
resolver for a connection and checks which session answers.
"""

from __future__ import annotations

import getpass
import ipaddress
import socket
import time
from collections.abc import Generator
from dataclasses import dataclass
from typing import Final

import zmq

from iris_session.client.address import DEFAULT_CONTROL_PORT, Address
from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.discovery import LISTEN_S, open_listener, request_introduction
from iris_session.client.errors import ClientError, NotConnectedError, RefusedError, SessionNameError, TrustError
from iris_session.client.sockets import ClientSockets, CurveKeys
from iris_session.link.discovery import FoundSession, is_plausible
from iris_session.protocol import pairing
from iris_session.protocol.client_messages import Pair, wrap_message
from iris_session.protocol.codec import decode_server, encode_client
from iris_session.protocol.discovery import Introduction
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Paired, ProtocolFault, Refused, Welcome
from iris_session.security import KeyHome, KeyPair, KeysError, KnownServer, compute_fingerprint, decode_key

LOCAL_ADDRESS: Final = f"127.0.0.1:{DEFAULT_CONTROL_PORT}"
INTRODUCTION_S: Final = 2.5
#: On this machine a reply takes one round of the front's loop.
LOOPBACK_INTRODUCTION_S: Final = 1.0
RETRY_S: Final = 0.2
#: Between two steps of a resolver: it is short-lived, and waits for different things.
STEP_NS: Final = 5_000_000
ANSWER_S: Final = 5.0
#: Period and duration of repeating a pairing request: a session answers that many clients pair at once, or not at all
#: while its disk is slow. A client that has paired gets the same answer again.
PAIR_RETRY_S: Final = 1.0
PAIR_PATIENCE_S: Final = 20.0
MAX_NAME: Final = 64  # as `protocol.common.Name`
MAX_ANSWER_BYTES: Final = 65_536


@dataclass(frozen=True, slots=True)
class ConnectRequest:
    """Session to connect to: `address` (without name), or the name `session`. `join_code`: to pair where needed."""

    address: Address | None
    session: str = ""
    curve: CurveKeys | None = None
    join_code: str = ""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Control channel of a session, and the keys for it.

    `session_id`: from the introduction, empty without one. `store`: the key is trusted at first sight and is stored
    when the session welcomes us.
    """

    address: Address
    curve: CurveKeys | None = None
    session_id: str = ""
    session: str = ""
    store: bool = False

    def store_key(self) -> None:
        """Store the session's key if `store` is set. Raises `TrustError` when another one was stored meanwhile."""
        if self.store and self.curve is not None:
            ServerTrust(KeyHome(), self.address).store(self.session, self.curve.server_public.decode())


def parse_connect_request(address: str, session: str, curve: CurveKeys | None, join_code: str) -> ConnectRequest:
    """Check the arguments of `Client`; without any, the session on this machine. Raises `ClientError`."""
    if address and session:
        raise ClientError("give an address or the name of a session, not both")
    if curve is not None and (session or join_code):
        raise ClientError("curve= names all keys itself: it goes with an address, without name and join code")
    try:
        code = pairing.normalise_code(join_code) if join_code else ""
    except ValueError as error:
        raise ClientError(str(error)) from None
    parsed = None if session else Address.parse(LOCAL_ADDRESS if address == "" else address)
    return ConnectRequest(parsed, session, curve, code)


class EndpointResolver:
    """Resolve a `ConnectRequest` in steps that never wait, until it succeeds or fails for good.

    `note`: what it waits for. `repair`: the session has refused our key as not paired, so pair although its key is
    known.
    """

    def __init__(self, request: ConnectRequest, *, repair: bool = False) -> None:
        self.note = ""
        self._request = request
        self._repair = repair
        self._steps = self._resolve()

    def step(self) -> Endpoint | None:
        """Take one step; `None` while there is no result. Raises `ClientError` when there will be none."""
        try:
            next(self._steps)
        except StopIteration as done:
            endpoint: Endpoint = done.value
            return endpoint
        except KeysError as error:
            raise TrustError(str(error)) from error
        return None

    def close(self) -> None:
        """Stop, and close all sockets."""
        self._steps.close()

    def _resolve(self) -> Generator[None, None, Endpoint]:
        request = self._request
        if request.curve is not None and request.address is not None:
            return Endpoint(request.address, request.curve)
        while True:
            address, found = request.address, None
            if address is None:
                found = yield from self._find_session(request.session)
                address = Address.parse(found.address)
            introduction = yield from self._request_introduction(address)
            endpoint = yield from self._select_keys(address, found, introduction)
            if endpoint is not None:
                return endpoint
            yield from _pause(RETRY_S)

    def _find_session(self, name: str) -> Generator[None, None, FoundSession]:
        """Wait until a session of that name is heard, and long enough to hear others of that name too."""
        with open_listener() as listener:
            heard_at: float | None = None
            while True:
                sessions = listener.poll_sessions()
                named = [one for one in sessions if one.name == name]
                if named and heard_at is None:
                    heard_at = time.monotonic()
                if heard_at is not None and time.monotonic() > heard_at + LISTEN_S / 2:
                    break
                others = ", ".join(f"{one.name} ({one.address})" for one in sessions) or "none"
                self.note = (
                    f"session {name!r} was not heard (heard: {others}); broadcasts may be blocked: type its address"
                )
                yield
        if len(named) > 1:
            where = ", ".join(one.address for one in named)
            raise SessionNameError(f"several sessions are called {name!r}: give the address of one of them ({where})")
        return named[0]

    def _request_introduction(self, address: Address) -> Generator[None, None, Introduction | None]:
        patience_s = LOOPBACK_INTRODUCTION_S if is_loopback(address.host) else INTRODUCTION_S
        try:
            introduction = yield from request_introduction(address.host, address.port, patience_s)
        except ProtocolError as error:
            self.note = f"the introduction at {address} cannot be read: {error}"
            return None
        except OSError as error:
            why = error.strerror or error
            self.note = (
                f"no introduction at {address}, which is on TCP port {address.port - 1}: {why}; "
                "`serve --port-base N` is joined at port N + 1"
            )
            return None
        if introduction.beacon.control != address.port:
            self.note = f"the session below {address} is another one, on port {introduction.beacon.control}"
            return None  # the port is forwarded, or is next to that of another session
        if not is_plausible(introduction.beacon):
            self.note = f"the introduction at {address} is not of a session"
            return None
        return introduction

    def _select_keys(
        self, address: Address, found: FoundSession | None, introduction: Introduction | None
    ) -> Generator[None, None, Endpoint | None]:
        """Select the key, and pair where requested; `None`: there is no decision yet."""
        home, code = KeyHome(), self._request.join_code or address.join_code
        trust = ServerTrust(home, address, found.name if found is not None else "")
        offered = None if introduction is None else introduction.server_key
        key = trust.select_key(offered, loopback=is_loopback(address.host))
        session_id = "" if introduction is None else introduction.beacon.session_id
        name = address.session if introduction is None else introduction.beacon.session_name
        if found is not None and session_id not in ("", found.session_id):
            raise SessionNameError(
                f"what answers at {address} is not the session {found.name!r} heard there: try again"
            )
        if not key:
            return None if key is None else Endpoint(address, None, session_id, name)
        own = home.load_identity()
        if code and (self._repair or not trust.is_known(key)):
            self.note = f"pairing with the session at {address}"
            yield from pair_key(address, key, own, code, default_key_name())
            trust.store(name, key)
        else:
            trust.check_name(key)
        curve = CurveKeys(key.encode(), own.public.encode(), own.secret.encode())
        return Endpoint(address, curve, session_id, name, store=not trust.stored)


def resolve_blocking(request: ConnectRequest, timeout_s: float) -> Endpoint:
    """Resolve a request, waiting.

    Args:
        request: Session to find.
        timeout_s: Seconds to wait at most.

    Returns:
        The endpoint.

    Raises:
        NotConnectedError: It took longer than `timeout_s`.
        ClientError: It cannot be resolved; a subclass says why.
    """
    resolver = EndpointResolver(request)
    until = time.monotonic() + timeout_s
    try:
        while (endpoint := resolver.step()) is None:
            if time.monotonic() > until:
                raise NotConnectedError(f"{resolver.note or 'no answer'} (within {timeout_s:g} s)")
            time.sleep(STEP_NS * 1e-9)
        return endpoint
    finally:
        resolver.close()


def is_loopback(host: str) -> bool:
    """Return whether an address reaches no further than this machine."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _pause(seconds: float) -> Generator[None, None, None]:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        yield


# --- joining a connection ---------------------------------------------------------------------------------------------


class SessionJoiner:
    """Resolve the endpoint of one connection, open it, and check that the session that introduced itself answers.

    `address`: `HOST:PORT`, as soon as it is known.
    """

    def __init__(self, request: ConnectRequest, connection: ClientConnection, sockets: ClientSockets) -> None:
        self.address = str(request.address or f"session {request.session!r}")
        self._request = request
        self._connection = connection
        self._sockets = sockets
        self._resolver: EndpointResolver | None = None
        self._endpoint: Endpoint | None = None  # until a session has welcomed us
        self._note = ""
        self._paired_anew = False

    @property
    def is_resolving(self) -> bool:
        """True while the endpoint is not known yet."""
        return self._resolver is not None

    def begin(self, *, repair: bool = False) -> None:
        """Start to resolve the endpoint."""
        self._connection.phase = ConnectionPhase.IDLE
        self._connection.failure = None
        self._endpoint = None
        self._connection.wake_ns = time.monotonic_ns()  # a loop over several clients must call `step` now
        self._resolver = EndpointResolver(self._request, repair=repair)

    def step(self) -> None:
        """Take one step of the resolver, if there is one; with its result, open the connection."""
        if self._resolver is None:
            return
        self._connection.wake_ns = time.monotonic_ns() + STEP_NS
        try:
            endpoint = self._resolver.step()
        except ClientError as error:
            self.cancel()
            self._fail(error)
            return
        if endpoint is not None:
            self._note = self._resolver.note if not endpoint.session_id else ""
            self.cancel()
            self._endpoint = endpoint
            self.address = str(endpoint.address)
            self._sockets.set_target(endpoint.address.host, endpoint.address.port, endpoint.curve)
            self._connection.open(time.monotonic_ns())

    def cancel(self) -> None:
        """Stop resolving."""
        if self._resolver is not None:
            self._resolver.close()
            self._resolver = None
            self._connection.wake_ns = 0

    def check_answer(self) -> None:
        """Check, after control messages, that the first welcome is from the session that introduced itself."""
        connection, endpoint = self._connection, self._endpoint
        if endpoint is None:
            return
        if connection.is_joined and connection.welcome is not None:
            self._endpoint = None
            self._check_welcome(endpoint, connection.welcome)
        elif self._may_pair():
            self._paired_anew = True  # only once: a key that is revoked again stays revoked
            self.begin(repair=True)
        elif connection.retryable_refusal is not None:
            return  # a session answers: `connection` sends hello again
        elif connection.phase is ConnectionPhase.WAITING and not endpoint.session_id and self._request.curve is None:
            self.begin()  # there was no introduction before: there may be one now

    def describe_failure(self, when: str) -> str:
        """Return a line for users: the address without a welcome, `when`, and the reason as far as it is known."""
        if self._connection.retryable_refusal is not None and self._resolver is None:
            return f"{self.address} {when}: {RefusedError(self._connection.retryable_refusal)}"
        note = self._note if self._resolver is None else self._resolver.note or self._note
        return f"{self.address} {when}: is `iris-session serve` running there?{f' ({note})' if note else ''}"

    def _may_pair(self) -> bool:
        failure = self._connection.failure
        unpaired = isinstance(failure, RefusedError) and failure.code == RefusalCode.UNPAIRED
        given = self._request.address
        return unpaired and not self._paired_anew and bool(self._request.join_code or (given and given.join_code))

    def _check_welcome(self, endpoint: Endpoint, welcome: Welcome) -> None:
        if endpoint.session_id not in ("", welcome.session_id):
            text = (
                f"the session {welcome.session_name!r} welcomed us at {endpoint.address}, "
                "where another introduced itself"
            )
            self._fail(SessionNameError(text))
            return
        try:
            endpoint.store_key()
        except ClientError as error:
            self._fail(error)

    def _fail(self, error: ClientError) -> None:
        self._connection.failure = error
        self._connection.phase = ConnectionPhase.REFUSED


# --- keys of known servers --------------------------------------------------------------------------------------------


class ServerTrust:
    """Keys that this user trusts for the session `session` at `address` (empty: not requested by name).

    Nothing is overwritten silently: a key that differs from the trusted one raises an error that names both.
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
        """Return whether this key is stored, for any address: the machine may have moved, or have several."""
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
        """Raise `TrustError` for a name that is known with another key: any machine can use it in a beacon."""
        named: list[KnownServer] = [one for one in self._known if self._session and one.session == self._session]
        if named and not self.is_known(key):
            raise TrustError(
                f"the session {self._session!r} at {self._address} has another key ({_fingerprint_or_none(key)}) than "
                f"the one known by that name ({named[-1].fingerprint}): pair with it by a join code, or give its "
                "address if you trust it"
            )

    def store(self, session: str, key: str) -> None:
        """Store `key` for the address. Raises `TrustError` when another one is there."""
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
    """Return the fingerprint of every stored key. Raises `TrustError` when the file cannot be read."""
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
    sock: zmq.Socket[bytes] = zmq.Context.instance().socket(zmq.DEALER)
    try:
        sock.linger = 0
        sock.setsockopt(zmq.MAXMSGSIZE, MAX_ANSWER_BYTES)
        sock.setsockopt(zmq.IPV6, int(":" in address.host))
        sock.curve_serverkey = server_key.encode()
        sock.curve_publickey = own.public.encode()
        sock.curve_secretkey = own.secret.encode()
        sock.connect(f"tcp://{address}")
        answer = yield from _request_pairing(sock, encode_client(wrap_message(request)), address)
    finally:
        sock.close()
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
        try:
            return (yield from _receive_answer(sock, address))
        except RefusedError as refused:
            if refused.code != RefusalCode.RATE or time.monotonic() > until:
                raise
        except TimeoutError as silent:
            if time.monotonic() > until:
                raise NotConnectedError(str(silent)) from None
        yield from _pause(PAIR_RETRY_S)


def _receive_answer(sock: zmq.Socket[bytes], address: Address) -> Generator[None, None, Paired]:
    """Raise `TimeoutError` after `ANSWER_S` without a message, and as `pair_key`."""
    until = time.monotonic() + ANSWER_S
    while True:
        try:
            message = decode_server(sock.recv_multipart(zmq.NOBLOCK)[0]).message
        except zmq.Again:
            if time.monotonic() > until:
                raise TimeoutError(f"the session at {address} did not answer within {PAIR_PATIENCE_S:g} s") from None
            yield
            continue
        except ProtocolError as error:
            raise NotConnectedError(f"the answer at {address} is not of a session: {error}") from None
        if isinstance(message, Paired):
            return message
        if isinstance(message, Refused):
            raise RefusedError(message)
        if isinstance(message, ProtocolFault):
            raise RefusedError(Refused(RefusalCode.CODE, message.message))
