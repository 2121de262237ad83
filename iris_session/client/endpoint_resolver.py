"""Resolver of a session's endpoint: from an address, a name, a URI or a join code to a host, a port and keys.

    name --beacons--> address --introduction--> key --known?--> (join code: pair, store the key) --> hello

`EndpointResolver` takes these steps: `server_trust` decides on keys and pairs. `SessionJoiner` drives a
resolver for a connection and checks which session answers.
"""

from __future__ import annotations

import time
from collections.abc import Generator
from dataclasses import dataclass
from typing import Final

from iris_session.client.core.connection import ClientConnection
from iris_session.client.core.status import ConnectionPhase
from iris_session.client.discovery import DEFAULT_CONTROL_PORT, LISTEN_S, Address, open_listener, request_introduction
from iris_session.client.errors import ClientError, NotConnectedError, RefusedError, SessionNameError, TrustError
from iris_session.client.server_trust import ServerTrust, default_key_name, pair_key
from iris_session.client.sockets import ClientSockets, CurveKeys
from iris_session.link.config import is_loopback
from iris_session.link.discovery import FoundSession, is_plausible
from iris_session.protocol import pairing
from iris_session.protocol.discovery import Introduction
from iris_session.protocol.errors import ProtocolError
from iris_session.protocol.names import RefusalCode
from iris_session.protocol.server_messages import Welcome
from iris_session.security import KeyHome, KeysError

LOCAL_ADDRESS: Final = f"127.0.0.1:{DEFAULT_CONTROL_PORT}"
INTRODUCTION_S: Final = 2.5
#: On this machine a reply takes one round of the front's loop.
LOOPBACK_INTRODUCTION_S: Final = 1.0
RETRY_S: Final = 0.2
#: Between two steps of a resolver: it is short-lived, and waits for different things.
STEP_NS: Final = 5_000_000


@dataclass(frozen=True, slots=True)
class ConnectRequest:
    """Session to connect to: `address` (without name), or the name `session`.

    Attributes:
        address: Control channel, `None` to find the session by name.
        session: Name of the session, empty with an address.
        curve: All keys, or `None` to select them.
        join_code: Code to pair with where needed, as given or as in the URI; empty without one.
    """

    address: Address | None
    session: str = ""
    curve: CurveKeys | None = None
    join_code: str = ""


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Control channel of a session, and the keys for it.

    Attributes:
        address: Control channel.
        curve: Keys, `None` without encryption.
        session_id: Id of the session that introduced itself, empty without an introduction.
        session: Its name, empty where it is not known.
        store: True if the key is trusted at first sight and is to be stored when the session welcomes us.
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
    """Check the arguments of `Client`.

    Args:
        address: Address or URI; empty without `session`: the session on this machine.
        session: Name of a session.
        curve: All keys.
        join_code: Code as typed.

    Returns:
        The request.

    Raises:
        ClientError: An argument is invalid, or contradicts another.
    """
    if address and session:
        raise ClientError("give an address or the name of a session, not both")
    if curve is not None and (session or join_code):
        raise ClientError("curve= names all keys itself: it goes with an address, without name and join code")
    try:
        code = pairing.normalise_code(join_code) if join_code else ""
    except ValueError as error:
        raise ClientError(str(error)) from None
    parsed = None if session else Address.parse(LOCAL_ADDRESS if address == "" else address)
    return ConnectRequest(parsed, session, curve, code or ("" if parsed is None else parsed.join_code))


class EndpointResolver:
    """Resolve a `ConnectRequest` in steps that never wait, until it succeeds or fails for good.

    Args:
        request: Session to find.
        force_pairing: Pair although the session's key is known: the session has refused our key as not paired.

    Attributes:
        note: What it waits for, in words.
    """

    def __init__(self, request: ConnectRequest, *, force_pairing: bool = False) -> None:
        self.note = ""
        self._request = request
        self._force_pairing = force_pairing
        self._steps = self._resolve()

    def step(self) -> Endpoint | None:
        """Take one step.

        Returns:
            The endpoint, `None` while there is no result.

        Raises:
            ClientError: There will be no result; a subclass says why.
        """
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
        home, code = KeyHome(), self._request.join_code
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
        if code and (self._force_pairing or not trust.is_known(key)):
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


def _pause(seconds: float) -> Generator[None, None, None]:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        yield


# --- joining a connection ---------------------------------------------------------------------------------------------


class SessionJoiner:
    """Resolve the endpoint of one connection, open it, and check that the session that introduced itself answers.

    Attributes:
        address: `HOST:PORT`, as soon as it is known; before, the name of the session.
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

    def begin(self, *, force_pairing: bool = False) -> None:
        """Start to resolve the endpoint; see `EndpointResolver`."""
        self._connection.phase = ConnectionPhase.IDLE
        self._connection.failure = None
        self._endpoint = None
        self._connection.wake_ns = time.monotonic_ns()  # a loop over several clients must call `step` now
        self._resolver = EndpointResolver(self._request, force_pairing=force_pairing)

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
            self.begin(force_pairing=True)
        elif connection.retryable_refusal is not None:
            return  # a session answers: `connection` sends hello again
        elif connection.phase is ConnectionPhase.WAITING and not endpoint.session_id and self._request.curve is None:
            self.begin()  # there was no introduction before: there may be one now

    def describe_failure(self, when: str) -> str:
        """Return a line for users: the address without a welcome, `when`, and the reason as far as it is known."""
        if self._connection.retryable_refusal is not None and self._resolver is None:
            return f"{self.address} {when}: {RefusedError(self._connection.retryable_refusal)}"
        note = self._note if self._resolver is None else self._resolver.note or self._note
        question = "is `iris-session serve`, or `session.run()` in a program, running there?"
        return f"{self.address} {when}: {question}{f' ({note})' if note else ''}"

    def _may_pair(self) -> bool:
        failure = self._connection.failure
        unpaired = isinstance(failure, RefusedError) and failure.code == RefusalCode.UNPAIRED
        return unpaired and not self._paired_anew and bool(self._request.join_code)

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
